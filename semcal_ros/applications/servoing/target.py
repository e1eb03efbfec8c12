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

"""A planar target that shows some of its markers at every magnification.

Square markers of a coded dictionary lie in the eight outer cells of a 3 x 3 board; the middle cell
is the same board again, a third of the size, with other markers, and so on. A marker can be read
from about 20 px up to most of the field, a factor of about 20, so that at least two levels can be
read at any magnification. The origin, in the middle of all boards, is common to all.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.servoing.thresholds import LEVELS_MAX, MARKER_BITS, MARKER_SIDE, RATIO
from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.errors import InvalidValueError

# All cells of the 3 x 3 but the middle one.
CELLS: tuple[tuple[int, int], ...] = tuple(
    (column, row) for row in (-1, 0, 1) for column in (-1, 0, 1) if (column, row) != (0, 0)
)
"""(column, row) of the eight outer cells, in the order of their markers."""


@lru_cache(maxsize=1)
def dictionary() -> cv2.aruco.Dictionary:
    """Return the code of the markers: fifty of 4 x 4 bits, at least four bits apart."""
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


@dataclass(frozen=True)
class NestedTarget:
    """Markers in nested boards around the origin of the target.

    Parameters
    ----------
    largest_cell_m
        Side of a cell of the largest board, m; that board is three cells wide.
    levels
        Number of boards, 1 to 6.

    Raises
    ------
    InvalidValueError
        For a size that is not positive, or more levels than the code has markers for.
    """

    largest_cell_m: float = 180e-6
    levels: int = LEVELS_MAX

    def __post_init__(self) -> None:
        check_positive(self.largest_cell_m, "a target with cells of", "m")
        if not 1 <= self.levels <= LEVELS_MAX:
            raise InvalidValueError(
                f"a target with {self.levels} levels", expected=f"1 to {LEVELS_MAX}"
            )

    @property
    def size(self) -> int:
        """Number of markers, numbered 0 to ``size - 1``: eight per level, largest first."""
        return len(CELLS) * self.levels

    def cell_m(self, level: int) -> float:
        """Return the side of a cell of a level, m."""
        return self.largest_cell_m / float(RATIO**level)

    def corners_m(self, ids: NDArray[np.int64]) -> Array:
        """Return the corners (n, 4, 2) of markers in the frame of the target, m.

        They start top left in the code's orientation and go clockwise, x to the right and y down.
        """
        level, place = np.divmod(np.asarray(ids, dtype=np.int64), len(CELLS))
        cell = self.largest_cell_m / RATIO ** level.astype(np.float64)
        half = 0.5 * MARKER_SIDE
        around = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        centre = np.array(CELLS, dtype=np.float64)[place]
        corners: Array = (centre[:, None, :] + around) * cell[:, None, None]
        return corners

    def bits(self, marker: int) -> NDArray[np.uint8]:
        """Return the (6, 6) squares of a marker, row by row: 1 is white."""
        if not 0 <= marker < self.size:
            raise InvalidValueError(f"marker {marker}", expected=f"0 to {self.size - 1}")
        drawn = cv2.aruco.generateImageMarker(dictionary(), int(marker), MARKER_BITS)
        return np.asarray(np.asarray(drawn) > 127, dtype=np.uint8)
