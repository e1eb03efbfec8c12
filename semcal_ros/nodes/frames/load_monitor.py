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

"""Decides whether a stream leaves enough time to measure the drift of every frame before publishing it."""

from __future__ import annotations

import math

from semcal_ros.core.errors import InvalidValueError

# Weight of the newest value in a running mean: the mean follows a change within about ten frames
# and hides a single slow one.
_WEIGHT = 0.1
# Number of intervals after which their mean counts; the first interval may include the publisher's start.
_LEAST_INTERVALS = 2
# Fractions of the interval: rectifying and publishing need the rest. Above the first, not every frame is measured any
# more; below the second, every frame is again. The gap keeps a stream at the limit from switching with every frame.
_TOO_MUCH, _LITTLE_ENOUGH = 0.6, 0.4


class LoadMonitor:
    """Compares the time that a measurement takes with the interval between frames.

    Both are running means. Until there are enough frames to decide, every frame is measured.

    Examples
    --------
    >>> load = LoadMonitor()
    >>> for _ in range(20):
    ...     load.add_interval(0.005)
    ...     load.add_cost(0.010)
    >>> load.keeps_up
    False
    """

    def __init__(self) -> None:
        self._interval_s: float | None = None
        self._cost_s: float | None = None
        self._frames = 0
        self._keeps_up = True

    @property
    def keeps_up(self) -> bool:
        """Whether a measurement fits between two frames, with room for the rest of the work."""
        return self._keeps_up

    @property
    def turn_s(self) -> float:
        """Mean time from one frame that can be measured to the next, s; infinite before it is known."""
        if self._interval_s is None or self._cost_s is None:
            return math.inf
        return self._interval_s + self._cost_s

    @property
    def cost_s(self) -> float:
        """Mean time of a measurement, s; NaN before the first."""
        return math.nan if self._cost_s is None else self._cost_s

    def add_interval(self, interval_s: float) -> None:
        """Add the interval between the publications of two successive frames, s.

        Raises
        ------
        InvalidValueError
            If it is negative or not finite.
        """
        self._interval_s = _mean(self._interval_s, _check(interval_s))
        self._frames += 1
        self._decide()

    def add_cost(self, cost_s: float) -> None:
        """Add the duration of a measurement, s; raises as :meth:`add_interval`."""
        self._cost_s = _mean(self._cost_s, _check(cost_s))
        self._decide()

    def _decide(self) -> None:
        if self._interval_s is None or self._cost_s is None or self._frames < _LEAST_INTERVALS:
            return
        share = _LITTLE_ENOUGH if not self._keeps_up else _TOO_MUCH
        self._keeps_up = self._cost_s <= share * self._interval_s


def _check(seconds: float) -> float:
    if not 0.0 <= seconds < math.inf:
        raise InvalidValueError(f"a time of {seconds} s", expected="a finite number >= 0")
    return seconds


def _mean(before: float | None, now: float) -> float:
    return now if before is None else before + _WEIGHT * (now - before)
