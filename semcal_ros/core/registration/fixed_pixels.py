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

"""Registration without the pixels that do not show the specimen in one of two images.

What lies at the same place in all images, such as a data bar, a cross-hair or a burnt spot of the detector, pulls a
shift to zero, and whatever its place is filled with pulls it, too: by 0.1 px where it is a twentieth of the image.
These pixels take no part, those of the reference where they are, and those of the image where the shift takes them.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.registration.reference import Reference, Region
from semcal_ros.core.registration.thresholds import DROPPED_WITHIN_PX, SMEARED_PX
from semcal_ros.core.registration.tiles import drop_pixels


def grow_mask(mask: Mask, by_px: int) -> Mask:
    """The mask (h, w) enlarged by so many pixels along each axis."""
    kernel = np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)
    return np.asarray(cv2.dilate(np.ascontiguousarray(mask).view(np.uint8), kernel)).view(bool)


def drop_fixed_pixels(
    reference: Reference, fixed: Mask | None, region: Region | None, shift_px: Array
) -> Reference:
    """A reference without its own fixed pixels, and without those that an image shows at a shift.

    Parameters
    ----------
    reference
        The reference.
    fixed
        (h, w) True at the pixels of the image that do not show the specimen; None where all do.
    region
        The part of the image that is compared; None for all of it.
    shift_px
        (2,) by how much further right and down the image shows what the reference shows, in px of the whole images.

    Returns
    -------
    The reference itself where there is nothing to drop.
    """
    if not reference.levels or (fixed is None and reference.fixed is None):
        return reference
    level = reference.levels[-1]
    if level.factor != 1:
        return reference
    width, height = level.size
    dropped = np.zeros((height, width), dtype=bool)
    reach = SMEARED_PX + int(np.ceil(level.sigma_px))
    if reference.fixed is not None:
        dropped |= grow_mask(reference.fixed, reach)
    if fixed is not None:
        left, top, right, bottom = region or (0, 0, fixed.shape[1], fixed.shape[0])
        around = grow_mask(fixed[top:bottom, left:right], reach + DROPPED_WITHIN_PX)
        origin = np.subtract((left, top), reference.region[:2])
        # Where the reference shows what the image shows at its corner.
        x, y = (int(v) for v in np.rint(origin - np.asarray(shift_px)))
        across, down = (
            slice(max(x, 0), max(x + right - left, 0)),
            slice(max(y, 0), max(y + bottom - top, 0)),
        )
        part = dropped[down, across]
        part |= around[max(-y, 0) :, max(-x, 0) :][: part.shape[0], : part.shape[1]]
    if not np.any(dropped):
        return reference
    levels = [drop_pixels(level, dropped)]
    for coarser in reference.levels[-2::-1]:
        # What fills their place would pull the start, too, by enough for one more step at full resolution.
        dropped = _halve(dropped)
        more = SMEARED_PX + int(np.ceil(coarser.sigma_px)) - reach // coarser.factor
        levels.insert(0, drop_pixels(coarser, grow_mask(dropped, max(more, 0))))
    return replace(reference, levels=tuple(levels), whole=reference.whole or reference)


def _halve(mask: Mask) -> Mask:
    """(h // 2, w // 2) the squares of 2 px of a mask (h, w) of which any pixel is True."""
    height, width = (n // 2 * 2 for n in mask.shape)
    even, odd = mask[0:height:2, :width], mask[1:height:2, :width]
    lines = even | odd
    return np.asarray(lines[:, 0::2] | lines[:, 1::2])
