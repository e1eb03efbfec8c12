"""The default calibration: one adjustment over all images at all magnifications.

Its unknowns are the coefficients of the continuous functions themselves, so a magnification with
few views borrows from its neighbours, and nothing needs to be interpolated afterwards (design
section 6.4).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, solve_scaled
from semcal_ros.core.calibration.bundle_adjustment import BundleResult, refine
from semcal_ros.core.calibration.initial_values import initial_values
from semcal_ros.core.calibration.model_selection import Summary, select_functions
from semcal_ros.core.calibration.normal_equations import (
    Problem,
    State,
    reduced_normal_equations,
)
from semcal_ros.core.calibration.priors import Setup
from semcal_ros.core.calibration.problem import (
    Functions,
    adjust,
    build_problem,
    constant_functions,
    resolve_mirrored_tilts,
    stack_coefficients,
    variance_factor,
    with_coefficients,
)
from semcal_ros.core.calibration.residual_field_fit import (
    FieldChoice,
    FieldSystem,
    blank_field,
    choose_field,
    field_system,
    solve_field,
    undo_field,
)
from semcal_ros.core.calibration.views import GridView, add_excess_noise, estimate_excess_sigma_px
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.residual_field import ResidualField

__all__ = [
    "RESIDUAL_MODES",
    "Adjustment",
    "FittedField",
    "JointFit",
    "adapt_priors",
    "fit_joint",
    "without_magnification",
]


RESIDUAL_MODES = ("auto", "off", "on")
_SMOOTH = ("scale", "aspect", "skew", "xi_r", "xi_t", "ex", "ey")
# Rounds of choosing the numbers of coefficients. A choice that alternates never converges; the
# calibration then carries a warning.
_MAX_ROUNDS = 5
# Number of zero coefficients that are added to the chosen ones, and the least number in all: what
# the views leave open of them enters the covariance.
_RESERVE, _LEAST_SIZE = 2, 5
# Updates of the spread of the heights before anything is selected. It has to be near only, since
# every later adjustment updates it again.
_HEIGHT_UPDATES = 4
# Limits of the spread of heights, relative to its prior: a micrometre is less than any view can
# show, and a depth of field of millimetres does not occur.
_LEAST_HEIGHT, _MOST_HEIGHT = 0.01, 20.0
# Tilt up to which a view counts as one from above: more than that of an untilted specimen on its
# mount, less than tilts that are set on purpose.
_FLAT_RAD = np.radians(5.0)
# Fewer views than this do not determine a spread of their own.
_ENOUGH_HEIGHTS = 4
# Corners per view for what only needs to be near: signs of tilts, poses, start functions.
_ENOUGH_CORNERS = 60
# Tolerance of the intermediate adjustments; only the last one needs to be exact.
_COARSE = 1e-6
# Turns of field and adjustment at most, and those in which strength and numbers of coefficients may
# change; with both fixed the turns converge.
_MAX_FIELD_TURNS, _CHOOSING_TURNS = 12, 2
# RMS change of the corrections of all corners, px, at which the field has converged: a fiftieth of
# the noise of good corners.
_FIELD_CONVERGED_PX = 1e-3
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
class Adjustment:
    """Continuous functions with a chosen number of coefficients, adjusted to the views.

    Attributes
    ----------
    functions
        The functions.
    problem, result
        The adjustment that gave their coefficients.
    rounds
        Number of times that the numbers of coefficients were chosen.
    converged
        Whether the last choice was the same as that of the round before.
    """

    functions: Functions
    problem: Problem
    result: BundleResult
    rounds: int
    converged: bool


@dataclass(frozen=True)
class JointFit:
    """Result of :func:`fit_joint`.

    Attributes
    ----------
    adjustment
        The adjustment with the chosen number of coefficients.
    padded, covariance
        The same functions with a few more coefficients, which are zero, and the covariance of all
        of them, followed by that of the coefficients of the field, for unit variance of the
        residuals.
    field
        The residual field, or None.
    excess_px
        1-sigma per axis, px, by which all corners scatter beyond their own.
    """

    adjustment: Adjustment
    padded: Functions
    covariance: Array
    field: FittedField | None
    excess_px: float


def _update_height_sigma(setup: Setup, result: BundleResult) -> Array:
    """Update the (V,) spread of the heights by expectation maximisation.

    Views without tilt have a spread of their own: the axis of the stage hardly ever passes through
    the point in view, so that tilting changes the height, while views from above may all share one
    height.
    """
    square = result.state.translations_m[:, 2] ** 2 + result.height_variance_m2
    flat = result.state.rotations[:, 2, 2] > np.cos(_FLAT_RAD)
    if min(flat.sum(), (~flat).sum()) < _ENOUGH_HEIGHTS:
        flat = np.zeros_like(flat)
    variance = np.empty(len(square))
    for group in (flat, ~flat):
        variance[group] = np.mean(square[group]) if np.any(group) else 0.0
    prior = setup.priors.height_sigma_m
    return np.clip(np.sqrt(variance), _LEAST_HEIGHT * prior, _MOST_HEIGHT * prior)


def refit_functions(
    functions: Functions, sizes: Mapping[str, tuple[str, int]]
) -> dict[str, ContinuousFunction]:
    """Fit functions of other kinds and sizes to the values of the given ones, by least squares."""
    out: dict[str, ContinuousFunction] = {}
    for name, function in functions.items():
        kind, size = sizes.get(name, (function.kind, function.smooth_size))
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


def _fit_start(setup: Setup) -> tuple[Functions, State, Array]:
    """Fit moderately flexible functions, poses and the spread of heights from nominal values."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    rho = start.rho if start.wide else min(max(start.rho, 0.0), _MAX_START_RHO)
    functions: Functions = constant_functions(setup, {"scale": start.scale_factor, "rho": rho})
    height = np.full(len(setup.views), setup.priors.height_sigma_m)
    problem = build_problem(setup, functions, setup.views, height)
    state = State(stack_coefficients(functions), start.rotations, start.translations_m)
    state, _ = resolve_mirrored_tilts(problem, state)

    size = min(3, max(1, len(setup.magnifications) - 1))
    functions = refit_functions(functions, dict.fromkeys(_SMOOTH, ("chebyshev_log", size)))
    problem = build_problem(setup, functions, setup.views, height)
    result = adjust(problem, replace(state, theta=stack_coefficients(functions)), tolerance=_COARSE)
    for _ in range(_HEIGHT_UPDATES):
        # Before anything is selected: too wide a prior of the heights would let them imitate the
        # scale.
        height = _update_height_sigma(setup, result)
        problem = replace(problem, height_sigma_m=height)
        result = refine(problem, result.state, tolerance=_COARSE)
    return with_coefficients(functions, result.state.theta), result.state, height


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


def _pad_covariance(
    setup: Setup, padded: Functions, adjustment: Adjustment, field: FittedField | None
) -> Array:
    """Return the covariance of the coefficients of the padded functions and of the field.

    A coefficient that was left out is not known to be zero: where the data do not determine it, its
    prior gives its uncertainty. Nor do the data say that it is zero: the estimate may also be wrong
    by as much as all coefficients would move if the omitted ones were free.
    """
    views = setup.views if field is None else undo_field(setup, field.field).views
    problem = build_problem(setup, padded, views, adjustment.problem.height_sigma_m)
    state = replace(adjustment.result.state, theta=stack_coefficients(padded))
    result = refine(problem, state, max_iterations=0)
    factor = variance_factor(adjustment.problem, adjustment.result)
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
    return covariance + np.outer(moved, moved) / factor


def _select_and_adjust(
    setup: Setup,
    functions: Functions,
    state: State,
    height_sigma_m: Array,
    sizes: Mapping[str, tuple[str, int]] | None = None,
) -> Adjustment:
    """Choose the number of coefficients of every function until the choice no longer changes."""
    problem = build_problem(setup, functions, setup.views, height_sigma_m)
    result = refine(problem, replace(state, theta=stack_coefficients(functions)), tolerance=_COARSE)
    converged, rounds = len(setup.magnifications) < 3, 0
    while rounds < _MAX_ROUNDS and not converged:
        rounds += 1
        chosen = select_functions(Summary.of(problem, result), setup, functions, _SMOOTH, sizes)
        converged = chosen == sizes
        if converged:
            break
        sizes = chosen
        functions = refit_functions(with_coefficients(functions, result.state.theta), chosen)
        problem = build_problem(setup, functions, setup.views, _update_height_sigma(setup, result))
        result = refine(
            problem, replace(result.state, theta=stack_coefficients(functions)), tolerance=_COARSE
        )
    functions = with_coefficients(functions, result.state.theta)
    return Adjustment(functions, problem, result, rounds, converged)


def _adjust_exactly(setup: Setup, adjustment: Adjustment) -> Adjustment:
    """Adjust exactly with the chosen functions, after trying both signs of every tilt."""
    thin = replace(setup, views=tuple(_thin_view(v) for v in setup.views))
    height = _update_height_sigma(setup, adjustment.result)
    turned, _ = resolve_mirrored_tilts(
        build_problem(thin, adjustment.functions, thin.views, height), adjustment.result.state
    )
    problem = build_problem(setup, adjustment.functions, setup.views, height)
    result = refine(problem, turned)
    functions = with_coefficients(adjustment.functions, result.state.theta)
    return replace(adjustment, functions=functions, problem=problem, result=result)


def _add_field(
    setup: Setup, adjustment: Adjustment, always: bool
) -> tuple[Adjustment, FittedField | None]:
    """Add a residual field, or return the adjustment unchanged where it is not worthwhile.

    Each turn solves for camera and field together, and then adjusts poses and camera to
    observations that the field has corrected. In the first turns the strength of the field and the
    numbers of coefficients of the functions are chosen again.
    """
    field = blank = blank_field(setup)
    start, before = adjustment, setup
    for turn in range(_MAX_FIELD_TURNS):
        system = field_system(setup, adjustment.problem, adjustment.result, field)
        if turn < _CHOOSING_TURNS:
            choice = choose_field(setup, system, blank)
            if not (choice.worthwhile or always):
                return start, None
        theta, field = solve_field(system, choice.prior, blank)
        after = undo_field(setup, field)
        adjustment = _readjust(after, adjustment, theta, choosing=turn < _CHOOSING_TURNS)
        pairs = zip(before.views, after.views, strict=True)
        change = np.concatenate([a.image_xy - b.image_xy for b, a in pairs])
        before = after
        if turn >= _CHOOSING_TURNS and np.sqrt(np.mean(change**2)) < _FIELD_CONVERGED_PX:
            return adjustment, FittedField(field, choice, system, True)
    return adjustment, FittedField(field, choice, system, False)


def _current_sizes(adjustment: Adjustment) -> dict[str, tuple[str, int]]:
    own = adjustment.functions
    return {name: (own[name].kind, own[name].smooth_size) for name in _SMOOTH}


def _readjust(setup: Setup, adjustment: Adjustment, theta: Array, *, choosing: bool) -> Adjustment:
    """Adjust to other views from other coefficients; ``choosing`` selects their number again."""
    functions, height = (
        with_coefficients(adjustment.functions, theta),
        _update_height_sigma(setup, adjustment.result),
    )
    if choosing:
        return _select_and_adjust(
            setup, functions, adjustment.result.state, height, _current_sizes(adjustment)
        )
    problem = build_problem(setup, functions, setup.views, height)
    result = refine(problem, replace(adjustment.result.state, theta=theta), tolerance=_COARSE)
    functions = with_coefficients(functions, result.state.theta)
    return replace(adjustment, functions=functions, problem=problem, result=result)


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
    thin = replace(setup, views=tuple(_thin_view(v) for v in setup.views))
    on_stage("start values", 0.0)
    start = _fit_start(thin)
    on_stage("number of coefficients", 0.3)
    adjustment, field = _select_and_adjust(setup, *start), None
    if residual != "off":
        on_stage("residual field", 0.5)
        adjustment, field = _add_field(setup, adjustment, residual == "on")
    excess = estimate_excess_sigma_px(
        setup.views, adjustment.result.residuals_px, 6 * len(setup.views)
    )
    if excess > 0.0:
        setup = replace(setup, views=add_excess_noise(setup.views, excess))
    final = setup if field is None else undo_field(setup, field.field)
    if excess > 0.0:
        height = _update_height_sigma(setup, adjustment.result)
        adjustment = _select_and_adjust(
            final, adjustment.functions, adjustment.result.state, height, _current_sizes(adjustment)
        )
    on_stage("final adjustment", 0.75)
    adjustment = _adjust_exactly(final, adjustment)
    if field is not None:
        system = field_system(setup, adjustment.problem, adjustment.result, field.field)
        field = replace(field, system=system)
    padded = _pad_functions(adjustment.functions)
    covariance = _pad_covariance(setup, padded, adjustment, field)
    return JointFit(adjustment, padded, covariance, field, excess)


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
    theta = stack_coefficients(functions)
    matrix, right = reduced_normal_equations(fit.adjustment.problem, theta, information, gradient)
    return with_coefficients(functions, theta + solve_scaled(matrix, right)), None
