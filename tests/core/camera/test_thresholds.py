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

"""The numbers of the camera model: those that are said to follow from something do."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.legendre import leg2poly
from scipy import stats

from semcal_ros.core.camera import thresholds as t

ROUNDING = 0.5 * np.finfo(np.float64).eps
FIELD_PX = 512.0


@pytest.mark.parametrize(
    ("value", "stated", "within"),
    [
        (t.ROTATION_TOLERANCE_RAD, np.radians(0.5), 5e-5),
        (t.SPECIMEN_TILT_SIGMA_RAD, np.radians(0.5), 5e-5),
        (t.LENS_TOLERANCE / ROUNDING, 90.0, 1.0),
        (0.5 / stats.norm.sf(t.CONTRADICTION_SIGMAS), 370.0, 1.0),
        # A tenth of the field in height: the change of the scale, and that at the edge in px.
        (0.1 * FIELD_PX / t.FOCAL_LENGTH_MAX_PX, 5e-6, 2e-7),
        (0.1 * FIELD_PX / t.FOCAL_LENGTH_MAX_PX * 0.5 * FIELD_PX, 1e-3, 4e-4),
        (t.PLUMB_BOB_POINTS**2 / 9, 11.0, 0.2),
        (1.0 - 2.0 * stats.norm.sf(t.COVERAGE_FACTOR), 0.954, 1e-3),
        ((t.JUDGED_MAGNIFICATIONS - 1) / np.log2(100.0), 4.0, 0.5),
    ],
)
def test_figures_follow_from_what_is_stated(value: float, stated: float, within: float) -> None:
    assert value == pytest.approx(stated, abs=within)


def test_the_last_step_of_newton_leaves_less_than_rounding() -> None:
    assert t.FIELD_TOLERANCE**2 < ROUNDING


def test_the_polynomials_are_those_of_legendre() -> None:
    for degree, row in enumerate(t.LEGENDRE_POWERS, 2):
        assert row[: degree + 1] == pytest.approx(leg2poly([0.0] * degree + [1.0]), abs=1e-14)
        assert not row[degree + 1 :].any()


def test_time_constants_are_columns_of_512_a_factor_of_two_apart() -> None:
    columns = 256.0 * np.array(t.SETTLING_TIMES)
    assert columns == pytest.approx([3.0, 6.0, 12.0, 24.0, 48.0], abs=0.02)
