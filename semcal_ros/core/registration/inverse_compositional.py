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

"""Fine alignment of two images by inverse-compositional least squares, coarse to fine.

With the model

    image(x + s) = (g0 + g1 x + g2 y) reference(x) + (o0 + o1 x + o2 y)

the reference's gradient is computed once and every step solves the same few equations (Baker and
Matthews 2004, doi:10.1023/B:VISI.0000011205.11775.fd). Gain and offset may vary over the field,
because the detector's shading does not move with the specimen: a gain ramp along x has a constant
product with the gradient along x and would pull the shift. Only what overlaps is compared. Because
the gradient belongs to the reference alone, the noise of the resampled image does not pull the
estimate towards whole pixels.

A scanned frame is seen line after line, so that what drifts during the frame is sheared and
stretched: the shift changes linearly with the row. That change is estimated with the shift.

Where the specimen turns or the magnification creeps, the shift also changes along a row. A rotation
and a scale can be estimated with the rest (:meth:`Alignment.fit_similarity`); they are told by what
changes along the rows, which were scanned in an instant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from scipy.special import stdtrit

from semcal_ros.core.arrays import Array, Mask, equilibrate, median
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.noise_spectrum import shared_pixels
from semcal_ros.core.registration.thresholds import (
    ALL_PIXELS,
    BLOCK_SIGMAS,
    BLOCKS_MIN,
    CHANCE_SIGMAS,
    COARSE_PASSES_MAX,
    COARSE_STEP_PX,
    CONDITION_MAX,
    CONTRACTION,
    CURVATURE,
    EXPECTED_SCORES,
    FEW_SCORES,
    FREEDOM_MIN,
    GAIN_MIN,
    HESSIAN_PIXELS,
    INFORMATION_KEPT_MIN,
    LOPSIDED_MAX,
    MEDIAN_CHI2,
    NOISE_ROWS_MIN,
    PASSES_MAX,
    PULL_BODY_MIN,
    PULL_CHI2_MIN,
    PULL_EXCESS_MAX,
    PULL_RATE,
    PULL_REST_MIN,
    PULL_SIDES,
    REMAINING_PX,
    REMAINING_SIGMAS,
    REWEIGHTED_PASSES_MAX,
    ROUNDING,
    ROWS_PER_MODE,
    ROWS_RATIO_MIN,
    SHEAR_ROWS_MIN,
    STEP_PX_MAX,
    THREE_SIGMAS,
)
from semcal_ros.core.registration.tile_least_squares import (
    TileFit,
    TileGeometry,
    invert_symmetric,
    prepare_geometry,
    solve_step,
    squared_residuals,
    well_posed,
)
from semcal_ros.core.registration.tiles import (
    Pyramid,
    PyramidLevel,
    TileSums,
    TileWindow,
    residuals_at_gradients,
    tile_sums,
    tile_window,
)

# A strained specimen, which has structure, has as little of it in common.
_FEATURELESS = (
    "one direction is not determined (no more gradient in common than by chance):"
    " featureless there, or strained"
)


@dataclass(frozen=True)
class SimilarityFit:
    """Shift, shear, rotation and scale, estimated together.

    Attributes
    ----------
    values
        (6,) shift (x, y) of the middle of the image, px; by how much more its last row is shifted than
        its first, px; rotation (rad, from x towards y) and logarithm of the scale against the
        reference, as the change of the shift along the rows tells them. The shear is what remains.
    covariance
        (6, 6).
    """

    values: Array
    covariance: Array

    def about(self, offset_px: Array) -> SimilarityFit:
        """The same with the shift of the point that lies ``offset_px`` (2,) from the middle."""
        x, y = offset_px.tolist()
        matrix = np.eye(6)
        matrix[:2, 4:] = [[-y, x], [x, y]]
        return SimilarityFit(matrix @ self.values, matrix @ self.covariance @ matrix.T)


@dataclass(frozen=True)
class Alignment:
    """Outcome of :func:`align`, whose shifts are those of the cropped images that went in.

    Attributes
    ----------
    shift_px
        (2,) shift.
    covariance
        (2, 2), from the scatter of the tiles' contributions.
    joint_px, joint_covariance
        (4,) shift at the image's middle row, and by how much more the last row of the image is
        shifted than the first, estimated together, and their (4, 4) covariance; NaN and infinite
        where too few rows are compared.
    half_difference_px, half_variance
        (2, 2) differences (rows: left/right, top/bottom) of the shifts that the two halves of the
        overlap ask for, and their variances.
    gain, offset
        Image grey levels per reference grey level, and at reference level 0, in the middle of the
        image.
    residual_rms
        RMS of what gain, offset and shift do not explain, in image grey levels after smoothing.
    reference_variance, image_variance, common_covariance
        Second moments over the overlap.
    overlap
        Fraction of the smaller image that both show.
    converged, iterations
        Whether the last step left nothing that matters, and the number of steps.
    may_be_pulled, pull_px
        Whether, beyond chance, a part of the image that moves by itself, and was not found to, may pull the shift by
        more than its 1-sigma without that part; and (2,) by how much one may, chance or not, which is in the
        covariance (:meth:`with_pull`).
    """

    shift_px: Array
    covariance: Array
    joint_px: Array
    joint_covariance: Array
    half_difference_px: Array
    half_variance: Array
    gain: float
    offset: float
    residual_rms: float
    reference_variance: float
    image_variance: float
    common_covariance: float
    overlap: float
    converged: bool
    iterations: int
    may_be_pulled: bool = False
    pull_px: Array = field(default_factory=lambda: np.zeros(2))
    _comparison: _Comparison | None = field(default=None, repr=False, compare=False)
    _left: Array | None = field(default=None, repr=False, compare=False)

    def with_pull(self) -> Alignment:
        """The same with what a part of the image that moves by itself, and was not found to, may pull, in the
        covariance.
        """
        if self._comparison is None or self._left is None:
            return self
        pull, sure = self._comparison.level.factor * _find_pulls(self._comparison, self._left)
        if not np.any(pull):
            return self
        return replace(
            self.widened(np.outer(pull, pull)),
            pull_px=pull,
            may_be_pulled=bool(np.any(sure**2 > np.diag(self.covariance))),
        )

    def widened(self, covariance: Array) -> Alignment:
        """The same with a shift that is less certain by a covariance (2, 2)."""
        joint = self.joint_covariance.copy()
        joint[:2, :2] += covariance
        return replace(self, covariance=self.covariance + covariance, joint_covariance=joint)

    def fit_similarity(self) -> SimilarityFit | None:
        """Estimate a rotation and a scale, too; None where too few tiles are compared."""
        comparison = self._comparison
        return None if comparison is None else _fit_similarity(comparison)

    def tile_statistics(self) -> TileStatistics | None:
        """What each tile shows at the shift; None where nothing was compared."""
        comparison = self._comparison
        return None if comparison is None else comparison.tiles

    def compared_tiles(self) -> tuple[TileWindow, TileSums, Array] | None:
        """The compared tiles of the reference, their sums whatever their weights, and the shift (2,) of these; None
        where nothing was compared.
        """
        comparison = self._comparison
        return (
            None if comparison is None else (comparison.window, comparison.plain, comparison.shift)
        )

    def row_power(self, modes: int) -> Array | None:
        """(2, k, 2) power of the shifts of the rows of tiles about a straight line, px^2 per row, in the
        lowest cosine modes down the frame, k = ``modes`` or as many as there are rows for; and the same of
        the noise alone. None where there are too few rows.
        """
        comparison = self._comparison
        return None if comparison is None else _measure_row_power(comparison, modes)


@dataclass(frozen=True)
class TileStatistics:
    """Tiles of a reference beside what the image shows there, after smoothing and without the mean of each tile.

    Attributes
    ----------
    rows, cols
        The tiles of the reference that are compared.
    pixels
        (rows, cols) number of pixels of each tile that count, at least 1.
    sigma_px
        Width of the smoothing.
    reference, image, common
        (rows, cols) sums of squares of the reference and of the image, and of their products.
    gain, offset
        (rows, cols) image grey levels per reference grey level, and by how much the image is brighter than that.
    gradient
        (rows, cols, 2, 2) sums of products of the reference's gradients.
    shows_structure
        (rows, cols) tiles where the reference shows structure, whatever its gradients; None where only these tell.
    scores
        (rows, cols, 2) products of the gradient with what gain and offset leave.
    """

    rows: slice
    cols: slice
    pixels: Array
    sigma_px: float
    reference: Array
    image: Array
    common: Array
    gain: Array
    offset: Array
    gradient: Array
    shows_structure: Mask | None
    scores: Array


def _make_statistics(
    level: PyramidLevel, window: TileWindow, sums: TileSums, gain: Array
) -> TileStatistics:
    own, cross = level.normal_matrices[window.rows, window.cols], sums.cross
    pixels, shape = level.pixel_counts[window.rows, window.cols], own.shape[:2]
    shows = level.shows_structure
    gain = gain.reshape(shape)
    # The offset of each tile is its own: charging and shading say nothing of the shift.
    offset = (cross[..., 3] - gain * own[..., 2, 3]) / pixels
    residual = (
        cross[..., :2] - gain[..., None] * own[..., :2, 2] - offset[..., None] * own[..., :2, 3]
    )
    return TileStatistics(
        window.rows,
        window.cols,
        pixels,
        level.sigma_px,
        own[..., 2, 2] - own[..., 2, 3] ** 2 / pixels,
        sums.energy - cross[..., 3] ** 2 / pixels,
        cross[..., 2] - own[..., 2, 3] * cross[..., 3] / pixels,
        gain,
        offset,
        own[..., :2, :2],
        shows if shows is None else shows[window.rows, window.cols],
        residual,
    )


def _look_at_tiles(level: PyramidLevel, image: Pyramid, shift: Array) -> TileStatistics | None:
    """The tiles at a shift in px of the level, before anything is fitted there, with the gain of the median tile."""
    pixels = image.centred(level.factor)
    window = tile_window(level, (pixels.shape[1], pixels.shape[0]), shift)
    if window is None:
        return None
    sums = tile_sums(level, window, pixels, shift, np.zeros((2, 2)))
    tiles = _make_statistics(level, window, sums, np.ones(len(window.y) * len(window.x)))
    rich = tiles.reference >= median(tiles.reference)
    ratios = tiles.common[rich] / np.maximum(tiles.reference[rich], 1e-30)
    # What came in has nothing in common with what it covers.
    ratios = ratios[ratios > GAIN_MIN]
    gains = np.full(tiles.gain.size, median(ratios) if len(ratios) else 1.0)
    return _make_statistics(level, window, sums, gains)


def unmeasured_alignment() -> Alignment:
    """The alignment of images between which nothing could be measured."""
    nan = float("nan")
    return Alignment(
        shift_px=np.full(2, np.nan),
        covariance=np.full((2, 2), np.inf),
        joint_px=np.full(4, np.nan),
        joint_covariance=np.full((4, 4), np.inf),
        half_difference_px=np.full((2, 2), np.nan),
        half_variance=np.full((2, 2), np.inf),
        gain=nan,
        offset=nan,
        residual_rms=nan,
        reference_variance=nan,
        image_variance=nan,
        common_covariance=nan,
        overlap=0.0,
        converged=False,
        iterations=0,
    )


@dataclass(frozen=True)
class _Comparison:
    """The pixels of one level compared at one shift; shifts in px of the level.

    ``plain`` are the sums without the ``weights`` (rows, cols) of the tiles.
    """

    level: PyramidLevel
    window: TileWindow
    geometry: TileGeometry
    sums: TileSums
    plain: TileSums
    fit: TileFit
    shift: Array
    image_size: tuple[int, int]
    mean: float
    weights: Array | None = None

    @cached_property
    def tiles(self) -> TileStatistics:
        """What each tile shows."""
        gain = self.geometry.ramps @ self.fit.gain
        return _make_statistics(self.level, self.window, self.plain, gain)

    @cached_property
    def expected_variances(self) -> Array:
        """(tiles, 2, 2) covariance of each tile's score as the residuals of its pixels tell it."""
        tiles, counts = self.tiles, self.level.pixel_counts[self.window.rows, self.window.cols]
        left = tiles.image - 2.0 * tiles.gain * tiles.common + tiles.gain**2 * tiles.reference
        return _expect_variances(self, left / counts)

    @cached_property
    def variances_at_gradients(self) -> Array:
        """(tiles, 2, 2) the same, as the residuals where the gradients are tell it."""
        gain = (self.geometry.ramps @ self.fit.gain).reshape(self.plain.energy.shape)
        squares = residuals_at_gradients(self.level, self.window, self.plain, gain)
        return _expect_variances(self, squares)

    @cached_property
    def tile_information(self) -> Array:
        """(tiles, 2, 2) each tile's part of the information: its gradients without those of the noise, which are spread
        evenly and have no part in what the two images have in common.
        """
        geometry, information = self.geometry, self.fit.information
        pixels = geometry.normal_matrices[:, 3, 3]
        evenly = (pixels / pixels.sum())[:, None, None]
        tiles = float(self.fit.gain[0]) * geometry.gradients
        values, vectors = np.linalg.eigh(tiles.sum(axis=0) - information)
        tiles = tiles - evenly * ((vectors * np.maximum(values, 0.0)) @ vectors.T)
        kept = np.diag(tiles.sum(axis=0))
        if not np.all(kept > INFORMATION_KEPT_MIN * np.diag(information)):
            tiles = geometry.gradients
        scale = np.sqrt(np.diag(information) / np.diag(tiles.sum(axis=0)))
        tiles = tiles * np.outer(scale, scale)
        # The products of x and y: those of the common information, spread evenly.
        tiles[:, 0, 1] += evenly[:, 0, 0] * (information[0, 1] - tiles[:, 0, 1].sum())
        tiles[:, 1, 0] = tiles[:, 0, 1]
        return np.asarray(tiles)

    @cached_property
    def ratio_of_contrasts(self) -> float:
        """Standard deviation of the image within its tiles over that of the reference with its noise."""
        return _ratio_of_contrasts(self.geometry, self.sums, self.level.noise_variance)

    def weighs_alike(self, window: TileWindow, weights: Array | None) -> bool:
        """Whether the tiles of a window are those of this comparison, with the same weights."""
        return (
            self.weights is not None
            and weights is not None
            and self.window.key == window.key
            and np.array_equal(self.weights, weights)
        )

    @property
    def length(self) -> float:
        """Length of the Gauss-Newton step."""
        return float(np.hypot(self.fit.step[0], self.fit.step[1]))

    @property
    def improved(self) -> Array:
        """The shift after the step, which is limited."""
        limit = min(1.0, STEP_PX_MAX / max(self.length, 1e-12))
        return np.asarray(self.shift + limit * self.fit.step)


def align(
    levels: Sequence[PyramidLevel],
    image: Pyramid,
    start_px: Array,
    *,
    held: Array | None = None,
) -> Alignment | Rejection[MatchFailure]:
    """Refine a shift.

    Parameters
    ----------
    levels
        The reference at falling reduction factors; the last one decides.
    image
        The image.
    start_px
        (2,) shift in full-resolution px, right to about a pixel of the first level.
    held
        (2,) unit vector along which the shift stays as it is; of the covariance and the halves only what lies across it
        means anything then.

    Returns
    -------
    The alignment, which may not have converged; or a rejection where too little overlaps, the gradient
    leaves a direction undetermined, or the images have no structure in common.
    """
    found = _align(levels, image, start_px, HESSIAN_PIXELS, held)
    if isinstance(found, Rejection) and found.status is not MatchFailure.TOO_LITTLE_OVERLAP:
        # What the gradients of some pixels do not tell from chance, those of all may.
        return _align(levels, image, start_px, ALL_PIXELS, held)
    return found


def _align(
    levels: Sequence[PyramidLevel],
    image: Pyramid,
    start_px: Array,
    enough: int,
    held: Array | None,
) -> Alignment | Rejection[MatchFailure]:
    """Refine a shift with the common gradient of enough pixels."""
    shift = np.asarray(start_px, dtype=np.float64)
    passes = 0
    for level in levels[:-1]:
        hessian = None
        for _ in range(COARSE_PASSES_MAX):
            comparison = _compare(level, image, shift / level.factor, hessian, enough, held=held)
            if isinstance(comparison, Rejection):
                # A fine texture may be lost at this resolution; the next one knows more.
                break
            passes += 1
            shift, hessian = comparison.improved * level.factor, comparison.sums.hessian
            if comparison.length < COARSE_STEP_PX:
                break
    hessian = None
    for _ in range(PASSES_MAX):
        comparison = _compare(
            levels[-1], image, shift / levels[-1].factor, hessian, enough, held=held
        )
        if isinstance(comparison, Rejection):
            return comparison
        passes += 1
        if held is None and enough != ALL_PIXELS and _is_lopsided(comparison.sums.hessian):
            enough, hessian = ALL_PIXELS, None
            continue
        shift = comparison.improved * levels[-1].factor
        # Far from the right shift the gradients have less in common.
        hessian = comparison.sums.hessian if comparison.length < STEP_PX_MAX else None
        covariance = _covariance(comparison)
        converged = _has_converged(comparison, covariance)
        if converged:
            break
    assert isinstance(comparison, _Comparison)
    chance = _find_chance_gradient(
        comparison.level,
        comparison.geometry,
        comparison.ratio_of_contrasts,
        comparison.fit.information,
        enough,
    )
    return chance or _summarise(comparison, covariance, converged, passes)


def _is_lopsided(hessian: Array) -> bool:
    """Whether one direction has so little of the gradients that those of some pixels do not tell it."""
    least, most = np.linalg.eigvalsh(hessian)
    return bool(least < LOPSIDED_MAX * most)


def _has_converged(comparison: _Comparison, covariance: Array) -> bool:
    """Whether what remains after a step is little against the sigma of the shift in its better direction."""
    sigma = float(np.sqrt(max(np.min(np.linalg.eigvalsh(covariance)), 0.0)))
    remaining = CONTRACTION * comparison.length + CURVATURE * comparison.length**2
    return remaining < max(REMAINING_SIGMAS * sigma, REMAINING_PX)


def align_reweighted(
    level: PyramidLevel,
    image: Pyramid,
    start_px: Array,
    weights: Array,
    reweight: Callable[[TileStatistics], Array],
    *,
    looks: bool = True,
    held: Array | None = None,
) -> Alignment | Rejection[MatchFailure]:
    """Refine a shift by those tiles that agree with it.

    Parameters
    ----------
    level
        The reference at full resolution.
    image
        The image.
    start_px
        (2,) shift, right to about a pixel.
    weights
        (rows, cols) first weights of the reference's tiles.
    reweight
        From the statistics of the compared tiles to their weights. What it was asked last is where the shift was found.
    looks
        Whether to look at the tiles at the start before the first step; not where the first weights tell what moves.
    held
        As for :func:`align`.

    Returns
    -------
    The alignment, which may not have converged; or a rejection as of :func:`align`.
    """
    found = _descend(level, image, start_px, weights, reweight, looks, held)
    return found if isinstance(found, Rejection) else _summarise(*found)


def shift_of_tiles(
    level: PyramidLevel, image: Pyramid, start_px: Array, weights: Array
) -> Array | None:
    """(2,) the shift of tiles with weights (rows, cols) as :func:`align_reweighted` finds it, and nothing else; None
    where it does not converge.
    """
    found = _descend(
        level,
        image,
        start_px,
        weights,
        lambda tiles: weights[tiles.rows, tiles.cols],
        looks=False,
    )
    if isinstance(found, Rejection) or not found[2]:
        return None
    return found[0].improved * level.factor


def _descend(
    level: PyramidLevel,
    image: Pyramid,
    start_px: Array,
    weights: Array,
    reweight: Callable[[TileStatistics], Array],
    looks: bool,
    held: Array | None = None,
) -> tuple[_Comparison, Array, bool, int] | Rejection[MatchFailure]:
    """The last comparison, its covariance, whether it has converged, and the number of passes."""
    shift, passes = np.asarray(start_px, dtype=np.float64), 0
    weights, converged = weights.copy(), False
    # A bright tool would pull the first step to where it went, or leave none.
    first = _look_at_tiles(level, image, shift / level.factor) if looks else None
    if first is not None:
        found = reweight(first)
        if np.count_nonzero(found) >= BLOCKS_MIN:
            weights[first.rows, first.cols] = found
    latest: _Comparison | None = None
    for passes in range(1, PASSES_MAX + 1):
        comparison = _compare(
            level,
            image,
            shift / level.factor,
            None,
            ALL_PIXELS,
            weights,
            held,
            before=latest,
        )
        if isinstance(comparison, Rejection):
            return comparison
        latest = comparison
        statistics = comparison.tiles
        found = reweight(statistics)
        shift = comparison.improved * level.factor
        before = weights[statistics.rows, statistics.cols]
        if passes >= min(REWEIGHTED_PASSES_MAX, PASSES_MAX) or np.array_equal(found, before):
            covariance = _covariance(comparison)
            converged = _has_converged(comparison, covariance)
            if converged:
                break
        weights[statistics.rows, statistics.cols] = found
    assert latest is not None
    chance = _find_chance_gradient(
        latest.level,
        latest.geometry,
        latest.ratio_of_contrasts,
        latest.fit.information,
        ALL_PIXELS,
    )
    return chance or (latest, covariance, converged, passes)


def _compare(
    level: PyramidLevel,
    image: Pyramid,
    shift: Array,
    hessian: Array | None,
    enough: int = HESSIAN_PIXELS,
    weights: Array | None = None,
    held: Array | None = None,
    before: _Comparison | None = None,
) -> _Comparison | Rejection[MatchFailure]:
    """Sums and fit at a shift in px of the level; ``hessian`` is that of an earlier
    comparison, None to compute it from enough pixels. ``weights`` (rows, cols) are those of the reference's tiles.
    ``held`` is as for :func:`align`. What a comparison ``before`` of the same level has of the same tiles with the same
    weights is not computed again.
    """
    pixels = image.centred(level.factor)
    size = pixels.shape[1], pixels.shape[0]
    window = tile_window(level, size, shift)
    if window is None:
        shared = _overlap_fraction(level.size, size, shift)
        reason = f"too little overlap ({100.0 * shared:.0f} % of the image)"
        return Rejection(MatchFailure.TOO_LITTLE_OVERLAP, reason)
    if weights is not None:
        weights = weights[window.rows, window.cols].copy()
    if before is not None and before.weighs_alike(window, weights):
        geometry = before.geometry
    else:
        geometry = prepare_geometry(level, window, weights)
    sums = tile_sums(level, window, pixels, shift, hessian, enough, weights)
    plain = sums
    if weights is not None:
        sums = sums.weighted(weights)
    fit = solve_step(geometry, sums, held)
    if fit is None:
        information = sums.hessian * np.outer(geometry.gradient_share, geometry.gradient_share)
        contrast = _ratio_of_contrasts(geometry, sums, level.noise_variance)
        return _find_chance_gradient(level, geometry, contrast, information, enough) or Rejection(
            MatchFailure.UNDETERMINED, _FEATURELESS
        )
    return _Comparison(level, window, geometry, sums, plain, fit, shift, size, image.mean, weights)


def _find_chance_gradient(
    level: PyramidLevel,
    geometry: TileGeometry,
    contrast: float,
    information: Array,
    enough: int,
) -> Rejection[MatchFailure] | None:
    """Reject images that have no more gradient in common than chance gives, in one direction or all; ``contrast`` is
    that of the image over that of the reference.
    """
    energy = geometry.total[:2, :2] * np.outer(geometry.gradient_share, geometry.gradient_share)
    pixels = max(min(float(geometry.total[3, 3]), float(enough)), 1.0)
    values, vectors = np.linalg.eigh(information)
    by_chance = _by_chance(level, contrast, pixels, energy, vectors)
    if values[0] > by_chance[0]:
        return None
    if values[1] > by_chance[1]:
        return Rejection(MatchFailure.UNDETERMINED, _FEATURELESS)
    return Rejection(
        MatchFailure.DISSIMILAR, "images differ: no more gradient in common than by chance"
    )


def _by_chance(
    level: PyramidLevel, contrast: float, pixels: float, energy: Array, vectors: Array
) -> Array:
    """What two images whose gradients have an ``energy`` (n, n) in the reference have in common by chance at most,
    along ``vectors`` (n, k).
    """
    # Smoothed noise has fewer independent pixels.
    chance = CHANCE_SIGMAS * contrast * np.sqrt(shared_pixels(level.sigma_px) / pixels)
    return np.asarray(chance * np.einsum("ik,ij,jk->k", vectors, energy, vectors))


def _ratio_of_contrasts(geometry: TileGeometry, sums: TileSums, noise: float) -> float:
    """Standard deviation of the image within its tiles over that of the reference with its noise."""
    own, cross = geometry.normal_matrices, sums.cross.reshape(-1, 4)
    pixels = np.maximum(own[:, 3, 3], 1e-12)
    within = float(np.sum(own[:, 2, 2] - own[:, 2, 3] ** 2 / pixels + noise * own[:, 3, 3]))
    image = float(np.sum(sums.energy.ravel() - cross[:, 3] ** 2 / pixels))
    return float(np.sqrt(max(image, 0.0) / max(within, 1e-300)))


def _sum_blocks(comparison: _Comparison, scores: Array) -> Array:
    """(blocks, k) sums of scores over as many tiles as make neighbours independent."""
    level = comparison.level
    rows = comparison.window.rows.stop - comparison.window.rows.start
    cols = comparison.window.cols.stop - comparison.window.cols.start
    wanted = BLOCK_SIGMAS * level.sigma_px
    merge = [max(1, int(np.ceil(wanted / side))) for side in level.side]
    while (rows // merge[1]) * (cols // merge[0]) < BLOCKS_MIN and max(merge) > 1:
        merge = [max(1, m - 1) for m in merge]
    if max(merge) == 1:
        return scores
    grid = scores.reshape(rows, cols, -1)
    starts = np.arange(0, rows, merge[1]), np.arange(0, cols, merge[0])
    sums = np.add.reduceat(np.add.reduceat(grid, starts[0], axis=0), starts[1], axis=1)
    return np.asarray(sums.reshape(-1, scores.shape[1]))


def _covariance(comparison: _Comparison) -> Array:
    """(2, 2) covariance from the scatter of the blocks' scores, whatever the colour and the strength
    of the noise.
    """
    inverse = invert_symmetric(comparison.fit.information)
    alone = np.ones((len(comparison.fit.scores), 1))
    return _robust_covariance(comparison, comparison.fit.scores, inverse, alone)


def _robust_covariance(
    comparison: _Comparison, scores: Array, inverse: Array, powers: Array
) -> Array:
    """Covariance from the scatter of blocks, and of whole rows of tiles where that is clearly
    larger: lines of a scan may be shifted or shaded as a whole.

    ``scores`` (n, 2 p) are those of the shift times each of the ``powers`` (n, p).
    """
    blocks = _sum_blocks(comparison, scores)
    covariance = _sandwich_covariance(blocks, inverse)
    count = _count_scores(blocks, inverse)
    if count < FEW_SCORES:
        expected = inverse @ _expect_spread(comparison, powers) @ inverse.T
        covariance = (count * covariance + EXPECTED_SCORES * expected) / (count + EXPECTED_SCORES)
        covariance *= _widen_few(count + EXPECTED_SCORES, blocks.shape[1], len(blocks))
    cols = comparison.window.cols.stop - comparison.window.cols.start
    rows = scores.reshape(-1, cols, scores.shape[1]).sum(axis=1)
    if len(rows) < NOISE_ROWS_MIN:
        return covariance
    ratio = np.diag(_sandwich_covariance(rows, inverse)) / np.maximum(np.diag(covariance), 1e-300)
    # With few rows the ratio scatters; white noise seldom makes it so large.
    scale = np.sqrt(np.where(ratio > ROWS_RATIO_MIN, ratio, 1.0))
    return np.asarray(covariance * np.outer(scale, scale))


def _sandwich_covariance(blocks: Array, inverse: Array) -> Array:
    """Covariance from the scatter of independent scores (White 1980, doi:10.2307/1912934)."""
    count, estimated = blocks.shape
    centred = blocks - blocks.mean(axis=0)
    spread = centred.T @ centred * count / max(count - estimated, 1)
    return np.asarray(inverse @ spread @ inverse.T)


def _count_scores(blocks: Array, inverse: Array) -> float:
    """Number of scores that make up most of the scatter: few where there are lone particles."""
    squares = np.einsum("bi,bi->b", blocks @ inverse, blocks)
    return float(squares.sum() ** 2 / max(float(squares @ squares), 1e-300))


def _expect_spread(comparison: _Comparison, powers: Array) -> Array:
    """(2 p, 2 p) covariance of the sum of all scores as the residuals of each tile's pixels tell it.

    A tile has some hundred pixels, and only two scores: of a few tiles it is the better estimate. It does not see what
    moves a tile as a whole.
    """
    variances = comparison.variances_at_gradients
    both = np.einsum("tp,tq,tij->piqj", powers, powers, variances)
    return np.asarray(both.reshape(2 * powers.shape[1], -1))


def _expect_variances(comparison: _Comparison, squares: Array) -> Array:
    """(tiles, 2, 2) covariance of each tile's score, from the mean squares (rows, cols) that the fit leaves in it."""
    level, window = comparison.level, comparison.window
    counts = level.pixel_counts[window.rows, window.cols]
    weights = comparison.geometry.normal_matrices[:, 3, 3] / counts.ravel()
    products = level.noise_products[window.rows, window.cols].reshape(-1, 2, 2)
    variances = weights**2 * np.maximum(squares, 0.0).ravel()
    return np.asarray(variances[:, None, None] * products)


def _widen_few(count: float, estimated: int, blocks: int) -> float:
    """By how much the covariance from so many scores is larger than that from many.

    Three sigmas then hold as of a Gaussian, although the sigma is that of few scores (Student's t).
    """
    freedom = max(count - estimated, FREEDOM_MIN)
    few = estimated / freedom - estimated / max(blocks, 1)
    return (float(stdtrit(freedom, THREE_SIGMAS)) / 3.0) ** 2 * (1.0 + max(few, 0.0))


def _summarise(
    comparison: _Comparison, covariance: Array, converged: bool, passes: int
) -> Alignment:
    level, fit = comparison.level, comparison.fit
    whole = comparison.geometry.total
    cross = comparison.sums.cross.reshape(-1, 4).sum(axis=0)
    pixels = float(whole[3, 3])
    # Of weighted tiles, the noise of the reference does not count.
    noise = level.noise_variance if comparison.weights is None else 0.0
    error = float(squared_residuals(comparison.geometry, comparison.sums, fit, noise).sum())
    gain = float(fit.gain[0])
    weights = comparison.tile_information
    difference, variance = _compare_halves(comparison, covariance, weights)
    joint, joint_covariance, left = _fit_shear(comparison, weights)
    factor = level.factor
    return Alignment(
        shift_px=comparison.improved * factor,
        covariance=covariance * factor**2,
        joint_px=joint * factor,
        joint_covariance=joint_covariance * factor**2,
        half_difference_px=difference * factor,
        half_variance=variance * factor**2,
        gain=gain,
        offset=float(fit.offset[0]) + comparison.mean - gain * level.mean,
        residual_rms=float(np.sqrt(max(error, 0.0) / pixels)),
        reference_variance=float(whole[2, 2] - whole[2, 3] ** 2 / pixels) / pixels
        + level.noise_variance,
        image_variance=float(comparison.sums.energy.sum() - cross[3] ** 2 / pixels) / pixels,
        common_covariance=float(cross[2] - whole[2, 3] * cross[3] / pixels) / pixels,
        overlap=_overlap_fraction(level.size, comparison.image_size, comparison.improved),
        converged=converged,
        iterations=passes,
        _comparison=comparison,
        _left=left,
    )


def _overlap_fraction(reference: tuple[int, int], image: tuple[int, int], shift: Array) -> float:
    both = 1.0
    for a, b, s in zip(reference, image, shift, strict=True):
        both *= max(0.0, min(float(a), b - float(s)) - max(0.0, -float(s)))
    return both / min(reference[0] * reference[1], image[0] * image[1])


def _compare_halves(
    comparison: _Comparison, covariance: Array, weights: Array
) -> tuple[Array, Array]:
    """Differences of the shifts of opposite halves, and their variances."""
    difference, variance = np.zeros((2, 2)), np.full((2, 2), np.inf)
    if comparison.geometry.has_constant_gain:
        # The halves of a lone particle tell nothing without each other.
        return difference, variance
    rows, cols = len(comparison.window.y), len(comparison.window.x)
    whole = comparison.fit.information
    scores = comparison.fit.scores.reshape(rows, cols, 2)
    # The variance of the whole exceeds that of white noise by the same factor as that of its halves.
    colour = np.diag(covariance) / np.diag(invert_symmetric(whole))
    on_grid = weights.reshape(rows, cols, 2, 2)
    weights_by_col, scores_by_col = (np.add.reduce(a, axis=0) for a in (on_grid, scores))
    weights_by_row, scores_by_row = (np.add.reduce(a, axis=1) for a in (on_grid, scores))
    total = scores_by_col.sum(axis=0)
    halves = (
        (weights_by_col[: cols // 2], scores_by_col[: cols // 2]),
        (weights_by_row[: rows // 2], scores_by_row[: rows // 2]),
    )
    for k, (half_weights, half_scores) in enumerate(halves):
        half, score = half_weights.sum(axis=0), half_scores.sum(axis=0)
        if not (well_posed(half) and well_posed(whole - half)):
            continue
        inverses = invert_symmetric(half), invert_symmetric(whole - half)
        difference[k] = -inverses[0] @ score + inverses[1] @ (total - score)
        variance[k] = (np.diag(inverses[0]) + np.diag(inverses[1])) * colour
    return difference, variance


def _fit_shear(comparison: _Comparison, weights: Array) -> tuple[Array, Array, Array]:
    """(4,) shift of the image's middle row and shear, estimated together, their covariance, and the scores (tiles, 2)
    that they leave.
    """
    rows, cols = len(comparison.window.y), len(comparison.window.x)
    # The shift is the same for all tiles of a row.
    by_row, gradients = (
        np.add.reduce(matrices.reshape(rows, cols, 2, 2), axis=1)
        for matrices in (weights, comparison.geometry.gradients)
    )
    powers = np.stack([np.ones(rows), comparison.window.y], axis=1)
    inverse = None
    if rows >= SHEAR_ROWS_MIN:
        inverse = _invert_information(comparison, by_row, gradients, powers)
    if inverse is None:
        return np.full(4, np.nan), np.full((4, 4), np.inf), comparison.fit.scores
    scores = comparison.fit.scores.reshape(rows, cols, 2)
    step = -inverse @ (powers.T @ np.add.reduce(scores, axis=1)).ravel()
    joint = np.append(comparison.shift + step[:2], step[2:])
    # What the step explains is not noise.
    steps = powers @ step.reshape(2, 2)
    explained = weights.reshape(rows, cols, 2, 2) @ steps[:, None, :, None]
    residual = scores + explained[..., 0]
    tilted = np.concatenate([residual, powers[:, 1, None, None] * residual], axis=2)
    each = np.repeat(powers, cols, axis=0)
    covariance = _robust_covariance(comparison, tilted.reshape(-1, 4), inverse, each)
    return joint, covariance, residual.reshape(-1, 2)


def _find_pulls(comparison: _Comparison, left: Array) -> Array:
    """(2, 2) by how much a part of the image that moves by itself, and was not found to, may pull the shift; 0 where
    none is seen. The first row is of any part, the second one of those that are beyond chance whatever their size.

    The scores (tiles, 2) that shift and shear have ``left`` are those of noise where all moves alike. Squares of tiles
    whose scores add up to more than chance may move by themselves. Without one of them, the shift would be another one,
    by the pull at most.
    """
    rows, cols = len(comparison.window.y), len(comparison.window.x)
    elements = [
        matrices.reshape(-1, 4)[:, [0, 1, 3]]
        for matrices in (comparison.expected_variances, comparison.tile_information)
    ]
    planes = np.concatenate([left, *elements], axis=1).reshape(rows, cols, 8)
    # Of a specimen that turns, the halves differ.
    sides = [n for n in PULL_SIDES if 2 * n <= min(rows, cols)] or [PULL_SIDES[0]]
    boxes = [
        cv2.boxFilter(planes, -1, (n, n), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for n in sides
    ]
    sums = np.moveaxis(np.array(boxes), -1, 0).reshape(8, len(sides), -1)
    chi2 = _chi_squares(np.ascontiguousarray(sums[:5]))
    # Images are never quite alike: as the least squares scatter, so do larger ones.
    least = chi2[0][chi2[0] > 0.0]
    scatter = median(least) / MEDIAN_CHI2 if least.size else 1.0
    whole = comparison.fit.information
    inverse = invert_symmetric(whole)
    share = 0.5 * np.tensordot([inverse[0, 0], 2.0 * inverse[0, 1], inverse[1, 1]], sums[5:], 1)
    # There are few squares with a large part of the information, so that less is chance.
    few_chi2 = -2.0 * np.log(PULL_RATE * np.clip(share, PULL_BODY_MIN, 1.0) ** 2)
    chi2 = chi2 / min(max(scatter, 1.0), PULL_EXCESS_MAX)
    moving = chi2 > np.where(share > PULL_BODY_MIN, few_chi2, PULL_CHI2_MIN)
    moves = sums[:, moving].T
    if not len(moves):
        return np.zeros((2, 2))
    rest = whole - moves[:, [5, 6, 6, 7]].reshape(-1, 2, 2)
    found = 1.0 - share[moving] > PULL_REST_MIN
    if not np.any(found):
        return np.zeros((2, 2))
    # In units of the whole. Along an edge, the rest may have nothing of the one direction: it says no more of it.
    white = np.linalg.inv(np.linalg.cholesky(whole))
    values, vectors = np.linalg.eigh(white @ rest[found] @ white.T)
    along = np.einsum("nij,ni->nj", vectors, moves[found, :2] @ white.T)
    pulls = np.einsum("nij,nj->ni", vectors, along / np.maximum(values, PULL_REST_MIN))
    squares = np.einsum("ni,ni->n", pulls, pulls)
    sure = np.where(chi2[moving][found] > PULL_CHI2_MIN, squares, 0.0)
    largest = [pulls[np.argmax(size)] * bool(np.any(size)) for size in (squares, sure)]
    return np.array(largest) @ white


def _chi_squares(sums: Array) -> Array:
    """(sides, n) squares of sums of scores over n squares of tiles in units of their variances; ``sums`` (5, sides, n)
    are those of the scores and of the elements xx, xy and yy of their variances.
    """
    x, y, xx, xy, yy = sums
    determinant = xx * yy - xy**2
    # Of what the filter adds up and takes off again, rounding is left where there is nothing.
    least = ROUNDING * (xx.max(axis=1) * yy.max(axis=1))[:, None]
    good = determinant > np.maximum(ROUNDING * xx * yy, least)
    chi2 = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / np.where(good, determinant, 1.0)
    return np.where(good, chi2, 0.0)


def _invert_information(
    comparison: _Comparison, matrices: Array, gradients: Array, powers: Array
) -> Array | None:
    """(2 p, 2 p) inverse of the information on the p terms of shifts whose ``powers`` are (n, p), of which ``matrices``
    (n, 2, 2) are the information and ``gradients`` (n, 2, 2) the products of the reference's gradients; None where a
    term is told by no more than noise in the gradients gives by chance.

    Of one edge, which a change of the scale moves nearly as a shift and a shear do, it has little but noise.
    """
    scaled, scale = equilibrate(_sum_over_powers(matrices, powers))
    if not _well_conditioned(scaled):
        return None
    both = np.outer(scale, scale)
    pixels = max(float(comparison.geometry.total[3, 3]), 1.0)
    energy = _sum_over_powers(gradients, powers) * both
    values, vectors = np.linalg.eigh(scaled)
    contrast = comparison.ratio_of_contrasts
    if np.any(values <= _by_chance(comparison.level, contrast, pixels, energy, vectors)):
        return None
    return np.asarray(np.linalg.inv(scaled) * both)


def _sum_over_powers(matrices: Array, powers: Array) -> Array:
    """(2 p, 2 p) sum of matrices (n, 2, 2) of shifts times the products of their ``powers`` (n, p)."""
    count = powers.shape[1]
    pairs = (powers[:, :, None] * powers[:, None, :]).reshape(len(powers), -1)
    whole = (matrices.reshape(-1, 4).T @ pairs).reshape(2, 2, count, count)
    return np.asarray(whole.transpose(2, 0, 3, 1).reshape(2 * count, 2 * count))


def _well_conditioned(matrix: Array) -> bool:
    """Whether the eigenvalues of a symmetric matrix are not too different."""
    values = np.abs(np.linalg.eigvalsh(matrix))
    return bool(values.max() <= CONDITION_MAX * values.min())


def _measure_row_power(comparison: _Comparison, modes: int) -> Array | None:
    """Power of the sum of both halves of the columns, and of their difference, which has the same noise."""
    rows, cols = len(comparison.window.y), len(comparison.window.x)
    modes = min(modes, int(rows / ROWS_PER_MODE))
    if min(modes, cols) < SHEAR_ROWS_MIN:
        return None
    scores = comparison.fit.scores.reshape(rows, cols, 2)
    # Neighbours share noise; pairs of columns take turns.
    sign = np.where((np.arange(cols) // 2) % 2 == 0, 1.0, -1.0)
    both = np.stack([scores.sum(axis=1), np.einsum("rcj,c->rj", scores, sign)])
    shifts = -rows * both @ np.linalg.inv(comparison.fit.information)
    basis, line = _cosines(rows, modes), comparison.window.y - comparison.window.y.mean()
    slope = np.einsum("krj,r->kj", shifts, line) / float(line @ line)
    shifts = shifts - line[:, None] * slope[:, None, :]
    power = np.einsum("rm,krj->kmj", basis, shifts) ** 2 / rows
    return np.asarray(power * comparison.level.factor**2)


@lru_cache(maxsize=16)
def _cosines(rows: int, modes: int) -> Array:
    """(rows, modes) orthonormal cosines (the discrete cosine transform of type II)."""
    phase = np.outer(np.arange(rows) + 0.5, np.arange(modes)) * (np.pi / rows)
    return np.asarray(np.sqrt(2.0 / rows) * np.cos(phase))


def _fit_similarity(comparison: _Comparison) -> SimilarityFit | None:
    """The shift of the image's middle, shear, rotation and scale."""
    window, factor = comparison.window, comparison.level.factor
    if min(len(window.x), len(window.y)) < SHEAR_ROWS_MIN:
        return None
    width, height = (factor * n for n in comparison.image_size)
    weights = comparison.tile_information
    x, y = np.tile(window.x, len(window.y)), np.repeat(window.y, len(window.x))
    powers = np.stack([np.ones_like(y), y, x], axis=1)
    inverse = _invert_information(comparison, weights, comparison.geometry.gradients, powers)
    if inverse is None:
        return None
    scores = (powers[:, :, None] * comparison.fit.scores[:, None, :]).reshape(-1, 6)
    step = -inverse @ scores.sum(axis=0)
    explained = np.einsum("tij,tj->ti", weights, powers @ step.reshape(3, 2))
    residual = comparison.fit.scores + explained
    scores = (powers[:, :, None] * residual[:, None, :]).reshape(-1, 6)
    covariance = _robust_covariance(comparison, scores, inverse, powers)
    step[:2] += comparison.shift
    # The last row minus the first; along a row, what changes is scale (x) and rotation (y).
    aspect = height / width
    matrix = np.zeros((6, 6))
    matrix[:4, :4] = factor * np.eye(4)
    matrix[2:4, 4:] = factor * aspect * np.array([[0.0, 1.0], [-1.0, 0.0]])
    matrix[4:, 4:] = factor / width * np.array([[0.0, 1.0], [1.0, 0.0]])
    return SimilarityFit(matrix @ step, matrix @ covariance @ matrix.T)


def tile_residual_energies(
    level: PyramidLevel, image: Pyramid, shift_px: Array, held: Array | None = None
) -> Array | None:
    """(rows, cols) mean squared residual of each tile of the reference at a shift; NaN where they
    do not overlap with the image.

    For comparing competing shifts of the same two images: a paired test over tiles tells whether one
    explains the image better than chance and model error allow. ``held`` is as for :func:`align`, for images of lines.
    """
    comparison = _compare(level, image, shift_px / level.factor, None, held=held)
    if isinstance(comparison, Rejection):
        return None
    energies = np.full(level.normal_matrices.shape[:2], np.nan)
    squares = squared_residuals(
        comparison.geometry, comparison.sums, comparison.fit, level.noise_variance
    )
    window = comparison.window
    counts = level.pixel_counts[window.rows, window.cols]
    energies[window.rows, window.cols] = squares.reshape(counts.shape) / counts
    return energies
