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

"""What a node counts and says about the messages that it handles."""

from __future__ import annotations

import time
import traceback
from pathlib import Path
from typing import Any

import cv2
import rclpy.utilities
from rclpy.clock import Clock

from semcal_ros.bridge.diagnostics import StreamStatistics
from semcal_ros.core.errors import SemcalError

NODE_ERRORS = (SemcalError, cv2.error)
"""What a message can cause; a node counts it, reports it and goes on."""

# Often enough for a user who opens the log, seldom enough to leave the rest of it readable.
_LOG_AGAIN_S = 10.0
# Different warnings within this time, so that one whose numbers change does not flood the log.
_LOGGED_AT_ONCE = 100
# A stamp that differs by more is from another clock, such as that of a replay without simulated time: no stream is
# an hour late, and recordings are older.
_OTHER_CLOCK_S = 3600.0


class Reporter:
    """Counts messages, keeps values for the diagnostics, and logs without flooding.

    Parameters
    ----------
    logger
        The logger of the node.
    clock
        The clock of the node; stamps are compared with it.
    """

    def __init__(self, logger: Any, clock: Clock) -> None:
        self.statistics = StreamStatistics()
        self._logger = logger
        self._clock = clock
        self._logged: dict[str, float] = {}

    def note(self, key: str, value: bool | float | str) -> None:
        """Keep a value for the diagnostics."""
        self.statistics.note(key, value)

    def forget(self, key: str) -> None:
        """Leave a value out of the diagnostics from now on."""
        self.statistics.forget(key)

    def info(self, text: str) -> None:
        """Log what a user may want to know."""
        self._logger.info(_printable(text))

    def warn(self, text: str) -> None:
        """Log a warning."""
        self._logger.warning(_printable(text))

    def warn_seldom(self, text: str) -> None:
        """Log a warning unless the same one was logged in the last seconds."""
        now_s = time.monotonic()
        if now_s - self._logged.get(text, -_LOG_AGAIN_S) < _LOG_AGAIN_S:
            return
        if len(self._logged) >= _LOGGED_AT_ONCE:
            recent = {t: s for t, s in self._logged.items() if now_s - s < _LOG_AGAIN_S}
            self._logged = recent
            if len(recent) >= _LOGGED_AT_ONCE:
                return
        self._logged[text] = now_s
        self.warn(text)

    def reject(self, error: Exception) -> None:
        """Count an unusable message and log its reason, though not again and again."""
        reason = _printable(" ".join(str(error).split()))
        self.statistics.reject(reason)
        self.warn_seldom(reason)

    def blame_itself(self, error: Exception) -> None:
        """Count a message on which the node itself failed, and log where, though not again and again; raises as
        :func:`describe_fault`.
        """
        self.reject(RuntimeError(describe_fault(error)))

    def count_received(self) -> None:
        """Count a frame that has come in."""
        self.statistics.receive(time.monotonic())

    def count_published(self, stamp_ns: int | None) -> None:
        """Count a result, with its latency where the stamp is from this clock."""
        latency_s: float | None = None
        if stamp_ns is not None:
            latency_s = (self._clock.now().nanoseconds - stamp_ns) * 1e-9
            if abs(latency_s) > _OTHER_CLOCK_S:
                latency_s = None
        self.statistics.publish(time.monotonic(), latency_s)


def describe_fault(error: Exception) -> str:
    """Say that the software itself has failed, and where.

    Raises
    ------
    Exception
        The error itself where ROS is being shut down, which is no fault.
    """
    if not rclpy.utilities.ok():
        raise error
    place = traceback.extract_tb(error.__traceback__)[-1]
    file = "/".join(Path(place.filename).parts[-3:])
    return f"a fault of this software, please report it: {type(error).__name__}: {error} ({file}, line {place.lineno})"


def _printable(text: str) -> str:
    """The text for a log or a message, which are UTF-8: the name of a file need not be."""
    return text.encode("utf-8", "backslashreplace").decode()
