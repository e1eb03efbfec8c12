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

"""Fields of messages of both families of classes: arrays, nested messages, stamps, headers; and names of ROS 2."""

from __future__ import annotations

import array
import sys
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.errors import InvalidValueError, MessageError

_NS_PER_S = 1_000_000_000  # nanoseconds per second
_SEC_MIN, _SEC_MAX = -(2**31), 2**31 - 1


def require_fields(message: Any, names: tuple[str, ...], type_name: str) -> None:
    """Raise :class:`MessageError` if ``message`` is not of type ``type_name``."""
    missing = [name for name in names if not hasattr(message, name)]
    if missing:
        raise MessageError(
            f"a message of type {type(message).__name__} without {', '.join(missing)}",
            expected=type_name,
            do="check the type of the topic",
        )


def whole_number(value: Any, what: str) -> int:
    """Return ``value`` as an int; raise :class:`MessageError` if it is not a whole number.

    A recording may redefine a known type, so that a field can have any type.
    """
    if not isinstance(value, (int, np.integer)):
        raise MessageError(
            f"{what} of type {type(value).__name__}",
            expected="a whole number",
            do="check the definition of the message type",
        )
    return int(value)


def byte_memory(message: Any, name: str, size: int) -> NDArray[np.uint8]:
    """Return (size,) writeable, uninitialised memory for a ``uint8[]`` field.

    rclpy takes an ``array.array('B')`` without looking at its elements; every other type is checked
    element by element, which costs milliseconds per image. An array that the message already has is
    used again if its length fits: a node that keeps one output message then pays for no new memory,
    whose first touch costs more than a copy.
    """
    old = getattr(message, name)
    if isinstance(old, np.ndarray):
        new = np.empty(size, dtype=np.uint8)
        setattr(message, name, new)
        return new
    if not (isinstance(old, array.array) and old.typecode == "B" and len(old) == size):
        # Half the time of array("B", bytes(size)), which fills the memory twice.
        setattr(message, name, array.array("B", b"\0") * size)
        # rclpy may have taken a copy.
        old = getattr(message, name)
    return np.frombuffer(old, dtype=np.uint8) if size else np.empty(0, np.uint8)


def assign_bytes(message: Any, name: str, values: NDArray[Any]) -> None:
    """Copy the memory of a C-contiguous array into a ``uint8[]`` field."""
    flat = values.reshape(-1).view(np.uint8)
    byte_memory(message, name, flat.size)[:] = flat


def assign_floats(message: Any, name: str, values: ArrayLike) -> None:
    """Set a ``float64[]`` or ``float64[n]`` field from values of any shape, row by row."""
    flat = np.array(values, dtype=np.float64).reshape(-1)
    if isinstance(getattr(message, name), np.ndarray):
        setattr(message, name, flat)
    else:
        setattr(message, name, array.array("d", flat.tobytes()))


def new_nested(owner: Any, type_name: str, **fields: Any) -> Any:
    """Create a message of ``type_name`` from the same family of classes (and the same package) as
    ``owner``.

    Parameters
    ----------
    owner
        A message of the package that defines ``type_name``.
    type_name
        Full name such as ``std_msgs/msg/MultiArrayDimension``.
    fields
        All of its fields.

    Raises
    ------
    MessageError
        The class is not found beside that of ``owner``.
    """
    module_name = type(owner).__module__
    short = type_name.rsplit("/", 1)[-1]
    places = [
        (module_name.rpartition(".")[0], short),
        (module_name, type_name.replace("/", "__")),
    ]
    for place, attribute in places:
        found = getattr(sys.modules.get(place), attribute, None)
        if found is not None:
            return found(**fields)
    raise MessageError(
        f"a message of class {module_name}.{type(owner).__name__}",
        expected=f"a message of rclpy or rosbags, whose package defines {type_name}",
    )


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


def absolute_namespace(namespace: str) -> str:
    """Return a namespace such as ``sem/left/`` in the form ``/sem/left``.

    Raises
    ------
    InvalidValueError
        If ROS would not accept it.
    """
    parts = namespace.strip("/").split("/")
    if not all(part.isascii() and part.isidentifier() for part in parts):
        raise InvalidValueError(f"namespace {namespace!r}", expected="a ROS namespace such as /sem")
    return "/" + "/".join(parts)
