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
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.camera.projection import PARAMETER_NAMES, project_points_with_jacobians
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.uncertainty import make_field_lattice

# Prior on the change of a pose without distortion, rad: directions that a view does not constrain
# must not diverge.
_TURN_RAD = 0.1
# The same for the height, m.
_HEIGHT_M = 1e-4


def compute_displacements(camera: ScanCamera, across: int = 13) -> tuple[Array, Array]:
    """Compute ideal pixels on a lattice and their displacements; NaN where undefined."""
    xy = make_field_lattice(camera.width, camera.height, across)
    return xy, camera.distort(xy) - xy


def remove_residual_field(camera: ScanCamera) -> ScanCamera:
    """Return the camera with only its parametric distortion."""
    return replace(camera, residual=None)


def compute_rms_without_distortion(result: CalibrationResult) -> dict[float, float]:
    """Compute the RMS error in px at each magnification without distortion correction.

    The poses are fitted again, linearly about those of the result.
    """
    squares: dict[float, list[Array]] = {}
    pull = np.diag([1.0 / _TURN_RAD] * 3 + [0.0, 0.0, 1.0 / _HEIGHT_M])
    poses = zip(result.fit.rotations, result.fit.translations_m, strict=True)
    for view, (rotation, translation) in zip(result.views, poses, strict=True):
        camera = remove_residual_field(result.model.at(view.magnification))
        straight = camera.parameters[: len(PARAMETER_NAMES)].copy()
        straight[[PARAMETER_NAMES.index("xi_r"), PARAMETER_NAMES.index("xi_t")]] = 0.0
        turned = view.board_xy_m @ rotation[:, :2].T
        points = turned + translation
        jacobian = project_points_with_jacobians(straight, points, camera.raster).d_xyz
        x, y, z = turned.T
        o = np.zeros_like(x)
        turns = np.stack([o, z, -y, -z, o, x, y, -x, o], axis=1).reshape(-1, 3, 3)
        columns = np.concatenate([jacobian @ turns, jacobian], axis=2)
        error = view.known_residuals(view.image_xy - camera.project_ideal(points))
        columns = np.stack([view.known_residuals(columns[..., k]) for k in range(6)], axis=2)
        columns, error = columns.reshape(-1, 6), error.ravel()
        known = np.isfinite(error) & np.all(np.isfinite(columns), axis=1)
        normal = columns[known].T @ columns[known] + pull.T @ pull
        scaled, scale = equilibrate(normal)
        right = scale * (columns[known].T @ error[known])
        step = scale * np.linalg.lstsq(scaled, right, rcond=None)[0]
        squares.setdefault(float(view.magnification), []).append(
            view.dimensions * (error[known] - columns[known] @ step) ** 2
        )
    return {g: float(np.sqrt(np.mean(np.concatenate(s)))) for g, s in sorted(squares.items())}
