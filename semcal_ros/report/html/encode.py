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

"""Encode images and figures as data embedded in an HTML file."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image  # matplotlib writes its PNG files with it

from semcal_ros.core.arrays import Array, check_image
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.report.html.page import remove_control_characters

# Two dots of the file per CSS pixel of the page (96 per inch), so that figures are sharp on
# high-resolution screens.
_FIGURE_DPI = 192.0
# By the definition of CSS.
_CSS_PX_PER_INCH = 96.0
# How far from a point of a curve its value is told, CSS px: about the width of a finger.
_REACH_PX = 16.0
# Antialiased line drawings need no more colours; the file is three times smaller than in RGB.
_COLORS = 128
# Quality of JPEG files. Images given by the caller are the subject of a page, and get more.
_JPEG_QUALITY = 82
# Quality of images given by the caller.
_CALLER_QUALITY = 88
# Width of images given by the caller, px: that of a column of the page.
_CALLER_WIDTH = 640


@dataclass(frozen=True)
class Readings:
    """Values of curves at some places along their common horizontal axis.

    Attributes
    ----------
    axes
        The plots, above each other.
    x
        (n,) places, ascending, in data.
    texts
        What is told at each.
    """

    axes: Sequence[Axes]
    x: Array
    texts: Sequence[str]


@dataclass(frozen=True)
class ReadingArea:
    """A rectangle of an image, CSS px from its upper left corner, and what it tells."""

    x: float
    y: float
    width: float
    height: float
    text: str


@dataclass(frozen=True)
class Picture:
    """One image of a page.

    Attributes
    ----------
    src
        Data URI.
    alt
        What the image shows, for readers who cannot see it.
    caption
        Sentence below the image; may be empty.
    width, height
        Size in CSS px at which the text in the image has its normal size.
    strips
        Parts of the image that tell values when one points at them.
    """

    src: str
    alt: str
    caption: str
    width: int
    height: int
    strips: tuple[ReadingArea, ...] = ()


def encode_data_uri(kind: str, data: bytes) -> str:
    """Encode as ``data:image/<kind>;base64,...``."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def encode_figure(
    figure: Figure, alt: str, caption: str = "", readings: Readings | None = None
) -> Picture:
    """Encode a figure for a page, and clear it to free its memory."""
    width, height = figure.get_size_inches() * _CSS_PX_PER_INCH
    source = encode_data_uri("png", encode_png(figure, _FIGURE_DPI))
    # The layout is known once the figure has been drawn.
    strips = () if readings is None else _place(figure, readings)
    figure.clear()
    return Picture(source, alt, caption, round(float(width)), round(float(height)), strips)


def _place(figure: Figure, readings: Readings) -> tuple[ReadingArea, ...]:
    """Divide the plots into strips, one around each place."""
    scale = _CSS_PX_PER_INCH / figure.dpi
    boxes = [axes.get_window_extent() for axes in readings.axes]
    low, high = min(box.y0 for box in boxes), max(box.y1 for box in boxes)
    bottom = readings.axes[-1].get_ylim()[0]
    at = np.array([(float(x), bottom) for x in readings.x])
    px = readings.axes[-1].transData.transform(at)[:, 0]
    middles = 0.5 * (px[1:] + px[:-1])
    left = np.maximum(np.concatenate([[boxes[0].x0], middles]), px - _REACH_PX / scale)
    right = np.minimum(np.concatenate([middles, [boxes[0].x1]]), px + _REACH_PX / scale)
    top = figure.bbox.y1 - high

    def to_css(dots: float) -> float:
        return round(float(scale * dots), 1)

    return tuple(
        ReadingArea(to_css(first), to_css(top), to_css(last - first), to_css(high - low), text)
        for first, last, text in zip(left, right, readings.texts, strict=True)
    )


def encode_png(figure: Figure, dpi: float, *, keep_rare_colors: bool = False) -> bytes:
    """Encode a figure as a PNG file with a palette.

    Parameters
    ----------
    figure
        The figure.
    dpi
        Dots per inch.
    keep_rare_colors
        Let the few pixels of a coloured line keep their colour among the grey ones of a micrograph.
    """
    full = io.BytesIO()
    # Not compressed, as it is only passed on.
    figure.savefig(full, format="png", dpi=dpi, pil_kwargs={"compress_level": 0})
    method = Image.Quantize.MAXCOVERAGE if keep_rare_colors else Image.Quantize.MEDIANCUT
    with Image.open(full) as image:
        palette = image.convert("RGB").quantize(_COLORS, method, dither=Image.Dither.NONE)
    small = io.BytesIO()
    palette.save(small, format="png", optimize=True)
    return small.getvalue()


def convert_to_8_bits(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert any gray or three-channel (RGB) image to uint8.

    Eight-bit images keep their values; others are stretched between their 0.5 and 99.5 % quantiles.

    Raises
    ------
    InvalidValueError
        If the array is not an image: wrong number of dimensions or channels, empty, or without
        finite pixels.
    """
    array = check_image(image)
    if array.dtype == np.uint8:
        return np.asarray(array, dtype=np.uint8)
    values = array.astype(np.float64)
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise InvalidValueError("an image without finite pixels", expected="gray values")
    low, high = np.quantile(finite, [0.005, 0.995])
    scaled = (values - low) * (255.0 / max(float(high - low), 1e-300))
    return np.asarray(np.clip(np.nan_to_num(scaled, nan=0.0), 0.0, 255.0), dtype=np.uint8)


def shrink(image: NDArray[np.uint8], width: int) -> tuple[NDArray[np.uint8], float]:
    """Shrink an image to at most ``width`` px across and three times that down.

    Returns
    -------
    The image, and the factor by which it was scaled.
    """
    factor = min(1.0, width / image.shape[1], 3.0 * width / image.shape[0])
    if factor == 1.0:
        return image, 1.0
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8), factor


def encode_jpeg(image: NDArray[np.uint8], quality: int = _JPEG_QUALITY) -> bytes:
    """Encode a gray or RGB image as JPEG, for micrographs several times smaller than PNG."""
    ordered = image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
    ok, data = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise InvalidValueError(
            f"an image of shape {image.shape} that cannot be encoded", expected="an 8-bit image"
        )
    return bytes(data)


def encode_pictures(images: Sequence[tuple[str, NDArray[Any]]]) -> list[Picture]:
    """Encode (caption, image) pairs, gray or RGB of any depth, at most 640 px wide."""
    pictures = []
    for caption, image in images:
        small, _ = shrink(convert_to_8_bits(image), _CALLER_WIDTH)
        text = remove_control_characters(caption)
        src = encode_data_uri("jpeg", encode_jpeg(small, _CALLER_QUALITY))
        pictures.append(Picture(src, f"Image: {text}", text, small.shape[1], small.shape[0]))
    return pictures
