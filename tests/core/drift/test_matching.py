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

"""Whether something has pulled a mean is asked once of each mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from semcal_ros.core.drift import keyframe_store, matching
from semcal_ros.core.drift.tracker import DriftTracker
from tests.helpers.drift_scenes import Texture

SIZE = 224
GROUND = Texture(5)
COLUMNS = np.arange(SIZE, dtype=np.float64)[None, :]


def test_a_mean_is_compared_with_its_first_frame_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (keyframe_store, matching):
        monkeypatch.setattr(module, "MEAN_COUNTS", (2, 4))
    registered, prepared = [], []
    register, prepare = matching.register, keyframe_store.Keyframe.prepare_reference

    def count_registrations(*arguments: Any, **options: Any) -> Any:
        registered[-1] += 1
        return register(*arguments, **options)

    def count_references(keyframe: keyframe_store.Keyframe, settings: Any) -> Any:
        prepared.append(keyframe.averaged)
        return prepare(keyframe, settings)

    monkeypatch.setattr(matching, "register", count_registrations)
    monkeypatch.setattr(keyframe_store.Keyframe, "prepare_reference", count_references)
    tracker = DriftTracker()
    averaged = []
    for k in range(12):
        ground = 90.0 + 20.0 * GROUND.view((0.4 * k, -0.3 * k), SIZE)
        # A tool that comes in by 3 px a frame.
        level = np.where(COLUMNS - 3.0 * k < 40.0, 185.0, ground)
        noisy = np.random.default_rng(k).normal(level, 7.0)
        registered.append(0)
        update = tracker.update(np.rint(noisy.clip(0, 255)).astype(np.uint8), float(k))
        assert update.accepted, update.reason
        assert tracker.state is not None
        averaged.append(tracker.state.keyframes[0].averaged)
    assert update.moving is not None
    assert averaged[-5:] == [4] * 5
    # It is full from then on, and was compared when it became so.
    assert registered[-4:] == [1] * 4
    assert 2 <= sum(registered) - len(registered) + 1 <= 4
    # The first frame alone was prepared at the start, and once for all comparisons.
    assert prepared.count(1) == 2
