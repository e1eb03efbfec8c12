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

"""sensor_msgs/msg/CameraInfo of rectified images: see ``doc/model.md``, "Square pixels"."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from semcal_ros.bridge.fields import assign_floats
from semcal_ros.bridge.headers import HeaderMessage, copy_header
from semcal_ros.core.camera.scan_camera import ScanCamera

if TYPE_CHECKING:  # its fit needs scipy.optimize, which takes long to import
    from semcal_ros.core.camera.plumb_bob import PlumbBobCamera


# Matrices of three rows, row by row.
_ZEROS: list[float] = [0.0] * 9
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


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
