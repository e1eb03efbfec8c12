"""Fine alignment of two pictures by inverse-compositional least squares at full resolution.

With the model

    image(x + s) = (g0 + g1 x + g2 y) reference(x) + (o0 + o1 x + o2 y)

the reference's gradient is computed once and every step solves the same two equations (Baker and
Matthews 2004, doi:10.1023/B:VISI.0000011205.11775.fd). Gain and offset may vary linearly over the
field, because the detector's shading does not move with the specimen: a gain ramp along x has a
constant product with the gradient along x and would pull the shift. They drop out when the gradient
is made orthogonal to them. Only what overlaps is compared. Because the gradient belongs to the
reference alone, the noise of the resampled image does not pull the estimate towards whole pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.subpixel import gradients, shifted_patch
from semcal_ros.core.template import Patch, Template, Window, overlap_window

__all__ = ["Alignment", "align", "block_energies"]

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_MAX_ITERATIONS = 12
_PATIENCE = 4
# The step after one of this size is a hundred times smaller.
_LAST_STEP_PX = 5e-3
_LONGEST_STEP_PX = 1.5
# Enough blocks that their scatter is known to a few percent, and each wide against the smoothed
# noise.
_BLOCKS = 400
_BLOCK_SIGMAS = 9.0


@dataclass(frozen=True)
class Alignment:
    """Outcome of :func:`align`; all shifts are those of the cropped pictures that went in.

    Attributes
    ----------
    shift_px
        (2,) shift.
    covariance
        (2, 2), from the scatter of the blocks' contributions.
    look_difference_px, look_variance
        (2, 2) differences (rows: left/right, top/bottom) of the shifts that the two halves of the
        overlap ask for, and their variances.
    gain, offset
        Image grey levels per reference grey level, and at reference level 0, in the middle of the
        overlap.
    residual_rms
        RMS of what gain, offset and shift do not explain, in image grey levels after smoothing.
    reference_variance, image_variance, common_covariance
        Second moments over the overlap.
    overlap
        Fraction of the smaller picture that was compared.
    converged, iterations
        Whether the last step was negligible, and the number of steps.
    """

    shift_px: Array
    covariance: Array
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


def _sampled(window: Window, image: Image, shift: Array) -> Image:
    """The image over the overlap, at the reference's pixels moved by the shift."""
    return shifted_patch(
        image,
        window.left + window.whole[0],
        window.top + window.whole[1],
        window.width,
        window.height,
        (float(shift[0] - window.whole[0]), float(shift[1] - window.whole[1])),
    )


def _well_posed(matrix: Array) -> bool:
    bound = 1e-6 * float(matrix[0, 0] * matrix[1, 1])
    return bool(matrix[0, 0] > 0.0 and float(np.linalg.det(matrix)) > bound > 0.0)


def align(template: Template, image: Image, start_px: Array) -> Alignment | None:
    """Refine a shift that is right to about a pixel.

    Parameters
    ----------
    template
        Reference.
    image
        Image, smoothed in the same way.
    start_px
        (2,) shift to start from.

    Returns
    -------
    Alignment or None
        None where too little overlaps or the gradient leaves a direction undetermined.
    """
    shift = np.asarray(start_px, dtype=np.float64).copy()
    window: Window | None = None
    for iteration in range(1, _MAX_ITERATIONS + 1):
        if window is None or float(np.max(np.abs(shift - window.whole))) > 0.9:
            window = overlap_window(template.smooth, image, shift)
            if window is None:
                return None
        patch = template.patch(window)
        if not _well_posed(patch.information):
            return None
        seen = _sampled(window, image, shift)
        gain = float(patch.nuisance[0] @ seen.ravel()) * float(patch.solve_nuisance[0, 0])
        slope = patch.information * (gain if gain > 0.1 else 1.0)
        if iteration > _PATIENCE:
            # Too slow: noise that is not white passes for gradient. The common gradient has none.
            common = _common_information(patch, seen)
            slope = common if _well_posed(common) else slope
        step = -np.linalg.solve(slope, (patch.gradient @ seen.ravel()).astype(np.float64))
        length = float(np.hypot(step[0], step[1]))
        shift = shift + step * min(1.0, _LONGEST_STEP_PX / max(length, 1e-12))
        if length < _LAST_STEP_PX:
            break
    assert window is not None
    return _finish(template, image, window, seen, shift, length < _LAST_STEP_PX, iteration)


def _common_information(patch: Patch, seen: Image) -> Array:
    """(2, 2) product of both pictures' gradients, to which noise does not contribute on average."""
    own = np.stack(gradients(seen)).reshape(2, -1)
    slope = (patch.gradient @ own.T).astype(np.float64)
    return np.asarray(0.5 * (slope + slope.T))


def _finish(
    template: Template,
    image: Image,
    window: Window,
    seen: Image,
    shift: Array,
    converged: bool,
    iterations: int,
) -> Alignment | None:
    patch = template.patch(window)
    slope = _common_information(patch, seen)
    if not _well_posed(slope):
        return None
    size = seen.size
    mean = float(seen.mean(dtype=np.float64))
    centred = (seen - np.float32(mean)).ravel()
    along = (patch.nuisance @ centred).astype(np.float64)
    factors = patch.solve_nuisance @ along
    error = centred - factors.astype(np.float32) @ patch.nuisance
    side = _block_side(window, template.sigma_px)
    inverse = np.asarray(np.linalg.inv(slope), dtype=np.float64)
    covariance = _scatter(_block_sums(patch.gradient * error, window, side), inverse)
    # Blocks leave the far edges out.
    covariance *= size / (window.width // side * (window.height // side) * side**2)
    difference, variance = _looks(patch, window, error, float(factors[0]), covariance)
    return Alignment(
        shift_px=shift,
        covariance=covariance,
        look_difference_px=difference,
        look_variance=variance,
        gain=float(factors[0]),
        offset=mean - float(factors[0]) * patch.mean,
        residual_rms=float(np.sqrt(float(error @ error) / size)),
        reference_variance=float(patch.nuisance[0] @ patch.nuisance[0]) / size,
        image_variance=float(centred @ centred) / size,
        common_covariance=float(along[0]) / size,
        overlap=size / float(min(template.smooth.size, image.size)),
        converged=converged,
        iterations=iterations,
    )


def _block_side(window: Window, sigma_px: float) -> int:
    side = max(np.sqrt(window.width * window.height / _BLOCKS), _BLOCK_SIGMAS * sigma_px, 6.0)
    return int(min(side, min(window.width, window.height) // 4))


def _block_sums(pictures: Image, window: Window, side: int) -> Array:
    """(k, rows, cols) sums over square blocks of (k, n); what does not fill a block at the far
    edges is left out.
    """
    rows, cols = window.height // side, window.width // side
    sums = []
    for picture in pictures.reshape(-1, window.height, window.width):
        part = picture[: rows * side, : cols * side]
        sums.append(cv2.resize(part, (cols, rows), interpolation=cv2.INTER_AREA))
    return np.asarray(np.stack(sums), dtype=np.float64) * float(side * side)


def _scatter(scores: Array, inverse: Array) -> Array:
    """(2, 2) covariance of a shift from its blocks' scores (2, ...): noise of any colour and
    strength is in them.
    """
    flat = scores.reshape(2, -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    blocks = flat.shape[1]
    return np.asarray(inverse @ (flat @ flat.T) @ inverse.T * blocks / max(blocks - 2, 1))


def _looks(
    patch: Patch, window: Window, error: Image, gain: float, covariance: Array
) -> tuple[Array, Array]:
    """Differences of the shifts of opposite halves, each with gain and offset of its own, and
    their variances.
    """
    difference, variance = np.zeros((2, 2)), np.zeros((2, 2))
    if patch.looks is None:
        return difference, variance + np.inf
    left = error.reshape(window.height, window.width).copy()
    left[:, window.width // 2 :] = 0.0
    upper = window.height // 2 * window.width
    whole = patch.columns @ error
    parts = (patch.columns @ left.ravel(), patch.columns[:, :upper] @ error[:upper])
    # How much larger than that of white noise the variance of the whole is holds for its halves as
    # well.
    colour = np.diag(covariance) / np.diag(np.linalg.inv(patch.information))
    for k, part in enumerate(parts):
        for sums, gram, sign in (
            (part, patch.looks[k, 0], 1.0),
            (whole - part, patch.looks[k, 1], -1.0),
        ):
            unit = np.sqrt(np.diag(gram)) + 1e-30
            inverse = np.linalg.inv(gram / np.outer(unit, unit) + 1e-6 * np.eye(8))
            inverse = inverse / np.outer(unit, unit)
            difference[k] -= sign * (inverse @ sums.astype(np.float64))[:2] / gain
            variance[k] += np.diag(inverse)[:2] * colour
    return difference, variance


def block_energies(template: Template, image: Image, alignment: Alignment) -> Array | None:
    """(16, 16) mean squared residual over parts of the reference; NaN where they do not overlap
    with the image.

    For comparing rival shifts of the same two pictures: a paired test over blocks tells whether one
    explains the image better than chance and model error allow.
    """
    window = overlap_window(template.smooth, image, alignment.shift_px)
    if window is None:
        return None
    seen = _sampled(window, image, alignment.shift_px)
    gain, offset = np.float32(alignment.gain), np.float32(alignment.offset)
    error = seen - gain * window.of(template.smooth) - offset
    full: Image = np.full(template.smooth.shape, np.nan, dtype=np.float32)
    window.of(full)[:] = error**2
    height, width = (n // 16 for n in template.smooth.shape)
    cells = full[: 16 * height, : 16 * width].reshape(16, height, 16, width)
    return np.asarray(cells.mean(axis=(1, 3)), dtype=np.float64)
