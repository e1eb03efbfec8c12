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

"""When each pixel of a scanned frame was acquired.

The beam visits pixels one after the other, so a frame has no single time: with a frame period ``T``
over ``rows`` lines and a flyback that takes the fraction ``f`` of each line, pixel (row, col) of
pass ``k`` is acquired at

    t = t0 + k T + row T / rows + (col / width) (T / rows) (1 - f)

(design section 7). A frame averaged from several passes shows the mean over the passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.errors import InvalidValueError

__all__ = ["ScanTiming"]


@dataclass(frozen=True)
class ScanTiming:
    """Raster timing of one microscope setting.

    Parameters
    ----------
    frame_time_s
        Seconds for one pass over the frame.
    averages
        Number of passes that are averaged into one image.
    flyback_fraction
        Part of the line period, in [0, 1), in which the beam returns and nothing is recorded.
    """

    frame_time_s: float
    averages: int = 1
    flyback_fraction: float = 0.0

    def __post_init__(self) -> None:
        check_positive(self.frame_time_s, "frame time", "s")
        if self.averages < 1:
            raise InvalidValueError(f"{self.averages} averaged passes", expected="at least 1")
        if not 0 <= self.flyback_fraction < 1:
            raise InvalidValueError(
                f"flyback fraction {self.flyback_fraction}", expected="a number in [0, 1)"
            )

    @property
    def acquisition_time_s(self) -> float:
        """Seconds from the first pixel of the first pass to the end of the last pass."""
        return self.frame_time_s * self.averages

    @property
    def centre_offset_s(self) -> float:
        """Seconds from the stamp (start of the first pass) to the centre of the acquisition."""
        return 0.5 * self.acquisition_time_s

    @property
    def pass_variance_s2(self) -> float:
        """Variance of the times at which the passes acquire one pixel, s^2."""
        return self.frame_time_s**2 * (self.averages**2 - 1) / 12.0

    def pixel_offset_s(self, row: ArrayLike, col: ArrayLike, rows: int, cols: int) -> Array:
        """Return the mean time of pixels over all passes, in seconds after the stamp.

        Parameters
        ----------
        row, col
            Pixel coordinates (may be fractional), of one broadcastable shape.
        rows, cols
            Size of the frame in pixels.
        """
        line_s = self.frame_time_s / rows
        passes_s = 0.5 * (self.averages - 1) * self.frame_time_s
        within_line = np.asarray(col, dtype=np.float64) / cols * (1.0 - self.flyback_fraction)
        return passes_s + line_s * (np.asarray(row, dtype=np.float64) + within_line)
