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

"""Bundle adjustment of points and poses with the calibrated camera of every view.

Unknowns are the points and, for each view, a rotation and a translation; the cameras are given.
Residuals are in undistorted pixels, whitened by the covariance of each observation, under a robust
loss. Points are eliminated by the Schur complement; derivatives are analytic. Heights hardly show
in parallel projection, so those of the views have a prior around that of the reference view, and
the points have a very weak prior around their middle, which keeps them from moving along the beam.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from semcal_ros.applications.reconstruction.factorization import Tracks
from semcal_ros.applications.reconstruction.thresholds import CAUCHY_SIGMAS, DEPTH_PRIOR, SCALE_MIN
from semcal_ros.core.arrays import MEDIAN_CHI2_2, Array, Indices, Mask, invert_scaled, solve_scaled
from semcal_ros.core.calibration.estimator.trust_region import DescentStatus, Step, descend
from semcal_ros.core.camera.plane_geometry import cross_matrices, rotations_from_vectors
from semcal_ros.core.camera.projection import project_ideal_points
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import StructureError
from semcal_ros.core.robust_losses import cauchy_loss, cauchy_weight
from semcal_ros.core.wording import counted


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of points in views as a list, in undistorted pixels, with their weights.

    Parameters
    ----------
    view, point
        (n,) indices.
    xy
        (n, 2) undistorted px.
    root
        (n, 2, 2) root of the information matrix: ``root @ error`` has unit covariance, 1/px.
    """

    view: Indices
    point: Indices
    xy: Array
    root: Array

    def __len__(self) -> int:
        return len(self.view)

    def select(self, keep: Mask | Indices) -> Observations:
        """Select some of the observations."""
        return Observations(self.view[keep], self.point[keep], self.xy[keep], self.root[keep])

    @staticmethod
    def from_tracks(
        tracks: Tracks, cameras: Sequence[ScanCamera], sigma_px: float = 1.0
    ) -> Observations:
        """Convert all that is seen in tracks, with one standard deviation."""
        view, point = np.nonzero(tracks.seen)
        table = tabulate_cameras(cameras)[view]
        x, y = tracks.xy_m[view, point].T
        m, a, skew, px, py = table[:, :5].T
        xy = np.stack([px + m * (a * x + skew * y), py + m * y / a], axis=1)
        root = np.broadcast_to(np.eye(2) / sigma_px, (len(view), 2, 2))
        return Observations(view, point, xy, np.array(root))


def tabulate_cameras(cameras: Sequence[ScanCamera]) -> Array:
    """Tabulate (views, 6) m, aspect, skew, px, py, rho."""
    return np.array([camera.parameters[:6] for camera in cameras]).reshape(-1, 6)


@dataclass(frozen=True, eq=False)
class AdjustedStructure:
    """Adjusted structure with its uncertainty.

    Attributes
    ----------
    rotations, translations_m
        (views, 3, 3), (views, 3) sem_from_specimen.
    points_m
        (points, 3) m.
    residuals
        (n, 2) undistorted px, observed minus predicted.
    weights
        (n,) weights of the robust loss, 1 for a good observation.
    sigma
        Factor by which the observations are worse than their information says.
    cost
        Sum of the robust loss, in units of the observations' own information.
    point_covariance_m2
        (points, 3, 3) relative to the middle of all points, in the axes of the reference view.
    pose_covariance
        (views, 6, 6) of rotation vector (rad, in the sem frame) and translation (m); zero for the
        reference view.
    reference
        View whose pose is the frame of the points' uncertainty.
    iterations, converged
        How the adjustment ended.
    """

    rotations: Array
    translations_m: Array
    points_m: Array
    residuals: Array
    weights: Array
    sigma: float
    cost: float
    point_covariance_m2: Array
    pose_covariance: Array
    reference: int
    iterations: int
    converged: bool
    _inverse_points: Array
    _coupling: Array
    _inverse_poses: Array

    def propagate_variance(self, gradient: Array) -> float:
        """Variance of a function of the points with the (points, 3) gradient, poses included."""
        return float(self.propagate_covariance(gradient[None])[0, 0])

    def propagate_covariance(self, gradients: Array) -> Array:
        """Covariance (k, k) of functions of the points with (k, points, 3) gradients, poses included."""
        moved = np.einsum("pij,kpj->kpi", self._inverse_points, gradients).reshape(
            len(gradients), -1
        )
        through = moved @ self._coupling.T
        direct = moved @ gradients.reshape(len(gradients), -1).T
        return np.asarray(direct + through @ self._inverse_poses @ through.T, dtype=np.float64)

    @property
    def rms_px(self) -> float:
        """RMS distance of the observations that the robust loss trusts, px."""
        good = self.weights > 0.5
        return float(np.sqrt(np.mean(np.sum(self.residuals[good] ** 2, axis=1))))


@dataclass(frozen=True, eq=False)
class _State:
    rotations: Array
    translations: Array
    points: Array


class _Problem:
    """Residuals, derivatives and normal equations; lengths in units of the specimen's size."""

    def __init__(
        self,
        observations: Observations,
        cameras: Sequence[ScanCamera],
        unit_m: float,
        height_sigma_m: float,
        reference: int,
    ) -> None:
        self.observed = observations
        table = tabulate_cameras(cameras)
        table[:, 0] *= unit_m
        table[:, 5] *= unit_m
        self.table = table[observations.view]
        self.height_sigma = height_sigma_m / unit_m
        self.reference = reference
        self.views = len(cameras)
        self.beam = np.array([0.0, 0.0, 1.0])

    def residuals(self, state: _State) -> tuple[Array, Array, Array]:
        """Compute errors in px (n, 2), rotated points and points in the sem frame (n, 3)."""
        seen = self.observed
        turned = np.einsum("nij,nj->ni", state.rotations[seen.view], state.points[seen.point])
        moved = turned + state.translations[seen.view]
        return seen.xy - project_ideal_points(self.table, moved), turned, moved

    def whiten(self, error: Array) -> Array:
        white = np.einsum("nij,nj->ni", self.observed.root, error)
        return np.asarray(white, dtype=np.float64)

    def heights(self, state: _State) -> Array:
        z = state.translations[:, 2]
        return np.asarray((z - z[self.reference]) / self.height_sigma, dtype=np.float64)

    def depths(self, state: _State) -> Array:
        return np.asarray(state.points @ self.beam / DEPTH_PRIOR, dtype=np.float64)

    def cost(self, state: _State, sigma: float) -> float:
        white = self.whiten(self.residuals(state)[0]) / sigma
        priors = np.sum(self.heights(state) ** 2) + np.sum(self.depths(state) ** 2)
        return float(np.sum(cauchy_loss(np.sum(white**2, axis=1), CAUCHY_SIGMAS))) + 0.5 * float(
            priors
        )

    def normal(self, state: _State, sigma: float) -> tuple[Array, Array, Array, Array, Array]:
        """Form the blocks of the normal equations: poses (v, 6, 6), points (p, 3, 3), coupling
        (6v, 3p) and the two right-hand sides.
        """
        seen = self.observed
        error, turned, moved = self.residuals(state)
        m, a, skew, px, py, rho = self.table.T
        w = 1.0 + rho * moved[:, 2]
        by_xyz = np.zeros((len(seen), 2, 3))
        by_xyz[:, 0, 0] = m * a / w
        by_xyz[:, 0, 1] = m * skew / w
        by_xyz[:, 1, 1] = m / (a * w)
        predicted = seen.xy - error
        by_xyz[:, :, 2] = -(rho / w)[:, None] * (predicted - np.stack([px, py], axis=1))
        white = self.whiten(error) / sigma
        weight = cauchy_weight(np.sum(white**2, axis=1), CAUCHY_SIGMAS)
        root = seen.root * (np.sqrt(weight) / sigma)[:, None, None]
        rows = root @ by_xyz
        error = np.einsum("nij,nj->ni", root, error)
        by_pose = np.concatenate([-rows @ cross_matrices(turned), rows], axis=2)
        by_point = rows @ state.rotations[seen.view]
        pose = _sum_by_index(_multiply_outer(by_pose, by_pose), seen.view, self.views)
        point = _sum_by_index(_multiply_outer(by_point, by_point), seen.point, len(state.points))
        coupling = np.zeros((self.views, 6, len(state.points), 3))
        coupling[seen.view, :, seen.point, :] = _multiply_outer(by_pose, by_point)
        right_pose = _sum_by_index(np.einsum("nki,nk->ni", by_pose, error), seen.view, self.views)
        right_point = _sum_by_index(
            np.einsum("nki,nk->ni", by_point, error), seen.point, len(state.points)
        )
        heights = self.heights(state)
        pose[:, 5, 5] += 1.0 / self.height_sigma**2
        right_pose[:, 5] -= heights / self.height_sigma
        point += np.outer(self.beam, self.beam) / DEPTH_PRIOR**2
        right_point -= self.depths(state)[:, None] * self.beam / DEPTH_PRIOR
        return pose, point, coupling.reshape(6 * self.views, -1), right_pose, right_point


def adjust(
    observations: Observations,
    cameras: Sequence[ScanCamera],
    rotations: Array,
    translations_m: Array,
    points_m: Array,
    *,
    reference: int = 0,
    height_sigma_m: float = 5e-6,
    max_iterations: int = 40,
    tolerance: float = 1e-7,
) -> AdjustedStructure:
    """Adjust points and poses to observations.

    Parameters
    ----------
    observations
        Each view sees each point at most once; each point is seen at least twice.
    cameras
        Camera of every view.
    rotations, translations_m, points_m
        Initial values, (views, 3, 3), (views, 3), (points, 3).
    reference
        View whose pose is held fixed.
    height_sigma_m
        1-sigma of the heights of the views relative to the reference view, m.
    max_iterations, tolerance
        The iteration ends at this number, or when the cost falls by less than this fraction.

    Raises
    ------
    StructureError
        If the initial values are none that the cameras can show: their relief is larger than the pivot is far away.
    """
    unit_m = float(np.sqrt(np.mean(np.var(points_m, axis=0)))) or 1.0
    problem = _Problem(observations, cameras, unit_m, height_sigma_m, reference)
    middle = points_m.mean(axis=0)
    problem.beam = rotations[reference, 2].copy()
    state = _State(
        rotations.copy(),
        (translations_m + rotations @ middle) / unit_m,
        (points_m - middle) / unit_m,
    )
    held = np.arange(6 * reference, 6 * reference + 6)
    free = np.setdiff1d(np.arange(6 * len(cameras)), held)
    iterations, converged, sigma = 0, False, _estimate_scale(problem, state)
    if not np.isfinite(sigma):
        raise StructureError(
            f"a first structure of {counted(len(points_m), 'point')} in {counted(len(cameras), 'view')} whose relief "
            "the cameras cannot show",
            expected="a specimen whose turns tell its depth",
            do="record more texture, slower movements or larger turns",
        )
    for _ in range(3):
        # The robust loss depends on the scale of the residuals: estimate both in turn.
        found = descend(
            state,
            problem.cost(state, sigma),
            partial(_linearise, problem, sigma, free),
            max_iterations=max_iterations,
            tolerance=tolerance,
        )
        state, converged = found.state, found.status is not DescentStatus.ITERATION_LIMIT
        iterations += found.iterations
        better = _estimate_scale(problem, state)
        scale_converged = abs(better - sigma) < 0.02 * sigma
        sigma = better
        if scale_converged:
            break
    return _finish(problem, state, sigma, free, unit_m, iterations, converged)


def _linearise(
    problem: _Problem, sigma: float, free: Indices, state: _State
) -> Callable[[float], Step[_State] | None]:
    """Return the function from the damping to the step from a state."""
    pose, point, coupling, right_pose, right_point = problem.normal(state, sigma)

    def solve(damping: float) -> Step[_State] | None:
        inverse = _invert(_damp(point, damping))
        reduced, moved = _form_schur_complement(_damp(pose, damping), inverse, coupling, free)
        right = right_pose.ravel()[free] - moved @ right_point.ravel()
        step = np.zeros(6 * len(pose))
        try:
            step[free] = solve_scaled(reduced, right)
        except np.linalg.LinAlgError:
            return None
        left = right_point - (coupling.T @ step).reshape(-1, 3)
        by_view, by_point = step.reshape(-1, 6), np.einsum("pij,pj->pi", inverse, left)
        trial = _State(
            rotations_from_vectors(by_view[:, :3]) @ state.rotations,
            state.translations + by_view[:, 3:],
            state.points + by_point,
        )
        # A Gauss-Newton step lowers the quadratic model by half of its product with the gradient.
        predicted = 0.5 * float(np.sum(by_view * right_pose) + np.sum(by_point * right_point))
        return Step(trial, problem.cost(trial, sigma), predicted)

    return solve


def _damp(blocks: Array, damping: float) -> Array:
    out = blocks.copy()
    axes = np.arange(blocks.shape[1])
    diagonal = blocks[:, axes, axes]
    floor = 1e-9 * np.maximum(diagonal.max(axis=1, keepdims=True), 1e-300)
    out[:, axes, axes] += damping * np.maximum(diagonal, floor) + 1e-12 * floor
    return np.asarray(out, dtype=np.float64)


def _invert(blocks: Array) -> Array:
    return np.asarray(np.linalg.inv(blocks), dtype=np.float64)


def _form_schur_complement(
    pose: Array, inverse: Array, coupling: Array, free: Indices
) -> tuple[Array, Array]:
    """Form the Schur complement on the free pose parameters, and coupling @ inverse points."""
    part = coupling[free]
    by_point = np.swapaxes(part.reshape(len(free), -1, 3), 0, 1) @ inverse
    moved = np.swapaxes(by_point, 0, 1).reshape(part.shape)
    whole = np.zeros((6 * len(pose), 6 * len(pose)))
    for view, block in enumerate(pose):
        whole[6 * view : 6 * view + 6, 6 * view : 6 * view + 6] = block
    return whole[np.ix_(free, free)] - moved @ part.T, moved


def _estimate_scale(problem: _Problem, state: _State) -> float:
    """Estimate the robust scale of the whitened residuals, corrected for degrees of freedom."""
    white = problem.whiten(problem.residuals(state)[0])
    size = 2.0 * len(white)
    spent = 3.0 * len(state.points) + 6.0 * problem.views
    median = float(np.median(np.sum(white**2, axis=1)))
    scale = np.sqrt(median / MEDIAN_CHI2_2 * size / max(size - spent, 0.05 * size))
    return max(float(scale), SCALE_MIN)


def _multiply_outer(a: Array, b: Array) -> Array:
    return np.asarray(np.swapaxes(a, 1, 2) @ b, dtype=np.float64)


def _sum_by_index(values: Array, index: Indices, count: int) -> Array:
    """Sum values (n, ...) over equal indices."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(index, weights=column, minlength=count) for column in flat.T]
    summed = np.stack(columns, axis=1).reshape(count, *values.shape[1:])
    return np.asarray(summed, dtype=np.float64)


def _finish(
    problem: _Problem,
    state: _State,
    sigma: float,
    free: Indices,
    unit_m: float,
    iterations: int,
    converged: bool,
) -> AdjustedStructure:
    pose, point, coupling, _, _ = problem.normal(state, sigma)
    inverse = _invert(_damp(point, 1e-12))
    reduced, moved = _form_schur_complement(pose, inverse, coupling, free)
    poses = invert_scaled(reduced, rcond=1e-14)
    # Relative to the middle of the points: their common position along the beam is not determined.
    through = moved.reshape(len(free), -1, 3)
    through = through - through.mean(axis=1, keepdims=True)
    spread = (poses @ through.reshape(len(free), -1)).reshape(through.shape)
    count = len(state.points)
    of_points = (1.0 - 2.0 / count) * inverse + inverse.sum(axis=0) / count**2
    covariance = (of_points + np.einsum("api,apj->pij", through, spread, optimize=True)) * unit_m**2
    full = np.zeros((6 * problem.views, 6 * problem.views))
    full[np.ix_(free, free)] = poses
    by_view = full.reshape(problem.views, 6, problem.views, 6)
    each = by_view[np.arange(problem.views), :, np.arange(problem.views), :]
    factor = np.array([1.0, 1.0, 1.0, unit_m, unit_m, unit_m])
    error = problem.residuals(state)[0]
    white = problem.whiten(error) / sigma
    return AdjustedStructure(
        rotations=state.rotations,
        translations_m=state.translations * unit_m,
        points_m=state.points * unit_m,
        residuals=error,
        weights=cauchy_weight(np.sum(white**2, axis=1), CAUCHY_SIGMAS),
        sigma=sigma,
        cost=problem.cost(state, sigma),
        point_covariance_m2=covariance,
        pose_covariance=each * np.outer(factor, factor),
        reference=problem.reference,
        iterations=iterations,
        converged=converged,
        _inverse_points=inverse * unit_m**2,
        _coupling=coupling[free] / unit_m,
        _inverse_poses=poses,
    )
