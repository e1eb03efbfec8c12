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

"""Robust losses: a weight is the slope of its loss over the residual, and Tukey's constant keeps 95 % efficiency."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from semcal_ros.core.arrays import Array
from semcal_ros.core.robust_losses import (
    TUKEY_CONSTANT,
    cauchy_loss,
    cauchy_weight,
    huber_loss,
    huber_weight,
    tukey_loss,
    tukey_weight,
)

PAIRS: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "huber": (lambda r: huber_loss(r, 1.5), lambda r: huber_weight(r, 1.5)),
    "cauchy": (lambda r: cauchy_loss(r**2, 2.5), lambda r: cauchy_weight(r**2, 2.5)),
    "tukey": (tukey_loss, tukey_weight),
}


@pytest.mark.parametrize("name", PAIRS)
def test_the_weight_is_the_slope_of_the_loss_over_the_residual(name: str) -> None:
    loss, weight = PAIRS[name]
    residual = np.linspace(0.05, 8.0, 160)
    step = 1e-6
    slope = (loss(residual + step) - loss(residual - step)) / (2.0 * step)
    # Central differences of a second derivative of 1: 1e-6, but at the kink of Huber's.
    assert slope / residual == pytest.approx(weight(residual), abs=1e-5)


@pytest.mark.parametrize("name", PAIRS)
def test_small_residuals_count_by_half_their_square(name: str) -> None:
    loss, weight = PAIRS[name]
    small = np.array([1e-3])
    assert loss(small) == pytest.approx(0.5 * small**2, rel=1e-5)
    assert weight(small) == pytest.approx(1.0, rel=1e-5)


def test_what_is_far_off_counts_for_nothing_with_tukey() -> None:
    far = np.array([-1e9, -1.001 * TUKEY_CONSTANT, 1.001 * TUKEY_CONSTANT])
    assert np.all(tukey_weight(far) == 0.0)
    assert tukey_loss(far) == pytest.approx(TUKEY_CONSTANT**2 / 6.0)
    # Of twice the scale, it is within.
    assert np.all(tukey_weight(far[1:], 2.0) > 0.5)


def test_tukeys_constant_costs_a_twentieth_of_the_information_of_normal_noise() -> None:
    """The efficiency of an M-estimator of location is ``E[psi']^2 / E[psi^2]`` (Huber 1981, equation 3.2.13)."""

    def score(x: float) -> float:
        return float(x * tukey_weight(np.array(x)))

    def slope(x: float) -> float:
        return (score(x + 1e-5) - score(x - 1e-5)) / 2e-5

    reach = (-TUKEY_CONSTANT, TUKEY_CONSTANT)
    mean_slope = quad(lambda x: slope(x) * norm.pdf(x), *reach)[0]
    mean_square = quad(lambda x: score(x) ** 2 * norm.pdf(x), *reach)[0]
    assert mean_slope**2 / mean_square == pytest.approx(0.95, abs=0.001)
