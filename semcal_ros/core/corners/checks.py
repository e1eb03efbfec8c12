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

"""Fitted corners, and the checks that each of them must pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from semcal_ros.core.arrays import MEDIAN_CHI2_2, Array, Array32, Indices, Mask
from semcal_ros.core.corners.corner_fit import CornerFit, PositionFit
from semcal_ros.core.corners.local_map import LocalMaps, fit_local_maps
from semcal_ros.core.corners.thresholds import (
    ANGLE_MAX,
    BLUR_SIGMAS,
    BORDER_UNLIKE,
    CHI2_EXCESS,
    CHI2_MAX,
    CHI2_SIGMAS,
    CONTINUED_MAX,
    CONTRAST_MIN,
    COVERAGE_MIN,
    IMBALANCE_MAX,
    LEVERAGE_MAX,
    MARGIN_PX,
    MISFIT_VISIBLE,
    PART_MIN,
    UNLIKE_MAX,
)
from semcal_ros.core.corners.window import PixelWindows

__all__ = [
    "FittedCorners",
    "contrast_signs",
    "find_credible",
    "find_undisturbed",
    "inflate_variance",
    "select_connected",
]


def select_connected(cells: Indices, maps: LocalMaps, fit: PositionFit, keep: Mask) -> Mask:
    """Select the largest part of the lattice and the parts that continue it; (n,) true for these.

    Where two boards meet, a lattice grows from one into the other, but no corner in between agrees
    with its neighbours. Debris also divides a board, but then the maps of one part predict the
    other.
    """
    low = cells[keep].min(axis=0)
    grid = np.zeros(cells[keep].max(axis=0) - low + 1, dtype=np.bool_)
    grid[tuple((cells[keep] - low).T)] = True
    labels, count = ndimage.label(grid)
    if count == 1:
        return keep
    part = np.zeros(len(keep), dtype=np.int64)
    part[keep] = labels[tuple((cells[keep] - low).T)]
    order = np.argsort(-np.bincount(part[keep], minlength=count + 1), kind="stable")[:count]
    size = np.bincount(part, minlength=count + 1)
    joined = keep & ((part == order[0]) | (size[part] < PART_MIN))
    waiting = [p for p in order[1:] if size[p] >= PART_MIN]
    # A part may continue the lattice only across another one.
    while True:
        continuing = [p for p in waiting if _continues(cells, maps, fit, joined, part == p)]
        if not continuing:
            return joined
        joined |= np.isin(part, continuing)
        waiting = [p for p in waiting if p not in continuing]


def _continues(
    cells: Indices, cell_maps: LocalMaps, fit: PositionFit, joined: Mask, other: Mask
) -> bool:
    """Return whether the corners of a part lie where the joined ones predict them."""
    xy = fit.xy
    maps = fit_local_maps(cells[other], cells[joined], xy[joined])
    near = maps.usable & (maps.leverage < LEVERAGE_MAX)
    if not np.any(near):
        return False
    spacing = np.linalg.norm(cell_maps.axes[other][near], axis=2).min(axis=1)
    variance = 0.5 * np.trace(fit.covariance[other][near], axis1=1, axis2=2)
    residual = np.linalg.norm(xy[other][near] - maps.xy[near], axis=1)
    allowed = CONTINUED_MAX * spacing + 3.0 * np.sqrt(variance * (1.0 + maps.leverage[near]))
    return bool(np.median(residual / allowed) < 1.0)


@dataclass(frozen=True)
class FittedCorners:
    """Cells with their local maps, pixels and fits, and which of them are credible."""

    cells: Indices
    maps: LocalMaps
    windows: PixelWindows
    fit: CornerFit
    good: Mask

    def select(self, keep: Mask) -> FittedCorners:
        """Return the corners where ``keep`` is true."""
        return FittedCorners(
            self.cells[keep],
            self.maps.select(keep),
            self.windows.select(keep),
            self.fit.select(keep),
            self.good[keep],
        )

    @staticmethod
    def join(first: FittedCorners, second: FittedCorners) -> FittedCorners:
        """Return the corners of both sets."""
        return FittedCorners(
            np.concatenate([first.cells, second.cells]),
            LocalMaps.join([first.maps, second.maps]),
            PixelWindows.join([first.windows, second.windows]),
            CornerFit.join([first.fit, second.fit]),
            np.concatenate([first.good, second.good]),
        )


def find_credible(cells: Indices, maps: LocalMaps, fit: CornerFit, image: Array32) -> Mask:
    """Select fits that converged near the prediction with the right sign of contrast; (n,)."""
    norm = np.linalg.norm(maps.axes, axis=2)
    spacing = np.abs(maps.cell_px2) / norm.max(axis=1)
    expected = np.arctan2(maps.axes[:, :, 1], maps.axes[:, :, 0])
    turn = np.abs(np.angle(np.exp(1j * (fit.angles - expected)))).max(axis=1)
    moved = np.linalg.norm(fit.xy - maps.xy, axis=1)
    signed = fit.contrast * contrast_signs(cells)
    limit = np.array([image.shape[1], image.shape[0]]) - 1 - MARGIN_PX
    plausible = (
        np.all((fit.xy >= MARGIN_PX) & (fit.xy <= limit), axis=1)
        & (fit.coverage > COVERAGE_MIN)
        & (moved < 0.25 * spacing)
        & (turn < ANGLE_MAX)
        & (fit.shift_px < 0.05 + 0.01 * spacing + 0.15 * fit.blur_px)
    )
    if not np.any(plausible):
        return np.zeros(len(cells), dtype=np.bool_)
    typical = float(np.median(signed[plausible]))
    judged = plausible & (signed * np.sign(typical) > CONTRAST_MIN * abs(typical))
    if not np.any(judged):
        return np.zeros(len(cells), dtype=np.bool_)
    usual = CHI2_MAX * float(np.median(fit.chi2[judged]))
    small = fit.variance.mean(axis=1) < (MISFIT_VISIBLE * fit.contrast) ** 2
    return judged & ((fit.chi2 < usual) | small)


def contrast_signs(cells: Indices) -> Array:
    """Return (n,) 1 for cells of even i + j and -1 for the others, as the contrast alternates."""
    return np.where(cells.sum(axis=1) % 2 == 0, 1.0, -1.0)


def find_undisturbed(fitted: FittedCorners) -> Mask:
    """Select corners whose pixels the model explains: no debris, no border of the board; (n,).

    In an image with little noise the shortcomings of the model are significant everywhere, so the
    excess must also be a visible part of the contrast.
    """
    fit = fitted.fit
    # Half of the corners of a small board may lie on its border, and would set the median.
    good = fitted.good & (fit.unlike < BORDER_UNLIKE)
    if not np.any(good):
        return good
    pooled = float(np.median(fit.chi2[good]))
    significant = fit.chi2 > pooled * (1.0 + CHI2_EXCESS + CHI2_SIGMAS * np.sqrt(2.0 / fit.freedom))
    surplus = fit.variance.mean(axis=1) * np.maximum(1.0 - pooled / fit.chi2, 0.0)
    visible = surplus > (MISFIT_VISIBLE * fit.contrast) ** 2
    return good & ~(significant & visible) & _alike(fit, good, pooled)


def _alike(fit: CornerFit, good: Mask, pooled: float) -> Mask:
    """Select corners with opposite squares of the same grey value and edges as sharp as elsewhere.

    A grain in one square hardly shows in the sum of the squared residuals of a noisy image, but
    shifts the corner by many standard deviations.
    """
    usual = max(pooled, float(np.median(fit.imbalance[good])) / MEDIAN_CHI2_2)
    uneven = (fit.imbalance > IMBALANCE_MAX * usual) & (fit.unlike > UNLIKE_MAX)
    pull = np.abs(fit.blur_pull)
    # The median of the absolute value is 0.675 standard deviations.
    typical = max(1.0, float(np.median(pull[good])) / 0.675)
    return ~uneven & (pull < BLUR_SIGMAS * typical)


def inflate_variance(fit: PositionFit, keep: Mask) -> Array:
    """Return (n,) factors on the covariances: the pooled misfit, or a corner's far larger one."""
    pooled = float(np.median(fit.chi2[keep]))
    significant = pooled * (1.0 + 3.0 * np.sqrt(2.0 / fit.freedom))
    return np.where(fit.chi2 > significant, fit.chi2, pooled)
