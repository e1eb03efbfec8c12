"""std_msgs/msg/Float64MultiArray with the affine-safe projection matrix."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.fields import assign_floats, new_nested
from semcal_ros.bridge.protocols import MultiArrayMessage
from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.errors import MessageError

__all__ = ["fill_projection", "projection_from_message"]

_SHAPE = (("rows", 3), ("columns", 4))


def fill_projection(message: MultiArrayMessage, camera: ScanCamera) -> None:
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


def projection_from_message(message: MultiArrayMessage) -> NDArray[np.float64]:
    """(3, 4) matrix of a message filled by :func:`fill_projection`.

    Raises
    ------
    MessageError
        The array has another size or holds values that are not finite.
    """
    values = np.array(message.data, dtype=np.float64)
    offset = int(message.layout.data_offset)
    if values.size - offset != 12 or not np.all(np.isfinite(values[offset:])):
        raise MessageError(
            f"a projection of {values.size - offset} numbers",
            expected="12 finite numbers, 3 rows of 4",
        )
    return values[offset:].reshape(3, 4)
