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

"""Commands to the stage, and motion that they do not explain."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.applications.servoing.thresholds import (
    COMMANDS_KEPT,
    DRIFT_FACTOR,
    GATE_SIGMAS,
    JUDGED_PX,
    ODD_MAX,
    TRAVEL_MAX,
    TRAVEL_MIN,
)
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError


class CommandHistory:
    """Commanded velocities, each valid from its time on; zero before the first."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=COMMANDS_KEPT)
        self._twists: deque[Array] = deque(maxlen=COMMANDS_KEPT)

    def add(self, time_s: float, twist: ArrayLike) -> None:
        """Add a command (3,): x, y in m/s, rotation in rad/s.

        Raises
        ------
        InvalidValueError
            If the command is not finite. A time before the last one counts as the last one.
        """
        values = np.array(twist, dtype=np.float64)
        if values.shape != (3,) or not np.all(np.isfinite([time_s, *values])):
            raise InvalidValueError(f"a command {values.tolist()}", expected="three finite numbers")
        self._times.append(max(time_s, self._times[-1]) if self._times else time_s)
        self._twists.append(values)

    def at(self, time_s: float) -> Array:
        """Return the command (3,) that is valid at a time."""
        valid = np.zeros(3)
        for begin, twist in zip(self._times, self._twists, strict=True):
            if begin > time_s:
                break
            valid = twist
        return valid

    def travel(self, first_s: float, last_s: float) -> Array:
        """Integrate commands to (3,) travel between two times, m, m, rad; negative if reversed."""
        if last_s < first_s:
            return -self.travel(last_s, first_s)
        way = np.zeros(3)
        ends = [*list(self._times)[1:], np.inf]
        for begin, end, twist in zip(self._times, ends, self._twists, strict=False):
            way += max(min(end, last_s) - max(begin, first_s), 0.0) * twist
        return way


class DisturbanceObserver:
    """Kalman filter, per axis, of the velocity that commands do not explain, such as drift.

    Parameters
    ----------
    sigma_m_s
        1-sigma of the velocity before anything is seen.
    change_m_s
        1-sigma of its change within a second.
    """

    def __init__(self, sigma_m_s: float, change_m_s: float) -> None:
        self._sigma, self._change = sigma_m_s, change_m_s
        self._odd = 0
        self.velocity_m_s: Array = np.zeros(2)
        self.variance: Array = np.full(2, sigma_m_s**2)

    def update(self, interval_s: float, unexplained_m: Array, variance_m2: Array) -> None:
        """Update the filter with motion in an interval that the commands do not explain.

        An innovation far beyond expectation is a knock on the stage and not drift, unless it
        persists.

        Parameters
        ----------
        interval_s
            Time between two frames.
        beside_m, variance_m2
            (2,) travel seen minus travel commanded, and its variance.
        """
        if interval_s <= 0.0:
            return
        self.variance = self.variance + self._change**2 * interval_s
        surprise = unexplained_m / interval_s - self.velocity_m_s
        spread = self.variance + variance_m2 / interval_s**2 + 1e-30
        if np.any(surprise**2 > GATE_SIGMAS**2 * spread):
            self._odd += 1
            if self._odd >= ODD_MAX:
                self.variance = np.full(2, (DRIFT_FACTOR * self._sigma) ** 2)
                self._odd = 0
            return
        self._odd = 0
        gain = self.variance / spread
        self.velocity_m_s = self.velocity_m_s + gain * surprise
        self.variance = (1.0 - gain) * self.variance


class StageMonitor:
    """Sum commanded and seen travel, and report when they are unrelated.

    A stage that does not move or has other axes than assumed, or an image that is stabilised while
    the stage moves, would be driven for ever, and with a wrong sign ever faster.
    """

    def __init__(self) -> None:
        self._path = self._along = self._squared = 0.0

    def update(self, commanded_px: Array, seen_px: Array) -> str:
        """Return what is wrong, or an empty text.

        Parameters
        ----------
        commanded_px, seen_px
            (2,) travel of the target between two frames as commanded and as seen, px.
        """
        self._path += float(np.hypot(commanded_px[0], commanded_px[1]))
        self._along += float(commanded_px @ seen_px)
        self._squared += float(commanded_px @ commanded_px)
        if self._path < JUDGED_PX:
            return ""
        share = self._along / self._squared
        self._path = self._along = self._squared = 0.0
        if TRAVEL_MIN <= share <= TRAVEL_MAX:
            return ""
        return (
            f"the image does not follow the stage: it moved by {share:.2f} of the commanded distance; check axes, topic"
            " and that the drift of each frame is added again"
        )
