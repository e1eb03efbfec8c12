"""Bundle adjustment of coefficient vectors and grid poses: Levenberg-Marquardt with a Huber loss.

Triggs et al., Bundle Adjustment - A Modern Synthesis, doi:10.1007/3-540-44480-7_21, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from semcal_ros.core.arrays import Array, invert_scaled, solve_scaled
from semcal_ros.core.calibration.normal_equations import (
    NormalEquations,
    Problem,
    State,
    normal_equations,
    prior_cost,
    reduced_normal_equations,
    residuals,
    retract,
    schur_complement,
    select_views,
    view_costs,
)

__all__ = ["BundleResult", "BundleStatus", "refine"]


# A guard against endless iteration; the result says where it was reached.
_MAX_ITERATIONS = 60
# Levenberg-Marquardt damping relative to the diagonal: nearly Gauss-Newton at the start; the limits
# stand for no damping and for steps of no length.
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-5, 1e-12, 1e10
# Ratio of actual to predicted decrease below which the quadratic model of a view has failed.
_POOR_GAIN = 0.25
# Steps by which the pose of such a view follows a new camera. It has to be near only: the next
# iteration continues from there.
_FOLLOWING_STEPS = 6
# Change of a view's half chi-square that does not count as a failure.
_NEGLIGIBLE = 1e-2
# Relative decrease of the cost below which another step cannot matter to the result.
_COST_TOLERANCE = 1e-7


class BundleStatus(Enum):
    """How an adjustment ended; the values are the sentences of the calibration file."""

    SMALL_DECREASE = "converged: relative decrease below the tolerance"
    NO_DESCENT = "converged: no step lowers the cost"
    ITERATION_LIMIT = "stopped at the iteration limit"
    NO_PROJECTION = "a point has no projection at the start"


@dataclass(frozen=True)
class BundleResult:
    """Result of :func:`refine`.

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
        (M, 10) the matching right-hand side (its sum over a free camera is zero at the optimum).
    covariance
        (K, K) of theta for unit variance of the whitened residuals.
    height_variance_m2
        (V,) posterior variance of the heights.
    iterations, status
        Number of steps, and why there were no more.
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
    status: BundleStatus

    @property
    def converged(self) -> bool:
        """Whether the cost is at a minimum."""
        return self.status in (BundleStatus.SMALL_DECREASE, BundleStatus.NO_DESCENT)

    def rms_px(self) -> float:
        """Return the RMS distance of observed and projected corners, px."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))


@dataclass(frozen=True)
class _Step:
    """A damped Gauss-Newton step, and the decrease of cost that its quadratic model predicts.

    Attributes
    ----------
    state
        State after the step.
    predicted, predicted_prior
        (V,) predicted decrease for each view, and that of the prior of theta.
    """

    state: State
    predicted: Array
    predicted_prior: float


def _step(problem: Problem, state: State, normal: NormalEquations, damping: float) -> _Step:
    information, gradient, back_camera, back_right = schur_complement(problem, normal, damping)
    matrix, right = reduced_normal_equations(problem, state.theta, information, gradient)
    change = solve_scaled(matrix, right, damping)
    camera_change = (problem.designs @ change)[problem.group]
    pose = back_right - np.einsum("vpq,vq->vp", back_camera, camera_change)
    new = retract(problem, state, change, pose)
    whole = np.concatenate([camera_change, pose], axis=1)
    bent = np.einsum("vpq,vq->vp", normal.matrix, whole)
    precision = problem.prior_sigma**-2.0
    prior = (problem.prior_mean - state.theta) * precision * change - 0.5 * change**2 * precision
    return _Step(new, np.sum((normal.right - 0.5 * bent) * whole, axis=1), float(prior.sum()))


def refine(
    problem: Problem,
    state: State,
    *,
    fixed_theta: bool = False,
    max_iterations: int = _MAX_ITERATIONS,
    tolerance: float = _COST_TOLERANCE,
) -> BundleResult:
    """Minimise the robust reprojection error from ``state``.

    With ``fixed_theta`` only the poses move. ``tolerance`` is the relative decrease of the cost
    that ends the iteration. The function never raises for lack of convergence: the result says how
    it ended.
    """
    costs = view_costs(problem, state)
    cost = float(costs.sum()) + prior_cost(problem, state)
    if not np.isfinite(cost):
        return _make_empty_result(problem, state)
    if fixed_theta:
        state, costs, iterations, status = _refine_poses(
            problem, state, costs, max_iterations, tolerance
        )
        cost = float(costs.sum()) + prior_cost(problem, state)
        return _make_result(problem, state, cost, iterations, status)
    damping, iterations, status = _FIRST_DAMPING, 0, BundleStatus.ITERATION_LIMIT
    while iterations < max_iterations:
        iterations += 1
        normal = normal_equations(problem, state)
        while True:
            step = _step(problem, state, normal, damping)
            trial, trial_costs = _refine_following_poses(problem, state, costs, step)
            trial_cost = float(trial_costs.sum()) + prior_cost(problem, trial)
            if trial_cost <= cost or damping >= _MAX_DAMPING:
                break
            damping *= 10.0
        if trial_cost > cost:
            status = BundleStatus.NO_DESCENT
            break
        decrease, cost, costs, state = cost - trial_cost, trial_cost, trial_costs, trial
        damping = max(0.1 * damping, _MIN_DAMPING)
        predicted = float(step.predicted.sum()) + step.predicted_prior
        if decrease <= tolerance * cost and predicted <= 1e3 * tolerance * (1.0 + cost):
            status = BundleStatus.SMALL_DECREASE
            break
    return _make_result(problem, state, cost, iterations, status)


def _refine_following_poses(
    problem: Problem, state: State, costs: Array, step: _Step
) -> tuple[State, Array]:
    """Return the state after a step, and its costs per view.

    The tilt of a nearly flat view acts through its square, so the quadratic model holds only for
    very small steps. Where the model failed, the pose is adjusted to the new camera on its own;
    otherwise a few such views would hold back the rest.
    """
    trial = step.state
    trial_costs = view_costs(problem, trial)
    short = trial_costs > costs - _POOR_GAIN * step.predicted + _NEGLIGIBLE
    if not np.any(short):
        return trial, trial_costs
    part = select_views(problem, short)
    start = State(trial.theta, trial.rotations[short], trial.translations_m[short])
    own, own_costs, _, _ = _refine_poses(part, start, trial_costs[short], _FOLLOWING_STEPS, 1e-3)
    rotations, translations = trial.rotations.copy(), trial.translations_m.copy()
    rotations[short], translations[short] = own.rotations, own.translations_m
    trial = State(trial.theta, rotations, translations)
    trial_costs[short] = own_costs
    return trial, trial_costs


def _refine_poses(
    problem: Problem, state: State, costs: Array, max_iterations: int, tolerance: float
) -> tuple[State, Array, int, BundleStatus]:
    """Adjust the pose of each view on its own by Levenberg-Marquardt, for all views at once.

    Returns the state, the costs of the views, the number of iterations, and why they ended.
    """
    damping = np.full(len(costs), _FIRST_DAMPING)
    iterations = 0
    while iterations < max_iterations:
        iterations += 1
        normal = normal_equations(problem, state)
        pose = normal.matrix[:, 10:, 10:].copy()
        diagonal = np.arange(6)
        pose[:, diagonal, diagonal] *= 1.0 + damping[:, None]
        change = np.asarray(
            np.linalg.solve(pose, normal.right[:, 10:, None])[:, :, 0], dtype=np.float64
        )
        trial = retract(problem, state, np.zeros_like(state.theta), change)
        trial_costs = view_costs(problem, trial)
        better = trial_costs <= costs
        decrease = np.where(better, costs - trial_costs, 0.0)
        state = State(
            state.theta,
            np.where(better[:, None, None], trial.rotations, state.rotations),
            np.where(better[:, None], trial.translations_m, state.translations_m),
        )
        costs = np.where(better, trial_costs, costs)
        damping = np.where(better, np.maximum(0.1 * damping, _MIN_DAMPING), 10.0 * damping)
        predicted = 0.5 * np.einsum("vp,vp->v", normal.right[:, 10:], change)
        small = tolerance * (1.0 + costs)
        if np.all(np.where(better, decrease, predicted) <= small):
            return state, costs, iterations, BundleStatus.SMALL_DECREASE
    return state, costs, iterations, BundleStatus.ITERATION_LIMIT


def _make_result(
    problem: Problem, state: State, cost: float, iterations: int, status: BundleStatus
) -> BundleResult:
    normal = normal_equations(problem, state)
    information, gradient, back_camera, _ = schur_complement(problem, normal, 0.0)
    matrix, _ = reduced_normal_equations(problem, state.theta, information, gradient)
    # A direction that neither data nor prior hold gets no spurious certainty from rounding.
    covariance = invert_scaled(matrix, rcond=1e-15)
    covariance = 0.5 * (covariance + covariance.T)
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
        status=status,
    )


def _make_empty_result(problem: Problem, state: State) -> BundleResult:
    """Return the result where some point has no projection at the start: nothing is known."""
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
        status=BundleStatus.NO_PROJECTION,
    )
