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

"""What a topic of a recording said last before a given moment, such as the magnification of an image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from semcal_ros.bridge.fields import optional_stamp_ns
from semcal_ros.bridge.magnification import MagnificationReading, read_magnification
from semcal_ros.bridge.zero_order_hold import ZeroOrderHold
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.errors import SemcalError
from semcal_ros.files.bags.reader import BagReader, RawMessage

T = TypeVar("T")


class HeldValues(Generic[T]):
    """All messages of a topic, each valid until the next one.

    Times are header stamps if every message has one, else the times of the recorder. A message with
    a bad value ends the validity of the one before it, so that no image gets a value that the
    microscope may have left.

    Parameters
    ----------
    reader, topic
        The recording, and the topic in it.
    read
        Makes a value of a message; raises :class:`SemcalError` for a bad one.

    Attributes
    ----------
    bad
        Reasons why messages were ignored.
    usable
        Number of messages with a usable value.
    by_stamp
        Whether header stamps are compared with those of the images, not the times of the recorder.
    timed
        (time in ns, value or None) of all messages, in the order of time.
    """

    def __init__(self, reader: BagReader, topic: str, read: Callable[[Any], T]) -> None:
        self.bad: list[str] = []
        self.usable = 0
        rows = [self._row(reader, raw, read) for raw in reader.raw_messages([topic])]
        self.by_stamp = bool(rows) and all(stamp_ns for stamp_ns, _, _ in rows)
        timed = [
            ((stamp_ns or 0) if self.by_stamp else logged, value)
            for stamp_ns, logged, value in rows
        ]
        self.timed: list[tuple[int, T | None]] = sorted(timed, key=lambda pair: pair[0])
        self._hold = ZeroOrderHold[Any](max_length=max(1, len(rows)))
        for time_ns, value in self.timed:
            self._hold.insert(time_ns, value)

    def _row(
        self, reader: BagReader, raw: RawMessage, read: Callable[[Any], T]
    ) -> tuple[int | None, int, T | None]:
        """Header stamp (None without one), receive time, and the value (None if it is bad)."""
        stamp_ns = None
        try:
            message = reader.decode(raw)
            stamp_ns = optional_stamp_ns(message)
            value = read(message)
        except SemcalError as error:
            self.bad.append(str(error))
            return stamp_ns, raw.log_time_ns, None
        self.usable += 1
        return stamp_ns, raw.log_time_ns, value

    def held_at(self, stamp_ns: int, log_time_ns: int) -> T | None:
        """Return the value at an image, or None before the first message and after a bad one."""
        held: T | None = self._hold.at(stamp_ns if self.by_stamp else log_time_ns)
        return held

    def held_during(self, start_ns: int, end_ns: int) -> list[T | None]:
        """Return all values of an interval, the one at its start first."""
        return [self._hold.at(start_ns), *self._hold.between(start_ns, end_ns)]


class MagnificationTrack(HeldValues[MagnificationReading]):
    """All magnification messages of a topic, each valid until the next one."""

    def __init__(self, reader: BagReader, topic: str, config: MicroscopeConfig) -> None:
        super().__init__(reader, topic, lambda message: read_magnification(message, config))

    def at(self, stamp_ns: int, log_time_ns: int, image_width_px: int) -> float | None:
        """Return the magnification at an image, or None before the first message and after a bad one.

        Raises
        ------
        MessageError
            A pixel size gives no credible magnification for an image of this width.
        """
        reading = self.held_at(stamp_ns, log_time_ns)
        return None if reading is None else float(reading.magnification(image_width_px))
