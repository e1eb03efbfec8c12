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

"""A step of the tracker: from a state that never changes to the next one."""

from __future__ import annotations

import pickle
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift import matching
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.drift.frame import MotionCorrector, ScanFrame
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.similarity import SimilarityState
from semcal_ros.core.drift.tracker import DriftTracker, step
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.register import Registration, register
from tests.helpers.drift_scenes import DriftingSpecimen, Texture, noisy, small_camera

TIMING = ScanTiming(0.9, 1, 0.1)
SPECIMEN, CAMERA = DriftingSpecimen(pitch_m=0.1e-6, seed=3), small_camera(2000.0)
VELOCITY = np.array([0.3e-6, -0.2e-6])


def make_setup(*, keeps_history: bool = False) -> TrackerSetup:
    settings = DriftSettings(similarity=True, lost_after=3)
    return TrackerSetup(settings, MotionCorrector(settings.interpolation), keeps_history)


def make_frame(k: int) -> tuple[ScanFrame, float]:
    """A frame of a series in which the specimen drifts, is lost for some frames, and found again."""
    image = SPECIMEN.frame(CAMERA, TIMING, VELOCITY * k, VELOCITY, k)
    if 6 <= k < 10:
        image = image[::-1].copy()
    return ScanFrame(image, CAMERA, TIMING), k + TIMING.centre_offset_s


def follow(
    setup: TrackerSetup, state: TrackerState | None, first: int, last: int
) -> tuple[TrackerState, list[DriftUpdate]]:
    updates = []
    for k in range(first, last):
        state, update = step(setup, state, *make_frame(k))
        updates.append(update)
    assert state is not None
    return state, updates


def collect_arrays(value: Any) -> list[np.ndarray]:
    """All arrays of a tree of dataclasses."""
    if isinstance(value, np.ndarray):
        return [value]
    if is_dataclass(value):
        return [a for f in fields(value) for a in collect_arrays(getattr(value, f.name))]
    if isinstance(value, dict):
        return [a for v in value.values() for a in collect_arrays(v)]
    if isinstance(value, tuple | list):
        return [a for v in value for a in collect_arrays(v)]
    return []


def assert_same(ours: list[DriftUpdate], theirs: list[DriftUpdate]) -> None:
    assert [u.status_text for u in ours] == [u.status_text for u in theirs]
    for a, b in zip(ours, theirs, strict=True):
        assert np.array_equal(a.drift_m, b.drift_m)
        assert np.array_equal(a.covariance, b.covariance)


@pytest.mark.slow
@pytest.mark.parametrize("keeps_history", [False, True])
def test_what_was_tried_is_undone_by_going_on_from_the_state_before(keeps_history: bool) -> None:
    setup = make_setup(keeps_history=keeps_history)
    early, _ = follow(setup, None, 0, 5)
    arrays = collect_arrays(early)
    copies = [a.copy() for a in arrays]
    late, updates = follow(setup, early, 5, 13)
    # All that can happen did: tracked, coasting, lost and started again, and tracked once more.
    assert {u.status.value for u in updates} == {"tracked", "coasting"}
    assert any(u.restarted for u in updates) and updates[-1].accepted
    assert len(late.keyframes) > len(early.keyframes) == 1
    # The state before is as it was, and leads to the same again, also in another process.
    assert len(arrays) > 20
    for array, copy in zip(collect_arrays(early), copies, strict=True):
        assert np.array_equal(array, copy, equal_nan=array.dtype.kind == "f")
    again = (setup, early) if keeps_history else pickle.loads(pickle.dumps((setup, early)))
    assert_same(follow(*again, 5, 13)[1], updates)


@pytest.mark.slow
def test_a_rotation_that_explains_nothing_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []
    activate, compare = SimilarityState.activate, register

    def note(similarity: SimilarityState, *arguments: Any) -> SimilarityState:
        tried.append(arguments)
        return activate(similarity, *arguments)

    def refuse_turned(*arguments: Any, **options: Any) -> Registration:
        found = compare(*arguments, **options)
        refused = Rejection(MatchFailure.DISSIMILAR, "does not look so without a rotation")
        return replace(found, rejection=refused) if tried else found

    monkeypatch.setattr(SimilarityState, "activate", note)
    monkeypatch.setattr(matching, "register", refuse_turned)
    texture, state, before = Texture(3), None, None
    for k in range(6):
        image = noisy(texture.view((0.2 * k, -0.1 * k), 192), 5.0, k)
        if k >= 4:
            # In two frames the right half lies lower, as if the specimen had turned.
            image[:, 96:] = np.roll(image[:, 96:], 1, axis=0)
        before = state
        state, update = step(make_setup(), state, ScanFrame(image, None, None), float(k))
        if tried:
            break
    assert state is not None and before is not None
    # The shift alone did not hold, and neither did the rotation that would have explained more.
    assert tried and not update.accepted and not state.similarity.is_active
    # Frames are still compared with the mean, and not with the first frame, which the try went back to.
    assert before.keyframes.prepared is not None and state.keyframes.prepared is not None
    assert state.keyframes.prepared.keyframe.averaged == 4


def test_images_are_shared_between_states() -> None:
    setup = make_setup()
    before, _ = follow(setup, None, 0, 6)
    # A frame that does not match adds no picture: nothing larger than the filter is made anew.
    after, _ = step(setup, before, *make_frame(6))
    known = {id(a) for a in collect_arrays(before)}
    assert max(a.size for a in collect_arrays(after) if id(a) not in known) < 1000
    assert after.keyframes.keyframes is before.keyframes.keyframes


def test_a_tracker_holds_the_state_and_a_frame_that_fails_leaves_it() -> None:
    tracker = DriftTracker(DriftSettings(similarity=True, lost_after=3))
    assert tracker.state is None
    updates = []
    for k in range(4):
        frame, _ = make_frame(k)
        updates.append(tracker.update(frame.image, float(k), CAMERA, TIMING))
    state, expected = follow(make_setup(), None, 0, 4)
    assert_same(updates, expected)
    held = tracker.state
    assert held is not None and held.time_s == state.time_s
    with pytest.raises(ValueError, match="bool"):
        tracker.update(np.zeros((192, 192), bool), 4.0, CAMERA, TIMING)
    assert tracker.state is held
    tracker.reset()
    assert tracker.state is None
