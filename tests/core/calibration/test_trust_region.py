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

"""A descent ends at the minimum, also along what is hardly determined."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.thresholds import DAMPING_MIN
from semcal_ros.core.calibration.estimator.trust_region import (
    Descent,
    DescentStatus,
    Step,
    descend,
)

# Two unknowns that are nearly the same in 1000 half chi-squares: their difference is determined to 1.
CURVATURE = 1e6 * np.array([[1.0, 1.0], [1.0, 1.0]]) + np.array([[0.25, -0.25], [-0.25, 0.25]])


def cost(x: Array) -> float:
    return 1000.0 + 0.5 * float(x @ CURVATURE @ x)


def linearise(x: Array) -> Callable[[float], Step[Array] | None]:
    def solve(damping: float) -> Step[Array]:
        damped = CURVATURE + damping * np.diag(np.diag(CURVATURE))
        new = x - np.linalg.solve(damped, CURVATURE @ x)
        return Step(new, cost(new), cost(x) - cost(new))

    return solve


def run(**given: float) -> Descent[Array]:
    start = np.array([0.05, -0.05])
    return descend(start, cost(start), linearise, max_iterations=50, tolerance=1e-6, **given)


def test_a_damped_first_step_may_pass_for_the_last() -> None:
    found = run()
    assert found.status is DescentStatus.SMALL_DECREASE and found.iterations == 1
    assert abs(found.state[0] - found.state[1]) > 0.09


def test_without_damping_and_with_a_limit_of_what_is_predicted_the_end_is_the_minimum() -> None:
    # 1e-10 half chi-squares are 1e-5 sigma.
    found = run(predicted=1e-10, first_damping=DAMPING_MIN)
    assert found.status is DescentStatus.SMALL_DECREASE
    np.testing.assert_allclose(found.state, 0.0, atol=1e-5)


def test_along_a_curved_valley_hardly_a_step_is_tried_twice() -> None:
    """In Rosenbrock's valley, where a damping that goes by factors of ten tries 231 steps and takes 119 of them."""
    tried: list[float] = []

    def residuals(x: Array) -> Array:
        return np.array([100.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    def cost_of(x: Array) -> float:
        return 0.5 * float(residuals(x) @ residuals(x))

    def linearise_valley(x: Array) -> Callable[[float], Step[Array] | None]:
        jacobian = np.array([[-200.0 * x[0], 100.0], [-1.0, 0.0]])
        curvature, gradient = jacobian.T @ jacobian, jacobian.T @ residuals(x)

        def solve(damping: float) -> Step[Array]:
            tried.append(damping)
            damped = curvature + damping * np.diag(np.diag(curvature))
            change = -np.linalg.solve(damped, gradient)
            predicted = -float(gradient @ change + 0.5 * change @ curvature @ change)
            return Step(x + change, cost_of(x + change), predicted)

        return solve

    start = np.array([-1.2, 1.0])
    found = descend(
        start, cost_of(start), linearise_valley, max_iterations=200, tolerance=1e-9, predicted=1e-12
    )
    np.testing.assert_allclose(found.state, 1.0, atol=1e-6)
    assert len(tried) < 231 / 2
    assert len(tried) < 1.6 * found.iterations
