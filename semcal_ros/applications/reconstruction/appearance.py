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

"""Images that keep the texture of the specimen and remove its shading.

The yield of secondary electrons grows with the slope of the surface, so shading stays with the
slope while the texture turns with the specimen: tracked features would be pulled against the
movement, most of all near the limb. Texture multiplies shading; after a square root (which also
makes shot noise uniform) and with the local mean and contrast divided out, only texture remains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Image, mad_sigma

__all__ = ["Appearance", "compute_log_grey", "convert_for_tracking", "prepare_appearance"]

# Second difference along both axes. Its squares sum to 1, so that it keeps the sigma of the noise.
_KERNEL = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=np.float32) / 6.0


@dataclass(frozen=True, eq=False)
class Appearance:
    """An image prepared for comparison with others.

    Attributes
    ----------
    smooth
        (h, w) square root of the grey level, slightly smoothed.
    texture
        (h, w) the same less its local mean, over its local contrast.
    noise
        1-sigma of the noise of a pixel before smoothing, in the unit of ``smooth``.
    smoothing_px
        Sigma of the smoothing.
    """

    smooth: Image
    texture: Image
    noise: float
    smoothing_px: float

    def corner_response(self, block: int = 7) -> tuple[Image, float]:
        """Compute the smaller eigenvalue of the structure tensor, and its mean for noise alone."""
        response = cv2.cornerMinEigenVal(self.smooth, block, ksize=3)
        # Sobel of size 3 is 8 derivatives; OpenCV divides by 4 and the block, and sums over the
        # block.
        gradient = self.noise**2 / (8.0 * math.pi * self.smoothing_px**4)
        return np.asarray(response, dtype=np.float32), 4.0 * gradient


def prepare_appearance(
    image: NDArray[Any], *, smoothing_px: float = 1.0, local_px: float = 6.0
) -> Appearance:
    """Extract the texture of a grey image (h, w) of any depth."""
    grey = np.sqrt(np.maximum(image.astype(np.float32), 0.0))
    noise = _estimate_noise(grey)
    smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), smoothing_px), dtype=np.float32)
    high = smooth - _blur_widely(smooth, local_px)
    power = _blur_widely(high * high, local_px)
    # Where there is only noise, it must not be amplified to look like texture.
    floor = noise**2 / (4.0 * math.pi * smoothing_px**2)
    texture = high / np.sqrt(power + np.float32(floor + 1e-12))
    return Appearance(smooth, np.asarray(texture, dtype=np.float32), noise, smoothing_px)


def compute_log_grey(image: NDArray[Any]) -> Image:
    """Compute the logarithm of a grey image (h, w) of any depth: shading adds to texture.

    Grey levels below what noise alone gives are raised to it: their logarithm has no bound.
    """
    grey = np.sqrt(np.maximum(image.astype(np.float32), 0.0))
    least = np.float32(max(_estimate_noise(grey), 1e-3))
    return np.asarray(2.0 * np.log(np.maximum(grey, least)), dtype=np.float32)


def convert_for_tracking(appearance: Appearance) -> NDArray[np.uint8]:
    """Convert the texture to an 8-bit image for OpenCV's tracker."""
    levels = np.rint(128.0 + 40.0 * appearance.texture)
    return np.asarray(np.clip(levels, 0, 255), dtype=np.uint8)


def _blur_widely(image: Image, sigma_px: float) -> Image:
    """Apply two running means, close to a Gaussian of this sigma; any width costs the same."""
    side = 2 * round(0.5 * math.sqrt(6.0 * sigma_px**2)) + 1
    once = cv2.blur(image, (side, side))
    return np.asarray(cv2.blur(once, (side, side)), dtype=np.float32)


def _estimate_noise(grey: Image) -> float:
    """Estimate pixel noise from second differences, free of most texture (Immerkaer 1996)."""
    rough = cv2.filter2D(grey, cv2.CV_32F, _KERNEL)[1:-1, 1:-1]
    return mad_sigma(rough)
