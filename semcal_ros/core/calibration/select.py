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

"""Which terms and coefficients the data ask for, as the corners come to be believed.

The number of coefficients of every function is chosen by leaving out one magnification at a time
(:mod:`~semcal_ros.core.calibration.model_selection`). The corners are believed as far as the model explains them, step
by step, so that a strong distortion is not explained by tilts. A residual field comes last, for what all terms leave.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.adjustment import (
    SMOOTH,
    Adjustment,
    FittedField,
    GridPattern,
    refit_functions,
)
from semcal_ros.core.calibration.estimator.blocks import State
from semcal_ros.core.calibration.estimator.bundle_adjustment import refine
from semcal_ros.core.calibration.estimator.poses import adjust_with_other_poses, refine_coarsely
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.estimator.problem import (
    Functions,
    build_problem,
    stack_theta,
    with_coefficients,
)
from semcal_ros.core.calibration.estimator.residual_field_fit import (
    blank_field,
    choose_field,
    field_system,
    solve_field,
    undo_field,
)
from semcal_ros.core.calibration.estimator.variance_components import (
    VarianceComponents,
    update_components,
)
from semcal_ros.core.calibration.model_selection import Summary, select_functions
from semcal_ros.core.calibration.start import Start, tempered
from semcal_ros.core.calibration.views import estimate_excess_sigma_px
from semcal_ros.core.camera.calibration_model import TERM_NAMES
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.errors import UnusableCalibrationError

__all__ = ["Selection", "excess_px", "select", "select_and_adjust"]

# Rounds of choosing the numbers of coefficients. A choice that alternates never converges; the
# calibration then carries a warning.
_MAX_ROUNDS = 5
# Steps in which corners come to be believed, and the part of the excess noise beyond which there is no further one.
_MOST_STEPS, _LEAST_STEP = 3, 0.7
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


def excess_px(setup: Setup, adjustment: Adjustment) -> float:
    """Return the scatter of the corners of an adjustment beyond their own sigmas."""
    residuals = adjustment.result.residuals_px
    return estimate_excess_sigma_px(setup.views, residuals, 6 * len(setup.views))


def _anneal(setup: Setup, noisy: Setup, adjustment: Adjustment) -> tuple[Setup, Adjustment]:
    """Believe the corners as far as the model explains them, step by step; return the last setup and adjustment."""
    level = max(view.excess_px for view in noisy.views)
    for _ in range(_MOST_STEPS):
        excess = min(excess_px(setup, adjustment), level)
        # The first step brings in what the stage says.
        if np.isfinite(noisy.tempering) and (level == 0.0 or excess > _LEAST_STEP * level):
            break
        level, noisy = excess, tempered(setup, excess)
        spread = update_components(noisy, adjustment.problem, adjustment.result)
        adjustment = select_and_adjust(noisy, adjustment.functions, adjustment.result.state, spread)
    return noisy, adjustment


def select_and_adjust(
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
    state = replace(state, theta=stack_theta(setup, functions, state))
    result, _ = adjust_with_other_poses(setup, functions, spread, problem, state)
    converged, rounds = False, 0
    terms = () if setup.priors.is_wide or not choose_terms else TERM_NAMES
    while rounds < _MAX_ROUNDS and not converged:
        rounds += 1
        every = build_problem(setup, functions, setup.views, spread, candidates=terms)
        summary = Summary.of(every, refine(every, result.state, max_iterations=0))
        chosen = select_functions(summary, setup, functions, SMOOTH, terms, sizes)
        if chosen == sizes:
            result, count = adjust_with_other_poses(setup, functions, spread, problem, result.state)
            converged = count == 0
            continue
        sizes = chosen
        functions = refit_functions(with_coefficients(functions, result.state.theta), chosen)
        spread = update_components(setup, problem, result)
        problem = build_problem(setup, functions, setup.views, spread)
        state = replace(result.state, theta=stack_theta(setup, functions, result.state))
        result = refine_coarsely(problem, state)
    functions = with_coefficients(functions, result.state.theta)
    return Adjustment(functions, problem, result, spread, rounds, converged)


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
            try:
                choice = choose_field(setup, system, blank)
            except UnusableCalibrationError:
                if always:
                    raise
                # What cannot be predicted from the rest does not show that there is a field.
                return start, None, None
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
    return {name: (own[name].kind, own[name].smooth_size) for name in SMOOTH}


def _readjust(setup: Setup, adjustment: Adjustment, theta: Array, *, choosing: bool) -> Adjustment:
    """Adjust to other views from other coefficients; ``choosing`` selects their number again."""
    functions = with_coefficients(adjustment.functions, theta)
    spread = update_components(setup, adjustment.problem, adjustment.result)
    state = replace(adjustment.result.state, theta=theta)
    if choosing:
        sizes = _current_sizes(adjustment)
        return select_and_adjust(setup, functions, state, spread, sizes, choose_terms=False)
    problem = build_problem(setup, functions, setup.views, spread)
    result = refine_coarsely(problem, state)
    functions = with_coefficients(functions, result.state.theta)
    return replace(adjustment, functions=functions, problem=problem, result=result, spread=spread)


@dataclass(frozen=True)
class Selection:
    """What was chosen.

    Attributes
    ----------
    setup
        The views as they were observed.
    adjustment
        The functions with their numbers of coefficients.
    field, pattern
        The residual field, and what is irregular about the grid, or None.
    excess_px
        1-sigma per axis, px, by which all corners scatter beyond their own.
    """

    setup: Setup
    adjustment: Adjustment
    field: FittedField | None
    pattern: GridPattern | None
    excess_px: float


def select(started: Start, residual: str) -> Selection:
    """Choose terms, numbers of coefficients, and whether there is a residual field.

    Parameters
    ----------
    started
        The first state.
    residual
        Whether there may be a residual field: ``"on"``, ``"off"``, or ``"auto"``, where cross-validation decides.
    """
    setup, noisy = started.setup, started.tempered
    adjustment = select_and_adjust(noisy, started.functions, started.state, started.spread)
    noisy, adjustment = _anneal(setup, noisy, adjustment)
    field, pattern = None, None
    if residual != "off":
        adjustment, field, pattern = _add_field(noisy, adjustment, residual == "on")
    return Selection(setup, adjustment, field, pattern, excess_px(setup, adjustment))
