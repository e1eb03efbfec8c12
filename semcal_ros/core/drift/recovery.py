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

"""Frames that do not match: the drift goes on as predicted, the specimen is lost, tracking starts again, and the place
is found again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.estimates import DriftStatus, DriftUpdate
from semcal_ros.core.drift.filter_update import use_match
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.gating import (
    OutlierTest,
    inflate_if_contradicted,
    inflate_position,
    inflate_when_lost,
    reach_of_drift_px,
)
from semcal_ros.core.drift.keyframe_store import Candidate
from semcal_ros.core.drift.matching import RejectedMatch, match_keyframe
from semcal_ros.core.drift.measurement import is_removable
from semcal_ros.core.drift.new_keyframes import add_keyframe, prepare_keyframe
from semcal_ros.core.drift.thresholds import INTERVAL_S_MIN, WHOLE_SHARE_MIN
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState, make_update
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import IMAGE_FAILURES, SEEN_AWAY, MatchFailure

# What an image looks like that shows another place: the prediction need not hold.
_ELSEWHERE = frozenset(
    {MatchFailure.NO_PEAK, MatchFailure.DISSIMILAR, MatchFailure.DEFECTS_ELSEWHERE}
)


def coast(
    setup: TrackerSetup,
    state: TrackerState,
    frame: ScanFrame,
    rejected: list[RejectedMatch],
    *,
    rescaled: bool,
) -> tuple[TrackerState, DriftUpdate]:
    """Keep the prediction, with a larger covariance where the image contradicts it; start
    again from it where the frame or its scale is lost.
    """
    # The first one is that of the best keyframe.
    rejection, registration = rejected[0].rejection, rejected[0].registration
    doubt = _doubt(setup, state, frame, rejected)
    # A blanked beam says nothing about the keyframe.
    is_of_keyframe = rejection.status not in IMAGE_FAILURES
    last_s, drift = state.previous_s, state.filter.state
    state = replace(
        state,
        doubt=state.doubt if doubt is None else doubt,
        body=state.body.update(None),
        rejected=state.rejected + is_of_keyframe,
    )
    suggested = np.asarray(np.linalg.solve(frame.px_from_unit, registration.suggested_px))
    key, is_move = state.keyframes.current, rejection.status is MatchFailure.STAGE_MOVE
    if key is not None and is_move and np.all(np.isfinite(suggested)):
        # The last lines of the frame are a first look at where the stage went.
        position = suggested + drift.keyframe_state(key)[:2]
        state = replace(state, outliers=state.outliers.see(drift.time_s, position))
    since_s = max(drift.time_s - last_s, INTERVAL_S_MIN)
    is_lost = state.rejected >= setup.settings.lost_after
    if is_lost:
        speed_px_s = setup.settings.first_step_px / since_s
        inflation = inflate_when_lost(frame.px_from_unit, _reach_px(setup, frame), speed_px_s)
        state = state.inflate(inflation)
    else:
        nearest = np.asarray(np.linalg.solve(frame.px_from_unit, registration.nearest_px))
        contradicted = inflate_if_contradicted(drift, state.keyframes.current, nearest, since_s)
        if contradicted is not None:
            state = state.inflate(contradicted)
    if is_lost:
        return restart(setup, state, frame, rejection)
    if rescaled and is_of_keyframe and rejection.status not in SEEN_AWAY:
        # What is in doubt now is so for all frames that are registered against this one.
        state = state.inflate(inflate_position(state.doubt))
        return restart(setup, replace(state, doubt=np.zeros((2, 2))), frame, rejection)
    return state, make_update(
        state, frame, DriftStatus.COASTING, rejection, registration=registration
    )


def leave_place(
    setup: TrackerSetup,
    state: TrackerState,
    frame: ScanFrame,
    key: int,
    rejected: list[RejectedMatch],
) -> TrackerState:
    """Return the state before a match with keyframe ``key``, of a frame that did not match a better one before.

    Where it is not known how far the two keyframes are apart, that match alone would tell it, as if the frame had been
    seen with both. But it does not show the place of the other one: the specimen has moved since the last frame, out of
    sight.
    """
    if all(one.rejection.status in IMAGE_FAILURES for one in rejected):
        return state
    if not _is_lost(setup, state, frame, key):
        return state
    since_s = max(state.filter.state.time_s - state.previous_s, INTERVAL_S_MIN)
    speed_px_s = setup.settings.first_step_px / since_s
    out_of_sight_px = float(max(frame.size))
    return state.inflate(inflate_when_lost(frame.px_from_unit, out_of_sight_px, speed_px_s))


def find_place_again(
    setup: TrackerSetup,
    state: TrackerState,
    frame: ScanFrame,
    key: int,
    candidates: list[Candidate],
) -> TrackerState:
    """Measure a frame that matched keyframe ``key`` against one from before the place was lost, too: that tells how far
    what came after it is from what came before.

    It is tried in the first, second, fourth, eighth frame, and so on. All of the structure has to agree, most of it to
    be in sight still, and it has to be no farther than drift gets until a place is given up: nothing says where a part
    of it would be, and a coarse grid repeats beyond that.
    """
    in_px = frame.px_from_unit @ state.filter.state.covariance[:2, :2] @ frame.px_from_unit.T
    if np.trace(in_px) <= reach_of_drift_px(setup.settings.first_step_px) ** 2:
        return replace(state, sought=0) if state.sought else state
    state = replace(state, sought=state.sought + 1)
    if state.sought & (state.sought - 1):
        return state
    apart = [
        c
        for c in candidates
        if c.key != key and not c.rescaled and _is_lost(setup, state, frame, c.key)
    ]
    if not apart:
        return state
    known, again = match_keyframe(setup, state, frame, apart[0])
    if isinstance(again, RejectedMatch) or again.registration.along is not None:
        return state
    alignment = again.registration.alignment
    expected, _ = state.filter.state.predict_shift(apart[0].key)
    away_px = float(np.linalg.norm(frame.px_from_unit @ (again.measure.shift[:2] - expected)))
    is_in_sight = (
        alignment.overlap >= setup.settings.rekey_overlap
        and away_px <= setup.settings.lost_after * setup.settings.first_step_px
    )
    if again.registration.share < WHOLE_SHARE_MIN or not is_in_sight:
        return state
    found, refused = use_match(setup, known, frame, again)
    if refused is not None:
        return state
    # What moves by itself was seen with the other one.
    return replace(found, moving=state.moving, body=state.body, flicker=state.flicker)


def _is_lost(setup: TrackerSetup, state: TrackerState, frame: ScanFrame, key: int) -> bool:
    """Whether it is not known, to as far as drift gets between two frames, how far a keyframe is from a frame."""
    _, covariance = state.filter.state.predict_shift(key)
    variance_px2 = np.linalg.eigvalsh(frame.px_from_unit @ covariance @ frame.px_from_unit.T)[-1]
    return bool(variance_px2 > reach_of_drift_px(setup.settings.first_step_px) ** 2)


def _reach_px(setup: TrackerSetup, frame: ScanFrame) -> float:
    """How far away the place may be that an image shows which matches nothing."""
    return setup.settings.max_jump * max(frame.size)


def _doubt(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, rejected: list[RejectedMatch]
) -> Array | None:
    """By how much, as a (2, 2) covariance, the drift may be off where an image does not match; None
    where the image says nothing about that.
    """
    disputed = next((r.disputed for r in rejected[::-1] if r.disputed is not None), None)
    if disputed is not None:
        return disputed
    best = rejected[0]
    suggested = np.asarray(np.linalg.solve(frame.px_from_unit, best.registration.suggested_px))
    contradicted = inflate_if_contradicted(
        state.filter.state, state.keyframes.current, suggested, INTERVAL_S_MIN
    )
    if contradicted is not None:
        # It is not believed, but the prediction may be the one that is wrong.
        return contradicted.covariance[:2, :2]
    if best.rejection.status not in _ELSEWHERE:
        return None
    if best.rejection.status is MatchFailure.NO_PEAK:
        motion = state.filter.state.motion
        removed = motion if is_removable(motion, frame) else np.zeros(4)
        if prepare_keyframe(setup, state, frame, removed)[1].defect:
            # Noise matches nothing, wherever the specimen is.
            return None
    unit = np.linalg.inv(frame.px_from_unit) * _reach_px(setup, frame)
    return np.asarray(unit @ unit.T)


def restart(
    setup: TrackerSetup,
    state: TrackerState,
    frame: ScanFrame,
    rejection: Rejection[MatchFailure],
) -> tuple[TrackerState, DriftUpdate]:
    """Go on from the predicted drift with this frame as keyframe."""
    unmatched = state.filter.pending
    state, defect = add_keyframe(setup, state, frame, state.filter.state.motion)
    if defect is None:
        if unmatched is not None and len(state.keyframes) > 2:
            # No frame has ever matched it.
            state = state.forget(unmatched)
        static = state.static.begin_again(is_in_doubt=unmatched is not None)
        state = replace(state, rejected=0, outliers=OutlierTest(), static=static)
    return state, make_update(
        state,
        frame,
        DriftStatus.COASTING,
        defect or rejection,
        restarted=defect is None,
    )
