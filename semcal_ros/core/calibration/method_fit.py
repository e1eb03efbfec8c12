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

"""What every method hands on: its fit, and the weaknesses that it found, each with its cost in nanometres."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.problem import Functions, Setup
from semcal_ros.core.camera.calibration_model import CalibrationModel, ScaleSigma
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import in_nm, rounded_magnification


@dataclass(frozen=True)
class Finding:
    """Something that makes a calibration worse than it could be.

    Attributes
    ----------
    text
        What was found, and what to do, in a sentence without capital and full stop.
    cost_px
        By how much positions at the edge of the image are off for it relative to its centre, px; NaN where that is not
        known.
    cost_relative
        The same as a part of half the image width: of an error of the scale, the aspect or the skew.
    magnification
        Where that is; NaN for what is the same at all magnifications, and so costs most nm at the lowest.
    """

    text: str
    cost_px: float = math.nan
    cost_relative: float = math.nan
    magnification: float = math.nan

    def cost(self, model: CalibrationModel) -> tuple[float, float]:
        """Return the cost in nm, and the magnification at which it is meant; NaN where it is not known."""
        low = model.magnification_range[0]
        g = self.magnification if math.isfinite(self.magnification) else low
        px = self.cost_px
        if math.isfinite(self.cost_relative):
            px = abs(self.cost_relative) * 0.5 * model.image_width
        if not math.isfinite(px):
            return math.nan, math.nan
        try:
            return 1e9 * px * float(np.mean(model.at(g).pixel_size_m)), g
        except InvalidValueError:
            return math.nan, math.nan

    def sentence(self, model: CalibrationModel) -> str:
        """Return the sentence, with what it costs in nm, if that is known and not nothing."""
        cost_nm, g = self.cost(model)
        if not math.isfinite(cost_nm) or cost_nm == 0.0:
            return self.text
        return f"{self.text} (costs {in_nm(1e-9 * cost_nm)} at {rounded_magnification(g)})"


def rank_findings(findings: Iterable[Finding], model: CalibrationModel) -> tuple[Finding, ...]:
    """Return the findings, each once, the most costly in nm first; those whose cost is not known come last."""

    def order(finding: Finding) -> float:
        cost_nm, _ = finding.cost(model)
        return -cost_nm if math.isfinite(cost_nm) else math.inf

    return tuple(sorted({own.text: own for own in findings}.values(), key=order))


@dataclass(frozen=True)
class MethodFit:
    """The common result of all methods.

    ``without`` gives it without one magnification; ``failure`` says how it did not converge.
    """

    functions: Functions
    covariance: Array
    without: Callable[[int], tuple[Functions, ResidualField | None]]
    height_sigma_m: Array
    poses: tuple[Array, Array] | None
    details: dict[str, Any]
    findings: tuple[Finding, ...]
    residual: ResidualField | None = None
    repeatability: float = 0.0
    failure: str = ""


def make_model(
    setup: Setup,
    functions: Functions,
    covariance: Array,
    method: str,
    residual: ResidualField | None = None,
    scale_sigma: ScaleSigma | None = None,
) -> CalibrationModel:
    """Make the calibration of some functions and their covariance."""
    return CalibrationModel(
        functions=functions,
        covariance=covariance,
        image_width=setup.image_size[0],
        image_height=setup.image_size[1],
        display_width_m=setup.display_width_m,
        magnifications=tuple(float(g) for g in setup.magnifications),
        method=method,
        residual=residual,
        scale_sigma=scale_sigma or ScaleSigma(),
    )
