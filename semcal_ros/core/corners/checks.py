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

"""Fitted corners, and the checks that each of them must pass: alone, and against the predictions of its neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from semcal_ros.core.arrays import MEDIAN_CHI2, MEDIAN_CHI2_2, Array, Array32, Indices, Mask
from semcal_ros.core.corners.corner_fit import CornerFit, PositionFit
from semcal_ros.core.corners.edge_model import PixelWindows
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
    CORNERS_COMPARED_MIN,
    COVERAGE_MIN,
    IMBALANCE_MAX,
    LARGE_SQUARE_PX,
    LEVERAGE_MAX,
    MAP_ERROR_PX,
    MAP_ERROR_RATIO,
    MARGIN_PX,
    MEDIAN_SIGMA_1,
    MEDIAN_SIGMA_2,
    MISFIT_VISIBLE,
    PART_MIN,
    RESIDUAL_SIGMAS,
    SCATTER_SIGMAS,
    SUPPORT_MIN,
    TREND_DEGREE,
    UNLIKE_MAX,
)

# By the number of dimensions.
MEDIAN_SIGMA = {1: MEDIAN_SIGMA_1, 2: MEDIAN_SIGMA_2}


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


def find_consistent(cells: Indices, maps: LocalMaps, fit: PositionFit, good: Mask) -> Mask:
    """Select corners of the ``good`` ones that agree with the predictions of their neighbours; (n,).

    Later passes leave out the worst corners, which spoil the predictions of their neighbours.
    """
    chosen = good
    for sigmas in RESIDUAL_SIGMAS:
        if chosen.sum() < CORNERS_COMPARED_MIN:
            return np.zeros(len(good), dtype=np.bool_)
        chosen = good & _agree_with_neighbours(cells, maps, fit, chosen, sigmas)
    return chosen


def _agree_with_neighbours(
    cells: Indices, cell_maps: LocalMaps, fit: PositionFit, good: Mask, sigmas: float
) -> Mask:
    """Select corners within ``sigmas`` of the predictions of the good corners around them; (n,)."""
    xy = fit.xy
    # Local maps extrapolate at the rim and are coarse in large squares. There only the residuals of
    # a smooth trend are small enough for them.
    rest = xy - _trend(cells, good, xy)
    maps = fit_local_maps(cells, cells[good], rest[good])
    # The neighbours are as uncertain as the corner itself.
    residual = (rest - maps.xy) / np.sqrt(1.0 + maps.leverage)[:, None]
    covariance = fit.covariance * inflate_variance(fit, good)[:, None, None]
    error = _map_error(cell_maps, good, covariance, _squared_mahalanobis(residual, covariance))
    covariance = covariance + (error**2)[:, None, None] * np.eye(2)
    passed = _squared_mahalanobis(residual, covariance) < sigmas**2
    return passed & (maps.support >= SUPPORT_MIN)


def estimate_scatter_px(cells: Indices, xy: Array, covariance: Array, dimensions: int = 2) -> float:
    """Estimate by how much points scatter about their neighbours beyond their covariances, 1-sigma per axis in px.

    Pixel noise does not tell it: edges are rough, debris lies beside them, and lines jitter. The result is 0 where
    chance explains the scatter, which it does in 399 of 400 images of a regular grid.

    Parameters
    ----------
    cells, xy, covariance
        (n, 2), (n, 2) and (n, 2, 2) of the points.
    dimensions
        In how many directions they are known: one for places on lines, whose other direction has a far larger variance.
    """
    flat = xy - _trend(cells, np.ones(len(cells), dtype=np.bool_), xy, 1)
    # Whatever a smooth model leaves of the distortion looks like scatter: the model that leaves least counts.
    scores = [_score_neighbours(cells, flat, covariance), _score_lens(xy, flat, covariance)]
    scores += [
        _score_trend(cells, flat, covariance, degree) for degree in range(2, TREND_DEGREE + 1)
    ]
    excess = min(scores) / MEDIAN_CHI2[dimensions] - 1.0
    if not 0.0 < SCATTER_SIGMAS * MEDIAN_SIGMA[dimensions] / np.sqrt(len(cells)) < excess < np.inf:
        return 0.0
    variances = np.linalg.eigvalsh(covariance)[:, :dimensions]
    return float(np.sqrt(excess * np.median(variances.mean(axis=1))))


def _score_lens(xy: Array, flat: Array, covariance: Array) -> float:
    """Return the median chi-square about a perspective with radial and decentring distortion."""
    x, y = ((xy - xy.mean(axis=0)) / np.std(xy)).T
    none, one, square = np.zeros_like(x), np.ones_like(x), x * x + y * y
    columns = [
        *((basis, none) for basis in (one, x, y)),
        *((none, basis) for basis in (one, x, y)),
        (x * x, x * y),
        (x * y, y * y),
        (x * square, y * square),
        (square + 2.0 * x * x, 2.0 * x * y),
        (2.0 * x * y, square + 2.0 * y * y),
    ]
    design = np.array(columns).reshape(len(columns), -1).T
    freedom = design.shape[0] - design.shape[1]
    if freedom < CORNERS_COMPARED_MIN:
        return np.inf
    target = flat.T.ravel()
    rest = (target - design @ np.linalg.lstsq(design, target, rcond=None)[0]).reshape(2, -1).T
    median = float(np.median(_squared_mahalanobis(rest, covariance)))
    return median * design.shape[0] / freedom


def _score_neighbours(cells: Indices, flat: Array, covariance: Array) -> float:
    """Return the median chi-square about predictions of neighbours; infinite without any."""
    rest = flat - _trend(cells, np.ones(len(cells), dtype=np.bool_), flat)
    maps = fit_local_maps(cells, cells, rest)
    supported = maps.support >= SUPPORT_MIN
    if supported.sum() < CORNERS_COMPARED_MIN:
        return np.inf
    residual = (rest - maps.xy) / np.sqrt(1.0 + maps.leverage)[:, None]
    return float(np.median(_squared_mahalanobis(residual, covariance)[supported]))


def _score_trend(cells: Indices, flat: Array, covariance: Array, degree: int) -> float:
    """Return the same about a polynomial trend; infinite with more than half as many terms as points."""
    count, terms = len(cells), (degree + 1) * (degree + 2) // 2
    if 2 * terms > count:
        return np.inf
    rest = flat - _trend(cells, np.ones(count, dtype=np.bool_), flat, degree)
    median = float(np.median(_squared_mahalanobis(rest, covariance)))
    return median * count / (count - terms)


def _squared_mahalanobis(residual: Array, covariance: Array) -> Array:
    """Return (n,) squared lengths of (n, 2) vectors in standard deviations."""
    x, y = residual.T
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)


def _map_error(maps: LocalMaps, good: Mask, covariance: Array, squared: Array) -> Array:
    """Estimate the (n,) errors of the maps besides noise, px, from the image as a whole.

    An uneven board is uneven everywhere; a distortion is too strong for the maps only in a part of
    the image.
    """
    excess = max(float(np.median(squared[good])) / MEDIAN_CHI2_2 - 1.0, 0.0)
    variance = 0.5 * np.trace(covariance, axis1=1, axis2=2)
    seen = np.sqrt(excess * float(np.median(variance[good])))
    spacing = np.linalg.norm(maps.axes, axis=2).min(axis=1)
    worst = MAP_ERROR_PX * (spacing / LARGE_SQUARE_PX) ** 3
    return np.maximum(seen, np.minimum(worst, MAP_ERROR_RATIO * seen))


def _trend(cells: Indices, good: Mask, xy: Array, most: int = TREND_DEGREE) -> Array:
    """Return (n, 2) positions of all cells on a polynomial through the good corners, of at most the degree ``most``."""
    known = int(good.sum())
    degree = max(d for d in range(1, most + 1) if d == 1 or (d + 1) * (d + 2) <= known)
    low, high = cells.min(axis=0), cells.max(axis=0)
    scaled = (2.0 * cells - low - high) / max(1, int((high - low).max()))
    u, v = (np.vander(column, degree + 1, increasing=True) for column in scaled.T)
    basis = np.concatenate(
        [u[:, a, None] * v[:, : degree + 1 - a] for a in range(degree + 1)], axis=1
    )
    through = basis[good]
    # The ridge is for boards of a few rows, which do not determine all terms.
    normal = through.T @ through + 1e-9 * known * np.eye(basis.shape[1])
    return basis @ np.linalg.solve(normal, through.T @ xy[good])
