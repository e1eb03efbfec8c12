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

"""Conversion of coefficient functions and their priors to an adjustment, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.blocks import Effects, Problem, State, make_problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.estimator.residuals import whitened_norm
from semcal_ros.core.calibration.estimator.variance_components import VarianceComponents
from semcal_ros.core.calibration.stage import attitudes
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import (
    ALL_FUNCTIONS,
    FUNCTION_NAMES,
    design_matrix,
    names_of,
)
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.projection import ALL_NAMES

__all__ = [
    "Functions",
    "build_problem",
    "constant_functions",
    "prior_vectors",
    "stack_coefficients",
    "stack_theta",
    "variance_factor",
    "weighted_squares",
    "with_coefficients",
    "with_shared",
    "with_shared_values",
]

Functions = Mapping[str, ContinuousFunction]


def build_problem(
    setup: Setup,
    functions: Functions,
    views: Sequence[GridView],
    spread: VarianceComponents | float,
    *,
    candidates: Sequence[str] = (),
) -> Problem:
    """Set up the adjustment of ``views`` with functions of the given kinds and sizes.

    Given one number, the 1-sigma of the heights, it has neither shared unknowns nor effects. ``candidates`` are
    parameters without a function, of which only the information is asked.
    """
    nominal = setup.nominal_px_per_m(setup.magnifications)
    rows = tuple(name for name in ALL_FUNCTIONS if name in functions or name in candidates)
    designs = np.stack(
        [
            design_matrix(functions, float(g), float(scale), rows)
            for g, scale in zip(setup.magnifications, nominal, strict=True)
        ]
    )
    mean, sigma = prior_vectors(setup, functions)
    shared = () if isinstance(spread, float) else setup.shared
    if shared:
        designs = with_shared(designs, len(shared))
        own_mean, own_sigma = setup.shared_priors()
        mean, sigma = np.concatenate([mean, own_mean]), np.concatenate([sigma, own_sigma])
    problem = make_problem(
        views,
        setup.magnifications,
        designs,
        raster=setup.raster,
        parameters=tuple(ALL_NAMES[ALL_FUNCTIONS.index(name)] for name in rows),
        nominal_px_per_m=nominal,
        prior_mean=mean,
        prior_sigma=sigma,
        height_sigma_m=spread if isinstance(spread, float) else spread.height_sigma_m,
    )
    if not shared or isinstance(spread, float):
        return problem
    visit, visit_group = setup.visits
    height = setup.image_size[1]
    y = np.concatenate([v.image_xy[:, 1] for v in views])
    effects = Effects(
        visit,
        visit_group,
        spread.scale.sigma,
        spread.visit_height.sigma,
        spread.drift_sigma_px,
        (y - 0.5 * (height - 1)) / height,
        spread.lattice_sigma,
    )
    known = attitudes(
        [v.stage for v in views],
        [v.untilted for v in views],
        setup.axis,
        setup.priors.untilted_sigma_rad,
    )
    known = replace(known, sigma_rad=setup.tempering * known.sigma_rad)
    sizes = setup.squares_m
    return replace(
        problem,
        shared=shared,
        square_class=np.array([sizes.index(v.square_m) for v in views], dtype=np.intp),
        effects=effects,
        attitudes=known if known.say_anything else None,
    )


def with_shared(designs: Array, count: int) -> Array:
    """Return designs (M, P, K) with ``count`` more unknowns, the same at every magnification."""
    groups, rows, columns = designs.shape
    out = np.zeros((groups, rows + count, columns + count))
    out[:, :rows, :columns] = designs
    out[:, np.arange(rows, rows + count), np.arange(columns, columns + count)] = 1.0
    return out


def with_shared_values(functions: Functions, theta: Array, shared: int) -> Array:
    """Return the coefficients of the functions, followed by the last ``shared`` values of theta."""
    return np.concatenate([stack_coefficients(functions), theta[len(theta) - shared :]])


def prior_vectors(setup: Setup, functions: Functions) -> tuple[Array, Array]:
    """Return (K,) means and sigmas of all coefficients, as in :meth:`Setup.coefficient_priors`."""
    parts = [
        setup.coefficient_priors(name, functions[name].kind, functions[name].smooth_size)
        for name in names_of(functions)
    ]
    return np.concatenate([m for m, _ in parts]), np.concatenate([s for _, s in parts])


def with_coefficients(functions: Functions, theta: Array) -> dict[str, ContinuousFunction]:
    """Return the functions with coefficients from a vector in the order of ``ALL_FUNCTIONS``."""
    out: dict[str, ContinuousFunction] = {}
    start = 0
    for name in names_of(functions):
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
    """Return (K,) all coefficients in the order of ``ALL_FUNCTIONS``."""
    return np.concatenate([functions[name].coefficients for name in names_of(functions)])


def stack_theta(setup: Setup, functions: Functions, state: State) -> Array:
    """Return the coefficients of the functions, followed by the shared unknowns of a state."""
    return with_shared_values(functions, state.theta, len(setup.shared))


def weighted_squares(problem: Problem, result: BundleResult) -> Array:
    """(N,) squares of the whitened residuals with their weights; 0 for a point without a projection."""
    square = whitened_norm(problem, result.residuals_px) ** 2
    return np.where(result.huber_weight > 0.0, square, 0.0) * result.huber_weight


def variance_factor(problem: Problem, result: BundleResult) -> float:
    """Return the mean square of the whitened residuals per degree of freedom (Huber-weighted)."""
    norm2 = weighted_squares(problem, result)
    unknowns = problem.layout.of_view.size * len(problem.group) + len(result.state.theta)
    freedom = 2.0 * result.huber_weight.sum() - unknowns - result.state.visits.size
    return float(max(norm2.sum() / max(freedom, 1.0), 1e-12))
