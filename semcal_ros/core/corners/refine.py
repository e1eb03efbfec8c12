"""Least-squares fit of the edge model to the pixels around each corner, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.corners.edge_model import (
    LINEAR,
    NONLINEAR,
    EdgeGeometry,
    evaluate,
)
from semcal_ros.core.corners.local_map import LocalMaps
from semcal_ros.core.corners.window import PixelWindows, gather_windows

__all__ = ["CornerFit", "NoiseModel", "fit_corners", "fit_noise"]

Array = NDArray[np.float64]
Single = NDArray[np.float32]

BLUR_MIN_PX = 0.28
BAND_MIN_PX = 4.0
BAND_BLURS = 3.5
BLOCK_PIXELS = 30000.0
ANGLE_PRIOR = 0.03
LOG_BLUR_FIRST_PRIOR = 0.5
LOG_BLUR_PRIOR = 0.15
# What a quadratic or cubic map through few, one-sided neighbours misses of a strong distortion
# grows as the third power.
SAGITTA_PRIOR_PX = 0.5
LARGE_SQUARE_PX = 130.0
# Shading over half a square, relative to the contrast of the image.
GRADIENT_PRIOR = 0.15
# For the first pass, which knows no noise yet.
ASSUMED_VARIANCE = 0.02


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a pixel: ``floor + slope * max(value - dark, 0)`` of its grey value."""

    floor: float
    slope: float
    dark: float

    def variance(self, value: Single) -> Single:
        """Variance at the grey values ``value``, same shape."""
        above = np.maximum(value - np.float32(self.dark), np.float32(0.0))
        return np.asarray(np.float32(self.floor) + np.float32(self.slope) * above, dtype=np.float32)


@dataclass(frozen=True)
class CornerFit:
    """Fitted corners.

    Attributes
    ----------
    xy
        (n, 2) positions, px.
    covariance
        (n, 2, 2) covariance of the positions, px^2, for the noise model given (unit noise without
        one).
    nonlinear, linear
        (n, 7) and (n, 6) parameters of :mod:`semcal_ros.core.corners.edge_model`, positions
        relative to the window.
    chi2
        (n,) weighted squared residuals per degree of freedom.
    freedom
        (n,) degrees of freedom.
    shift_px
        (n,) size of the last step; large where the fit has not settled.
    coverage
        (n,) part of the window in the image.
    level, variance
        (n, 2) mean grey value and squared residual of the pixels darker and of those brighter than
        the middle.
    """

    xy: Array
    covariance: Array
    nonlinear: Array
    linear: Array
    chi2: Array
    freedom: Array
    shift_px: Array
    coverage: Array
    level: Array
    variance: Array

    def select(self, keep: NDArray[np.bool_]) -> CornerFit:
        """The fits of the corners where ``keep`` is true."""
        return CornerFit(*(getattr(self, f.name)[keep] for f in fields(self)))

    @property
    def angles(self) -> Array:
        """(n, 2) directions of the edges along i and along j, rad."""
        return self.nonlinear[:, 2:4]

    @property
    def blur_px(self) -> Array:
        """(n,) standard deviation of the blur, px."""
        return np.asarray(np.exp(self.nonlinear[:, 4]), dtype=np.float64)

    @property
    def contrast(self) -> Array:
        """(n,) signed contrast: half the step of grey value between squares."""
        return self.linear[:, 3]


def fit_corners(
    image: Single,
    maps: LocalMaps,
    start: Array | None,
    blur_px: float,
    *,
    noise: NoiseModel | None,
    iterations: int,
) -> CornerFit:
    """Gauss-Newton on position, edge directions, blur, grey levels and their gradients.

    Parameters
    ----------
    image
        (h, w) float32.
    maps
        Where the corners are expected, and first directions and the curvature of their edges.
    start
        (n, 2) first positions in the image, or None for those of the maps.
    blur_px
        First blur; the band of pixels used along the edges follows from it.
    noise
        Noise for the weights; None for equal weights.
    iterations
        Number of steps.
    """
    band = max(BAND_MIN_PX, BAND_BLURS * blur_px + 1.0)
    reach = 1.0 + np.abs(maps.axes).sum(axis=1).max()
    # Blocks whose arrays stay in the processor's cache.
    block = max(1, int(BLOCK_PIXELS / reach**2))
    parts = []
    for first in range(0, len(maps.xy), block):
        rows = slice(first, first + block)
        windows = gather_windows(image, maps.xy[rows], maps.axes[rows], maps.bend[rows], band)
        begin = None if start is None else start[rows]
        parts.append(
            _fit_block(windows, maps.axes[rows], maps.bend[rows], begin, blur_px, noise, iterations)
        )
    return CornerFit(
        *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(CornerFit))
    )


def _fit_block(
    windows: PixelWindows,
    axes: Array,
    bend: Array,
    start: Array | None,
    blur_px: float,
    noise: NoiseModel | None,
    iterations: int,
) -> CornerFit:
    geometry = EdgeGeometry.from_map(axes, bend)
    n = len(windows.origin)
    nonlinear = np.zeros((n, NONLINEAR))
    if start is not None:
        nonlinear[:, :2] = start - windows.origin
    nonlinear[:, 2:4] = np.arctan2(axes[:, :, 1], axes[:, :, 0])
    nonlinear[:, 4] = np.log(blur_px)
    shortest = np.minimum(geometry.spacing_1, geometry.spacing_2)
    limits = np.tile([0.0, 0.0, 0.15, 0.15, 0.5, 1.0, 1.0], (n, 1))
    limits[:, :2] = 0.2 * shortest[:, None]
    prior = _prior_information(geometry, noise)
    expected = np.column_stack([nonlinear, np.zeros((n, LINEAR))])
    blur_limits = np.log(BLUR_MIN_PX), np.log(np.maximum(0.35 * shortest, 0.5))
    linear = _solve_linear(windows, geometry, nonlinear)
    for _ in range(iterations):
        # Statistics are those before the last step, which is tiny where the fit has settled.
        jacobian, model = evaluate(windows, geometry, nonlinear, linear)
        weight = windows.valid if noise is None else windows.valid / noise.variance(model)
        residual = windows.value - model
        normal, right = _normal_equations(jacobian, residual, weight)
        normal += prior[:, :, None] * np.eye(NONLINEAR + LINEAR)
        right += prior * (expected - np.column_stack([nonlinear, linear]))
        step = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        nonlinear = nonlinear + np.clip(step[:, :NONLINEAR], -limits, limits)
        nonlinear[:, 4] = np.clip(nonlinear[:, 4], *blur_limits)
        linear = linear + step[:, NONLINEAR:]
    freedom = np.maximum(windows.valid.sum(axis=1, dtype=np.float64) - NONLINEAR - LINEAR, 1.0)
    chi2 = np.einsum("np,np,np->n", weight, residual, residual).astype(np.float64) / freedom
    level, variance = _statistics(windows, residual, model, freedom)
    return CornerFit(
        windows.origin + nonlinear[:, :2],
        np.asarray(np.linalg.inv(normal)[:, :2, :2], dtype=np.float64),
        nonlinear,
        linear,
        chi2,
        freedom,
        np.linalg.norm(step[:, :2], axis=1),
        windows.coverage,
        level,
        variance,
    )


def _prior_information(geometry: EdgeGeometry, noise: NoiseModel | None) -> Array:
    """(n, 13) inverse variances of weak priors, from the lattice, of the nuisance parameters.

    They matter only for small or blurred squares, which leave little for each corner to tell by
    itself.
    """
    deviation = np.full((len(geometry.length), NONLINEAR + LINEAR), np.inf)
    deviation[:, 2:4] = ANGLE_PRIOR
    deviation[:, 4] = LOG_BLUR_PRIOR if noise is not None else LOG_BLUR_FIRST_PRIOR
    sagitta = SAGITTA_PRIOR_PX * (2.0 * geometry.length / LARGE_SQUARE_PX) ** 3 + 0.002
    deviation[:, 5:7] = sagitta[:, None]
    for column in (1, 2, 4, 5):
        deviation[:, NONLINEAR + column] = GRADIENT_PRIOR
    unit = 1.0 if noise is not None else ASSUMED_VARIANCE
    return np.asarray(unit / deviation**2, dtype=np.float64)


def fit_noise(fit: CornerFit) -> NoiseModel:
    """Noise as a function of the grey value, from the residuals of unweighted fits.

    It is a line through the noise of the dark and that of the bright pixels; medians over the
    corners keep some corners under debris from mattering.
    """
    dark, bright = (float(v) for v in np.median(fit.level, axis=0))
    low, high = (float(v) for v in np.median(fit.variance, axis=0))
    spread = max(bright - dark, 1e-6)
    # Rounding to grey levels is never without noise.
    tiny = 1e-6 * spread**2
    low, high = max(low, tiny), max(high, tiny)
    if high < low:
        return NoiseModel(0.5 * (low + high), 0.0, dark)
    return NoiseModel(low, (high - low) / spread, dark)


def _statistics(
    windows: PixelWindows, residual: Single, model: Single, freedom: Array
) -> tuple[Array, Array]:
    """Levels and variances of the pixels darker and brighter than the middle, both (n, 2)."""
    valid = windows.valid
    total = np.maximum(valid.sum(axis=1, keepdims=True), 1.0)
    middle = (model * valid).sum(axis=1, keepdims=True) / total
    square = residual * residual
    scale = total[:, 0] / freedom
    level, variance = np.empty((len(model), 2)), np.empty((len(model), 2))
    for side, part in enumerate((valid * (model <= middle), valid * (model > middle))):
        count = np.maximum(part.sum(axis=1), 1.0)
        level[:, side] = np.einsum("np,np->n", part, model) / count
        variance[:, side] = np.einsum("np,np->n", part, square) / count * scale
    return level, variance


def _normal_equations(jacobian: Single, residual: Single, weight: Single) -> tuple[Array, Array]:
    weighted = jacobian * weight[:, None, :]
    normal = (weighted @ jacobian.transpose(0, 2, 1)).astype(np.float64)
    right = (weighted @ residual[:, :, None])[:, :, 0].astype(np.float64)
    diagonal = np.einsum("nii->ni", normal)
    diagonal *= 1.0 + 1e-6
    diagonal += 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-12
    return normal, right


def _solve_linear(windows: PixelWindows, geometry: EdgeGeometry, nonlinear: Array) -> Array:
    jacobian, _ = evaluate(windows, geometry, nonlinear, None)
    normal, right = _normal_equations(jacobian, windows.value, windows.valid)
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)
