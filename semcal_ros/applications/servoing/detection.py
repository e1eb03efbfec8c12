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

"""Find the markers of a target in an image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.applications.servoing.sides import refine_quads
from semcal_ros.applications.servoing.target import NestedTarget, dictionary
from semcal_ros.core.arrays import Array, Mask, check_image

__all__ = ["TargetView", "find_target"]


# Larger images are averaged down by a whole factor to find the markers; their sides are then
# measured at full resolution.
_SEARCHED_PX = 1024
# Three pixels for each of the six squares along a side.
_SMALLEST_SIDE_PX = 18.0
# Sigma of the smoothing for the search: a third of the smallest square that can be read.
_NOISE_BLUR_PX = 1.0


@dataclass(frozen=True, eq=False)
class TargetView:
    """Markers of a target in one image.

    Attributes
    ----------
    ids
        (n,) numbers of the markers.
    target_xy_m
        (n, 4, 2) corners of the markers in the frame of the target, m.
    xy
        (n, 4, 2) the same corners in the image, px.
    covariance_px2
        (n, 8, 8) covariance of the four corners of each.
    reason
        Why there are no markers; empty if there are some.
    """

    ids: NDArray[np.int64]
    target_xy_m: Array
    xy: Array
    covariance_px2: Array
    reason: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the target was found."""
        return not self.reason

    def with_corners(self, xy: Array) -> TargetView:
        """Return the same markers with their corners (n, 4, 2) moved."""
        return TargetView(self.ids, self.target_xy_m, xy, self.covariance_px2, self.reason)

    def select(self, keep: Mask) -> TargetView:
        """Keep some of the markers."""
        return TargetView(
            self.ids[keep],
            self.target_xy_m[keep],
            self.xy[keep],
            self.covariance_px2[keep],
            self.reason,
        )


def find_target(image: ArrayLike, target: NestedTarget) -> TargetView:
    """Find the corners of all readable markers of ``target`` to a few hundredths of a pixel.

    Parameters
    ----------
    image
        (h, w) grey levels of integers or floats; markers are dark on white.
    target
        The target to find.

    Returns
    -------
    The markers; empty, with a reason, if the target is not in view or the image is blank.

    Raises
    ------
    InvalidValueError
        If the image is not a two-dimensional array of at least 32 x 32 px.
    """
    grey = check_image(image, channels=(1,), least_side=32)
    pixels = np.ascontiguousarray(grey, dtype=np.float32)
    if not np.all(np.isfinite(pixels)):
        return _reject("the image has values that are not finite")
    factor = -(-max(pixels.shape) // _SEARCHED_PX)
    stretched = _stretch(pixels, factor)
    if stretched is None:
        return _reject("image: blank")
    ids, corners = _search_markers(stretched, factor, target)
    if len(ids) == 0:
        return _reject("no marker of the target in view")
    refined = refine_quads(pixels, corners)
    if not np.any(refined.good):
        return _reject("no marker of the target with four straight sides")
    good = refined.good
    return TargetView(
        ids[good], target.corners_m(ids[good]), refined.xy[good], refined.covariance_px2[good]
    )


def _reject(reason: str) -> TargetView:
    return TargetView(
        np.empty(0, np.int64),
        np.empty((0, 4, 2)),
        np.empty((0, 4, 2)),
        np.empty((0, 8, 8)),
        reason,
    )


def _stretch(image: NDArray[np.float32], factor: int) -> NDArray[np.uint8] | None:
    """Convert to 8 bits with less noise for the search; return None for a blank image."""
    small = image
    if factor > 1:
        height, width = (side // factor for side in image.shape)
        cut = image[: height * factor, : width * factor]
        small = cut.reshape(height, factor, width, factor).mean(axis=(1, 3), dtype=np.float32)
    smooth = cv2.GaussianBlur(small, (0, 0), _NOISE_BLUR_PX)
    # Pixels that were not scanned are 0 in a rectified image and say nothing about the contrast.
    seen = smooth[smooth > 0.0]
    if seen.size < 1024:
        return None
    low, high = (float(v) for v in np.percentile(seen[:: max(seen.size // 65536, 1)], (1.0, 99.0)))
    if not high - low > 1e-6 * max(abs(high), abs(low)):
        return None
    scaled = np.clip((smooth - low) * (255.0 / (high - low)), 0.0, 255.0)
    return np.asarray(scaled, dtype=np.uint8)


@lru_cache(maxsize=1)
def _create_detector() -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    # A code with a wrong bit may just as well belong to another marker.
    parameters.errorCorrectionRate = 0.0
    parameters.minMarkerPerimeterRate = 0.04
    parameters.adaptiveThreshWinSizeMin = 5
    parameters.adaptiveThreshWinSizeMax = 45
    parameters.adaptiveThreshWinSizeStep = 20
    return cv2.aruco.ArucoDetector(dictionary(), parameters)


def _search_markers(
    image: NDArray[np.uint8], factor: int, target: NestedTarget
) -> tuple[NDArray[np.int64], Array]:
    """Find numbers (n,) and rough corners (n, 4, 2) of readable markers, px of the whole image."""
    found, numbers, _ = _create_detector().detectMarkers(image)
    if numbers is None or len(found) == 0:
        return np.empty(0, np.int64), np.empty((0, 4, 2))
    ids = np.asarray(numbers, dtype=np.int64).reshape(-1)
    corners = np.asarray(found, dtype=np.float64).reshape(-1, 4, 2)
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    # The same marker twice: one of them is something else, and nothing shows which.
    seen, count = np.unique(ids, return_counts=True)
    keep = (ids < target.size) & np.isin(ids, seen[count == 1])
    keep &= sides.min(axis=1) >= _SMALLEST_SIDE_PX
    return ids[keep], (corners[keep] + 0.5) * factor - 0.5
