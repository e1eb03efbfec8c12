# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a calibration is good for, in one sentence, and what would make it better, in another."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.calibration.judgement.plan import PLANNED_TILTS_RAD, PlannedVisit, plan_views
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.uncertainty_budget import worst_pixel_size
from semcal_ros.core.errors import SemcalError
from semcal_ros.core.wording import rounded_magnification

__all__ = ["Verdict", "judge_calibration"]

# A visit that lowers the largest sigma by less than this part is not worth the way to the microscope.
_WORTH = 0.05


@dataclass(frozen=True)
class Verdict:
    """How well a calibration knows nm per pixel.

    Attributes
    ----------
    low, high
        The calibrated range of magnifications.
    largest, at
        Largest relative 1-sigma of nm per pixel in the range, and the magnification where that is.
    pixel_size_m
        Pixel size there, the mean of both axes, m.
    floor
        The part of ``largest`` that no number of views removes: repeatability, squares, height; NaN if unknown.
    next_visit
        The visit that lowers it most; None where none is worth it, or the grid is not known.
    conditions
        What it holds for: voltage, working distance and date.
    """

    low: float
    high: float
    largest: float
    at: float
    pixel_size_m: float
    floor: float
    next_visit: PlannedVisit | None
    conditions: str = ""

    @property
    def pixel_sigma_m(self) -> float:
        """1-sigma of the pixel size there, m."""
        return self.largest * self.pixel_size_m

    def describe(self) -> str:
        """Return how well nm per pixel is known, over which range, and under which conditions."""
        # Pixels of photographs of a board are some tenths of a mm.
        factor, unit = (1e9, "nm") if self.pixel_size_m < 1e-4 else (1e6, "um")
        sigma, size = factor * self.pixel_sigma_m, factor * self.pixel_size_m
        digits = 2
        if 0.0 < sigma < math.inf:
            digits = min(max(1 - math.floor(math.log10(sigma)), 0), 6)
        span = (
            f"from {self.low:g}x to {self.high:g}x" if self.high > self.low else f"at {self.low:g}x"
        )
        best = f"{100.0 * self.largest:.2g} % (1-sigma)" + (
            " or better" if self.high > self.low else ""
        )
        where = f", least well at {rounded_magnification(self.at)}" if self.high > self.low else ""
        known = f"{size:.{digits}f} +- {sigma:.{digits}f} {unit}"
        under = f" ({self.conditions})" if self.conditions else ""
        return f"nm per px is known to {best} {span}{where}: {known}{under}"

    def advise(self) -> str:
        """Return what to record next; empty if that is not known."""
        visit = self.next_visit
        if visit is not None:
            tilts = " and ".join(f"{math.degrees(t):.0f}" for t in PLANNED_TILTS_RAD if t > 0.0)
            return (
                f"to improve it most: views of the {1e6 * visit.square_m:g} um squares at "
                f"{rounded_magnification(visit.magnification)}, flat and tilted by {tilts} degrees, "
                f"bring it to {100.0 * visit.largest:.2g} % (see semcal plan)"
            )
        if not math.isfinite(self.floor):
            return ""
        return (
            "more views would hardly improve it: the repeatability of the magnification, the squares and the height "
            f"alone make {100.0 * self.floor:.2g} % (semcal at --budget lists them)"
        )


def judge_calibration(model: CalibrationModel) -> Verdict:
    """Judge how well a calibration knows nm per pixel, and what would improve that most."""
    largest, at = worst_pixel_size(model)
    low, high = model.magnification_range
    size_m = float(np.mean(model.at(at).pixel_size_m))
    squares = () if model.record is None else model.record.squares_m
    floor, visit = math.nan, None
    if squares and math.isfinite(largest) and largest > 0.0:
        try:
            plan = plan_views(model, 1e-9, squares_m=squares, most_visits=1)
        except (SemcalError, ArithmeticError, np.linalg.LinAlgError):
            pass  # a calibration that was edited can be anything; the sentence is then left out
        else:
            floor = plan.floor
            first = plan.visits[0] if plan.visits else None
            if first is not None and first.largest < (1.0 - _WORTH) * largest:
                visit = first
    conditions = model.provenance.describe_essentials()
    return Verdict(float(low), float(high), largest, at, size_m, floor, visit, conditions)
