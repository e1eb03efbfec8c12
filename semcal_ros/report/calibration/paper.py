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

"""The figures of the paper beside those of a calibration.

Malti et al. (2012), doi:10.1117/1.JEI.21.3.033020.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.report.calibration.numbers import PAPER_RMS_PX, compute_held_out_px
from semcal_ros.report.html.text import format_px

__all__ = ["PaperRow", "compute_median_px", "tabulate_beside_paper"]

# Section 4.1.3, medians: after the correction of drift but not of distortion.
_PAPER_STRAIGHT_PX = 3.0


@dataclass(frozen=True)
class PaperRow:
    """One kind of error, here and in the paper."""

    label: str
    here: str
    paper: str


def compute_median_px(errors: Mapping[float, float]) -> float | None:
    """Compute the median over the magnifications, px, or None."""
    values = [v for v in errors.values() if not np.isnan(v)]
    return float(np.median(values)) if values else None


def tabulate_beside_paper(
    result: CalibrationResult, rms: Mapping[float, float], straight: Mapping[float, float]
) -> list[PaperRow]:
    """Tabulate the errors of a calibration beside those of the paper.

    Parameters
    ----------
    rms, straight
        Error in px at each magnification, with and without correction of the distortion.
    """
    abstract, section = PAPER_RMS_PX
    return [
        PaperRow(
            "Distortion left in, median over the magnifications",
            format_px(compute_median_px(straight)),
            f"{_PAPER_STRAIGHT_PX:g} px (median, section 4.1.3)",
        ),
        PaperRow(
            "Distortion corrected, median over the magnifications",
            format_px(compute_median_px(rms)),
            f"{section:g} px (median, section 4.1.3)",
        ),
        PaperRow(
            "Distortion corrected, all corners",
            format_px(result.fit.rms_px()),
            f"{abstract:g} px (abstract and figure 13)",
        ),
        PaperRow(
            "Magnifications left out of the calibration, RMS without the outermost two",
            format_px(compute_held_out_px(result)),
            "not reported",
        ),
    ]
