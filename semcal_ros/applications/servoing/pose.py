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

"""Pose of a target in the stage plane, and how its image moves with the stage."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.applications.servoing.plane_camera import PlaneCamera
from semcal_ros.applications.servoing.target import TargetView
from semcal_ros.applications.servoing.thresholds import (
    MISREAD_PART,
    POSE_SETTLED_PX,
    POSE_STEPS_MAX,
)
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import as_points
from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True)
class PlanePose:
    """Pose in the stage plane.

    A point x of the target lies at ``R(angle) x + (x_m, y_m)`` in the sem frame.

    Parameters
    ----------
    x_m, y_m
        Origin of the target in the sem frame, m.
    angle_rad
        From x towards y.
    """

    x_m: float
    y_m: float
    angle_rad: float = 0.0

    def __post_init__(self) -> None:
        if not np.all(np.isfinite(self.values)):
            raise InvalidValueError(f"a pose {self.values.tolist()}", expected="finite numbers")

    @property
    def values(self) -> Array:
        """(3,) x, y in m and the angle in rad."""
        return np.array([self.x_m, self.y_m, self.angle_rad], dtype=np.float64)

    @property
    def rotation(self) -> Array:
        """(2, 2) rotation."""
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return np.array([[c, -s], [s, c]])

    def apply(self, target_xy_m: ArrayLike) -> Array:
        """Transform points (n, 2) of the target to the sem frame, m."""
        moved: Array = as_points(target_xy_m, 2) @ self.rotation.T + self.values[:2]
        return moved

    def displace(self, dx_m: float, dy_m: float, turn_rad: float = 0.0) -> PlanePose:
        """Return the pose after a displacement and a turn about the target's origin."""
        return PlanePose(self.x_m + dx_m, self.y_m + dy_m, self.angle_rad + turn_rad)

    def minus(self, other: PlanePose) -> Array:
        """Subtract another pose: (3,) difference, with the angle between -pi and pi."""
        difference: Array = self.values - other.values
        difference[2] = math.remainder(float(difference[2]), 2.0 * math.pi)
        return difference


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Pose of a target in one image.

    Attributes
    ----------
    pose
        The pose; always finite, but meaningless if ``reason`` is given.
    covariance
        (3, 3) of x, y in m and the angle in rad, from the scatter of the corners. It does not
        include errors of the camera itself.
    scale, scale_sigma
        Seen size of the target over its size according to the camera, and the 1-sigma of that.
    rms_px
        RMS distance of the corners from where the pose puts them.
    view
        The markers that were used.
    reason
        Why there is no pose; empty if there is one.
    """

    pose: PlanePose
    covariance: Array
    scale: float
    scale_sigma: float
    rms_px: float
    view: TargetView
    reason: str = ""

    @property
    def accepted(self) -> bool:
        """Whether there is a pose."""
        return not self.reason


def fit_pose(view: TargetView, camera: PlaneCamera) -> PoseFit:
    """Fit the most likely pose of a target to its markers.

    Weighted least squares over all corners in pixels, the scale given by the camera; markers that
    contradict most others are left out.

    Parameters
    ----------
    view
        Markers in rectified pixels.
    camera
        Camera of this image.
    """
    if not view.accepted:
        return _reject(view, view.reason)
    kept, scale = view, 1.0
    start = PlanePose(0.0, 0.0)
    while True:
        start, scale = _fit_similarity(kept, camera)
        misfit = np.linalg.norm(_compute_residual(kept, camera, start, scale), axis=2).max(axis=1)
        sides = np.linalg.norm(np.roll(kept.xy, -1, axis=1) - kept.xy, axis=2).mean(axis=1)
        excess = misfit / (MISREAD_PART * sides)
        if float(excess.max()) <= 1.0:
            break
        if len(kept.ids) <= 2 or 2 * (len(kept.ids) - 1) < len(view.ids):
            return _reject(view, "the markers contradict each other")
        kept = kept.select(np.arange(len(kept.ids)) != int(np.argmax(excess)))
    return _adjust(kept, camera, start, scale)


def _reject(view: TargetView, reason: str) -> PoseFit:
    spread = np.full((3, 3), np.inf)
    return PoseFit(
        PlanePose(0.0, 0.0), spread, float("nan"), float("nan"), float("nan"), view, reason
    )


def _fit_similarity(view: TargetView, camera: PlaneCamera) -> tuple[PlanePose, float]:
    """Fit pose and scale by least squares in the plane, as complex b = scale exp(i angle) a + c."""
    seen = camera.plane_from_px(view.xy.reshape(-1, 2)) @ np.array([1.0, 1.0j])
    target = view.target_xy_m.reshape(-1, 2) @ np.array([1.0, 1.0j])
    # Small markers are located as well as large ones in px, but constrain the whole less.
    spread = target - target.mean()
    factor = complex(np.sum(np.conj(spread) * (seen - seen.mean())) / np.sum(np.abs(spread) ** 2))
    origin = complex(seen.mean() - factor * target.mean())
    return PlanePose(origin.real, origin.imag, float(np.angle(factor))), abs(factor)


def _compute_residual(
    view: TargetView, camera: PlaneCamera, pose: PlanePose, scale: float = 1.0
) -> Array:
    """Compute the (n, 4, 2) residuals of the corners, px."""
    predicted = camera.project(pose.apply(scale * view.target_xy_m.reshape(-1, 2)))
    residual: Array = view.xy - predicted.reshape(view.xy.shape)
    return residual


def _adjust(view: TargetView, camera: PlaneCamera, start: PlanePose, scale: float) -> PoseFit:
    whitening = _form_whitening(view)
    pose, converged = start, False
    design, residual = np.empty((0, 3)), np.empty(0)
    target_xy_m = view.target_xy_m.reshape(-1, 2)
    for _ in range(POSE_STEPS_MAX):
        residual = _whiten(whitening, _compute_residual(view, camera, pose))
        moved = pose.apply(target_xy_m)
        slope = compute_interaction_of_points(camera, moved, pose.values[:2])
        design = _whiten(whitening, slope.reshape(len(view.ids), 8, 3))
        # Columns of m and rad differ by seven orders of magnitude.
        size = np.linalg.norm(design, axis=0)
        step = np.linalg.lstsq(design / size, residual, rcond=None)[0] / size
        pose = pose.displace(*(float(v) for v in step))
        if float(np.max(np.abs(slope @ step))) < POSE_SETTLED_PX:
            converged = True
            break
    left = _compute_residual(view, camera, pose)
    residual = _whiten(whitening, left)
    size = np.linalg.norm(design, axis=0)
    normal = (design / size).T @ (design / size)
    # If the corners scatter more than their covariance says, the pose does, too.
    factor = max(1.0, float(residual @ residual) / max(len(residual) - 3, 1))
    covariance = np.linalg.inv(normal) / np.outer(size, size) * factor
    rms_px = float(np.sqrt(np.mean(np.sum(left**2, axis=2))))
    pose = PlanePose(pose.x_m, pose.y_m, math.remainder(pose.angle_rad, 2.0 * math.pi))
    reason = "" if converged else f"the pose did not converge in {POSE_STEPS_MAX} steps"
    return PoseFit(pose, covariance, scale, _compute_scale_sigma(view), rms_px, view, reason)


def _compute_scale_sigma(view: TargetView) -> float:
    """Compute the 1-sigma of the scale from the scatter of the corners and their extent."""
    flat = view.xy.reshape(-1, 2)
    reach = float(np.sum((flat - flat.mean(axis=0)) ** 2))
    variance = float(np.trace(view.covariance_px2, axis1=1, axis2=2).mean()) / 8.0
    return math.sqrt(variance / max(reach, 1e-9))


def _form_whitening(view: TargetView) -> Array:
    """Form (n, 8, 8) inverse Cholesky factors of the markers' covariances."""
    floor = 1e-8 * np.eye(8)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(view.covariance_px2 + floor)))


def _whiten(whitening: Array, values: Array) -> Array:
    """Whiten (n, 4, 2) or (n, 8, k) to values (8 n, ...)."""
    if values.ndim == 3 and values.shape[1:] == (4, 2):
        return np.asarray(np.einsum("nij,nj->ni", whitening, values.reshape(-1, 8)).reshape(-1))
    return np.asarray((whitening @ values).reshape(-1, values.shape[-1]))


def compute_interaction_of_points(camera: PlaneCamera, xy_m: Array, centre_m: Array) -> Array:
    """As :func:`compute_interaction_matrix`, (2n, 3), for points (n, 2) of the plane, m."""
    slope = camera.jacobian(xy_m)
    arm = xy_m - centre_m
    turned = np.column_stack([-arm[:, 1], arm[:, 0]])
    return np.concatenate([slope, slope @ turned[:, :, None]], axis=2).reshape(-1, 3)


def compute_interaction_matrix(camera: PlaneCamera, xy: ArrayLike, centre_m: ArrayLike) -> Array:
    """Compute the derivative of rectified pixels with respect to the stage velocity in the sem frame.

    P_g of the frame is known, and with it the depth 1 / rho of the stage plane, so a pixel has one
    position in the plane. No depth has to be estimated, as it has for other cameras (Chaumette and
    Hutchinson 2006, doi:10.1109/MRA.2006.250573).

    Parameters
    ----------
    camera
        Camera of the frame.
    xy
        (n, 2) rectified pixels of points that the stage carries.
    centre_m
        (2,) where the axis of rotation meets the plane, m.

    Returns
    -------
    (2n, 3): rows u, v of each point; columns px per m for x and y, px per rad for the rotation from
    x towards y.
    """
    centre = np.asarray(centre_m, dtype=np.float64).reshape(2)
    return compute_interaction_of_points(camera, camera.plane_from_px(xy), centre)
