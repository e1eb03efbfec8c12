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

"""Images averaged down by whole factors."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError


def bin_image(image: AnyImage, camera: ScanCamera, largest_px: int) -> tuple[AnyImage, ScanCamera]:
    """An image with no side longer than ``largest_px``, and the camera that takes it.

    Square blocks of pixels are averaged. Rows and columns at the bottom and on the right that do not
    fill a block are left out.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3) of uint8, uint16 or float32.
    camera
        Its camera, of any size.
    largest_px
        Longest side wanted, px.

    Returns
    -------
    The image itself where it is not longer, and the camera for the size of what is returned.

    Raises
    ------
    InvalidValueError
        If ``largest_px`` is less than 1.
    """
    if largest_px < 1:
        raise InvalidValueError(f"a longest side of {largest_px} px", expected="at least 1 px")
    height, width = image.shape[:2]
    fitted = camera.resized(width, height)
    factor = -(-max(width, height) // largest_px)
    small = width // factor, height // factor
    if factor == 1 or min(small) < 1:
        return image, fitted
    kept = small[0] * factor, small[1] * factor
    blocks = cast("NDArray[np.uint8]", image[: kept[1], : kept[0]])
    binned = cv2.resize(blocks, small, interpolation=cv2.INTER_AREA)
    # What is left out at the far ends moves no other pixel.
    cropped = replace(fitted, width=kept[0], height=kept[1])
    return np.asarray(binned), cropped.resized(*small)
