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

"""The camera of an image in messages: sensor_msgs/msg/CameraInfo, the projection matrix, and the frames of tf2.

Cameras are those of rectified images: see ``doc/model.md``, "Square pixels". ``projection``, the affine-safe matrix, is
a std_msgs/msg/Float64MultiArray, which has no header. ``projection_stamped`` is a sensor_msgs/msg/Image of 3 rows and
4 columns in the encoding ``64FC1``: the one standard message that holds a matrix of any size and has a header, so that
it pairs with its image by the stamp. The covariance goes out beside them, as ``projection_covariance`` and
``projection_covariance_stamped`` of 12 rows and columns: subscribers of the matrix need not know of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from semcal_ros.bridge.fields import (
    HeaderMessage,
    assign_floats,
    copy_header,
    fill_stamp,
    new_nested,
    whole_number,
)
from semcal_ros.bridge.images import PixelFormat, fill_image, image_from_message
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import MessageError

if TYPE_CHECKING:  # its fit needs scipy.optimize, which takes long to import
    from semcal_ros.core.camera.pinhole_model import PlumbBobCamera


# Matrices of three rows, row by row.
_ZEROS: list[float] = [0.0] * 9
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]

_STAMPED_ENCODING = "64FC1"
_STAMPED_ENCODINGS = {_STAMPED_ENCODING: PixelFormat(np.dtype(np.float64), 1)}

_ROOT = "sem"


def fill_camera_info(
    message: Any,
    camera: ScanCamera | None,
    header: HeaderMessage,
    width: int,
    height: int,
) -> None:
    """Describe a rectified image as a pinhole camera: ``camera.rectified``.

    CameraInfo has no skew: its readers take ``fx, fy, cx, cy`` and nothing else. The rectified
    camera has no skew either, and one focal length.

    Points are those of the optical frame, whose origin is the scan pivot: a sem-frame point
    (X, Y, z) lies at ``Z = 1/rho + z``. Then ``K`` has ``f = m / rho``, ``P = [K | 0]``, ``R`` is
    the identity and the five ``plumb_bob`` coefficients are zero.

    Parameters
    ----------
    message
        The message to fill.
    camera
        The camera of this image, in any size: it is resized to the image's. None means
        uncalibrated; a parallel projection (``rho <= 0`` or only slightly above) has no finite K
        either. Both leave K, R and P zero, which sensor_msgs defines as "uncalibrated"; the affine-safe matrix of
        :mod:`semcal_ros.bridge.projection` still describes a parallel projection.
    header
        Header of the image, copied verbatim.
    width, height
        Size of the rectified image, px.
    """
    copy_header(message.header, header)
    message.width, message.height = int(width), int(height)
    message.distortion_model = "plumb_bob"
    k, r = _ZEROS, _ZEROS
    if camera is not None and camera.rho > 0.0:
        with np.errstate(over="ignore"):
            pinhole = camera.resized(width, height).rectified.K
        if np.all(np.isfinite(pinhole)):
            k, r = pinhole.ravel().tolist(), _IDENTITY
    assign_floats(message, "d", [0.0] * 5)
    assign_floats(message, "k", k)
    assign_floats(message, "r", r)
    assign_floats(message, "p", [*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0])


def fill_raw_camera_info(
    message: Any, camera: PlumbBobCamera | None, header: HeaderMessage, width: int, height: int
) -> None:
    """Describe a raw image as image_pipeline does: K, D and R of the raw image, P of the rectified one.

    Parameters
    ----------
    message
        A sensor_msgs/msg/CameraInfo.
    camera
        The model fitted to the camera, or None: K, R and P are zero then, which says "uncalibrated".
    header
        Header of the image, copied verbatim.
    width, height
        Size of the raw image with its data bar, px.
    """
    copy_header(message.header, header)
    message.width, message.height = int(width), int(height)
    message.distortion_model = "plumb_bob"
    assign_floats(message, "d", np.zeros(5) if camera is None else camera.D)
    assign_floats(message, "k", np.zeros((3, 3)) if camera is None else camera.K)
    assign_floats(message, "r", np.zeros((3, 3)) if camera is None else camera.R)
    assign_floats(message, "p", np.zeros((3, 4)) if camera is None else camera.P)


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


@dataclass(frozen=True)
class StaticFrame:
    """A frame in the sem frame.

    Attributes
    ----------
    name
        Its name.
    z_m
        Its origin on the optical axis, m.
    yaw_rad
        By how much it is turned about z, from x towards y, rad.
    """

    name: str
    z_m: float = 0.0
    yaw_rad: float = 0.0


def static_frames(config: MicroscopeConfig, camera: ScanCamera | None) -> tuple[StaticFrame, ...]:
    """Return the frames whose parent is the sem frame.

    ``specimen`` is where the specimen was in the first frame, to which corrected images are corrected. ``stage`` has
    its x along the tilt axis of the configuration. The frame of the images has its origin at the pivot of the scan,
    and is missing without a camera or for a parallel projection.
    """
    stage = config.stage
    yaw_rad = 0.0 if stage is None else math.radians(stage.tilt_axis_deg)
    found = [StaticFrame("specimen"), StaticFrame("stage", yaw_rad=yaw_rad)]
    if camera is not None and camera.rho > 0.0:
        # A point at the height Z has the depth 1 / rho + Z.
        found.append(StaticFrame(config.frame_id, z_m=-1.0 / camera.rho))
    return tuple(found)


def fill_static_frames(
    message: Any,
    frames: Iterable[StaticFrame],
    stamp_ns: int,
    new_transform: Callable[[], Any],
) -> None:
    """Set a tf2_msgs/msg/TFMessage.

    Parameters
    ----------
    message
        What to set.
    frames
        What it tells.
    stamp_ns
        From when on, ns.
    new_transform
        Makes an empty geometry_msgs/msg/TransformStamped of the same family of classes.
    """
    transforms = []
    for frame in frames:
        stamped = new_transform()
        fill_stamp(stamped.header.stamp, stamp_ns)
        stamped.header.frame_id, stamped.child_frame_id = _ROOT, frame.name
        stamped.transform.translation.z = frame.z_m
        stamped.transform.rotation.z = math.sin(0.5 * frame.yaw_rad)
        stamped.transform.rotation.w = math.cos(0.5 * frame.yaw_rad)
        transforms.append(stamped)
    message.transforms = transforms
