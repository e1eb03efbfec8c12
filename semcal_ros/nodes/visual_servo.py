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

"""Executable ``visual_servo``: brings a target on the stage to a pose in the sem frame, at any magnification."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from semcal_ros.applications.servoing import (
    NestedTarget,
    PlaneCamera,
    PlanePose,
    Servo,
    ServoSettings,
    ServoStatus,
    ServoStep,
    TargetView,
    choose_projection,
    find_target,
)
from semcal_ros.bridge.drift import UNKNOWN_VARIANCE
from semcal_ros.bridge.fields import copy_header, stamp_ns_from_msg
from semcal_ros.bridge.images import image_from_message, to_gray
from semcal_ros.bridge.magnification import MagnificationReading
from semcal_ros.bridge.projection import (
    projection_from_message,
    stamped_projection_covariance_from_message,
    stamped_projection_from_message,
)
from semcal_ros.core.arrays import Array
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.parameters import ParameterDeclaration, Parameters
from semcal_ros.nodes.common.qos import image_input, stream_output, value_input
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.common.subscription import MessageInfo
from semcal_ros.nodes.frames.held_values import MagnificationInput

# Frames that wait for their other parts: more than the queues of all inputs hold. Projections: as many magnifications
# as can be on their way with those frames.
_WAITING, _PROJECTIONS = 16, 16
# Frames are complete without these, which bags of earlier versions do not have.
_OPTIONAL = ("projection_stamped", "projection_covariance_stamped")

_GOAL = (
    ParameterDeclaration(
        "goal_x_m", 0.0, "Goal of the target in the sem frame, x.", "m", -1e-3, 1e-3
    ),
    ParameterDeclaration(
        "goal_y_m", 0.0, "Goal of the target in the sem frame, y.", "m", -1e-3, 1e-3
    ),
    ParameterDeclaration(
        "goal_rotation_deg", 0.0, "Goal of its rotation.", "degrees", -180.0, 180.0
    ),
)
_LAW = (
    ParameterDeclaration(
        "gain", 1.0, "Fraction of the error that is corrected per second.", "1/s", 0.001, 100.0
    ),
    ParameterDeclaration(
        "speed_limit_um_s", 50.0, "Largest speed of the stage.", "um/s", 1e-3, 1e4
    ),
    ParameterDeclaration(
        "turn_limit_deg_s", 5.0, "Largest speed of the stage's rotation.", "degrees/s", 1e-3, 360.0
    ),
    ParameterDeclaration(
        "travel_limit_px",
        12.0,
        "Largest movement of a marker between two frames, which blurs it.",
        "px",
        0.1,
        1e4,
    ),
    ParameterDeclaration(
        "tolerance_px", 0.5, "Largest error at which the goal counts as reached.", "px", 0.01, 100.0
    ),
    ParameterDeclaration(
        "scale_tolerance",
        0.05,
        "Largest relative error of the target's size against the camera of the frame.",
        low=0.001,
        high=0.5,
    ),
    ParameterDeclaration(
        "axis_sigma_px",
        15.0,
        "1-sigma of the calibrated position of the optical axis, which is corrected by what changes of the"
        " magnification show. 0: it is not corrected.",
        "px",
        0.0,
        1e4,
        fixed=True,
    ),
    ParameterDeclaration(
        "feed_forward", True, "Compensate the drift that remains besides the commands."
    ),
)
_STAGE = (
    ParameterDeclaration("start", False, "Start at once, without ~/start.", fixed=True),
    ParameterDeclaration(
        "stage", "virtual_sem/stage", "Topic of the stage's velocity.", fixed=True
    ),
    ParameterDeclaration(
        "goal_frame",
        "instrument",
        "instrument: the goal is a place under the beam; what was removed from the image as drift is added again."
        " specimen: the goal is a place in the drift-free image, for an actuator that moves the target over it.",
        choices=("instrument", "specimen"),
        fixed=True,
    ),
    ParameterDeclaration(
        "with_drift",
        True,
        "Whether a drift is published with each image, as from stream_corrector; false for images of rectifier.",
        fixed=True,
    ),
    ParameterDeclaration(
        "reset_service",
        "stream_corrector/reset",
        "Service to call when the corrected image has moved too far from what is in view; empty: none.",
        fixed=True,
    ),
    ParameterDeclaration(
        "reset_beyond",
        0.15,
        "It is called when the drift exceeds this fraction of the width.",
        low=0.01,
        high=1.0,
    ),
    ParameterDeclaration(
        "target_cell_m", 180e-6, "Side of a cell of the largest board.", "m", 1e-9, 1.0, fixed=True
    ),
    ParameterDeclaration("height_m", 0.0, "Height of the target along the beam.", "m", -1e-3, 1e-3),
    ParameterDeclaration(
        "rotation_centre_x_m",
        0.0,
        "Where the axis of the stage's rotation meets the target, in the target's frame.",
        "m",
        -1.0,
        1.0,
        fixed=True,
    ),
    ParameterDeclaration(
        "rotation_centre_y_m",
        0.0,
        "Where the axis of the stage's rotation meets the target, in the target's frame.",
        "m",
        -1.0,
        1.0,
        fixed=True,
    ),
)
SERVO_PARAMETERS = (*_GOAL, *_LAW, *_STAGE)

# Period of the watchdog: a fifth of the shortest silence that it has to notice.
_TICK_S = 0.1
# The stage stops when the specimen has not been seen for this many frame times, and at least this time: one lost frame
# does not stop it.
_SILENCE, _SHORTEST_SILENCE_S = 2.5, 0.5
# Stamps that differ from now by more are from another clock: no frame takes that long to arrive.
_OTHER_CLOCK_S = 30.0
# A target that is not found may have left the image if the drift exceeds this fraction of its width: more than
# markers at the edge can hide.
_HIDDEN = 0.03
# Least time between two resets while the target is still found, in addition to two frame intervals:
# frames corrected before a reset still arrive with the old drift. Chosen, not measured.
_RESET_AGAIN_S = 2.0


# Longest wait for the acknowledgement of the final zero velocity: a stage that is gone must not
# hold up the end of the node. Chosen, not measured.
_LAST_WORD_S = 1.0


@dataclass(frozen=True)
class ServoFrame:
    """One rectified frame.

    Attributes
    ----------
    image
        (h, w) grey levels.
    k
        (3, 3) K of its camera_info; zero without a camera.
    drift_m
        (2,) drift that was removed from the image, m.
    projections
        (3, 4) P_g with the frame's own stamp; without one, the latest of all, the oldest first.
    covariance
        (12, 12) covariance of the P_g with the frame's own stamp, or None where it is not known.
    header, stamp_ns
        Its header.
    """

    image: NDArray[Any]
    k: Array
    drift_m: Array
    projections: tuple[Array, ...]
    header: Any
    stamp_ns: int
    covariance: Array | None = None


class ServoInput:
    """Subscribes to ``image_rect``, ``camera_info``, ``drift``, ``projection_stamped``, its covariance, ``projection``.

    All but the last are paired by stamp. The newest complete frame counts; older ones are dropped. A frame is complete
    without its ``projection_stamped`` and without the covariance of that.

    Parameters
    ----------
    context
        Of the node.
    on_frame
        Called with each frame; its exceptions of :data:`NODE_ERRORS` are counted and passed to ``on_error``.
    on_error
        Called with the reason why a frame cannot be used.
    with_drift
        Whether a frame needs a drift; otherwise no drift was removed from the image.
    """

    def __init__(
        self,
        context: NodeContext,
        on_frame: Callable[[ServoFrame], None],
        on_error: Callable[[str], None],
        *,
        with_drift: bool,
    ) -> None:
        endpoints = context.endpoints
        self._reporter = context.reporter
        self._on_frame = on_frame
        self._on_error = on_error
        self._parts: dict[str, dict[int, Any]] = {"image": {}, "info": {}}
        self._projections: deque[Array] = deque(maxlen=_PROJECTIONS)
        self._stamped: dict[int, Array] = {}
        self._covariances: dict[int, Array] = {}
        self._draining = False
        endpoints.subscribe(Float64MultiArray, "projection", self._on_projection, value_input())
        self._inputs = [
            endpoints.subscribe(
                Image, "projection_stamped", self._on_stamped_projection, stream_output()
            ),
            endpoints.subscribe(
                Image, "projection_covariance_stamped", self._on_covariance, stream_output()
            ),
            endpoints.subscribe(CameraInfo, "camera_info", self._keeps("info"), stream_output()),
            endpoints.subscribe(Image, "image_rect", self._keeps("image"), image_input()),
        ]
        if with_drift:
            self._parts["drift"] = {}
            drift = self._keeps("drift")
            kind = PoseWithCovarianceStamped
            self._inputs.append(endpoints.subscribe(kind, "drift", drift, stream_output()))

    @property
    def required_topics(self) -> tuple[str, ...]:
        """The topics without which no frame is complete."""
        return tuple(s.topic for s in self._inputs if s.topic not in _OPTIONAL)

    def _on_projection(self, message: Any, _info: MessageInfo) -> None:
        try:
            self._projections.append(projection_from_message(message))
        except NODE_ERRORS as error:
            self._reporter.reject(error)

    def _on_stamped_projection(self, message: Any, _info: MessageInfo) -> None:
        try:
            matrix = stamped_projection_from_message(message)
            _insert_newest(self._stamped, stamp_ns_from_msg(message), matrix)
        except NODE_ERRORS as error:
            self._reporter.reject(error)

    def _on_covariance(self, message: Any, _info: MessageInfo) -> None:
        try:
            matrix = stamped_projection_covariance_from_message(message)
            _insert_newest(self._covariances, stamp_ns_from_msg(message), matrix)
        except NODE_ERRORS as error:
            self._reporter.reject(error)

    def _keeps(self, part: str) -> Callable[[Any, MessageInfo], None]:
        def keep(message: Any, _info: MessageInfo) -> None:
            if part == "image":
                self._reporter.count_received()
            try:
                _insert_newest(self._parts[part], stamp_ns_from_msg(message), message)
            except NODE_ERRORS as error:
                self._reporter.reject(error)
                self._on_error(" ".join(str(error).split()))
            if not self._draining:
                self._drain()

        return keep

    def _drain(self) -> None:
        """Take all waiting messages, then process the newest frame that has all its parts."""
        self._draining = True
        try:
            for subscription in self._inputs:
                subscription.take_waiting()
        finally:
            self._draining = False
        complete = set.intersection(*(set(part) for part in self._parts.values()))
        if not complete:
            return
        newest = [stamp for stamp in self._parts["image"] if stamp in complete][-1]
        parts = {name: waiting[newest] for name, waiting in self._parts.items()}
        self._reporter.statistics.drop(list(self._parts["image"]).index(newest))
        for waiting in self._parts.values():
            for stamp in list(waiting)[: list(waiting).index(newest) + 1]:
                del waiting[stamp]
        self._work(newest, parts)

    def _work(self, stamp_ns: int, parts: dict[str, Any]) -> None:
        started_s = time.monotonic()
        try:
            image = parts["image"]
            grey = to_gray(image_from_message(image), image.encoding)
            drift_m = np.zeros(2)
            if "drift" in parts:
                place = parts["drift"].pose.pose.position
                drift_m = np.array([place.x, place.y])
            k = np.array(parts["info"].k, dtype=np.float64).reshape(3, 3)
            stamped = self._stamped.get(stamp_ns)
            projections = tuple(self._projections) if stamped is None else (stamped,)
            self._on_frame(
                ServoFrame(
                    grey,
                    k,
                    drift_m,
                    projections,
                    image.header,
                    stamp_ns,
                    None if stamped is None else self._covariances.get(stamp_ns),
                )
            )
        except NODE_ERRORS as error:
            self._reporter.reject(error)
            self._on_error(" ".join(str(error).split()))
        self._reporter.note("processing_ms", 1e3 * (time.monotonic() - started_s))


def _insert_newest(waiting: dict[int, Any], stamp_ns: int, value: Any) -> None:
    """Add what belongs to a stamp, and drop what has waited the longest."""
    waiting[stamp_ns] = value
    # In order of arrival: stamps go back when a clock does.
    while len(waiting) > _WAITING:
        del waiting[next(iter(waiting))]


def read_goal(settings: Parameters) -> PlanePose:
    """Read the goal from the parameters."""
    angle_rad = math.radians(settings["goal_rotation_deg"])
    return PlanePose(settings["goal_x_m"], settings["goal_y_m"], angle_rad)


def read_servo_settings(settings: Parameters) -> ServoSettings:
    """Read the settings of the control law from the parameters."""
    return ServoSettings(
        gain_hz=settings["gain"],
        speed_limit_m_s=1e-6 * settings["speed_limit_um_s"],
        turn_limit_rad_s=math.radians(settings["turn_limit_deg_s"]),
        travel_limit_px=settings["travel_limit_px"],
        tolerance_px=settings["tolerance_px"],
        scale_tolerance=settings["scale_tolerance"],
        axis_sigma_px=settings["axis_sigma_px"],
        feed_forward=settings["feed_forward"],
    )


class StageOutput:
    """Publishes velocities of the stage; the last one is zero.

    Parameters
    ----------
    endpoints, topic
        Where to publish.
    """

    def __init__(self, endpoints: Endpoints, topic: str) -> None:
        self._publisher = endpoints.stream_publisher(Twist, topic)
        self.twist = np.zeros(3)

    @property
    def is_moving(self) -> bool:
        """Whether the last velocity was not zero."""
        return bool(np.any(self.twist))

    def send(self, twist: Array) -> None:
        """Publish (3,): x, y in m/s, rotation in rad/s."""
        message = Twist()
        message.linear.x, message.linear.y, message.angular.z = (float(v) for v in twist)
        self._publisher.publish(message)
        self.twist = np.array(twist)

    def repeat(self) -> None:
        """Publish the last velocity once more."""
        self.send(self.twist)

    def close(self) -> None:
        """Stop the stage and wait until it has received the zero velocity."""
        self.send(np.zeros(3))
        self._publisher.wait_for_all_acked(Duration(seconds=_LAST_WORD_S))


class ErrorOutput:
    """Publishes ``~/error``: target minus goal, in the sem frame, at the centre of a frame."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._publisher = endpoints.stream_publisher(PoseWithCovarianceStamped, "~/error")

    def publish(self, step: ServoStep, header: Any) -> None:
        """Publish the measured error; nothing if nothing was measured."""
        if not np.all(np.isfinite(step.error_covariance)):
            return
        message = PoseWithCovarianceStamped()
        copy_header(message.header, header)
        pose = message.pose.pose
        x, y, turn = (float(v) for v in step.error)
        pose.position.x, pose.position.y = x, y
        pose.orientation.z, pose.orientation.w = math.sin(0.5 * turn), math.cos(0.5 * turn)
        full = np.diag(np.full(6, UNKNOWN_VARIANCE))
        known = np.ix_((0, 1, 5), (0, 1, 5))
        full[known] = step.error_covariance
        message.pose.covariance = full.reshape(-1).tolist()
        self._publisher.publish(message)


class VisualServo(SemNode):
    """Takes rectified images with their camera and drift, and publishes velocities of the stage.

    The stage stands still unless every one of these holds: ``~/start`` was called; frames come, soon after they were
    taken; the frame has a camera; the target is found in the image with the size that this camera implies; the
    magnification has not changed since; the image follows the stage.
    """

    def __init__(self) -> None:
        super().__init__("visual_servo", SERVO_PARAMETERS)
        values = self.parameters
        self._target = NestedTarget(values["target_cell_m"])
        centre = values["rotation_centre_x_m"], values["rotation_centre_y_m"]
        self._servo = Servo(read_goal(values), read_servo_settings(values), centre)
        for setting in SERVO_PARAMETERS:
            if not setting.fixed:
                values.on_change(setting.name, self._apply)
        self._active = bool(values["start"])
        self._state = "" if self._active else "waiting for ~/start"
        # Stamp of the last frame, and when (time.monotonic) it had been scanned.
        self._last: tuple[int, float] | None = None
        # The shortest time between a scan and the work on it, by the stamps of a clock that is not this one.
        self._least_delay_s = np.inf
        # The watchdog has a thread of its own: a frame that takes long to work on must not hold it up.
        self._lock = threading.RLock()
        self._interval_s = 0.0
        self._shortest_s = np.inf
        self._magnification_value: float | None = None
        self._resets = 0
        self._reset_s = -_RESET_AGAIN_S
        self._stage = StageOutput(self.endpoints, values["stage"])
        self.closing.callback(self._stage.close)
        self._errors = ErrorOutput(self.endpoints)
        self._reset = None
        if values["reset_service"] and values["goal_frame"] == "instrument":
            self._reset = self.create_client(Trigger, values["reset_service"])
        self._magnification = MagnificationInput(self.node_context, self._on_magnification)
        self._input = ServoInput(
            self.node_context,
            self._on_frame,
            self._halt,
            with_drift=bool(values["with_drift"]),
        )
        alone = MutuallyExclusiveCallbackGroup()
        self._triggers = [
            self.endpoints.trigger_service("~/start", self._on_start),
            # As the watchdog, not to wait for the end of the work on a frame.
            self.endpoints.trigger_service("~/stop", self._on_stop, alone),
        ]
        # A simulated clock is at zero until its first message, and leaps where a replay is moved on.
        self._clock_leapt = False
        leap = Duration(seconds=_OTHER_CLOCK_S)
        threshold = JumpThreshold(min_forward=leap, min_backward=Duration(seconds=-_OTHER_CLOCK_S))
        self._leaps = self.get_clock().create_jump_callback(threshold, post_callback=self._on_leap)
        # A simulated clock may stand still; the stage must not keep moving because of it.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watchdog = self.create_timer(_TICK_S, self._watch, alone, clock=steady)

    # -- control -----------------------------------------------------------------------------------

    def _apply(self, _value: Any) -> None:
        with self._lock:
            self._servo.goal = read_goal(self.parameters)
            self._servo.settings = read_servo_settings(self.parameters)

    def _on_start(self) -> str:
        waiting = self._missing_inputs()
        with self._lock:
            self._servo.restart()
            self._last, self._shortest_s, self._least_delay_s = None, np.inf, np.inf
            self._active = True
            self._set_state(f"waiting for {waiting or 'frames'}")
        return (
            f"waiting for {waiting}; then the stage is servoed"
            if waiting
            else "the stage is servoed"
        )

    def _missing_inputs(self) -> str:
        """Return what the control needs and nobody publishes, in words."""
        missing = [t for t in self._input.required_topics if not self.count_publishers(t)]
        return f"a publisher of {', '.join(missing)}" if missing else ""

    def _on_stop(self) -> str:
        with self._lock:
            self._active = False
            self._halt("waiting for ~/start")
        return "the stage stands still"

    def _on_magnification(self, reading: MagnificationReading) -> None:
        """Stop: the frame that is being scanned shows two magnifications and will not arrive."""
        before, self._magnification_value = self._magnification_value, reading.value
        if before is not None and before != reading.value:
            self._halt("the magnification has changed")

    def _watch(self) -> None:
        with self._lock:
            if self._last is None or not self._stage.is_moving:
                return
            if time.monotonic() - self._last[1] > self._longest_silence_s():
                self._halt("no frames")
                self._last = None
            else:
                # So that a stage may stop by itself when it hears nothing any more.
                self._stage.repeat()

    def _longest_silence_s(self) -> float:
        """Return for how long the stage may move without being seen."""
        return max(_SILENCE * self._frame_time_s(), _SHORTEST_SILENCE_S)

    def _frame_time_s(self) -> float:
        """Return how long the microscope takes for a frame.

        Not the interval between the last two that came: where a processor is too slow, that grows with its load, and
        the time for which the stage would move unseen with it.
        """
        if self.config.scan is not None:
            return self.config.scan.acquisition_time_s
        return self._shortest_s if np.isfinite(self._shortest_s) else 0.0

    def _halt(self, reason: str) -> None:
        """Stop the stage."""
        with self._lock:
            self._send(np.zeros(3))
            self._servo.stop(ServoStatus.NOT_READY, reason)
            self._set_state(reason)

    def _send(self, twist: np.ndarray[Any, Any]) -> None:
        self._stage.send(twist)
        self._servo.record_command(self._now_s(), twist)
        self.reporter.note("servo_speed_m_s", float(np.hypot(twist[0], twist[1])))

    def _set_state(self, state: str) -> None:
        self._state = state
        self.reporter.note("servo_state", state)

    # -- frames ------------------------------------------------------------------------------------

    def _on_leap(self, _leap: TimeJump) -> None:
        # No more than this: whoever sets the clock waits for it, and the lock may be held for a while.
        self._clock_leapt = True

    def _now_s(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _times(self, stamp_ns: int) -> tuple[float, float | None, float]:
        """Return the centre of a frame's acquisition, now, and how long ago its scan ended.

        Now is None if the stamp is of another clock, which is as fast as this one: the frame that came soonest after
        its scan counts as fresh, and the others are older by as much as they are later.
        """
        scan = self.config.scan
        centre_s, whole_s = (
            (0.0, 0.0) if scan is None else (scan.centre_offset_s, scan.acquisition_time_s)
        )
        now_s = self._now_s()
        start_s = stamp_ns * 1e-9 + self.config.start_offset_s
        delay_s = now_s - start_s - whole_s
        self._least_delay_s = min(self._least_delay_s, delay_s)
        if 0.0 <= now_s - start_s - centre_s < _OTHER_CLOCK_S and self._least_delay_s > -whole_s:
            return start_s + centre_s, now_s, max(delay_s, 0.0)
        age_s = delay_s - self._least_delay_s
        # As if the frame had been there as soon as it was complete.
        return now_s - age_s - (whole_s - centre_s), None, age_s

    def _on_frame(self, frame: ServoFrame) -> None:
        before, arrived_s = self._last, time.monotonic()
        if before is not None and frame.stamp_ns <= before[0]:
            self._least_delay_s = np.inf
        # What takes long, without the lock: the watchdog may have to stop the stage meanwhile.
        view = find_target(frame.image, self._target)
        with self._lock:
            if self._clock_leapt:
                # How late frames were by the time of before tells nothing of how late they are now.
                self._clock_leapt, self._least_delay_s = False, np.inf
            time_s, now_s, age_s = self._times(frame.stamp_ns)
            # The work on a frame takes time, too, and a frame of another clock cannot be younger than that.
            age_s = max(age_s, time.monotonic() - arrived_s)
            self._last = frame.stamp_ns, time.monotonic() - age_s
            step = self._step(frame, view, before, (time_s, now_s))
            if age_s > self._longest_silence_s():
                reason = f"frames are {age_s:.1f} s old when they have been worked on"
                step = self._servo.stop(ServoStatus.NOT_READY, reason, step.fit)
            moves = self._active and not step.reason
            self._send(step.twist if moves else np.zeros(3))
            if self._active:
                self._set_state(step.reason or ("converged" if step.converged else "servoing"))
        self._keep_in_view(frame, step)
        self._errors.publish(step, frame.header)
        self._note(step)
        self.reporter.count_published(frame.stamp_ns)

    def _step(
        self,
        frame: ServoFrame,
        view: TargetView,
        before: tuple[int, float] | None,
        times: tuple[float, float | None],
    ) -> ServoStep:
        if before is None or frame.stamp_ns <= before[0]:
            return self._servo.stop(ServoStatus.NOT_READY, "waiting for a second frame")
        self._interval_s = (frame.stamp_ns - before[0]) * 1e-9
        self._shortest_s = min(self._shortest_s, self._interval_s)
        try:
            projection = choose_projection(frame.k, frame.projections)
            camera = PlaneCamera.from_projection(
                projection, self.parameters["height_m"], frame.covariance
            )
        except NODE_ERRORS as error:
            self.reporter.warn_seldom(str(error))
            return self._servo.stop(ServoStatus.NOT_READY, " ".join(str(error).split()))
        in_instrument = self.parameters["goal_frame"] == "instrument"
        return self._servo.update(
            view,
            camera,
            times[0],
            interval_s=self._interval_s,
            now_s=times[1],
            shift_m=frame.drift_m if in_instrument else np.zeros(2),
        )

    def _keep_in_view(self, frame: ServoFrame, step: ServoStep) -> None:
        """Reset the corrector when the image that it holds in place has drifted out of the field of view."""
        if self._reset is None or not frame.projections or not self._reset.service_is_ready():
            return
        px_per_m = float(np.linalg.norm(frame.projections[-1][:2, :2], 2))
        moved = px_per_m * float(np.hypot(*frame.drift_m)) / frame.image.shape[1]
        lost = step.fit is None or not step.fit.view.accepted
        now_s = time.monotonic()
        if moved <= (_HIDDEN if lost else self.parameters["reset_beyond"]):
            return
        if now_s - self._reset_s < _RESET_AGAIN_S * (not lost) + 2.0 * self._interval_s:
            return
        self._reset_s = now_s
        self._resets += 1
        self._reset.call_async(Trigger.Request())

    # -- diagnostics -------------------------------------------------------------------------------

    def _note(self, step: ServoStep) -> None:
        note = self.reporter.note
        note("servo_error_px", step.error_px)
        note("servo_error_m", step.error_m)
        note("servo_sigma_px", step.sigma_px)
        note("servo_sigma_m", step.sigma_m)
        note("servo_markers", 0 if step.fit is None else len(step.fit.view.ids))
        note("servo_gain", step.gain_hz)
        note("servo_limited", step.limited or "no")
        note("servo_axis_px", "{:.2f}, {:.2f}".format(*step.axis_px))
        note("servo_axis_sigma_px", step.axis_sigma_px)
        note("servo_drift_m_s", float(np.hypot(*step.drift_m_s)))
        note("servo_response", "{:.3f}, {:.3f}; {:.3f}, {:.3f}".format(*step.response.ravel()))
        note("servo_resets", self._resets)

    def conditions(self) -> list[str]:
        """Extend the base class: also report why the stage stands still."""
        standing = self._active and self._state not in ("servoing", "converged")
        return super().conditions() + [f"standing still: {self._state}"] * standing

    def idle(self) -> bool:
        """Return whether the control has not been started: it expects no stream before."""
        return not self._active


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(VisualServo, args, threads=2)


if __name__ == "__main__":
    raise SystemExit(main())
