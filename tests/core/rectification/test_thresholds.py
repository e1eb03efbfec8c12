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

"""The numbers of the maps: those that are said to follow from something do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from semcal_ros.core.camera.thresholds import SETTLING_TIMES
from semcal_ros.core.rectification import thresholds as t

WIDTH_PX = 512.0


@pytest.mark.parametrize(
    ("value", "stated", "within"),
    [
        (t.POSITION_CONVERGED_PX, t.MAP_ERROR_MAX_PX / 100.0, 1e-12),
        (t.MOVING_ERROR_MAX_PX, 0.1 / 32.0, 2e-4),
        (t.DEFLECTION_ERROR_MAX_PX, t.MAP_ERROR_MAX_PX / 2.0, 1e-12),
        # Linear interpolation of exp(-x / T), whose curvature is 1 / T^2, with the fastest T in px.
        (t.SCAN_STEP_PX**2 / 8.0 / (0.5 * WIDTH_PX * min(SETTLING_TIMES)) ** 2, 2e-4, 3e-5),
        # The slowest decay at the end of what is tested closely.
        (np.exp(-2.0 * t.SETTLED_AFTER / max(SETTLING_TIMES)), 1.0 / 8.0, 0.01),
        (np.hypot(1.0, t.PHASE_CONVERGED), 1.005, 1e-3),
        (1.0 / np.sqrt(2.0 * (t.LINE_GROUPS - 1)), 1.0 / 6.0, 0.02),
        (2.0 * stats.t.sf(t.PHASE_SIGMAS, t.LINE_GROUPS - 1), 1.6e-4, 1e-5),
        (1.0 / (1.0 - t.PHASE_MEMORY), 8.0, 1e-12),
        (t.SIDE_MAX_PX, np.iinfo(np.int16).max - 1, 0.0),
        (t.EDGE_PX, t.MAP_ERROR_MAX_PX, 0.0),
    ],
)
def test_figures_follow_from_what_is_stated(value: float, stated: float, within: float) -> None:
    assert value == pytest.approx(stated, abs=within)


def test_most_tests_of_a_map_are_far_from_its_nodes() -> None:
    """Nodes are the cosines of whole steps pi / degree; near one, a map cannot be wrong."""
    tests = (np.arange(t.TESTS_PER_AXIS) + t.TEST_OFFSET) / t.TESTS_PER_AXIS
    for degree in t.MAP_DEGREES:
        steps = degree * tests
        assert np.count_nonzero(np.abs(steps - np.rint(steps)) > 0.1) >= 6, degree
    assert t.FIELD_CONVERGED_PX < t.MAP_ERROR_MAX_PX / 2.0
