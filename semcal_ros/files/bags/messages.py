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

"""ROS messages without ROS: type store, default values, serialisation, and what a microscope says with its images."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from semcal_ros.bridge.conditions import CONDITIONS_TYPE, Conditions, fill_conditions
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.magnification import published_number
from semcal_ros.config.config import IMAGE_TYPE, STAGE_TYPE, MicroscopeConfig, StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import BagError

_NOT_NUMERIC = ("string", "wstring")
_NUMPY_NAMES = {"byte": "uint8", "char": "uint8", "bool": "bool"}
_NUMBER_TYPES = ("std_msgs/msg/Float64", "std_msgs/msg/Float32")


@lru_cache(maxsize=1)
def jazzy_types() -> Typestore:
    """Return the message types of ROS 2 Jazzy; those that the project uses are the same in Kilted."""
    return get_typestore(Stores.ROS2_JAZZY)


def _fields(typename: str, store: Typestore) -> list[tuple[str, Any]]:
    if typename not in store.fielddefs:
        raise BagError(
            f"message type {typename!r}",
            expected="a type of the common ROS 2 interface packages, such as sensor_msgs/msg/Image",
            do="check its spelling",
        )
    return list(store.get_msgdef(typename).fields)


def _dtype(base_name: str) -> np.dtype[Any]:
    return np.dtype(_NUMPY_NAMES.get(base_name, base_name))


def _blank_value(description: Any, store: Typestore) -> Any:
    kind, detail = description
    if kind == Nodetype.NAME:
        return _blank(detail, store)
    if kind == Nodetype.BASE:
        return "" if detail[0] in _NOT_NUMERIC else _dtype(detail[0]).type(0).item()
    (inner_kind, inner), length = detail
    count = length if kind == Nodetype.ARRAY else 0
    if inner_kind == Nodetype.BASE and inner[0] not in _NOT_NUMERIC:
        return np.zeros(count, dtype=_dtype(inner[0]))
    return [_blank_value((inner_kind, inner), store) for _ in range(count)]


def _blank(typename: str, store: Typestore) -> Any:
    values = {name: _blank_value(kind, store) for name, kind in _fields(typename, store)}
    return store.types[typename](**values)


def blank_message(typename: str) -> Any:
    """Make a message with every field at zero, empty or false; its attributes can be set afterwards.

    Parameters
    ----------
    typename
        Full name such as ``sensor_msgs/msg/Image``.

    Raises
    ------
    BagError
        The type is not one of the common interface packages.
    """
    return _blank(typename, jazzy_types())


def message_type_name(message: Any) -> str:
    """Return the full type name of a message made by :func:`blank_message` or read from a bag."""
    name = getattr(message, "__msgtype__", None)
    if not isinstance(name, str):
        raise BagError(
            f"an object of type {type(message).__name__}",
            expected="a message made by blank_message or read from a bag",
        )
    return name


def _is_numeric_block(description: Any) -> bool:
    kind, detail = description
    if kind not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return False
    (inner_kind, inner), _ = detail
    return bool(inner_kind == Nodetype.BASE and inner[0] not in _NOT_NUMERIC)


def _as_block(value: Any, dtype: np.dtype[Any]) -> Any:
    """Return a contiguous 1-D array of the field's type; buffers are taken without a copy."""
    if isinstance(value, (bytes, bytearray, memoryview)):
        return np.frombuffer(value, dtype=np.uint8).view(dtype)
    return np.ascontiguousarray(value, dtype=dtype).reshape(-1)


def _normalise(message: Any, typename: str, store: Typestore) -> None:
    """Make numeric array fields what the serialiser needs: arrays of the declared type."""
    for name, kind in _fields(typename, store):
        value = getattr(message, name)
        if _is_numeric_block(kind):
            setattr(message, name, _as_block(value, _dtype(kind[1][0][1][0])))
        elif kind[0] == Nodetype.NAME:
            _normalise(value, kind[1], store)
        elif kind[0] != Nodetype.BASE and kind[1][0][0] == Nodetype.NAME:
            for item in value:
                _normalise(item, kind[1][0][1], store)


def serialize_message(message: Any) -> memoryview:
    """Serialize a message to CDR bytes; its array fields may be arrays, ``bytes``, ``array.array`` or lists.

    Raises
    ------
    BagError
        The object is not a message, or its type is unknown.
    ValueError, struct.error, OverflowError
        A value does not fit its field.
    """
    typename = message_type_name(message)
    store = jazzy_types()
    _normalise(message, typename, store)
    return store.serialize_cdr(message, typename)


def microscope_topic(name: str) -> str:
    """Return the full name of a topic in a recording."""
    return name if name.startswith("/") else f"/sem/{name}"


def check_recordable(config: MicroscopeConfig) -> None:
    """Check that a recording can be made as a configuration describes it.

    Raises
    ------
    BagError
        Its images or magnifications are in messages of another type.
    """
    if config.image.type != IMAGE_TYPE:
        raise BagError(
            f"configuration {config.name!r} has its images in {config.image.type}",
            expected=f"{IMAGE_TYPE} for a recording",
            do="use --config generic",
        )
    source = config.magnification
    if source.type not in _NUMBER_TYPES or source.field != "data":
        raise BagError(
            f"configuration {config.name!r} has its {source.quantity} in {source.type}, "
            f"field {source.field}",
            expected="std_msgs/msg/Float64, field data, for a recording",
            do="use --config generic",
        )


def magnification_message(config: MicroscopeConfig, magnification: float, width_px: int) -> Any:
    """Return a magnification, or the quantity that the configuration has in its place."""
    message = blank_message(config.magnification.type)
    width_m = config.display_width_m / magnification
    message.data = published_number(config, width_m, width_px)
    return message


def stage_message(source: StageConfig, reading: StageReading | None, stamp_ns: int) -> Any:
    """Return the joints of the stage; none where they are not known, which ends the reading before."""
    stated = reading or StageReading()
    joints = {
        source.tilt: stated.tilt_rad,
        source.rotation: stated.rotation_rad,
        source.scan_rotation: stated.scan_rotation_rad,
        source.x: stated.x_m,
        source.y: stated.y_m,
    }
    known = {joint: value for joint, value in joints.items() if value is not None}
    message = blank_message(STAGE_TYPE)
    fill_header(message.header, stamp_ns, "")
    message.name, message.position = list(known), list(known.values())
    return message


def conditions_message(conditions: Conditions, name: str) -> Any:
    """Return how an image was taken."""
    message = blank_message(CONDITIONS_TYPE)
    fill_conditions(message, conditions.topic_values(), name)
    return message
