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

"""Ordinary image files of one image each: PNG, JPEG, BMP, GIF, WebP."""

from __future__ import annotations

import warnings
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from semcal_ros.core.errors import BagError

__all__ = ["PLAIN_IMAGES", "describe_plain_image", "read_plain_image"]

#: Suffixes of these files.
PLAIN_IMAGES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".gif", ".webp"})

# EXIF: the directory of the camera, and in it the time of the exposure.
_CAMERA, _TAKEN = 0x8769, 0x9003
# The rows of the sensor, however the camera was held.
_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def describe_plain_image(path: Path) -> tuple[tuple[int, int], datetime | None]:
    """Return the (width, height) of an image, and when it was taken, where a camera wrote that down.

    Raises
    ------
    BagError
        The file cannot be read, or is no image.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd metadata, and of large images
            with Image.open(path) as image:
                taken = image.getexif().get_ifd(_CAMERA).get(_TAKEN)
                size = image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        reason = getattr(error, "strerror", None)
        raise BagError(
            f"{path}: {reason}" if reason else f"{path}: not a readable image",
            expected="an intact 8 or 16 bit image file",
        ) from error
    try:
        return size, datetime.strptime(str(taken), "%Y:%m:%d %H:%M:%S")  # local time
    except ValueError:
        return size, None


def read_plain_image(path: Path) -> NDArray[Any]:
    """Read the grey values of an image file, 8 or 16 bit.

    Raises
    ------
    BagError
        The file cannot be read or decoded, or has another depth.
    """
    try:
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise BagError(f"{path}: {error.strerror or error}", expected="a readable image") from error
    try:
        image = cv2.imdecode(data, _AS_STORED) if len(data) else None
    except cv2.error:
        image = None  # OpenCV raises for absurd sizes
    if image is None or image.dtype.name not in ("uint8", "uint16"):
        raise BagError(f"{path}: not a readable image", expected="an intact 8 or 16 bit image file")
    return image
