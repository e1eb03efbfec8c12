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

"""Why two images do not match by one shift: what is seen when the question is put another way.

Only images that were rejected are looked at, at a reduced size, so that this costs little.
"""

from __future__ import annotations

import cv2
import numpy as np

from semcal_ros.core.arrays import Array, Image
from semcal_ros.core.registration.normalised_correlation import (
    CoarseReference,
    find_coarse_peaks,
    remove_shading,
)
from semcal_ros.core.registration.thresholds import (
    DEFORMATION_MIN,
    PART_CORRELATION_MIN,
    PART_DEVIATION_PX_MAX,
    PART_LEAD_MIN,
    PARTS,
    PARTS_FOUND_MIN,
    PARTS_SIDE_PX_MAX,
)
from semcal_ros.core.registration.tiles import Pyramid


def explain_mismatch(reference: CoarseReference, image: Pyramid, guess_px: Array) -> str:
    """Say what else would make images match of which no shift stands out, in words; empty where nothing does.

    Parameters
    ----------
    reference, image
        The images.
    guess_px
        (2,) predicted shift.
    """
    full = image.full
    negative = Pyramid(np.asarray(full.max() - full, dtype=full.dtype))
    if find_coarse_peaks(reference, negative, guess_px):
        return "contrast reversed: only the negative of the image fits"
    return explain_deformation(reference.pyramid, image)


def explain_deformation(reference: Pyramid, image: Pyramid) -> str:
    """Say how one image is strained or turned against another, in words; empty where it is not."""
    longest = max(*reference.full.shape, *image.full.shape)
    factor = 1 << max(0, int(np.ceil(np.log2(longest / PARTS_SIDE_PX_MAX))))
    whole, moved = (remove_shading(pyramid.at(factor)) for pyramid in (reference, image))
    places, shifts = _match_parts(whole, moved)
    if len(places) < PARTS_FOUND_MIN:
        return ""
    design = np.column_stack([places, np.ones(len(places))])
    found, *_ = np.linalg.lstsq(design, shifts, rcond=None)
    if np.sqrt(np.mean((shifts - design @ found) ** 2)) > PART_DEVIATION_PX_MAX:
        return ""
    gradient = found[:2].T
    turn = 0.5 * (gradient[1, 0] - gradient[0, 1])
    strain = 0.5 * (gradient + gradient.T)
    stretch = float(np.max(np.abs(np.linalg.eigvalsh(strain))))
    if max(stretch, abs(turn)) < DEFORMATION_MIN:
        return ""
    if abs(turn) > stretch:
        return f"turned by {np.degrees(turn):.1f} degrees: its parts fit, but not by one shift"
    return f"strained by {100.0 * stretch:.1f} %: its parts fit, but not by one shift"


def _match_parts(whole: Image, moved: Image) -> tuple[Array, Array]:
    """Middles (n, 2) of the parts of an image that are found elsewhere in the other, and their shifts (n, 2)."""
    height, width = (n // PARTS for n in moved.shape)
    places, shifts = [], []
    if min(height, width) < 8 or height > whole.shape[0] or width > whole.shape[1]:
        return np.zeros((0, 2)), np.zeros((0, 2))
    for row in range(PARTS):
        for column in range(PARTS):
            x, y = column * width, row * height
            part = moved[y : y + height, x : x + width]
            if float(part.std()) == 0.0:
                continue
            surface = cv2.matchTemplate(whole, part, cv2.TM_CCOEFF_NORMED)
            _, best, _, (found_x, found_y) = cv2.minMaxLoc(surface)
            # The neighbours of a maximum are nearly as high.
            around = np.s_[
                max(found_y - height // 4, 0) : found_y + height // 4 + 1,
                max(found_x - width // 4, 0) : found_x + width // 4 + 1,
            ]
            surface[around] = -1.0
            if best > PART_CORRELATION_MIN and best - float(surface.max()) > PART_LEAD_MIN:
                places.append([x + 0.5 * width, y + 0.5 * height])
                shifts.append([x - found_x, y - found_y])
    return np.array(places, dtype=np.float64).reshape(-1, 2), np.array(
        shifts, dtype=np.float64
    ).reshape(-1, 2)
