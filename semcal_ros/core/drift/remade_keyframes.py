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

"""Keyframes that are made anew from their first frame: without a motion, or without what spoilt their mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.keyframe import Keyframe, make_keyframe
from semcal_ros.core.drift.measurement import exceeds_tolerance, is_removable
from semcal_ros.core.drift.operations import CorrectShear
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState


def single_keyframe(
    setup: TrackerSetup, frame: ScanFrame, removed: Array, old: Keyframe
) -> Keyframe:
    """A keyframe of a single frame, freed of a motion ``removed`` (4,), in the place of another one."""
    image, region = setup.corrector.corrected_image(frame, removed, old.turn)
    fixed = setup.corrector.corrected_mask(frame, removed, old.turn)
    return make_keyframe(frame, removed, image, region, old.time_s, old.turn, fixed)


def remake_keyframe(
    setup: TrackerSetup, state: TrackerState, key: int, frame: ScanFrame, removed: Array
) -> TrackerState:
    """Replace a keyframe by one of a single frame, freed of a motion ``removed`` (4,)."""
    single = single_keyframe(setup, frame, removed, state.keyframes[key])
    return replace(state, keyframes=state.keyframes.replace(key, single))


def forget_mean(setup: TrackerSetup, state: TrackerState, key: int) -> TrackerState:
    """Go back to the first frame of a keyframe: the mean is of frames that were turned, or pulled."""
    old = state.keyframes[key]
    if old.averaged == 1:
        return state
    return remake_keyframe(setup, state, key, old.frame, old.removed)


def clean_keyframes(setup: TrackerSetup, state: TrackerState) -> TrackerState:
    """Free all keyframes of what is now known not to be the specimen."""
    for key in state.keyframes.keys:
        old = state.keyframes[key]
        frame = state.static.remove_from(old.frame)
        if frame is not old.frame:
            single = single_keyframe(setup, frame, old.removed, old)
            state = replace(state, keyframes=state.keyframes.clean(key, single))
    return state


def correct_shear(
    setup: TrackerSetup, state: TrackerState, key: int, drift: DriftState
) -> tuple[TrackerState, bool]:
    """Take the shear, as the state ``drift`` knows it, out of a keyframe; whether there was any. Only a single frame
    has one.
    """
    keyframe = state.keyframes[key]
    remaining = np.append(drift.keyframe_state(key)[2:], np.zeros(2))
    removed = keyframe.removed + remaining
    if (
        keyframe.averaged > 1
        or not exceeds_tolerance(remaining, keyframe.frame)
        # A stage that jumped, or a wrong match: no velocity that a scan could be freed from.
        or not is_removable(removed, keyframe.frame)
    ):
        return state, False
    state = remake_keyframe(setup, state, key, keyframe.frame, removed)
    term_s2 = keyframe.frame.acceleration_term_s2
    return state.apply(CorrectShear(key, remaining, term_s2)), True
