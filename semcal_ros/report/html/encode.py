"""Pictures as data that an HTML file carries in itself."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image  # matplotlib writes its PNG files with it

from semcal_ros.core.arrays import check_image
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.report.calibration.numbers import plain

__all__ = [
    "Picture",
    "as_bytes_image",
    "captioned_pictures",
    "data_uri",
    "jpeg_of",
    "picture_of_figure",
    "shrunk",
]

# Two dots of the file per CSS pixel of the page (96 per inch), so that pictures are sharp on fine
# screens.
_FIGURE_DPI = 192.0
_CSS_PX_PER_INCH = 96.0
_JPEG_QUALITY = 82
# Line drawings with soft edges need no more colours; the file is three times smaller than in RGB.
_COLORS = 128


@dataclass(frozen=True)
class Picture:
    """One picture of a page.

    Attributes
    ----------
    src
        Data URI.
    alt
        What the picture shows, for those who cannot see it.
    caption
        Sentence below the picture; may be empty.
    width, height
        Size in CSS px at which the text in the picture has its normal size.
    """

    src: str
    alt: str
    caption: str
    width: int
    height: int


def data_uri(kind: str, data: bytes) -> str:
    """``data:image/<kind>;base64,...``"""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def picture_of_figure(figure: Figure, alt: str, caption: str = "") -> Picture:
    """The figure as a PNG picture; the figure is emptied afterwards, so that its memory is free."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=_FIGURE_DPI)
    width, height = figure.get_size_inches() * _CSS_PX_PER_INCH
    figure.clear()
    with Image.open(drawn) as image:
        few = image.convert("RGB").quantize(
            _COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
        )
    small = io.BytesIO()
    few.save(small, format="png", optimize=True)
    return Picture(
        data_uri("png", small.getvalue()), alt, caption, round(float(width)), round(float(height))
    )


def as_bytes_image(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Any gray or three-channel (RGB) image as uint8.

    Eight-bit images keep their values; others are stretched between their 0.5 and 99.5 % quantiles.

    Raises
    ------
    InvalidValueError
        For an array that is no image: wrong number of dimensions or channels, empty, or without
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


def shrunk(image: NDArray[np.uint8], width: int) -> tuple[NDArray[np.uint8], float]:
    """The image at most ``width`` px wide and three times as high, and its scale factor."""
    factor = min(1.0, width / image.shape[1], 3.0 * width / image.shape[0])
    if factor == 1.0:
        return image, 1.0
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8), factor


def jpeg_of(image: NDArray[np.uint8], quality: int = _JPEG_QUALITY) -> bytes:
    """JPEG file of a gray or RGB image: noisy micrographs are several times smaller than as PNG."""
    ordered = image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
    ok, data = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise InvalidValueError(
            f"an image of shape {image.shape} that cannot be encoded", expected="an 8-bit image"
        )
    return bytes(data)


_MAX_WIDTH = 640
_QUALITY = 88


def captioned_pictures(images: Sequence[tuple[str, NDArray[Any]]]) -> list[Picture]:
    """(caption, image) pairs, gray or RGB of any depth, at most 640 px wide."""
    pictures = []
    for caption, image in images:
        small, _ = shrunk(as_bytes_image(image), _MAX_WIDTH)
        text = plain(caption)
        src = data_uri("jpeg", jpeg_of(small, _QUALITY))
        pictures.append(Picture(src, f"Image: {text}", text, small.shape[1], small.shape[0]))
    return pictures
