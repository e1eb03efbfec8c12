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

"""Ordinary image files, which do not contain their common magnification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.errors import BagError

__all__ = ["PLAIN_IMAGES", "plain_image_paths", "read_plain_image"]

PLAIN_IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".gif", ".webp"}


def plain_image_paths(path: Path) -> list[Path]:
    """Return the image files of a folder in the order of their names, or the one file."""
    listed = sorted(path.iterdir()) if path.is_dir() else [path]
    return [p for p in listed if p.is_file() and p.suffix.lower() in PLAIN_IMAGES]


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
        image = (
            cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) if len(data) else None
        )
    except cv2.error:
        image = None  # OpenCV raises for absurd sizes
    if image is None or image.dtype.name not in ("uint8", "uint16"):
        raise BagError(f"{path}: not a readable image", expected="an intact 8 or 16 bit image file")
    return image
