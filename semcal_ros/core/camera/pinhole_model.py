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

"""The camera as a pinhole with polynomial distortion, for programs that know no other, and as ROS describes it.

OpenCV, ROS, mrcal and COLMAP share one model: ``x = X / Z``, ``y = Y / Z`` in the camera frame; radial factor
``(1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6)``; tangential terms ``2 p1 x y + p2 (r2 + 2 x2)`` and
``p1 (r2 + 2 y2) + 2 p2 x y``; then focal lengths and principal point (OpenCV documentation, "Camera Calibration and
3D Reconstruction"). It holds a microscope only in part: it has no skew and no residual field, its distortion is
centred on the principal point, and it has no parallel projection. What cannot be held is stated in px. ROS calls the
model with five coefficients ``plumb_bob``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.projection import ALL_NAMES, PARAMETER_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.thresholds import (
    COEFFICIENT_POWERS,
    COMPARED_ACROSS,
    COMPARED_HEIGHTS,
    FOCAL_LENGTH_MAX_PX,
    PLUMB_BOB_POINTS,
)
from semcal_ros.core.errors import InvalidValueError

#: Names of the distortion coefficients, in the order of OpenCV.
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, eq=False)
class PinholeModel:
    """A pinhole camera with distortion.

    Attributes
    ----------
    fx, fy, cx, cy
        Focal lengths and principal point, px; pixel (0, 0) is the centre of the first pixel.
    distortion
        (4,), (5,) or (8,) coefficients in the order of :data:`COEFFICIENTS`.
    rotation, translation_m
        (3,) rotation vector, rad, and (3,) translation, m, from the sem frame to the camera frame. The small rotation
        brings the principal point to the centre of the distortion.
    width, height
        Image size, px.
    worst_px, rms_px
        Largest and RMS distance from the camera that it stands for, over the field at heights within a tenth of the
        field width.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Array
    rotation: Array
    translation_m: Array
    width: int
    height: int
    worst_px: float = 0.0
    rms_px: float = 0.0

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, xyz_m: Array) -> Array:
        """Project sem-frame points (n, 3), m, to raw pixels (n, 2), with OpenCV."""
        points = np.ascontiguousarray(xyz_m, dtype=np.float64).reshape(-1, 1, 3)
        xy, _ = cv2.projectPoints(
            points, self.rotation, self.translation_m, self.matrix, self.distortion
        )
        return np.asarray(xy, dtype=np.float64).reshape(-1, 2)


def fit_pinhole(camera: ScanCamera, coefficients: int = 5) -> PinholeModel:
    """Fit a pinhole camera with distortion to a camera, by least squares over the field and some heights.

    Parameters
    ----------
    camera
        The camera at one magnification.
    coefficients
        Number of distortion coefficients: 4, 5 or 8 of :data:`COEFFICIENTS`.

    Raises
    ------
    InvalidValueError
        For another number of coefficients, or a camera that shows no part of its field.
    """
    if coefficients not in (4, 5, 8):
        raise InvalidValueError(f"{coefficients} distortion coefficients", expected="4, 5 or 8")
    points, raw = _sample(camera)
    focal = (
        camera.m / camera.rho
        if camera.rho * FOCAL_LENGTH_MAX_PX > camera.m
        else FOCAL_LENGTH_MAX_PX
    )
    distance_m = focal / camera.m
    # Coefficients in units in which the corner of the field is at r = 1, so that all unknowns matter alike.
    reach = 0.5 * np.hypot(camera.width, camera.height) / focal
    by_power = reach ** -np.array(COEFFICIENT_POWERS[:coefficients], dtype=np.float64)
    units = np.concatenate(
        [[focal, focal, 1.0, 1.0], by_power, [1.0 / focal] * 3, [1.0 / camera.m] * 2]
    )
    # The axis goes through the centre of the distortion; a shift keeps the image where it is.
    end = 4 + coefficients
    start = np.zeros(len(units))
    start[:4] = camera.aspect, 1.0 / camera.aspect, camera.ex, camera.ey
    start[end + 3 :] = camera.px - camera.ex, camera.py - camera.ey

    def build(unknowns: Array) -> PinholeModel:
        values = unknowns * units
        return PinholeModel(
            fx=float(values[0]),
            fy=float(values[1]),
            cx=float(values[2]),
            cy=float(values[3]),
            distortion=values[4:end].copy(),
            rotation=values[end : end + 3].copy(),
            translation_m=np.append(values[end + 3 :], distance_m),
            width=camera.width,
            height=camera.height,
        )

    # Weak ties hold what the field hardly determines: a turn that moves the image by 1000 px, which a shift undoes,
    # counts as one pixel at one of a thousand points.
    ties = np.concatenate(
        [np.zeros(4), np.full(coefficients, 1e-4), np.full(3, 1e-3), np.full(2, 1e-6)]
    )

    def error(unknowns: Array) -> Array:
        left = (build(unknowns).project(points) - raw).ravel()
        return np.concatenate([left, ties * (unknowns - start)])

    def derivative(unknowns: Array) -> Array:
        made = build(unknowns)
        jacobian = cv2.projectPoints(
            points[:, None], made.rotation, made.translation_m, made.matrix, made.distortion
        )[1]
        # OpenCV: rotation, translation, focal lengths, principal point, distortion.
        columns = [6, 7, 8, 9, *range(10, 10 + coefficients), 0, 1, 2, 3, 4]
        return np.concatenate([jacobian[:, columns] * units, np.diag(ties)])

    if _is_pinhole(camera):
        start[2:4] = camera.px, camera.py
        start[end + 3 :] = 0.0
        made = build(start)
    else:
        made = build(_minimise(error, derivative, start))
    distance = np.linalg.norm(made.project(points) - raw, axis=1)
    return replace(
        made,
        worst_px=float(distance.max()),
        rms_px=float(np.sqrt(np.mean(distance**2))),
    )


def _is_pinhole(camera: ScanCamera) -> bool:
    """Return whether a camera has neither distortion nor skew, as that of rectified images."""
    terms = ALL_NAMES[len(PARAMETER_NAMES) :]
    bends = (getattr(camera, name) for name in ("xi_r", "xi_t", "skew", *terms))
    return camera.residual is None and not any(bends)


def _sample(camera: ScanCamera) -> tuple[Array, Array]:
    """Return sem-frame points (n, 3), m, that fill the field at some heights, and their raw pixels (n, 2)."""
    down = max(2, round(COMPARED_ACROSS * camera.height / camera.width))
    x, y = np.meshgrid(
        np.linspace(0.0, camera.width - 1.0, COMPARED_ACROSS),
        np.linspace(0.0, camera.height - 1.0, down),
    )
    flat = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1))
    flat = flat[np.all(np.isfinite(flat), axis=1)]
    field_m = camera.width / camera.m
    heights = [h * field_m for h in COMPARED_HEIGHTS if 1.0 + camera.rho * h * field_m > 0.1]
    points = np.concatenate([camera.sem_from_ideal(flat, h) for h in heights])
    raw = camera.project(points)
    known = np.all(np.isfinite(raw), axis=1)
    if np.count_nonzero(known) < 30:
        raise InvalidValueError(
            f"a camera at {camera.magnification:g}x whose distortion leaves no image",
            expected="a calibration within its range",
        )
    return points[known], raw[known]


def _minimise(
    error: Callable[[Array], Array], derivative: Callable[[Array], Array], start: Array
) -> Array:
    from scipy.optimize import least_squares

    found = least_squares(
        error, start, derivative, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=300
    )
    return np.asarray(found.x, dtype=np.float64)


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
    # An image of one line, or one that distortion folds over, tells no model.
    if np.sum(good) < PLUMB_BOB_POINTS or min(width, height) < 2:
        return None
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
