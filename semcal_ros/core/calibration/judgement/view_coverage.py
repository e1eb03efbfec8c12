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

"""What found views cover before anything is calibrated from them: field, tilts and magnifications."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.corners import LatticeDetection

__all__ = ["ViewCoverage", "estimate_tilt_deg", "measure_view_coverage"]

# Cells across the field. At the lowest magnifications a square of the grid is smaller than one of them; at the
# highest, a view has some tens of corners, and a few views fill them.
_ACROSS = 8


@dataclass(frozen=True)
class ViewCoverage:
    """What views cover.

    Attributes
    ----------
    field_share
        Share of the cells of the field that have a corner in at least one view; 0 without views.
    tilts_deg
        Tilt of the grid in each view: what the stage says, else as :func:`estimate_tilt_deg`.
    views
        Number of views at each magnification, in ascending order.
    """

    field_share: float
    tilts_deg: tuple[float, ...]
    views: dict[float, int]


def estimate_tilt_deg(detection: LatticeDetection) -> float:
    """Estimate the tilt of a square grid from how much shorter it is in one direction, degrees.

    An aspect of the pixels of 1 % looks like 8 degrees, so this tells large tilts from small ones only.
    """
    ij = detection.ij - detection.ij.mean(axis=0)
    map_from_lattice = np.linalg.lstsq(
        ij.astype(np.float64), detection.xy - detection.xy.mean(axis=0), rcond=None
    )[0]
    longer, shorter = np.linalg.svd(map_from_lattice, compute_uv=False)
    return math.degrees(math.acos(min(float(shorter / longer), 1.0)))


def _filled(detection: LatticeDetection, rows: int) -> Array:
    width, height = detection.image_size
    cells = np.floor((detection.xy + 0.5) / np.array([width / _ACROSS, height / rows]))
    column, row = np.clip(cells.astype(np.intp), 0, [_ACROSS - 1, rows - 1]).T
    filled = np.zeros((rows, _ACROSS), dtype=np.float64)
    filled[row, column] = 1.0
    return filled


def measure_view_coverage(views: Sequence[FoundView]) -> ViewCoverage:
    """Measure what views of one microscope cover.

    Parameters
    ----------
    views
        Of any magnifications. Their images should have one shape; where they have not, the shape of the first counts.
    """
    if not views:
        return ViewCoverage(0.0, (), {})
    width, height = views[0].detection.image_size
    rows = max(1, round(_ACROSS * height / width))
    filled = np.max([_filled(view.detection, rows) for view in views], axis=0)
    tilts = []
    for view in views:
        told = None if view.stage is None else view.stage.tilt_rad
        tilts.append(estimate_tilt_deg(view.detection) if told is None else math.degrees(told))
    counts = Counter(float(view.magnification) for view in views)
    return ViewCoverage(float(np.mean(filled)), tuple(tilts), dict(sorted(counts.items())))
