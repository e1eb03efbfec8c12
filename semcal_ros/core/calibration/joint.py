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

"""The default calibration: one adjustment over all images at all magnifications.

Its unknowns are the coefficients of the continuous functions themselves, so a magnification with
few views borrows from its neighbours, and nothing needs to be interpolated afterwards (design
section 6.4).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import MEDIAN_CHI2_2, Array, Indices, solve_scaled
from semcal_ros.core.calibration.bundle_adjustment import BundleResult, refine
from semcal_ros.core.calibration.certificate import certify
from semcal_ros.core.calibration.initial_values import initial_values
from semcal_ros.core.calibration.line_jitter import LineJitter, estimate_jitter, jitter_covariance
from semcal_ros.core.calibration.model_selection import Summary, select_functions
from semcal_ros.core.calibration.normal_equations import (
    GRID_NAMES,
    MISS_NAMES,
    Problem,
    State,
    reduced_normal_equations,
)
from semcal_ros.core.calibration.priors import Setup
from semcal_ros.core.calibration.problem import (
    LEAST_DECREASE,
    Functions,
    adjust,
    build_problem,
    constant_functions,
    mirror,
    resolve_mirrored_tilts,
    restart_poses,
    stack_coefficients,
    variance_factor,
    with_coefficients,
    with_shared_values,
)
from semcal_ros.core.calibration.residual_field_fit import (
    FieldChoice,
    FieldSystem,
    blank_field,
    choose_field,
    field_system,
    held_prior,
    solve_field,
    undo_field,
)
from semcal_ros.core.calibration.stage import OFFSET_NAMES
from semcal_ros.core.calibration.variance_components import (
    VarianceComponents,
    initial_components,
    limit_components,
    update_components,
)
from semcal_ros.core.calibration.views import GridView, add_excess_noise, estimate_excess_sigma_px
from semcal_ros.core.camera.calibration_model import ALL_FUNCTIONS, TERM_NAMES, names_of
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.fit_record import Certificate
from semcal_ros.core.camera.plane_geometry import fit_homography
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.errors import UnusableCalibrationError

__all__ = [
    "RESIDUAL_MODES",
    "Adjustment",
    "FittedField",
    "JointFit",
    "adapt_priors",
    "add_shared_unknowns",
    "fit_joint",
    "without_magnification",
]


RESIDUAL_MODES = ("auto", "off", "on")
_SMOOTH = ("scale", "aspect", "skew", "xi_r", "xi_t", "ex", "ey")
# Rounds of choosing the numbers of coefficients. A choice that alternates never converges; the
# calibration then carries a warning.
_MAX_ROUNDS = 5
# Rounds of other poses, each after an adjustment to the last ones.
_MAX_TURNS = 5
# Number of zero coefficients that are added to the chosen ones, and the least number in all: what
# the views leave open of them enters the covariance.
_RESERVE, _LEAST_SIZE = 2, 5
# Updates of the variance components before anything is selected: they have to be near only, since
# every later adjustment updates them again. At most so many after that, until they change by less
# than the last number.
_FIRST_UPDATES, _LAST_UPDATES, _SMALL_CHANGE = 4, 12, 0.02
# Steps in which corners come to be believed, and the part of the excess noise beyond which there is no further one.
_MOST_STEPS, _LEAST_STEP = 3, 0.7
# Views that a message names.
_NAMED = 5
# Corners per view for what only needs to be near: signs of tilts, poses, start functions.
_ENOUGH_CORNERS = 60
# Tolerance of the intermediate adjustments; only the last one needs to be exact.
_COARSE = 1e-6
# Turns of field and adjustment at most, and those in which strength and numbers of coefficients may
# change; with both fixed the turns converge.
_MAX_FIELD_TURNS, _CHOOSING_TURNS = 30, 2
# Part of the misfit that a field must explain: distortion of the scan that none of the other
# parameters describes is explained to nine tenths, settling that is narrower than the knots to a quarter, and the waves
# of a grid to a sixth.
_LEAST_EXPLAINED = 0.2
# RMS change of the corrections of all corners, px, at which the field has converged: a fiftieth of
# the noise of good corners.
_FIELD_CONVERGED_PX = 1e-3
# Step of a central difference: its error is the square of this, far below what a share is worth.
_CERTAINTY_STEP = 0.02
# Largest start of rho, 1/m. The depth gradient of weakly tilted views is noisy, and a pivot nearer
# than 5 mm would be noise.
_MAX_START_RHO = 200.0


@dataclass(frozen=True)
class FittedField:
    """The residual field of a :class:`JointFit`.

    Attributes
    ----------
    field
        The field itself.
    choice
        Its strength, and the result of cross-validation.
    system
        The reduced system at the solution, from which magnifications can be left out.
    converged
        Whether camera and field stopped changing.
    """

    field: ResidualField
    choice: FieldChoice
    system: FieldSystem
    converged: bool


@dataclass(frozen=True)
class GridPattern:
    """Displacements of the corners that turn with the grid: it is not regular.

    Attributes
    ----------
    system
        The reduced system with the pattern as unknowns.
    choice
        Its strength, and the result of cross-validation.
    """

    system: FieldSystem
    choice: FieldChoice


@dataclass(frozen=True)
class Adjustment:
    """Continuous functions with a chosen number of coefficients, adjusted to the views.

    Attributes
    ----------
    functions
        The functions.
    problem, result
        The adjustment that gave their coefficients.
    spread
        Its variance components.
    rounds
        Number of times that the numbers of coefficients were chosen.
    converged
        Whether the last choice was the same as that of the round before.
    """

    functions: Functions
    problem: Problem
    result: BundleResult
    spread: VarianceComponents
    rounds: int
    converged: bool


@dataclass(frozen=True)
class CovarianceParts:
    """What the covariance of the coefficients consists of; the rest of it is the form of the functions.

    Attributes
    ----------
    corners
        (K, K) the errors of the corners, in lines too.
    visits
        (K, K) what varies between visits and views, and all that is left open besides: poses, heights, grid, stage.
    """

    corners: Array
    visits: Array


@dataclass(frozen=True)
class JointFit:
    """Result of :func:`fit_joint`.

    Attributes
    ----------
    adjustment
        The adjustment with the chosen number of coefficients.
    padded, covariance
        The same functions with a few more coefficients, which are zero, and the covariance of all
        of them, followed by that of the coefficients of the field.
    jitter
        Errors that corners on neighbouring lines share.
    field
        The residual field, or None.
    pattern
        What is irregular about the grid, or None.
    excess_px
        1-sigma per axis, px, by which all corners scatter beyond their own.
    parts
        What the covariance of the functions consists of.
    certificate
        That the adjustment ended at a minimum.
    """

    adjustment: Adjustment
    padded: Functions
    covariance: Array
    jitter: LineJitter
    field: FittedField | None
    pattern: GridPattern | None
    excess_px: float
    parts: CovarianceParts
    certificate: Certificate


def refit_functions(
    functions: Functions, sizes: Mapping[str, tuple[str, int]]
) -> dict[str, ContinuousFunction]:
    """Fit functions of other kinds and sizes to the values of the given ones, by least squares."""
    out: dict[str, ContinuousFunction] = {}
    none = replace(functions["scale"], coefficients=np.zeros(1), breaks=np.zeros(0))
    for name in ALL_FUNCTIONS:
        function = functions.get(name, none)
        kind, size = sizes.get(
            name, (function.kind, function.smooth_size if name in functions else 0)
        )
        if size == 0:
            continue
        zeros = np.zeros(size + len(function.breaks))
        blank = ContinuousFunction(kind, zeros, function.g_range, breaks=function.breaks)
        grid = np.union1d(np.geomspace(*function.g_range, 64), function.breaks)
        basis = np.stack([blank.basis(float(g)) for g in grid])
        values = np.array([function(float(g)) for g in grid])
        out[name] = replace(blank, coefficients=np.linalg.lstsq(basis, values, rcond=None)[0])
    return out


def _thin_view(view: GridView) -> GridView:
    """Return the view with a random part of its corners, enough for a pose and a rough camera."""
    if len(view.board_xy_m) <= _ENOUGH_CORNERS:
        return view
    keep = np.random.default_rng(0).permutation(len(view.board_xy_m))[:_ENOUGH_CORNERS]
    return view.chosen(keep)


def adapt_priors(setup: Setup) -> Setup:
    """Return the setup with priors of a photographic lens where the perspective is that strong."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    if not start.wide:
        return setup
    return replace(setup, priors=setup.priors.of_wide_views(start.rho))


def add_shared_unknowns(setup: Setup) -> Setup:
    """Return the setup with the unknowns of the grid, of the tilt axis and of the stage.

    A photograph has none of them: its priors (see :func:`adapt_priors`) are those of a lens.
    """
    if setup.priors.is_wide:
        return setup
    squares = tuple(f"square_{k}" for k in range(1, len(setup.squares_m)))
    stage = OFFSET_NAMES if any(v.has_stage_tilt for v in setup.views) else ()
    return replace(setup, shared=(*GRID_NAMES, *squares, *MISS_NAMES, *stage))


def measure_misfit_px(setup: Setup) -> float:
    """Return by how much the worst view departs from a plane under a perspective, 1-sigma per axis in px, beyond the
    sigmas of its corners.

    Where every corner is believed to its own noise while lens and scan are not known yet, poses, pivot and grid take
    their place, and no prior counts. An adjustment therefore starts from corners that are as uncertain as that.
    """
    worst = 0.0
    for view in setup.views:
        ones = np.ones((len(view.board_xy_m), 1))
        seen = np.hstack([view.board_xy_m, ones]) @ fit_homography(view.board_xy_m, view.image_xy).T
        square = np.sum((view.image_xy - seen[:, :2] / seen[:, 2:]) ** 2, axis=1)
        variance = float(np.median(square)) / MEDIAN_CHI2_2 - float(np.median(view.sigma_px)) ** 2
        worst = max(worst, variance)
    return float(np.sqrt(worst))


def _with_excess(setup: Setup, sigma_px: float) -> Setup:
    """Return the setup with corners that are more uncertain by ``sigma_px`` per axis."""
    if sigma_px == 0.0:
        return setup
    return replace(setup, views=add_excess_noise(setup.views, sigma_px))


def _tempered(setup: Setup, sigma_px: float) -> Setup:
    """Return the setup with observations, of corners and of the stage, that are believed less by the same factor."""
    noisy = _with_excess(setup, sigma_px)
    own = np.concatenate([view.own_variance_share for view in noisy.views])
    return replace(noisy, tempering=float(np.median(own)) ** -0.5)


def _excess_px(setup: Setup, adjustment: Adjustment) -> float:
    """Return the scatter of the corners of an adjustment beyond their own sigmas."""
    residuals = adjustment.result.residuals_px
    return estimate_excess_sigma_px(setup.views, residuals, 6 * len(setup.views))


def _anneal(setup: Setup, noisy: Setup, adjustment: Adjustment) -> tuple[Setup, Adjustment]:
    """Believe the corners as far as the model explains them, step by step; return the last setup and adjustment."""
    level = max(view.excess_px for view in noisy.views)
    for _ in range(_MOST_STEPS):
        excess = min(_excess_px(setup, adjustment), level)
        # The first step brings in what the stage says.
        if np.isfinite(noisy.tempering) and (level == 0.0 or excess > _LEAST_STEP * level):
            break
        level, noisy = excess, _tempered(setup, excess)
        spread = update_components(noisy, adjustment.problem, adjustment.result)
        adjustment = _select_and_adjust(
            noisy, adjustment.functions, adjustment.result.state, spread
        )
    return noisy, adjustment


def _fit_start(setup: Setup) -> tuple[Functions, State, VarianceComponents]:
    """Fit moderately flexible functions, poses and variance components from nominal values."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    rho = start.rho if start.wide else min(max(start.rho, 0.0), _MAX_START_RHO)
    functions: Functions = constant_functions(setup, {"scale": start.scale_factor, "rho": rho})
    spread = initial_components(setup)
    problem = build_problem(setup, functions, setup.views, spread)
    theta = np.concatenate([stack_coefficients(functions), setup.shared_start()])
    state = State(theta, start.rotations, start.translations_m)
    state, _ = resolve_mirrored_tilts(problem, state)

    size = min(3, max(1, len(setup.magnifications) - 1))
    functions = refit_functions(functions, dict.fromkeys(_SMOOTH, ("chebyshev_log", size)))
    problem = build_problem(setup, functions, setup.views, spread)
    state = replace(state, theta=_theta(setup, functions, state))
    result = adjust(problem, state, tolerance=_COARSE)
    result = _right_way_up(setup, functions, problem, result)
    for _ in range(_FIRST_UPDATES):
        # Before anything is selected: too wide a prior of the heights would let them imitate the
        # scale.
        spread = update_components(setup, problem, result)
        problem = build_problem(setup, functions, setup.views, spread)
        result = _refine_coarsely(problem, result.state)
    return with_coefficients(functions, result.state.theta), result.state, spread


def _refuse_lost_corners(setup: Setup, adjustment: Adjustment) -> None:
    """Refuse an adjustment whose camera does not show some corners at all, and name their views."""
    lost = adjustment.result.lost
    if not np.any(lost):
        return
    views = sorted({int(v) for v in adjustment.problem.view_of_point[lost]})
    more = f" and {len(views) - _NAMED} more" if len(views) > _NAMED else ""
    raise UnusableCalibrationError(
        "an adjustment whose camera cannot show corners of "
        f"{', '.join(setup.views[v].name for v in views[:_NAMED])}{more}",
        expected="views of one flat grid, by one microscope, at the magnifications that are stated",
        do="leave these views out, or check magnifications, --display-width and --squares",
    )


def _right_way_up(
    setup: Setup, functions: Functions, problem: Problem, result: BundleResult
) -> BundleResult:
    """Return the adjustment, or the one of the mirrored start if that fits better.

    It is tried where the pivot has come to lie on the far side of the specimen, where no microscope has it.
    """
    rho = with_coefficients(functions, result.state.theta)["rho"](setup.magnifications[0])
    if rho >= 0.0:
        return result
    other = refine(problem, mirror(functions, problem, result.state), tolerance=_COARSE)
    return other if other.cost < result.cost else result


def _refine_coarsely(problem: Problem, state: State) -> BundleResult:
    return refine(problem, state, tolerance=_COARSE)


def _theta(setup: Setup, functions: Functions, state: State) -> Array:
    """Return the coefficients of the functions, followed by the shared unknowns of a state."""
    return with_shared_values(functions, state.theta, len(setup.shared))


def _pad_functions(functions: Functions) -> dict[str, ContinuousFunction]:
    """Return the functions with a few more coefficients than were chosen, all zero."""
    out = dict(functions)
    low, high = functions["scale"].g_range
    for name in _SMOOTH if low < high else ():
        own = functions[name]
        size = max(own.smooth_size + _RESERVE, _LEAST_SIZE)
        smooth, jumps = np.split(own.coefficients, [own.smooth_size])
        zeros = np.zeros(size - own.smooth_size)
        out[name] = replace(own, coefficients=np.concatenate([smooth, zeros, jumps]))
    return out


def _linearise(
    setup: Setup, padded: Functions, views: Sequence[GridView], adjustment: Adjustment
) -> tuple[Problem, BundleResult]:
    """Return the problem of the padded functions, and its equations at the adjusted solution."""
    problem = build_problem(setup, padded, views, adjustment.spread)
    state = adjustment.result.state
    state = replace(state, theta=_theta(setup, padded, state))
    return problem, refine(problem, state, max_iterations=0)


def _pad_covariance(
    setup: Setup,
    padded: Functions,
    adjustment: Adjustment,
    field: FittedField | None,
    jitter: LineJitter,
) -> Array:
    """Return the covariance of the coefficients of the padded functions and of the field.

    A coefficient that was left out is not known to be zero: where the data do not determine it, its
    prior gives its uncertainty. Nor do the data say that it is zero: the estimate may also be wrong
    by as much as all coefficients would move if the omitted ones were free. Residuals that are
    smaller than the corners say do not make it smaller; those that lines share make it larger.
    """
    views = setup.views if field is None else undo_field(setup, field.field).views
    problem, result = _linearise(setup, padded, views, adjustment)
    state = result.state
    factor = variance_factor(adjustment.problem, adjustment.result)
    size = len(state.theta) - len(setup.shared)
    if field is None:
        reduced = reduced_normal_equations(
            problem, state.theta, result.information, result.gradient
        )
        covariance, moved = result.covariance, solve_scaled(*reduced)
    else:
        system = field_system(setup, problem, result, field.field)
        # This one is scaled to the variance that the residuals show.
        covariance = system.covariance(field.choice.prior) / factor
        theta, freed = solve_field(system, field.choice.prior, field.field)
        change = freed.coefficients - field.field.coefficients
        moved = np.concatenate([theta - state.theta, change.ravel()])
    covariance = (covariance + np.outer(moved, moved) / factor) * max(factor, 1.0)
    count = len(state.theta)
    covariance[:count, :count] += jitter_covariance(problem, result, jitter)
    keep = np.r_[0:size, count : len(moved)]
    return covariance[np.ix_(keep, keep)]


def _split_covariance(
    setup: Setup,
    padded: Functions,
    adjustment: Adjustment,
    views: Sequence[GridView],
    jitter: LineJitter,
) -> CovarianceParts:
    """Split the covariance C of the padded functions into what corners, visits and left-out coefficients add.

    The information is that of the corners and that of the priors, C^-1 = N + P, so that C = C N C + C P C: the first
    is what errors of the corners do to the estimate, the second what the priors stand for does. With all corners
    ``1 + t`` times as certain, C is ``((1 + t)^2 N + P)^-1``, whose derivative at t = 0 is -2 C N C. The
    prior of the coefficients that were left out is diagonal.
    """
    problem, result = _linearise(setup, padded, views, adjustment)
    state = result.state

    def covariance(certainty: float) -> Array:
        scaled = replace(problem, whitening=certainty * problem.whitening)
        return refine(scaled, state, max_iterations=0).covariance

    whole = result.covariance
    corners = (covariance(1.0 - _CERTAINTY_STEP) - covariance(1.0 + _CERTAINTY_STEP)) / (
        4.0 * _CERTAINTY_STEP
    )
    left = _left_out(adjustment.functions, padded)
    omitted = (whole[:, left] / problem.prior_sigma[left] ** 2) @ whole[left]
    factor = max(variance_factor(adjustment.problem, adjustment.result), 1.0)
    size = len(state.theta) - len(setup.shared)
    own = slice(0, size)
    shaken = jitter_covariance(problem, result, jitter)
    return CovarianceParts(
        (factor * corners + shaken)[own, own], (factor * (whole - corners - omitted))[own, own]
    )


def _left_out(chosen: Functions, padded: Functions) -> Indices:
    """Indices of the coefficients that the padded functions have and the chosen ones have not."""
    out: list[int] = []
    start = 0
    for name in names_of(padded):
        own, whole = chosen[name], padded[name]
        out += range(start + own.smooth_size, start + whole.smooth_size)
        start += whole.size
    return np.array(out, dtype=np.intp)


def _pattern_covariance(
    setup: Setup, padded: Functions, adjustment: Adjustment, pattern: GridPattern
) -> Array:
    """Return what an irregular grid adds to the covariance of the coefficients.

    It is the difference between the covariances with the pattern unknown and with none.
    """
    problem, result = _linearise(setup, padded, setup.views, adjustment)
    blank = blank_field(setup)
    system = field_system(setup, problem, result, blank, of_grid=True)
    size = len(result.state.theta) - len(setup.shared)
    free = system.covariance(pattern.choice.prior)[:size, :size]
    none = system.covariance(held_prior(blank, setup.norm_px))[:size, :size]
    return free - none


def _select_and_adjust(
    setup: Setup,
    functions: Functions,
    state: State,
    spread: VarianceComponents,
    sizes: Mapping[str, tuple[str, int]] | None = None,
    *,
    choose_terms: bool = True,
) -> Adjustment:
    """Choose the number of coefficients of every function, and further terms of the camera, until the choice no longer
    changes.

    Beside a residual field the terms stay as they are, since it takes the place of those that are not there.
    """
    problem = build_problem(setup, functions, setup.views, spread)
    state = replace(state, theta=_theta(setup, functions, state))
    result, _ = _adjust_with_other_poses(setup, functions, spread, problem, state)
    converged, rounds = False, 0
    terms = () if setup.priors.is_wide or not choose_terms else TERM_NAMES
    while rounds < _MAX_ROUNDS and not converged:
        rounds += 1
        every = build_problem(setup, functions, setup.views, spread, candidates=terms)
        summary = Summary.of(every, refine(every, result.state, max_iterations=0))
        chosen = select_functions(summary, setup, functions, _SMOOTH, terms, sizes)
        if chosen == sizes:
            result, count = _adjust_with_other_poses(
                setup, functions, spread, problem, result.state
            )
            converged = count == 0
            continue
        sizes = chosen
        functions = refit_functions(with_coefficients(functions, result.state.theta), chosen)
        spread = update_components(setup, problem, result)
        problem = build_problem(setup, functions, setup.views, spread)
        state = replace(result.state, theta=_theta(setup, functions, result.state))
        result = _refine_coarsely(problem, state)
    functions = with_coefficients(functions, result.state.theta)
    return Adjustment(functions, problem, result, spread, rounds, converged)


def _adjust_with_other_poses(
    setup: Setup,
    functions: Functions,
    spread: VarianceComponents,
    problem: Problem,
    state: State,
) -> tuple[BundleResult, int]:
    """Adjust, and adjust to other poses as long as some fit better; return how many did."""
    result, total = _refine_coarsely(problem, state), 0
    for _ in range(_MAX_TURNS):
        state, count = _try_other_poses(setup, functions, spread, result.state)
        other = _refine_coarsely(problem, state) if count else result
        if other.cost > result.cost - LEAST_DECREASE:
            # Better for some of the corners, and not for all.
            break
        result, total = other, total + count
    return result, total


def _try_other_poses(
    setup: Setup, functions: Functions, spread: VarianceComponents, state: State
) -> tuple[State, int]:
    """Try the mirrored tilt of every view, and a pose from the affine part of it; return how many fit better.

    A tilt that was chosen while the camera was still wrong may have the wrong sign, and then holds the camera back.
    """
    thin = replace(setup, views=tuple(_thin_view(v) for v in setup.views))
    few = build_problem(thin, functions, thin.views, spread)
    state, mirrored = resolve_mirrored_tilts(few, state)
    state, restarted = restart_poses(thin, few, state)
    return state, mirrored + restarted


def _adjust_exactly(setup: Setup, adjustment: Adjustment) -> Adjustment:
    """Adjust exactly with the chosen functions, after trying both signs of every tilt.

    The variance components are updated until they no longer change.
    """
    functions = adjustment.functions
    # From what is usual: spreads that were wide while the model was wrong would hold it there.
    spread = update_components(setup, adjustment.problem, adjustment.result)
    spread = limit_components(setup, spread)
    state, _ = _try_other_poses(setup, functions, spread, adjustment.result.state)
    for _ in range(_LAST_UPDATES):
        problem = build_problem(setup, functions, setup.views, spread)
        result = _right_way_up(setup, functions, problem, _refine_coarsely(problem, state))
        before, state = spread, result.state
        spread = update_components(setup, problem, result)
        if _largest_change(before, spread) < _SMALL_CHANGE:
            break
    problem = build_problem(setup, functions, setup.views, spread)
    result = refine(problem, state)
    functions = with_coefficients(functions, result.state.theta)
    return replace(adjustment, functions=functions, problem=problem, result=result, spread=spread)


def _largest_change(before: VarianceComponents, after: VarianceComponents) -> float:
    """Return the largest relative change of the variance components."""
    a, b = (
        np.concatenate(
            [
                [c.scale.sigma, c.visit_height.sigma],
                c.height_sigma_m,
                c.drift_sigma_px,
                () if c.lattice_sigma is None else c.lattice_sigma,
            ]
        )
        for c in (before, after)
    )
    return float(np.max(np.abs(np.log(b / a))))


def _grid_pattern(setup: Setup, adjustment: Adjustment, field: ResidualField) -> GridPattern | None:
    """Return the pattern of displacements that turns with the grid, or None if there is none."""
    system = field_system(setup, adjustment.problem, adjustment.result, field, of_grid=True)
    choice = choose_field(setup, system, field)
    return GridPattern(system, choice) if choice.worthwhile else None


def _add_field(
    setup: Setup, adjustment: Adjustment, always: bool
) -> tuple[Adjustment, FittedField | None, GridPattern | None]:
    """Add a residual field, or return the adjustment unchanged where it is not worthwhile.

    What stays with the image is the microscope's; what turns with the grid is the grid's, and no
    field is added for it. The one that predicts views that were left out better decides. Nor is a
    field added that leaves most of the misfit: the lattices of the views may differ by quarter
    turns and by whole squares, so that an irregular grid has no pattern of its own either.

    Each turn solves for camera and field together, and then adjusts poses and camera to
    observations that the field has corrected. In the first turns the strength of the field and the
    numbers of coefficients of the functions are chosen again.
    """
    field = blank = blank_field(setup)
    start, before = adjustment, setup
    for turn in range(_MAX_FIELD_TURNS):
        if np.any(adjustment.result.lost):
            # A field that moves corners to where the camera shows nothing is none.
            return start, None, None
        system = field_system(setup, adjustment.problem, adjustment.result, field)
        if turn < _CHOOSING_TURNS:
            choice = choose_field(setup, system, blank)
            if not (choice.worthwhile or always):
                return start, None, None
            if turn == 0 and setup.shared and not always:
                pattern = _grid_pattern(setup, adjustment, field)
                of_grid = pattern is not None and pattern.choice.gain > choice.gain
                if of_grid or choice.explained < _LEAST_EXPLAINED:
                    return start, None, pattern
        theta, field = solve_field(system, choice.prior, blank)
        after = undo_field(setup, field)
        adjustment = _readjust(after, adjustment, theta, choosing=turn < _CHOOSING_TURNS)
        pairs = zip(before.views, after.views, strict=True)
        change = np.concatenate([a.image_xy - b.image_xy for b, a in pairs])
        before = after
        if turn >= _CHOOSING_TURNS and np.sqrt(np.mean(change**2)) < _FIELD_CONVERGED_PX:
            return adjustment, FittedField(field, choice, system, True), None
    return adjustment, FittedField(field, choice, system, False), None


def _current_sizes(adjustment: Adjustment) -> dict[str, tuple[str, int]]:
    own = adjustment.functions
    return {name: (own[name].kind, own[name].smooth_size) for name in _SMOOTH}


def _readjust(setup: Setup, adjustment: Adjustment, theta: Array, *, choosing: bool) -> Adjustment:
    """Adjust to other views from other coefficients; ``choosing`` selects their number again."""
    functions = with_coefficients(adjustment.functions, theta)
    spread = update_components(setup, adjustment.problem, adjustment.result)
    state = replace(adjustment.result.state, theta=theta)
    if choosing:
        sizes = _current_sizes(adjustment)
        return _select_and_adjust(setup, functions, state, spread, sizes, choose_terms=False)
    problem = build_problem(setup, functions, setup.views, spread)
    result = _refine_coarsely(problem, state)
    functions = with_coefficients(functions, result.state.theta)
    return replace(adjustment, functions=functions, problem=problem, result=result, spread=spread)


def fit_joint(
    setup: Setup,
    residual: str = "off",
    on_stage: Callable[[str, float], None] = lambda _name, _fraction: None,
) -> JointFit:
    """Calibrate from views and nominal values alone.

    The poses come first, with a camera that does not depend on the magnification; then moderately
    flexible functions, both from a part of the corners; from there the number of coefficients of
    every function is chosen by leaving out one magnification at a time, until the choice no longer
    changes. With ``residual`` ``"on"``, or ``"auto"`` where cross-validation finds it worthwhile, a
    residual field is estimated too. ``on_stage`` as for ``calibrate_views``.
    """
    start_px = measure_misfit_px(setup)
    noisy = _tempered(setup, start_px)
    if start_px > 0.0:
        # What a stage says wrongly must not lead poses astray that are so uncertain.
        noisy = replace(noisy, tempering=np.inf)
    thin = replace(noisy, views=tuple(_thin_view(v) for v in noisy.views))
    on_stage("start values", 0.0)
    start = _fit_start(thin)
    on_stage("number of coefficients", 0.3)
    adjustment = _select_and_adjust(noisy, *start)
    noisy, adjustment = _anneal(setup, noisy, adjustment)
    field, pattern = None, None
    if residual != "off":
        on_stage("residual field", 0.5)
        adjustment, field, pattern = _add_field(noisy, adjustment, residual == "on")
    excess = _excess_px(setup, adjustment)
    final = setup = _with_excess(setup, excess)
    if field is not None:
        final = undo_field(setup, field.field)
    if excess > 0.0 or start_px > 0.0:
        spread = update_components(setup, adjustment.problem, adjustment.result)
        adjustment = _select_and_adjust(
            final, adjustment.functions, adjustment.result.state, spread, choose_terms=field is None
        )
    on_stage("final adjustment", 0.75)
    adjustment = _adjust_exactly(final, adjustment)
    _refuse_lost_corners(final, adjustment)
    certificate = certify(adjustment.functions, adjustment.problem, adjustment.result)
    if field is not None:
        system = field_system(setup, adjustment.problem, adjustment.result, field.field)
        field = replace(field, system=system)
    on_stage("uncertainty", 0.9)
    padded = _pad_functions(adjustment.functions)
    jitter = estimate_jitter(adjustment.problem, adjustment.result)
    covariance = _pad_covariance(setup, padded, adjustment, field, jitter)
    if pattern is not None:
        covariance = covariance + _pattern_covariance(setup, padded, adjustment, pattern)
    parts = _split_covariance(setup, padded, adjustment, final.views, jitter)
    return JointFit(adjustment, padded, covariance, jitter, field, pattern, excess, parts, certificate)


def without_magnification(fit: JointFit, index: int) -> tuple[Functions, ResidualField | None]:
    """Return the solution without one magnification, by one Gauss-Newton step on reduced equations.

    At the optimum the poses of the other views follow linearly, so one step is as good as a new
    adjustment.
    """
    if fit.field is not None:
        fitted = fit.field
        keep = fitted.system.group != index
        theta, field = solve_field(fitted.system, fitted.choice.prior, fitted.field, keep)
        return with_coefficients(fit.adjustment.functions, theta), field
    functions, result = fit.adjustment.functions, fit.adjustment.result
    information, gradient = result.information.copy(), result.gradient.copy()
    information[index] = 0.0
    gradient[index] = 0.0
    theta = result.state.theta
    matrix, right = reduced_normal_equations(fit.adjustment.problem, theta, information, gradient)
    return with_coefficients(functions, theta + solve_scaled(matrix, right)), None
