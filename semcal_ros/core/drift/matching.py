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

"""A frame against one keyframe: registered, again without what the registration shows to be left, and measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import AnyImage, Array, Mask, solve_scaled
from semcal_ros.core.drift.camera_uncertainty import visit_scale_variance
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.keyframe_store import Candidate
from semcal_ros.core.drift.measurement import (
    exceeds_tolerance,
    is_removable,
    keyframe_noise,
    make_measurement,
)
from semcal_ros.core.drift.operations import Measure
from semcal_ros.core.drift.remade_keyframes import correct_shear, forget_mean, single_keyframe
from semcal_ros.core.drift.similarity import SimilarityMatch, constrain_registration
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.thresholds import (
    INNOVATION_CHI2_MAX,
    KNOWN_SHEAR_PX,
    MEAN_COUNTS,
    PULLED_CHI2_MIN,
    PULLED_PX,
    REGISTRATIONS_MAX,
    SHEAR_MAX,
    TURN_LEFT_PX,
    VISIT_SIGMAS,
)
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState
from semcal_ros.core.errors import Rejection
from semcal_ros.core.rectification.raw_positions import similarity_matrix
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.inverse_compositional import unmeasured_alignment
from semcal_ros.core.registration.reference import Reference, Region
from semcal_ros.core.registration.register import Registration, register


@dataclass(frozen=True)
class Match:
    """A registration that holds against a keyframe.

    Attributes
    ----------
    candidate
        The keyframe.
    registration
        Shift in px.
    image, region, fixed
        The frame as it was compared, the part of it that was scanned, and the pixels that do not show the specimen.
    removed
        (4,) drift velocity and acceleration that were removed from it.
    measure
        The measurement for the filter.
    keyframe_time_s
        Time of the keyframe.
    similarity
        What it says of rotation and scale.
    """

    candidate: Candidate
    registration: Registration
    image: AnyImage
    region: Region
    fixed: Mask | None
    removed: Array
    measure: Measure
    keyframe_time_s: float
    similarity: SimilarityMatch

    @property
    def apart(self) -> Mask | None:
        """(h, w) the pixels of the image that do not show the specimen, what moves among them; None where all do."""
        moving = self.registration.moving
        if moving is None:
            return self.fixed
        height, width = self.image.shape[:2]
        # Its edge may run through the tiles around.
        around = moving.grown().draw((width, height)) > 0
        return around if self.fixed is None else around | self.fixed


@dataclass(frozen=True)
class RejectedMatch:
    """A registration against a keyframe that is not used.

    ``disputed`` (2, 2) is what a shift that contradicts the prediction adds to the covariance of
    the drift: one of the two is wrong. It is None where the registration failed.
    """

    rejection: Rejection[MatchFailure]
    registration: Registration
    disputed: Array | None = None

    @classmethod
    def unseen(cls, rejection: Rejection[MatchFailure]) -> RejectedMatch:
        """That of a frame that is not registered at all."""
        return cls(rejection, Registration(unmeasured_alignment(), float("nan"), rejection))


def match_keyframe(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, candidate: Candidate
) -> tuple[TrackerState, Match | RejectedMatch]:
    """Register a frame, and again without the shear that a wrong velocity has left in it.

    Returns
    -------
    What is known now, and the match. The drift is not updated by it yet; but references were prepared, and the noise of
    a keyframe that nothing was compared with before, or a shear that it has, are known to the filter.
    """
    motion = state.filter.state.motion
    first = motion if is_removable(motion, frame) else np.zeros(4)
    turn = state.similarity.expected_turn(candidate.key)
    state, match = _register(setup, state, frame, candidate, first, turn)
    state, match = _match_turned(setup, state, frame, match, candidate, first, turn)
    for _ in range(REGISTRATIONS_MAX - 1):
        if isinstance(match, RejectedMatch):
            break
        outcome = match.measure(state.filter.state, state.filter.process_noise)
        drift = outcome.state
        is_jump = outcome.nis > INNOVATION_CHI2_MAX and not _shows_shear(match)
        if is_jump or not is_removable(drift.motion, frame):
            # A jump, not a drift: the gate decides.
            break
        corrected = False
        if not candidate.rescaled:
            state, corrected = correct_shear(setup, state, candidate.key, drift)
        turned = match.similarity.remaining_px(frame.size) > TURN_LEFT_PX
        known = _is_known(drift, match.removed, frame)
        moved = known and exceeds_tolerance(drift.motion - match.removed, frame)
        if not (corrected or moved or turned):
            break
        turn = match.similarity.turn
        motion = drift.motion if known else match.removed
        state, again = _register(setup, state, frame, candidate, motion, turn)
        if isinstance(again, RejectedMatch):
            break
        match = again
    return state, match


def _shows_shear(match: Match) -> bool:
    """Whether a frame is sheared by another velocity than the one that was taken out of it.

    Where it is not, what is far from where it was expected is there by a move between the frames, as of a stage.
    """
    shear_px = match.registration.alignment.joint_px[2:]
    variance = match.registration.alignment.joint_covariance[2:, 2:]
    if not np.all(np.isfinite(shear_px)):
        return False
    return float(shear_px @ solve_scaled(variance, shear_px)) > INNOVATION_CHI2_MAX


def _is_known(drift: DriftState, removed: Array, frame: ScanFrame) -> bool:
    """Whether a velocity is well known, or at least better than it differs from the one that was taken out of a frame.

    After a move that may have been a jump or a drift, it is not: what lies beside the middle line would be found off by
    its error.
    """
    if frame.timing is None:
        return True
    change, covariance = drift.velocity - removed[:2], drift.covariance[2:4, 2:4]
    in_px = frame.px_from_unit @ covariance @ frame.px_from_unit.T
    sheared_px = frame.timing.frame_time_s * np.sqrt(np.max(np.diag(in_px)))
    if sheared_px < KNOWN_SHEAR_PX:
        return True
    return float(change @ solve_scaled(covariance, change)) > INNOVATION_CHI2_MAX


def _register(
    setup: TrackerSetup,
    state: TrackerState,
    frame: ScanFrame,
    candidate: Candidate,
    motion: Array,
    turn: Array,
) -> tuple[TrackerState, Match | RejectedMatch]:
    """Register a frame that is corrected for a motion (4,), and a rotation and a scale (2,)."""
    key, rate = candidate.key, state.similarity.rate
    image, region = setup.corrector.corrected_image(frame, motion, turn, rate)
    fixed = setup.corrector.corrected_mask(frame, motion, turn, rate)
    state, reference = _prepare_reference(setup, state, frame, candidate)
    shift, covariance = state.filter.state.predict_shift(key)
    px_from_unit, is_turned = frame.px_from_unit, state.similarity.is_active
    appears = state.similarity.keyframe_similarity(key)
    if is_turned:
        px_from_unit = similarity_matrix(appears) @ px_from_unit
    covariance = covariance + state.unseen_covariance(px_from_unit)
    keyframe = state.keyframes[key]
    is_other_visit = keyframe.time_s < state.zoomed_s
    stretch = 0.0
    if is_other_visit:
        variance = visit_scale_variance(keyframe.frame.camera, frame.camera)
        stretch = VISIT_SIGMAS * float(np.sqrt(variance))
    registration = register(
        reference,
        image,
        guess_px=px_from_unit @ shift,
        guess_covariance=px_from_unit @ covariance @ px_from_unit.T,
        image_region=region,
        max_shear_px=SHEAR_MAX * frame.size[1],
        max_stretch=stretch,
        suspected=state.moving,
        takes_lines=True,
        fixed=fixed,
    )
    if registration.rejection is not None:
        return state, RejectedMatch(registration.rejection, registration)
    if not candidate.rescaled:
        registration = keyframe.allow_for_change(registration)
    averaged = np.inf if candidate.rescaled else float(state.keyframes.averaged(key))
    known, similarity = state.similarity.match(
        key, registration, turn, frame, averaged, measures=not candidate.rescaled
    )
    measured = registration
    if is_turned:
        measured = constrain_registration(registration, similarity, appears, frame)
    measure = make_measurement(
        key,
        keyframe.frame,
        frame,
        measured,
        motion,
        averaged,
        is_other_visit=is_other_visit,
    )
    drift_filter = state.filter
    if drift_filter.pending == key:
        drift_filter = drift_filter.set_keyframe_noise(keyframe_noise(measure), measure.scan_s)
    match = Match(
        candidate,
        registration,
        image,
        region,
        fixed,
        motion,
        measure,
        keyframe.time_s,
        similarity,
    )
    return replace(state, similarity=known, filter=drift_filter), match


def _prepare_reference(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, candidate: Candidate
) -> tuple[TrackerState, Reference]:
    """The keyframe as a frame is registered against it."""
    settings, store = setup.settings.registration, state.keyframes
    if candidate.rescaled:
        store, reference = store.resampled_reference(candidate.key, frame, settings)
    else:
        store, reference = store.reference(candidate.key, settings)
    return replace(state, keyframes=store), reference


def _match_turned(
    setup: TrackerSetup,
    state: TrackerState,
    frame: ScanFrame,
    before: Match | RejectedMatch,
    candidate: Candidate,
    motion: Array,
    turn: Array,
) -> tuple[TrackerState, Match | RejectedMatch]:
    """Register a frame again without the rotation and the scale that the registration ``before``
    shows, where it shows any; the better match of the two.
    """
    key, similarity = candidate.key, state.similarity
    if candidate.rescaled or not setup.settings.similarity:
        return state, before
    if isinstance(before, Match):
        similarity, suggested = similarity.confirm_turn(
            key, before.registration, turn, frame, state.filter.state.time_s, state.time_s
        )
        state = replace(state, similarity=similarity)
    else:
        suggested = similarity.suggest_turn(key, before.registration, turn, frame)
    if suggested is None:
        return state, before
    turned = state
    if not similarity.is_active:
        active = similarity.activate(key, suggested, state.filter.state.time_s)
        turned = forget_mean(setup, replace(state, similarity=active), key)
    turned, match = _register(setup, turned, frame, candidate, motion, suggested)
    if isinstance(match, RejectedMatch):
        return state, before
    if not similarity.is_active:
        for other in turned.similarity.keys:
            if other != key:
                turned = forget_mean(setup, turned, other)
    return turned, match


def free_of_pull(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, match: Match
) -> tuple[TrackerState, Match]:
    """The match against means that nothing has pulled, where something is found to move by itself.

    As long as it had moved by little, it was taken for the specimen, and pulled the frames that were added to a
    mean. Where the first frame of the keyframe asks for another shift than the mean does, all means are given up.

    The difference is one of the two references, whichever frame is compared with both: a mean of the same frames as
    before is not looked at again.
    """
    key, before = match.candidate.key, match.registration
    old = state.keyframes[key]
    is_new = old.averaged in MEAN_COUNTS and old.averaged != old.compared
    if (
        before.moving is None
        or not (is_new or state.moving is None)
        or match.candidate.rescaled
        or old.averaged == 1
    ):
        return state, match
    compared = replace(old, compared=old.averaged)
    store, first = state.keyframes.replace(key, compared).single_reference(
        key,
        lambda: single_keyframe(setup, old.frame, old.removed, old),
        setup.settings.registration,
    )
    state = replace(state, keyframes=store)
    found = register(
        first,
        match.image,
        guess_px=before.shift_px,
        guess_covariance=before.covariance + np.eye(2) * PULLED_PX**2,
        image_region=match.region,
        max_shear_px=SHEAR_MAX * frame.size[1],
        suspected=before.moving,
        fixed=match.fixed,
    )
    pulled_px = found.shift_px - before.shift_px
    if (
        not found.accepted
        or float(pulled_px @ np.linalg.solve(found.covariance, pulled_px)) < PULLED_CHI2_MIN
    ):
        return state, match
    freed = state
    for k in state.keyframes.keys:
        freed = forget_mean(setup, freed, k)
    freed, again = _register(
        setup, freed, frame, match.candidate, match.removed, match.similarity.turn
    )
    if isinstance(again, RejectedMatch):
        return state, match
    pulled = np.linalg.solve(frame.px_from_unit, pulled_px)
    widened = freed.filter.widen_measurements(np.outer(pulled, pulled))
    return replace(freed, filter=widened), again
