"""std_msgs/msg/Float64MultiArray with the affine-safe projection matrix."""

from __future__ import annotations

from typing import Any

import numpy as np

from semcal_ros.bridge.fields import assign_floats, new_nested, whole_number
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import MessageError

__all__ = ["fill_projection", "projection_from_message"]

_SHAPE = (("rows", 3), ("columns", 4))


def fill_projection(message: Any, camera: ScanCamera) -> None:
    """Set a 3 x 4 array, row by row: the undistorted homogeneous pixel of a homogeneous sem-frame
    point in m.

    It is finite for every camera, parallel ones too, and its last row is ``[0 0 rho 1]``.
    """
    stride = 12
    dimensions = []
    for label, size in _SHAPE:
        dimensions.append(
            new_nested(
                message.layout,
                "std_msgs/msg/MultiArrayDimension",
                label=label,
                size=size,
                stride=stride,
            )
        )
        stride //= size
    message.layout.dim = dimensions
    message.layout.data_offset = 0
    assign_floats(message, "data", camera.P_affine)


def projection_from_message(message: Any) -> Array:
    """Return the (3, 4) matrix of a message filled by :func:`fill_projection`.

    Raises
    ------
    MessageError
        The array has another size or holds values that are not finite.
    """
    offset = whole_number(message.layout.data_offset, "data_offset")
    try:
        values = np.array(message.data, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MessageError(
            f"a projection of type {type(message.data).__name__}", expected="12 finite numbers"
        ) from error
    fits = values.ndim == 1 and 0 <= offset == values.size - 12
    if not (fits and np.all(np.isfinite(values[offset:]))):
        raise MessageError(
            f"a projection of {values.size} numbers from index {offset} on",
            expected="12 finite numbers, 3 rows of 4",
        )
    return values[offset:].reshape(3, 4)
