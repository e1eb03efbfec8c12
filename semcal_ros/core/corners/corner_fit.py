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

"""Least-squares fit of the edge model to the pixels around each corner, with its covariance.

A test of the fit: opposite squares of a corner have the same grey value, as on a checkerboard.

A single small or blurred corner hardly separates a gradient of the contrast or a bend of an edge
from a shift of its own. The variation of such parameters over the image, however, is well
determined by all corners together, so their spread is learnt and used as a prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from semcal_ros.core.arrays import Array, Array32, Indices, Mask
from semcal_ros.core.corners.edge_model import (
    ANGLES,
    BRIGHTNESS,
    CONTRAST,
    GRADIENTS,
    GROWTH,
    LINEAR,
    LOG_BLUR,
    NONLINEAR,
    SAGITTAS,
    EdgeGeometry,
    PixelWindows,
    evaluate,
)
from semcal_ros.core.corners.local_map import LocalMaps, fit_local_maps
from semcal_ros.core.corners.thresholds import (
    ANGLE_PRIOR,
    ASSUMED_VARIANCE,
    BAND_BLURS,
    BAND_MIN_PX,
    BLUR_MIN_PX,
    FIT_BLOCK_PIXELS,
    GRADIENT_LEAST,
    GRADIENT_PRIOR,
    GROWTH_PRIOR_PX,
    LARGE_SQUARE_PX,
    LIKELIHOOD_LOSS,
    LOG_BLUR_PRIOR,
    NOISE_FLOOR_PART,
    OUTLIER_SCORE,
    PRIOR_SPREADS,
    PULL_LEAST,
    SAGITTA_PRIOR_PX,
)

if TYPE_CHECKING:
    from typing_extensions import Self


PARAMETERS = NONLINEAR + LINEAR
# Parameters that share one spread.
GROUPS = (ANGLES, slice(LOG_BLUR, LOG_BLUR + 1), SAGITTAS, *GRADIENTS, GROWTH)
# Parameters with a value that is common to all corners of an image.
COMMON = (LOG_BLUR, GROWTH.start, GROWTH.start + 1)


@dataclass(frozen=True)
class Prior:
    """Independent normal priors of the parameters of n corners.

    Attributes
    ----------
    mean, deviation
        (n, 15); a deviation is infinite where nothing is known.
    """

    mean: Array
    deviation: Array

    def near(self, parameters: Array) -> Prior:
        """Return the same prior with directions within half a turn of (n, 15) ``parameters``."""
        mean = self.mean.copy()
        turns = (parameters[:, ANGLES] - mean[:, ANGLES]) / (2.0 * np.pi)
        mean[:, ANGLES] += 2.0 * np.pi * np.round(turns)
        return Prior(mean, self.deviation)


@dataclass(frozen=True)
class Learnt:
    """Common values and spreads of nuisance parameters.

    Attributes
    ----------
    common
        (15,) means; zero where a parameter has no common value.
    spread
        (15,) factors on the deviations of the loose prior.
    """

    common: Array
    spread: Array

    def prior(self, maps: LocalMaps, geometry: EdgeGeometry) -> Prior:
        """Return the prior of corners whose local maps are given."""
        loose = loose_prior(maps, geometry, 1.0)
        mean = loose.mean + self.common
        mean[:, LOG_BLUR] = self.common[LOG_BLUR]
        return Prior(mean, loose.deviation * self.spread)


def loose_prior(maps: LocalMaps, geometry: EdgeGeometry, blur_px: float) -> Prior:
    """Return the prior before any fit: what is plausible for any image of a board."""
    deviation = np.full((len(maps.xy), PARAMETERS), np.inf)
    deviation[:, ANGLES] = ANGLE_PRIOR
    deviation[:, LOG_BLUR] = LOG_BLUR_PRIOR
    sagitta = SAGITTA_PRIOR_PX * (2.0 * geometry.length / LARGE_SQUARE_PX) ** 3 + 0.002
    deviation[:, SAGITTAS] = sagitta[:, None]
    for gradient in GRADIENTS:
        deviation[:, gradient] = GRADIENT_PRIOR
    deviation[:, GROWTH] = GROWTH_PRIOR_PX
    mean = np.zeros_like(deviation)
    mean[:, ANGLES] = np.arctan2(maps.axes[:, :, 1], maps.axes[:, :, 0])
    mean[:, LOG_BLUR] = np.log(blur_px)
    return Prior(mean, deviation)


def learn(parameters: Array, normal: Array, used: Prior, unit: float, noise: float) -> Learnt:
    """Learn common values and spreads from the fits of some corners.

    Parameters
    ----------
    parameters
        (n, 15) fitted values.
    normal
        (n, 15, 15) normal matrices, including the prior.
    used
        Prior of those fits.
    unit
        Variance of a pixel that the weight of the prior assumed.
    noise
        Variance of the residuals in the same measure.
    """
    information = 1.0 / np.einsum("nii->ni", np.linalg.inv(normal))
    common, spread = np.zeros(PARAMETERS), np.ones(PARAMETERS)
    for group in GROUPS:
        deviation = used.deviation[:, group]
        # The information of the pixels alone, without the prior.
        share = np.maximum(information[:, group] - unit / deviation**2, 1e-9)
        likeliest = used.mean[:, group] + (parameters[:, group] - used.mean[:, group]) * (
            information[:, group] / share
        )
        variance = noise / (share * deviation**2)
        if group.start in COMMON:
            common[group] = _weighted_median(likeliest, 1.0 / (1.0 + variance))
            centre = common[group]
        else:
            centre = used.mean[:, group]
        spread[group] = _largest_spread(
            ((likeliest - centre) / deviation).ravel(), variance.ravel()
        )
    return Learnt(common, spread)


def _weighted_median(values: Array, weights: Array) -> Array:
    """Return the (m,) weighted medians of the columns of (n, m)."""
    order = np.argsort(values, axis=0)
    total = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    middle = (total < 0.5 * total[-1]).sum(axis=0)
    picked = np.take_along_axis(order, middle[None], axis=0)
    return np.asarray(np.take_along_axis(values, picked, axis=0)[0], dtype=np.float64)


def _largest_spread(score: Array, variance: Array) -> float:
    """Return the largest spread that scores with these variances do not contradict."""
    total = PRIOR_SPREADS[:, None] ** 2 + variance
    # Corners under debris count no more than others at three standard deviations.
    cost = 0.5 * (np.log(total) + np.minimum(score**2 / total, OUTLIER_SCORE)).sum(axis=1)
    plausible = cost <= cost.min() + LIKELIHOOD_LOSS
    if PRIOR_SPREADS[np.argmin(cost)] <= 1.0:
        plausible &= PRIOR_SPREADS <= 1.0
    return float(PRIOR_SPREADS[np.nonzero(plausible)[0][-1]])


def smooth_levels(prior: Prior, cells: Indices, linear: Array, maps: LocalMaps) -> Prior:
    """Return the prior with gradients of brightness and contrast from the neighbours' levels.

    Parameters
    ----------
    prior
        Prior to start from.
    cells
        (n, 2) lattice indices.
    linear
        (n, 8) fitted levels.
    maps
        Local maps of the same corners.
    """
    parity = np.where(cells.sum(axis=1) % 2 == 0, 1.0, -1.0)
    levels = np.stack([linear[:, 0], linear[:, 3] * parity], axis=1)
    smooth = fit_local_maps(cells, cells, levels, leave_out_self=False)
    others = fit_local_maps(cells, cells, levels)
    usable = (others.support >= 6) & (others.leverage < 1.0)
    if usable.sum() < 6:
        return prior
    # Rows: x and y; columns: brightness, contrast.
    slope = np.asarray(np.linalg.solve(maps.axes, smooth.axes))
    slope[:, :, 1] *= parity[:, None]
    slope *= 0.25 * np.linalg.norm(maps.axes, axis=2).sum(axis=1)[:, None, None]
    residual = np.abs(levels - others.xy) / np.sqrt(1.0 + others.leverage)[:, None]
    typical = np.median(residual[usable], axis=0) / 0.675
    mean, deviation = prior.mean.copy(), prior.deviation.copy()
    for level, gradient in enumerate(GRADIENTS):
        limit = max(float(typical[level]), GRADIENT_LEAST)
        # Where the levels are noisy, no gradient at all may be the better guess.
        if limit < float(np.max(prior.deviation[:, gradient])):
            mean[usable, gradient] = slope[usable, :, level]
            deviation[usable, gradient] = limit
    return Prior(mean, deviation)


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a pixel: ``floor + slope * (value - dark)`` of its grey value.

    ``dark`` is the mean of the darker pixels, so that half of them lie below it; the variance never
    falls below a part of the floor.
    """

    floor: float
    slope: float
    dark: float

    def variance(self, value: Array32) -> Array32:
        """Return the variance at the grey values ``value``, in the same shape."""
        variance = np.float32(self.slope) * (value - np.float32(self.dark))
        variance += np.float32(self.floor)
        least = np.float32(NOISE_FLOOR_PART * self.floor)
        return np.asarray(np.maximum(variance, least), dtype=np.float32)


@dataclass(frozen=True)
class PositionFit:
    """Positions fitted to the pixels around them.

    Attributes
    ----------
    xy
        (n, 2) positions, px.
    covariance
        (n, 2, 2) covariance of the positions, px^2, for the noise model given (unit noise without
        one).
    scan_response
        (n, 2, 2) by how far a position moves, px, where the displacement of the picture along x has another slope
        (``[:, 0]``) and another second derivative, per px (``[:, 1]``), in the window than the local map.
    chi2
        (n,) weighted squared residuals per degree of freedom.
    freedom
        (n,) degrees of freedom.
    level, variance
        (n, 2) mean grey value and mean squared residual of the pixels darker and of the pixels
        brighter than the middle.
    shift_px
        (n,) size of the last step, px; large where the fit has not converged.
    coverage
        (n,) part of the window that lies in the image.
    """

    xy: Array
    covariance: Array
    scan_response: Array
    chi2: Array
    freedom: Array
    level: Array
    variance: Array
    shift_px: Array
    coverage: Array

    def select(self, keep: Mask) -> Self:
        """Return the fits of the points where ``keep`` is true."""
        return type(self)(*(getattr(self, f.name)[keep] for f in fields(self)))

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Concatenate the fits of several sets."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@dataclass(frozen=True)
class CornerFit(PositionFit):
    """Fitted corners.

    Attributes
    ----------
    nonlinear, linear
        (n, 7) and (n, 8) parameters of :mod:`semcal_ros.core.corners.edge_model`, positions
        relative to the window.
    normal
        (n, 15, 15) normal matrices, including the prior.
    imbalance, unlike
        (n,) score test of a difference in grey value between opposite squares, a chi-square with
        two degrees of freedom in units of ``chi2``, and the difference as a part of the contrast;
        zeros where the squares were not compared.
    blur_pull
        (n,) distance of the blur from its prior, in standard deviations.
    """

    nonlinear: Array
    linear: Array
    normal: Array
    imbalance: Array
    unlike: Array
    blur_pull: Array

    @property
    def parameters(self) -> Array:
        """(n, 15) nonlinear and linear parameters."""
        return np.column_stack([self.nonlinear, self.linear])

    @property
    def angles(self) -> Array:
        """(n, 2) directions of the edges along i and along j, rad."""
        return self.nonlinear[:, ANGLES]

    @property
    def blur_px(self) -> Array:
        """(n,) standard deviation of the blur, px."""
        return np.asarray(np.exp(self.nonlinear[:, LOG_BLUR]), dtype=np.float64)

    @property
    def contrast(self) -> Array:
        """(n,) signed contrast: half the step of grey value between squares."""
        return self.linear[:, 3]


def rough_start(windows: PixelWindows, prior: Prior, sign: Array) -> Array:
    """Return (n, 15) starting values: those of the prior, and the mean and scatter of the pixels.

    Parameters
    ----------
    sign
        (n,) expected sign of the contrast.
    """
    count = np.maximum(windows.valid.sum(axis=1), 1.0)
    mean = windows.value.sum(axis=1) / count
    square = np.einsum("np,np->n", windows.value, windows.value) / count
    start = prior.mean.copy()
    start[:, BRIGHTNESS] = mean
    start[:, CONTRAST] = sign * np.sqrt(np.maximum(square - mean * mean, 1e-6))
    return start


def band_px(blur_px: float) -> float:
    """Return the half-width of the band of pixels that determine the position of an edge."""
    return max(BAND_MIN_PX, BAND_BLURS * blur_px + 1.0)


def fit_corners(
    windows: PixelWindows,
    geometry: EdgeGeometry,
    start: Array | None,
    prior: Prior,
    *,
    noise: NoiseModel | None,
    iterations: int,
    judged: bool = False,
) -> CornerFit:
    """Fit position, edge directions, blur, grey levels and gradients of corners by Gauss-Newton.

    Parameters
    ----------
    windows
        Pixels of the corners.
    geometry
        Spacing and curvature of their edges from the lattice.
    start
        (n, 15) starting values, or None for those of the prior.
    prior
        Prior of the parameters.
    noise
        Noise model for the weights; None for equal weights.
    iterations
        Number of steps.
    judged
        Whether to compare opposite squares.
    """
    block = max(1, FIT_BLOCK_PIXELS // windows.x.shape[1])
    parts = []
    for first in range(0, max(1, len(windows.origin)), block):
        rows = slice(first, first + block)
        part, shape = windows.select(rows), geometry.select(rows)
        expected = Prior(prior.mean[rows], prior.deviation[rows])
        if start is None:
            nonlinear = expected.mean[:, :NONLINEAR].copy()
            linear = _solve_linear(part, shape, nonlinear, expected)
        else:
            nonlinear, linear = start[rows, :NONLINEAR].copy(), start[rows, NONLINEAR:].copy()
        parts.append(
            _fit_block(part, shape, nonlinear, linear, expected, noise, iterations, judged)
        )
    return CornerFit.join(parts)


def _fit_block(
    windows: PixelWindows,
    geometry: EdgeGeometry,
    nonlinear: Array,
    linear: Array,
    prior: Prior,
    noise: NoiseModel | None,
    iterations: int,
    judged: bool,
) -> CornerFit:
    shortest = np.minimum(geometry.spacing_1, geometry.spacing_2)
    limits = np.tile([0.0, 0.0, 0.15, 0.15, 0.5, 1.0, 1.0], (len(shortest), 1))
    limits[:, :2] = 0.2 * shortest[:, None]
    blur_limits = np.log(BLUR_MIN_PX), np.log(np.maximum(0.35 * shortest, 0.5))
    known = (1.0 if noise is not None else ASSUMED_VARIANCE) / prior.deviation**2
    axes = np.zeros((len(shortest), NONLINEAR + LINEAR, 3))
    axes[:, [0, 1, LOG_BLUR], [0, 1, 2]] = 1.0
    for left in range(iterations - 1, -1, -1):
        # Levels and variances are those before the last step, which is tiny where the fit has
        # converged.
        jacobian, model = evaluate(windows, geometry, nonlinear, linear)
        weight = windows.valid if noise is None else windows.valid / noise.variance(model)
        residual = windows.value - model
        normal, right = normal_equations(jacobian, residual, weight)
        np.einsum("nii->ni", normal)[...] += known
        pull = known * (prior.mean - np.column_stack([nonlinear, linear]))
        right += pull
        # Covariances are those of the last step.
        sides = [right[:, :, None]]
        if not left:
            sides += [axes, displaced_sides(windows, nonlinear[:, 0], jacobian, weight)]
        solution = np.linalg.solve(normal, np.concatenate(sides, axis=2)).astype(
            np.float64, copy=False
        )
        step = solution[:, :, 0]
        nonlinear = nonlinear + np.clip(step[:, :NONLINEAR], -limits, limits)
        nonlinear[:, LOG_BLUR] = np.clip(nonlinear[:, LOG_BLUR], *blur_limits)
        linear = linear + step[:, NONLINEAR:]
    # A parameter that the prior holds costs no degree of freedom.
    fitted = np.sum(1.0 - known / np.einsum("nii->ni", normal), axis=1)
    freedom = np.maximum(windows.valid.sum(axis=1, dtype=np.float64) - fitted, 1.0)
    chi2 = np.einsum("np,np,np->n", weight, residual, residual).astype(np.float64)
    # The last step changes chi2 as the normal equations predict without the prior.
    change = np.einsum("na,na->n", step, right - 2.0 * pull + known * step)
    chi2 = np.maximum(chi2 - change, 0.5 * chi2) / freedom
    level, variance = split_statistics(windows, residual, model, freedom)
    balance = (
        compare_opposite_squares(windows, nonlinear, jacobian, residual, weight, normal, step)
        if judged
        else np.zeros((2, len(shortest)))
    )
    return CornerFit(
        windows.origin + nonlinear[:, :2],
        solution[:, :2, 1:3],
        np.swapaxes(solution[:, :2, 4:6], 1, 2),
        chi2,
        freedom,
        level,
        variance,
        np.linalg.norm(step[:, :2], axis=1),
        windows.coverage,
        nonlinear,
        linear,
        normal,
        balance[0],
        balance[1] / np.maximum(np.abs(linear[:, CONTRAST - NONLINEAR]), 1e-9),
        _pull(nonlinear[:, LOG_BLUR], solution[:, LOG_BLUR, 3], prior),
    )


def _pull(log_blur: Array, variance: Array, prior: Prior) -> Array:
    """Return (n,) distances of the blur from its prior, in standard deviations of fitted values."""
    deviation = prior.deviation[:, LOG_BLUR]
    # Values fitted under a prior scatter by the variance of the prior less that of the fit.
    spread = np.maximum(deviation**2 - variance, PULL_LEAST * deviation**2)
    return (log_blur - prior.mean[:, LOG_BLUR]) / np.sqrt(spread)


def fit_noise(fit: PositionFit) -> NoiseModel:
    """Fit the noise as a function of the grey value to the residuals of unweighted fits.

    The model is a line through the noise of the dark pixels and that of the bright ones. Medians
    over the corners make it robust against a few corners under debris.
    """
    dark, bright = (float(v) for v in np.median(fit.level, axis=0))
    low, high = (float(v) for v in np.median(fit.variance, axis=0))
    spread = max(bright - dark, 1e-6)
    # The variance stays positive even in an image without noise.
    tiny = 1e-6 * spread**2
    low, high = max(low, tiny), max(high, tiny)
    if high < low:
        return NoiseModel(0.5 * (low + high), 0.0, dark)
    return NoiseModel(low, (high - low) / spread, dark)


def split_statistics(
    windows: PixelWindows, residual: Array32, model: Array32, freedom: Array
) -> tuple[Array, Array]:
    """Return (n, 2) levels and variances of the pixels darker and brighter than the middle."""
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


def normal_equations(jacobian: Array32, residual: Array32, weight: Array32) -> tuple[Array, Array]:
    """Return (n, a, a) normal matrices and (n, a) right-hand sides of weighted least squares.

    The diagonal is raised by a trifle, so that undetermined parameters do not make it singular.

    Parameters
    ----------
    jacobian, residual, weight
        (n, a, p) derivatives, (n, p) residuals and weights.
    """
    weighted = jacobian * weight[:, None, :]
    normal = (weighted @ jacobian.transpose(0, 2, 1)).astype(np.float64)
    right = (weighted @ residual[:, :, None])[:, :, 0].astype(np.float64)
    diagonal = np.einsum("nii->ni", normal)
    diagonal *= 1.0 + 1e-6
    diagonal += 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-12
    return normal, right


def displaced_sides(windows: PixelWindows, x: Array, jacobian: Array32, weight: Array32) -> Array:
    """Return (n, a, 2) right-hand sides that displacements along x by u and by u^2 / 2 make, u px from a point.

    Parameters
    ----------
    windows
        Pixels of n points.
    x
        (n,) positions of the points relative to the windows, px.
    jacobian, weight
        (n, a, p) derivatives, that by x first, and (n, p) weights.
    """
    away = windows.x - x.astype(np.float32)[:, None]
    moved = np.stack([away, np.float32(0.5) * away * away], axis=1)
    moved *= (jacobian[:, 0] * weight)[:, None]
    return np.asarray(jacobian @ moved.transpose(0, 2, 1), dtype=np.float64)


def _solve_linear(
    windows: PixelWindows, geometry: EdgeGeometry, nonlinear: Array, prior: Prior
) -> Array:
    jacobian, _ = evaluate(windows, geometry, nonlinear, None)
    normal, right = normal_equations(jacobian, windows.value, windows.valid)
    known = ASSUMED_VARIANCE / prior.deviation[:, NONLINEAR:] ** 2
    np.einsum("nii->ni", normal)[...] += known
    right += known * prior.mean[:, NONLINEAR:]
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)


def compare_opposite_squares(
    windows: PixelWindows,
    nonlinear: Array,
    jacobian: Array32,
    residual: Array32,
    weight: Array32,
    normal: Array,
    step: Array,
) -> tuple[Array, Array]:
    """Apply a score test of two steps that the model lacks: both squares beyond an edge brighter.

    Nothing is fitted again: the residuals are projected on the two new terms, from which the
    parameters of the model are eliminated.

    Parameters
    ----------
    windows, nonlinear
        Pixels of n corners and (n, 7) parameters of :mod:`semcal_ros.core.corners.edge_model`.
    jacobian, residual, weight
        (n, 15, p) derivatives, (n, p) residuals and weights of the pixels before the last step.
    normal, step
        (n, 15, 15) normal matrices and (n, 15) last step.

    Returns
    -------
    statistic
        (n,) chi-square with two degrees of freedom where opposite squares are alike.
    difference
        (n,) the larger of the two steps, half the difference of grey value.
    """

    def column(values: Array) -> Array32:
        return np.asarray(values, dtype=np.float32)[:, None]

    px, py, angle_1, angle_2 = nonlinear.T[:4]
    x, y = windows.x - column(px), windows.y - column(py)
    side_1 = np.copysign(weight, column(np.cos(angle_1)) * y - column(np.sin(angle_1)) * x)
    side_2 = np.copysign(weight, column(np.sin(angle_2)) * x - column(np.cos(angle_2)) * y)
    sides = np.stack([side_1, side_2], axis=1)
    shared = (sides @ jacobian.transpose(0, 2, 1)).astype(np.float64)
    score = (sides @ residual[:, :, None])[:, :, 0] - np.einsum("nka,na->nk", shared, step)
    total = weight.sum(axis=1, dtype=np.float64)
    information = np.empty((len(x), 2, 2))
    # The ridge is for windows that show only one side of an edge.
    information[:, 0, 0] = information[:, 1, 1] = total * (1.0 + 1e-6)
    both = np.einsum("np,np->n", side_1, np.copysign(np.float32(1.0), side_2))
    information[:, 0, 1] = information[:, 1, 0] = both
    information -= shared @ np.linalg.solve(normal, shared.transpose(0, 2, 1))
    size = np.linalg.solve(information, score[:, :, None])[:, :, 0]
    return np.einsum("nk,nk->n", score, size), np.abs(size).max(axis=1)
