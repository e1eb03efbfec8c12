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

"""How many coefficients a function gets."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.calibration.estimator.problem import Priors, Setup, constant_functions
from semcal_ros.core.calibration.select import Summary, select_functions

MAGNIFICATIONS = np.geomspace(100.0, 10000.0, 6)


def _aspect_size(values: np.ndarray, information: float) -> int:
    """Coefficients for an aspect that is known independently at every magnification."""
    setup = Setup((), MAGNIFICATIONS, (512, 512), 0.12, Priors())
    matrices, rights = np.zeros((6, 10, 10)), np.zeros((6, 10))
    matrices[:, 1, 1] = information
    rights[:, 1] = information * values
    chosen = select_functions(
        Summary(matrices, rights), setup, constant_functions(setup, {}), ("aspect",), ()
    )
    return chosen["aspect"][1]


def test_a_constant_gets_one_coefficient_and_a_line_two() -> None:
    assert _aspect_size(np.ones(6), 1e6) == 1
    assert _aspect_size(1.0 + 0.01 * np.log(MAGNIFICATIONS / 1000.0), 1e6) == 2


@pytest.mark.parametrize("outermost", [0, -1])
def test_the_outermost_magnifications_are_never_left_out(outermost: int) -> None:
    """Only the outermost one shows this change: the others could not predict it."""
    values = np.ones(6)
    values[outermost] += 0.003
    assert _aspect_size(values, 1e6) > 1
