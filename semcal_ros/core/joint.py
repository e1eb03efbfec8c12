"""The default calibration: one adjustment over all images at all magnifications.

Its unknowns are the coefficients of the continuous functions themselves, so a magnification with few views borrows
from its neighbours and nothing has to be interpolated afterwards (design section 6.4).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.bundle import BundleResult, refine
from semcal_ros.core.functions import ContinuousFunction
from semcal_ros.core.initial import initial_values
from semcal_ros.core.problem import (
    Functions,
    Setup,
    adjust,
    build_problem,
    constant_functions,
    resolve_mirrored_tilts,
    theta_of,
    with_coefficients,
)
from semcal_ros.core.reprojection import Problem, State, scaled_solve, theta_system
from semcal_ros.core.selection import Summary, select_functions
from semcal_ros.core.views import GridView

__all__ = ["JointFit", "fit_joint", "without_magnification"]

Array = NDArray[np.float64]

_SMOOTH = ("scale", "aspect", "skew", "xi_r", "xi_t", "ex", "ey")
_MAX_ROUNDS = 5
_RESERVE, _LEAST_SIZE = 2, 5
_HEIGHT_UPDATES = 3
# For what only has to be near: signs of tilts, poses, moderately flexible functions.
_ENOUGH_CORNERS = 60
# Tolerance of the adjustments on the way; only the last one has to be exact.
_COARSE = 1e-6
# The depth gradient of weakly tilted views says little; a start beyond 5 mm would be noise.
_MAX_START_RHO = 200.0


@dataclass(frozen=True)
class JointFit:
    """Outcome of :func:`fit_joint`.

    Attributes
    ----------
    functions, result, problem
        The adjustment with the chosen number of coefficients.
    padded, covariance
        The same functions with some coefficients more, which are zero, and the covariance of all of them for unit
        variance of the residuals.
    rounds, settled
        How the choice came about.
    """

    functions: Functions
    result: BundleResult
    problem: Problem
    padded: Functions
    covariance: Array
    rounds: int
    settled: bool


def _height_sigma(result: BundleResult) -> float:
    """Expectation-maximisation update of the spread of the heights."""
    square = result.state.translations_m[:, 2] ** 2 + result.height_variance_m2
    return float(np.clip(np.sqrt(np.mean(square)), 1e-6, 2e-3))


def enriched(
    functions: Functions, sizes: Mapping[str, tuple[str, int]]
) -> dict[str, ContinuousFunction]:
    """Functions of other kinds and sizes through the values of the given ones, by least squares."""
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


def _thinned(view: GridView) -> GridView:
    """The view with a spread of at most so many corners as its pose and a rough camera need."""
    if len(view.board_xy_m) <= _ENOUGH_CORNERS:
        return view
    keep = np.random.default_rng(0).permutation(len(view.board_xy_m))[:_ENOUGH_CORNERS]
    return replace(
        view,
        board_xy_m=view.board_xy_m[keep],
        image_xy=view.image_xy[keep],
        sigma_px=view.sigma_px[keep],
    )


def _started(setup: Setup) -> tuple[Functions, State, float]:
    """Moderately flexible functions, poses, and the spread of the heights, from nominal values alone."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    functions: Functions = constant_functions(
        setup, {"scale": start.scale_factor, "rho": min(max(start.rho, 0.0), _MAX_START_RHO)}
    )
    height = setup.priors.height_sigma_m
    problem = build_problem(setup, functions, setup.views, height)
    state = State(theta_of(functions), start.rotations, start.translations_m)
    state, _ = resolve_mirrored_tilts(problem, state)

    size = min(3, max(1, len(setup.magnifications) - 1))
    functions = enriched(functions, dict.fromkeys(_SMOOTH, ("chebyshev_log", size)))
    problem = build_problem(setup, functions, setup.views, height)
    result = adjust(problem, replace(state, theta=theta_of(functions)), tolerance=_COARSE)
    for _ in range(_HEIGHT_UPDATES):
        # Before anything is selected: too wide a prior of the heights would let them imitate the scale.
        height = _height_sigma(result)
        problem = replace(problem, height_sigma_m=height)
        result = refine(problem, result.state, tolerance=_COARSE)
    return with_coefficients(functions, result.state.theta), result.state, height


def _with_reserve(functions: Functions) -> dict[str, ContinuousFunction]:
    """The functions with some more coefficients than were chosen, all zero."""
    out = dict(functions)
    low, high = functions["scale"].g_range
    for name in _SMOOTH if low < high else ():
        own = functions[name]
        size = max(own.smooth_size + _RESERVE, _LEAST_SIZE)
        smooth, jumps = np.split(own.coefficients, [own.smooth_size])
        zeros = np.zeros(size - own.smooth_size)
        out[name] = replace(own, coefficients=np.concatenate([smooth, zeros, jumps]))
    return out


def _covariance_with_reserve(
    setup: Setup, padded: Functions, result: BundleResult, height_sigma_m: float
) -> Array:
    """Covariance of the padded functions' coefficients.

    A coefficient that was left out is not known to be zero: what the data do not tell about it is as uncertain as its
    prior says.
    """
    problem = build_problem(setup, padded, setup.views, height_sigma_m)
    state = replace(result.state, theta=theta_of(padded))
    return refine(problem, state, max_iterations=0).covariance


def fit_joint(setup: Setup) -> JointFit:
    """Calibrate from nominal values alone.

    The poses come first, with a camera that does not depend on the magnification; then moderately flexible functions,
    both from a part of the corners; from there the number of coefficients of every function is chosen by leaving out
    one magnification at a time, until the choice no longer changes.
    """
    thin = replace(setup, views=tuple(_thinned(v) for v in setup.views))
    functions, state, height = _started(thin)
    problem = build_problem(setup, functions, setup.views, height)
    result = refine(problem, state, tolerance=_COARSE)

    settled, rounds = len(setup.magnifications) < 3, 0
    sizes: dict[str, tuple[str, int]] | None = None
    while rounds < _MAX_ROUNDS and not settled:
        rounds += 1
        chosen = select_functions(Summary.of(problem, result), setup, functions, _SMOOTH, sizes)
        settled = chosen == sizes
        if settled:
            break
        sizes = chosen
        functions = enriched(with_coefficients(functions, result.state.theta), chosen)
        problem = build_problem(setup, functions, setup.views, _height_sigma(result))
        result = refine(
            problem, replace(result.state, theta=theta_of(functions)), tolerance=_COARSE
        )
    functions = with_coefficients(functions, result.state.theta)
    height = _height_sigma(result)
    turned, _ = resolve_mirrored_tilts(
        build_problem(thin, functions, thin.views, height), result.state
    )
    problem = build_problem(setup, functions, setup.views, height)
    result = refine(problem, turned)
    functions = with_coefficients(functions, result.state.theta)
    padded = _with_reserve(functions)
    covariance = _covariance_with_reserve(setup, padded, result, height)
    return JointFit(functions, result, problem, padded, covariance, rounds, settled)


def without_magnification(fit: JointFit, index: int) -> Functions:
    """The joint solution without one magnification, by one Gauss-Newton step on the reduced equations.

    At the optimum the poses of the other views follow linearly, so that one step is as good as a new adjustment.
    """
    information, gradient = fit.result.information.copy(), fit.result.gradient.copy()
    information[index] = 0.0
    gradient[index] = 0.0
    theta = theta_of(fit.functions)
    matrix, right = theta_system(fit.problem, theta, information, gradient)
    return with_coefficients(fit.functions, theta + scaled_solve(matrix, right, 0.0))
