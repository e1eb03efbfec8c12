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

"""An image of the corners that were detected."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

# Green, in OpenCV's order of blue, green, red.
_FOUND_BGR = (0, 220, 0)
_REFUSED_BGR = (0, 0, 255)  # pure red


def corner_overlay(
    image: NDArray[Any], corners_xy: ArrayLike, refused: str = ""
) -> NDArray[np.uint8]:
    """Draw the image in grey with a circle around every corner.

    Parameters
    ----------
    image
        (h, w) grey values of any depth; they are stretched to 8 bits between their 0.5 and 99.5 percentiles.
    corners_xy
        (n, 2) corners, px.
    refused
        Why the view is not used; written into the image, with a red frame.

    Returns
    -------
    (h, w, 3) bgr8 image.
    """
    low, high = np.percentile(image, (0.5, 99.5))
    scale = 255.0 / max(float(high - low), 1e-12)
    grey = np.clip((image.astype(np.float32) - np.float32(low)) * np.float32(scale), 0, 255)
    drawn = np.ascontiguousarray(np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2))
    height, width = drawn.shape[:2]
    radius = max(3, width // 160)
    for x, y in np.asarray(corners_xy, dtype=np.float64).reshape(-1, 2):
        cv2.circle(drawn, (round(x), round(y)), radius, _FOUND_BGR, 1, cv2.LINE_AA)
    if refused:
        cv2.rectangle(drawn, (0, 0), (width - 1, height - 1), _REFUSED_BGR, 3)
        place = (8, height - 12)
        cv2.putText(drawn, refused, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, _REFUSED_BGR, 1)
    return drawn
