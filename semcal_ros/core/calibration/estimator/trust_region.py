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

"""Descent to a minimum of a sum of squares: Levenberg-Marquardt, with any kind of state.

No step that is taken raises the cost; one that would is tried again with a larger damping, which
makes it shorter. How well the quadratic model predicted a step decides by how much the next one is damped.

Triggs et al., Bundle Adjustment - A Modern Synthesis, doi:10.1007/3-540-44480-7_21, section 4; Nielsen, Damping
Parameter in Marquardt's Method, IMM-REP-1999-05, Technical University of Denmark.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import numpy as np

from semcal_ros.core.calibration.estimator.thresholds import (
    DAMPING_LOWERED_MIN,
    DAMPING_MAX,
    DAMPING_MIN,
    FIRST_DAMPING,
    PREDICTED_MAX,
)

S = TypeVar("S")


class DescentStatus(Enum):
    """How a descent ended; the values are the sentences of the calibration file."""

    SMALL_DECREASE = "converged: relative decrease below the tolerance"
    NO_DESCENT = "converged: no step lowers the cost"
    ITERATION_LIMIT = "stopped at the iteration limit"
    SINGULAR = "the views and the priors do not determine the unknowns"


@dataclass(frozen=True)
class Step(Generic[S]):
    """A state that may be taken: its cost, and by how much the quadratic model predicted that it would fall."""

    state: S
    cost: float
    predicted: float


@dataclass(frozen=True)
class Descent(Generic[S]):
    """Where a descent ended.

    Attributes
    ----------
    state, cost
        The last state, and its cost.
    iterations, status
        Number of steps, and why there were no more.
    last_decrease
        Relative decrease of the cost in the last step.
    """

    state: S
    cost: float
    iterations: int
    status: DescentStatus
    last_decrease: float


def descend(
    state: S,
    cost: float,
    linearise: Callable[[S], Callable[[float], Step[S] | None]],
    *,
    max_iterations: int,
    tolerance: float,
    predicted: float | None = None,
    first_damping: float = FIRST_DAMPING,
) -> Descent[S]:
    """Lower the cost step by step.

    Parameters
    ----------
    state, cost
        The start.
    linearise
        From a state to a function from the damping to the step, or to None where rounding leaves no equations that
        can be solved.
    max_iterations, tolerance
        The descent ends at this number of steps, or when a step lowers the cost by less than this part of it and
        predicts little more.
    predicted
        What the last step may predict, in units of the cost; by default in proportion to ``tolerance`` and the cost.
    first_damping
        Of the first step; less than the default is for problems that are nearly linear from the start.
    """
    damping, relative = first_damping, 0.0
    for iteration in range(1, max_iterations + 1):
        solve = linearise(state)
        step, growth = solve(damping), 2.0
        while (step is None or not step.cost <= cost) and damping < DAMPING_MAX:
            damping, growth = growth * damping, 2.0 * growth
            step = solve(damping)
        if step is None:
            return Descent(state, cost, iteration, DescentStatus.SINGULAR, relative)
        if not step.cost <= cost:
            return Descent(state, cost, iteration, DescentStatus.NO_DESCENT, relative)
        decrease, cost, state = cost - step.cost, step.cost, step.state
        damping = max(_damping_change(decrease, step.predicted) * damping, DAMPING_MIN)
        relative = decrease / max(cost, np.finfo(np.float64).tiny)
        small = decrease <= tolerance * cost
        little = PREDICTED_MAX * tolerance * (1.0 + cost) if predicted is None else predicted
        if small and step.predicted <= little:
            return Descent(state, cost, iteration, DescentStatus.SMALL_DECREASE, relative)
    return Descent(state, cost, max_iterations, DescentStatus.ITERATION_LIMIT, relative)


def _damping_change(decrease: float, predicted: float) -> float:
    """Return the factor of the damping after a step that lowered the cost by ``decrease``.

    One that did half of what was predicted leaves it as it is: in a curved valley, a smaller damping would make the
    next step fail, and that would have to be tried twice.
    """
    part = min(decrease / predicted, 1.0) if predicted > 0.0 else 1.0
    return max(DAMPING_LOWERED_MIN, 1.0 - (2.0 * part - 1.0) ** 3)
