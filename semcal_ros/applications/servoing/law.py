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

"""Compute the velocity of the stage from the markers of one frame.

The law is image-based: it brings the distance, in pixels of the frame, between the markers and
their goal positions to zero. Goal and interaction matrix are computed with P_g of the same frame,
so a change of magnification changes features, goal and derivatives together, and a servo that had
converged stays converged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.applications.servoing.motion import (
    CommandHistory,
    MotionObserver,
    StageMonitor,
)
from semcal_ros.applications.servoing.plane_camera import AxisObserver, PlaneCamera
from semcal_ros.applications.servoing.pose import (
    PlanePose,
    PoseFit,
    compute_interaction_matrix,
    fit_pose,
)
from semcal_ros.applications.servoing.target import TargetView
from semcal_ros.applications.servoing.thresholds import (
    COMMAND_DELAY,
    GAIN_MAX,
    GAIN_WITHOUT_TIMES_MAX,
    LATENCY_MAX_S,
    RESPONSE_RATIO,
)
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError, Rejection


@dataclass(frozen=True)
class ServoSettings:
    """Settings of :class:`~semcal_ros.applications.servoing.law.Servo`.

    Attributes
    ----------
    gain_hz
        Part of the error that is removed per second, 1/s.
    speed_limit_m_s, turn_limit_rad_s
        Largest commanded speeds.
    travel_limit_px
        Largest movement of a feature within a frame, whose acquisition blurs it by that much.
    tolerance_px
        Distance to the goal, RMS over the features, below which the servo has converged; the
        distance must be known to half of it (1-sigma).
    settle_frames
        Number of successive frames in which this must hold.
    scale_tolerance
        Largest relative difference between the size of the target and the size that the camera of
        the frame predicts: beyond it, frame and camera are of different magnifications.
    max_sigma_px
        Largest 1-sigma of a pose that is used.
    feed_forward
        Whether motion that the commands do not explain (drift) is estimated and compensated.
    drift_sigma_m_s, drift_change_m_s
        Expected drift (1-sigma), and its change within a second.
    axis_sigma_px, axis_change_px
        Error of the cameras in the position of the optical axis (1-sigma), and its change from one
        magnification to the next. Changes of magnification serve to correct it; 0 disables the
        correction.
    slip
        Relative error of the stage's travel (1-sigma), which is not taken for drift.
    """

    gain_hz: float = 1.0
    speed_limit_m_s: float = 50e-6
    turn_limit_rad_s: float = 0.1
    travel_limit_px: float = 12.0
    tolerance_px: float = 0.5
    settle_frames: int = 3
    scale_tolerance: float = 0.05
    max_sigma_px: float = 1.0
    feed_forward: bool = True
    drift_sigma_m_s: float = 50e-9
    drift_change_m_s: float = 5e-9
    axis_sigma_px: float = 15.0
    axis_change_px: float = 0.3
    slip: float = 0.03

    def __post_init__(self) -> None:
        for name in (
            "gain_hz",
            "speed_limit_m_s",
            "turn_limit_rad_s",
            "travel_limit_px",
            "tolerance_px",
            "settle_frames",
            "scale_tolerance",
            "max_sigma_px",
        ):
            if not getattr(self, name) > 0:
                raise InvalidValueError(
                    f"{name} = {getattr(self, name)}", expected="a positive number"
                )
        for name in (
            "drift_sigma_m_s",
            "drift_change_m_s",
            "axis_sigma_px",
            "axis_change_px",
            "slip",
        ):
            if not getattr(self, name) >= 0:
                raise InvalidValueError(f"{name} = {getattr(self, name)}", expected="a number >= 0")


class ServoStatus(Enum):
    """Why the stage stands still."""

    NOT_READY = "not ready"
    NO_POSE = "no pose"
    WRONG_SCALE = "wrong scale"
    UNCERTAIN = "uncertain"
    FAULT = "fault"


@dataclass(frozen=True, eq=False)
class ServoStep:
    """Result of one frame.

    Attributes
    ----------
    twist
        (3,) commanded velocity in the sem frame: m/s, m/s, rad/s; zero where there is a
        ``rejection``.
    error
        (3,) target minus goal at the centre of the frame's acquisition: m, m, rad.
    error_covariance
        (3, 3) covariance of the error, from the image and, where the camera tells it, its scale.
    error_px, error_m
        RMS over the features, px, and distance of the target's origin from the goal, m.
    sigma_px, sigma_m
        1-sigma of the origin in the worst direction, likewise. Whether the target is near its goal is judged by that
        of the image alone: the scale is wrong by the same in the next frame.
    fit
        The pose in the frame; None if no pose was fitted.
    drift_m_s
        (2,) drift velocity that the command compensates.
    response
        (2, 2) travel of the stage per commanded travel, as seen so far.
    axis_px, axis_sigma_px
        (2,) offset of the optical axis from the principal point of the camera, and its 1-sigma: the
        position of the goal in the sem frame is not known any better.
    gain_hz
        Gain in use.
    limited
        What limited the speed; empty if nothing did.
    converged
        Whether the goal is reached and has been for some frames.
    rejection
        Why the stage stands still; None if it is servoed.
    """

    twist: Array = field(default_factory=lambda: np.zeros(3))
    error: Array = field(default_factory=lambda: np.full(3, np.nan))
    error_covariance: Array = field(default_factory=lambda: np.full((3, 3), np.inf))
    error_px: float = float("nan")
    error_m: float = float("nan")
    sigma_px: float = float("inf")
    sigma_m: float = float("inf")
    fit: PoseFit | None = None
    drift_m_s: Array = field(default_factory=lambda: np.zeros(2))
    response: Array = field(default_factory=lambda: np.eye(2))
    axis_px: Array = field(default_factory=lambda: np.zeros(2))
    axis_sigma_px: float = float("inf")
    gain_hz: float = 0.0
    limited: str = ""
    converged: bool = False
    rejection: Rejection[ServoStatus] | None = None

    @property
    def reason(self) -> str:
        """Why the stage stands still, in words; empty if it is servoed."""
        return "" if self.rejection is None else self.rejection.reason


@dataclass(frozen=True, eq=False)
class _PosedFrame:
    """The latest frame with a pose, and the camera that came with it."""

    pose: PlanePose
    covariance: Array
    camera: PlaneCamera
    time_s: float


class Servo:
    """Brings a target to a pose in the sem frame; :meth:`update` once per frame.

    Parameters
    ----------
    goal
        Goal pose of the target.
    settings
        Settings of the control law.
    rotation_centre_m
        Where the axis of the stage's rotation meets the target, in the target's frame: the axis
        moves with x and y. A wrong one bends the path but does not keep the target from its goal.
    """

    def __init__(
        self,
        goal: PlanePose,
        settings: ServoSettings | None = None,
        rotation_centre_m: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.goal = goal
        self.settings = settings or ServoSettings()
        self.rotation_centre_m = np.array(rotation_centre_m, dtype=np.float64)
        # The axis belongs to the microscope and not to this run: it outlives a restart.
        self._axis_observer = AxisObserver(
            self.settings.axis_sigma_px, self.settings.axis_change_px
        )
        self.restart()

    def restart(self) -> None:
        """Reset observations, commands and fault, but keep the position of the axis."""
        self.history = CommandHistory()
        self.fault = ""
        self._last: _PosedFrame | None = None
        self._near = 0
        self._monitor = StageMonitor()
        self._observer = MotionObserver(
            self.settings.drift_sigma_m_s, self.settings.drift_change_m_s
        )

    def record_command(self, time_s: float, twist: ArrayLike) -> None:
        """Record a velocity (3,) sent to the stage and its time; stops count, too."""
        self.history.add(time_s, twist)

    def stop(self, status: ServoStatus, reason: str = "", fit: PoseFit | None = None) -> ServoStep:
        """Make the step of a frame, or of a time without one, in which the stage stands still."""
        self._near = 0
        return ServoStep(fit=fit, rejection=Rejection(status, reason))

    def update(
        self,
        view: TargetView,
        camera: PlaneCamera,
        time_s: float,
        *,
        interval_s: float,
        now_s: float | None = None,
        shift_m: ArrayLike = (0.0, 0.0),
    ) -> ServoStep:
        """Compute the velocity after a frame.

        Parameters
        ----------
        view
            Markers in rectified pixels.
        camera
            Camera of this frame.
        time_s
            Centre of its acquisition, on the clock of :meth:`record_command`.
        interval_s
            Time between frames.
        now_s
            When the command will take effect; the motion until then is predicted. None if the
            clocks do not allow that.
        shift_m
            (2,) shift that was removed from the image and has to be added again: the drift of the
            frame if the goal is a position in the sem frame, zero if it is a position on the
            specimen.

        Raises
        ------
        InvalidValueError
            If a time is not finite or the interval not positive.
        """
        if not (np.all(np.isfinite([time_s, interval_s])) and interval_s > 0.0):
            raise InvalidValueError(
                f"a frame at {time_s} s after {interval_s} s", expected="a positive interval"
            )
        if self.fault:
            return self.stop(ServoStatus.FAULT, self.fault)
        shift = np.asarray(shift_m, dtype=np.float64)
        corrected = self._axis_observer.correct(camera)
        fit = fit_pose(_shift_view(view, corrected, shift), corrected)
        rejection = self._check(fit, corrected)
        if rejection is not None:
            return self.stop(rejection.status, rejection.reason, fit)
        if self._learn_axis(fit, camera, time_s):
            corrected = self._axis_observer.correct(camera)
            fit = fit_pose(_shift_view(view, corrected, shift), corrected)
        self._learn(fit, camera, time_s)
        if self.fault:
            return self.stop(ServoStatus.FAULT, self.fault, fit)
        return self._command(fit, corrected, time_s, interval_s, now_s)

    def _check(self, fit: PoseFit, camera: PlaneCamera) -> Rejection[ServoStatus] | None:
        limits = self.settings
        if not fit.accepted:
            return Rejection(ServoStatus.NO_POSE, fit.reason)
        if abs(fit.scale - 1.0) > limits.scale_tolerance + 3.0 * fit.scale_sigma:
            return Rejection(
                ServoStatus.WRONG_SCALE,
                f"the target is {fit.scale:.3f} times as large as the camera of the frame implies",
            )
        sigma_px = _compute_origin_sigma(fit, camera)[1]
        if not sigma_px <= limits.max_sigma_px:
            return Rejection(
                ServoStatus.UNCERTAIN, f"the pose of the target is only known to {sigma_px:.2g} px"
            )
        return None

    # -- what moves -------------------------------------------------------------------------------

    def _way(self, first_s: float, last_s: float, pose: PlanePose) -> Array:
        """Compute the (3,) travel of the target's origin between two times, from commands alone."""
        way = self.history.travel(first_s, last_s)
        arm = -(pose.rotation @ self.rotation_centre_m)
        # The origin moves around the axis during rotation.
        c, s = math.cos(float(way[2])), math.sin(float(way[2]))
        way[:2] += np.array([(c - 1.0) * arm[0] - s * arm[1], s * arm[0] + (c - 1.0) * arm[1]])
        return way

    def _compare_travel(
        self, fit: PoseFit, before: _PosedFrame, time_s: float
    ) -> tuple[Array, Array, Array]:
        """Compare travel since the last frame: (2,) commanded, (2,) seen, (2,) variance of both."""
        way = self._way(before.time_s, time_s, before.pose)
        seen = fit.pose.minus(before.pose)
        variance = np.diag(fit.covariance)[:2] + np.diag(before.covariance)[:2]
        variance = variance + (self.settings.slip * float(np.hypot(way[0], way[1]))) ** 2
        # A command takes effect late, by an unknown part of an interval.
        change = self.history.at(time_s) - self.history.at(before.time_s)
        late_m = COMMAND_DELAY * (time_s - before.time_s) * float(np.hypot(change[0], change[1]))
        return way[:2], seen[:2], variance + late_m**2

    def _learn_axis(self, fit: PoseFit, camera: PlaneCamera, time_s: float) -> bool:
        """Update the axis after a change of magnification; return whether the estimate was used."""
        before = self._last
        if before is None or camera.is_same(before.camera) or time_s <= before.time_s:
            return False
        way, seen, variance = self._compare_travel(fit, before, time_s)
        beyond, spread = self._observer.predict(time_s - before.time_s, way)
        return self._axis_observer.update(
            before.camera,
            camera,
            fit.pose.values[:2],
            seen - way - beyond,
            np.diag(variance + spread),
        )

    def _learn(self, fit: PoseFit, camera: PlaneCamera, time_s: float) -> None:
        """Compare with the last frame: estimate drift, and check that the stage obeys commands."""
        before = self._last
        self._last = _PosedFrame(fit.pose, fit.covariance, camera, time_s)
        # Two cameras disagree on a position by more than image noise; that is not drift.
        if before is None or not camera.is_same(before.camera) or time_s <= before.time_s:
            return
        way, seen, variance = self._compare_travel(fit, before, time_s)
        slope = camera.jacobian(fit.pose.values[None, :2])[0]
        # A stage that holds a target against drift is commanded all the time, and nothing moves.
        interval_s = time_s - before.time_s
        drift = interval_s * self._observer.velocity_m_s
        against = self._observer.find_command(-drift)
        self.fault = self._monitor.update(slope @ (way - against), slope @ seen)
        image = float(np.trace(fit.covariance[:2, :2] + before.covariance[:2, :2])) / 2.0
        answered = image + float(drift @ drift)
        self._observer.update(
            interval_s,
            way,
            seen - way,
            variance,
            with_response=float(way @ way) > RESPONSE_RATIO**2 * answered,
        )

    # -- command ----------------------------------------------------------------------------------

    def _command(
        self,
        fit: PoseFit,
        camera: PlaneCamera,
        time_s: float,
        interval_s: float,
        now_s: float | None,
    ) -> ServoStep:
        limits = self.settings
        drift = self._observer.velocity_m_s if limits.feed_forward else np.zeros(2)
        latency_s = 0.0 if now_s is None else now_s - time_s
        known = now_s is not None and 0.0 <= latency_s < LATENCY_MAX_S
        ahead = fit.pose
        if known:
            way = self._way(time_s, time_s + latency_s, fit.pose)
            dx, dy = way[:2] + self._observer.excess @ way[:2] + drift * latency_s
            ahead = fit.pose.displace(float(dx), float(dy), float(way[2]))
        most = GAIN_MAX if known else GAIN_WITHOUT_TIMES_MAX
        gain_hz = min(limits.gain_hz, most / interval_s)
        twist = -gain_hz * self._correction(fit, camera, ahead)
        twist[:2] = self._observer.find_command(twist[:2] - drift)
        twist, limited = self._limit(twist, fit, camera, interval_s)
        sigma_px = _compute_origin_sigma(fit, camera)[1]
        error = fit.pose.minus(self.goal)
        target_xy_m = fit.view.target_xy_m.reshape(-1, 2)
        away = camera.project(fit.pose.apply(target_xy_m)) - camera.project(
            self.goal.apply(target_xy_m)
        )
        error_px = float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
        is_near = error_px <= limits.tolerance_px and 2.0 * sigma_px <= limits.tolerance_px
        self._near = self._near + 1 if is_near else 0
        spread = fit.covariance.copy()
        spread[:2, :2] += camera.scale_spread(fit.pose.values[:2])
        sigma_m, sigma_px = _compute_origin_sigma(fit, camera, spread[:2, :2])
        return ServoStep(
            twist=twist,
            error=error,
            error_covariance=spread,
            error_px=error_px,
            error_m=float(np.hypot(error[0], error[1])),
            sigma_px=sigma_px,
            sigma_m=sigma_m,
            fit=fit,
            drift_m_s=drift.copy(),
            response=np.eye(2) + self._observer.excess,
            axis_px=self._axis_observer.offset_px.copy(),
            axis_sigma_px=self._axis_observer.sigma_px,
            gain_hz=gain_hz,
            limited=limited,
            converged=self._near >= limits.settle_frames,
        )

    def _correction(self, fit: PoseFit, camera: PlaneCamera, ahead: PlanePose) -> Array:
        """Compute the (3,) stage travel that separates features and goal, to second order."""
        target_xy_m = fit.view.target_xy_m.reshape(-1, 2)
        # Predicted features: these are servoed, not the pose.
        seen = fit.view.xy.reshape(-1, 2) - camera.project(fit.pose.apply(target_xy_m))
        features = camera.project(ahead.apply(target_xy_m)) + seen
        wanted = camera.project(self.goal.apply(target_xy_m))
        here = compute_interaction_matrix(camera, features, self._axis(ahead))
        there = compute_interaction_matrix(camera, wanted, self._axis(self.goal))
        # The mean of both ends is right to the second order (Chaumette and Hutchinson 2006).
        slope = 0.5 * (here + there)
        whitening = np.linalg.inv(np.linalg.cholesky(fit.view.covariance_px2 + 1e-8 * np.eye(8)))
        design = (whitening @ slope.reshape(-1, 8, 3)).reshape(-1, 3)
        error = (whitening @ (features - wanted).reshape(-1, 8, 1)).reshape(-1)
        size = np.linalg.norm(design, axis=0)
        way: Array = np.linalg.lstsq(design / size, error, rcond=None)[0] / size
        return way

    def _axis(self, pose: PlanePose) -> Array:
        axis: Array = pose.apply(self.rotation_centre_m[None])[0]
        return axis

    def _limit(
        self, twist: Array, fit: PoseFit, camera: PlaneCamera, interval_s: float
    ) -> tuple[Array, str]:
        """Slow the twist down, in the same direction, if it is too fast."""
        limits = self.settings
        pixels = fit.view.xy.reshape(-1, 2)
        moved = (
            compute_interaction_matrix(camera, pixels, self._axis(fit.pose)) @ twist * interval_s
        )
        travel_px = float(np.sqrt(np.sum(moved.reshape(-1, 2) ** 2, axis=1)).max())
        shares = {
            "speed": limits.speed_limit_m_s / max(float(np.hypot(twist[0], twist[1])), 1e-30),
            "turn": limits.turn_limit_rad_s / max(abs(float(twist[2])), 1e-30),
            "blur": limits.travel_limit_px / max(travel_px, 1e-30),
        }
        name = min(shares, key=lambda key: shares[key])
        if shares[name] >= 1.0:
            return twist, ""
        return twist * shares[name], name


def _shift_view(view: TargetView, camera: PlaneCamera, shift_m: Array) -> TargetView:
    if shift_m.shape != (2,) or not np.all(np.isfinite(shift_m)):
        raise InvalidValueError(f"a shift {shift_m.tolist()}", expected="two finite numbers")
    if not view.accepted or not np.any(shift_m):
        return view
    moved = camera.project(camera.plane_from_px(view.xy.reshape(-1, 2)) + shift_m)
    return view.with_corners(moved.reshape(view.xy.shape))


def _compute_origin_sigma(
    fit: PoseFit, camera: PlaneCamera, covariance_m2: Array | None = None
) -> tuple[float, float]:
    """Compute the 1-sigma of the target's origin in the worst direction, m and px; that of the image by default."""
    block = fit.covariance[:2, :2] if covariance_m2 is None else covariance_m2
    slope = camera.jacobian(fit.pose.values[None, :2])[0]
    worst = [float(np.linalg.eigvalsh(c)[-1]) for c in (block, slope @ block @ slope.T)]
    return math.sqrt(max(worst[0], 0.0)), math.sqrt(max(worst[1], 0.0))
