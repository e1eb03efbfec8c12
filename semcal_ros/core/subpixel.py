"""Band-limited sub-pixel shifts and derivatives as short separable filters.

A pure translation needs no general remap: the same eight weights serve every pixel of a row. The
weights minimise the squared error over the band in which a blurred picture has its power
(least-squares fractional delay, Laakso et al. 1996, doi:10.1109/79.482137), so the interpolation
error stays below the noise and does not depend on the fraction. OpenCV's remap is no substitute:
version 4 rounds float maps to 1/32 px.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["MARGIN", "derivative_taps", "gradients", "shifted_patch"]

Array = NDArray[np.float64]
Image = NDArray[np.float32]

#: Pixels that the filters reach beyond the patch on each side.
MARGIN = 4

_TAPS = 8
_FIRST_TAP = -3
_BAND = 0.65 * np.pi
_FREQUENCIES = (np.arange(64) + 0.5) / 64.0 * _BAND
# Pictures have most of their power at low frequencies, so errors there weigh more.
_WEIGHTS = 1.0 / (0.05 + _FREQUENCIES**2) ** 2


@lru_cache(maxsize=1)
def _fit() -> Array:
    """(8, 8) inverse of the normal equations of the weights."""
    offsets = np.arange(_TAPS) + _FIRST_TAP
    difference = offsets[:, None] - offsets[None, :]
    normal = np.tensordot(_WEIGHTS, np.cos(_FREQUENCIES[:, None, None] * difference), axes=1)
    # Outside of the band the weights are free; this keeps them small there.
    normal += 1e-9 * normal[0, 0] * np.eye(_TAPS)
    return np.asarray(np.linalg.inv(normal))


def _shift_taps(fraction: float) -> Array:
    """(8,) weights w with ``f(x + fraction) = sum_k w[k] f(x - 3 + k)``, for a fraction in [0,
    1].
    """
    away = np.arange(_TAPS) + _FIRST_TAP - fraction
    taps = _fit() @ (np.cos(away[:, None] * _FREQUENCIES) @ _WEIGHTS)
    return np.asarray(taps / taps.sum())


@lru_cache(maxsize=1)
def derivative_taps() -> Array:
    """(9,) antisymmetric weights of the first derivative at the centre tap."""
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


def shifted_patch(
    image: Image, left: int, top: int, width: int, height: int, fraction: tuple[float, float]
) -> Image:
    """``image`` sampled at ``(left + col + fraction[0], top + row + fraction[1])``.

    The patch must lie at least :data:`MARGIN` px inside the image on all sides; the fractions lie
    in [-1, 1].
    """
    whole = np.floor(fraction).astype(int)
    x0, y0 = left + int(whole[0]), top + int(whole[1])
    source = image[
        max(y0 + _FIRST_TAP, 0) : y0 + height + MARGIN,
        max(x0 + _FIRST_TAP, 0) : x0 + width + MARGIN,
    ]
    filtered = cv2.sepFilter2D(
        source,
        cv2.CV_32F,
        _shift_taps(fraction[0] - float(whole[0])),
        _shift_taps(fraction[1] - float(whole[1])),
        anchor=(-_FIRST_TAP, -_FIRST_TAP),
        borderType=cv2.BORDER_REFLECT_101,
    )
    x, y = min(-_FIRST_TAP, x0), min(-_FIRST_TAP, y0)
    return np.asarray(filtered[y : y + height, x : x + width], dtype=np.float32)
