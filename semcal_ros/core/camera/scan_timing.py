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

as ``doc/drift_and_rectification.md``, "Raster timing", says. A frame averaged from several passes shows the mean over
the passes. Where each line is scanned n times before the next one, its time ``T / rows`` is that of n lines, and the
pixel shows their mean. A recursive average ``y_k = y_(k-1) + (x_k - y_(k-1)) / N`` of passes x shows what was N - 1
passes ago on average.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.camera.thresholds import FRAME_TIME_MAX_S
from semcal_ros.core.errors import InvalidValueError


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
    line_averages
        Number of times that each line is scanned before the next one; all of them are part of the frame time.
    recursive_averages
        N of a recursive average of passes; 1 for none. The stamp is that of the latest pass.
    bidirectional
        Whether odd lines, 0 being even, are scanned backwards.
    """

    frame_time_s: float
    averages: int = 1
    flyback_fraction: float = 0.0
    line_averages: int = 1
    recursive_averages: int = 1
    bidirectional: bool = False

    def __post_init__(self) -> None:
        check_positive(self.frame_time_s, "frame time", "s")
        if self.frame_time_s > FRAME_TIME_MAX_S:
            raise InvalidValueError(
                f"frame time {self.frame_time_s:g} s",
                expected=f"at most {FRAME_TIME_MAX_S:g} s",
                do="state the unit, as in --frame-time 500ms",
            )
        if self.averages < 1:
            raise InvalidValueError(f"{self.averages} averaged passes", expected="at least 1")
        if self.line_averages < 1:
            raise InvalidValueError(f"{self.line_averages} scans of a line", expected="at least 1")
        if self.recursive_averages < 1:
            raise InvalidValueError(
                f"a recursive average of {self.recursive_averages} passes", expected="at least 1"
            )
        if self.averages > 1 and self.recursive_averages > 1:
            raise InvalidValueError(
                f"{self.averages} averaged passes and a recursive average of {self.recursive_averages}",
                expected="one of the two",
                do="set averages or recursive_averages to 1",
            )
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
        """Seconds from the stamp (start of the first pass, or of the latest one of a recursive average) to the
        centre of the acquisition.
        """
        return 0.5 * self.acquisition_time_s - self._lag_s

    @property
    def _lag_s(self) -> float:
        """Mean age of a recursive average beyond its latest pass, s."""
        return (self.recursive_averages - 1) * self.frame_time_s

    @property
    def pass_variance_s2(self) -> float:
        """Variance of the times at which the averaged passes acquire one pixel, s^2; 0 for a recursive average,
        in which an acceleration over that many passes cannot be told from a drift.
        """
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
        passes_s = 0.5 * (self.averages - 1) * self.frame_time_s - self._lag_s
        within_line = np.asarray(col, dtype=np.float64) / cols
        if self.bidirectional:
            # The mean of two neighbours: times that alternate from line to line, by half a line at most, would give
            # a map that does, too, and differs by the drift in that time.
            within_line = np.full_like(within_line, 0.5)
        within_line = within_line * (1.0 - self.flyback_fraction)
        if self.line_averages > 1:
            within_line = (within_line + 0.5 * (self.line_averages - 1)) / self.line_averages
        return passes_s + line_s * (np.asarray(row, dtype=np.float64) + within_line)
