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

"""The affine-safe projection matrix of rectified images and its covariance, as messages without and with a stamp.

``projection`` is a std_msgs/msg/Float64MultiArray, which has no header. ``projection_stamped`` is a
sensor_msgs/msg/Image of 3 rows and 4 columns in the encoding ``64FC1``: the one standard message that
holds a matrix of any size and has a header, so that it pairs with its image by the stamp. The covariance goes out
beside them, as ``projection_covariance`` and ``projection_covariance_stamped`` of 12 rows and columns: subscribers of
the matrix need not know of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from semcal_ros.bridge.fields import assign_floats, new_nested, whole_number
from semcal_ros.bridge.headers import HeaderMessage
from semcal_ros.bridge.images import PixelFormat, fill_image, image_from_message
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import MessageError

_STAMPED_ENCODING = "64FC1"
_STAMPED_ENCODINGS = {_STAMPED_ENCODING: PixelFormat(np.dtype(np.float64), 1)}


def fill_projection(message: Any, camera: ScanCamera) -> None:
    """Set a 3 x 4 array, row by row: the homogeneous rectified pixel of a homogeneous sem-frame point
    in m, ``camera.rectified.P_affine``.

    It is finite for every camera, parallel ones too, and its last row is ``[0 0 rho 1]``.
    """
    _fill_array(message, camera.rectified.P_affine)


def fill_projection_covariance(message: Any, camera: ScanCamera) -> None:
    """Set a 12 x 12 array, row by row: the covariance of the 12 numbers of :func:`fill_projection`, in their order.

    Raises
    ------
    InvalidValueError
        The camera carries no covariance.
    """
    _fill_array(message, camera.rectified.P_affine_covariance)


def _fill_array(message: Any, matrix: Array) -> None:
    stride = matrix.size
    dimensions = []
    for label, size in zip(("rows", "columns"), matrix.shape, strict=True):
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
    assign_floats(message, "data", matrix)


def projection_from_message(message: Any) -> Array:
    """Return the (3, 4) matrix of a message filled by :func:`fill_projection`.

    Raises
    ------
    MessageError
        The array has another size or holds values that are not finite.
    """
    return _read_array(message, "projection", (3, 4))


def projection_covariance_from_message(message: Any) -> Array:
    """Return the (12, 12) matrix of a message filled by :func:`fill_projection_covariance`.

    Raises
    ------
    MessageError
        As :func:`projection_from_message`.
    """
    return _read_array(message, "covariance of a projection", (12, 12))


def _read_array(message: Any, what: str, shape: tuple[int, int]) -> Array:
    size = shape[0] * shape[1]
    offset = whole_number(message.layout.data_offset, "data_offset")
    try:
        values = np.array(message.data, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MessageError(
            f"a {what} of type {type(message.data).__name__}", expected=f"{size} finite numbers"
        ) from error
    fits = values.ndim == 1 and 0 <= offset == values.size - size
    if not (fits and np.all(np.isfinite(values[offset:]))):
        raise MessageError(
            f"a {what} of {values.size} numbers from index {offset} on",
            expected=f"{size} finite numbers, {shape[0]} rows of {shape[1]}",
        )
    return values[offset:].reshape(shape)


def fill_stamped_projection(
    message: Any, camera: ScanCamera | None, header: HeaderMessage, width: int, height: int
) -> None:
    """Set an image message to the matrix of :func:`fill_projection`, with the header of an image.

    Parameters
    ----------
    message
        A sensor_msgs/msg/Image.
    camera
        The camera of the rectified image, in any size: it is resized to the image's. None, for an
        image without a camera, gives a matrix of zeros, as K is in its camera_info.
    header
        Header of the image, copied verbatim.
    width, height
        Size of the rectified image, px.
    """
    matrix = np.zeros((3, 4))
    if camera is not None:
        matrix = camera.resized(width, height).rectified.P_affine
    fill_image(message, matrix, _STAMPED_ENCODING, header, _STAMPED_ENCODINGS)


def stamped_projection_from_message(message: Any) -> Array:
    """Return the (3, 4) matrix of a message filled by :func:`fill_stamped_projection`.

    It is zero for an image without a camera.

    Raises
    ------
    MessageError
        The message is not an image of 3 x 4 double-precision numbers, or they are not finite.
    """
    return _read_image(message, "projection", (3, 4))


def fill_stamped_projection_covariance(
    message: Any, camera: ScanCamera | None, header: HeaderMessage, width: int, height: int
) -> None:
    """Set an image message to the matrix of :func:`fill_projection_covariance`, with the header of an image.

    Parameters and an image without a camera are as for :func:`fill_stamped_projection`.

    Raises
    ------
    InvalidValueError
        The camera carries no covariance.
    """
    matrix = np.zeros((12, 12))
    if camera is not None:
        matrix = camera.resized(width, height).rectified.P_affine_covariance
    fill_image(message, matrix, _STAMPED_ENCODING, header, _STAMPED_ENCODINGS)


def stamped_projection_covariance_from_message(message: Any) -> Array:
    """Return the (12, 12) matrix of a message filled by :func:`fill_stamped_projection_covariance`.

    Raises
    ------
    MessageError
        As :func:`stamped_projection_from_message`.
    """
    return _read_image(message, "covariance of a projection", (12, 12))


def _read_image(message: Any, what: str, shape: tuple[int, int]) -> Array:
    matrix = image_from_message(message, _STAMPED_ENCODINGS)
    if matrix.shape != shape or not np.all(np.isfinite(matrix)):
        raise MessageError(
            f"a {what} of {matrix.shape[0]} x {matrix.shape[1]} numbers",
            expected=f"{shape[0]} rows of {shape[1]} finite numbers in {_STAMPED_ENCODING}",
        )
    return np.array(matrix, dtype=np.float64)
