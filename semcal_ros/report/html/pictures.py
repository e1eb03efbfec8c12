"""Photographs of a page: images with captions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from semcal_ros.report.calibration.numbers import plain
from semcal_ros.report.html.encode import Picture, as_bytes_image, data_uri, jpeg_of, shrunk

__all__ = ["captioned_pictures"]

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
