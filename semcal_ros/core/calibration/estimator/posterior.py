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

"""What is known after an adjustment: that it ended at a minimum, the covariance, and what this consists of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Indices, equilibrate, invert_scaled, solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    SMOOTH_AT_LAST,
    Adjustment,
    BundleResult,
    refine,
    residual_variance,
    variance_factor,
)
from semcal_ros.core.calibration.estimator.correlated_errors import (
    LineJitter,
    estimate_jitter,
    jitter_covariance,
)
from semcal_ros.core.calibration.estimator.problem import (
    SCAN_GAINS,
    Functions,
    Setup,
    build_problem,
    stack_theta,
)
from semcal_ros.core.calibration.estimator.residual_field_fit import (
    FittedField,
    GridPattern,
    blank_field,
    field_system,
    held_prior,
    solve_field,
)
from semcal_ros.core.calibration.estimator.thresholds import (
    CERTAINTY_STEP,
    CHANGE_FALLS,
    CHANGE_LIMITS,
    CHANGE_UPDATES,
    FALL_DOUBT,
    HELD_PART,
    NAMED_MAX,
    REMAINING_MAX,
    RESERVE_SIZE,
    RESERVE_SIZE_MIN,
    USUAL_CHANGES,
)
from semcal_ros.core.camera.calibration_model import columns_of
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.distortion import LENS_NAMES
from semcal_ros.core.camera.records import Certificate
from semcal_ros.core.errors import UnusableCalibrationError

PADDED = tuple(dict.fromkeys((*SMOOTH_AT_LAST, *LENS_NAMES)))
"""The functions whose form between the magnifications is uncertain, where they are there: all but those of the scan,
which hardly change, and the constants."""


def certify(functions: Functions, problem: Problem, result: BundleResult) -> Certificate:
    """Certify an adjustment.

    Raises
    ------
    UnusableCalibrationError
        If one more Newton step would move an unknown by more than its sigma, or the equations have no solution. The
        message names the unknowns.
    """
    matrix, right = result.equations(problem)
    sigmas = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))
    scaled, _ = equilibrate(matrix)
    values = np.linalg.eigvalsh(scaled) if np.all(np.isfinite(scaled)) else np.zeros(1)
    names = [name for name in columns_of(functions) for _ in range(functions[name].size)]
    names += list(problem.shared)
    if not (values[0] > 0.0 and np.all(np.isfinite(sigmas)) and np.all(sigmas > 0.0)):
        weak = [
            name for name, s in zip(names, sigmas, strict=True) if not (np.isfinite(s) and s > 0)
        ]
        raise UnusableCalibrationError(
            "a fit whose equations have no solution",
            expected=f"views that determine {', '.join(dict.fromkeys(weak)) or 'the camera'}",
            do="record views with more tilt, at more magnifications",
        )
    remaining = np.abs(solve_scaled(matrix, right)) / sigmas
    if float(remaining.max()) > REMAINING_MAX:
        worst = [names[k] for k in np.argsort(-remaining) if remaining[k] > REMAINING_MAX]
        raise UnusableCalibrationError(
            f"a fit that is not at a minimum: {', '.join(list(dict.fromkeys(worst))[:NAMED_MAX])} would still move by "
            f"{remaining.max():.1f} sigma",
            expected="views of one flat grid, by one microscope, at the magnifications that are stated",
            do="leave out views that are not such, or record more",
        )
    held = []
    for name, own in columns_of(functions).items():
        prior, first = problem.prior_sigma[own.start], sigmas[own.start]
        if np.isfinite(prior) and first**2 > (HELD_PART * prior) ** 2:
            held.append(name)
    return Certificate(
        remaining_sigmas=float(remaining.max()),
        last_decrease=max(result.last_decrease, 0.0),
        condition=float(values[-1] / values[0]),
        held=tuple(held),
    )


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
class PaddedAdjustment:
    """An adjustment at its end, with a few more coefficients than were chosen, all zero.

    Attributes
    ----------
    chosen
        The adjustment.
    functions
        The functions with these coefficients.
    problem, result
        The equations of all coefficients at the adjusted solution; the views are those of the adjustment, from which a
        residual field has been taken off.
    jitter
        Errors that corners on neighbouring lines share.
    line_covariance
        (K, K) what they add to the covariance of theta.
    """

    chosen: Adjustment
    functions: Functions
    problem: Problem
    result: BundleResult
    jitter: LineJitter
    line_covariance: Array

    @property
    def variance_factor(self) -> float:
        """That of the residuals of the chosen adjustment."""
        return variance_factor(self.chosen.problem, self.chosen.result)


def pad(setup: Setup, adjustment: Adjustment) -> PaddedAdjustment:
    """Return the adjustment with a few more coefficients; ``setup`` has the views that it was made of."""
    # What a further term may do besides is a residual field's, where there is one.
    names = SMOOTH_AT_LAST if setup.corrected else PADDED
    functions = _pad_functions(adjustment.functions, names)
    problem = build_problem(setup, functions, setup.views, adjustment.spread)
    state = adjustment.result.state
    state = replace(state, theta=stack_theta(setup, functions, state))
    result = refine(problem, state, max_iterations=0)
    problem = replace(problem, prior_sigma=estimate_changes(functions, problem, result))
    result = refine(problem, state, max_iterations=0)
    jitter = estimate_jitter(adjustment.problem, adjustment.result)
    lines = jitter_covariance(problem, result, jitter)
    return PaddedAdjustment(adjustment, functions, problem, result, jitter, lines)


def _pad_functions(functions: Functions, names: Sequence[str]) -> dict[str, ContinuousFunction]:
    out = dict(functions)
    low, high = functions["scale"].g_range
    for name in names if low < high else ():
        if name not in functions:
            continue
        own = functions[name]
        size = max(own.smooth_size + RESERVE_SIZE, RESERVE_SIZE_MIN)
        smooth, jumps = np.split(own.coefficients, [own.smooth_size])
        zeros = np.zeros(size - own.smooth_size)
        out[name] = replace(own, coefficients=np.concatenate([smooth, zeros, jumps]))
    return out


def estimate_changes(padded: Functions, problem: Problem, result: BundleResult) -> Array:
    """Return the (K,) prior sigmas of theta, with those of the changes of each function as large as they seem to be.

    The prior of the changes is that of any microscope. Two things about this one are estimated. How quickly the
    coefficients fall with their order is the same for all functions of the lens; it maximises the evidence
    (:func:`log_evidence`), but for two half chi-squares in favour of functions that bend more: with half of one, one
    check in ten found a distortion at the level of 5 % where nothing had changed. The gains of the scan are not
    presumed to be that smooth. How much a function changes is a variance component, estimated as in
    :mod:`~semcal_ros.core.calibration.estimator.variance_components`: the squares of its coefficients but the first, in
    prior sigmas, over the number of them that the views determine.
    """
    departure = result.state.theta - problem.prior_mean
    tried = [_changes_that_fall(padded, problem, result, by) for by in CHANGE_FALLS]
    evidence = np.array(
        [
            log_evidence(*result.equations(replace(problem, prior_sigma=sigma)), departure, sigma)
            for sigma in tried
        ]
    )
    return tried[int(np.argmax(evidence >= evidence.max() - FALL_DOUBT))]


def log_evidence(matrix: Array, right: Array, departure: Array, prior_sigma: Array) -> float:
    """Return the logarithm of the probability of the data with a prior, but for what all priors have in common.

    With the normal equations ``matrix`` (K, K) and ``right`` (K,) of a change of the unknowns, the prior in them, and
    the (K,) ``departure`` of the unknowns from its mean (MacKay 1992, doi:10.1162/neco.1992.4.3.415).
    """
    scaled, scale = equilibrate(matrix)
    logarithm = np.linalg.slogdet(scaled)[1] - 2.0 * np.sum(np.log(scale))
    misfit = np.sum((departure / prior_sigma) ** 2) - right @ solve_scaled(matrix, right)
    return float(-0.5 * (misfit + logarithm) - np.sum(np.log(prior_sigma)))


def _changes_that_fall(
    padded: Functions, problem: Problem, result: BundleResult, by: float
) -> Array:
    """Return the prior sigmas with changes of the lens that fall by a factor with each order; all are as large as they
    seem to be.
    """
    changing = {
        name: slice(own.start + 1, own.start + padded[name].smooth_size)
        for name, own in columns_of(padded).items()
        if name in PADDED and padded[name].smooth_size > 1
    }
    usual_sigma, theta = problem.prior_sigma.copy(), result.state.theta
    for name, own in changing.items():
        if name not in SCAN_GAINS:
            usual_sigma[own] *= by ** np.arange(own.stop - own.start)
    sigma = usual_sigma.copy()
    for _ in range(CHANGE_UPDATES):
        known = replace(problem, prior_sigma=sigma)
        matrix, right = result.equations(known)
        freed = theta + solve_scaled(matrix, right)
        variance = np.diagonal(invert_scaled(matrix))
        for own in changing.values():
            usual = usual_sigma[own]
            square = float(np.sum((freed[own] / usual) ** 2))
            determined = float(np.sum(np.maximum(1.0 - variance[own] / sigma[own] ** 2, 0.0)))
            ratio = np.sqrt((square + USUAL_CHANGES) / (determined + USUAL_CHANGES))
            sigma[own] = usual * np.clip(ratio, *CHANGE_LIMITS)
    return sigma


def pad_covariance(setup: Setup, padded: PaddedAdjustment, field: FittedField | None) -> Array:
    """Return the covariance of the coefficients of the padded functions and of the field.

    ``setup`` has the views as they were observed.
    A coefficient that was left out is not known to be zero: where the data do not determine it, its
    prior gives its uncertainty. Nor do the data say that it is zero: the estimate may also be wrong
    by as much as all coefficients would move if the omitted ones were free. Residuals that are
    smaller than the corners say do not make it smaller; those that lines share make it larger.
    """
    problem, result, factor = padded.problem, padded.result, padded.variance_factor
    state = result.state
    size = len(state.theta) - len(setup.shared)
    if field is None:
        covariance, moved = result.covariance, solve_scaled(*result.equations(problem))
    else:
        system = field_system(setup, problem, result, field.field)
        # This one is scaled to the variance that the residuals show.
        covariance = system.covariance(field.choice.prior) / residual_variance(problem, result)
        theta, freed = solve_field(system, field.choice.prior, field.field)
        change = freed.coefficients - field.field.coefficients
        moved = np.concatenate([theta - state.theta, change.ravel()])
    covariance = (covariance + np.outer(moved, moved) / factor) * max(factor, 1.0)
    count = len(state.theta)
    covariance[:count, :count] += padded.line_covariance
    keep = np.r_[0:size, count : len(moved)]
    return covariance[np.ix_(keep, keep)]


def split_covariance(padded: PaddedAdjustment) -> CovarianceParts:
    """Split the covariance C of the padded functions into what corners, visits and left-out coefficients add.

    The information is that of the corners and that of the priors, C^-1 = N + P, so that C = C N C + C P C: the first
    is what errors of the corners do to the estimate, the second what the priors stand for does. With all corners
    ``1 + t`` times as certain, C is ``((1 + t)^2 N + P)^-1``, whose derivative at t = 0 is -2 C N C. The
    prior of the coefficients that were left out is diagonal. Of equations without a solution, all parts are infinite.
    """
    problem, state = padded.problem, padded.result.state

    def covariance(certainty: float) -> Array:
        scaled = replace(problem, whitening=certainty * problem.whitening)
        return refine(scaled, state, max_iterations=0).covariance

    whole = padded.result.covariance
    less, more = covariance(1.0 - CERTAINTY_STEP), covariance(1.0 + CERTAINTY_STEP)
    if not np.all(np.isfinite([whole, less, more])):
        nothing = np.full((len(state.theta) - len(problem.shared),) * 2, np.inf)
        return CovarianceParts(nothing, nothing)
    corners = (less - more) / (4.0 * CERTAINTY_STEP)
    left = _left_out(padded.chosen.functions, padded.functions)
    omitted = (whole[:, left] / problem.prior_sigma[left] ** 2) @ whole[left]
    factor = max(padded.variance_factor, 1.0)
    own = slice(0, len(state.theta) - len(problem.shared))
    return CovarianceParts(
        (factor * corners + padded.line_covariance)[own, own],
        (factor * (whole - corners - omitted))[own, own],
    )


def _left_out(chosen: Functions, padded: Functions) -> Indices:
    """Indices of the coefficients that the padded functions have and the chosen ones have not."""
    out: list[int] = []
    for name, own in columns_of(padded).items():
        first = own.start
        out += range(first + chosen[name].smooth_size, first + padded[name].smooth_size)
    return np.array(out, dtype=np.intp)


def pad_chosen(padded: PaddedAdjustment, covariance: Array) -> Array:
    """Return a covariance of theta, with the coefficients that were chosen, as one of all coefficients."""
    size = len(padded.result.state.theta) - len(padded.problem.shared)
    chosen = np.setdiff1d(np.arange(size), _left_out(padded.chosen.functions, padded.functions))
    whole = np.zeros((size, size))
    whole[np.ix_(chosen, chosen)] = covariance[: len(chosen), : len(chosen)]
    return whole


def pattern_covariance(setup: Setup, padded: PaddedAdjustment, pattern: GridPattern) -> Array:
    """Return what an irregular grid adds to the covariance of the coefficients.

    It is the difference between the covariances with the pattern unknown and with none. ``setup`` has the views as they
    were observed.
    """
    blank = blank_field(setup)
    system = field_system(setup, padded.problem, padded.result, blank, of_grid=True)
    size = len(padded.result.state.theta) - len(setup.shared)
    free = system.covariance(pattern.choice.prior)[:size, :size]
    none = system.covariance(held_prior(blank, setup.norm_px))[:size, :size]
    return free - none
