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

"""Frames that become keyframes, or part of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.camera_uncertainty import zoom_covariance
from semcal_ros.core.drift.estimates import DriftStatus, DriftUpdate
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.keyframe import Keyframe, make_keyframe
from semcal_ros.core.drift.keyframe_store import KeyframeStore
from semcal_ros.core.drift.matching import Match
from semcal_ros.core.drift.measurement import (
    add_zoom_uncertainty,
    clone_keyframe,
    measure_itself,
)
from semcal_ros.core.drift.operations import Measure
from semcal_ros.core.drift.thresholds import (
    BLUR_PX_MAX,
    COPY_NOISE,
    COPY_NOISE_BESIDE,
    MERGED_CORRELATION_MIN,
    MERGED_GAINS,
    MERGED_SHEAR_PX_MAX,
    OPEN_SIGMAS,
    PLACE_SIGMA_PX_MAX,
    SMALL_ZOOM,
)
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState, make_update
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.reference import Reference


def prepare_keyframe(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, removed: Array
) -> tuple[Keyframe, Reference]:
    """A frame as a keyframe without a motion ``removed`` (4,), and the reference that it would be."""
    turn, rate = state.similarity.position, state.similarity.rate
    image, region = setup.corrector.corrected_image(frame, removed, turn, rate)
    fixed = setup.corrector.corrected_mask(frame, removed, turn, rate)
    time_s = state.filter.state.time_s
    keyframe = make_keyframe(frame, removed, image, region, time_s, turn, fixed)
    return keyframe, keyframe.prepare_reference(setup.settings.registration)


def add_keyframe(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, removed: Array
) -> tuple[TrackerState, Rejection[MatchFailure] | None]:
    """Make this frame a keyframe that was not measured; why it cannot be one, or None."""
    keyframe, reference = prepare_keyframe(setup, state, frame, removed)
    if reference.defect:
        return state, Rejection(MatchFailure.UNUSABLE_IMAGE, reference.defect)
    store = state.keyframes.add(keyframe, reference)
    key, turn, time_s = store.latest, state.similarity.position, state.filter.state.time_s
    state = replace(
        state,
        keyframes=store,
        filter=state.filter.add_keyframe(key, removed, frame.acceleration_term_s2),
        similarity=state.similarity.add_keyframe(key, turn, time_s),
        lines=state.lines.with_keyframe(key),
    )
    return _forget_oldest(setup, state), None


def clone_measured(
    setup: TrackerSetup,
    state: TrackerState,
    frame: ScanFrame,
    match: Match,
    measure: Measure,
    noise: Array,
    *,
    is_changed: bool = False,
) -> TrackerState:
    """Make this frame a keyframe, as it was measured against the one before; ``noise`` (2, 2) is the covariance of its
    position as a keyframe about the measured one, and ``is_changed`` whether the specimen has changed since.
    """
    drift, turn = state.filter.state, match.similarity.removed
    keyframe = make_keyframe(
        frame, match.removed, match.image, match.region, drift.time_s, turn, match.fixed
    )
    changes = state.keyframes[measure.key].changes + int(is_changed)
    store = state.keyframes.add(replace(keyframe, changes=changes))
    key, similarity = store.latest, state.similarity
    if match.candidate.rescaled:
        similarity = similarity.add_keyframe(key, turn, drift.time_s)
    else:
        similarity = similarity.clone_keyframe(
            key, measure.key, match.registration, turn, drift.time_s
        )
    state = replace(
        state,
        keyframes=store,
        filter=state.filter.apply(clone_keyframe(key, drift, measure, match.removed, noise)),
        similarity=similarity,
        lines=state.lines.with_keyframe(key),
    )
    return _forget_oldest(setup, state)


def _forget_oldest(setup: TrackerSetup, state: TrackerState) -> TrackerState:
    """Keep memory and number of the keyframes within their limits."""
    settings = setup.settings
    for key in state.keyframes.superfluous(settings.max_keyframe_bytes, settings.max_keyframes):
        state = state.forget(key)
    return state


def change_scale(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, match: Match, measure: Measure
) -> tuple[TrackerState, Measure]:
    """Make this frame the keyframe of its magnification, by way of one of another; its
    measurement against itself.
    """
    before, now = state.keyframes[measure.key].frame.camera, frame.camera
    assert before is not None and now is not None
    noise = zoom_covariance(before, now) + measure.covariance[:2, :2] * COPY_NOISE
    state = clone_measured(setup, state, frame, match, measure, noise)
    return state, measure_itself(state.keyframes.latest, measure, match.removed)


def renew_keyframe(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, match: Match
) -> tuple[TrackerState, DriftUpdate]:
    """Choose the keyframe for the frames that follow one that was measured, and improve its mean."""
    registration, candidate = match.registration, match.candidate
    if candidate.ratio > SMALL_ZOOM:
        # It became a keyframe when it was measured.
        return state, make_update(state, frame, DriftStatus.KEYFRAME, registration=registration)
    store = state.keyframes.use(candidate.key)
    latest = store[candidate.key]
    noted = latest.note_match(registration)
    state = replace(state, keyframes=store.replace(candidate.key, noted))
    status, merged = DriftStatus.TRACKED, False
    overlap, enough = registration.alignment.overlap, setup.settings.rekey_overlap
    # A single frame that differs may show another place in a part of its lines, and would hide the move to it.
    is_changed = (noted.differs and latest.differs) or (
        # A tool that comes in is no change of the specimen.
        noted.is_worn and registration.moving is None and not registration.alignment.may_be_pulled
    )
    if is_changed or overlap < enough:
        following = state.keyframes.candidates(state.filter.state, frame, enough, SMALL_ZOOM)
        if is_changed or following[0].overlap < enough:
            share = COPY_NOISE + COPY_NOISE_BESIDE * (1.0 - min(overlap, 1.0))
            if is_changed:
                # What grows in the place of the rest pulls all frames the same way, and from change to change: the
                # sigmas of single frames add up, and not variances.
                share += 2.0 * noted.changes + 1.0
            noise = match.measure.covariance[:2, :2] * share
            measure = match.measure
            if candidate.rescaled:
                before = state.keyframes[candidate.key].frame
                measure = add_zoom_uncertainty(measure, before, frame)
            state = clone_measured(
                setup, state, frame, match, measure, noise, is_changed=is_changed
            )
            status = DriftStatus.KEYFRAME
    elif (
        setup.settings.average
        and state.lines.unseen is None
        and _is_mergeable(match, state.keyframes)
    ):
        # Not of lines alone: what came into the picture since would be where it was predicted to be.
        keyframe = state.keyframes[candidate.key]
        mean = keyframe.with_frame(match.image, match.region, registration, match.apart)
        state = replace(state, keyframes=state.keyframes.replace(candidate.key, mean))
        merged = True
    update = make_update(state, frame, status, registration=registration)
    return state, replace(update, keyframe_time_s=match.keyframe_time_s, merged=merged)


def _is_mergeable(match: Match, store: KeyframeStore) -> bool:
    """Whether a frame makes the mean of its keyframe better."""
    registration, candidate = match.registration, match.candidate
    alignment = registration.alignment
    shear_px = np.abs(np.nan_to_num(alignment.joint_px[2:], nan=0.0))
    sigma_px = np.sqrt(np.diag(alignment.joint_covariance)[2:])
    # A few particles tell a shear badly: what they leave open is none.
    shows_shear = shear_px > MERGED_SHEAR_PX_MAX + OPEN_SIGMAS * np.where(
        np.isfinite(sigma_px), sigma_px, 0.0
    )
    return (
        not candidate.rescaled
        and store.has_room(candidate.key, alignment.overlap)
        and registration.correlation > MERGED_CORRELATION_MIN
        and MERGED_GAINS[0] < registration.contrast < MERGED_GAINS[1]
        and not np.any(shows_shear)
        and float(np.max(shear_px)) < BLUR_PX_MAX
        and float(np.max(np.diag(registration.covariance))) < PLACE_SIGMA_PX_MAX**2
        # A mean that is pulled stays so, and all that is registered against it.
        and not alignment.may_be_pulled
    )
