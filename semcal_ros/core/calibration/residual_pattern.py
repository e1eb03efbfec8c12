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

"""Residuals of a calibration over the image field: what is more than chance."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.coverage import assign_cells, concatenate_corners

__all__ = ["estimate_pattern_px", "normalise_residuals"]

# Cells across the field for the test: larger than in the figure, so that their means are less
# noisy.
_PATTERN_CELLS = 8
# With fewer corners a cell is left out.
_MIN_IN_CELL = 5


def normalise_residuals(result: CalibrationResult) -> Array:
    """Divide residuals (n, 2) by the 1-sigma of their corners."""
    sigma = np.concatenate([v.sigma_px for v in result.views])
    return np.asarray(np.concatenate(result.fit.residuals_px) / sigma[:, None], dtype=np.float64)


def estimate_pattern_px(result: CalibrationResult) -> tuple[float, float]:
    """Estimate the size in px of a pattern in the residuals, and its ratio to chance.

    The ratio compares the squares of the cells' weighted mean residuals with what independent
    corners of the same spread would give; 1 is pure chance.
    """
    xy, residuals = concatenate_corners(result)
    weights = np.concatenate([v.sigma_px for v in result.views]) ** -2.0
    cells = assign_cells(result, xy, _PATTERN_CELLS)
    size = cells.columns * cells.rows
    enough = cells.counts >= _MIN_IN_CELL
    if not np.any(enough):
        return 0.0, 1.0
    total = np.bincount(cells.index, weights, size)[enough]
    sums = np.stack(
        [np.bincount(cells.index, weights * residuals[:, k], size)[enough] for k in (0, 1)], axis=1
    )
    # The median is robust; 0.6745 is the median absolute value of a standard normal variable.
    spread = float(np.median(np.abs(normalise_residuals(result)))) / 0.6745
    chance = spread**2 / total
    squares = np.sum((sums / total[:, None]) ** 2, axis=1)
    excess = float(np.mean(squares - 2.0 * chance))
    if not np.all(chance > 0.0):
        return 0.0, 1.0
    return float(np.sqrt(max(excess, 0.0))), float(np.mean(squares / (2.0 * chance)))
