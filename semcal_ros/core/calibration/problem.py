"""Conversion of coefficient functions and their priors to an adjustment, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.bundle_adjustment import BundleResult, refine
from semcal_ros.core.calibration.normal_equations import Problem, State, make_problem, whitened_norm
from semcal_ros.core.calibration.priors import Setup
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, design_matrix
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.plane_geometry import mirrored_tilt

__all__ = [
    "Functions",
    "adjust",
    "build_problem",
    "constant_functions",
    "prior_vectors",
    "resolve_mirrored_tilts",
    "stack_coefficients",
    "variance_factor",
    "with_coefficients",
]

Functions = Mapping[str, ContinuousFunction]

# Rounds of turning views over. Each follows an adjustment to the last one, and the rounds end when
# no view turns.
_MAX_TURNS = 5
# Steps from either sign of a tilt, enough to say which fits better; the adjustment does the rest.
_POSE_ITERATIONS = 12


def build_problem(
    setup: Setup, functions: Functions, views: Sequence[GridView], height_sigma_m: Array | float
) -> Problem:
    """Set up the adjustment of ``views`` with functions of the given kinds and sizes."""
    nominal = setup.nominal_px_per_m(setup.magnifications)
    designs = np.stack(
        [
            design_matrix(functions, float(g), float(scale))
            for g, scale in zip(setup.magnifications, nominal, strict=True)
        ]
    )
    mean, sigma = prior_vectors(setup, functions)
    return make_problem(
        views,
        setup.magnifications,
        designs,
        norm_px=setup.norm_px,
        nominal_px_per_m=nominal,
        prior_mean=mean,
        prior_sigma=sigma,
        height_sigma_m=height_sigma_m,
    )


def prior_vectors(setup: Setup, functions: Functions) -> tuple[Array, Array]:
    """Return (K,) means and sigmas of all coefficients, as in :meth:`Setup.coefficient_priors`."""
    parts = [
        setup.coefficient_priors(name, functions[name].kind, functions[name].smooth_size)
        for name in FUNCTION_NAMES
    ]
    return np.concatenate([m for m, _ in parts]), np.concatenate([s for _, s in parts])


def with_coefficients(functions: Functions, theta: Array) -> dict[str, ContinuousFunction]:
    """Return the functions with coefficients from a vector in the order of ``FUNCTION_NAMES``."""
    out: dict[str, ContinuousFunction] = {}
    start = 0
    for name in FUNCTION_NAMES:
        stop = start + functions[name].size
        out[name] = replace(functions[name], coefficients=theta[start:stop].copy())
        start = stop
    return out


def constant_functions(setup: Setup, values: Mapping[str, float]) -> dict[str, ContinuousFunction]:
    """Make functions that do not depend on the magnification, except for their jumps."""
    g_range = (float(setup.magnifications[0]), float(setup.magnifications[-1]))
    return {
        name: ContinuousFunction(
            "chebyshev_log",
            np.array(
                [values.get(name, setup.prior_of(name)[0]), *np.zeros(len(setup.breaks_of(name)))]
            ),
            g_range,
            breaks=setup.breaks_of(name),
        )
        for name in FUNCTION_NAMES
    }


def stack_coefficients(functions: Functions) -> Array:
    """Return (K,) all coefficients in the order of ``FUNCTION_NAMES``."""
    return np.concatenate([functions[name].coefficients for name in FUNCTION_NAMES])


def adjust(problem: Problem, state: State, *, tolerance: float = 1e-9) -> BundleResult:
    """Refine, and turn views to their mirrored tilt as long as that fits better."""
    result = refine(problem, state, tolerance=tolerance)
    for _ in range(_MAX_TURNS):
        turned, changed = resolve_mirrored_tilts(problem, result.state)
        if not changed:
            break
        result = refine(problem, turned, tolerance=tolerance)
    return result


def resolve_mirrored_tilts(problem: Problem, state: State) -> tuple[State, int]:
    """Fit the poses from both signs of the tilt; return the better ones and how many changed."""
    pairs = zip(problem.starts[:-1], problem.starts[1:], strict=True)
    middle = np.stack([problem.board_m[a:b].mean(axis=0) for a, b in pairs])
    rotations = mirrored_tilt(state.rotations)
    # Turning about the middle of the visible points keeps the view in place.
    moved = np.einsum("vij,vj->vi", state.rotations - rotations, middle)
    mirrored = State(state.theta, rotations, state.translations_m + moved)
    own = refine(problem, state, fixed_theta=True, max_iterations=_POSE_ITERATIONS)
    other = refine(problem, mirrored, fixed_theta=True, max_iterations=_POSE_ITERATIONS)
    if not np.isfinite(other.cost):
        return own.state, 0
    better = _view_costs(problem, other) < _view_costs(problem, own) * (1.0 - 1e-6)
    pick = better[:, None, None]
    turned = State(
        state.theta,
        np.where(pick, other.state.rotations, own.state.rotations),
        np.where(pick[:, 0], other.state.translations_m, own.state.translations_m),
    )
    return turned, int(better.sum())


def _view_costs(problem: Problem, result: BundleResult) -> Array:
    square = whitened_norm(problem, result.residuals_px) ** 2 * result.huber_weight
    height = result.state.translations_m[:, 2] / problem.height_sigma_m
    return np.bincount(problem.view_of_point, weights=square) + height**2


def variance_factor(problem: Problem, result: BundleResult) -> float:
    """Return the mean square of the whitened residuals per degree of freedom (Huber-weighted)."""
    norm2 = whitened_norm(problem, result.residuals_px) ** 2 * result.huber_weight
    freedom = 2.0 * result.huber_weight.sum() - 6 * len(problem.group) - len(result.state.theta)
    return float(max(norm2.sum() / max(freedom, 1.0), 1e-12))
