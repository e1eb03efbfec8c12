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

"""The raw picture in the camera model that other programs know: OpenCV's, which ROS calls ``plumb_bob``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.thresholds import PLUMB_BOB_POINTS


@dataclass(frozen=True)
class PlumbBobCamera:
    """A camera as in sensor_msgs/CameraInfo; rectified pixels are ``P (x, y, 1)`` of rays ``R`` turns.

    Attributes
    ----------
    K, D, R, P
        (3, 3), (5,) k1 k2 p1 p2 k3, (3, 3) and (3, 4).
    worst_px
        Largest distance on a grid over the image between this model and the calibration, px. A
        skew, which the model lacks, and what five coefficients cannot follow, remain in it.
    """

    K: Array
    D: Array
    R: Array
    P: Array
    worst_px: float


def _distort(q: Array, d: Array) -> Array:
    """Apply the model (n, 2) to (n, 2) with k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = d
    x, y = q[:, 0], q[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.column_stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    )


def fit_plumb_bob(camera: ScanCamera, width: int, height: int) -> PlumbBobCamera | None:
    """Fit the model to a camera for images of this size; None for one without a finite K.

    ``P`` is that of the rectified image. ``R`` turns the centre of the distortion onto the axis,
    where the model has it: a principal point is hardly seen at these focal lengths, and lies elsewhere.
    """
    fitted = camera.resized(width, height)
    if not fitted.rho > 0.0:
        return None
    rect = fitted.rectified
    f = float(rect.K[0, 0])
    if not np.isfinite(f):
        return None
    n = 0.5 * width
    xs, ys = (
        np.linspace(0.0, width - 1.0, PLUMB_BOB_POINTS),
        np.linspace(0.0, height - 1.0, PLUMB_BOB_POINTS),
    )
    rect_px = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    raw_px = fitted.raw_from_rect(rect_px)
    good = np.all(np.isfinite(raw_px), axis=1)
    rect_px, raw_px = rect_px[good], raw_px[good]
    centre = np.array([rect.ex, rect.ey])
    offset = (centre - rect.K[:2, 2]) / f
    # The rays of the raw camera, turned by R, are those of the rectified one. Half of the skew is a
    # turn about the axis.
    turn = Rotation.from_euler("xyz", [-np.arctan(offset[1]), np.arctan(offset[0]), 0.0])
    turn = turn * Rotation.from_euler("z", 0.5 * fitted.skew)
    rays = np.column_stack([(rect_px - rect.K[:2, 2]) / f, np.ones(len(rect_px))])
    seen = turn.inv().apply(rays)
    # In half image widths, so that all unknowns are of order one.
    q = seen[:, :2] / seen[:, 2:] * (f / n)

    def project(theta: Array) -> Array:
        return theta[2:4] + n * theta[:2] * _distort(q, theta[4:])

    def residuals(theta: Array) -> Array:
        return np.ravel(project(theta) - raw_px)

    start = np.concatenate([[1.0, 1.0], fitted.raw_from_rect(centre[None])[0], np.zeros(5)])
    if not np.all(np.isfinite(start)):
        return None
    theta = least_squares(residuals, start, x_scale="jac", ftol=1e-12, xtol=1e-12).x
    per = n / f
    d = theta[4:] / np.array([per**2, per**4, per, per, per**6])
    k = np.array([[f * theta[0], 0.0, theta[2]], [0.0, f * theta[1], theta[3]], [0.0, 0.0, 1.0]])
    return PlumbBobCamera(
        K=k,
        D=d,
        R=turn.as_matrix(),
        P=np.column_stack([rect.K, np.zeros(3)]),
        worst_px=float(np.hypot(*(project(theta) - raw_px).T).max()),
    )
