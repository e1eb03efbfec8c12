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

"""What a recording without a configured scan timing is told about its drift."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semcal_ros.config.config import load_config
from semcal_ros.core.drift.estimates import DriftPath, DriftUpdate
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.workflows.follow_drift import estimate_timing
from tests.helpers.drift_scenes import make_drift_update

LOST = Rejection(MatchFailure.NO_PEAK, "lost")


def note_of(updates: Sequence[DriftUpdate]) -> str:
    follower: Any = SimpleNamespace(updates=updates, path=lambda live: DriftPath(updates))
    config, note = estimate_timing(load_config("generic"), follower, None)
    assert config.scan is None
    return note


def updates(step_px: float, rejected: Sequence[int] = ()) -> list[DriftUpdate]:
    return [
        make_drift_update(
            time_s=float(k),
            # What was only predicted is far from what was measured.
            drift_m=np.array([k * step_px + 20.0 * (k in rejected), 0.0]),
            rejection=LOST if k in rejected else None,
        )
        for k in range(12)
    ]


@pytest.mark.parametrize(("step_px", "noted"), [(0.4, False), (0.6, True)])
def test_fast_drift_is_noted_where_the_shear_of_the_frames_is_unknown(
    step_px: float, noted: bool
) -> None:
    assert ("drift of up to 0.6 px" in note_of(updates(step_px))) == noted


def test_frames_that_were_only_predicted_do_not_count() -> None:
    assert note_of(updates(0.1, rejected=(3, 7))) == ""
