"""Fitted corners, and the checks that each of them has to pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.corners.local_map import LocalMaps, fit_local_maps
from semcal_ros.core.corners.priors import LARGE_SQUARE_PX
from semcal_ros.core.corners.refine import CornerFit
from semcal_ros.core.corners.window import PixelWindows

__all__ = [
    "CORNERS_MIN",
    "MARGIN_PX",
    "Fitted",
    "credible",
    "inflation",
    "parity_of",
    "smooth",
    "undisturbed",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Single = NDArray[np.float32]

# Corners nearer to the frame than this are not fitted: less than half of their window is in the
# image.
MARGIN_PX = 2.0
CONTRAST_MIN = 0.3
COVERAGE_MIN = 0.3
ANGLE_MAX = 0.2
CHI2_MAX = 4.0
CHI2_EXCESS = 0.5
CHI2_SIGMAS = 6.0
MISFIT_MAX = 0.12
# A local map does not follow a strong distortion exactly; its error is a small part of a square,
# and grows where the map extrapolates. Noise alone exceeds four sigmas once in 3000 corners.
MISS_SIGMAS = (5.0, 4.0)
MISS_PART = 0.005
# What a map through large squares on one side misses of a strong distortion, per variance.
EXTRAPOLATED_PX = 2.5
CORNERS_MIN = 6


@dataclass(frozen=True)
class Fitted:
    """Cells with their local maps, pixels, fits, and which of them are credible."""

    cells: Indices
    maps: LocalMaps
    windows: PixelWindows
    fit: CornerFit
    good: Mask

    def select(self, keep: Mask) -> Fitted:
        """Those where ``keep`` is true."""
        return Fitted(
            self.cells[keep],
            self.maps.select(keep),
            self.windows.select(keep),
            self.fit.select(keep),
            self.good[keep],
        )

    @staticmethod
    def join(first: Fitted, second: Fitted) -> Fitted:
        """Both sets."""
        return Fitted(
            np.concatenate([first.cells, second.cells]),
            LocalMaps.join([first.maps, second.maps]),
            PixelWindows.join([first.windows, second.windows]),
            CornerFit.join([first.fit, second.fit]),
            np.concatenate([first.good, second.good]),
        )


def credible(cells: Indices, maps: LocalMaps, fit: CornerFit, image: Single) -> Mask:
    """Fits that settled near the prediction, with the right sign of contrast."""
    norm = np.linalg.norm(maps.axes, axis=2)
    spacing = np.abs(np.linalg.det(maps.axes)) / norm.max(axis=1)
    expected = np.arctan2(maps.axes[:, :, 1], maps.axes[:, :, 0])
    turn = np.abs(np.angle(np.exp(1j * (fit.angles - expected)))).max(axis=1)
    moved = np.linalg.norm(fit.xy - maps.xy, axis=1)
    signed = fit.contrast * parity_of(cells)
    limit = np.array([image.shape[1], image.shape[0]]) - 1 - MARGIN_PX
    settled = (
        np.all((fit.xy >= MARGIN_PX) & (fit.xy <= limit), axis=1)
        & (fit.coverage > COVERAGE_MIN)
        & (moved < 0.25 * spacing)
        & (turn < ANGLE_MAX)
        & (fit.shift_px < 0.05 + 0.01 * spacing + 0.15 * fit.blur_px)
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


def parity_of(cells: Indices) -> Array:
    """(n,) 1 for cells of even i + j, -1 for the others: the sign of the contrast alternates."""
    return np.where(cells.sum(axis=1) % 2 == 0, 1.0, -1.0)


def undisturbed(fitted: Fitted) -> Mask:
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


def smooth(fitted: Fitted) -> Mask:
    """Corners that agree with what their neighbours predict.

    The second look is without the worst, which spoil the predictions of their neighbours.
    """
    good = fitted.good
    for sigmas in MISS_SIGMAS:
        if good.sum() < CORNERS_MIN:
            return np.zeros(len(good), dtype=np.bool_)
        good = fitted.good & _predicted(fitted, good, sigmas)
    return good


def _predicted(fitted: Fitted, good: Mask, sigmas: float) -> Mask:
    """Corners within so many standard deviations of what the good ones around them predict."""
    maps = fit_local_maps(fitted.cells, fitted.cells[good], fitted.fit.xy[good])
    reach = np.sqrt(1.0 + maps.leverage)
    miss = np.linalg.norm(fitted.fit.xy - maps.xy, axis=1) / reach
    # The median of a length in the plane is 1.18 standard deviations per axis.
    typical = float(np.median(miss[good])) / 1.18
    pooled = float(np.median(fitted.fit.chi2[good]))
    own = np.sqrt(pooled * np.trace(fitted.fit.covariance, axis1=1, axis2=2) / 2.0)
    spacing = np.linalg.norm(fitted.maps.axes, axis=2).min(axis=1)
    tolerance = sigmas * np.maximum(typical, own) + MISS_PART * spacing * reach
    tolerance += EXTRAPOLATED_PX * (spacing / LARGE_SQUARE_PX) ** 3 * maps.leverage
    return np.asarray((miss < tolerance) & maps.usable, dtype=np.bool_)


def inflation(fit: CornerFit, keep: Mask) -> Array:
    """Factor on the covariances: the pooled misfit, or a corner's own if that is far larger."""
    pooled = float(np.median(fit.chi2[keep]))
    significant = pooled * (1.0 + 3.0 * np.sqrt(2.0 / fit.freedom))
    return np.where(fit.chi2 > significant, fit.chi2, pooled)
