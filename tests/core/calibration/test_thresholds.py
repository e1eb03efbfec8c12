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

"""The numbers of a calibration: those that are said to follow from something do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from semcal_ros.core.calibration import thresholds as t
from semcal_ros.core.calibration.estimator import thresholds as estimator
from semcal_ros.core.calibration.judgement import thresholds as judgement
from semcal_ros.core.calibration.judgement.check import CHANGES


@pytest.mark.parametrize(
    ("chance", "one_in"),
    [
        (stats.chi2.sf(estimator.HUBER_SIGMAS**2, 2), 90),
        (stats.norm.sf(estimator.FIELD_GAIN_SIGMAS), 160),
        (judgement.JUMP_FALSE_ALARMS, 100),
        (2.0 * stats.norm.sf(judgement.TILT_SIGMAS), 1.7e6),
        (2.0 * stats.norm.sf(judgement.SURPRISING_SIGMAS), 16_000),
        (10.0 * 2.0 * stats.norm.sf(judgement.DIFFERENT_SIGMAS), 100),
        (judgement.OUTLIER_FALSE_ALARMS, 100),
        (2.0 * stats.norm.sf(judgement.WRONG_QUANTILE_SIGMAS), 1.0 / judgement.WRONG_PART_MAX),
        (2.0 * stats.norm.sf((t.MISFIT_MAX - 1.0) / judgement.MISFIT_SIGMA), 370),
        (stats.chi2.sf(2.0 * t.TERM_GAIN, 1), 640),
        (stats.chi2.sf(estimator.JITTER_GAIN, 1), 370),
        (judgement.HYSTERESIS_FALSE_ALARMS, 3000),
    ],
)
def test_rates_are_those_of_the_distributions(chance: float, one_in: float) -> None:
    assert 1.0 / chance == pytest.approx(one_in, rel=0.12)  # one or two digits are stated


@pytest.mark.parametrize(
    ("value", "stated", "within"),
    [
        (1.0 - math.cos(estimator.FLAT_RAD), 0.004, 2e-4),
        (1.0 / math.sqrt(2.0 * estimator.SPREAD_COUNT_MIN), 0.35, 0.005),
        (1.0 / math.sqrt(2.0 * judgement.USUAL_VIEWS), 0.35, 0.005),
        (1.0 / math.sqrt(2.0 * 100.0), 0.07, 0.001),
        (math.sqrt(2.0 * estimator.NOTHING_DECREASE), 0.0045, 5e-5),
        (estimator.ALONG_LINE_MIN, math.cos(math.radians(45.0)) ** 2, 1e-12),
        (estimator.CERTAINTY_STEP**2, 4e-4, 1e-12),
        (math.cos(t.UNTILTED_RAD), 0.990, 5e-4),
        (0.05 / t.FIELD_SETTLED_PX, 50.0, 1e-9),
        (0.5 * estimator.HUBER_SIGMAS**2, 4.5, 0.0),
        (
            1.0
            / math.sqrt(judgement.SIGN_FLIPS * judgement.CHECK_FALSE_ALARMS / (len(CHANGES) + 1)),
            0.17,
            0.005,
        ),
        (math.radians(3.0) ** 2 / math.radians(30.0) ** 2, judgement.ONE_DIRECTION, 1e-9),
        ((1.0 - 4.0 * stats.norm.sf(0.5 / t.BLURRED_PART)) ** 2, 0.83, 0.005),
        (math.cos(math.radians(70.0)), 0.34, 0.005),
        (math.cos(t.TILT_MAX_RAD), 0.5, 1e-9),
        (t.VISIT_ROTATION_RAD / (2.0 * math.pi), 1.0 - (math.sqrt(5.0) - 1.0) / 2.0, 1e-12),
        (1.0 - math.cos(t.LINES_TILT_MAX_RAD), 1.5e-4, 5e-6),
        (stats.norm.cdf(1.0), t.ONE_SIGMA, 1e-12),
        (5.0 / 108.0, judgement.EMPTY_PART, 0.005),
        (stats.norm.ppf(0.5 + 0.5 * judgement.VIEW_PART), judgement.VIEW_PART_SIGMAS, 1e-5),
        (np.ptp(judgement.PLANNED_DIRECTIONS_RAD), 2.0 / 3.0 * math.pi, 1e-12),
    ],
)
def test_values_are_those_of_the_formulas(value: float, stated: float, within: float) -> None:
    assert value == pytest.approx(stated, abs=max(within, 1e-12))
