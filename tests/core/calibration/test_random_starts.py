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

"""Where a fit ends does not depend on where it starts.

`benchmarks.calibration.starts` tries the reference recordings.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.calibration.starts import MOST_ABOVE, ends_of, largest_sigmas
from semcal_ros.core.calibration.estimator.poses import mirror
from semcal_ros.core.calibration.estimator.problem import build_problem
from semcal_ros.core.calibration.estimator.residuals import corner_residuals, view_residuals
from semcal_ros.core.calibration.pipeline import prepare
from semcal_ros.core.calibration.start import start
from semcal_ros.core.calibration.views import GridView
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import SimulatedStage, stage_views

JSM = preset("jsm820")
MAGNIFICATIONS = (200.0, 400.0, 800.0, 1600.0, 3200.0)
STARTS = 4


def _views(readings: bool) -> list[GridView]:
    stage = SimulatedStage(
        (0.0, 0.35, 0.6),
        axis_rad=0.02,
        height_sigma_m=1e-5,
        tilt_error_rad=0.003,
        reading_sigma_rad=0.002,
    )
    return stage_views(
        JSM.camera_at, MAGNIFICATIONS, stage, noise_px=0.05, seed=1, readings=readings
    )


def test_a_mirrored_state_agrees_with_the_stage_by_as_much() -> None:
    setup = prepare(_views(True), image_size=JSM.image_size, display_width_m=JSM.display_width_m)
    first = start(setup)
    problem = build_problem(setup, first.functions, setup.views, first.spread)
    other = mirror(first.functions, problem, first.state)
    np.testing.assert_allclose(
        corner_residuals(problem, other), corner_residuals(problem, first.state), atol=1e-9
    )
    own, turned = (view_residuals(problem, state) for state in (first.state, other))
    for name in ("height", "attitude"):
        np.testing.assert_allclose(
            np.sum(turned[name].values ** 2, axis=1),
            np.sum(own[name].values ** 2, axis=1),
            rtol=1e-6,
            atol=1e-9,
        )
    # It is the axis that lies the other way round, so that what is known of it tells the two apart.
    axis = problem.shared_values(other.theta, ["stage_axis"])[0]
    assert abs(axis) > 3.0


@pytest.mark.long
@pytest.mark.parametrize("readings", [False, True])
def test_random_starts_end_at_the_same_cost(readings: bool) -> None:
    ends = ends_of(_views(readings), JSM.image_size, JSM.display_width_m, STARTS)
    above = np.array([end.cost for end in ends]) - min(end.cost for end in ends)
    # Choices of coefficients that differ by less are equally good; a poor optimum is hundreds above.
    assert np.all(above < MOST_ABOVE)
    # Such choices, and where an adjustment stops, leave differences that are well below what is stated.
    assert max(largest_sigmas(ends[0].model, end.model) for end in ends[1:]) < 0.5
