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

"""Cameras as files of other programs: of OpenCV, ROS, mrcal, COLMAP, and of ImageJ and Fiji.

Formats: OpenCV ``FileStorage`` in YAML; the calibration files of ROS's ``camera_info_manager``; ``.cameramodel``
of mrcal (its documentation, "Camera model file formats"); ``cameras.txt`` of COLMAP (its documentation, "Output
Format"). COLMAP counts pixels from the corner of the first pixel, the others from its centre. ImageJ
and Fiji take the scale from a macro, and the distortion from a map, which other programs read, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import yaml

from semcal_ros.core.arrays import Array, Array32
from semcal_ros.core.camera.pinhole_model import PinholeModel, PlumbBobCamera
from semcal_ros.core.camera.scan_camera import ScanCamera


def format_opencv(
    camera: PinholeModel, pixel_size_m: tuple[float, float], notes: Sequence[str]
) -> str:
    """Format as YAML for ``cv2.FileStorage``."""
    file = cv2.FileStorage("camera.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for note in notes:
        file.writeComment(note)
    file.write("image_width", camera.width)
    file.write("image_height", camera.height)
    file.write("camera_matrix", camera.matrix)
    file.write("distortion_coefficients", np.asarray(camera.distortion).reshape(1, -1))
    file.write("rotation_vector", np.asarray(camera.rotation).reshape(3, 1))
    file.write("translation_vector", np.asarray(camera.translation_m).reshape(3, 1))
    file.write("pixel_size_m", np.array([pixel_size_m]))
    file.write("largest_difference_px", camera.worst_px)
    file.write("rms_difference_px", camera.rms_px)
    return str(file.releaseAndGetString())


def format_ros(
    camera: PinholeModel | PlumbBobCamera, size: tuple[int, int], name: str, notes: Sequence[str]
) -> str:
    """Format as the calibration file of ``camera_info_manager``, for images of (width, height) ``size``.

    A :class:`.PlumbBobCamera` has the rectification that the nodes state in ``camera_info``; a pinhole model none.
    """
    if isinstance(camera, PlumbBobCamera):
        matrix, distortion = camera.K, camera.D
        rectification, projection = camera.R, camera.P
    else:
        matrix, distortion = camera.matrix, camera.distortion
        rectification, projection = np.eye(3), np.hstack([camera.matrix, np.zeros((3, 1))])
    data = {
        "image_width": size[0],
        "image_height": size[1],
        "camera_name": name,
        "camera_matrix": _table(matrix),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": _table(np.asarray(distortion)[None]),
        "rectification_matrix": _table(rectification),
        "projection_matrix": _table(projection),
    }
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100_000)
    return "".join(f"# {note}\n" for note in notes) + str(text)


def _table(values: Array) -> dict[str, object]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": [float(v) for v in values.ravel()]}


def format_mrcal(camera: PinholeModel, notes: Sequence[str]) -> str:
    """Format as ``.cameramodel`` with the model LENSMODEL_OPENCV4, 5 or 8; extrinsics from the sem frame, m."""
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    extrinsics = [*camera.rotation, *camera.translation_m]
    lines = [f"# {note}" for note in notes]
    lines += [
        "{",
        f"    'lensmodel':  'LENSMODEL_OPENCV{len(camera.distortion)}',",
        f"    'extrinsics': [ {', '.join(repr(float(v)) for v in extrinsics)}, ],",
        f"    'intrinsics': [ {', '.join(repr(float(v)) for v in intrinsics)}, ],",
        f"    'imagersize': [ {camera.width}, {camera.height}, ],",
        "}",
    ]
    return "\n".join(lines) + "\n"


def format_colmap(camera: PinholeModel, notes: Sequence[str]) -> str:
    """Format as ``cameras.txt`` with the model OPENCV or FULL_OPENCV."""
    model = "OPENCV" if len(camera.distortion) == 4 else "FULL_OPENCV"
    distortion = np.zeros(4 if model == "OPENCV" else 8)
    distortion[: len(camera.distortion)] = camera.distortion
    values = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *distortion]
    numbers = " ".join(repr(float(v)) for v in values)
    lines = [f"# {note}" for note in notes]
    lines += [
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        f"1 {model} {camera.width} {camera.height} {numbers}",
    ]
    return "\n".join(lines) + "\n"


def format_macro(pixel_size_m: tuple[float, float], notes: Sequence[str]) -> str:
    """Format a macro that sets the pixel size of the current image."""
    x_nm, y_nm = (1e9 * size for size in pixel_size_m)
    lines = [f"// {note}" for note in notes]
    lines.append(f'setVoxelSize({x_nm!r}, {y_nm!r}, 1, "nm");')
    return "\n".join(lines) + "\n"


def compute_raw_map(camera: ScanCamera) -> Array32:
    """Compute x and y of the raw pixel that each rectified pixel shows, (2, height, width) px.

    They are NaN where there is none.
    """
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    raw = camera.raw_from_rect(np.stack([x.ravel(), y.ravel()], axis=1))
    shape = (camera.height, camera.width)
    return np.stack([raw[:, k].reshape(shape) for k in (0, 1)]).astype(np.float32)
