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

"""The numbers of a ladder: those that are said to follow from something do."""

from __future__ import annotations

import math

import pytest
from scipy import stats

from semcal_ros.core.ladder import thresholds as t


@pytest.mark.parametrize(
    ("chance", "one_in"),
    [
        (2.0 * 2.0 * stats.norm.sf(t.BLOCK_SIGMAS), 870_000),
        (12.0 * stats.chi2.sf(t.JUMP_GAIN, 1), 11_000),
        (math.exp(-0.5 * t.EVIDENCE_SURE), 3.3e6),
        (2.0 * stats.norm.sf(t.VISIT_SIGMAS), 500e6),
        (stats.chi2.sf(24.0 * t.VARIANCE_FACTOR_MAX, 24), 7e9),
        (2.0 * stats.norm.sf(t.CREEP_SIGMAS), 16_000),
    ],
)
def test_rates_are_those_of_the_distributions(chance: float, one_in: float) -> None:
    assert 1.0 / chance == pytest.approx(one_in, rel=0.12)  # one or two digits are stated


@pytest.mark.parametrize(
    ("value", "stated", "within"),
    [
        (t.STEP**-2, 0.44, 0.005),
        (t.STEP_MAX**-2, 0.39, 0.005),
        (384.0 * math.sqrt(0.5) * math.radians(1.0 / 3.0), 1.6, 0.05),
        (t.BLOCKS_MIN - (t.FINE_DEGREE + 1) * (t.FINE_DEGREE + 2) // 2, 9, 0),
        (t.GAIN_MIN * t.GAIN_MAX, 1.0, 1e-12),
        (2.0**-16, 1.5e-5, 5e-7),
        (math.degrees(math.acos(t.ONE_ROTATION_COS)), 1.0, 0.01),
        (math.sqrt(2.0) * t.POINTED_SIGMA_PX / t.LENGTH_MIN_PX, 0.035, 5e-4),
        ((0.1 * 0.1) ** (t.TIME_STEPS - 1), 1e-4, 1e-8),
        (28 * t.CREEP_SIGMA, 0.03, 0.003),
        (math.degrees(t.STEEPEST_RAD), 5.0, 0.01),
    ],
)
def test_values_are_those_of_the_formulas(value: float, stated: float, within: float) -> None:
    assert value == pytest.approx(stated, abs=within)
