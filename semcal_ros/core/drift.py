"""Live drift: keyframe registration, filtered, in metres.

Every frame is registered against a keyframe, so that errors do not add up from frame to frame; the
keyframe is replaced before its overlap with the picture is lost, and what was uncertain about the
drift at that moment stays in the covariance for good. A constant-velocity Kalman filter predicts
each shift, gates it and bridges frames that cannot be used. Sign: drift is the displacement of the
specimen, so what lay at X in the first frame is seen at X + drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.drift_types import DriftSettings, DriftUpdate
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.kalman import DriftState, predict, process_noise, update
from semcal_ros.core.keyframe import (
    Keyframe,
    Shot,
    carried,
    make_keyframe,
    picture_of,
    scale_ratio,
)
from semcal_ros.core.raster import ScanTiming
from semcal_ros.core.rectify import Rectifier
from semcal_ros.core.registration import Registration, register

__all__ = ["DriftSettings", "DriftTracker", "DriftUpdate"]

Array = NDArray[np.float64]

# Innovations beyond this normalised square happen to a correct filter once in a million frames.
_GATE = 27.6
# Multiple of the first step's sigma within which a shift agrees with what was expected.
_REACH = 2.0
# The shear that a wrong velocity leaves is worth a second look from here on.
_SHEAR_PX = 0.1


@dataclass(frozen=True)
class _Measurement:
    """A registration in the unit of the drift."""

    drift: Array
    covariance: Array
    registration: Registration


class DriftTracker:
    """Tracks the drift of a stream of frames; :meth:`update` once per frame, in the order of their
    stamps.
    """

    def __init__(self, settings: DriftSettings | None = None) -> None:
        self.settings = settings or DriftSettings()
        self._rectifier = Rectifier(self.settings.interpolation)
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame has zero drift."""
        self._state: DriftState | None = None
        self._key: Keyframe | None = None
        # Uncertainty of the keyframe's own drift, and the part of it that all registrations against
        # it share.
        self._chain: Array = np.zeros((2, 2))
        self._shared: Array = np.zeros((2, 2))
        self._psd = 0.0
        self._frames = 0
        self._misses = 0
        self._pending: tuple[tuple[float, Array], ...] = ()

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
        picture = _picture(image)
        height, width = picture.shape[:2]
        fitted = None if camera is None else camera.resized(width, height)
        shot = Shot(picture, fitted, timing, rectified)
        centre_s = time_s + (timing.centre_offset_s if timing is not None else 0.0)
        if self._must_restart(shot, centre_s):
            self.reset()
        if self._state is None or self._key is None:
            return self._first(shot, centre_s)
        predicted = self._predicted(shot, centre_s)
        ratio = scale_ratio(self._key.shot, shot)
        if ratio > self.settings.max_ratio:
            reason = f"scale changed by a factor of {ratio:.2f}"
            return self._restart_at(predicted, shot, reason)
        return self._measure(predicted, shot, rescaled=ratio > 1.0 + 1e-9)

    # -- beginning --------------------------------------------------------------------------------

    def _must_restart(self, shot: Shot, centre_s: float) -> bool:
        if self._state is None or self._key is None:
            return False
        gained_or_lost = (self._key.shot.camera is None) != (shot.camera is None)
        return gained_or_lost or centre_s < self._state.time_s

    def _first(self, shot: Shot, centre_s: float) -> DriftUpdate:
        key = self._keyframe(shot, np.zeros(2), np.zeros(2))
        self._state = DriftState(centre_s, np.zeros(4), np.zeros((4, 4)))
        if key.reference.complaint:
            # Nothing can be measured against such a picture: wait for a better one.
            return self._report(shot, f"coasting: {key.reference.complaint}", None, np.nan)
        self._key = key
        self._frames = 1
        return self._report(shot, "keyframe", None, 1.0)

    def _keyframe(self, shot: Shot, drift: Array, velocity: Array) -> Keyframe:
        return make_keyframe(shot, drift, velocity, self._rectifier, self.settings.registration)

    def _predicted(self, shot: Shot, centre_s: float) -> DriftState:
        state = self._state
        assert state is not None
        dt = centre_s - state.time_s
        if self._frames == 1 and dt > 0.0:
            # Until a second frame sets the pace, all that is known of the velocity is how far drift
            # gets in a frame.
            unit_from_px = np.linalg.inv(shot.px_from_unit)
            step = self.settings.first_step_px * float(np.linalg.norm(unit_from_px, 2))
            covariance = state.covariance.copy()
            covariance[2:, 2:] = np.eye(2) * (step / dt) ** 2
            state = DriftState(state.time_s, state.mean, covariance)
            given = self.settings.acceleration_psd
            # A tenth of that step per frame is how much the pace is expected to change.
            self._psd = (0.1 * step) ** 2 / dt**3 if given is None else given
            self._frames = 2
        return predict(state, centre_s, self._psd)

    # -- measuring --------------------------------------------------------------------------------

    def _measure(self, predicted: DriftState, shot: Shot, rescaled: bool) -> DriftUpdate:
        found = self._registered(predicted, predicted.velocity, shot, rescaled)
        if isinstance(found, Registration):
            return self._missed(predicted, shot, found.reason, found, rescaled)
        jump = self._jump(predicted, shot, found)
        if jump:
            return self._missed(predicted, shot, jump, found.registration, rescaled)
        outcome = update(predicted, found.drift, found.covariance, self._gate())
        state = outcome.state
        if not outcome.accepted:
            revised = self._revised(predicted, shot, found)
            if revised is None:
                reason = f"shift is {np.sqrt(outcome.nis):.0f} deviations from the prediction"
                return self._missed(predicted, shot, reason, found.registration, rescaled)
            predicted = revised
            state = update(predicted, found.drift, found.covariance).state
        if self._sheared(predicted.velocity, state.velocity, shot):
            found, state = self._looked_again(predicted, found, state, shot, rescaled)
        self._adapt(outcome.nis)
        self._state = state
        self._misses, self._pending = 0, ()
        self._shared = found.covariance
        self._frames += 1
        return self._tracked(shot, found.registration, rescaled)

    def _looked_again(
        self,
        predicted: DriftState,
        found: _Measurement,
        state: DriftState,
        shot: Shot,
        rescaled: bool,
    ) -> tuple[_Measurement, DriftState]:
        """The registration repeated without the shear that was left by a velocity that was
        wrong.
        """
        key = self._key
        assert key is not None
        if self._frames == 2 and not rescaled:
            # The first frame was taken at the same unknown velocity.
            self._key = self._keyframe(key.shot, key.drift, state.velocity)
        again = self._registered(predicted, state.velocity, shot, rescaled)
        if isinstance(again, Registration):
            self._key = key
            return found, state
        return again, update(predicted, again.drift, again.covariance).state

    def _gate(self) -> float | None:
        # The first step has only a guessed prior, which must not refuse what two looks agree on.
        return None if self._frames <= 2 else _GATE

    def _registered(
        self, predicted: DriftState, velocity: Array, shot: Shot, rescaled: bool
    ) -> _Measurement | Registration:
        key = self._key
        assert key is not None
        if rescaled:
            key = carried(key, shot, self._rectifier, self.settings.registration)
        picture, region = picture_of(shot, velocity, self._rectifier)
        px_from_unit = shot.px_from_unit
        registration = register(
            key.reference,
            picture,
            guess_px=px_from_unit @ (predicted.position - key.drift),
            guess_covariance=px_from_unit @ predicted.covariance[:2, :2] @ px_from_unit.T,
            image_region=region,
        )
        if not registration.accepted:
            return registration
        unit_from_px = np.linalg.inv(px_from_unit)
        # Half of the variance is the keyframe's own noise: it is the same at each frame and does
        # not average out.
        covariance = 0.5 * unit_from_px @ registration.covariance @ unit_from_px.T
        drift = key.drift + unit_from_px @ registration.shift_px
        return _Measurement(drift, covariance, registration)

    def _sheared(self, used: Array, better: Array, shot: Shot) -> bool:
        """Whether the wrong velocity has bent the picture by more than the shift is to be known
        to.
        """
        if shot.timing is None:
            return False
        bend_px = np.abs(shot.px_from_unit @ (better - used)) * shot.timing.frame_time_s
        return float(np.max(bend_px)) > _SHEAR_PX

    def _jump(self, predicted: DriftState, shot: Shot, found: _Measurement) -> str:
        away_px = np.abs(shot.px_from_unit @ (found.drift - predicted.position))
        limit = self.settings.max_jump * np.array(shot.size)
        if np.any(away_px > limit):
            return f"jump of ({away_px[0]:.0f}, {away_px[1]:.0f}) px: a move of the stage"
        return ""

    def _revised(self, predicted: DriftState, shot: Shot, found: _Measurement) -> DriftState | None:
        """Another prediction that an unexpected shift agrees with, or None if it is not to be believed.

        It is believed if drift can get so far between two frames, if the unexpected shift before
        says the same, or if the two before say that the drift goes on like this.
        """
        earlier = self._pending
        self._pending = (*earlier, (predicted.time_s, found.drift))[-2:]
        reach = _REACH * self.settings.first_step_px * np.linalg.inv(shot.px_from_unit)

        def near(expected: Array) -> bool:
            return bool(np.linalg.norm(np.linalg.solve(reach, found.drift - expected)) <= 1.0)

        if near(predicted.position):
            return self._loosened(predicted, found)
        if not earlier:
            return None
        time_s, drift = earlier[-1]
        since_s = predicted.time_s - time_s
        paces = [predicted.velocity]
        if len(earlier) == 2:
            paces.append((drift - earlier[0][1]) / (time_s - earlier[0][0]))
        for pace in paces:
            expected = drift + pace * since_s
            if near(expected):
                covariance = np.zeros((4, 4))
                covariance[:2, :2] = reach @ reach.T
                covariance[2:, 2:] = covariance[:2, :2] / since_s**2
                return DriftState(predicted.time_s, np.concatenate([expected, pace]), covariance)
        return None

    def _loosened(self, predicted: DriftState, found: _Measurement) -> DriftState:
        """The prediction with as much more process noise as the measured drift asks for."""
        state = self._state
        assert state is not None
        dt = predicted.time_s - state.time_s
        away = found.drift - predicted.position
        extra = process_noise(dt, 1.5 * float(away @ away) / dt**3)
        return DriftState(predicted.time_s, predicted.mean, predicted.covariance + extra)

    def _adapt(self, nis: float) -> None:
        """Nudge the process noise until innovations are as large as predicted (2 on average)."""
        if self.settings.acceleration_psd is None and self._frames > 2:
            self._psd *= float(np.exp(0.2 * (np.clip(0.5 * nis, 0.0, 6.0) - 1.0)))

    # -- keyframes --------------------------------------------------------------------------------

    def _rekey(self, shot: Shot) -> None:
        """Make this frame the keyframe; its drift's uncertainty is from now on that of the
        chain.
        """
        state = self._state
        assert state is not None
        self._key = self._keyframe(shot, state.position, state.velocity)
        self._chain = self._chain + self._shared + state.covariance[:2, :2]
        self._shared = np.zeros((2, 2))
        covariance = state.covariance.copy()
        covariance[:2, :] = covariance[:, :2] = 0.0
        self._state = DriftState(state.time_s, state.mean, covariance)

    def _tracked(self, shot: Shot, registration: Registration, rescaled: bool) -> DriftUpdate:
        status = "tracked"
        if rescaled or registration.overlap < self.settings.rekey_overlap:
            self._rekey(shot)
            status = "keyframe"
        return self._report(shot, status, registration, registration.overlap)

    def _missed(
        self,
        predicted: DriftState,
        shot: Shot,
        reason: str,
        registration: Registration,
        rescaled: bool,
    ) -> DriftUpdate:
        self._state = predicted
        unusable = reason.startswith("image:")
        # A blanked beam says nothing about the keyframe.
        self._misses += 0 if unusable else 1
        if self._misses >= self.settings.lost_after or (rescaled and not unusable):
            return self._restart_at(predicted, shot, reason)
        return self._report(shot, f"coasting: {reason}", registration, registration.overlap)

    def _restart_at(self, predicted: DriftState, shot: Shot, reason: str) -> DriftUpdate:
        """Go on from the predicted drift with this frame as keyframe."""
        candidate = self._keyframe(shot, predicted.position, predicted.velocity)
        self._state = predicted
        if candidate.reference.complaint:
            return self._report(shot, f"coasting: {candidate.reference.complaint}", None, np.nan)
        self._rekey(shot)
        self._misses, self._pending = 0, ()
        return self._report(shot, f"coasting: {reason}", None, np.nan)

    # -- reporting --------------------------------------------------------------------------------

    def _report(
        self, shot: Shot, status: str, registration: Registration | None, overlap: float
    ) -> DriftUpdate:
        state = self._state
        assert state is not None
        covariance = state.covariance.copy()
        covariance[:2, :2] += self._chain + self._shared
        reason = status.removeprefix("coasting: ") if status.startswith("coasting") else ""
        return DriftUpdate(
            time_s=state.time_s,
            drift_m=state.position.copy(),
            velocity_m_s=state.velocity.copy(),
            covariance=covariance,
            status=status,
            accepted=not reason,
            reason=reason,
            residual=float("nan") if registration is None else registration.residual_rms,
            px_from_unit=shot.px_from_unit,
            overlap=overlap,
            calibrated=shot.camera is not None,
        )


def _picture(image: NDArray[np.generic]) -> NDArray[np.generic]:
    """The image in a type that can be resampled."""
    shape = image.shape
    if image.dtype.kind not in "uif" or not (
        len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)
    ):
        raise InvalidValueError(
            f"an image of shape {shape} and type {image.dtype}",
            expected="(h, w) or (h, w, 3) of integers or floats",
        )
    return image if image.dtype.name in ("uint8", "uint16", "float32") else image.astype(np.float32)
