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

"""What views that are all tilted alike leave open.

The perspective of a tilted view tells the product of its tilt and of the inverse pivot distance rho, and how much it is
shortened tells its tilt and the aspect ratio together. Where the tilts differ, so do these, and each is told. Where all
views have one tilt, about one axis of the image, nothing tells a tilt of 17 degrees from one of 6 before a scan that is
4 % shorter in one direction. The adjustment then ends somewhere along a curve: at small tilts, since there a difference
between the tilts of two views costs least. Its covariance is that of the tangent, which knows the scale to 0.4 %.

So rho is held at values to either side, and the rest adjusted to each. Each that the views allow counts by what is
known beforehand of the camera alone, the priors of its unknowns: what the views prefer among them is how
little their tilts and heights differ, which is no chance where a holder made them equal, and how well they are followed
by coefficients that were chosen for the camera that was found. The same holds for the cameras of one rho: an aspect
ratio that changes with magnification stands for tilts that do. So the priors choose among these, too, and all that
the views allow weighs no more than one unit of their cost. The second moment about the camera that is so
chosen with the rho of the adjustment is added to the covariance. The estimate stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    Adjustment,
    refine,
    refine_poses,
    variance_factor,
)
from semcal_ros.core.calibration.estimator.residuals import theta_cost, view_costs
from semcal_ros.core.calibration.estimator.thresholds import (
    ALIKE_FORESHORTENING,
    COMMON_TILT_CONFIDENCE,
    COMMON_TILT_SLACK,
    FIT_STEPS_MAX,
    PIVOT_HELD_PART,
    PIVOT_ITERATIONS,
    PIVOT_RATIO,
    PIVOT_SIGMAS,
    PIVOT_STEPS_MAX,
    PIVOT_TOLERANCE,
    RISE_GIVEN_UP,
)
from semcal_ros.core.camera.calibration_model import columns_of


def are_tilted_alike(rotations: Array) -> bool:
    """Whether the tilts of views (V, 3, 3) shorten all of them alike, within :data:`ALIKE_FORESHORTENING`.

    How much two views are shortened differently is seen whatever their common tilt is.
    """
    lean = rotations[:, :2, 2]
    shortened = 0.5 * lean[:, :, None] * lean[:, None, :]
    spread = np.sum(np.var(shortened, axis=0))
    return bool(spread < ALIKE_FORESHORTENING**2)


def _hold_pivot(
    problem: Problem, column: int, value: float, ratio: float, indifference: float
) -> Problem:
    """Return the problem with rho held at a value, and with heights that are larger by ``ratio``.

    What is seen of a height is its product with rho, as of a tilt. What the views prefer by ``indifference`` counts as
    one unit of what is known beforehand.
    """
    means, sigmas = problem.prior_mean.copy(), problem.prior_sigma.copy()
    means[column], sigmas[column] = value, PIVOT_HELD_PART * value
    held = replace(
        problem,
        prior_mean=means,
        prior_sigma=sigmas / np.sqrt(indifference),
        height_sigma_m=ratio * problem.height_sigma_m,
    )
    effects = problem.effects
    if effects is None:
        return held
    return replace(held, effects=replace(effects, height_sigma_m=ratio * effects.height_sigma_m))


@dataclass(frozen=True)
class _Camera:
    """A camera that the views allow: its rho, the unknowns with it, and what these cost by their priors."""

    rho: float
    theta: Array
    cost: float


def _walk(adjustment: Adjustment, column: int) -> list[_Camera]:
    """Return the cameras along the curve, that with the rho of the adjustment first; ``column`` is that of rho."""
    problem, result = adjustment.problem, adjustment.result
    rho = float(result.state.theta[column])
    factor = max(variance_factor(problem, result), 1.0)
    chance = 0.5 * factor * float(chdtri(3 * len(problem.group), 1.0 - COMMON_TILT_CONFIDENCE))
    limit = COMMON_TILT_SLACK * chance
    least = float(np.sum(view_costs(problem, result.state)))
    tolerance = PIVOT_TOLERANCE / result.cost

    def refit(near: State, value: float) -> tuple[State, float]:
        held = _hold_pivot(problem, column, value, rho / value, limit)
        state = refine(
            held,
            refine_poses(held, near, max_iterations=FIT_STEPS_MAX),
            max_iterations=PIVOT_ITERATIONS,
            tolerance=tolerance,
            predicted=tolerance,
        ).state
        return state, float(np.sum(view_costs(held, state))) - least

    begin, _ = refit(result.state, rho)
    allowed = [_Camera(rho, begin.theta, theta_cost(problem, begin.theta))]
    for ratio in (1.0 / PIVOT_RATIO, PIVOT_RATIO):
        state, value, slope = begin, rho, np.zeros_like(begin.theta)
        unlikely = 0
        for _ in range(PIVOT_STEPS_MAX):
            last, value = (state.theta, value**-2.0), ratio * value
            # What a tilt shortens goes with its square, and that with the inverse square of rho.
            theta = last[0] + slope * (value**-2.0 - last[1])
            theta[column] = value
            state, rise = refit(replace(state, theta=theta), value)
            cost = theta_cost(problem, state.theta)
            # One that is not at its optimum yet may look unlikely.
            least_cost = min(camera.cost for camera in allowed)
            unlikely = unlikely + 1 if cost > least_cost + 0.5 * PIVOT_SIGMAS**2 else 0
            if rise > RISE_GIVEN_UP * limit or unlikely > 1:
                break
            slope = (state.theta - last[0]) / (value**-2.0 - last[1])
            # Beyond one that the views do not allow, others may be allowed.
            if rise <= limit:
                allowed.append(_Camera(value, state.theta, cost))
    return allowed


def common_tilt_covariance(adjustment: Adjustment) -> Array:
    """Return the (K, K) covariance of theta that is added for a tilt that all views share.

    It is zero where their tilts differ, or where one is known from the stage.
    """
    problem, state = adjustment.problem, adjustment.result.state
    column = columns_of(adjustment.functions)["rho"].start
    known = problem.attitudes is not None or not are_tilted_alike(state.rotations)
    if known or state.theta[column] <= 0.0:
        return np.zeros_like(adjustment.result.covariance)
    cameras = _walk(adjustment, column)
    # The values of rho are equally far apart in the logarithm, and the prior is one of rho.
    likely = np.array([np.log(camera.rho) - camera.cost for camera in cameras])
    weight = np.exp(likely - likely.max())
    apart = np.stack([camera.theta for camera in cameras]) - cameras[0].theta
    return np.asarray(np.einsum("k,ka,kb->ab", weight / weight.sum(), apart, apart))
