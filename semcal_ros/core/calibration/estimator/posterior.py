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

"""What is known after an adjustment: the covariance of the coefficients, and what it consists of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Indices, solve_scaled
from semcal_ros.core.calibration.estimator.adjustment import (
    SMOOTH,
    Adjustment,
    FittedField,
    GridPattern,
)
from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult, refine
from semcal_ros.core.calibration.estimator.line_jitter import LineJitter, jitter_covariance
from semcal_ros.core.calibration.estimator.normal_equations import reduced_normal_equations
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.estimator.problem import (
    Functions,
    build_problem,
    stack_theta,
    variance_factor,
)
from semcal_ros.core.calibration.estimator.residual_field_fit import (
    blank_field,
    field_system,
    held_prior,
    solve_field,
    undo_field,
)
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import names_of
from semcal_ros.core.camera.continuous_function import ContinuousFunction

__all__ = [
    "CovarianceParts",
    "pad_covariance",
    "pad_functions",
    "pattern_covariance",
    "split_covariance",
]

# Number of zero coefficients that are added to the chosen ones, and the least number in all: what
# the views leave open of them enters the covariance.
_RESERVE, _LEAST_SIZE = 2, 5
# Step of a central difference: its error is the square of this, far below what a share is worth.
_CERTAINTY_STEP = 0.02


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


def pad_functions(functions: Functions) -> dict[str, ContinuousFunction]:
    """Return the functions with a few more coefficients than were chosen, all zero."""
    out = dict(functions)
    low, high = functions["scale"].g_range
    for name in SMOOTH if low < high else ():
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
    state = replace(state, theta=stack_theta(setup, padded, state))
    return problem, refine(problem, state, max_iterations=0)


def pad_covariance(
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


def split_covariance(
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


def pattern_covariance(
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
