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

"""Starting values of a calibration: scales and poses from the affine part of every view.

They presume only the nominal scale (magnification, image width, display width) and zero distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import (
    AffineView,
    mirrored_tilt,
    rotation_from_affine,
    view_affine,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError
from semcal_ros.core.wording import counted

__all__ = ["InitialValues", "initial_values", "pose_from_camera"]


# Ratio of the field width to the distance of the pivot. Noise and distortion imitate a few hundredths; an SEM at 100x
# has 0.06 to 0.15, at 60x with a pivot of 4 mm 0.5, and a photographic lens about 1.
_WIDE = 0.7


@dataclass(frozen=True)
class InitialValues:
    """Starting values of the adjustment.

    Attributes
    ----------
    scale_factor
        Observed over nominal scale, median over the views.
    rho
        Inverse pivot distance, 1/m.
    rotations, translations_m
        (V, 3, 3) and (V, 3).
    wide
        Whether the perspective within the widest view is so strong that it determines ``rho`` by
        itself, as in a photograph.
    """

    scale_factor: float
    rho: float
    rotations: Array
    translations_m: Array
    wide: bool


def _estimate_rho(affines: Sequence[AffineView], rotations: Array, fallback: float) -> float:
    """Fit |depth gradient| = rho * sin(tilt) by least squares, weighted by the field of view."""
    gradient = np.array([np.linalg.norm(a.gradient) for a in affines])
    tilt = np.linalg.norm(rotations[:, 2, :2], axis=1)
    # Noise of the gradient grows with the scale, since it acts over a smaller field.
    weight = np.array([a.scale for a in affines]) ** -4.0
    denominator = float(np.sum(weight * tilt * tilt))
    if denominator <= 0.0:
        return fallback
    return float(np.sum(weight * gradient * tilt) / denominator)


def initial_values(
    views: Sequence[GridView], nominal_px_per_m: Array, centre_px: Array, rho_prior: float
) -> InitialValues:
    """Estimate starting values from V views and their nominal scales (V,) in px per m."""
    affines = [view_affine(v.board_xy_m, v.image_xy, centre_px) for v in views]
    ratios = np.array([a.scale for a in affines]) / nominal_px_per_m
    factor = float(np.median(ratios))
    rotations = np.stack([rotation_from_affine(a.matrix, a.gradient) for a in affines])
    rho = _estimate_rho(affines, rotations, rho_prior)
    board = np.stack([a.board_xy_m for a in affines])
    translations = -np.einsum("vij,vj->vi", rotations[:, :, :2], board)
    # The grid point at the image centre lies on the axis: at the reference plane, unless its scale
    # determines its height.
    wide = _is_wide(rho, (2.0 * centre_px[0] + 1.0) / min(a.scale for a in affines))
    if wide:
        translations[:, 2] += (factor / ratios - 1.0) / rho
    return InitialValues(factor, rho, rotations, translations, wide)


def _is_wide(rho: float, field_m: float) -> bool:
    return bool(rho * field_m > _WIDE)


def pose_from_camera(view: GridView, camera: ScanCamera) -> tuple[Array, Array]:
    """Estimate two candidate poses of a view under a known camera.

    Returns
    -------
    rotations, translations_m
        (2, 3, 3) and (2, 3): the pose from the affine part of the undistorted view, and its
        mirrored tilt.

    Raises
    ------
    CalibrationError
        If the camera can undistort fewer than four corners of the view.
    """
    ideal = camera.undistort(view.image_xy)
    known = np.all(np.isfinite(ideal), axis=1)
    if known.sum() < 4:
        raise CalibrationError(
            f"view {view.name}, in which the calibration can undistort only {counted(known.sum(), 'corner')}",
            expected="images of the microscope that was calibrated",
            do="check the magnification and --display-width",
        )
    principal = np.array([camera.px, camera.py])
    centre = np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1)])
    affine = view_affine(view.board_xy_m[known], ideal[known], centre)
    metric = np.asarray(
        np.linalg.solve(camera.ideal_from_sem_jacobian, affine.matrix), dtype=np.float64
    )
    rotation = rotation_from_affine(metric, affine.gradient)
    both = np.stack([rotation, mirrored_tilt(rotation[None])[0]])
    offset = np.linalg.solve(camera.ideal_from_sem_jacobian, centre - principal)
    # The grid plane passes through the reference plane on the axis of the image centre, unless its
    # scale determines its height.
    depth = 1.0
    if _is_wide(camera.rho, camera.width / camera.m):
        depth = 1.0 / float(np.linalg.norm(metric, 2))
    translations = -both[:, :, :2] @ affine.board_xy_m
    translations[:, :2] += depth * offset
    if depth != 1.0:
        translations[:, 2] += (depth - 1.0) / camera.rho
    return both, translations
