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

"""Predicted errors of positions over the image field, from the covariance of a camera."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.projection import project_points_with_jacobians
from semcal_ros.core.camera.scan_camera import ScanCamera


def make_field_lattice(width: int, height: int, across: int) -> Array:
    """Make (n, 2) pixels on a regular lattice from edge to edge of the field, row by row."""
    down = max(2, round(across * height / width))
    x, y = np.meshgrid(np.linspace(0, width - 1, across), np.linspace(0, height - 1, down))
    return np.stack([x.ravel(), y.ravel()], axis=1)


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
    moved = project_points_with_jacobians(camera.parameters, points, camera.raster).d_xyz
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
