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

"""Live drift: registration against keyframes, filtered, in metres.

Every frame is registered against a keyframe, so that errors do not add up from frame to frame. The
keyframe is replaced before its overlap with the image is lost, and an old one is used again when
its place comes back into view. One Kalman filter holds the drift, its velocity and the positions of
the keyframes (:mod:`semcal_ros.core.drift.state`); it predicts each shift, gates it and bridges
frames that cannot be used.

Drift is the displacement of the specimen: what lay at X in the first frame is seen at X + drift.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import AnyImage, Array, Mask
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.camera_uncertainty import (
    centre_covariance,
    scale_covariance,
    zoom_covariance,
)
from semcal_ros.core.drift.estimates import (
    DriftPredictor,
    DriftSettings,
    DriftStatus,
    DriftUpdate,
    forget_prior,
)
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.fixed_parts import (
    LEAST_MOVE_PX,
    find_fixed_parts,
    share_of_gradients,
)
from semcal_ros.core.drift.flicker import FlickerEstimator
from semcal_ros.core.drift.frame import MotionCorrector, ScanFrame, resampleable
from semcal_ros.core.drift.gating import (
    GATE,
    OutlierTest,
    inflate_after_pause,
    inflate_if_contradicted,
    inflate_position,
    inflate_when_lost,
    judge_shift,
)
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.keyframe import Keyframe, make_keyframe
from semcal_ros.core.drift.keyframe_store import MEAN_COUNTS, Candidate, KeyframeStore
from semcal_ros.core.drift.measurement import (
    add_zoom_uncertainty,
    clone_keyframe,
    exceeds_tolerance,
    keyframe_noise,
    make_measurement,
    measure_itself,
)
from semcal_ros.core.drift.operations import CorrectShear, Inflate, Marginalise, Measure, Predict
from semcal_ros.core.drift.overlay import find_overlay, remove_overlay
from semcal_ros.core.drift.own_motion import BodyFrame, OwnMotion, OwnMotionEstimator
from semcal_ros.core.drift.similarity import (
    SimilarityMatch,
    SimilarityTracker,
    constrain_registration,
    turn_drift,
)
from semcal_ros.core.drift.state import DriftState, initial_state
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.rectification.raw_positions import similarity_matrix
from semcal_ros.core.registration.agreement import MovingTiles
from semcal_ros.core.registration.failures import IMAGE_FAILURES, MatchFailure
from semcal_ros.core.registration.reference import Reference, Region
from semcal_ros.core.registration.register import Registration, register

# The velocity is expected to change by this part of the first step per frame, to begin with.
_VELOCITY_CHANGE = 0.1
# A disputed position counts as two standard deviations away.
_DISPUTED_SIGMAS = 2.0
# Changes of scale up to which the keyframe stays in use, resampled for each frame.
_SMALL_ZOOM = 1.15
# A frame whose correlation with its keyframe is lower takes its place: the specimen changes.
_MIN_CORRELATION = 0.75
# What frames must be like to become part of their keyframe's mean: a higher correlation, a gain
# within a factor of two, and a shear that does not blur it.
_MIN_MERGE_CORRELATION, _MERGE_GAINS, _MAX_MERGE_SHEAR_PX = 0.85, (0.5, 2.0), 0.1
# Standard deviations of a measured shear within which it may be none, and the largest one then: a quarter of a pixel to
# either side at the upper and the lower edge blurs structure at a third of a cycle per pixel by 4 % there.
_OPEN_SIGMAS, _MAX_BLUR_PX = 2.0, 0.5
# Deviations of a rotation that is seen: by chance once in 16 000 frames.
_TURNED_SIGMAS = 4.0
# 1-sigma of a shift from which a frame would blur the mean as much.
_MAX_PLACE_PX = 0.2
# A frame's position as a keyframe is that which was measured, noise and all; but as a reference its
# noise weighs otherwise than as an image, and other parts of it are compared. Of the variance of the
# frame's noise, this part, and this part times the fraction that did not overlap, as seen in the
# closure of triples of frames.
_COPY_NOISE, _COPY_NOISE_BESIDE = 0.15, 5.0
# After this number of frame intervals without a frame nothing says that the drift went on as it was.
_PAUSE = 10.0
# Keyframes to try; twice as many where nothing matched before.
_CANDIDATES = 2
# Registrations of one frame; each removes the shear that the one before it measured.
_MAX_REGISTRATIONS = 4
# Part of the image's height by which drift may shear it.
_MAX_SHEAR = 0.1
# Rotation and scale that are left at the edge of a frame are worth another registration from here on.
_MAX_TURN_PX = 0.1
# Divisions by intervals stay finite.
_MIN_INTERVAL_S = 1e-9
# Frames in which an overlay is looked for: the first ones, and then every so many.
_FIRST_LOOKS, _LOOK_EVERY = 3, 8
# What stays in place is looked for as soon as the specimen has moved, the first times, and then after one frame more
# each time, up to so many: a spot does not show where the specimen is as dark.
_FIXED_FIRST, _FIXED_LATER = 4, 32
# Part of the image that must newly be found to stay, for keyframes to be freed of it.
_NEWLY_FIXED = 1e-4
# What moves by less than this against the specimen may not have been found, and has pulled by a part of it at most, px.
_MOST_PULLED_PX = 0.3
# Chi-square (2 degrees of freedom) from which a mean is of frames that were pulled: of others, one in a hundred, which
# costs a few frames until there is a mean again.
_PULLED_CHI2 = 9.2
# What an image looks like that shows another place: the prediction need not hold.
_ELSEWHERE = frozenset({MatchFailure.NO_PEAK, MatchFailure.DISSIMILAR})


@dataclass
class _FixedTrack:
    """What stays in place while the specimen drifts: ``mask`` (h, w), from as many comparisons as ``looks`` with the
    frame ``image``, ``since`` frames ago, at the drift ``drift_px`` (2,).
    """

    image: AnyImage | None = None
    drift_px: Array = field(default_factory=lambda: np.zeros(2))
    px_from_unit: Array = field(default_factory=lambda: np.eye(2))
    since: int = 0
    looks: int = 0
    mask: Mask | None = None


@dataclass
class _Track:
    """Everything that is known since the drift was zero.

    ``camera`` and ``time_s`` are those of the latest frame, ``sample`` is some of its pixels, and
    ``rejected`` is the number of frames in a row that did not match. ``doubt`` (2, 2) is what the last
    frames that contradict the prediction add to the covariance of the drift, until one matches. ``moving`` is what
    did not move with the specimen in the last frame that matched, ``own_motion`` its motion, measured by ``body``.
    ``before`` is the last frame as it came,
    ``overlay`` what is drawn into all of them, of which there were ``seen``, and ``fixed`` what else stays in place.
    Where the specimen shows lines only,
    ``along`` (2,) is their direction in px, ``unseen`` what was known before the first frame that did not tell the
    drift along them, ``of_unseen`` (2, 2) what that adds to the covariance of the last frame, and ``blind`` the
    keyframes that were made since, whose own place along the lines was only predicted.
    """

    filter: DriftFilter
    store: KeyframeStore
    camera: ScanCamera | None
    time_s: float
    sample: bytes
    outliers: OutlierTest = field(default_factory=OutlierTest)
    rejected: int = 0
    doubt: Array = field(default_factory=lambda: np.zeros((2, 2)))
    moving: MovingTiles | None = None
    own_motion: OwnMotion | None = None
    body: OwnMotionEstimator = field(default_factory=OwnMotionEstimator)
    before: AnyImage | None = None
    overlay: Mask | None = None
    seen: int = 0
    fixed: _FixedTrack = field(default_factory=_FixedTrack)
    along: Array | None = None
    unseen: DriftState | None = None
    of_unseen: Array = field(default_factory=lambda: np.zeros((2, 2)))
    blind: set[int] = field(default_factory=set)
    flicker: FlickerEstimator = field(default_factory=FlickerEstimator)
    similarity: SimilarityTracker = field(
        default_factory=lambda: SimilarityTracker(keeps_history=False)
    )

    def unseen_covariance(self, px_from_unit: Array) -> Array:
        """(2, 2) covariance of the drift along lines, which has only been predicted since they alone are seen."""
        if self.unseen is None or self.along is None:
            return np.zeros((2, 2))
        coasting = DriftPredictor(self.unseen, self.filter.process_noise, None)
        covariance = coasting.at(self.filter.state.time_s).covariance[:2, :2]
        direction = np.linalg.solve(px_from_unit, self.along)
        variance = float(self.along @ px_from_unit @ covariance @ px_from_unit.T @ self.along)
        return variance * np.outer(direction, direction)

    def inflate(self, inflation: Inflate) -> None:
        """Let the covariance grow, also that of what is only predicted since lines alone are seen."""
        self.filter.apply(inflation)
        if self.unseen is not None:
            self.unseen = inflation(self.unseen, self.filter.process_noise)

    def see_again(self) -> None:
        """Both directions are known again; keyframes that were made in between are not."""
        self.along = self.unseen = None
        for key in self.blind & set(self.store.keys):
            self.store.forget(key)
            self.forget(key)
        self.blind.clear()

    def forget(self, key: int) -> None:
        """Remove a keyframe from what is estimated."""
        self.filter.apply(Marginalise(key))
        self.similarity.forget(key)


@dataclass(frozen=True)
class _Match:
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
class _RejectedMatch:
    """A registration against a keyframe that is not used.

    ``disputed`` (2, 2) is what a shift that contradicts the prediction adds to the covariance of
    the drift: one of the two is wrong. It is None where the registration failed.
    """

    rejection: Rejection[MatchFailure]
    registration: Registration
    disputed: Array | None = None


class DriftTracker:
    """Tracks the drift of a stream of frames; :meth:`update` once per frame, in the order of their
    stamps.

    Parameters
    ----------
    settings
        How to track.
    history
        Where to keep what a smoother needs: some kB per frame.
    """

    def __init__(
        self, settings: DriftSettings | None = None, *, history: DriftHistory | None = None
    ) -> None:
        self.settings = settings or DriftSettings()
        self._corrector = MotionCorrector(self.settings.interpolation)
        self._history = history
        self._track: _Track | None = None

    def reset(self) -> None:
        """Forget everything: the next frame has zero drift."""
        self._track = None

    def predictor(self) -> DriftPredictor:
        """What is known now of the drift at times after that of the last frame.

        Raises
        ------
        InvalidValueError
            If there was no frame yet.
        """
        track = self._track
        if track is None:
            raise InvalidValueError(
                "a forecast before the first frame", expected="at least one frame"
            )
        state = track.filter.state.without_keyframes()
        similarity = track.similarity.predictor()
        return DriftPredictor(
            state,
            track.filter.process_noise,
            track.camera,
            similarity,
            doubt=track.doubt + track.of_unseen,
            measured=track.filter.measured > 0,
        )

    def update(
        self,
        image: AnyImage,
        time_s: float,
        camera: ScanCamera | None = None,
        timing: ScanTiming | None = None,
        *,
        rectified: bool = False,
    ) -> DriftUpdate:
        """Drift at this frame.

        Parameters
        ----------
        image
            (h, w) or (h, w, 3) image of integers or floats.
        time_s
            Start of its acquisition. A time before that of the last frame resets the tracker.
        camera
            Camera of this frame's magnification; None tracks in raw pixels. A stream that gains or
            loses its camera starts again, because its unit changes.
        timing
            Raster timing; None takes the frame as an instant at ``time_s``.
        rectified
            Whether the image already is in rectified pixels of ``camera``.

        Raises
        ------
        InvalidValueError
            If the time is not finite or the image has another shape or type.
        """
        if not np.isfinite(time_s):
            raise InvalidValueError(f"frame time {time_s} s", expected="a finite number")
        pixels = resampleable(image)
        height, width = pixels.shape[:2]
        fitted = None if camera is None else camera.resized(width, height)
        frame = ScanFrame(pixels, fitted, timing, rectified)
        centre_s = time_s + (timing.centre_offset_s if timing is not None else 0.0)
        track = self._track
        if track is not None and (
            centre_s < track.time_s or (track.camera is None) != (fitted is None)
        ):
            track = self._track = None
        if track is None or len(track.store) == 0:
            track, update = self._begin(frame, centre_s)
            self._track = track
        else:
            self._look_for_overlay(track, frame)
            frame = _without_fixed(track, frame)
            self._predict(track, frame, centre_s)
            update = self._follow(track, frame)
            if update.accepted and self._look_for_fixed(track, frame, pixels):
                # What was found has pulled this frame, too.
                track.sample = b""
                frame = _without_fixed(track, frame)
                update = self._follow(track, frame)
        if track.seen < _FIRST_LOOKS or (track.seen + 1) % _LOOK_EVERY == 0:
            track.before = pixels.copy()
        track.filter.mark_frame()
        track.similarity.mark_frame(track.filter.state.time_s)
        track.camera, track.time_s = fitted, centre_s
        track.of_unseen = track.unseen_covariance(frame.px_from_unit)
        if self._history is not None:
            self._history.add(update, fitted)
        return update

    def _look_for_overlay(self, track: _Track, frame: ScanFrame) -> None:
        """Look for what is drawn into the frames; the first time, the keyframes are freed of it."""
        track.seen += 1
        looks = track.seen <= _FIRST_LOOKS or track.seen % _LOOK_EVERY == 0
        if looks and track.before is not None and not np.array_equal(track.before, frame.image):
            found = find_overlay(track.before, frame.image)
            is_new = found is not None and track.overlay is None
            track.overlay = found
            if is_new:
                self._clean_keyframes(track)

    def _look_for_fixed(self, track: _Track, frame: ScanFrame, pixels: AnyImage) -> bool:
        """Look for what stays in place between a frame that was measured, as it came (``pixels``), and an earlier one,
        once the specimen has moved; the keyframes are freed of what is new. Whether there was any.
        """
        is_new = False
        fixed, drift_px = track.fixed, frame.px_from_unit @ track.filter.state.position
        fixed.since += 1
        if (
            fixed.image is not None
            and fixed.image.shape == pixels.shape
            and np.allclose(fixed.px_from_unit, frame.px_from_unit)
        ):
            every = min(1 + max(0, fixed.looks - _FIXED_FIRST), _FIXED_LATER)
            moved_px = drift_px - fixed.drift_px
            if fixed.since < every or np.hypot(*moved_px) < LEAST_MOVE_PX:
                return False
            fixed.looks += 1
            found = find_fixed_parts(fixed.image, pixels, moved_px)
            if found is not None:
                known = np.zeros_like(found.stays) if fixed.mask is None else fixed.mask
                fixed.mask = found.stays | (known & ~found.moves)
                # What is drawn is left out already.
                stays, drawn = found.stays, track.overlay
                if drawn is not None and drawn.shape == stays.shape:
                    stays = stays & ~drawn
                is_new = float(np.mean(stays & ~known)) > _NEWLY_FIXED
                if is_new:
                    # What stays pulls to where it is: by its part of the structure.
                    pulled_px = share_of_gradients(pixels, stays) * moved_px
                    moved = np.linalg.solve(frame.px_from_unit, pulled_px)
                    track.filter.widen_measurements(np.outer(moved, moved))
                    self._clean_keyframes(track)
        elif fixed.mask is not None and fixed.mask.shape != pixels.shape[:2]:
            fixed.mask = None
        fixed.image, fixed.drift_px, fixed.since = pixels.copy(), drift_px, 0
        fixed.px_from_unit = frame.px_from_unit
        return is_new

    def _clean_keyframes(self, track: _Track) -> None:
        """Free all keyframes of what is now known not to be the specimen."""
        for key in track.store.keys:
            old = track.store[key]
            frame = _without_fixed(track, old.frame)
            if frame is not old.frame:
                self._remake_keyframe(track, key, frame, old.removed)

    def _remake_keyframe(self, track: _Track, key: int, frame: ScanFrame, removed: Array) -> None:
        """Replace a keyframe by one of a single frame, freed of a motion."""
        track.store.replace(key, self._single(frame, removed, track.store[key]))

    def _single(self, frame: ScanFrame, removed: Array, old: Keyframe) -> Keyframe:
        """A keyframe of a single frame, freed of a motion, in the place of another one."""
        image, region = self._corrector.corrected_image(frame, removed, old.turn)
        fixed = self._corrector.corrected_mask(frame, removed, old.turn)
        return make_keyframe(frame, removed, image, region, old.time_s, old.turn, fixed)

    # -- the first frame --------------------------------------------------------------------------

    def _begin(self, frame: ScanFrame, centre_s: float) -> tuple[_Track, DriftUpdate]:
        """Start with zero drift."""
        settings = self.settings
        start = initial_state(centre_s, centre_covariance(frame.camera))
        kept = self._history is not None
        drift_filter = DriftFilter(start, settings.acceleration_psd, history=kept)
        similarity = SimilarityTracker(keeps_history=kept)
        if self._history is not None:
            self._history.begin(drift_filter, similarity)
        store = KeyframeStore(
            settings.registration, settings.max_keyframe_bytes, settings.max_keyframes
        )
        track = _Track(
            drift_filter, store, frame.camera, centre_s, frame.sample, similarity=similarity
        )
        rejection = self._add_keyframe(track, frame, np.zeros(4))
        if rejection is not None:
            # Nothing can be measured against such an image: wait for a better one.
            return track, _make_update(track, frame, DriftStatus.COASTING, rejection)
        return track, _make_update(track, frame, DriftStatus.KEYFRAME, overlap=1.0)

    def _add_keyframe(
        self, track: _Track, frame: ScanFrame, removed: Array
    ) -> Rejection[MatchFailure] | None:
        """Make this frame a keyframe that was not measured; why it cannot be one, or None."""
        turn, time_s = track.similarity.position, track.filter.state.time_s
        keyframe, reference = self._prepare_keyframe(track, frame, removed)
        if reference.defect:
            return Rejection(MatchFailure.UNUSABLE_IMAGE, reference.defect)
        key, forgotten = track.store.add(keyframe, reference)
        track.filter.add_keyframe(key, removed, frame.acceleration_term_s2)
        track.similarity.add_keyframe(key, turn, time_s)
        if track.unseen is not None:
            track.blind.add(key)
        for old in forgotten:
            track.forget(old)
        return None

    def _prepare_keyframe(
        self, track: _Track, frame: ScanFrame, removed: Array
    ) -> tuple[Keyframe, Reference]:
        """A frame as a keyframe, and the reference that it would be."""
        turn, time_s = track.similarity.position, track.filter.state.time_s
        image, region = self._corrector.corrected_image(frame, removed, turn, track.similarity.rate)
        fixed = self._corrector.corrected_mask(frame, removed, turn, track.similarity.rate)
        keyframe = make_keyframe(frame, removed, image, region, time_s, turn, fixed)
        return keyframe, keyframe.prepare_reference(self.settings.registration)

    # -- every other frame ------------------------------------------------------------------------

    def _predict(self, track: _Track, frame: ScanFrame, centre_s: float) -> None:
        """Predict the state at the time of the frame."""
        drift_filter = track.filter
        dt = centre_s - drift_filter.state.time_s
        if (
            drift_filter.measured == 0
            and dt > 0.0
            and not np.any(drift_filter.state.drift_covariance[2:, 2:])
        ):
            # The second frame tells the interval, and how far drift gets in it is all that is known
            # of the velocity.
            unit_from_px = np.linalg.inv(frame.px_from_unit)
            step = self.settings.first_step_px * float(np.linalg.norm(unit_from_px, 2))
            drift_filter.set_motion_prior(step / dt, (_VELOCITY_CHANGE * step) ** 2 / dt**3, dt)
        speed = float(np.hypot(*drift_filter.state.velocity))
        drift_filter.apply(Predict(centre_s))
        track.similarity.predict(centre_s)
        if 0.0 < _PAUSE * drift_filter.process_noise.time_constant_s < dt:
            track.inflate(inflate_after_pause(speed, dt))

    def _follow(self, track: _Track, frame: ScanFrame) -> DriftUpdate:
        """Register the frame against the best keyframes, until one of them holds."""
        settings = self.settings
        sample = frame.sample
        is_repeated, track.sample = sample == track.sample, sample
        candidates = track.store.candidates(
            track.filter.state, frame, settings.rekey_overlap, settings.max_ratio
        )
        if not candidates:
            ratio = track.store.smallest_scale_ratio(frame)
            reason = f"scale changed by a factor of {ratio:.2f}"
            return self._restart(track, frame, Rejection(MatchFailure.SCALE_CHANGE, reason))
        if track.unseen is not None:
            # What was seen in both directions can tell them again.
            candidates = sorted(candidates, key=lambda c: c.key in track.blind)
        # Where nothing matched before, the image may be that of any of them.
        is_steady = track.rejected == 0 and track.filter.pending is None
        rejected: list[_RejectedMatch] = []
        for candidate in candidates[: _CANDIDATES if is_steady else 2 * _CANDIDATES]:
            match = self._match(track, frame, candidate)
            if isinstance(match, _Match) and is_repeated:
                # Noise never comes twice: the scan is paused, or the driver sent the frame again.
                reason = "image: the same as the previous frame"
                repeated = Rejection(MatchFailure.REPEATED_IMAGE, reason)
                match = _RejectedMatch(repeated, match.registration)
            if isinstance(match, _Match):
                match = self._free_of_pull(track, frame, match)
                refused = self._use(track, frame, match)
                if refused is None:
                    return self._finish(track, frame, match)
                match = refused
            rejected.append(match)
        return self._coast(track, frame, rejected, candidates[0].rescaled)

    # -- matching ---------------------------------------------------------------------------------

    def _match(
        self, track: _Track, frame: ScanFrame, candidate: Candidate
    ) -> _Match | _RejectedMatch:
        """Register a frame, and again without the shear that a wrong velocity has left in it.

        The noise of a keyframe that nothing was compared with before becomes known to the filter.
        """
        motion = track.filter.state.motion
        first = motion if _is_removable(motion, frame) else np.zeros(4)
        turn = track.similarity.expected_turn(candidate.key)
        match = self._match_once(track, frame, candidate, first, turn)
        match = self._match_turned(track, frame, candidate, match, first, turn)
        for _ in range(_MAX_REGISTRATIONS - 1):
            if isinstance(match, _RejectedMatch):
                break
            state = match.measure(track.filter.state, track.filter.process_noise).state
            if not _is_removable(state.motion, frame):
                # A jump, not a drift: the gate decides.
                break
            corrected = self._correct_keyframe(track, candidate, state)
            turned = match.similarity.remaining_px(frame.size) > _MAX_TURN_PX
            moved = exceeds_tolerance(state.motion - match.removed, frame)
            if not (corrected or moved or turned):
                break
            again = self._match_once(track, frame, candidate, state.motion, match.similarity.turn)
            if isinstance(again, _RejectedMatch):
                break
            match = again
        return match

    def _match_turned(
        self,
        track: _Track,
        frame: ScanFrame,
        candidate: Candidate,
        before: _Match | _RejectedMatch,
        motion: Array,
        turn: Array,
    ) -> _Match | _RejectedMatch:
        """Register a frame again without the rotation and the scale that the registration ``before``
        shows, where it shows any; the better match of the two.
        """
        similarity, key = track.similarity, candidate.key
        if candidate.rescaled or not self.settings.similarity:
            return before
        if isinstance(before, _Match):
            time_s, last_s = track.filter.state.time_s, track.time_s
            suggested = similarity.confirm_turn(before.registration, turn, frame, time_s, last_s)
        else:
            suggested = similarity.suggest_turn(key, before.registration, turn, frame)
        if suggested is None:
            return before
        if similarity.is_active:
            match = self._match_once(track, frame, candidate, motion, suggested)
            return match if isinstance(match, _Match) else before
        mean = track.store[key]
        similarity.activate(key, suggested, track.filter.state.time_s)
        self._forget_mean(track, key)
        match = self._match_once(track, frame, candidate, motion, suggested)
        if isinstance(match, _RejectedMatch):
            similarity.deactivate()
            track.store.replace(key, mean)
            return before
        for other in similarity.keys:
            if other != key:
                self._forget_mean(track, other)
        return match

    def _free_of_pull(self, track: _Track, frame: ScanFrame, match: _Match) -> _Match:
        """The match against means that nothing has pulled, where something is found to move by itself.

        As long as it had moved by little, it was taken for the specimen, and pulled the frames that were added to a
        mean. Where the first frame of the keyframe asks for another shift than the mean does, all means are given up.
        """
        key, before = match.candidate.key, match.registration
        old = track.store[key]
        is_new = track.moving is None or old.averaged in MEAN_COUNTS
        if before.moving is None or not is_new or match.candidate.rescaled or old.averaged == 1:
            return match
        first = self._single(old.frame, old.removed, old).prepare_reference(
            self.settings.registration
        )
        found = register(
            first,
            match.image,
            guess_px=before.shift_px,
            guess_covariance=before.covariance + np.eye(2) * _MOST_PULLED_PX**2,
            image_region=match.region,
            max_shear_px=_MAX_SHEAR * frame.size[1],
            suspected=before.moving,
            fixed=match.fixed,
        )
        pulled_px = found.shift_px - before.shift_px
        if (
            not found.accepted
            or float(pulled_px @ np.linalg.solve(found.covariance, pulled_px)) < _PULLED_CHI2
        ):
            return match
        means = {k: track.store[k] for k in track.store.keys}
        for k in means:
            self._forget_mean(track, k)
        again = self._match_once(
            track, frame, match.candidate, match.removed, match.similarity.turn
        )
        if isinstance(again, _RejectedMatch):
            for k, mean in means.items():
                track.store.replace(k, mean)
            return match
        pulled = np.linalg.solve(frame.px_from_unit, pulled_px)
        track.filter.widen_measurements(np.outer(pulled, pulled))
        return again

    def _forget_mean(self, track: _Track, key: int) -> None:
        """Go back to the first frame of a keyframe: the mean is of frames that were turned, or pulled."""
        old = track.store[key]
        if old.averaged > 1:
            self._remake_keyframe(track, key, old.frame, old.removed)

    def _match_once(
        self, track: _Track, frame: ScanFrame, candidate: Candidate, motion: Array, turn: Array
    ) -> _Match | _RejectedMatch:
        """Register a frame that is corrected for a motion, a rotation and a scale."""
        store, key = track.store, candidate.key
        rate = track.similarity.rate
        image, region = self._corrector.corrected_image(frame, motion, turn, rate)
        fixed = self._corrector.corrected_mask(frame, motion, turn, rate)
        reference = (
            store.resampled_reference(key, frame) if candidate.rescaled else store.reference(key)
        )
        shift, covariance = track.filter.state.predict_shift(key)
        px_from_unit, is_turned = frame.px_from_unit, track.similarity.is_active
        appears = track.similarity.keyframe_similarity(key)
        if is_turned:
            px_from_unit = similarity_matrix(appears) @ px_from_unit
        covariance = covariance + track.unseen_covariance(px_from_unit)
        registration = register(
            reference,
            image,
            guess_px=px_from_unit @ shift,
            guess_covariance=px_from_unit @ covariance @ px_from_unit.T,
            image_region=region,
            max_shear_px=_MAX_SHEAR * frame.size[1],
            suspected=track.moving,
            takes_lines=True,
            fixed=fixed,
        )
        if registration.rejection is not None:
            return _RejectedMatch(registration.rejection, registration)
        keyframe = store[key]
        averaged = np.inf if candidate.rescaled else float(store.averaged(key))
        similarity = track.similarity.match(
            key, registration, turn, frame, averaged, measures=not candidate.rescaled
        )
        measured = registration
        if is_turned:
            measured = constrain_registration(registration, similarity, appears, frame)
        measure = make_measurement(key, keyframe.frame, frame, measured, motion, averaged)
        if track.filter.pending == key:
            track.filter.set_keyframe_noise(keyframe_noise(measure), measure.scan_s)
        return _Match(
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

    def _correct_keyframe(self, track: _Track, candidate: Candidate, state: DriftState) -> bool:
        """Take the shear out of a keyframe; whether there was any. Only a single frame has one."""
        keyframe = track.store[candidate.key]
        velocity = state.keyframe_state(candidate.key)[2:]
        remaining = np.append(velocity, np.zeros(2))
        removed = keyframe.removed + remaining
        if (
            candidate.rescaled
            or keyframe.averaged > 1
            or not exceeds_tolerance(remaining, keyframe.frame)
            # A stage that jumped, or a wrong match: no velocity that a scan could be freed from.
            or not _is_removable(removed, keyframe.frame)
        ):
            return False
        self._remake_keyframe(track, candidate.key, keyframe.frame, removed)
        term_s2 = keyframe.frame.acceleration_term_s2
        track.filter.apply(CorrectShear(candidate.key, remaining, term_s2))
        return True

    # -- measuring --------------------------------------------------------------------------------

    def _use(self, track: _Track, frame: ScanFrame, match: _Match) -> _RejectedMatch | None:
        """Update the filter by a match, unless it contradicts the prediction."""
        drift_filter, measure = track.filter, match.measure
        along = match.registration.along
        state = drift_filter.state
        # A keyframe of lines says nothing of the drift along them, whatever came into the picture since.
        sees_again = along is None and track.unseen is not None and measure.key not in track.blind
        anywhere = inflate_position(track.unseen_covariance(frame.px_from_unit))
        if sees_again:
            state = anywhere(state, drift_filter.process_noise)
        expected, _ = state.predict_shift(measure.key)
        innovation = measure.shift[:2] - expected
        keyframe = track.store[measure.key]
        zoomed = measure
        if match.candidate.rescaled:
            zoomed = add_zoom_uncertainty(measure, keyframe.frame, frame)
        outcome = zoomed(state, drift_filter.process_noise)
        judged = judge_shift(
            track.outliers,
            state,
            measure,
            outcome.nis,
            frame,
            share=match.registration.share,
            is_first=drift_filter.measured == 0,
            last_s=track.time_s,
            first_step_px=self.settings.first_step_px,
            max_jump=self.settings.max_jump,
        )
        if isinstance(judged, Rejection):
            deviation = innovation / _DISPUTED_SIGMAS
            disputed = np.outer(deviation, deviation)
            return _RejectedMatch(judged, match.registration, disputed)
        if sees_again:
            drift_filter.apply(anywhere)
            track.see_again()
        if judged is not None:
            track.inflate(judged)
        if along is not None:
            track.along = along
            if track.unseen is None:
                track.unseen = drift_filter.state.without_keyframes()
        since_s = state.time_s - track.time_s
        track.similarity.use(match.similarity, since_s)
        if outcome.shear_nis > GATE:
            measure = measure.without_shear()
        if match.candidate.ratio > _SMALL_ZOOM:
            measure = self._change_scale(track, frame, match, replace(measure, zoom=zoomed.zoom))
        elif match.candidate.rescaled:
            # A zoom in small steps would make a long chain of keyframes.
            measure = zoomed
        drift_filter.update(measure)
        # Of two directions, one was the predicted one.
        nis = outcome.nis if along is None else 2.0 * outcome.nis
        drift_filter.adapt_process_noise(nis, measure.covariance[:2, :2], since_s)
        if not match.candidate.rescaled:
            self._look_for_flicker(track, frame, match)
        return None

    def _look_for_flicker(self, track: _Track, frame: ScanFrame, match: _Match) -> None:
        """Estimate again what drift faster than the frames does to them, at growing intervals."""
        averaged = float(track.store.averaged(match.candidate.key))
        if not track.flicker.add(match.registration, averaged, frame.size):
            return
        variance_px2 = track.flicker.variance_px2()
        unit = 1.0 / np.sqrt(abs(np.linalg.det(frame.px_from_unit)))
        frame_s = 1.0 if frame.timing is None else frame.timing.frame_time_s
        flicker = variance_px2 * unit**2 / np.array([1.0, 1.0, frame_s**2, frame_s**2])
        if not np.array_equal(flicker, track.filter.process_noise.flicker):
            track.filter.set_flicker(flicker)

    def _change_scale(
        self, track: _Track, frame: ScanFrame, match: _Match, measure: Measure
    ) -> Measure:
        """Make this frame the keyframe of its magnification, by way of one of another; its
        measurement against itself.
        """
        before, now = track.store[measure.key].frame.camera, frame.camera
        assert before is not None and now is not None
        noise = zoom_covariance(before, now) + measure.covariance[:2, :2] * _COPY_NOISE
        key = _rekey(track, frame, match, measure, noise)
        return measure_itself(key, measure, match.removed)

    # -- afterwards -------------------------------------------------------------------------------

    def _finish(self, track: _Track, frame: ScanFrame, match: _Match) -> DriftUpdate:
        """Choose the keyframe for the frames that follow, and improve its mean."""
        store, state = track.store, track.filter.state
        track.rejected = 0
        track.doubt = np.zeros((2, 2))
        track.outliers.reset(state)
        registration, candidate = match.registration, match.candidate
        track.moving = registration.moving
        track.own_motion = self._follow_body(track, frame, match)
        if candidate.ratio > _SMALL_ZOOM:
            return _make_update(track, frame, DriftStatus.KEYFRAME, registration=registration)
        store.use(candidate.key)
        status, merged = DriftStatus.TRACKED, False
        overlap, enough = registration.alignment.overlap, self.settings.rekey_overlap
        is_changed = registration.correlation < _MIN_CORRELATION
        if is_changed or overlap < enough:
            following = store.candidates(state, frame, enough, _SMALL_ZOOM)
            if is_changed or following[0].overlap < enough:
                share = _COPY_NOISE + _COPY_NOISE_BESIDE * (1.0 - min(overlap, 1.0))
                noise = match.measure.covariance[:2, :2] * share
                measure = match.measure
                if candidate.rescaled:
                    before = store[candidate.key].frame
                    measure = add_zoom_uncertainty(measure, before, frame)
                _rekey(track, frame, match, measure, noise)
                status = DriftStatus.KEYFRAME
        elif self.settings.average and track.unseen is None and _is_mergeable(match, store):
            # Not of lines alone: what came into the picture since would be where it was predicted to be.
            keyframe = store[candidate.key]
            mean = keyframe.with_frame(match.image, match.region, registration, match.apart)
            store.replace(candidate.key, mean)
            merged = True
        update = _make_update(track, frame, status, registration=registration)
        return replace(update, keyframe_time_s=match.keyframe_time_s, merged=merged)

    def _follow_body(self, track: _Track, frame: ScanFrame, match: _Match) -> OwnMotion | None:
        """The own motion of what does not move with the specimen."""
        moving, state = match.registration.moving, track.filter.state
        if moving is None or track.similarity.is_active:
            return track.body.update(None)
        return track.body.update(
            BodyFrame(
                match.image, match.region, moving, state.position, frame.px_from_unit, state.time_s
            )
        )

    def _coast(
        self, track: _Track, frame: ScanFrame, rejected: list[_RejectedMatch], rescaled: bool
    ) -> DriftUpdate:
        """Keep the prediction, with a larger covariance where the image contradicts it; start
        again from it where the frame or its scale is lost.
        """
        # The first one is that of the best keyframe.
        rejection, registration = rejected[0].rejection, rejected[0].registration
        doubt = self._doubt(track, frame, rejected)
        if doubt is not None:
            track.doubt = doubt
        track.own_motion = track.body.update(None)
        # A blanked beam says nothing about the keyframe.
        is_of_keyframe = rejection.status not in IMAGE_FAILURES
        track.rejected += is_of_keyframe
        state = track.filter.state
        since_s = max(state.time_s - track.time_s, _MIN_INTERVAL_S)
        is_lost = track.rejected >= self.settings.lost_after
        if is_lost:
            reach_px = self._reach_px(frame)
            speed_px_s = self.settings.first_step_px / since_s
            track.inflate(inflate_when_lost(frame.px_from_unit, reach_px, speed_px_s))
        else:
            nearest = np.asarray(np.linalg.solve(frame.px_from_unit, registration.nearest_px))
            inflation = inflate_if_contradicted(state, track.store.current, nearest, since_s)
            if inflation is not None:
                track.inflate(inflation)
        if is_lost or (rescaled and is_of_keyframe):
            return self._restart(track, frame, rejection)
        return _make_update(
            track, frame, DriftStatus.COASTING, rejection, registration=registration
        )

    def _reach_px(self, frame: ScanFrame) -> float:
        """How far away the place may be that an image shows which matches nothing."""
        return self.settings.max_jump * max(frame.size)

    def _doubt(
        self, track: _Track, frame: ScanFrame, rejected: list[_RejectedMatch]
    ) -> Array | None:
        """By how much, as a (2, 2) covariance, the drift may be off where an image does not match; None
        where the image says nothing about that.
        """
        disputed = next((r.disputed for r in rejected[::-1] if r.disputed is not None), None)
        if disputed is not None:
            return disputed
        best = rejected[0]
        if best.rejection.status not in _ELSEWHERE:
            return None
        if best.rejection.status is MatchFailure.NO_PEAK:
            motion = track.filter.state.motion
            removed = motion if _is_removable(motion, frame) else np.zeros(4)
            if self._prepare_keyframe(track, frame, removed)[1].defect:
                # Noise matches nothing, wherever the specimen is.
                return None
        unit = np.linalg.inv(frame.px_from_unit) * self._reach_px(frame)
        return np.asarray(unit @ unit.T)

    def _restart(
        self,
        track: _Track,
        frame: ScanFrame,
        rejection: Rejection[MatchFailure],
    ) -> DriftUpdate:
        """Go on from the predicted drift with this frame as keyframe."""
        unmatched = track.filter.pending
        defect = self._add_keyframe(track, frame, track.filter.state.motion)
        if defect is None:
            if unmatched is not None and len(track.store) > 2:
                # No frame has ever matched it.
                track.store.forget(unmatched)
                track.forget(unmatched)
            track.rejected = 0
            track.outliers.reset()
        return _make_update(
            track,
            frame,
            DriftStatus.COASTING,
            defect or rejection,
            restarted=defect is None,
        )


def _is_removable(motion: Array, frame: ScanFrame) -> bool:
    """Whether a motion can be that of a specimen during a frame."""
    if frame.timing is None:
        return True
    shear_px = np.abs(frame.px_from_unit @ motion[:2]) * frame.timing.frame_time_s
    return float(np.max(shear_px)) <= _MAX_SHEAR * frame.size[1]


def _is_mergeable(match: _Match, store: KeyframeStore) -> bool:
    """Whether a frame makes the mean of its keyframe better."""
    registration, candidate = match.registration, match.candidate
    alignment = registration.alignment
    shear_px = np.abs(np.nan_to_num(alignment.joint_px[2:], nan=0.0))
    sigma_px = np.sqrt(np.diag(alignment.joint_covariance)[2:])
    # A few particles tell a shear badly: what they leave open is none.
    shows_shear = shear_px > _MAX_MERGE_SHEAR_PX + _OPEN_SIGMAS * np.where(
        np.isfinite(sigma_px), sigma_px, 0.0
    )
    return (
        not candidate.rescaled
        and store.has_room(candidate.key, alignment.overlap)
        and registration.correlation > _MIN_MERGE_CORRELATION
        and _MERGE_GAINS[0] < registration.contrast < _MERGE_GAINS[1]
        and not np.any(shows_shear)
        and float(np.max(shear_px)) < _MAX_BLUR_PX
        and float(np.max(np.diag(registration.covariance))) < _MAX_PLACE_PX**2
        # A mean that is pulled stays so, and all that is registered against it.
        and (not alignment.may_be_pulled or _seems_turned(registration))
    )


def _seems_turned(registration: Registration) -> bool:
    """Whether a rotation is seen, which displaces parts of the image as something that moves by itself does."""
    fit = registration.fit_similarity()
    return fit is not None and bool(fit.values[4] ** 2 > _TURNED_SIGMAS**2 * fit.covariance[4, 4])


def _rekey(track: _Track, frame: ScanFrame, match: _Match, measure: Measure, noise: Array) -> int:
    """Make this frame a keyframe, as it was measured against the one before; its number."""
    state = track.filter.state
    turn = match.similarity.removed
    keyframe = make_keyframe(
        frame, match.removed, match.image, match.region, state.time_s, turn, match.fixed
    )
    key, forgotten = track.store.add(keyframe)
    track.filter.apply(clone_keyframe(key, state, measure, match.removed, noise))
    if match.candidate.rescaled:
        track.similarity.add_keyframe(key, turn, state.time_s)
    else:
        track.similarity.clone_keyframe(key, measure.key, match.registration, turn, state.time_s)
    if track.unseen is not None:
        track.blind.add(key)
    for old in forgotten:
        track.forget(old)
    return key


def _without_fixed(track: _Track, frame: ScanFrame) -> ScanFrame:
    """The frame with the place of what does not show the specimen filled from around, as far as it is known."""
    masks = [m for m in (track.overlay, track.fixed.mask) if m is not None]
    masks = [m for m in masks if m.shape == frame.image.shape[:2]]
    fixed = np.logical_or.reduce(masks) if masks else np.zeros(1, dtype=bool)
    if not np.any(fixed):
        return frame
    return replace(frame, image=remove_overlay(frame.image, fixed), fixed=fixed)


def _make_update(
    track: _Track,
    frame: ScanFrame,
    status: DriftStatus,
    rejection: Rejection[MatchFailure] | None = None,
    *,
    registration: Registration | None = None,
    overlap: float = float("nan"),
    restarted: bool = False,
) -> DriftUpdate:
    """The drift at a frame; ``overlap`` is for a frame without a registration."""
    state = track.filter.state
    motion, covariance = (
        (state.position, state.velocity, state.acceleration),
        state.drift_covariance,
    )
    is_first = registration is None and rejection is None
    similarity = track.similarity.estimate(registration, frame, is_first=is_first)
    if track.similarity.is_active:
        turned = turn_drift(*motion, covariance, similarity)
        motion = turned.position, turned.velocity, turned.acceleration
        covariance = turned.covariance
    of_scale = scale_covariance(frame.camera, motion[0], motion[1])
    covariance = covariance + of_scale
    if not is_first:
        covariance[:2, :2] += track.filter.process_noise.flicker_covariance
    unseen = track.unseen_covariance(frame.px_from_unit)
    covariance[:2, :2] += track.doubt + unseen
    if track.filter.measured == 0:
        covariance = forget_prior(covariance, is_first=is_first)
    alignment = None if registration is None else registration.alignment
    return DriftUpdate(
        time_s=state.time_s,
        drift_m=motion[0].copy(),
        velocity_m_s=motion[1].copy(),
        acceleration_m_s2=motion[2].copy(),
        covariance=covariance,
        status=status,
        rejection=rejection,
        residual=float("nan") if alignment is None else alignment.residual_rms,
        px_from_unit=frame.px_from_unit,
        overlap=overlap if alignment is None else alignment.overlap,
        calibrated=frame.camera is not None,
        restarted=restarted,
        shear_px=np.full(2, np.nan) if alignment is None else alignment.joint_px[2:],
        shear_covariance=(
            np.full((2, 2), np.inf) if alignment is None else alignment.joint_covariance[2:, 2:]
        ),
        keyframe_time_s=float("nan"),
        merged=False,
        similarity=similarity.mean,
        similarity_covariance=similarity.covariance,
        doubt=track.doubt,
        unseen=unseen,
        along=track.along,
        moving=None if registration is None else registration.moving,
        own_motion=track.own_motion,
        fixed=None if frame.fixed is None else MovingTiles.of_pixels(frame.fixed),
        of_scale=of_scale[:2, :2],
    )
