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

"""Executable ``microscope``: puts a microscope, a folder of its pictures or a frame grabber on the topics."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Header

from semcal_ros.bridge.conditions import fill_conditions
from semcal_ros.bridge.fields import fill_header, fill_stamp, optional_stamp_ns
from semcal_ros.bridge.images import fill_image
from semcal_ros.bridge.magnification import published_number
from semcal_ros.config.config import IMAGE_TYPE, MicroscopeConfig
from semcal_ros.core.errors import ConfigError, MicroscopeError, SemcalError
from semcal_ros.drivers.choose import SOURCES, make_source
from semcal_ros.drivers.health import FrameWatch
from semcal_ros.drivers.openfibsem import MANUFACTURERS
from semcal_ros.drivers.runner import SourceRunner
from semcal_ros.drivers.source import (
    JOINTS,
    ConfirmsFrames,
    FrameSource,
    MovesStage,
    SetsFieldWidth,
    SourceFrame,
)
from semcal_ros.middleware import message_class
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.motion import MOTION, MotionInterface
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.run import run_node

_PARAMETERS = (
    ParameterDeclaration(
        "source", "folder", "What the frames come from.", choices=tuple(SOURCES), fixed=True
    ),
    ParameterDeclaration("start", True, "Begin at once, without ~/start.", fixed=True),
    ParameterDeclaration(
        "field_width_m",
        0.0,
        "Width of the field of view where the source does not say it; 0: unknown then.",
        "m",
        0.0,
        0.1,
    ),
    ParameterDeclaration(
        "frame_timeout",
        10.0,
        "Silence of a source that scans all the time after which it is reported; three frame times, if that is longer.",
        "s",
        0.5,
        3600.0,
    ),
    ParameterDeclaration(
        "motion_timeout",
        60.0,
        "A move that takes longer is taken for failed.",
        "s",
        1.0,
        3600.0,
    ),
    ParameterDeclaration(
        "wait_for_subscribers",
        1,
        "folder: files wait until the images have this many subscribers.",
        low=0,
        high=100,
    ),
    ParameterDeclaration(
        "max_rate", 20.0, "folder: frames per second of files that have waited.", "Hz", 0.1, 1000.0
    ),
    ParameterDeclaration(
        "folder", "", "folder: the folder into which the microscope saves.", fixed=True
    ),
    ParameterDeclaration(
        "pattern", "*", "folder: names that count, such as *.tif, separated by spaces.", fixed=True
    ),
    ParameterDeclaration(
        "settle",
        0.3,
        "folder: a file that is written may not change for this time.",
        "s",
        0.05,
        60,
        fixed=True,
    ),
    ParameterDeclaration(
        "poll", 0.5, "folder: time between two looks through the folder.", "s", 0.05, 60, fixed=True
    ),
    ParameterDeclaration(
        "give_up",
        10.0,
        "folder: a file that cannot be read is refused after this time without a change.",
        "s",
        1.0,
        3600.0,
        fixed=True,
    ),
    ParameterDeclaration(
        "backlog",
        "resume",
        "folder: files that are there at the start. Those since the last run; all that were never published; none.",
        choices=("resume", "all", "skip"),
        fixed=True,
    ),
    ParameterDeclaration(
        "stamps",
        "file",
        "folder: a frame was finished when its file was written, or when it was found.",
        choices=("file", "arrival"),
        fixed=True,
    ),
    ParameterDeclaration(
        "journal",
        "",
        "folder: file that keeps what has been published; empty: one below ROS_HOME, else ~/.ros.",
        fixed=True,
    ),
    ParameterDeclaration(
        "manufacturer",
        "configured",
        "openfibsem: the microscope; by default that of its configuration.",
        choices=("configured", *MANUFACTURERS),
        fixed=True,
    ),
    ParameterDeclaration(
        "ip_address",
        "",
        "openfibsem: of the microscope's server; empty: that of the configuration.",
        fixed=True,
    ),
    ParameterDeclaration(
        "fibsem_config",
        "",
        "openfibsem: configuration file of fibsem; empty: its default.",
        fixed=True,
    ),
    ParameterDeclaration(
        "beam", "electron", "openfibsem: which beam.", choices=("electron", "ion"), fixed=True
    ),
    ParameterDeclaration(
        "video", "", "video: device such as /dev/video0, address, or file.", fixed=True
    ),
    ParameterDeclaration(
        "video_format",
        "",
        "video: FFmpeg's name of the format; empty: v4l2 for a device, else found out.",
        fixed=True,
    ),
    ParameterDeclaration(
        "magnification_file",
        "",
        "video: text file that says the magnification or the field width; read again when it changes.",
        fixed=True,
    ),
    ParameterDeclaration(
        "publish_magnification",
        True,
        "Publish the magnification; false: another node does.",
        fixed=True,
    ),
    *MOTION,
)
# How often the state is looked at: a person who has pulled a plug sees it within the time of a report.
_LOOK_S = 0.05
# A call of the source that takes longer has hung; those that wait for a frame return after 0.2 s by themselves.
_HUNG_S = 5.0
_FRAME_TIMES = 3.0
# Fast DDS asks its subscribers every 3 s what they have received; one that has not answered twice is not waited for.
_PROBE_S = 7.0
_LAST_ANSWER_S = 3.5

_ENCODINGS = {"uint8": "mono8", "uint16": "mono16"}
# The moment of the acquisition that the header stamp means.
_PASSED = {"start": 0.0, "centre": 0.5, "end": 1.0}


class SourceOutput:
    """The topics ``image_raw``, ``magnification``, ``stage`` and ``conditions`` of a microscope.

    Parameters
    ----------
    context
        Of the node.
    stage, magnification
        Whether these topics are published.

    Raises
    ------
    ConfigError
        The configuration asks for something that cannot be published.
    """

    def __init__(self, context: NodeContext, *, stage: bool, magnification: bool) -> None:
        config, endpoints = context.config, context.endpoints
        self._config = config
        self._reporter = context.reporter
        if config.image.type != IMAGE_TYPE:
            raise ConfigError(
                f"config {config.name} with images in {config.image.type}",
                expected=f"{IMAGE_TYPE}, which is what this node publishes",
                do="name another configuration",
            )
        source = config.magnification
        if "[" in source.field:
            raise ConfigError(
                f"config {config.name} with a {source.quantity} in {source.field}",
                expected="a field without an index, such as data or vector.x",
                do="name another configuration",
            )
        kind = message_class(source.type)
        self._new_number = kind
        self._set_number(kind(), 1.0)
        self._images = endpoints.stream_publisher(Image, config.image.topic)
        self._numbers = endpoints.latched_publisher(kind, source.topic) if magnification else None
        self._conditions = endpoints.latched_publisher(DiagnosticStatus, "conditions")
        self._joints = None
        if stage and config.stage is not None:
            self._joints = endpoints.latched_publisher(JointState, config.stage.topic)
        self._number: float | None = None
        self._published_conditions: Mapping[str, float | str] | None = None
        self._published_stage: dict[str, float] | None = None
        self._image = Image()

    @property
    def listeners(self) -> int:
        """Number of subscribers of the images."""
        return int(self._images.get_subscription_count())

    def _set_number(self, message: Any, number: float) -> None:
        owner, *path = message, *self._config.magnification.field.split(".")
        try:
            for name in path[:-1]:
                owner = getattr(owner, name)
            setattr(owner, path[-1], type(getattr(owner, path[-1]))(number))
        except (AttributeError, TypeError, ValueError) as error:
            raise ConfigError(
                f"field {self._config.magnification.field} of {self._config.magnification.type}",
                expected="a field that holds a number",
                do="correct magnification.field in the configuration",
            ) from error

    def publish(self, frame: SourceFrame, *, stage: bool = True) -> int:
        """Publish a frame, after what has changed since the one before.

        Parameters
        ----------
        frame
            The frame.
        stage
            Whether what it says about the stage holds.

        Returns
        -------
        The header stamp, ns.

        Raises
        ------
        MicroscopeError
            Its pixels are of another type than 8 or 16 bit grey.
        """
        encoding = _ENCODINGS.get(np.dtype(frame.image.dtype).name)
        if encoding is None or frame.image.ndim != 2:
            raise MicroscopeError(
                f"a frame of {frame.image.dtype} with {frame.image.ndim} axes",
                expected="grey levels of 8 or 16 bit",
            )
        self._publish_magnification(frame)
        if stage:
            self.publish_stage(frame.stage, frame.start_ns)
        self.publish_conditions(frame.conditions)
        acquisition_s = frame.acquisition_s
        if acquisition_s is None and self._config.scan is not None:
            acquisition_s = self._config.scan.acquisition_time_s
        passed = _PASSED[self._config.image.stamp]
        stamp_ns = frame.start_ns + round(passed * (acquisition_s or 0.0) * 1e9)
        header = Header()
        fill_header(header, stamp_ns, self._config.frame_id)
        if self._images.hands_over:
            self._image = Image()
        fill_image(self._image, frame.image, encoding, header)
        self._images.publish(self._image)
        return stamp_ns

    def is_taken(self, wait_s: float = 0.0) -> bool:
        """Return whether all subscribers have told that they received what was published.

        Fast DDS asks them every three seconds.
        """
        timeout = Duration(nanoseconds=max(1, round(wait_s * 1e9)))
        return bool(self._images.wait_for_all_acked(timeout))

    def _publish_magnification(self, frame: SourceFrame) -> None:
        if self._numbers is None:
            return
        width_m = frame.field_width_m
        number = math.nan
        if width_m is not None and math.isfinite(width_m) and width_m > 0.0:
            number = published_number(self._config, width_m, frame.image.shape[1])
            self._reporter.note("magnification", self._config.display_width_m / width_m)
        else:
            self._reporter.note("magnification", "unknown")
        same = number == self._number or (math.isnan(number) and self._number is None)
        if self._number is not None and math.isnan(number) and math.isnan(self._number):
            same = True
        if same:
            return
        self._number = number
        message = self._new_number()
        self._set_number(message, number)
        if optional_stamp_ns(message) is not None:
            fill_stamp(getattr(message, "header", message).stamp, frame.start_ns)
        self._numbers.publish(message)

    def publish_stage(self, stage: Mapping[str, float], stamp_ns: int) -> None:
        """Publish where the stage is, if that has changed; a stage that is no longer known has no joints."""
        source = self._config.stage
        if self._joints is None or source is None:
            return
        joints = {getattr(source, joint): float(stage[joint]) for joint in JOINTS if joint in stage}
        if joints == self._published_stage or (not joints and self._published_stage is None):
            return
        self._published_stage = joints
        message = JointState(name=list(joints), position=list(joints.values()))
        fill_header(message.header, stamp_ns, "")
        self._joints.publish(message)
        self._reporter.note("stage_tilt_rad", stage.get("tilt", "unknown"))

    def publish_conditions(self, conditions: Mapping[str, float | str]) -> None:
        """Publish how the frames are taken, if that has changed."""
        if conditions == self._published_conditions or not (
            conditions or self._published_conditions
        ):
            return
        self._published_conditions = dict(conditions)
        message = DiagnosticStatus()
        fill_conditions(message, conditions, self._config.name)
        self._conditions.publish(message)


class Microscope(SemNode):
    """Publishes ``image_raw``, ``magnification``, ``stage`` and ``conditions`` of a source, and moves it.

    Parameters
    ----------
    make_own
        Makes another source than those of the parameter ``source``, from the configuration.
    """

    def __init__(self, make_own: Callable[[MicroscopeConfig], FrameSource] | None = None) -> None:
        super().__init__("microscope", _PARAMETERS)
        name = self.parameters["source"]
        if make_own is None:
            self._source = make_source(name, self.config, self.parameters)
        else:
            self._source = make_own(self.config)
            name = type(self._source).__name__
        self._source_name = name
        stage = name != "video"
        self._output = SourceOutput(
            self.node_context,
            stage=stage,
            magnification=self.parameters["publish_magnification"],
        )
        self._watch = FrameWatch()
        self._skipped = 0
        self._phase = ""
        self._frame_s = 0.0
        self._last_published_s = -1.0
        # When the magnification was last set from here, and the stage moved.
        self._set_ns = self._stands_since_ns = 0
        self._moving_since_ns: int | None = None
        # Subscribers that are known to hear this node, and the frame by which that is found out.
        self._heard_by = 0
        self._probe: tuple[SourceFrame, int, float] | None = None
        wake = self.endpoints.guard(self._handle)
        self._runner = SourceRunner(self._source, _quietly(wake.trigger))
        self.closing.callback(self._runner.close)
        self.closing.callback(self._finish_probe)
        self._hands = _Hands(self, self._source, self._runner)
        self._motion = MotionInterface(self.node_context, self._hands)
        self._controls = [
            self.endpoints.trigger_service("~/start", self._start),
            self.endpoints.trigger_service("~/stop", self._stop),
        ]
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(_LOOK_S, self._handle, clock=steady)
        if self.parameters["start"]:
            self._runner.start()

    # -- what it tells -----------------------------------------------------------------------------

    def introduction(self) -> list[str]:
        """Extend the base class: say which source, and whether it may be moved."""
        may = "may move it" if self.parameters["allow_motion"] else "does not move it"
        return [*super().introduction(), f"source {self._source_name}", may]

    def idle(self) -> bool:
        """Return whether no frame may come for a long time without a fault."""
        return not self._source.streams or not self._runner.wanted

    def conditions(self) -> list[str]:
        """Extend the base class: what is the matter with the source, its frames and its stage."""
        state = self._runner.state()
        found = super().conditions()
        if state.phase == "stopped":
            found.append("stopped")
        elif state.phase == "lost":
            found.append(f"source lost, trying again: {state.reason}")
        elif state.phase == "connecting":
            found.append(f"connecting for {state.blocked_s:.0f} s")
        elif state.blocked_s > _HUNG_S:
            found.append(f"source does not answer for {state.blocked_s:.0f} s")
        elif self._is_silent(state.silent_s):
            found.append(f"no frame for {state.silent_s:.0f} s")
        if self._waits_for_subscribers():
            found.append(f"files wait for subscribers of {self.config.image.topic}")
        return [*found, *self._watch.conditions(), *self._motion.conditions()]

    def _is_silent(self, silent_s: float) -> bool:
        limit_s = max(self.parameters["frame_timeout"], _FRAME_TIMES * self._frame_s)
        return self._source.streams and silent_s > limit_s

    # -- services ----------------------------------------------------------------------------------

    def _start(self) -> str:
        self._watch.acknowledge()
        self._motion.acknowledge()
        was_running = self._runner.wanted
        self._runner.start()
        return (
            "running already; what has changed since is taken for wanted"
            if was_running
            else "started"
        )

    def _stop(self) -> str:
        was_running = self._runner.wanted
        self._runner.stop()
        under_way = "; a move that is under way goes on to its end" if self._motion.busy else ""
        return f"{'stopped' if was_running else 'not running'}{under_way}"

    # -- frames ------------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Return the time on a steady clock, s: that of ROS stands still or goes back where it is simulated."""
        return time.monotonic()

    def _waits_for_subscribers(self) -> bool:
        wanted = int(self.parameters["wait_for_subscribers"])
        return (
            self._source.lossless and self._runner.waiting > 0 and self._output.listeners < wanted
        )

    def _handle(self) -> None:
        """Publish the frames that have come, and say what has happened to the source."""
        for error in self._runner.problems():
            self.reporter.reject(error)
        self._tell_phase()
        if self._probe is not None:
            self._is_heard()
        self._hands.check(self.parameters["motion_timeout"])
        while self._runner.waiting and self._runner.wanted and self._may_publish():
            frame = self._runner.take()
            if frame is None:
                return
            self._publish(frame)

    def _may_publish(self) -> bool:
        if not self._source.lossless:
            return True
        if self._waits_for_subscribers() or not self._is_heard():
            return False
        return self.now_s() - self._last_published_s >= 1.0 / self.parameters["max_rate"]

    def _is_heard(self) -> bool:
        """Return whether all subscribers hear what is published, or one frame shall go out to find that out.

        This side may know of a subscriber that has not found this side yet, and misses what is published meanwhile
        unless this process lives on to send it again. So the first frame after one has come is told to the journal,
        and followed by the next, only once it has been received.
        """
        listeners = self._output.listeners
        if self._probe is None:
            self._heard_by = min(self._heard_by, listeners)
            return True
        frame, count, since_s = self._probe
        if not self._output.is_taken() and self.now_s() - since_s < _PROBE_S:
            return False
        self._probe, self._heard_by = None, count
        self._confirm(frame)
        return True

    def _finish_probe(self) -> None:
        """Wait for the answer to a frame that is not in the journal yet, lest the next start publish it again."""
        if self._probe is not None and self._output.is_taken(_LAST_ANSWER_S):
            self._confirm(self._probe[0])

    def _publish(self, frame: SourceFrame) -> None:
        self.reporter.count_received()
        self._frame_s = frame.acquisition_s or 0.0
        if frame.start_ns < self._set_ns and not self._source.lossless:
            # Scanned, at least in part, at the magnification of before, for which receivers would not take it.
            self.reporter.statistics.drop()
            return
        try:
            for news in self._watch.see(frame):
                self.reporter.warn(news)
            stands = self._moving_since_ns is None and frame.start_ns >= self._stands_since_ns
            stamp_ns = self._output.publish(frame, stage=stands)
            self._last_published_s = self.now_s()
            self.reporter.count_published(stamp_ns)
        except SemcalError as error:
            self.reporter.reject(error)
        listeners = self._output.listeners
        if self._source.lossless and listeners > self._heard_by:
            self._probe = frame, listeners, self.now_s()
        else:
            self._confirm(frame)

    def _confirm(self, frame: SourceFrame) -> None:
        if not isinstance(self._source, ConfirmsFrames):
            return
        try:
            self._source.confirm(frame)
        except SemcalError as error:
            self.reporter.reject(error)

    def _tell_phase(self) -> None:
        state = self._runner.state()
        skipped, self._skipped = state.skipped - self._skipped, state.skipped
        if skipped:
            self.reporter.statistics.drop(skipped)
        self.reporter.note("source_state", state.phase)
        if state.phase == self._phase:
            return
        self._phase = state.phase
        if state.phase == "open":
            self.reporter.info(state.reason)
        elif state.phase == "lost" and self._motion.busy:
            self._motion.give_up("the source went away during a move")

    # -- moving ------------------------------------------------------------------------------------

    @property
    def motion(self) -> MotionInterface:
        """What is asked to move."""
        return self._motion

    def note_field_width(self, width_m: float, now_ns: int) -> None:
        """Take note of a field width that was set from here, at this time."""
        self._watch.asked(width_m, now_ns)
        self._set_ns = now_ns

    def note_move(self, position: Mapping[str, float] | None, now_ns: int) -> None:
        """Take note that the stage begins to move (None), or where it has arrived.

        Meanwhile its position is not known, whatever frames say that were begun before.
        """
        self._moving_since_ns = now_ns if position is None else None
        if position is not None:
            self._stands_since_ns = now_ns
        self._output.publish_stage(position or {}, now_ns)


class _Hands:
    """Moves the source in a thread of its own; a :class:`~semcal_ros.nodes.common.motion.Performer`."""

    def __init__(self, node: Microscope, source: object, runner: SourceRunner) -> None:
        self._node = node
        self._source = source
        self._runner = runner
        self._results: deque[Callable[[], None]] = deque()
        self._begun_s: float | None = None
        self._thread: threading.Thread | None = None
        self._guard = node.endpoints.guard(self._deliver)

    def obstacle(self) -> str:
        state = self._runner.state()
        if self._thread is not None and self._thread.is_alive():
            return "the microscope has not returned from the command before"
        return "" if state.phase == "open" else f"the source is {state.phase}"

    def position(self) -> Mapping[str, float]:
        if not isinstance(self._source, MovesStage):
            raise MicroscopeError(
                "a source whose stage cannot be moved", expected="a source that can, as openfibsem"
            )
        return self._source.stage_position()

    def own_limits(self) -> Mapping[str, tuple[float, float]]:
        return self._source.stage_limits() if isinstance(self._source, MovesStage) else {}

    def move(self, target: Mapping[str, float]) -> None:
        assert isinstance(self._source, MovesStage)
        self._note_move(None)
        try:
            self._source.move_stage(target)
        finally:
            position: Mapping[str, float] = {}
            with contextlib.suppress(Exception):  # the move itself tells what is wrong
                position = self._source.stage_position()
            self._note_move(position)

    def _note_move(self, position: Mapping[str, float] | None) -> None:
        now_ns = time.time_ns()
        self._results.append(lambda: self._node.note_move(position, now_ns))
        _quietly(self._guard.trigger)()

    def set_magnification(self, magnification: float) -> None:
        if not isinstance(self._source, SetsFieldWidth):
            raise MicroscopeError(
                "a source whose magnification cannot be set",
                expected="a source that can, as openfibsem",
            )
        width_m = self._node.config.display_width_m / magnification
        self._source.set_field_width(width_m)
        now_ns = time.time_ns()
        self._results.append(lambda: self._node.note_field_width(width_m, now_ns))

    def run(self, work: Callable[[], str], done: Callable[[str, SemcalError | None], None]) -> None:
        self._begun_s = self._node.now_s()

        def task() -> None:
            answer, problem = "", None
            try:
                answer = work()
            except SemcalError as error:
                problem = error
            except Exception as error:
                # Libraries of makers raise what they like.
                problem = MicroscopeError(f"{type(error).__name__}: {error}")
            self._results.append(lambda: done(answer, problem))
            _quietly(self._guard.trigger)()

        self._thread = threading.Thread(target=task, name="motion", daemon=True)
        self._thread.start()

    def _deliver(self) -> None:
        while self._results:
            self._results.popleft()()
        if not self._node.motion.busy:
            self._begun_s = None

    def check(self, timeout_s: float) -> None:
        """Give up a command that takes too long."""
        if self._begun_s is None or not self._node.motion.busy:
            return
        if self._node.now_s() - self._begun_s > timeout_s:
            self._begun_s = None
            self._node.motion.give_up(f"the microscope has not finished within {timeout_s:g} s")


def _quietly(trigger: Callable[[], None]) -> Callable[[], None]:
    """Return a call that does nothing once the node has ended."""

    def call() -> None:
        with contextlib.suppress(Exception):
            trigger()

    return call


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(Microscope, args)


if __name__ == "__main__":
    raise SystemExit(main())
