"""Array fields and nested messages, for both families of message classes."""

from __future__ import annotations

import array
import sys
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.errors import MessageError

__all__ = ["assign_bytes", "assign_floats", "new_nested", "require_fields"]


def require_fields(message: Any, names: tuple[str, ...], type_name: str) -> None:
    """Raise :class:`MessageError` where ``message`` is of another type than ``type_name``."""
    missing = [name for name in names if not hasattr(message, name)]
    if missing:
        raise MessageError(
            f"a message of type {type(message).__name__} without {', '.join(missing)}",
            expected=type_name,
            do="check the type of the topic",
        )


def assign_bytes(message: Any, name: str, values: NDArray[Any]) -> None:
    """Copy the memory of a C-contiguous array into a ``uint8[]`` field.

    rclpy takes an ``array.array('B')`` without looking at its elements; every other type is checked
    element by element, which costs milliseconds per image. An array that the message already has is
    overwritten if its length fits: a node that keeps one output message then pays for no new
    memory, whose first touch costs more than the copy.
    """
    flat = values.reshape(-1).view(np.uint8)
    old = getattr(message, name)
    if isinstance(old, np.ndarray):
        setattr(message, name, flat.copy())
        return
    if isinstance(old, array.array) and old.typecode == "B" and len(old) == flat.size > 0:
        np.frombuffer(old, dtype=np.uint8)[:] = flat
        return
    data = array.array("B")
    data.frombytes(flat.data)
    setattr(message, name, data)


def assign_floats(message: Any, name: str, values: ArrayLike) -> None:
    """Set a ``float64[]`` or ``float64[n]`` field from values of any shape, row by row."""
    flat = np.array(values, dtype=np.float64).reshape(-1)
    if isinstance(getattr(message, name), np.ndarray):
        setattr(message, name, flat)
    else:
        setattr(message, name, array.array("d", flat))


def new_nested(owner: Any, type_name: str, **fields: Any) -> Any:
    """A message of ``type_name`` from the same family of classes (and the same package) as
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
        expected=f"a message of rclpy or rosbags, beside which {type_name} is defined",
    )
