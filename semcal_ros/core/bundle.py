"""Bundle adjustment of coefficient vectors and grid poses.

The unknowns are one vector ``theta`` of coefficients, from which the camera of each magnification follows linearly
(``camera = design @ theta``), and six pose unknowns per view. The poses are eliminated view by view (Schur complement),
so that the reduced system has the size of ``theta`` whatever the number of views; what is left of a view is a 10 x 10
information matrix on the camera of its magnification. Levenberg-Marquardt with a Huber loss.

Triggs et al., Bundle Adjustment - A Modern Synthesis, doi:10.1007/3-540-44480-7_21, sections 4 and 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.poses import cross_matrices, rotations_from_vectors
from semcal_ros.core.projection import project_points, project_points_with_jacobians
from semcal_ros.core.views import GridView

__all__ = [
    "BundleResult",
    "Problem",
    "State",
    "make_problem",
    "refine",
    "residuals",
    "theta_system",
]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_MAX_ITERATIONS = 60
_MAX_DAMPING = 1e10
# Relative decrease of the cost below which another step cannot matter to the result.
_COST_TOLERANCE = 1e-9
# Huber's threshold on the norm of a whitened 2-D residual: 99 % of Gaussian corners stay quadratic.
_HUBER = 3.0


@dataclass(frozen=True)
class Problem:
    """Observations and priors of one adjustment.

    Attributes
    ----------
    board_m, observed_px, weight
        (N, 3), (N, 2) and (N,): grid points, observed raw pixels, 1 / sigma.
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
        (K,) prior of theta; an infinite sigma is no prior.
    height_sigma_m
        Prior 1-sigma of each view's height t_z about the reference plane.
    """

    board_m: Array
    observed_px: Array
    weight: Array
    starts: Index
    group: Index
    designs: Array
    unit_m: Array
    norm_px: float
    prior_mean: Array
    prior_sigma: Array
    height_sigma_m: float

    @property
    def view_of_point(self) -> Index:
        """(N,) view index of every point."""
        return np.repeat(np.arange(len(self.group)), np.diff(self.starts))


@dataclass(frozen=True)
class State:
    """Values of the unknowns: theta (K,), rotations (V, 3, 3) and translations (V, 3) in m."""

    theta: Array
    rotations: Array
    translations_m: Array


@dataclass(frozen=True)
class BundleResult:
    """Outcome of :func:`refine`.

    Attributes
    ----------
    state
        Adjusted unknowns.
    residuals_px
        (N, 2) observed minus projected pixels.
    huber_weight
        (N,) weights in (0, 1]; below 1 where a corner is an outlier.
    cost
        Half the robust sum of squares, with priors.
    information
        (M, 10, 10) information on each magnification's camera with the poses eliminated.
    gradient
        (M, 10) the matching right-hand side (zero sum over a free camera at the optimum).
    covariance
        (K, K) of theta for unit variance of the whitened residuals.
    height_variance_m2
        (V,) posterior variance of the heights.
    iterations, converged, reason
        How the iteration ended.
    """

    state: State
    residuals_px: Array
    huber_weight: Array
    cost: float
    information: Array
    gradient: Array
    covariance: Array
    height_variance_m2: Array
    iterations: int
    converged: bool
    reason: str

    def rms_px(self) -> float:
        """RMS distance of observed and projected corners, px."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))


def make_problem(
    views: Sequence[GridView],
    magnifications: Array,
    designs: Array,
    *,
    norm_px: float,
    nominal_px_per_m: Array,
    prior_mean: Array,
    prior_sigma: Array,
    height_sigma_m: float,
) -> Problem:
    """Arrange views for the adjustment; ``magnifications`` (M,) are the distinct ones, in order."""
    counts = [len(v.board_xy_m) for v in views]
    group = np.searchsorted(magnifications, [v.magnification for v in views]).astype(np.intp)
    board = np.concatenate([v.board_xy_m for v in views])
    return Problem(
        board_m=np.column_stack([board, np.zeros(len(board))]),
        observed_px=np.concatenate([v.image_xy for v in views]),
        weight=1.0 / np.concatenate([v.sigma_px for v in views]),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        group=group,
        designs=designs,
        unit_m=1.0 / nominal_px_per_m[group],
        norm_px=norm_px,
        prior_mean=prior_mean,
        prior_sigma=prior_sigma,
        height_sigma_m=height_sigma_m,
    )


def _points_and_cameras(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    view = problem.view_of_point
    rotated = np.einsum("nij,nj->ni", state.rotations[view], problem.board_m)
    cameras = (problem.designs @ state.theta)[problem.group]
    return rotated, rotated + state.translations_m[view], cameras[view]


def residuals(problem: Problem, state: State) -> Array:
    """(N, 2) observed minus projected pixels; NaN where a point has no projection."""
    _, points, cameras = _points_and_cameras(problem, state)
    return problem.observed_px - project_points(cameras, points, problem.norm_px)


def _huber(norm: Array) -> tuple[Array, Array]:
    """Huber's loss (half squared norm inside) and weight of the whitened residual norms."""
    outside = norm > _HUBER
    loss = np.where(outside, _HUBER * (norm - 0.5 * _HUBER), 0.5 * norm * norm)
    return loss, np.where(outside, _HUBER / np.maximum(norm, _HUBER), 1.0)


def _cost(problem: Problem, state: State) -> float:
    miss = residuals(problem, state)
    norm = np.hypot(miss[:, 0], miss[:, 1]) * problem.weight
    if not np.all(np.isfinite(norm)):
        return float("inf")
    prior = (state.theta - problem.prior_mean) / problem.prior_sigma
    height = state.translations_m[:, 2] / problem.height_sigma_m
    return float(_huber(norm)[0].sum() + 0.5 * (prior @ prior + height @ height))


@dataclass(frozen=True)
class _Normal:
    """Normal equations: per view (V, 16, 16) and (V, 16), with camera first and pose last."""

    matrix: Array
    right: Array
    residuals_px: Array
    huber_weight: Array


def _normal_equations(problem: Problem, state: State) -> _Normal:
    rotated, points, cameras = _points_and_cameras(problem, state)
    jacobians = project_points_with_jacobians(cameras, points, problem.norm_px)
    miss = problem.observed_px - jacobians.xy
    norm = np.hypot(miss[:, 0], miss[:, 1]) * problem.weight
    huber = _huber(norm)[1]
    whiten = (problem.weight * np.sqrt(huber))[:, None]
    unit = problem.unit_m[problem.view_of_point][:, None, None]

    rows = np.empty((len(points), 2, 17))
    rows[:, :, :10] = jacobians.d_parameters
    rows[:, :, 10:13] = -jacobians.d_xyz @ cross_matrices(rotated)
    rows[:, :, 13:16] = jacobians.d_xyz * unit
    rows[:, :, 16] = miss
    rows *= whiten[:, :, None]

    n_views = len(problem.group)
    matrix = np.empty((n_views, 17, 17))
    for v in range(n_views):
        block = rows[problem.starts[v] : problem.starts[v + 1]].reshape(-1, 17)
        matrix[v] = block.T @ block
    height = problem.unit_m / problem.height_sigma_m
    matrix[:, 15, 15] += height**2
    matrix[:, 15, 16] -= height * state.translations_m[:, 2] / problem.height_sigma_m
    return _Normal(matrix[:, :16, :16], matrix[:, :16, 16], miss, huber)


def _reduce(problem: Problem, normal: _Normal, damping: float) -> tuple[Array, Array, Array, Array]:
    """Eliminate the poses: information (M, 10, 10), gradient (M, 10), V^-1 W' and V^-1 b per view."""
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


def theta_system(
    problem: Problem, theta: Array, information: Array, gradient: Array
) -> tuple[Array, Array]:
    """Reduced normal equations (K, K) and (K,) of theta, with its prior, from the blocks per magnification."""
    designs = problem.designs
    matrix = np.einsum("mpk,mpq,mql->kl", designs, information, designs, optimize=True)
    right = np.einsum("mpk,mp->k", designs, gradient)
    matrix[np.diag_indices_from(matrix)] += problem.prior_sigma**-2.0
    right = right - (theta - problem.prior_mean) * problem.prior_sigma**-2.0
    return matrix, right


def _scaled_solve(matrix: Array, right: Array, damping: float) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
    scaled = matrix * np.outer(scale, scale)
    scaled[np.diag_indices_from(scaled)] += damping
    return np.asarray(scale * np.linalg.solve(scaled, scale * right), dtype=np.float64)


def _step(
    problem: Problem, state: State, normal: _Normal, damping: float, fixed: bool
) -> tuple[State, float]:
    """The damped Gauss-Newton step and the decrease of the cost that its quadratic model predicts."""
    information, gradient, back_camera, back_right = _reduce(problem, normal, damping)
    change = np.zeros_like(state.theta)
    if not fixed:
        matrix, right = theta_system(problem, state.theta, information, gradient)
        change = _scaled_solve(matrix, right, damping)
    camera_change = (problem.designs @ change)[problem.group]
    pose = back_right - np.einsum("vpq,vq->vp", back_camera, camera_change)
    new = State(
        state.theta + change,
        rotations_from_vectors(pose[:, :3]) @ state.rotations,
        state.translations_m + pose[:, 3:] * problem.unit_m[:, None],
    )
    whole = np.concatenate([camera_change, pose], axis=1)
    linear = np.einsum("vp,vp->", normal.right, whole)
    quadratic = np.einsum("vp,vpq,vq->", whole, normal.matrix, whole, optimize=True)
    precision = problem.prior_sigma**-2.0
    linear += np.sum((problem.prior_mean - state.theta) * precision * change)
    quadratic += np.sum(change * change * precision)
    return new, float(linear - 0.5 * quadratic)


def refine(
    problem: Problem,
    state: State,
    *,
    fixed_theta: bool = False,
    max_iterations: int = _MAX_ITERATIONS,
    tolerance: float = _COST_TOLERANCE,
) -> BundleResult:
    """Minimise the robust reprojection error from ``state``.

    With ``fixed_theta`` only the poses move. ``tolerance`` is the relative decrease of the cost that ends the
    iteration. Never raises for lack of convergence: the result says how it ended.
    """
    cost = _cost(problem, state)
    if not np.isfinite(cost):
        return _no_result(problem, state)
    damping, growth, iterations, reason = 1e-5, 2.0, 0, ""
    while not reason and iterations < max_iterations:
        iterations += 1
        normal = _normal_equations(problem, state)
        while True:
            trial, predicted = _step(problem, state, normal, damping, fixed_theta)
            trial_cost = _cost(problem, trial)
            if trial_cost <= cost or damping >= _MAX_DAMPING:
                break
            damping, growth = damping * growth, 2.0 * growth
        if trial_cost > cost:
            reason = "converged: no step lowers the cost"
            break
        decrease, cost, state = cost - trial_cost, trial_cost, trial
        # Damping follows how well the quadratic model predicted the decrease (Nielsen 1999).
        gain = min(decrease / max(predicted, 1e-300), 1.0)
        damping, growth = max(damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-12), 2.0
        if decrease <= tolerance * cost and predicted <= 1e3 * tolerance * (1.0 + cost):
            reason = "converged: relative decrease below the tolerance"
    return _result(problem, state, cost, iterations, reason)


def _result(
    problem: Problem, state: State, cost: float, iterations: int, reason: str
) -> BundleResult:
    normal = _normal_equations(problem, state)
    information, gradient, back_camera, _ = _reduce(problem, normal, 0.0)
    matrix, _ = theta_system(problem, state.theta, information, gradient)
    covariance = _covariance(matrix)
    spread = problem.designs @ covariance @ np.swapaxes(problem.designs, 1, 2)
    height_row = back_camera[:, 5]
    own = np.linalg.inv(normal.matrix[:, 10:, 10:])[:, 5, 5]
    coupled = np.einsum("vp,vpq,vq->v", height_row, spread[problem.group], height_row)
    return BundleResult(
        state=state,
        residuals_px=normal.residuals_px,
        huber_weight=normal.huber_weight,
        cost=cost,
        information=information,
        gradient=gradient,
        covariance=covariance,
        height_variance_m2=(own + coupled) * problem.unit_m**2,
        iterations=iterations,
        converged=reason.startswith("converged"),
        reason=reason or "stopped at the iteration limit",
    )


def _no_result(problem: Problem, state: State) -> BundleResult:
    """What is known when some point has no projection at the start: nothing."""
    groups, size = len(problem.designs), len(state.theta)
    return BundleResult(
        state=state,
        residuals_px=residuals(problem, state),
        huber_weight=np.zeros(len(problem.board_m)),
        cost=float("inf"),
        information=np.zeros((groups, 10, 10)),
        gradient=np.zeros((groups, 10)),
        covariance=np.full((size, size), np.inf),
        height_variance_m2=np.full(len(problem.group), np.inf),
        iterations=0,
        converged=False,
        reason="a point has no projection at the start",
    )


def _covariance(matrix: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
    # pinv: a direction that neither data nor prior hold gets no spurious certainty from rounding.
    inverse = np.linalg.pinv(matrix * np.outer(scale, scale), rcond=1e-15, hermitian=True)
    inverse = 0.5 * (inverse + inverse.T)
    return np.asarray(inverse * np.outer(scale, scale), dtype=np.float64)
