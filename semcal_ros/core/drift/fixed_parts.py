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

"""What stays at its place in the image while the specimen drifts: burnt spots of a detector, dirt, a tool at rest.

It has the noise of the electrons, so that it is not found as what is drawn is (:mod:`.overlay`). Two images between
which the specimen drifted are compared pixel by pixel, at the same place and at that to which the specimen moved: what
stays agrees at the first and not at the second.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semcal_ros.core.arrays import AnyImage, Array, Image, Mask
from semcal_ros.core.drift.thresholds import (
    FIXED_ENLARGED_PX,
    FIXED_MOVE_PX_MIN,
    FIXED_PIXELS_MIN,
    FIXED_RATIO_MIN,
    FIXED_SHARE_MAX,
    FIXED_SQUARE_PX,
    GRADIENTS_ALLOWED,
    GRADIENTS_SMOOTHED_PX,
    ROUNDING_VARIANCE,
)
from semcal_ros.core.registration.agreement import keep_bodies
from semcal_ros.core.registration.fixed_pixels import grow_mask


@dataclass(frozen=True)
class FixedParts:
    """What two images show of what stays in place.

    Attributes
    ----------
    stays
        (h, w) True where the images agree at the same place, and not at that to which the specimen moved.
    moves
        (h, w) True where they agree at the latter, and not at the former.
    """

    stays: Mask
    moves: Mask


def find_fixed_parts(before: AnyImage, now: AnyImage, shift_px: Array) -> FixedParts | None:
    """Find what stays in place between two images of one size, (h, w) or (h, w, 3).

    Parameters
    ----------
    before, now
        The images as they were scanned.
    shift_px
        (2,) by how much the specimen moved between them, px.

    Returns
    -------
    None where nothing can be told: of different sizes, of a shift below
    :data:`~semcal_ros.core.drift.thresholds.FIXED_MOVE_PX_MIN` or beyond half of the image, or where the shift is in
    doubt: so much would stay, or the rest of the image agrees better at the same place than at that to which it moved.

    It fails where the specimen repeats by the shift.
    """
    if before.shape != now.shape or np.hypot(*shift_px) < FIXED_MOVE_PX_MIN:
        return None
    first, second = to_levels(before), to_levels(now)
    height, width = first.shape
    if np.any(np.abs(shift_px) > 0.5 * np.array([width, height])):
        return None
    in_place = _sum_squares(second - first)
    # What lay at x before is seen at x + shift now: look at both of them from each place.
    moved = np.full((2, height, width), np.inf, dtype=np.float32)
    for k, (image, other, sign) in enumerate(((second, first, -1.0), (first, second, 1.0))):
        there = look_beside(other, sign * shift_px)
        covered = cv2.warpAffine(
            np.ones_like(other),
            _shift_matrix(sign * shift_px),
            (width, height),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        )
        squares = _sum_squares(image - there)
        inside = (
            cv2.erode(
                covered,
                np.ones((FIXED_SQUARE_PX + 4, FIXED_SQUARE_PX + 4), np.uint8),
                borderValue=0,
            )
            > 0
        )
        moved[k][inside] = squares[inside]
    known = np.isfinite(moved).all(axis=0)
    stays = known & (moved.min(axis=0) > FIXED_RATIO_MIN * in_place)
    moves = known & (in_place > FIXED_RATIO_MIN * moved.max(axis=0))
    stays = keep_bodies(stays, FIXED_PIXELS_MIN)
    if float(np.mean(stays)) > FIXED_SHARE_MAX:
        return None
    enlarged = grow_mask(stays, FIXED_ENLARGED_PX)
    if not _has_moved(first, second, shift_px, known & ~enlarged):
        return None
    return FixedParts(enlarged, np.asarray(moves & ~enlarged))


def _has_moved(first: Image, second: Image, shift_px: Array, rest: Mask) -> bool:
    """Whether the ``rest`` of two images agrees better at the place to which it moved than at the same place.

    They are smoothed: interpolation takes away less of what noise is left then, and does not make the moved one agree.
    """
    sigma = GRADIENTS_SMOOTHED_PX
    one, two = (
        np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)
        for image in (first, second)
    )
    there = look_beside(one, -shift_px)
    squares = [np.sum((two - other)[rest] ** 2, dtype=np.float64) for other in (there, one)]
    return bool(squares[0] < squares[1])


def _shift_matrix(shift_px: Array) -> Array:
    x, y = shift_px.tolist()
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y]])


def look_beside(image: Image, shift_px: Array) -> Image:
    """What an image shows ``shift_px`` (2,) beside each pixel."""
    there = cv2.warpAffine(
        image,
        _shift_matrix(shift_px),
        image.shape[::-1],
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(there, dtype=np.float32)


def share_of_gradients(image: AnyImage, part: Mask) -> float:
    """The part of the squared gradients of an image (h, w) or (h, w, 3) that lies in ``part`` (h, w), 0 to 1.

    A shift is pulled to that of the part by as much of the difference. The image is smoothed against noise, which has
    gradients, too; those that are left are allowed for by a factor of two.
    """
    smoothed = cv2.GaussianBlur(to_levels(image), (0, 0), GRADIENTS_SMOOTHED_PX)
    squares = (
        cv2.Sobel(smoothed, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(smoothed, cv2.CV_32F, 0, 1) ** 2
    )
    whole = float(np.sum(squares, dtype=np.float64))
    inside = float(np.sum(squares[part], dtype=np.float64))
    return min(1.0, GRADIENTS_ALLOWED * inside / max(whole, 1e-30))


def to_levels(image: AnyImage) -> Image:
    """(h, w) grey levels of an image (h, w) or (h, w, 3), in single precision."""
    gray = image if image.ndim == 2 else image[..., 1]
    return np.asarray(gray, dtype=np.float32)


def _sum_squares(difference: Image) -> Image:
    size = (FIXED_SQUARE_PX, FIXED_SQUARE_PX)
    found = cv2.boxFilter(difference**2, cv2.CV_32F, size, normalize=True)
    return np.asarray(found + np.float32(ROUNDING_VARIANCE))
