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

"""The value that was valid at a given stamp, and when a frame was scanned, on the clock of such values."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from typing import Generic, TypeVar

from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.errors import InvalidValueError

T = TypeVar("T")

_NS_PER_S = 1_000_000_000  # nanoseconds per second
# Fraction of the acquisition at either end in which a change is harmless: a row or two at most.
_MARGIN = 0.01
# A value published at most this long before a frame, or this part of its scan, was announced together with it.
_TOGETHER_NS, _TOGETHER_AT_MOST = 20_000_000, 0.25
# Part of a recursive average below which what an earlier pass shows is harmless.
_OLD_SHARE = 0.05
# A frame that was published later than this after its scan has a stamp of another clock.
_LONGEST_WAY_NS = 10 * _NS_PER_S


class ZeroOrderHold(Generic[T]):
    """Bounded history of stamped values, each valid from its stamp until the next one.

    Parameters
    ----------
    max_length
        Number of values kept; the oldest are dropped.
    jump_ns
        A value older than the newest one by more than this means that the clock went back (a bag
        that loops, a simulation that restarts): the history is cleared. Smaller steps back are
        late arrivals and are sorted in.

    Notes
    -----
    Not locked: insert and read from one thread, or from callbacks that exclude each other.

    Examples
    --------
    >>> hold = ZeroOrderHold[float]()
    >>> hold.insert(100, 500.0)
    False
    >>> hold.at(99) is None, hold.at(100), hold.at(10**12)
    (True, 500.0, 500.0)
    """

    def __init__(self, max_length: int = 256, jump_ns: int = _NS_PER_S) -> None:
        if max_length < 1:
            raise InvalidValueError(f"a history of {max_length} values", expected="at least 1")
        if jump_ns < 0:
            raise InvalidValueError(f"a clock jump of {jump_ns} ns", expected="0 or more")
        self._max_length = max_length
        self._jump_ns = jump_ns
        self._stamps: list[int] = []
        self._values: list[T] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest value, or None."""
        return self._stamps[-1] if self._stamps else None

    def clear(self) -> None:
        """Forget everything."""
        self._stamps.clear()
        self._values.clear()

    def insert(self, stamp_ns: int, value: T) -> bool:
        """Add a value; one with the same stamp is replaced.

        Returns
        -------
        True if the clock went back and the history was cleared first.
        """
        cleared = bool(self._stamps) and stamp_ns < self._stamps[-1] - self._jump_ns
        if cleared:
            self.clear()
        place = bisect_left(self._stamps, stamp_ns)
        if place < len(self._stamps) and self._stamps[place] == stamp_ns:
            self._values[place] = value
            return cleared
        self._stamps.insert(place, stamp_ns)
        self._values.insert(place, value)
        if len(self._stamps) > self._max_length:
            del self._stamps[0], self._values[0]
        return cleared

    def at(self, stamp_ns: int) -> T | None:
        """Return the value with the latest stamp not after ``stamp_ns``, or None."""
        place = bisect_right(self._stamps, stamp_ns)
        return self._values[place - 1] if place else None

    def between(self, start_ns: int, end_ns: int) -> list[T]:
        """Return the values that began in ``start_ns`` < stamp <= ``end_ns``, oldest first."""
        first, last = bisect_right(self._stamps, start_ns), bisect_right(self._stamps, end_ns)
        return self._values[first:last]


def scan_interval_ns(
    stamp_ns: int, sent_ns: int | None, config: MicroscopeConfig
) -> tuple[int, int] | None:
    """Return the first and the last moment of a frame's scan at which a change of magnification spoils it.

    The very first and last rows do not count, and of a recursive average the earlier passes do, as long as they make up
    a twentieth of it. Where publication times decide, neither do the last 20 ms before that of
    the frame (at most a quarter of its scan): many drivers announce a magnification with its frame.

    Parameters
    ----------
    stamp_ns
        Header stamp of the frame.
    sent_ns
        When the frame was published, where the magnification has no stamps of its own and is known
        by when it was published; None where stamps are compared with stamps.
    config
        What the stamp means, and the raster timing.

    Returns
    -------
    (start, end), ns; None if unknown: without raster timing and publication time, or
    where stamps and publication are on different clocks, as in a replay.
    """
    start_ns = stamp_ns + round(config.start_offset_s * 1e9)
    duration_ns = 0 if config.scan is None else round(config.scan.acquisition_time_s * 1e9)
    end_ns = start_ns + duration_ns
    if sent_ns is not None:
        if not 0 <= sent_ns - start_ns <= duration_ns + _LONGEST_WAY_NS:
            return None
        if config.scan is None and config.image.stamp == "start":
            end_ns = sent_ns
        # A frame that is published while it is still being scanned holds what came before.
        end_ns = min(end_ns, sent_ns)
    margin_ns = round(_MARGIN * (end_ns - start_ns))
    first_ns, last_ns = start_ns + margin_ns - _blended_ns(config), end_ns - margin_ns
    if sent_ns is not None:
        last_ns = min(last_ns, sent_ns - _together_ns(config))
    return (first_ns, last_ns) if first_ns < last_ns else None


def _blended_ns(config: MicroscopeConfig) -> int:
    """How long before its latest pass a recursive average still shows what there was."""
    if config.scan is None or config.scan.recursive_averages == 1:
        return 0
    kept = 1.0 - 1.0 / config.scan.recursive_averages
    return round(math.log(_OLD_SHARE) / math.log(kept) * config.scan.frame_time_s * 1e9)


def _together_ns(config: MicroscopeConfig) -> int:
    """How long before the publication of a frame a value is announced together with it."""
    if config.scan is None:
        return _TOGETHER_NS
    return min(_TOGETHER_NS, round(_TOGETHER_AT_MOST * config.scan.acquisition_time_s * 1e9))


def find_values(
    hold: ZeroOrderHold[T], stamp_ns: int, sent_ns: int | None, config: MicroscopeConfig
) -> tuple[T | None, list[T | None]]:
    """Return the value that is that of a frame, and all that were valid during its scan, the one at its start first.

    It is the one in force during the scan, and not at the stamp or the publication, which may come before or after a
    change; but one that was announced together with the frame. The parameters are those of :func:`scan_interval_ns`;
    where that is unknown, the value at the stamp or at the publication is all.
    """
    interval = scan_interval_ns(stamp_ns, sent_ns, config)
    if interval is None:
        value = hold.at(stamp_ns if sent_ns is None else sent_ns)
        return value, [value]
    during = [hold.at(interval[0]), *hold.between(*interval)]
    if sent_ns is not None and hold.between(sent_ns - _together_ns(config), sent_ns):
        return hold.at(sent_ns), during
    return during[-1], during
