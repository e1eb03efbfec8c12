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

"""ROS message types without ROS: type store, default values, and serialisation."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from semcal_ros.core.errors import BagError

__all__ = ["blank_message", "jazzy_types", "message_type_name", "serialize_message"]

_NOT_NUMERIC = ("string", "wstring")
_NUMPY_NAMES = {"byte": "uint8", "char": "uint8", "bool": "bool"}


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
