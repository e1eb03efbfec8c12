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

"""What the calibration does not know, in the drift."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.thresholds import VISIT_SCALE

# Places of the parameters in ScanCamera.covariance.
_SCALES, _CENTRE = slice(0, 3), slice(3, 5)


def _scale_jacobian(camera: ScanCamera, *vectors: Array) -> Array:
    """(2 n, 3) derivative by m, aspect and skew of n lengths in the sem frame that span given
    pixels.
    """
    m, a, s = camera.m, camera.aspect, camera.skew
    u: list[float] = []
    v: list[float] = []
    for x, y in (vector.tolist() for vector in vectors):
        u += (a * x + s * y, m * x, m * y)
        v += (y / a, -m * y / a**2, 0.0)
    by = -np.linalg.solve(camera.ideal_from_sem_jacobian, np.array([u, v]))
    return np.asarray(by.reshape(2, -1, 3).swapaxes(0, 1).reshape(-1, 3))


def scale_covariance(camera: ScanCamera | None, drift: Array, velocity: Array) -> Array:
    """(4, 4) covariance of drift and velocity from that of the camera's scale, aspect and skew.

    Zero without a camera (the drift is in pixels) and for a camera that is known exactly.
    """
    if camera is None or camera.covariance is None:
        return np.zeros((4, 4))
    jacobian = _scale_jacobian(camera, drift, velocity)
    return np.asarray(jacobian @ camera.covariance[_SCALES, _SCALES] @ jacobian.T)


def relative_scale_sigma(camera: ScanCamera | None) -> float:
    """1-sigma of the camera's scale as a fraction of it; 0 where it is known exactly."""
    if camera is None or camera.covariance is None:
        return 0.0
    return float(np.sqrt(max(camera.covariance[0, 0], 0.0))) / camera.m


def centre_covariance(camera: ScanCamera | None) -> Array:
    """(2, 2) covariance of the camera's principal point, in half widths of the raster; zero where that is exact."""
    if camera is None or camera.covariance is None:
        return np.zeros((2, 2))
    return np.asarray(camera.covariance[_CENTRE, _CENTRE]) / camera.norm_px**2


def apparent_zoom_shift(before: ScanCamera, after: ScanCamera) -> Array:
    """(2, 2) metres that a change of magnification seems to move the specimen by, the other way, per half width of the
    raster of error of the principal point that both cameras share. Another number of pixels is no such change.
    """
    by_error = [np.linalg.inv(c.ideal_from_sem_jacobian) * c.norm_px for c in (before, after)]
    return np.asarray(by_error[1] - by_error[0])


def zoom_covariance(before: ScanCamera, after: ScanCamera) -> Array:
    """(2, 2) covariance in m^2 of the step that a change of magnification seems to make because of
    errors of the two scales.

    They move the specimen in proportion to the distance of the image's middle from the principal
    point, about which the zoom is.
    """
    covariance = np.zeros((2, 2))
    for camera in (before, after):
        middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
        from_centre = np.linalg.solve(
            camera.ideal_from_sem_jacobian, middle - np.array([camera.px, camera.py])
        )
        covariance += scale_covariance(camera, from_centre, np.zeros(2))[:2, :2]
    return covariance


def visit_scale_variance(before: ScanCamera | None, after: ScanCamera | None) -> float:
    """Variance of the ratio of the scales of two visits, as fractions of them."""
    stated = relative_scale_sigma(before) ** 2 + relative_scale_sigma(after) ** 2
    return max(stated, VISIT_SCALE**2)


def visit_stretch_covariance(before: ScanCamera, after: ScanCamera, height_px: float) -> Array:
    """(2, 2) covariance in m^2 of the shear between the first and the last row of a frame of ``height_px`` that the
    scales of two visits seem to make: a frame that is taller by a part in 1000 looks like one that moves in y.
    """
    covariance = np.zeros((2, 2))
    for camera in (before, after):
        factor = height_px * camera.m / after.m
        rows = np.linalg.solve(camera.ideal_from_sem_jacobian, np.array([0.0, factor]))
        covariance += scale_covariance(camera, rows, np.zeros(2))[:2, :2]
        covariance += 0.5 * VISIT_SCALE**2 * np.outer(rows, rows)
    return covariance
