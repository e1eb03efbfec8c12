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

"""What the uncertainty of nm per pixel, and of a length in an image, consists of; and the errors that a camera's
covariance predicts over the field. The 1-sigma of a pixel size itself is that of its camera,
:attr:`~semcal_ros.core.camera.scan_camera.ScanCamera.pixel_size_sigma_m`.

The parts are independent and add as variances (JCGM 100:2008, "GUM", 5.1.2); the expanded uncertainty has the coverage
factor 2, which is 95 % for a normal distribution (6.2.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.projection import project_points_with_jacobians
from semcal_ros.core.camera.scan_camera import RectifiedCamera, ScanCamera
from semcal_ros.core.camera.thresholds import (
    COVERAGE_FACTOR,
    JUDGED_MAGNIFICATIONS,
    LENGTH_PLACES,
    SPECIMEN_TILT_SIGMA_RAD,
)
from semcal_ros.core.errors import InvalidValueError


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
    specimen drops out, the one that keeps in place what is seen at the centre: no measurement within
    one image needs its position. A shift of the image instead would leave what the distortion does
    to it, and count that the principal point is uncertain.
    """
    covariance = camera.joint_covariance
    if covariance is None:
        return np.zeros(len(xy))
    centre = np.array([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]])
    points = camera.sem_from_ideal(np.concatenate([centre, xy]))
    jacobian = camera.project_jacobian(points)
    moved = project_points_with_jacobians(
        camera.parameters, points, camera.raster, points_only=True
    ).d_xyz[:, :, :2]
    # Where nothing is seen at the centre, nothing is relative to it.
    shift = np.full((2, jacobian.shape[2]), np.nan)
    if np.all(np.isfinite(moved[0])) and np.all(np.isfinite(jacobian[0])):
        shift = np.linalg.solve(moved[0], jacobian[0])
    return _compute_larger_sigma(jacobian[1:] - moved[1:] @ shift, covariance)


def make_similarity_moves(xy: Array) -> Array:
    """Return what shifts along x and y, a turn and a scale about their middle do to (n, 2) points: (n, 2, 4)."""
    x, y = (xy - xy.mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    return np.stack([np.stack([one, zero, -y, x], 1), np.stack([zero, one, x, y], 1)], 1)


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
    moved = project_points_with_jacobians(
        camera.parameters, points, camera.raster, points_only=True
    ).d_xyz
    jacobian = camera.project_jacobian(points)
    known = np.all(np.isfinite(jacobian), axis=(1, 2))
    if not np.any(known):
        return np.full(len(xy), np.nan)
    columns = (moved[known][:, :, :2] @ make_similarity_moves(points[known, :2])).reshape(-1, 4)
    basis = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]
    rows = jacobian[known].reshape(-1, jacobian.shape[2])
    left = (rows - basis @ (basis.T @ rows)).reshape(-1, 2, jacobian.shape[2])
    out = np.full(len(xy), np.nan)
    out[known] = _compute_larger_sigma(left, covariance)
    return out


@dataclass(frozen=True)
class BudgetPart:
    """One source of uncertainty.

    Attributes
    ----------
    source
        What it is.
    relative
        Its relative 1-sigma.
    """

    source: str
    relative: float


@dataclass(frozen=True)
class UncertaintyBudget:
    """A quantity and all that makes it uncertain.

    Attributes
    ----------
    value_m
        The quantity, m.
    parts
        Its sources of uncertainty, the largest first.
    """

    value_m: float
    parts: tuple[BudgetPart, ...]

    @property
    def relative(self) -> float:
        """Combined relative 1-sigma."""
        return math.sqrt(sum(part.relative**2 for part in self.parts))

    @property
    def sigma_m(self) -> float:
        """Combined 1-sigma, m."""
        return self.value_m * self.relative

    @property
    def coverage(self) -> float:
        """Coverage factor k of :attr:`expanded_m`."""
        return COVERAGE_FACTOR

    @property
    def expanded_m(self) -> float:
        """Expanded uncertainty, m."""
        return COVERAGE_FACTOR * self.sigma_m

    def share(self, part: BudgetPart) -> float:
        """Part of the combined variance, 0 to 1."""
        return part.relative**2 / self.relative**2 if self.relative > 0.0 else 0.0


def _budget(value_m: float, parts: dict[str, float]) -> UncertaintyBudget:
    listed = [BudgetPart(source, relative) for source, relative in parts.items() if relative > 0.0]
    return UncertaintyBudget(value_m, tuple(sorted(listed, key=lambda part: -part.relative)))


def _scale_parts(
    model: CalibrationModel, magnification: float, height_m: float
) -> tuple[RectifiedCamera, float, dict[str, float]]:
    """Camera, pixel size at the height, and the relative parts of its uncertainty."""
    camera = model.at(magnification)
    if camera.covariance is None or not math.isfinite(height_m):
        raise InvalidValueError(f"a height of {height_m} m", expected="a finite one")
    stretch = 1.0 + camera.rho * height_m
    if stretch <= 0.0:
        raise InvalidValueError(
            f"a height of {1e3 * height_m:g} mm",
            expected=f"one of more than {-1e3 / camera.rho:.3g} mm, where the pivot of the scan lies",
        )
    rectified, sigma = camera.rectified, model.scale_sigma
    total = max(rectified.pixel_size_sigma_m) / rectified.pixel_size_m[0]
    extra = float(np.hypot(sigma.relative(camera.rho), model.ladder_sigma(magnification)))
    beyond = model.extrapolation_sigma(magnification)
    views = max(total**2 - extra**2 - beyond**2, 0.0)
    steps = 0.0
    if (ladder := model.ladder) is not None and ladder.beyond(magnification) > 0.0:
        # What is not known at the end of the grid goes with every step; the rest comes from the steps.
        end = min(max(magnification, ladder.anchored[0]), ladder.anchored[1])
        at_end = model.at(end)
        known = (max(at_end.rectified.pixel_size_sigma_m) * at_end.m) ** 2
        known -= sigma.relative(at_end.rho) ** 2
        steps, views = max(views - known, 0.0), min(views, max(known, 0.0))
        steps = math.hypot(math.sqrt(steps), ladder.growth_sigma(magnification))
    parts = {
        "repeatability of the magnification": sigma.repeatability,
        "squares of the grid": sigma.grid,
        "height of the specimen": camera.rho * sigma.height_m / stretch,
        "magnification outside the calibrated range": beyond,
        "steps of the ladder beyond the grid": steps,
        "place of a relay": 0.0 if ladder is None else ladder.relay_sigma(magnification),
        **_split_views(model, magnification, views),
        # The cosine of a small tilt differs from 1 by half of its square, of which this is the RMS.
        "tilt of the specimen": 0.5 * math.sqrt(3.0) * SPECIMEN_TILT_SIGMA_RAD**2,
    }
    if height_m:
        rho_sigma = math.sqrt(max(float(camera.covariance[5, 5]), 0.0))
        parts["distance of the scan pivot"] = abs(height_m) * rho_sigma / stretch
    return rectified, rectified.pixel_size_m[0] * stretch, parts


def _split_views(
    model: CalibrationModel, magnification: float, variance: float
) -> dict[str, float]:
    """What the covariance of the calibration adds, by its sources where the calibration tells them."""
    shares = None if model.record is None else model.record.scale_shares
    if shares is None:
        return {"views of the calibration": math.sqrt(variance)}
    at, calibrated = np.log(magnification), np.log(shares.magnifications)
    corners, visits = (
        float(np.interp(at, calibrated, part)) for part in (shares.corners, shares.visits)
    )
    parts = {
        "corners of the calibration": math.sqrt(variance * corners),
        "visits, poses and heights of the calibration": math.sqrt(variance * visits),
    }
    left = max(1.0 - corners - visits, 0.0)
    return parts | {"form of the functions of the calibration": math.sqrt(variance * left)}


def worst_pixel_size(model: CalibrationModel) -> tuple[float, float]:
    """Largest relative 1-sigma of nm per pixel in the calibrated range, of the worse axis, and its magnification."""
    low, high = model.magnification_range
    # The ends of the range come out of the logarithm with a rounding error.
    judged = np.clip(np.geomspace(low, high, JUDGED_MAGNIFICATIONS), low, high)
    cameras = [model.at(float(g)) for g in judged]
    sigmas = [
        max(s / x for s, x in zip(c.pixel_size_sigma_m, c.pixel_size_m, strict=True))
        for c in cameras
    ]
    worst = int(np.argmax(sigmas))
    return float(sigmas[worst]), float(judged[worst])


def budget_of_pixel_size(
    model: CalibrationModel, magnification: float, *, height_m: float = 0.0
) -> UncertaintyBudget:
    """The pixel size of rectified images at a magnification, and what makes it uncertain.

    Parameters
    ----------
    model
        The calibration.
    magnification
        The magnification.
    height_m
        Height of the specimen above the plane of the calibration, towards larger pixels: away from the pole piece.

    Raises
    ------
    InvalidValueError
        As :meth:`.CalibrationModel.at`, or if the height is beyond the pivot of the scan.
    """
    _, size_m, parts = _scale_parts(model, magnification, height_m)
    return _budget(size_m, parts)


def budget_of_length(
    model: CalibrationModel,
    magnification: float,
    length_m: float,
    *,
    edge_sigma_px: float,
    height_m: float = 0.0,
) -> UncertaintyBudget:
    """A length between two edges in a rectified image, and what makes it uncertain.

    Parameters
    ----------
    model, magnification, height_m
        As for :func:`budget_of_pixel_size`.
    length_m
        The length.
    edge_sigma_px
        1-sigma of the position of each of both edges, px.

    Raises
    ------
    InvalidValueError
        As there, or if the length does not fit the image.
    """
    camera, size_m, parts = _scale_parts(model, magnification, height_m)
    check_positive(length_m, "length_m =")
    length_px = length_m / size_m
    if length_px > max(camera.width, camera.height):
        raise InvalidValueError(
            f"a length of {1e6 * length_m:g} um in a field of {1e6 * size_m * camera.width:.4g} um",
            expected="a length in the image",
            do="choose a lower magnification",
        )
    parts["position of both edges"] = math.sqrt(2.0) * edge_sigma_px / length_px
    parts["distortion"] = _distortion(camera, length_px)
    return _budget(length_m, parts)


def _distortion(camera: RectifiedCamera, length_px: float) -> float:
    """Relative 1-sigma of a length beyond that of the pixel size: the worst of places and directions."""
    covariance = camera.joint_covariance
    assert covariance is not None
    worst = 0.0
    for axis, full in ((0, camera.width), (1, camera.height)):
        step = np.zeros(2)
        step[axis] = 0.5 * min(length_px, full - 1.0)
        relative = camera.pixel_size_sigma_m[axis] / camera.pixel_size_m[axis]
        for x in LENGTH_PLACES:
            for y in LENGTH_PLACES:
                middle = np.array([x * camera.width, y * camera.height])
                # A length that does not fit there is moved to where it does.
                room = (camera.width, camera.height)
                middle[axis] = np.clip(middle[axis], step[axis], room[axis] - 1.0 - step[axis])
                ends: Array = np.stack([middle - step, middle + step])
                jacobian = camera.project_jacobian(camera.sem_from_ideal(ends))[:, axis]
                row = (jacobian[1] - jacobian[0]) / (2.0 * step[axis])
                total = float(row @ covariance @ row)
                if math.isfinite(total):
                    worst = max(worst, total - relative**2)
    return math.sqrt(worst)
