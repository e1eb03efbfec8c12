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

"""Counters, rate and latency of a stream, and the diagnostic message that shows them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from semcal_ros.bridge.fields import new_nested
from semcal_ros.core.arrays import check_positive

_BETWEEN = "; "


class DiagnosticLevel(IntEnum):
    """Levels of diagnostic_msgs/msg/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class DiagnosticSummary:
    """The content of one diagnostic message: a level, one line, and key/value pairs."""

    level: DiagnosticLevel
    message: str
    values: tuple[tuple[str, str], ...]


def join_states(states: Iterable[str]) -> str:
    """Join states to the one line of a diagnostic message.

    Semicolons within a state, as between what was seen and what was expected, become commas: what reads the line can
    tell the states apart again, see :func:`split_states`.
    """
    return _BETWEEN.join(state.replace(";", ",") for state in states)


def split_states(message: str) -> list[str]:
    """Split the line that :func:`join_states` made."""
    return [state for part in message.split(_BETWEEN.strip()) if (state := part.strip())]


class StreamStatistics:
    """Counters, rate and latency of one stream, for any number of threads.

    Times are arguments, in seconds of any one monotonic clock.

    Parameters
    ----------
    window_s
        Rate and latency are those of the last ``window_s`` seconds.
    stale_after_s
        Without a frame for this long the stream counts as stale.
    """

    def __init__(self, window_s: float = 5.0, stale_after_s: float = 5.0) -> None:
        for name, value in (("window", window_s), ("stale time", stale_after_s)):
            check_positive(value, f"{name} of", "s")
        # A replay counts in a thread of its own, while the node's reports.
        self._lock = threading.RLock()
        self._window_s = window_s
        self._stale_after_s = stale_after_s
        self._recent: deque[tuple[float, float | None]] = deque()
        self._last_s: float | None = None
        self._counts = {"received": 0, "published": 0, "dropped": 0, "rejected": 0}
        self._troubles_reported = 0
        self._rejection = ""
        self._extra: dict[str, str] = {}

    @property
    def received(self) -> int:
        """Frames that arrived."""
        return self._counts["received"]

    @property
    def published(self) -> int:
        """Results that went out."""
        return self._counts["published"]

    @property
    def dropped(self) -> int:
        """Frames that were overtaken by newer ones."""
        return self._counts["dropped"]

    @property
    def rejected(self) -> int:
        """Messages that could not be used."""
        return self._counts["rejected"]

    def receive(self, time_s: float) -> None:
        """Count a frame that arrived at ``time_s``."""
        with self._lock:
            self._counts["received"] += 1
            self._last_s = time_s

    def publish(self, time_s: float, latency_s: float | None = None) -> None:
        """Count a result that left at ``time_s``.

        ``latency_s`` is the time since the stamp of its frame, or None if unknown.
        """
        with self._lock:
            self._counts["published"] += 1
            self._recent.append((time_s, latency_s))
            self._forget(time_s)

    def drop(self, count: int = 1) -> None:
        """Count frames that were lost or overtaken."""
        with self._lock:
            self._counts["dropped"] += count

    def reject(self, reason: str) -> None:
        """Count a message that could not be used and keep its reason."""
        with self._lock:
            self._counts["rejected"] += 1
            self._rejection = reason

    def note(self, key: str, value: object) -> None:
        """Show one more key/value pair, such as a residual; the latest value of a key stays."""
        text = f"{value:.6g}" if isinstance(value, float) else str(value)
        with self._lock:
            self._extra[key] = text

    def forget(self, key: str) -> None:
        """Show a key of :meth:`note` no longer, if it is shown."""
        with self._lock:
            self._extra.pop(key, None)

    def _forget(self, now_s: float) -> None:
        while self._recent and self._recent[0][0] < now_s - self._window_s:
            self._recent.popleft()

    def rate_hz(self, now_s: float) -> float:
        """Return the results per second over the window."""
        with self._lock:
            self._forget(now_s)
            if len(self._recent) < 2:
                return 0.0
            span = self._recent[-1][0] - self._recent[0][0]
            return (len(self._recent) - 1) / span if span > 0.0 else 0.0

    def latency_s(self, now_s: float) -> tuple[float, float] | None:
        """Return the mean and the largest latency over the window, or None without any."""
        with self._lock:
            self._forget(now_s)
            known = [latency for _, latency in self._recent if latency is not None]
        return (sum(known) / len(known), max(known)) if known else None

    def summary(self, now_s: float) -> DiagnosticSummary:
        """Summarise the state at ``now_s``.

        Stale without frames; a warning if frames were lost or refused since the last summary.
        """
        with self._lock:
            troubles = self.dropped + self.rejected
            fresh_troubles = troubles - self._troubles_reported
            self._troubles_reported = troubles
            rate = self.rate_hz(now_s)
            if self._last_s is None:
                level, message = DiagnosticLevel.STALE, "no frame received yet"
            elif now_s - self._last_s > self._stale_after_s:
                level = DiagnosticLevel.STALE
                message = f"no frame for {now_s - self._last_s:.1f} s"
            elif fresh_troubles:
                level = DiagnosticLevel.WARN
                message = f"{fresh_troubles} frames dropped or rejected"
            else:
                level, message = DiagnosticLevel.OK, f"{rate:.1f} Hz"
            if fresh_troubles and self._rejection:
                level = max(level, DiagnosticLevel.WARN)
                message = join_states([message, f"last rejection: {self._rejection}"])
            return DiagnosticSummary(level, message, self._values(now_s, rate))

    def _values(self, now_s: float, rate: float) -> tuple[tuple[str, str], ...]:
        pairs = [(key, str(count)) for key, count in self._counts.items()]
        pairs.append(("rate_hz", f"{rate:.3f}"))
        latency = self.latency_s(now_s)
        if latency is not None:
            pairs.append(("latency_mean_ms", f"{1e3 * latency[0]:.3f}"))
            pairs.append(("latency_max_ms", f"{1e3 * latency[1]:.3f}"))
        if self._rejection:
            pairs.append(("last_rejection", self._rejection))
        return tuple(pairs) + tuple(self._extra.items())


def fill_diagnostic_status(
    message: Any, name: str, hardware_id: str, summary: DiagnosticSummary
) -> None:
    """Set a diagnostic_msgs/msg/DiagnosticStatus."""
    message.level = _level_value(message.level, summary.level)
    message.name = name
    message.hardware_id = hardware_id
    message.message = summary.message
    message.values = [
        new_nested(message, "diagnostic_msgs/msg/KeyValue", key=key, value=value)
        for key, value in summary.values
    ]


def _level_value(current: Any, level: DiagnosticLevel) -> Any:
    # A ROS byte is a bytes object of length one in rclpy and a number in rosbags.
    return bytes([level]) if isinstance(current, bytes) else int(level)
