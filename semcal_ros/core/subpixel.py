"""Band-limited sub-pixel shifts and derivatives as short separable filters.

A pure translation needs no general remap: the same twelve weights serve every pixel of a row. The
weights minimise the squared error over the band in which a blurred picture has its power
(least-squares fractional delay, Laakso et al. 1996, doi:10.1109/79.482137), so the interpolation
error stays below the noise and does not depend on the fraction. OpenCV's remap is no substitute:
version 4 rounds float maps to 1/32 px.
"""

from __future__ import annotations

from functools import lru_cache
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["MARGIN", "derivative_taps", "gradients", "sampled"]

Array = NDArray[np.float64]
Image = NDArray[np.float32]

#: Pixels that the filters reach beyond the patch on each side.
MARGIN = 6

_TAPS = 12
_FIRST_TAP = -5
_BAND = 0.72 * np.pi
_FREQUENCIES = (np.arange(64) + 0.5) / 64.0 * _BAND
# Pictures have most of their power at low frequencies, so errors there weigh more.
_WEIGHTS = 1.0 / (0.05 + _FREQUENCIES**2)


@lru_cache(maxsize=1)
def _fit() -> Array:
    """(12, 12) inverse of the normal equations of the weights."""
    offsets = np.arange(_TAPS) + _FIRST_TAP
    difference = offsets[:, None] - offsets[None, :]
    normal = np.tensordot(_WEIGHTS, np.cos(_FREQUENCIES[:, None, None] * difference), axes=1)
    # Outside of the band the weights are free; this keeps them small there.
    normal += 1e-9 * normal[0, 0] * np.eye(_TAPS)
    return np.asarray(np.linalg.inv(normal))


def _shift_taps(fraction: float) -> Array:
    """(12,) weights w with ``f(x + fraction) = sum_k w[k] f(x - 5 + k)``, for a fraction in [0,
    1].
    """
    away = np.arange(_TAPS) + _FIRST_TAP - fraction
    taps = _fit() @ (np.cos(away[:, None] * _FREQUENCIES) @ _WEIGHTS)
    return np.asarray(taps / taps.sum())


@lru_cache(maxsize=1)
def derivative_taps() -> Array:
    """(13,) antisymmetric weights of the first derivative at the centre tap."""
    reach = np.arange(1, MARGIN + 1)
    sines = 2.0 * np.sin(_FREQUENCIES[:, None] * reach)
    weighted = sines * _WEIGHTS[:, None]
    half = np.linalg.solve(sines.T @ weighted, weighted.T @ _FREQUENCIES)
    half /= 2.0 * float(half @ reach)
    return np.concatenate([-half[::-1], [0.0], half])


def gradients(image: Image) -> tuple[Image, Image]:
    """Derivatives (d/dx, d/dy) of ``image`` in units per px, each as large as ``image``."""
    taps = derivative_taps()
    one = np.array([1.0])
    dx = cv2.sepFilter2D(image, cv2.CV_32F, taps, one, borderType=cv2.BORDER_REFLECT_101)
    dy = cv2.sepFilter2D(image, cv2.CV_32F, one, taps, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(dx, dtype=np.float32), np.asarray(dy, dtype=np.float32)


def sampled(
    image: NDArray[np.generic],
    corner: tuple[int, int],
    size: tuple[int, int],
    fraction: Array,
    taps: tuple[Array, Array],
    delta: float,
) -> Image:
    """``image`` filtered and sampled at ``corner + (col, row) + fraction``, plus ``delta``.

    Parameters
    ----------
    image
        (h, w) of uint8, uint16 or float32.
    corner, size
        (left, top) and (width, height) of the patch, which must lie inside of the image.
    fraction
        (2,) sub-pixel shift (x, y), each in [-1, 1].
    taps
        Odd numbers of weights of the filter along x and along y.
    delta
        Added to the result.

    Notes
    -----
    What the filters reach outside of the image is mirrored.
    """
    left, top = corner
    width, height = size
    below = np.floor(fraction).astype(int)
    kernels = [
        np.convolve(tap, _shift_taps(float(part)))
        for tap, part in zip(taps, fraction - below, strict=True)
    ]
    before = [-_FIRST_TAP + len(tap) // 2 for tap in taps]
    after = [len(k) - 1 - b for k, b in zip(kernels, before, strict=True)]
    x0, y0 = left + int(below[0]), top + int(below[1])
    from_x, from_y = max(x0 - before[0], 0), max(y0 - before[1], 0)
    source = image[from_y : y0 + height + after[1], from_x : x0 + width + after[0]]
    filtered = cv2.sepFilter2D(
        cast("Image", source),
        cv2.CV_32F,
        kernels[0],
        kernels[1],
        anchor=(before[0], before[1]),
        delta=delta,
        borderType=cv2.BORDER_REFLECT_101,
    )
    patch = filtered[y0 - from_y : y0 - from_y + height, x0 - from_x : x0 - from_x + width]
    return np.asarray(patch, dtype=np.float32)
