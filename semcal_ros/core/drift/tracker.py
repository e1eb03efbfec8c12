"""Live drift: registration against keyframes, filtered, in metres.

Every frame is registered against a keyframe, so that errors do not add up from frame to frame; the
keyframe is replaced before its overlap with the picture is lost, and an old one is used again when
its place comes back into view. One Kalman filter holds the drift, its velocity and the positions of
the keyframes (:mod:`semcal_ros.core.drift.state`); it predicts each shift, gates it and bridges
frames that cannot be used. Sign: drift is the displacement of the specimen, so what lay at X in the
first frame is seen at X + drift.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.camera_uncertainty import (
    carry_covariance,
    centre_covariance,
    scale_covariance,
)
from semcal_ros.core.drift.estimates import (
    DriftForecast,
    DriftPredictor,
    DriftSettings,
    DriftUpdate,
)
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.frame import MotionCorrector, ScanFrame, resampleable
from semcal_ros.core.drift.gating import (
    GATE,
    OutlierTest,
    of_a_contradiction,
    of_a_pause,
    of_another_place,
)
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.keyframe import keyframe_of
from semcal_ros.core.drift.keyframe_store import KeyframeStore
from semcal_ros.core.drift.matching import Match, is_mergeable, match_keyframe
from semcal_ros.core.drift.measurement import (
    acceleration_term_s2,
    at_itself,
    becoming_keyframe,
    loosened,
)
from semcal_ros.core.drift.operations import Marginalise, Measure, Predict
from semcal_ros.core.drift.state import initial_state
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration.register import Registration

__all__ = ["DriftForecast", "DriftPredictor", "DriftSettings", "DriftTracker", "DriftUpdate"]


# Multiple of the first step's sigma within which a shift agrees with what was expected.
_REACH = 2.0
# Changes of scale up to which the keyframe stays in use, resampled for each frame.
_SMALL_ZOOM = 1.15
# A picture that has come to differ that much from its keyframe needs another one.
_LIKE_ENOUGH = 0.75
# A frame's position as a keyframe is that which was measured, noise and all; but as a reference its
# noise weighs otherwise than as an image, and other parts of it are compared. Of the variance of the
# frame's noise, this much, and this much times the part that did not overlap, as seen in the closure
# of triples of frames.
_COPY_NOISE, _COPY_NOISE_BESIDE = 0.15, 5.0
_FROZEN = "image: the same picture as the frame before"
# After so many frame intervals without a frame nothing says that the drift went on as it was.
_PAUSE = 10.0
_CANDIDATES = 2


class DriftTracker:
    """Tracks the drift of a stream of frames; :meth:`update` once per frame, in the order of their
    stamps.

    Parameters
    ----------
    settings
        How.
    history
        Where to keep what a second look with hindsight needs: some kB per frame.
    """

    def __init__(
        self, settings: DriftSettings | None = None, *, history: DriftHistory | None = None
    ) -> None:
        self.settings = settings or DriftSettings()
        self._stills = MotionCorrector(self.settings.interpolation)
        self._history = history
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame has zero drift."""
        limits = self.settings
        self._filter: DriftFilter | None = None
        self._store = KeyframeStore(
            limits.registration, limits.max_keyframe_bytes, limits.max_keyframes
        )
        self._misses = 0
        self._surprises = OutlierTest()
        # Camera and time of the frame before.
        self._last: tuple[ScanCamera | None, float] | None = None
        self._doubt = np.zeros((2, 2))
        self._sample = b""

    def update(
        self,
        image: NDArray[np.generic],
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
            (h, w) or (h, w, 3) picture of integers or floats.
        time_s
            Start of its acquisition. A time before that of the last frame resets the tracker.
        camera
            Camera of this frame's magnification; None tracks in raw pixels. A stream that gains or
            loses its camera starts anew, because its unit changes.
        timing
            Raster timing; None takes the frame as an instant at ``time_s``.
        rectified
            The picture already is in ideal pixels of ``camera``.

        Raises
        ------
        InvalidValueError
            If the time is not finite or the picture has another shape or type.
        """
        if not np.isfinite(time_s):
            raise InvalidValueError(f"frame time {time_s} s", expected="a finite number")
        picture = resampleable(image)
        height, width = picture.shape[:2]
        fitted = None if camera is None else camera.resized(width, height)
        shot = ScanFrame(picture, fitted, timing, rectified)
        centre_s = time_s + (timing.centre_offset_s if timing is not None else 0.0)
        if self._last is not None and (
            centre_s < self._last[1] or (self._last[0] is None) != (fitted is None)
        ):
            self.reset()
        if self._filter is None or len(self._store) == 0:
            update = self._first(shot, centre_s)
        else:
            self._advance(self._filter, shot, centre_s)
            update = self._followed(self._filter, shot)
        assert self._filter is not None
        self._filter.mark()
        self._last = fitted, centre_s
        if self._history is not None:
            self._history.add(update, fitted)
        return update

    # -- beginning --------------------------------------------------------------------------------

    def _first(self, shot: ScanFrame, centre_s: float) -> DriftUpdate:
        kept = self._history is not None
        start = initial_state(centre_s, centre_covariance(shot.camera))
        self._filter = DriftFilter(start, self.settings.acceleration_psd, history=kept)
        if self._history is not None:
            self._history.begin(self._filter)
        self._sample = shot.sample
        complaint = self._new_key(self._filter, shot, np.zeros(4))
        if complaint:
            # Nothing can be measured against such a picture: wait for a better one.
            return self._report(shot, f"coasting: {complaint}", None, np.nan)
        return self._report(shot, "keyframe", None, 1.0)

    def _new_key(self, drift: DriftFilter, shot: ScanFrame, removed: Array) -> str:
        """This frame becomes a keyframe that was not measured; why it cannot, or an empty
        string.
        """
        picture, region = self._stills.of(shot, removed)
        keyframe = keyframe_of(shot, removed, picture, region, drift.state.time_s)
        reference = keyframe.reference(self.settings.registration)
        if not reference.defect:
            key, gone = self._store.add(keyframe, reference)
            drift.settle_later(key, removed, acceleration_term_s2(shot))
            for old in gone:
                drift.do(Marginalise(old))
        return reference.defect

    def _advance(self, drift: DriftFilter, shot: ScanFrame, centre_s: float) -> None:
        dt = centre_s - drift.state.time_s
        if drift.measured == 0 and dt > 0.0 and not np.any(drift.state.own[2:, 2:]):
            # Until a second frame sets the pace, all that is known of the velocity is how far drift
            # gets in a frame; a tenth of that is how much the pace is expected to change.
            unit_from_px = np.linalg.inv(shot.px_from_unit)
            step = self.settings.first_step_px * float(np.linalg.norm(unit_from_px, 2))
            drift.first_velocity(step / dt, (0.1 * step) ** 2 / dt**3, dt)
        speed = float(np.hypot(*drift.state.velocity))
        drift.do(Predict(centre_s))
        if 0.0 < _PAUSE * drift.restlessness.memory_s < dt:
            drift.do(of_a_pause(speed, dt))

    # -- measuring --------------------------------------------------------------------------------

    def _followed(self, drift: DriftFilter, shot: ScanFrame) -> DriftUpdate:
        limits = self.settings
        self._doubt = np.zeros((2, 2))
        sample = shot.sample
        frozen, self._sample = sample == self._sample, sample
        candidates = self._store.candidates(
            drift.state, shot, limits.rekey_overlap, limits.max_ratio
        )
        if not candidates:
            ratio = self._store.least_ratio(shot)
            return self._restarted(drift, shot, f"scale changed by a factor of {ratio:.2f}")
        refusal: tuple[str, Registration] | None = None
        # Where nothing matched before, the picture may be that of any of them.
        tried = _CANDIDATES if self._misses == 0 and drift.pending is None else 2 * _CANDIDATES
        for candidate in candidates[:tried]:
            found = match_keyframe(drift, self._store, candidate, shot, self._stills)
            if isinstance(found, Registration):
                refusal = refusal or (found.reason, found)
                continue
            # Noise never comes twice: the scan is paused, or the driver sent the frame again.
            reason = _FROZEN if frozen else self._accepted(drift, shot, found)
            if not reason:
                return self._kept(drift, shot, found)
            refusal = refusal or (reason, found.registration)
        assert refusal is not None
        return self._missed(drift, shot, *refusal, candidates[0].rescaled)

    def _accepted(self, drift: DriftFilter, shot: ScanFrame, found: Match) -> str:
        """Use a measurement, or say why not."""
        state, measure = drift.state, found.measure
        before = self._store[measure.key].shot
        expected, _ = state.shift_from(measure.key)
        away_px = np.abs(shot.px_from_unit @ (measure.shift[:2] - expected))
        loose = loosened(measure, before, shot) if found.candidate.rescaled else measure
        outcome = loose(state, drift.restlessness)
        unexpected = drift.measured == 0 or outcome.nis > GATE
        # If it is refused, either is wrong, and the one who reads the drift has to be warned.
        doubt = (measure.shift[:2] - expected) / 3.0
        self._doubt = np.outer(doubt, doubt)
        if unexpected and np.any(away_px > self.settings.max_jump * np.array(shot.size)):
            return f"jump of ({away_px[0]:.0f}, {away_px[1]:.0f}) px: a move of the stage"
        if outcome.shear_nis > GATE:
            measure = measure.of_shift()
        since_s = state.time_s - (self._last[1] if self._last else state.time_s)
        # The first step has only a guessed prior, which must not refuse what two looks agree on.
        if drift.measured > 0 and outcome.nis > GATE:
            seen = measure.shift[:2] + state.where(measure.key)[:2]
            # What moves fast may also turn fast.
            step_px = float(np.hypot(*(shot.px_from_unit @ state.velocity))) * since_s
            reach_px = max(_REACH * self.settings.first_step_px, step_px)
            reach = np.asarray(reach_px * np.linalg.inv(shot.px_from_unit))
            widened = self._surprises.believed(state, seen, reach, state.time_s - since_s)
            if widened is None:
                return f"shift is {np.sqrt(outcome.nis):.0f} deviations from the prediction"
            drift.do(widened)
        if found.candidate.ratio > _SMALL_ZOOM:
            measure = self._carried(drift, shot, found, replace(measure, zoom=loose.zoom))
        elif found.candidate.rescaled:
            # A zoom in small steps would make a long chain of keyframes.
            measure = loose
        self._doubt = np.zeros((2, 2))
        drift.accept(measure)
        drift.adapt(outcome.nis, measure.covariance[:2, :2], since_s)
        return ""

    def _carried(
        self, drift: DriftFilter, shot: ScanFrame, found: Match, measure: Measure
    ) -> Measure:
        """This frame becomes the keyframe of its magnification, by way of one of another; what it
        says of the drift.
        """
        before, now = self._store[measure.key].shot.camera, shot.camera
        assert before is not None and now is not None
        noise = carry_covariance(before, now) + measure.covariance[:2, :2] * _COPY_NOISE
        key = self._rekey(drift, shot, found, measure, noise)
        return at_itself(key, measure, found.removed)

    def _rekey(
        self, drift: DriftFilter, shot: ScanFrame, found: Match, measure: Measure, noise: Array
    ) -> int:
        """Make this frame a keyframe, as it was measured against the one before."""
        keyframe = keyframe_of(shot, found.removed, found.picture, found.region, drift.state.time_s)
        key, gone = self._store.add(keyframe)
        drift.do(becoming_keyframe(key, drift.state, measure, found.removed, noise))
        for old in gone:
            drift.do(Marginalise(old))
        return key

    # -- after ------------------------------------------------------------------------------------

    def _kept(self, drift: DriftFilter, shot: ScanFrame, found: Match) -> DriftUpdate:
        """Bookkeeping of a frame that was registered: the keyframe in use, and its mean."""
        self._misses = 0
        self._surprises.forget(drift.state)
        registration, candidate = found.registration, found.candidate
        overlap = registration.alignment.overlap
        if candidate.ratio > _SMALL_ZOOM:
            return self._report(shot, "keyframe", registration, overlap)
        self._store.use(candidate.key)
        status, enough, joined = "tracked", self.settings.rekey_overlap, False
        unlike = registration.correlation < _LIKE_ENOUGH
        if unlike or overlap < enough:
            following = self._store.candidates(drift.state, shot, enough, _SMALL_ZOOM)
            if unlike or following[0].overlap < enough:
                share = _COPY_NOISE + _COPY_NOISE_BESIDE * (1.0 - min(overlap, 1.0))
                noise = found.measure.covariance[:2, :2] * share
                measure = found.measure
                if candidate.rescaled:
                    before = self._store[candidate.key].shot
                    measure = loosened(measure, before, shot)
                self._rekey(drift, shot, found, measure, noise)
                status = "keyframe"
        elif joined := self.settings.average and is_mergeable(found, self._store):
            keyframe = self._store[candidate.key]
            better = keyframe.with_frame(found.picture, found.region, registration)
            self._store.replace(candidate.key, better)
        update = self._report(shot, status, registration, overlap)
        return replace(update, keyframe_time_s=found.keyframe_time_s, joined=joined)

    def _missed(
        self,
        drift: DriftFilter,
        shot: ScanFrame,
        reason: str,
        registration: Registration,
        rescaled: bool,
    ) -> DriftUpdate:
        unusable = reason.startswith("image:")
        # A blanked beam says nothing about the keyframe.
        self._misses += 0 if unusable else 1
        since_s = max(drift.state.time_s - (self._last[1] if self._last else 0.0), 1e-9)
        nearest = np.asarray(np.linalg.solve(shot.px_from_unit, registration.nearest_px))
        doubt = of_a_contradiction(drift.state, self._store.current, nearest, since_s)
        lost = self._misses >= self.settings.lost_after
        if lost:
            reach_px = self.settings.max_jump * max(shot.size)
            pace_px = self.settings.first_step_px / since_s
            doubt = of_another_place(shot.px_from_unit, reach_px, pace_px)
        if doubt is not None:
            drift.do(doubt)
        if lost or (rescaled and not unusable):
            return self._restarted(drift, shot, reason)
        return self._report(
            shot, f"coasting: {reason}", registration, registration.alignment.overlap
        )

    def _restarted(self, drift: DriftFilter, shot: ScanFrame, reason: str) -> DriftUpdate:
        """Go on from the predicted drift with this frame as keyframe."""
        useless = drift.pending
        complaint = self._new_key(drift, shot, drift.state.motion)
        if not complaint:
            if useless is not None and len(self._store) > 2:
                # Nothing was ever like it.
                self._store.forget(useless)
                drift.do(Marginalise(useless))
            self._misses = 0
            self._surprises.forget()
        status = f"coasting: {complaint or reason}"
        return self._report(shot, status, None, np.nan, restarted=not complaint)

    def _report(
        self,
        shot: ScanFrame,
        status: str,
        registration: Registration | None,
        overlap: float,
        *,
        restarted: bool = False,
    ) -> DriftUpdate:
        assert self._filter is not None
        state = self._filter.state
        reason = status.removeprefix("coasting: ") if status.startswith("coasting") else ""
        open_ = scale_covariance(shot.camera, state.position, state.velocity)
        open_[:2, :2] += self._doubt
        joint = np.full(4, np.nan) if registration is None else registration.alignment.joint_px
        spread = (
            np.full((4, 4), np.inf)
            if registration is None
            else registration.alignment.joint_covariance
        )
        return DriftUpdate(
            time_s=state.time_s,
            drift_m=state.position.copy(),
            velocity_m_s=state.velocity.copy(),
            acceleration_m_s2=state.acceleration.copy(),
            covariance=state.own + open_,
            status=status,
            accepted=not reason,
            reason=reason,
            residual=float("nan") if registration is None else registration.alignment.residual_rms,
            px_from_unit=shot.px_from_unit,
            overlap=overlap,
            calibrated=shot.camera is not None,
            restarted=restarted,
            shear_px=joint[2:],
            shear_covariance=spread[2:, 2:],
            keyframe_time_s=float("nan"),
            joined=False,
        )

    # -- other times ------------------------------------------------------------------------------

    def outlook(self) -> DriftPredictor:
        """What is known now of the drift at times after the last frame's.

        Raises
        ------
        InvalidValueError
            If there was no frame yet.
        """
        if self._filter is None or self._last is None:
            raise InvalidValueError("a forecast before the first frame", expected="a frame before")
        state = self._filter.state.without_keyframes()
        return DriftPredictor(state, self._filter.restlessness, self._last[0])
