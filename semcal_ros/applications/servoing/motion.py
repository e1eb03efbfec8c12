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
    RESPONSE_SIGMA,
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


class MotionObserver:
    """Kalman filter, per axis, of the drift and of how the stage responds to commands.

    A piezo stage without a sensor may go a third less or more than it is told, and along axes that are turned a little.
    That shows while it moves, and drift while it stands.

    Parameters
    ----------
    sigma_m_s
        1-sigma of the drift velocity before anything is seen.
    change_m_s
        1-sigma of its change within a second.

    Attributes
    ----------
    velocity_m_s
        (2,) drift velocity.
    excess
        (2, 2) response of the stage beyond the commanded travel: ``excess @ way`` is added to it.
    """

    def __init__(self, sigma_m_s: float, change_m_s: float) -> None:
        self._sigma, self._change = sigma_m_s, change_m_s
        self._odd = 0
        self.velocity_m_s: Array = np.zeros(2)
        self.excess: Array = np.zeros((2, 2))
        self._covariance = self._start(sigma_m_s)

    @staticmethod
    def _start(sigma_m_s: float) -> Array:
        """(2, 3, 3) covariance, for each axis, of the drift velocity and a row of the excess."""
        each = np.diag(np.square([sigma_m_s, RESPONSE_SIGMA, RESPONSE_SIGMA]))
        return np.array([each, each])

    def predict(self, interval_s: float, way_m: Array) -> tuple[Array, Array]:
        """Predict (2,) motion beyond the commanded travel (2,) of an interval, and its (2,) variance."""
        by_state = np.array([interval_s, *way_m])
        motion = self.velocity_m_s * interval_s + self.excess @ way_m
        return motion, np.asarray(by_state @ self._covariance @ by_state, dtype=np.float64)

    def update(
        self,
        interval_s: float,
        way_m: Array,
        unexplained_m: Array,
        variance_m2: Array,
        *,
        with_response: bool = True,
    ) -> None:
        """Update the filter with the motion of an interval.

        An innovation far beyond expectation is a knock on the stage and not drift, unless it
        persists.

        Parameters
        ----------
        interval_s
            Time between two frames.
        way_m
            (2,) travel commanded in it.
        unexplained_m, variance_m2
            (2,) travel seen minus that commanded, and its variance.
        with_response
            Whether it tells the response: a small command answers to drift, and to the noise of the frame before, which
            is in the travel seen as well. Otherwise the response stays as it is, with its share in the uncertainty of
            the drift (Schmidt-Kalman).
        """
        if interval_s <= 0.0:
            return
        self._covariance[:, 0, 0] += self._change**2 * interval_s
        expected, spread = self.predict(interval_s, way_m)
        innovation, spread = unexplained_m - expected, spread + variance_m2 + 1e-30
        if np.any(innovation**2 > GATE_SIGMAS**2 * spread):
            self._odd += 1
            if self._odd >= ODD_MAX:
                self._covariance = self._start(DRIFT_FACTOR * self._sigma)
                self._odd = 0
            return
        self._odd = 0
        by_state = np.array([interval_s, *way_m])
        for axis in range(2):
            gain = self._covariance[axis] @ by_state / spread[axis]
            if not with_response:
                gain[1:] = 0.0
            change = gain * innovation[axis]
            self.velocity_m_s[axis] += change[0]
            self.excess[axis] += change[1:]
            rest = np.eye(3) - np.outer(gain, by_state)
            noise = variance_m2[axis] * np.outer(gain, gain)
            self._covariance[axis] = rest @ self._covariance[axis] @ rest.T + noise

    def find_command(self, travel_m_s: Array) -> Array:
        """Return the (2,) command with which the stage moves at a velocity (2,).

        A stage that obeys as badly as :class:`StageMonitor` refuses gets the velocity itself, until that stops it.
        """
        response = np.eye(2) + self.excess
        along = np.linalg.eigvalsh(0.5 * (response + response.T))
        if along[0] < TRAVEL_MIN or along[1] > TRAVEL_MAX:
            return travel_m_s
        return np.asarray(np.linalg.solve(response, travel_m_s), dtype=np.float64)


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
