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

"""Time stamps and headers of messages."""

from __future__ import annotations

from typing import Any, Protocol

from semcal_ros.bridge.fields import whole_number
from semcal_ros.core.errors import InvalidValueError, MessageError

_NS_PER_S = 1_000_000_000  # nanoseconds per second
_SEC_MIN, _SEC_MAX = -(2**31), 2**31 - 1


class StampMessage(Protocol):
    """builtin_interfaces/msg/Time, of rclpy or of rosbags."""

    sec: int
    nanosec: int


class HeaderMessage(Protocol):
    """std_msgs/msg/Header, of rclpy or of rosbags."""

    @property
    def stamp(self) -> StampMessage:
        """Time of the data."""

    frame_id: str


def stamp_ns_from_msg(message: Any) -> int:
    """Return the stamp in ns of a message with a header, of a header, or of a time message.

    Raises
    ------
    MessageError
        There is no stamp, or its numbers are not a valid time: 32-bit seconds, and nanoseconds
        below one second.
    """
    stamp = _find_stamp(message)
    if stamp is None:
        raise MessageError(
            f"a message of type {type(message).__name__} without a stamp",
            expected="a message with a header",
        )
    sec, nanosec = whole_number(stamp.sec, "seconds"), whole_number(stamp.nanosec, "nanoseconds")
    if not 0 <= nanosec < _NS_PER_S:
        raise MessageError(f"a stamp with {nanosec} ns", expected="nanoseconds below 1000000000")
    if not _SEC_MIN <= sec <= _SEC_MAX:
        raise MessageError(
            f"a stamp of {sec} s", expected="seconds that fit a 32-bit signed integer"
        )
    return sec * _NS_PER_S + nanosec


def optional_stamp_ns(message: Any) -> int | None:
    """Return as :func:`stamp_ns_from_msg`, or None for a type without a header, such as Float64."""
    return None if _find_stamp(message) is None else stamp_ns_from_msg(message)


def _find_stamp(message: Any) -> StampMessage | None:
    holder = getattr(message, "header", message)
    stamp = getattr(holder, "stamp", holder)
    if hasattr(stamp, "sec") and hasattr(stamp, "nanosec"):
        found: StampMessage = stamp
        return found
    return None


def fill_stamp(stamp: StampMessage, stamp_ns: int) -> None:
    """Set a time message to ``stamp_ns`` nanoseconds.

    Raises
    ------
    InvalidValueError
        The seconds do not fit the 32 bits of the message.
    """
    sec, nanosec = divmod(int(stamp_ns), _NS_PER_S)
    if not _SEC_MIN <= sec <= _SEC_MAX:
        raise InvalidValueError(
            f"a stamp of {stamp_ns} ns", expected="seconds that fit a 32-bit signed integer"
        )
    stamp.sec, stamp.nanosec = sec, nanosec


def fill_header(header: HeaderMessage, stamp_ns: int, frame_id: str) -> None:
    """Set stamp and frame of a header."""
    fill_stamp(header.stamp, stamp_ns)
    header.frame_id = frame_id


def copy_header(target: HeaderMessage, source: HeaderMessage) -> None:
    """Copy a header verbatim, also between the two families of message classes."""
    target.stamp.sec = int(source.stamp.sec)
    target.stamp.nanosec = int(source.stamp.nanosec)
    target.frame_id = str(source.frame_id)
