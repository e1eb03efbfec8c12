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

All of it is :func:`step`: from what is known before a frame to what is known after it
(:class:`~semcal_ros.core.drift.tracker_state.TrackerState`, which never changes), with the drift at the frame.
:class:`DriftTracker` holds the state for those who have a stream.

Drift is the displacement of the specimen: what lay at X in the first frame is seen at X + drift.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.camera_uncertainty import centre_covariance, visit_scale_variance
from semcal_ros.core.drift.estimates import DriftPredictor, DriftStatus, DriftUpdate
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.filter_update import use_match
from semcal_ros.core.drift.frame import MotionCorrector, ScanFrame, resampleable
from semcal_ros.core.drift.gating import inflate_after_pause, inflate_position
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.keyframe_store import KeyframeStore
from semcal_ros.core.drift.matching import Match, RejectedMatch, free_of_pull, match_keyframe
from semcal_ros.core.drift.new_keyframes import add_keyframe, renew_keyframe
from semcal_ros.core.drift.operations import Predict
from semcal_ros.core.drift.recovery import coast, find_place_again, leave_place, restart
from semcal_ros.core.drift.remade_keyframes import clean_keyframes
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.similarity import SimilarityState
from semcal_ros.core.drift.state import initial_state
from semcal_ros.core.drift.static_parts import StaticParts
from semcal_ros.core.drift.stripes import Stripes
from semcal_ros.core.drift.thresholds import (
    CANDIDATES,
    FIXED_PULL_MIN,
    LONE_LINE_CHI2_MIN,
    PAUSE_MIN,
    STRIPE_CELLS_MIN,
    STRIPE_CELLS_TRIED,
    STRIPE_CHI2_MIN,
    STRIPE_MOVE_PX_MAX,
    STRIPE_TRIES,
    VELOCITY_CHANGE,
    ZOOM_MIN,
)
from semcal_ros.core.drift.torn_frames import TearTest
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState, make_update
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.registration.failures import STRIPE_FAILURES, MatchFailure

# Noise never comes twice: the scan is paused, or the driver sent the frame again.
_REPEATED_IMAGE = Rejection(MatchFailure.REPEATED_IMAGE, "image: the same as the previous frame")
_REPEATED_TIME = Rejection(
    MatchFailure.REPEATED_TIME,
    "time: the same as that of the previous frame, before any drift is known: give each frame its own stamp",
)


def step(
    setup: TrackerSetup, state: TrackerState | None, frame: ScanFrame, time_s: float
) -> tuple[TrackerState, DriftUpdate]:
    """One frame: from what is known before it to what is known after it, and the drift at it.

    Parameters
    ----------
    setup
        What the tracker was told.
    state
        What is known; None before the first frame. It does not change.
    frame
        The frame.
    time_s
        Centre of its acquisition. A time before that of the last frame begins anew, and so does a stream that gains or
        loses its camera, because its unit changes; the update says ``restarted``.
    """
    raw = frame.image
    if state is None or not state.goes_on_with(frame, time_s):
        # Without a keyframe, no drift was counted from a frame before.
        restarted = state is not None and len(state.keyframes) > 0
        state, update = _begin(setup, frame, time_s, restarted=restarted)
    else:
        state = replace(state, tears=state.tears.look_at(raw))
        state = _look_for_overlay(setup, state, frame)
        frame = state.static.remove_from(frame)
        state = _note_zoom(_predict(setup, state, frame, time_s), frame)
        before = state
        state, update = _follow(setup, state, frame)
        state, update, frame = _follow_without_stripes(setup, before, raw, (state, update, frame))
        if update.accepted:
            state, is_pulled = _look_for_fixed(setup, state, frame, raw)
            if is_pulled:
                frame = state.static.remove_from(frame)
                state, update = _follow(setup, state, frame)
    return _conclude(state, frame, raw, time_s), update


def _begin(
    setup: TrackerSetup, frame: ScanFrame, time_s: float, *, restarted: bool
) -> tuple[TrackerState, DriftUpdate]:
    """Start with zero drift; ``restarted`` says whether the drift was counted from another frame before."""
    start = initial_state(time_s, centre_covariance(frame.camera))
    psd, kept = setup.settings.acceleration_psd, setup.keeps_history
    state = TrackerState(
        filter=DriftFilter.begin(start, psd, keeps_history=kept),
        similarity=SimilarityState(keeps_history=kept),
        keyframes=KeyframeStore(),
        camera=frame.camera,
        time_s=time_s,
        sample=frame.sample,
        tears=TearTest().look_at(frame.image),
    )
    state, rejection = add_keyframe(setup, state, frame, np.zeros(4))
    if rejection is not None:
        # Nothing can be measured against such an image: wait for a better one.
        coasting = DriftStatus.COASTING
        return state, make_update(state, frame, coasting, rejection, restarted=restarted)
    return state, make_update(state, frame, DriftStatus.KEYFRAME, overlap=1.0, restarted=restarted)


def _look_for_overlay(setup: TrackerSetup, state: TrackerState, frame: ScanFrame) -> TrackerState:
    """Look for what is drawn into the frames; the first time, the keyframes are freed of it."""
    if state.tears.share > 0.0:
        # A part of a torn frame is the same as before, too.
        return state
    static, is_new = state.static.look_for_overlay(frame.image)
    state = replace(state, static=static)
    return clean_keyframes(setup, state) if is_new else state


def _predict(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, time_s: float
) -> TrackerState:
    """Predict the state at the time of the frame."""
    drift_filter = state.filter
    dt = time_s - drift_filter.state.time_s
    if dt > 0.0 and not drift_filter.knows_motion:
        # The second frame tells the interval, and how far drift gets in it is all that is known
        # of the velocity.
        unit_from_px = np.linalg.inv(frame.px_from_unit)
        first = setup.settings.first_step_px * float(np.linalg.norm(unit_from_px, 2))
        psd = (VELOCITY_CHANGE * first) ** 2 / dt**3
        drift_filter = drift_filter.set_motion_prior(first / dt, psd, dt)
    speed = float(np.hypot(*drift_filter.state.velocity))
    state = replace(
        state,
        filter=drift_filter.apply(Predict(time_s)),
        similarity=state.similarity.predict(time_s),
    )
    if 0.0 < PAUSE_MIN * drift_filter.process_noise.time_constant_s < dt:
        state = state.inflate(inflate_after_pause(speed, dt))
    # Two frames are never taken at once: one with the time of the frame before was taken up to an interval later.
    late_s = drift_filter.interval_s if dt == 0.0 and frame.sample != state.sample else 0.0
    reach = speed * max(late_s, state.late_s)
    if reach > 0.0:
        state = state.inflate(inflate_position(np.eye(2) * reach**2))
    return replace(state, late_s=late_s, jump=np.zeros((2, 2)))


def _note_zoom(state: TrackerState, frame: ScanFrame) -> TrackerState:
    """Note that the magnification was changed before the frame, if it was."""
    before, now = state.camera, frame.camera
    if before is None or now is None:
        return state
    ratio = (now.m * before.width) / (before.m * now.width)
    if max(ratio, 1.0 / ratio) <= ZOOM_MIN:
        return state
    similarity = state.similarity.change_visit(visit_scale_variance(before, now))
    return replace(state, similarity=similarity, zoomed_s=state.filter.state.time_s)


def _follow(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame
) -> tuple[TrackerState, DriftUpdate]:
    """Register the frame against the best keyframes, until one of them holds; go on as predicted where none does."""
    settings, sample = setup.settings, frame.sample
    is_repeated = sample == state.sample
    state = replace(state, sample=sample)
    flaw = _find_flaw(state, is_repeated=is_repeated)
    if flaw is not None:
        return coast(setup, state, frame, [RejectedMatch.unseen(flaw)], rescaled=False)
    candidates = state.keyframes.candidates(
        state.filter.state, frame, settings.rekey_overlap, settings.max_ratio
    )
    if not candidates:
        ratio = state.keyframes.smallest_scale_ratio(frame)
        reason = f"scale changed by a factor of {ratio:.2f}"
        if not np.isfinite(ratio):
            reason = "image of {} x {} px: no earlier one has this size".format(*frame.size)
        return restart(setup, state, frame, Rejection(MatchFailure.SCALE_CHANGE, reason))
    if state.lines.unseen is not None:
        # What was seen in both directions can tell them again.
        candidates = sorted(candidates, key=lambda c: c.key in state.lines.blind)
    # Where nothing matched before, the image may be that of any of them.
    is_steady = state.rejected == 0 and state.filter.pending is None
    rejected: list[RejectedMatch] = []
    for candidate in candidates[: CANDIDATES if is_steady else 2 * CANDIDATES]:
        state, match = match_keyframe(setup, state, frame, candidate)
        if isinstance(match, Match) and is_repeated:
            match = RejectedMatch(_REPEATED_IMAGE, match.registration)
        if isinstance(match, Match):
            state, match = free_of_pull(setup, state, frame, match)
            state = leave_place(setup, state, frame, match.measure.key, rejected)
            state, refused = use_match(setup, state, frame, match)
            if refused is None:
                state = find_place_again(setup, state, frame, match.measure.key, candidates)
                return renew_keyframe(setup, state, frame, match)
            match = refused
        rejected.append(match)
    return coast(setup, state, frame, rejected, rescaled=candidates[0].rescaled)


def _find_flaw(state: TrackerState, *, is_repeated: bool) -> Rejection[MatchFailure] | None:
    """Why a frame is not used, whatever it shows; None where nothing speaks against it."""
    if state.tears.share > 0.0:
        share = 100.0 * state.tears.share
        reason = f"image: torn: {share:.0f} % of its lines are those of the previous frame"
        return Rejection(MatchFailure.REPEATED_IMAGE, reason)
    if not state.filter.knows_motion:
        # A frame at another time tells the prior of the motion; without any, a shift would be taken for noise.
        return _REPEATED_IMAGE if is_repeated else _REPEATED_TIME
    return None


def _look_for_fixed(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, raw: AnyImage
) -> tuple[TrackerState, bool]:
    """Look for what stays in place, in a frame that was measured, as it came (``raw``). The keyframes are freed of what
    is new. Where it has pulled this frame and those before, they are worth less, and the frame is measured again.
    """
    px_from_unit = frame.px_from_unit
    drift_px = px_from_unit @ state.filter.state.position
    static, pulled_px = state.static.look_for_fixed(raw, drift_px, px_from_unit)
    state = replace(state, static=static)
    if pulled_px is None:
        return state, False
    pulled = np.linalg.solve(px_from_unit, pulled_px)
    squares = pulled @ np.linalg.solve(state.filter.state.covariance[:2, :2], pulled)
    is_pulled = bool(squares >= FIXED_PULL_MIN**2)
    if is_pulled:
        widened = state.filter.widen_measurements(np.outer(pulled, pulled))
        # The frame is measured once more, and is no repeated one.
        state = replace(state, filter=widened, sample=b"")
    return clean_keyframes(setup, state), is_pulled


def _follow_without_stripes(
    setup: TrackerSetup,
    state: TrackerState,
    raw: AnyImage,
    found: tuple[TrackerState, DriftUpdate, ScanFrame],
) -> tuple[TrackerState, DriftUpdate, ScanFrame]:
    """Follow a frame that came as ``raw`` once more from the ``state`` before it, without the brightness that its lines
    or columns have in common, where it may have stripes; what was ``found`` with them where that changes nothing.

    It is of use where the frame could not be measured, and where the drift is significantly another one without.
    """
    with_them, rejection = found[1], found[1].rejection
    if rejection is None:
        looks = state.static.looks_for_stripes
    else:
        looks = rejection.status in STRIPE_FAILURES and state.rejected < STRIPE_TRIES
    # What was measured says by itself whether stripes make a difference.
    least = STRIPE_CELLS_MIN if rejection is not None else STRIPE_CELLS_TRIED
    static, lone = state.static, Stripes()
    if looks:
        lone = static.find_lone_lines(raw, with_them.moving)
        static = static.suspect_stripes(raw, with_them.moving, least)
        static = replace(static, stripes=static.stripes | lone)
    if static.stripes == state.static.stripes:
        return found
    cleaned, frame = _without(setup, state, static, replace(found[2], image=raw))
    if rejection is None:
        # It only decides.
        cleaned = replace(cleaned, filter=replace(cleaned.filter, adapts=False))
    freed, without = _follow(setup, cleaned, frame)
    if not without.accepted or without.along is not None:
        return found
    if rejection is not None:
        return freed, without, frame
    # Lines pull along y, and columns along x.
    to_px = frame.px_from_unit
    apart = without.drift_m - with_them.drift_m
    apart_px = to_px @ apart
    if np.hypot(*apart_px) > STRIPE_MOVE_PX_MAX:
        # No stripes pull that far: it is another match, such as one that is a period of the specimen away.
        return found
    squares = apart_px**2 / np.diag(to_px @ without.covariance[:2, :2] @ to_px.T)
    limits = np.where([lone.lines, lone.columns], LONE_LINE_CHI2_MIN, STRIPE_CHI2_MIN)
    pulled = Stripes(*(squares[::-1] > limits).tolist()) & static.stripes
    known = state.static.stripes
    if known | pulled == known:
        return found
    static = replace(static, stripes=known | pulled)
    cleaned, frame = _without(setup, state, static, replace(found[2], image=raw))
    # The frames before were pulled as well.
    widened = cleaned.filter.widen_measurements(np.outer(apart, apart))
    freed, without = _follow(setup, replace(cleaned, filter=widened), frame)
    return freed, without, frame


def _without(
    setup: TrackerSetup, state: TrackerState, static: StaticParts, frame: ScanFrame
) -> tuple[TrackerState, ScanFrame]:
    """The state with keyframes that are free of what is ``static``, and such a frame, which came with all of it."""
    return clean_keyframes(setup, replace(state, static=static)), static.remove_from(frame)


def _conclude(state: TrackerState, frame: ScanFrame, raw: AnyImage, time_s: float) -> TrackerState:
    """Keep what the next frame needs of this one, which came as ``raw``."""
    return replace(
        state,
        filter=state.filter.mark_frame(),
        similarity=state.similarity.mark_frame(state.filter.state.time_s),
        camera=frame.camera,
        time_s=time_s,
        static=state.static if state.tears.share > 0.0 else state.static.keep(raw),
        lines=replace(state.lines, of_unseen=state.unseen_covariance(frame.px_from_unit)),
    )


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
        self._setup = TrackerSetup(
            self.settings, MotionCorrector(self.settings.interpolation), history is not None
        )
        self._history = history
        self._state: TrackerState | None = None

    @property
    def state(self) -> TrackerState | None:
        """What is known after the latest frame; None before the first."""
        return self._state

    def reset(self) -> None:
        """Forget everything: the next frame has zero drift."""
        self._state = None

    def predictor(self) -> DriftPredictor:
        """What is known now of the drift at times after that of the last frame.

        Raises
        ------
        InvalidValueError
            If there was no frame yet.
        """
        if self._state is None:
            raise InvalidValueError(
                "a forecast before the first frame", expected="at least one frame"
            )
        return self._state.predictor()

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
            Start of its acquisition. A time before that of the last frame begins anew at zero drift, and the update
            says ``restarted``.
        camera
            Camera of this frame's magnification; None tracks in raw pixels. A stream that gains or
            loses its camera begins anew, too, because its unit changes.
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
        self._state, update = step(self._setup, self._state, frame, centre_s)
        if self._history is not None:
            self._history.add(update, fitted, self._state.filter, self._state.similarity)
        return update
