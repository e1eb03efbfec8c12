"""Checks of an image before corners are looked for in it, and its conversion to float."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.errors import InvalidValueError

__all__ = ["prepare_image", "screen_image"]

SATURATED_MAX = 0.5
SMALLEST_SIDE = 32


def prepare_image(image: ArrayLike, databar_rows: int) -> NDArray[np.float32]:
    """The image as (h, w) float32 without its databar.

    Raises
    ------
    InvalidValueError
        If it is not a two-dimensional image of numbers, or is too small.
    """
    values = np.asarray(image)
    if values.ndim != 2 or values.dtype.kind not in "uif":
        raise InvalidValueError(
            f"an image of shape {values.shape} and type {values.dtype}",
            expected="one channel of integers or floats, shape (h, w)",
            do="convert colour images to grey first",
        )
    if not 0 <= databar_rows <= values.shape[0] - SMALLEST_SIDE or values.shape[1] < SMALLEST_SIDE:
        raise InvalidValueError(
            f"an image of {values.shape[1]} x {values.shape[0]} px"
            f" with {databar_rows} databar rows",
            expected=f"at least {SMALLEST_SIDE} x {SMALLEST_SIDE} px without the databar",
        )
    rows = values.shape[0] - databar_rows
    return np.ascontiguousarray(values[:rows], dtype=np.float32)


def screen_image(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], str]:
    """The image scaled to a contrast of about 1, and a reason to refuse it ("" if none)."""
    sample = image[::2, ::2]
    if not np.all(np.isfinite(image)):
        return image, "the image has values that are not finite"
    low, high = (float(v) for v in np.percentile(sample, [1.0, 99.0]))
    top, bottom = float(image.max()), float(image.min())
    if top - bottom <= 0.0:
        return image, "the image is blank: every pixel has the same value"
    at_limit = max(float(np.mean(sample >= top)), float(np.mean(sample <= bottom)))
    if high <= low or at_limit > 0.9:
        return image, "the image is blank or saturated: nearly all pixels have the same value"
    if float(np.mean((sample >= top) | (sample <= bottom))) > SATURATED_MAX and _two_levels(sample):
        return (image - np.float32(low)) / np.float32(high - low), ""
    if at_limit > SATURATED_MAX:
        part = round(100.0 * at_limit)
        return image, f"the image is saturated: {part} % of the pixels are at a limit"
    return (image - np.float32(low)) / np.float32(high - low), ""


def _two_levels(sample: NDArray[np.float32]) -> bool:
    """Whether both limits are common: a clean two-level board is not saturated."""
    top = float(np.mean(sample >= sample.max()))
    bottom = float(np.mean(sample <= sample.min()))
    return min(top, bottom) > 0.2
