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

"""Predicted errors of a calibration, and errors without distortion correction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array, equilibrate
from semcal_ros.core.calibration.calibrate import CalibrationResult
from semcal_ros.core.camera.projection import ProjectionJacobians, project_points_with_jacobians
from semcal_ros.core.camera.scan_camera import ScanCamera

__all__ = [
    "compute_displacements",
    "compute_rms_without_distortion",
    "make_field_lattice",
    "predict_aligned_sigma_px",
    "predict_shape_sigma_px",
    "remove_residual_field",
]


# Prior on the change of a pose without distortion, rad: directions that a view does not constrain
# must not diverge.
_TURN_RAD = 0.1
# The same for the height, m.
_HEIGHT_M = 1e-4


def make_field_lattice(width: int, height: int, across: int) -> Array:
    """Make (n, 2) pixels on a regular lattice from edge to edge of the field, row by row."""
    down = max(2, round(across * height / width))
    x, y = np.meshgrid(np.linspace(0, width - 1, across), np.linspace(0, height - 1, down))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def compute_displacements(camera: ScanCamera, across: int = 13) -> tuple[Array, Array]:
    """Compute ideal pixels on a lattice and their displacements; NaN where undefined."""
    xy = make_field_lattice(camera.width, camera.height, across)
    return xy, camera.distort(xy) - xy


def remove_residual_field(camera: ScanCamera) -> ScanCamera:
    """Return the camera with only its parametric distortion."""
    return replace(camera, residual=None)


def _compute_jacobians(camera: ScanCamera, points: Array) -> ProjectionJacobians:
    return project_points_with_jacobians(camera.parameters, points, camera.norm_px)


def _compute_larger_sigma(difference: Array, covariance: Array) -> Array:
    """Compute (n,) 1-sigma along the worse axis from (n, 2, k) derivatives; NaN if unknown."""
    spread = np.einsum("nip,pq,njq->nij", difference, covariance, difference, optimize=True)
    known = np.all(np.isfinite(spread), axis=(1, 2))
    out = np.full(len(difference), np.nan)
    out[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(spread[known])[:, -1], 0.0))
    return out


def predict_shape_sigma_px(camera: ScanCamera, xy: Array) -> Array:
    """Predict the (n,) 1-sigma, px, of positions relative to the image centre, worse axis.

    The points lie in the reference plane and are seen at ideal pixels ``xy``. A common shift of the
    image drops out: it trades off against the position of the specimen, which no measurement
    within one image needs.
    """
    covariance = camera.joint_covariance
    if covariance is None:
        return np.zeros(len(xy))
    centre = np.array([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]])
    points = camera.sem_from_ideal(np.concatenate([centre, xy]))
    jacobian = camera.project_jacobian(points)
    return _compute_larger_sigma(jacobian[1:] - jacobian[:1], covariance)


def predict_aligned_sigma_px(camera: ScanCamera, xy: Array) -> Array:
    """Predict as :func:`predict_shape_sigma_px`, after the best shift, turn and scale.

    This is what remains when the pose of a flat specimen is fitted to the image, so it is the part
    of the predicted error that reprojection errors can show.
    """
    covariance = camera.joint_covariance
    if covariance is None:
        return np.zeros(len(xy))
    points = camera.sem_from_ideal(xy)
    # The moves of the specimen span the same images with and without the small residual field.
    moved = _compute_jacobians(camera, points).d_xyz
    jacobian = camera.project_jacobian(points)
    known = np.all(np.isfinite(jacobian), axis=(1, 2))
    if not np.any(known):
        return np.full(len(xy), np.nan)
    x, y = (points[known, :2] - points[known, :2].mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    moves = np.stack([np.stack([one, zero, -y, x], 1), np.stack([zero, one, x, y], 1)], 1)
    columns = (moved[known][:, :, :2] @ moves).reshape(-1, 4)
    basis = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]
    rows = jacobian[known].reshape(-1, jacobian.shape[2])
    left = (rows - basis @ (basis.T @ rows)).reshape(-1, 2, jacobian.shape[2])
    out = np.full(len(xy), np.nan)
    out[known] = _compute_larger_sigma(left, covariance)
    return out


def compute_rms_without_distortion(result: CalibrationResult) -> dict[float, float]:
    """Compute the RMS error in px at each magnification without distortion correction.

    The poses are fitted again, linearly about those of the result.
    """
    squares: dict[float, list[Array]] = {}
    pull = np.diag([1.0 / _TURN_RAD] * 3 + [0.0, 0.0, 1.0 / _HEIGHT_M])
    poses = zip(result.fit.rotations, result.fit.translations_m, strict=True)
    for view, (rotation, translation) in zip(result.views, poses, strict=True):
        camera = remove_residual_field(result.model.at(view.magnification))
        straight = replace(camera, xi_r=0.0, xi_t=0.0)
        turned = view.board_xy_m @ rotation[:, :2].T
        points = turned + translation
        jacobian = _compute_jacobians(straight, points).d_xyz
        x, y, z = turned.T
        o = np.zeros_like(x)
        turns = np.stack([o, z, -y, -z, o, x, y, -x, o], axis=1).reshape(-1, 3, 3)
        columns = np.concatenate([jacobian @ turns, jacobian], axis=2).reshape(-1, 6)
        error = (view.image_xy - straight.project_ideal(points)).ravel()
        known = np.isfinite(error) & np.all(np.isfinite(columns), axis=1)
        normal = columns[known].T @ columns[known] + pull.T @ pull
        scaled, scale = equilibrate(normal)
        right = scale * (columns[known].T @ error[known])
        step = scale * np.linalg.lstsq(scaled, right, rcond=None)[0]
        squares.setdefault(float(view.magnification), []).append(
            (error[known] - columns[known] @ step) ** 2
        )
    # Two components per corner.
    return {g: float(np.sqrt(2.0 * np.mean(np.concatenate(s)))) for g, s in sorted(squares.items())}
