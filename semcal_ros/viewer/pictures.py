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

"""Pictures for the page: a part of an image, stretched to 8 bits, in the size that is shown."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.errors import InvalidValueError

#: Closed polygons of (x, y) px.
Outlines = tuple[tuple[tuple[int, int], ...], ...]

# Grey levels that may be lost at either end, percent: hot pixels and the edges of charging.
_TAIL_PERCENT = 0.5
# Enough for a percentile to 0.2 % of the levels; a whole large image would take longer than its JPEG.
_SAMPLED = 1 << 16
# Noise hardly compresses; below 80 its grain becomes that of the compression.
_JPEG_QUALITY = 85
# A pixel of the image then covers a good part of a centimetre on the screen.
_LARGEST_ZOOM = 32.0


@dataclass(frozen=True)
class Contrast:
    """How grey levels become those of the screen.

    Attributes
    ----------
    mode
        ``auto``: between the 0.5 and 99.5 percentiles; ``full``: the whole range of the detector;
        ``fixed``: between ``low`` and ``high``.
    low, high
        Grey levels that become black and white, for ``fixed``.
    """

    mode: str = "auto"
    low: float = 0.0
    high: float = 255.0

    def __post_init__(self) -> None:
        if self.mode not in ("auto", "full", "fixed"):
            raise InvalidValueError(f"contrast {self.mode!r}", expected="auto, full or fixed")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise InvalidValueError(
                f"a contrast from {self.low:g} to {self.high:g}", expected="black below white"
            )


@dataclass(frozen=True)
class Levels:
    """Grey levels of an image.

    Attributes
    ----------
    low, high
        What becomes black and white.
    least, greatest
        The range that can be chosen from: of the bits that the detector seems to have, or of the values that there are.
    """

    low: float
    high: float
    least: float
    greatest: float


def outline(mask: NDArray[Any]) -> Outlines:
    """Return the outlines of what is not 0 in an image (h, w) of 8 bits."""
    found, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return tuple(tuple((int(x), int(y)) for x, y in points[:, 0]) for points in found)


@dataclass(frozen=True)
class Region:
    """A part of an image, in whole pixels: its left upper corner and its size."""

    x: int
    y: int
    width: int
    height: int


def choose_levels(image: NDArray[Any], contrast: Contrast) -> Levels:
    """Choose what becomes black and white.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3) grey levels of any real type.
    contrast
        As the user wants it.
    """
    step = max(1, math.isqrt(image.shape[0] * image.shape[1] // _SAMPLED))
    sample = image[::step, ::step]
    if image.dtype.kind == "f":
        sample = sample[np.isfinite(sample)]
        least, greatest = (float(sample.min()), float(sample.max())) if sample.size else (0.0, 1.0)
        if greatest <= least:
            greatest = least + 1.0
    else:
        # Detectors of 10, 12 and 14 bits fill the lower part of 16; a few levels tell which.
        bits = max(8, int(sample.max()).bit_length())
        least, greatest = 0.0, float(2 ** (bits + bits % 2) - 1)
    if contrast.mode == "fixed":
        return Levels(contrast.low, contrast.high, least, greatest)
    low, high = least, greatest
    if contrast.mode == "auto" and sample.size:
        low, high = (
            float(v) for v in np.percentile(sample, (_TAIL_PERCENT, 100.0 - _TAIL_PERCENT))
        )
    if high <= low:
        # An even image: grey, neither black nor white.
        low, high = low - 1.0, low + 1.0
    return Levels(low, high, least, greatest)


def choose_region(
    size: tuple[int, int], zoom: float = 1.0, centre: tuple[float, float] = (0.5, 0.5)
) -> Region:
    """Choose the part of an image that is shown.

    Parameters
    ----------
    size
        (width, height) of the image, px.
    zoom
        How many times larger than the whole; held between 1 and 32.
    centre
        Its middle as fractions of width and height; held so that the part lies in the image.
    """
    width, height = size
    if not all(math.isfinite(v) for v in (zoom, *centre)):
        raise InvalidValueError(f"a zoom of {zoom} at {centre}", expected="finite numbers")
    zoom = min(max(zoom, 1.0), _LARGEST_ZOOM)
    w, h = max(1, round(width / zoom)), max(1, round(height / zoom))
    x = min(max(round(centre[0] * width - 0.5 * w), 0), width - w)
    y = min(max(round(centre[1] * height - 0.5 * h), 0), height - h)
    return Region(x, y, w, h)


def _stretch(part: NDArray[Any], levels: Levels) -> NDArray[np.uint8]:
    """Grey levels of the screen."""
    if part.dtype == np.uint8:
        # A tenth of the time of the arithmetic below.
        return np.asarray(cv2.LUT(part, _table(np.uint8, levels)), dtype=np.uint8)
    if part.dtype == np.uint16:
        return np.take(_table(np.uint16, levels), part)
    return _scale_to_screen(part, levels)


@lru_cache(maxsize=4)
def _table(kind: type[np.uint8 | np.uint16], levels: Levels) -> NDArray[np.uint8]:
    # A few pages look at one stream, with levels that change with the picture at most.
    return _scale_to_screen(np.arange(np.iinfo(kind).max + 1, dtype=kind), levels)


def _scale_to_screen(values: NDArray[Any], levels: Levels) -> NDArray[np.uint8]:
    scale = 255.0 / (levels.high - levels.low)
    grey = (values.astype(np.float32) - np.float32(levels.low)) * np.float32(scale)
    shown: NDArray[np.uint8] = np.clip(np.nan_to_num(grey), 0.0, 255.0).astype(np.uint8)
    return shown


def encode_picture(
    image: NDArray[Any], levels: Levels, region: Region, width_px: int
) -> tuple[bytes, tuple[int, int]]:
    """Encode a part of an image as JPEG.

    Parameters
    ----------
    image
        (h, w), or (h, w, 3) in the channel order of OpenCV; of any real type.
    levels, region
        As chosen by the functions above.
    width_px
        How many pixels the page has for it; a smaller part keeps its own.

    Returns
    -------
    tuple
        The bytes, and the (width, height) of the picture in px.
    """
    part = image[region.y : region.y + region.height, region.x : region.x + region.width]
    if width_px < region.width:
        height_px = max(1, round(region.height * width_px / region.width))
        part = cv2.resize(part, (max(1, width_px), height_px), interpolation=cv2.INTER_AREA)
    shown = _stretch(part, levels)
    done, data = cv2.imencode(".jpg", shown, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
    assert done
    return bytes(data), (shown.shape[1], shown.shape[0])
