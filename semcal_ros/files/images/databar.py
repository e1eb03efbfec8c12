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

"""Find the bar with text that a microscope writes below a picture, where no metadata tell its height.

A scanned row has noise, so that none of its grey values is the commonest by far. A row of a bar is mostly of one
value, that of its background.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["find_databar", "is_blank_above"]

# Part of a row that has its commonest value: in bars at least a half, but where text is dense; in pictures of 8 bits at
# most a third, but where they are clipped.
_OF_BAR, _OF_BAR_TYPICALLY, _OF_PICTURE = 0.45, 0.6, 0.4
# Rows of a bar, at least and as a part of the picture at most.
_FEWEST, _LARGEST_PART = 8, 0.25


def is_blank_above(image: NDArray[Any]) -> bool:
    """Whether the upper half of an image is even, as of a blanked beam: a bar would differ from nothing there."""
    upper = image[: (len(image) + 1) // 2]
    return bool(upper.min() == upper.max())


def find_databar(image: NDArray[Any]) -> int:
    """Return the number of rows of a bar at the bottom, 0 where there is none.

    Parameters
    ----------
    image
        (h, w) grey levels of 8 or 16 bits, as stored.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        return 0
    height = len(image)
    most = int(_LARGEST_PART * height)
    looked = image[height - min(2 * most, height) :]
    share = np.array([np.bincount(row).max() for row in looked]) / image.shape[1]
    low = np.flatnonzero(share < _OF_BAR)
    rows = len(share) - 1 - int(low[-1]) if len(low) else len(share)
    if not _FEWEST <= rows <= most or np.median(share[-rows:]) < _OF_BAR_TYPICALLY:
        return 0
    above = share[max(0, len(share) - 2 * rows) : len(share) - rows]
    return rows if np.median(above) < _OF_PICTURE else 0
