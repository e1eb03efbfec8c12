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

"""A stage with faults, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.actuator import ActuatorFaults, StageActuator


def travel(pieces: list[tuple[float, tuple[float, float]]], end_s: float) -> np.ndarray:
    ends = [*(t for t, _ in pieces[1:]), end_s]
    steps = zip(pieces, ends, strict=True)
    return np.sum([(end - begin) * np.array(v) for (begin, v), end in steps], axis=0)


def test_a_perfect_stage_does_what_it_is_told() -> None:
    assert StageActuator().obey((1e-6, -2e-6), 3.0, 4.0) == [(3.0, (1e-6, -2e-6))]


def test_gain_and_direction() -> None:
    stage = StageActuator(ActuatorFaults(gain=(1.1, 0.9), turned_rad=math.radians(90.0)))
    ((_, velocity),) = stage.obey((1.0, 1.0), 0.0, 1.0)
    assert velocity == pytest.approx((-0.9, 1.1))


def test_play_is_lost_at_every_reversal_and_only_there() -> None:
    stage = StageActuator(ActuatorFaults(backlash_m=(2.0, 0.0)))
    assert travel(stage.obey((1.0, 0.0), 0.0, 5.0), 5.0)[0] == pytest.approx(5.0)
    # Half of the play, and a stop, which changes nothing; then the other half.
    assert travel(stage.obey((-1.0, 1.0), 5.0, 6.0), 6.0) == pytest.approx([0.0, 1.0])
    assert travel(stage.obey((0.0, 0.0), 6.0, 9.0), 9.0) == pytest.approx([0.0, 0.0])
    assert stage.obey((-1.0, 0.0), 9.0, 12.0) == [(9.0, (0.0, 0.0)), (10.0, (-1.0, 0.0))]
    assert travel(stage.obey((-1.0, 0.0), 12.0, 13.0), 13.0)[0] == pytest.approx(-1.0)
    assert travel(stage.obey((1.0, 0.0), 13.0, 16.0), 16.0)[0] == pytest.approx(1.0)


@pytest.mark.parametrize("faults", [{"gain": (0.0, 1.0)}, {"backlash_m": (-1.0, 0.0)}])
def test_absurd_faults_are_refused(faults: dict[str, tuple[float, float]]) -> None:
    with pytest.raises(InvalidValueError):
        ActuatorFaults(**faults)
