"""From a grown lattice to every corner in view at sub-pixel accuracy: fill in, fit, reject."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.corners.lattice import STEPS, Lattice
from semcal_ros.core.corners.local_map import LocalMaps, fit_local_maps
from semcal_ros.core.corners.refine import CornerFit, NoiseModel, fit_corners, fit_noise

__all__ = ["RefinedCorners", "refine_lattice"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Single = NDArray[np.float32]

# Corners nearer to the frame than this are not fitted: less than half of their window is in the
# image.
MARGIN_PX = 2.0
FIRST_BLUR_PX = 1.0
CONTRAST_MIN = 0.3
COVERAGE_MIN = 0.3
ANGLE_MAX = 0.2
CHI2_MAX = 4.0
CHI2_EXCESS = 0.5
CHI2_SIGMAS = 6.0
MISFIT_MAX = 0.12
# A local map does not follow a strong distortion exactly; its error is a small part of a square.
MISS_SIGMAS = 5.0
MISS_PART = 0.005
GROW_ROUNDS = 4
CORNERS_MIN = 6


@dataclass(frozen=True)
class RefinedCorners:
    """Corners that passed all checks.

    Attributes
    ----------
    ij, xy
        (n, 2) indices and positions.
    covariance
        (n, 2, 2), px^2.
    blur_px
        Median blur.
    quality
        Part of the corners expected inside the lattice's extent that passed.
    rejected
        Number that did not pass.
    """

    ij: Indices
    xy: Array
    covariance: Array
    blur_px: float
    quality: float
    rejected: int


@dataclass(frozen=True)
class _Fitted:
    """Cells with their local maps, fits, and which of them are credible."""

    cells: Indices
    maps: LocalMaps
    fit: CornerFit
    good: Mask


@dataclass(frozen=True)
class _Known:
    """Credible corners so far."""

    cells: Indices
    xy: Array
    blur_px: float

    def select(self, keep: Mask) -> _Known:
        return _Known(self.cells[keep], self.xy[keep], self.blur_px)


def refine_lattice(image: Single, lattice: Lattice) -> RefinedCorners | None:
    """Fit all corners of a lattice, drop bad ones, look for missed ones; None if under six remain.

    Parameters
    ----------
    image
        (h, w) float32 with a contrast of about 1.
    lattice
        Grown from saddle points.
    """
    grown = _plausible(lattice)
    if len(grown.ij) < CORNERS_MIN:
        return None
    maps = fit_local_maps(grown.ij, grown.ij, grown.xy, leave_out_self=False)
    usable = maps.usable
    if usable.sum() < CORNERS_MIN:
        return None
    grown, maps = grown.select(usable), maps.select(usable)
    first = _fit(image, grown.ij, maps, None, None, FIRST_BLUR_PX, iterations=3)
    count = int(first.good.sum())
    if count < CORNERS_MIN:
        return None
    noise = fit_noise(first.fit.select(first.good))
    known = _fill(image, _credible_corners(first))
    maps = fit_local_maps(known.cells, known.cells, known.xy, leave_out_self=False)
    known, maps = known.select(maps.usable), maps.select(maps.usable)
    if len(known.cells) < CORNERS_MIN:
        return None
    last = _fit(image, known.cells, maps, known.xy, noise, known.blur_px, iterations=2)
    keep = last.good & _undisturbed(last)
    keep &= _smooth(replace(last, good=keep))
    if keep.sum() < CORNERS_MIN:
        return None
    fit = last.fit
    return RefinedCorners(
        known.cells[keep],
        fit.xy[keep],
        fit.covariance[keep] * _inflation(fit, keep)[keep, None, None],
        float(np.median(fit.blur_px[keep])),
        count / len(grown.ij),
        int(len(keep) - keep.sum()),
    )


def _plausible(lattice: Lattice) -> Lattice:
    """The lattice without points that do not fit their neighbours."""
    maps = fit_local_maps(lattice.ij, lattice.ij, lattice.xy)
    miss = np.linalg.norm(maps.xy - lattice.xy, axis=1)
    spacing = np.linalg.norm(lattice.axes, axis=2).min(axis=1)
    keep = (miss < 0.3 * spacing) & maps.usable
    return lattice.select(keep)


def _fit(
    image: Single,
    cells: Indices,
    maps: LocalMaps,
    start: Array | None,
    noise: NoiseModel | None,
    blur_px: float,
    *,
    iterations: int,
) -> _Fitted:
    """Fit all cells from their local maps and judge each fit on its own."""
    fit = fit_corners(image, maps, start, blur_px, noise=noise, iterations=iterations)
    return _Fitted(cells, maps, fit, _credible(cells, maps, fit, image))


def _credible(cells: Indices, maps: LocalMaps, fit: CornerFit, image: Single) -> Mask:
    """Fits that settled near the prediction, with the right sign of contrast."""
    norm = np.linalg.norm(maps.axes, axis=2)
    spacing = np.abs(np.linalg.det(maps.axes)) / norm.max(axis=1)
    expected = np.arctan2(maps.axes[:, :, 1], maps.axes[:, :, 0])
    turn = np.abs(np.angle(np.exp(1j * (fit.angles - expected)))).max(axis=1)
    moved = np.linalg.norm(fit.xy - maps.xy, axis=1)
    parity = np.where(cells.sum(axis=1) % 2 == 0, 1.0, -1.0)
    signed = fit.contrast * parity
    limit = np.array([image.shape[1], image.shape[0]]) - 1 - MARGIN_PX
    settled = (
        np.all((fit.xy >= MARGIN_PX) & (fit.xy <= limit), axis=1)
        & (fit.coverage > COVERAGE_MIN)
        & (moved < 0.25 * spacing)
        & (turn < ANGLE_MAX)
        & (fit.shift_px < 0.05 + 0.01 * spacing)
    )
    if not np.any(settled):
        return np.zeros(len(cells), dtype=np.bool_)
    typical = float(np.median(signed[settled]))
    judged = settled & (signed * np.sign(typical) > CONTRAST_MIN * abs(typical))
    if not np.any(judged):
        return np.zeros(len(cells), dtype=np.bool_)
    usual = CHI2_MAX * float(np.median(fit.chi2[judged]))
    small = fit.variance.mean(axis=1) < (MISFIT_MAX * fit.contrast) ** 2
    return np.asarray(judged & ((fit.chi2 < usual) | small), dtype=np.bool_)


def _credible_corners(fitted: _Fitted) -> _Known:
    good = fitted.good
    return _Known(
        fitted.cells[good], fitted.fit.xy[good], float(np.median(fitted.fit.blur_px[good]))
    )


def _fill(image: Single, known: _Known) -> _Known:
    """Fit free cells next to good corners, round by round, as long as that finds more."""
    limit = np.array([image.shape[1], image.shape[0]]) - 1 - MARGIN_PX
    tried = _keys(known.cells)
    for _ in range(GROW_ROUNDS):
        near = np.unique((known.cells[:, None] + STEPS[None]).reshape(-1, 2), axis=0)
        near = near[~np.isin(_keys(near), tried)]
        if not len(near):
            break
        maps = fit_local_maps(near, known.cells, known.xy)
        inside = np.all((maps.xy >= MARGIN_PX) & (maps.xy <= limit), axis=1)
        inside &= maps.usable
        near = near[inside]
        if not len(near):
            break
        tried = np.concatenate([tried, _keys(near)])
        fitted = _fit(image, near, maps.select(inside), None, None, known.blur_px, iterations=4)
        if not np.any(fitted.good):
            break
        found = _credible_corners(fitted)
        known = _Known(
            np.concatenate([known.cells, found.cells]),
            np.concatenate([known.xy, found.xy]),
            known.blur_px,
        )
    return known


def _keys(cells: Indices) -> Indices:
    """One number per cell; indices stay far below 2^20."""
    return np.asarray(cells[:, 0] * (1 << 21) + cells[:, 1], dtype=np.int64)


def _undisturbed(fitted: _Fitted) -> Mask:
    """Corners whose pixels the model explains: no debris, no border of the board.

    In a picture with little noise the model's own shortcomings are significant everywhere, so that
    the excess must also be a visible part of the contrast.
    """
    fit = fitted.fit
    if not np.any(fitted.good):
        return fitted.good
    pooled = float(np.median(fit.chi2[fitted.good]))
    significant = fit.chi2 > pooled * (1.0 + CHI2_EXCESS + CHI2_SIGMAS * np.sqrt(2.0 / fit.freedom))
    surplus = fit.variance.mean(axis=1) * np.maximum(1.0 - pooled / fit.chi2, 0.0)
    return np.asarray(~(significant & (surplus > (MISFIT_MAX * fit.contrast) ** 2)))


def _smooth(fitted: _Fitted) -> Mask:
    """Corners that agree with what their neighbours predict."""
    good = fitted.good
    if good.sum() < CORNERS_MIN:
        return np.zeros(len(good), dtype=bool)
    cells, xy = fitted.cells[good], fitted.fit.xy[good]
    maps = fit_local_maps(fitted.cells, cells, xy)
    miss = np.linalg.norm(fitted.fit.xy - maps.xy, axis=1) / np.sqrt(1.0 + maps.leverage)
    # The median of a length in the plane is 1.18 standard deviations per axis.
    typical = float(np.median(miss[good])) / 1.18
    pooled = float(np.median(fitted.fit.chi2[good]))
    own = np.sqrt(pooled * np.trace(fitted.fit.covariance, axis1=1, axis2=2) / 2.0)
    spacing = np.linalg.norm(fitted.maps.axes, axis=2).min(axis=1)
    tolerance = MISS_SIGMAS * np.maximum(typical, own) + MISS_PART * spacing
    return np.asarray((miss < tolerance) & maps.usable, dtype=np.bool_)


def _inflation(fit: CornerFit, keep: Mask) -> Array:
    """Factor on the covariances: the pooled misfit, or a corner's own if that is far larger."""
    pooled = float(np.median(fit.chi2[keep]))
    significant = pooled * (1.0 + 3.0 * np.sqrt(2.0 / fit.freedom))
    return np.where(fit.chi2 > significant, fit.chi2, pooled)
