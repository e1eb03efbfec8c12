"""Fine alignment of two pictures by inverse-compositional least squares, coarse to fine.

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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, equilibrate
from semcal_ros.core.registration.tile_least_squares import (
    TileFit,
    TileGeometry,
    fitted,
    geometry_of,
    residuals,
    well_posed,
)
from semcal_ros.core.registration.tiles import (
    PIXELS_FOR_SLOPES,
    Pyramid,
    PyramidLevel,
    TileSums,
    TileWindow,
    tile_sums,
    tile_window,
)

__all__ = ["Alignment", "align", "residual_energies"]


_MAX_PASSES = 12
_COARSE_PASSES = 4
_LONGEST_STEP_PX = 1.5
# A coarse level is left when its step is this short (px of the level).
_COARSE_STEP_PX = 0.2
# What a step leaves is at most this part of it, and its square over the pictures' finest structure.
_CONTRACTION = 0.06
_CURVATURE = 0.5
_SIGMAS_LEFT = 0.12
_LEAST_LEFT_PX = 5e-4
_BLOCK_SIGMAS = 14.0
_LEAST_BLOCKS = 36
# Rows of tiles from which a change of the shift over the rows can be told.
_LEAST_ROWS = 6
# Noise of lines is looked for in that many rows of tiles, and found where it makes the variance so
# many times larger.
_LEAST_ROWS_OF_NOISE = 10
_ROWS_RATIO = 2.0
# How many standard deviations of chance the common information must be above.
_CHANCE = 5.0


@dataclass(frozen=True)
class Alignment:
    """Outcome of :func:`align`; shifts are those of the cropped pictures that went in.

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
    look_difference_px, look_variance
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
        Fraction of the smaller picture that both show.
    converged, iterations
        Whether the last step left nothing that matters, and the number of steps.
    """

    shift_px: Array
    covariance: Array
    joint_px: Array
    joint_covariance: Array
    look_difference_px: Array
    look_variance: Array
    gain: float
    offset: float
    residual_rms: float
    reference_variance: float
    image_variance: float
    common_covariance: float
    overlap: float
    converged: bool
    iterations: int


@dataclass(frozen=True)
class _Look:
    """Everything about one look at the pixels of one level; shifts in px of the level."""

    level: PyramidLevel
    window: TileWindow
    geometry: TileGeometry
    sums: TileSums
    fit: TileFit
    shift: Array
    image_size: tuple[int, int]
    mean: float

    @property
    def length(self) -> float:
        """Length of the step that the look asks for."""
        return float(np.hypot(self.fit.step[0], self.fit.step[1]))

    @property
    def improved(self) -> Array:
        """The shift after the step, which is limited."""
        limit = min(1.0, _LONGEST_STEP_PX / max(self.length, 1e-12))
        return np.asarray(self.shift + limit * self.fit.step)


def align(levels: Sequence[PyramidLevel], image: Pyramid, start_px: Array) -> Alignment | None:
    """Refine a shift.

    Parameters
    ----------
    levels
        Reference at falling reduction factors; the last one decides.
    image
        Image.
    start_px
        (2,) shift in full-resolution px, right to about a pixel of the first level.

    Returns
    -------
    Alignment or None
        None where too little overlaps or the gradient leaves a direction undetermined.
    """
    shift = np.asarray(start_px, dtype=np.float64)
    mean = float(image.at(levels[0].factor).mean(dtype=np.float64))
    passes = 0
    for level in levels[:-1]:
        slopes = None
        for _ in range(_COARSE_PASSES):
            look = _look(level, image, shift / level.factor, mean, slopes)
            if look is None:
                # A fine texture may be lost at this resolution; the next one knows more.
                break
            passes += 1
            shift, slopes = look.improved * level.factor, look.sums.slopes
            if look.length < _COARSE_STEP_PX:
                break
    slopes = None
    for _ in range(_MAX_PASSES):
        look = _look(levels[-1], image, shift / levels[-1].factor, mean, slopes)
        if look is None:
            return None
        passes += 1
        shift = look.improved * levels[-1].factor
        # Far from the right shift the gradients have less in common.
        slopes = look.sums.slopes if look.length < _LONGEST_STEP_PX else None
        covariance = _covariance(look)
        sigma = float(np.sqrt(max(np.min(np.linalg.eigvalsh(covariance)), 0.0)))
        left = _CONTRACTION * look.length + _CURVATURE * look.length**2
        converged = left < max(_SIGMAS_LEFT * sigma, _LEAST_LEFT_PX)
        if converged:
            break
    assert look is not None
    if not _informed(look):
        return None
    return _finished(look, covariance, converged, passes)


def _look(
    level: PyramidLevel, image: Pyramid, shift: Array, mean: float, slopes: Array | None
) -> _Look | None:
    """Sums and fit at a shift in px of the level; ``slopes`` are those of an earlier look."""
    picture = image.at(level.factor)
    size = picture.shape[1], picture.shape[0]
    window = tile_window(level, size, shift)
    if window is None:
        return None
    geometry = geometry_of(level, window)
    sums = tile_sums(level, window, picture, shift, mean, slopes)
    fit = fitted(geometry, sums)
    return None if fit is None else _Look(level, window, geometry, sums, fit, shift, size, mean)


def _informed(look: _Look) -> bool:
    """Whether the pictures have more gradient in common than chance gives, in every direction."""
    level, geometry, fit = look.level, look.geometry, look.fit
    energy = geometry.gram.sum(axis=0)[:2, :2] * np.outer(geometry.kept, geometry.kept)
    pixels = min(float(geometry.gram[:, 3, 3].sum()), float(PIXELS_FOR_SLOPES))
    # Smoothed noise has fewer independent pixels.
    chance = np.sqrt((1.0 + 4.0 * np.pi * level.sigma_px**2) / pixels)
    values, vectors = np.linalg.eigh(fit.information)
    weakest = vectors[:, 0]
    return bool(values[0] > _CHANCE * chance * float(weakest @ energy @ weakest))


def _blocks(look: _Look, scores: Array) -> Array:
    """(blocks, k) sums of scores over so many tiles that neighbours are independent."""
    level = look.level
    rows = look.window.rows.stop - look.window.rows.start
    cols = look.window.cols.stop - look.window.cols.start
    wanted = _BLOCK_SIGMAS * level.sigma_px
    merge = [max(1, int(np.ceil(wanted / side))) for side in level.side]
    while (rows // merge[1]) * (cols // merge[0]) < _LEAST_BLOCKS and max(merge) > 1:
        merge = [max(1, m - 1) for m in merge]
    if max(merge) == 1:
        return scores
    grid = scores.reshape(rows, cols, -1)
    starts = np.arange(0, rows, merge[1]), np.arange(0, cols, merge[0])
    sums = np.add.reduceat(np.add.reduceat(grid, starts[0], axis=0), starts[1], axis=1)
    return np.asarray(sums.reshape(-1, scores.shape[1]))


def _covariance(look: _Look) -> Array:
    """(2, 2) from the scatter of the blocks' scores: noise of any colour and strength is in
    them.
    """
    return _robust(look, look.fit.scores, _inverse(look.fit.information))


def _robust(look: _Look, scores: Array, inverse: Array) -> Array:
    """Covariance from the scatter of blocks, and of whole rows of tiles where that is clearly
    larger: lines of a scan may be shifted or shaded as a whole.
    """
    covariance = _sandwich(_blocks(look, scores), inverse)
    cols = look.window.cols.stop - look.window.cols.start
    rows = scores.reshape(-1, cols, scores.shape[1]).sum(axis=1)
    if len(rows) < _LEAST_ROWS_OF_NOISE:
        return covariance
    ratio = np.diag(_sandwich(rows, inverse)) / np.maximum(np.diag(covariance), 1e-300)
    # With few rows the ratio scatters; white noise seldom makes it so large.
    scale = np.sqrt(np.where(ratio > _ROWS_RATIO, ratio, 1.0))
    return np.asarray(covariance * np.outer(scale, scale))


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _sandwich(blocks: Array, inverse: Array) -> Array:
    count, estimated = blocks.shape
    centred = blocks - blocks.mean(axis=0)
    spread = centred.T @ centred * count / max(count - estimated, 1)
    return np.asarray(inverse @ spread @ inverse.T)


def _finished(look: _Look, covariance: Array, converged: bool, passes: int) -> Alignment:
    gram, cross, level = look.geometry.gram, look.sums.cross.reshape(-1, 4), look.level
    whole, seen = gram.sum(axis=0), cross.sum(axis=0)
    pixels = float(whole[3, 3])
    error = float(residuals(look.geometry, look.sums, look.fit).sum())
    gain = float(look.fit.gain[0])
    weights = _weights(look)
    difference, variance = _halves(look, covariance, weights)
    joint, joint_covariance = _with_shear(look, weights)
    factor = level.factor
    return Alignment(
        shift_px=look.improved * factor,
        covariance=covariance * factor**2,
        joint_px=joint * factor,
        joint_covariance=joint_covariance * factor**2,
        look_difference_px=difference * factor,
        look_variance=variance * factor**2,
        gain=gain,
        offset=float(look.fit.offset[0]) + look.mean - gain * level.mean,
        residual_rms=float(np.sqrt(max(error, 0.0) / pixels)),
        reference_variance=float(whole[2, 2] - whole[2, 3] ** 2 / pixels) / pixels,
        image_variance=float(look.sums.energy.sum() - seen[3] ** 2 / pixels) / pixels,
        common_covariance=float(seen[2] - whole[2, 3] * seen[3] / pixels) / pixels,
        overlap=_overlap(level.size, look.image_size, look.improved),
        converged=converged,
        iterations=passes,
    )


def _overlap(reference: tuple[int, int], image: tuple[int, int], shift: Array) -> float:
    both = 1.0
    for a, b, s in zip(reference, image, shift, strict=True):
        both *= max(0.0, min(float(a), b - float(s)) - max(0.0, -float(s)))
    return both / min(reference[0] * reference[1], image[0] * image[1])


def _weights(look: _Look) -> Array:
    """(tiles, 2, 2) each tile's part of the information, in the proportion of its gradients."""
    own = look.geometry.gram[:, :2, :2]
    scale = np.sqrt(np.diag(look.fit.information) / np.diag(own.sum(axis=0)))
    tiles = own * np.outer(scale, scale)
    # The products of x and y: those of the common information, spread evenly.
    missing = look.fit.information[0, 1] - tiles[:, 0, 1].sum()
    tiles[:, 0, 1] += missing / len(tiles)
    tiles[:, 1, 0] = tiles[:, 0, 1]
    return np.asarray(tiles)


def _halves(look: _Look, covariance: Array, weights: Array) -> tuple[Array, Array]:
    """Differences of the shifts of opposite halves, and their variances."""
    difference, variance = np.zeros((2, 2)), np.full((2, 2), np.inf)
    if look.geometry.alone:
        # Of a lone particle no half tells anything without the other.
        return difference, variance
    cols = look.window.cols.stop - look.window.cols.start
    scores, shape = look.fit.scores, (-1, cols)
    whole, total = look.fit.information, scores.sum(axis=0)
    # How much larger than that of white noise the variance of the whole is, holds for its halves.
    colour = np.diag(covariance) / np.diag(_inverse(whole))
    on_grid, scores_on_grid = weights.reshape(*shape, 2, 2), scores.reshape(*shape, 2)
    rows = len(on_grid)
    halves = (
        (on_grid[:, : cols // 2], scores_on_grid[:, : cols // 2]),
        (on_grid[: rows // 2], scores_on_grid[: rows // 2]),
    )
    for k, (half_weights, half_scores) in enumerate(halves):
        half = half_weights.sum(axis=(0, 1))
        if not (well_posed(half) and well_posed(whole - half)):
            continue
        score = half_scores.sum(axis=(0, 1))
        inverses = _inverse(half), _inverse(whole - half)
        difference[k] = -inverses[0] @ score + inverses[1] @ (total - score)
        variance[k] = (np.diag(inverses[0]) + np.diag(inverses[1])) * colour
    return difference, variance


def _with_shear(look: _Look, weights: Array) -> tuple[Array, Array]:
    """(4,) shift of the image's middle row and shear, estimated together, and their covariance."""
    cols = look.window.cols.stop - look.window.cols.start
    y = np.repeat(look.window.y, cols)
    powers = np.stack([np.ones_like(y), y], axis=1)
    pairs = (powers[:, :, None] * powers[:, None, :]).reshape(-1, 4)
    whole = (weights.reshape(-1, 4).T @ pairs).reshape(2, 2, 2, 2)
    information = whole.transpose(2, 0, 3, 1).reshape(4, 4)
    scaled, scale = equilibrate(information)
    if len(look.window.y) < _LEAST_ROWS or np.linalg.cond(scaled) > 1e6:
        return np.full(4, np.nan), np.full((4, 4), np.inf)
    inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
    scores = (powers[:, :, None] * look.fit.scores[:, None, :]).reshape(-1, 4)
    step = -inverse @ scores.sum(axis=0)
    joint = np.append(look.shift + step[:2], step[2:])
    # What the step explains is no noise.
    moved = powers @ step.reshape(2, 2)
    left = look.fit.scores + np.einsum("tij,tj->ti", weights, moved)
    scores = (powers[:, :, None] * left[:, None, :]).reshape(-1, 4)
    return joint, _robust(look, scores, inverse)


def residual_energies(level: PyramidLevel, image: Pyramid, shift_px: Array) -> Array | None:
    """(rows, cols) mean squared residual of each tile of the reference at a shift; NaN where they
    do not overlap with the image.

    For comparing rival shifts of the same two pictures: a paired test over tiles tells whether one
    explains the image better than chance and model error allow.
    """
    mean = float(image.at(level.factor).mean(dtype=np.float64))
    look = _look(level, image, shift_px / level.factor, mean, None)
    if look is None:
        return None
    energies = np.full(level.gram.shape[:2], np.nan)
    left = residuals(look.geometry, look.sums, look.fit) / level.gram[0, 0, 3, 3]
    energies[look.window.rows, look.window.cols] = left.reshape(len(look.window.y), -1)
    return energies
