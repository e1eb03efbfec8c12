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

"""The exact adjustment of what was selected, and what is known after it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, solve_scaled
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    SMOOTH_AT_LAST,
    Adjustment,
    refine,
)
from semcal_ros.core.calibration.estimator.common_tilt import common_tilt_covariance
from semcal_ros.core.calibration.estimator.correlated_errors import estimate_shared_excess_px
from semcal_ros.core.calibration.estimator.poses import (
    right_way_up,
    try_other_poses,
)
from semcal_ros.core.calibration.estimator.posterior import (
    CovarianceParts,
    PaddedAdjustment,
    pad,
    pad_chosen,
    pad_covariance,
    pattern_covariance,
    split_covariance,
)
from semcal_ros.core.calibration.estimator.problem import (
    Functions,
    Setup,
    VarianceComponents,
    build_problem,
)
from semcal_ros.core.calibration.estimator.residual_field_fit import (
    FittedField,
    GridPattern,
    field_system,
    solve_field,
    undo_field,
)
from semcal_ros.core.calibration.estimator.thresholds import (
    DAMPING_MIN,
    NAMED_MAX,
    USUAL_LATTICES,
)
from semcal_ros.core.calibration.estimator.variance_components import (
    accelerate_components,
    largest_change,
    limit_components,
    update_components,
)
from semcal_ros.core.calibration.select import Selection, add_late_terms, select_and_adjust
from semcal_ros.core.calibration.start import with_excess
from semcal_ros.core.calibration.thresholds import (
    EXACT_STEPS_MAX,
    EXACT_TOLERANCE,
    SPREAD_CHANGE,
    SPREAD_UPDATES_MAX,
    UPDATE_PREDICTED,
    UPDATE_TOLERANCE,
)
from semcal_ros.core.camera.calibration_model import with_coefficients
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.errors import UnusableCalibrationError


@dataclass(frozen=True)
class JointFit:
    """Result of :func:`fit_joint`.

    Attributes
    ----------
    adjustment
        The adjustment with the chosen number of coefficients.
    padded
        The same with a few more coefficients, which are zero.
    covariance
        Covariance of the coefficients of the padded functions, followed by that of the coefficients of the field.
    field
        The residual field, or None.
    pattern
        What is irregular about the grid, or None.
    excess_px
        1-sigma per axis, px, by which the corners are taken to be more uncertain than by their own: they scatter by it,
        or neighbouring ones are off alike.
    shared_px
        What the second of these requires, whether it is counted or not; 0 where neighbouring corners share no error.
    parts
        What the covariance of the functions consists of.
    """

    adjustment: Adjustment
    padded: PaddedAdjustment
    covariance: Array
    field: FittedField | None
    pattern: GridPattern | None
    excess_px: float
    shared_px: float
    parts: CovarianceParts


def _refuse_lost_corners(setup: Setup, adjustment: Adjustment) -> None:
    """Refuse an adjustment whose camera does not show some corners at all, and name their views."""
    lost = adjustment.result.lost
    if not np.any(lost):
        return
    views = sorted({int(v) for v in adjustment.problem.view_of_point[lost]})
    more = f" and {len(views) - NAMED_MAX} more" if len(views) > NAMED_MAX else ""
    raise UnusableCalibrationError(
        "an adjustment whose camera cannot show corners of "
        f"{', '.join(setup.views[v].name for v in views[:NAMED_MAX])}{more}",
        expected="views of one flat grid, by one microscope, at the magnifications that are stated",
        do="leave these views out, or check magnifications, --display-width and --squares",
    )


def _adjust_exactly(setup: Setup, adjustment: Adjustment, *, usual_spreads: bool) -> Adjustment:
    """Adjust exactly with the chosen functions, after trying both signs of every tilt.

    The variance components are updated until they no longer change. With ``usual_spreads`` they are at most the usual
    ones: what corners share would pass for drift and stretched lattices.
    """
    functions = adjustment.functions
    # From what is usual: spreads that were wide while the model was wrong would hold it there.
    spread = update_components(setup, adjustment.problem, adjustment.result)
    spread = limit_components(setup, spread)
    state, _ = try_other_poses(setup, functions, spread, adjustment.result.state)
    updates: list[tuple[VarianceComponents, VarianceComponents]] = []
    while len(updates) < SPREAD_UPDATES_MAX:
        problem = build_problem(setup, functions, setup.views, spread)
        result = refine(
            problem,
            state,
            tolerance=UPDATE_TOLERANCE,
            predicted=UPDATE_PREDICTED,
        )
        result = right_way_up(setup, functions, problem, result)
        state = result.state
        after = update_components(setup, problem, result, usual_lattices=USUAL_LATTICES)
        after = limit_components(setup, after) if usual_spreads else after
        updates.append((spread, after))
        if largest_change(*updates[-1]) < SPREAD_CHANGE:
            break
        spread = accelerate_components(updates)
    problem = build_problem(setup, functions, setup.views, spread)
    result = refine(
        problem,
        state,
        tolerance=EXACT_TOLERANCE,
        predicted=EXACT_TOLERANCE,
        first_damping=DAMPING_MIN,
        max_iterations=EXACT_STEPS_MAX,
    )
    functions = with_coefficients(functions, result.state.theta)
    return replace(adjustment, functions=functions, problem=problem, result=result, spread=spread)


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
    step = solve_scaled(*result.leave_out(index).equations(fit.adjustment.problem))
    return with_coefficients(functions, result.state.theta + step), None


def solve(
    selection: Selection, on_stage: Callable[[str, float], None], *, count_shared: bool = True
) -> JointFit:
    """Adjust exactly, and compute the covariance; ``on_stage`` as for ``calibrate_views``.

    Without ``count_shared`` corners that are off alike count as independent ones: a view that is wrong, or a tilt of
    the stage, bends what others leave of it as well, and shows as wrong only then.

    Raises
    ------
    UnusableCalibrationError
        If the adjustment loses corners.
    """
    adjustment, field = selection.adjustment, selection.field
    on_stage("final adjustment", 0.75)
    shared_px = estimate_shared_excess_px(selection.setup, adjustment.problem, adjustment.result)
    excess_px = max(selection.excess_px, shared_px if count_shared else 0.0)
    final = setup = with_excess(selection.setup, excess_px)
    if field is not None:
        final = undo_field(setup, field.field)
    # The corners are believed to their own noise now.
    spread = update_components(final, adjustment.problem, adjustment.result)
    adjustment = select_and_adjust(
        final,
        adjustment.functions,
        adjustment.result.state,
        spread,
        always=SMOOTH_AT_LAST,
        # A field takes the place of what is not there.
        choose_terms=field is None,
    )
    if field is None:
        adjustment = add_late_terms(final, adjustment, always=SMOOTH_AT_LAST)
    uncounted = shared_px > 0.0 and not count_shared
    adjustment = _adjust_exactly(final, adjustment, usual_spreads=uncounted)
    _refuse_lost_corners(final, adjustment)
    if field is not None:
        system = field_system(setup, adjustment.problem, adjustment.result, field.field)
        field = replace(field, system=system)
    on_stage("uncertainty", 0.9)
    padded = pad(final, adjustment)
    covariance = pad_covariance(setup, padded, field)
    if selection.pattern is not None:
        covariance = covariance + pattern_covariance(setup, padded, selection.pattern)
    return JointFit(
        adjustment,
        padded,
        covariance,
        field,
        selection.pattern,
        excess_px,
        shared_px,
        split_covariance(padded),
    )


def add_common_tilt(fit: JointFit) -> JointFit:
    """Return the fit with the uncertainty of a tilt that all views share.

    It takes as long as some adjustments, so that only the last fit of a calibration gets it.
    """
    common = pad_chosen(fit.padded, common_tilt_covariance(fit.adjustment))
    covariance = fit.covariance.copy()
    covariance[: len(common), : len(common)] += common
    parts = replace(fit.parts, visits=fit.parts.visits + common)
    return replace(fit, covariance=covariance, parts=parts)
