"""Reprojection errors of grid views, and their normal equations with the poses eliminated.

The unknowns are one vector ``theta`` of coefficients, from which the camera of each magnification
follows linearly (``camera = design @ theta``), and six pose unknowns per view. The poses are
eliminated view by view (Schur complement), so the reduced system has the size of ``theta`` for any
number of views; a view leaves a 10 x 10 information matrix on the camera of its magnification.

Triggs et al., Bundle Adjustment - A Modern Synthesis, doi:10.1007/3-540-44480-7_21, section 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Indices, Mask
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.projection import project_points, project_points_with_jacobians

__all__ = [
    "NormalEquations",
    "Problem",
    "State",
    "WhitenedRows",
    "make_problem",
    "normal_equations",
    "prior_cost",
    "reduced_normal_equations",
    "residuals",
    "retract",
    "schur_complement",
    "select_views",
    "view_costs",
    "whiten",
    "whitened_norm",
    "whitened_rows",
    "with_height_prior",
]


# Huber's threshold on the norm of a whitened 2-D residual: 99 % of Gaussian corners stay quadratic.
_HUBER = 3.0


@dataclass(frozen=True)
class Problem:
    """Observations and priors of one adjustment.

    Attributes
    ----------
    board_m, observed_px
        (N, 3) and (N, 2): grid points, and observed raw pixels (corrected by the residual field
        where there is one).
    whitening
        (N, 3): the lower triangle (xx, yx, yy) that turns a residual into one of unit covariance.
    starts
        (V + 1,) offsets of the views in these arrays.
    group
        (V,) index of each view's magnification in ``designs``.
    designs
        (M, 10, K): camera parameters of each magnification per unit of theta.
    unit_m
        (V,) metres per pose unit (about one pixel), which keeps the equations well scaled.
    norm_px
        Normalisation of the distortion.
    prior_mean, prior_sigma
        (K,) prior of theta; an infinite sigma stands for no prior.
    height_sigma_m
        (V,) prior 1-sigma of each view's height t_z about the reference plane.
    """

    board_m: Array
    observed_px: Array
    whitening: Array
    starts: Indices
    group: Indices
    designs: Array
    unit_m: Array
    norm_px: float
    prior_mean: Array
    prior_sigma: Array
    height_sigma_m: Array

    @property
    def view_of_point(self) -> Indices:
        """(N,) view index of every point."""
        return np.repeat(np.arange(len(self.group)), np.diff(self.starts))


@dataclass(frozen=True)
class State:
    """Values of the unknowns: theta (K,), rotations (V, 3, 3) and translations (V, 3) in m."""

    theta: Array
    rotations: Array
    translations_m: Array


def make_problem(
    views: Sequence[GridView],
    magnifications: Array,
    designs: Array,
    *,
    norm_px: float,
    nominal_px_per_m: Array,
    prior_mean: Array,
    prior_sigma: Array,
    height_sigma_m: Array | float,
) -> Problem:
    """Arrange views for an adjustment; ``magnifications`` (M,) are the distinct ones, in order.

    ``height_sigma_m`` is one number, or one for each view.
    """
    counts = [len(v.board_xy_m) for v in views]
    group = np.searchsorted(magnifications, [v.magnification for v in views]).astype(np.intp)
    board = np.concatenate([v.board_xy_m for v in views])
    return Problem(
        board_m=np.column_stack([board, np.zeros(len(board))]),
        observed_px=np.concatenate([v.image_xy for v in views]),
        whitening=np.concatenate([v.whitening for v in views]),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        group=group,
        designs=designs,
        unit_m=1.0 / nominal_px_per_m[group],
        norm_px=norm_px,
        prior_mean=prior_mean,
        prior_sigma=prior_sigma,
        height_sigma_m=np.broadcast_to(np.asarray(height_sigma_m, dtype=np.float64), len(views)),
    )


def _points_and_cameras(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    view = problem.view_of_point
    rotated = np.einsum("nij,nj->ni", state.rotations[view], problem.board_m)
    cameras = (problem.designs @ state.theta)[problem.group]
    return rotated, rotated + state.translations_m[view], cameras[view]


def residuals(problem: Problem, state: State) -> Array:
    """Return (N, 2) observed minus projected pixels; NaN where a point has no projection."""
    _, points, cameras = _points_and_cameras(problem, state)
    return problem.observed_px - project_points(cameras, points, problem.norm_px)


def whitened_norm(problem: Problem, miss: Array) -> Array:
    """Return the (N,) lengths of residuals (N, 2) in standard deviations."""
    xx, yx, yy = problem.whitening.T
    return np.hypot(xx * miss[:, 0], yx * miss[:, 0] + yy * miss[:, 1])


def _huber(norm: Array) -> tuple[Array, Array]:
    """Return Huber's loss (half the squared norm inside) and weight of whitened residual norms."""
    outside = norm > _HUBER
    loss = np.where(outside, _HUBER * (norm - 0.5 * _HUBER), 0.5 * norm * norm)
    return loss, np.where(outside, _HUBER / np.maximum(norm, _HUBER), 1.0)


def view_costs(problem: Problem, state: State) -> Array:
    """Return (V,) half robust sums of squares, with the priors of the heights.

    The cost of a view is infinite where one of its points has no projection.
    """
    miss = residuals(problem, state)
    norm = whitened_norm(problem, miss)
    loss = np.where(np.isfinite(norm), _huber(norm)[0], np.inf)
    height = state.translations_m[:, 2] / problem.height_sigma_m
    return np.add.reduceat(loss, problem.starts[:-1]) + 0.5 * height * height


def prior_cost(problem: Problem, state: State) -> float:
    """Return half the sum of squares of theta about its prior."""
    prior = (state.theta - problem.prior_mean) / problem.prior_sigma
    return float(0.5 * prior @ prior)


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of each view, (V, 16, 16) and (V, 16), with camera first and pose last."""

    matrix: Array
    right: Array
    residuals_px: Array
    huber_weight: Array


@dataclass(frozen=True)
class WhitenedRows:
    """Linearised observations of unit variance, Huber-weighted.

    Attributes
    ----------
    rows
        (2, 17, N): derivatives by camera (10), turn (3) and shift (3), and the residual.
    residuals_px
        (N, 2) without weights.
    huber_weight
        (N,).
    """

    rows: Array
    residuals_px: Array
    huber_weight: Array


def whitened_rows(problem: Problem, state: State) -> WhitenedRows:
    """Compute the whitened residuals and derivatives of all observations."""
    rotated, points, cameras = _points_and_cameras(problem, state)
    jacobians = project_points_with_jacobians(cameras, points, problem.norm_px)
    miss = problem.observed_px - jacobians.xy
    huber = _huber(whitened_norm(problem, miss))[1]
    rows = np.empty((2, 17, len(points)))
    rows[:, :10] = np.moveaxis(jacobians.d_parameters, 0, -1)
    shift = np.moveaxis(jacobians.d_xyz, 0, -1)
    x, y, z = rotated.T
    rows[:, 10] = y * shift[:, 2] - z * shift[:, 1]
    rows[:, 11] = z * shift[:, 0] - x * shift[:, 2]
    rows[:, 12] = x * shift[:, 1] - y * shift[:, 0]
    rows[:, 13:16] = shift * problem.unit_m[problem.view_of_point]
    rows[:, 16] = miss.T
    whiten(problem.whitening, rows, huber)
    return WhitenedRows(rows, miss, huber)


def whiten(whitening: Array, rows: Array, huber: Array) -> None:
    """Scale rows (2, k, N) to unit variance, in place."""
    xx, yx, yy = whitening.T * np.sqrt(huber)
    rows[1] *= yy
    if np.any(yx):
        rows[1] += yx * rows[0]
    rows[0] *= xx


def with_height_prior(problem: Problem, state: State, matrix: Array, column: int) -> None:
    """Add the prior of each view's height to augmented normal equations (V, k, k), in place.

    ``column`` is that of the height; the right-hand side is the last column.
    """
    height = problem.unit_m / problem.height_sigma_m
    matrix[:, column, column] += height**2
    matrix[:, column, -1] -= height * state.translations_m[:, 2] / problem.height_sigma_m


def normal_equations(problem: Problem, state: State) -> NormalEquations:
    """Compute the Huber-weighted normal equations of every view, with the prior of its height."""
    whitened = whitened_rows(problem, state)
    n_views = len(problem.group)
    matrix = np.empty((n_views, 17, 17))
    for v in range(n_views):
        x, y = whitened.rows[:, :, problem.starts[v] : problem.starts[v + 1]]
        matrix[v] = x @ x.T + y @ y.T
    with_height_prior(problem, state, matrix, 15)
    return NormalEquations(
        matrix[:, :16, :16], matrix[:, :16, 16], whitened.residuals_px, whitened.huber_weight
    )


def schur_complement(
    problem: Problem, normal: NormalEquations, damping: float
) -> tuple[Array, Array, Array, Array]:
    """Eliminate the poses.

    Returns information (M, 10, 10) and gradient (M, 10), and V^-1 W' and V^-1 b for each view.
    """
    pose = normal.matrix[:, 10:, 10:].copy()
    diagonal = np.arange(6)
    pose[:, diagonal, diagonal] *= 1.0 + damping
    right = np.concatenate([normal.matrix[:, 10:, :10], normal.right[:, 10:, None]], axis=2)
    solved = np.linalg.solve(pose, right)
    cross = normal.matrix[:, :10, 10:]
    information = np.zeros((len(problem.designs), 10, 10))
    gradient = np.zeros((len(problem.designs), 10))
    np.add.at(information, problem.group, normal.matrix[:, :10, :10] - cross @ solved[:, :, :10])
    np.add.at(gradient, problem.group, normal.right[:, :10] - (cross @ solved[:, :, 10:])[:, :, 0])
    return information, gradient, solved[:, :, :10], solved[:, :, 10]


def reduced_normal_equations(
    problem: Problem, theta: Array, information: Array, gradient: Array
) -> tuple[Array, Array]:
    """Assemble the reduced normal equations (K, K) and (K,) of theta, with its prior.

    ``information`` (M, 10, 10) and ``gradient`` (M, 10) are the blocks of each magnification.
    """
    designs = problem.designs
    matrix = np.einsum("mpk,mpq,mql->kl", designs, information, designs, optimize=True)
    right = np.einsum("mpk,mp->k", designs, gradient)
    matrix[np.diag_indices_from(matrix)] += problem.prior_sigma**-2.0
    right = right - (theta - problem.prior_mean) * problem.prior_sigma**-2.0
    return matrix, right


def retract(problem: Problem, state: State, change: Array, pose: Array) -> State:
    """Return the state after changes of theta (K,) and of the poses (V, 6)."""
    return State(
        state.theta + change,
        rotations_from_vectors(pose[:, :3]) @ state.rotations,
        state.translations_m + pose[:, 3:] * problem.unit_m[:, None],
    )


def select_views(problem: Problem, chosen: Mask) -> Problem:
    """Return the problem with only some of its views."""
    points = chosen[problem.view_of_point]
    counts = np.diff(problem.starts)[chosen]
    return replace(
        problem,
        board_m=problem.board_m[points],
        observed_px=problem.observed_px[points],
        whitening=problem.whitening[points],
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        group=problem.group[chosen],
        unit_m=problem.unit_m[chosen],
        height_sigma_m=problem.height_sigma_m[chosen],
    )
