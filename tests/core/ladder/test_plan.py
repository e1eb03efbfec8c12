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

"""Plans of ladders."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.ladder.acquisition import plan_ladder
from semcal_ros.core.ladder.thresholds import STEP_MAX
from tests.helpers.ladders import calibration_of, make_scope


@pytest.mark.parametrize("last", [100e3, 9000.0, 300.0])
def test_a_ladder_begins_inside_the_range_and_has_no_gap(last: float) -> None:
    model = calibration_of(make_scope())
    steps = plan_ladder(model, last)
    seen = np.array([step.magnification for step in steps])
    low, high = model.magnification_range
    assert seen[-1] == pytest.approx(last, rel=1e-3)
    # Three steps inside, so that no single visit carries the scale.
    assert np.count_nonzero((seen >= 0.999 * low) & (seen <= 1.001 * high)) >= 3
    ratios = np.exp(np.abs(np.diff(np.log(seen))))
    assert np.all(ratios < STEP_MAX)
    for step in steps:
        assert step.field_m == pytest.approx(model.display_width_m / step.magnification)
        for x, y in step.moves_m[1:]:
            assert 0.2 < np.hypot(x, y) / step.field_m < 0.34
    # To either side in turn: what drifts steadily then stretches the turned pictures to either side.
    assert {round(step.turn_rad, 6) for step in steps} == {round(s * np.pi / 2, 6) for s in (1, -1)}


@pytest.mark.parametrize("last", [2000.0, 1e9, 1e-3])
def test_a_magnification_inside_the_range_needs_no_ladder(last: float) -> None:
    with pytest.raises(InvalidValueError, match="beyond"):
        plan_ladder(calibration_of(make_scope()), last)
