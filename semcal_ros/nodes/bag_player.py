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

"""Executable ``bag_player``: replays a recording on its own topics, at any rate, without ROS command-line tools."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import rclpy.utilities
from diagnostic_msgs.msg import DiagnosticArray
from rclpy._rclpy_pybind11 import RCLError
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from semcal_ros.bridge.conditions import CONDITIONS_TYPE
from semcal_ros.bridge.fields import fill_stamp
from semcal_ros.core.errors import (
    BagError,
    ConfigError,
    InvalidValueError,
    MessageError,
    SemcalError,
)
from semcal_ros.files.bags.held_values import CONDITIONS_TOPIC
from semcal_ros.files.bags.reader import BagTopic, RawMessage, open_bag, topic_matches
from semcal_ros.middleware import message_class
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.endpoints import PatientPublisher
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.qos import overridable, service_queue, stream_output, value_input
from semcal_ros.nodes.common.run import run_node


class _Pacer:
    """Position in a recording that advances with a wall clock; wall times are arguments.

    Parameters
    ----------
    rate
        Seconds of recording per second.
    paused
        Whether the position stands still at first.
    """

    def __init__(self, rate: float = 1.0, *, paused: bool = False) -> None:
        self.rate = rate
        self.paused = paused
        self.position_ns = 0
        self._wall_s: float | None = None

    def seek(self, position_ns: int) -> None:
        """Go to a position, ns."""
        self.position_ns = position_ns
        self._wall_s = None

    def advance(self, wall_s: float) -> int:
        """Return the position at a wall time, ns; wall times must not decrease."""
        if self._wall_s is not None and not self.paused:
            self.position_ns += round((wall_s - self._wall_s) * self.rate * 1e9)
        self._wall_s = wall_s
        return self.position_ns

    def wait_s(self, target_ns: int, at_most_s: float) -> float:
        """Return the wall time until a position is reached, s, at most the limit; the limit while paused."""
        if self.paused:
            return at_most_s
        return min(max(target_ns - self.position_ns, 0) * 1e-9 / self.rate, at_most_s)


_RATE_RANGE = (0.001, 1000.0)
_PARAMETERS = (
    ParameterDeclaration(
        "bag", "", "Recording: a rosbag2 folder, or an .mcap or .db3 file.", fixed=True
    ),
    ParameterDeclaration(
        "topics",
        "inputs",
        "What is played: inputs (images, magnification and stage by the configuration, and conditions); all, also what"
        " nodes of the suite published while it was recorded; or names of topics, with commas between them. A name"
        " without a leading / stands for every topic that ends with it.",
        fixed=True,
    ),
    ParameterDeclaration(
        "exclude",
        "",
        "Names of topics that are not played, with commas between them.",
        fixed=True,
    ),
    ParameterDeclaration("rate", 1.0, "Speed of the replay.", "s of recording per s", *_RATE_RANGE),
    ParameterDeclaration("loop", False, "Start again at the end."),
    ParameterDeclaration(
        "clock", False, "Publish the time of the recording on /clock.", fixed=True
    ),
    ParameterDeclaration(
        "start_paused", False, "Wait for ~/resume, ~/play_next or ~/pause with false.", fixed=True
    ),
    ParameterDeclaration(
        "wait_for_subscribers",
        0,
        "Start once images and magnification (all topics, if there are none) have this many subscribers each.",
        low=0,
        high=100,
        fixed=True,
    ),
    ParameterDeclaration(
        "wait_for",
        "",
        "Start once these topics have so many subscribers each, as in `image:2 magnification:3 image_stabilized:1`."
        " image, magnification and stage are the configured topics; of a topic that is not in the recording the node"
        " that publishes it says in its diagnostics how many it has.",
        fixed=True,
    ),
)
# Between two values of /clock, s: finer than the interval between frames that live tracking keeps up with.
_TICK_S = 0.02
# Fast DDS sends lost parts of a message again every three seconds: three chances.
_ACK_S = 10.0
# Discovery takes a second, and several on a busy machine; afterwards the replay begins in any case.
_DISCOVERY_S = 10.0
# The replay's thread checks every _TICK_S whether it should end; only a read from disk can take
# longer.
_END_S = 5.0
# Between two lines of the log about the progress, s: often enough to see that it goes on.
_PROGRESS_S = 10.0
# A subscriber that has not come after this time is worth a line, s: nodes take two or three to start.
_IMPATIENT_S = 5.0
# ~/play_next answers when its frame is out, s: the longest that a client waits for the disk.
_STEP_S = 5.0
# Topics on which the suite publishes: played, they would come a second time, and the calibration would be replaced.
_OUTPUTS = (
    *("calibration", "image_rect", "image_stabilized", "camera_info", "projection"),
    *("projection_stamped", "projection_covariance", "projection_covariance_stamped"),
    *("drift", "drift_velocity"),
)
# Queue length per topic: a burst of messages with nearly the same log time goes out at once.
_DEPTH = 10


class BagPlayer(SemNode):
    """Publishes the stored bytes of a recording; the node ends with the recording unless it loops."""

    def __init__(self) -> None:
        super().__init__("bag_player", _PARAMETERS)
        if not self.parameters["bag"]:
            raise ConfigError(
                "no recording", expected="the parameter bag", do="give --ros-args -p bag:=PATH"
            )
        self.exit_status = 0
        self._bag = open_bag(self.parameters["bag"])
        self.closing.callback(self._bag.close)
        # Topics whose last message reaches late subscribers too.
        self._latched: set[str] = set()
        self._publishers_by_topic = self._make_publishers(self._choose_topics())
        self._frames = self._find_frames()
        self._wanted = self._wanted_subscribers()
        # Latched topics whose subscribers may not have discovered this node yet.
        self._undiscovered = set(self._latched) if self._wanted else set()
        # Of topics of other nodes, by name.
        self._reported: dict[str, int] = {}
        self._clock_publisher = (
            self.create_publisher(ClockMessage, "/clock", 10) if self.parameters["clock"] else None
        )
        self._pacer = _Pacer(self.parameters["rate"], paused=self.parameters["start_paused"])
        # Shutting the context down from the replay's own thread would make that thread wait for itself.
        self._end = self.create_guard_condition(self._leave)
        self._changed = threading.Condition()
        self._ended = False
        self._started = False
        self._steps = 0
        self._played = 0
        self._target_ns: int | None = None
        self._reported_s = time.monotonic()
        self._make_controls()
        self._announce()
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)
        self.closing.callback(self._end_replay)

    def begin(self) -> None:
        """Override the base class: the replay begins."""
        self._thread.start()

    def idle(self) -> bool:
        """Return True: a replay receives no frames."""
        return True

    def conditions(self) -> list[str]:
        """Extend the base class: also report whether the replay is paused."""
        return super().conditions() + ["paused"] * self._pacer.paused

    def _end_replay(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=_END_S)

    # -- topics ------------------------------------------------------------------------------------

    def _choose_topics(self) -> list[BagTopic]:
        recorded = list(self._bag.topics)
        asked = _split_names(self.parameters["topics"])
        chosen = recorded
        if asked == ["inputs"]:
            chosen = [topic for topic in recorded if self._role(topic)]
            if not any(self._role(topic) == "image" for topic in chosen):
                raise self._not_found(
                    f"images on {self.config.image.topic} of type {self.config.image.type}",
                    "set config to that of the recording, or topics to all",
                )
        elif asked != ["all"]:
            for name in asked:
                if not any(topic_matches(name, topic.name) for topic in recorded):
                    raise self._not_found(f"topic {name}", "check the parameter topics")
            chosen = [t for t in recorded if any(topic_matches(n, t.name) for n in asked)]
        excluded = _split_names(self.parameters["exclude"])
        return [t for t in chosen if not any(topic_matches(n, t.name) for n in excluded)]

    def _not_found(self, what: str, do: str) -> BagError:
        names = ", ".join(f"{topic.name} ({topic.type})" for topic in self._bag.topics)
        return BagError(
            f"{self.parameters['bag']} has no {what}", expected=f"one of {names}", do=do
        )

    def _role(self, topic: BagTopic) -> str:
        """Return ``image``, ``magnification``, ``stage`` or ``conditions`` for an input of the suite, else nothing."""
        if topic.type == CONDITIONS_TYPE and topic_matches(CONDITIONS_TOPIC, topic.name):
            return "conditions"
        sources: dict[str, Any] = {
            "image": self.config.image,
            "magnification": self.config.magnification,
            "stage": self.config.stage,
        }
        for role, source in sources.items():
            # The stage has one type and does not name it.
            fits = source is not None and topic.type == getattr(source, "type", topic.type)
            if fits and topic_matches(source.topic, topic.name):
                return role
        return ""

    def _make_publishers(self, topics: list[BagTopic]) -> dict[str, Any]:
        publishers: dict[str, Any] = {}
        for topic in topics:
            publisher = self._make_publisher(topic)
            if publisher is not None:
                publishers[topic.name] = publisher
        if not publishers:
            raise BagError(
                f"{self.parameters['bag']} has no topic that can be published",
                expected="at least one topic of an installed message type",
                do="check the parameters topics and exclude" if self._bag.topics else "",
            )
        return publishers

    def _make_publisher(self, topic: BagTopic) -> Any:
        """Make the publisher of a topic; count and return None if its type is not installed."""
        try:
            message_type = message_class(topic.type)
        except ConfigError as error:
            self.reporter.reject(error)
            return None
        # A magnification stays valid, as conditions do, so a node that is started later must receive it.
        is_latched = topic.latched or self._role(topic) in ("magnification", "conditions")
        if is_latched:
            self._latched.add(topic.name)
        profile = value_input(1) if is_latched else stream_output(_DEPTH)
        return self.create_publisher(
            message_type,
            topic.name,
            profile,
            qos_overriding_options=overridable(),
            publisher_class=PatientPublisher,
        )

    def _find_frames(self) -> set[str]:
        """Return the topics of the images that are counted and stepped; all topics, if there are no images."""
        played = [topic for topic in self._bag.topics if topic.name in self._publishers_by_topic]
        frames = {topic.name for topic in played if self._role(topic) == "image"}
        frames = frames or {t.name for t in played if t.type == self.config.image.type}
        return frames or {topic.name for topic in played}

    def _announce(self) -> None:
        counts = {topic.name: topic.count for topic in self._bag.topics}
        played = [
            f"{publisher.topic_name} ({counts[name]})"
            for name, publisher in self._publishers_by_topic.items()
        ]
        left_out = [name for name in counts if name not in self._publishers_by_topic]
        text = f"{self.parameters['bag']}: {', '.join(played)}; {self._bag.duration_s:.1f} s"
        text += f" at rate {self.parameters['rate']:g}" + ", paused" * self._pacer.paused
        if left_out:
            text += f"; not played: {', '.join(left_out)}"
        self.reporter.info(text)
        outputs = [
            name
            for name in self._publishers_by_topic
            if any(topic_matches(output, name) for output in _OUTPUTS)
        ]
        if outputs:
            self.reporter.warn(
                f"the recording holds what nodes of the suite publish: {', '.join(outputs)}. If they run, it comes"
                " twice, and a recorded calibration is used where none is in force; the default, topics:=inputs, leaves"
                " it out"
            )

    # -- control -----------------------------------------------------------------------------------

    def _make_controls(self) -> None:
        self.parameters.on_change("rate", self._set_rate)
        self._pause = self.create_service(
            SetBool, "~/pause", self._on_pause, qos_profile=service_queue()
        )
        self.endpoints.trigger_service("~/resume", lambda: self._set_paused(False))
        self.endpoints.trigger_service(
            "~/toggle_paused", lambda: self._set_paused(not self._pacer.paused)
        )
        self.endpoints.trigger_service("~/play_next", self._play_next)
        # Numbers come as messages, for std_srvs has no service that takes one.
        self._knobs = [
            self.create_subscription(Float64, name, handler, stream_output(10))
            for name, handler in (("~/set_rate", self._on_rate), ("~/seek", self._on_seek))
        ]

    def _set_rate(self, rate: float) -> None:
        with self._changed:
            self._pacer.advance(time.monotonic())
            self._pacer.rate = rate
            self._changed.notify_all()

    def _on_rate(self, message: Any) -> None:
        # By way of the parameter, which refuses what is out of range and shows the rate in use.
        answer = self.set_parameters([Parameter("rate", value=float(message.data))])[0]
        if not answer.successful:
            self.reporter.reject(InvalidValueError(f"~/set_rate: {answer.reason}"))

    def _on_pause(self, request: Any, response: Any) -> Any:
        response.message = self._set_paused(bool(request.data))
        response.success = True
        return response

    def _set_paused(self, paused: bool) -> str:
        with self._changed:
            self._pacer.advance(time.monotonic())
            self._pacer.paused = paused
            self._changed.notify_all()
        return "paused" if paused else "playing"

    def _play_next(self) -> str:
        """Play up to the next image; only while paused."""
        with self._changed:
            if not self._pacer.paused:
                raise InvalidValueError(
                    "the replay is not paused", expected="a paused one", do="call ~/pause with true"
                )
            if not self._started:
                raise InvalidValueError(
                    "the replay has not begun: it waits for subscribers",
                    expected=f"the subscribers {self._wanted}",
                )
            self._steps += 1
            self._changed.notify_all()
            done = self._changed.wait_for(lambda: not self._steps or self._ended, _STEP_S)
            if not done:
                self._steps = 0
                raise BagError(f"no frame in {_STEP_S:g} s", expected="a readable recording")
            return self._progress()

    def _on_seek(self, message: Any) -> None:
        seconds = float(message.data)
        if not 0.0 <= seconds <= self._bag.duration_s:
            self.reporter.reject(
                InvalidValueError(
                    f"~/seek to {seconds:g} s",
                    expected=f"seconds since the start, 0 to {self._bag.duration_s:.3f}",
                )
            )
            return
        with self._changed:
            self._target_ns = self._bag.start_ns + round(seconds * 1e9)
            self._changed.notify_all()

    # -- replay ------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._wait_for_subscribers()
            begun_s = time.monotonic()
            self._play_once()
            while self.parameters["loop"] and not self._ended:
                self._play_once()
            self._flush()
            if not self._ended:
                self.reporter.info(
                    f"played {self._played} frames in {time.monotonic() - begun_s:.1f} s"
                )
        except SemcalError as error:
            self.exit_status = 2
            self.get_logger().error(str(error))
        finally:
            with self._changed:
                self._steps = 0
                self._changed.notify_all()
            if not self._ended:
                self._end.trigger()

    def _leave(self) -> None:
        raise ExternalShutdownException

    def _progress(self) -> str:
        position_s = (self._pacer.position_ns - self._bag.start_ns) * 1e-9
        return f"{position_s:.1f} of {self._bag.duration_s:.1f} s, {self._played} frames played"

    # -- subscribers -------------------------------------------------------------------------------

    def _wanted_subscribers(self) -> dict[str, int]:
        """Return how many subscribers each topic must have, by its name in the recording or by that of another node."""
        recorded = {t.name: t for t in self._bag.topics if t.name in self._publishers_by_topic}
        wanted: dict[str, int] = {}
        if number := self.parameters["wait_for_subscribers"]:
            values = {n for n, topic in recorded.items() if self._role(topic) == "magnification"}
            names = values | self._frames
            wanted = dict.fromkeys(names, number)
        for word in self.parameters["wait_for"].split():
            name, _, count = word.rpartition(":")
            if not name or not count.isdecimal():
                raise InvalidValueError(
                    f"wait_for {word!r}", expected="topics and counts, such as magnification:2"
                )
            names = {n for n, topic in recorded.items() if name in (self._role(topic), n)}
            if not names and name not in ("image", "magnification", "stage"):
                names = {name}
            wanted.update({n: max(wanted.get(n, 0), int(count)) for n in names})
        return {name: count for name, count in wanted.items() if count}

    def _missing_subscribers(self) -> list[str]:
        missing = []
        for name, count in self._wanted.items():
            publisher = self._publishers_by_topic.get(name)
            found = publisher.get_subscription_count() if publisher else self._reported.get(name, 0)
            if found < count:
                shown = publisher.topic_name if publisher else name
                missing.append(f"{shown} has {found} of {count}")
        return missing

    def _wait_for_subscribers(self) -> None:
        others = [name for name in self._wanted if name not in self._publishers_by_topic]
        # What another node knows of its own subscribers counts, not what this one sees of them.
        diagnostics = (
            self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
            if others
            else None
        )
        reported_s = time.monotonic() - _PROGRESS_S + _IMPATIENT_S
        while not self._ended and (missing := self._missing_subscribers()):
            if time.monotonic() - reported_s >= _PROGRESS_S:
                reported_s = time.monotonic()
                self.reporter.info(f"waiting for subscribers: {', '.join(missing)}")
            self._pause_for(_TICK_S)
        if diagnostics is not None:
            self.destroy_subscription(diagnostics)
        with self._changed:
            self._started = True
            self._reported_s = time.monotonic()

    def _on_diagnostics(self, message: Any) -> None:
        namespace = self.get_namespace().rstrip("/")
        for status in message.status:
            if not status.name.startswith(f"{namespace}/"):
                continue
            for value in status.values:
                topic = value.key.removeprefix("subscribers.")
                if topic != value.key and value.value.isdecimal():
                    self._reported[topic] = int(value.value)

    def _pause_for(self, seconds: float) -> None:
        with self._changed:
            if not self._ended:
                self._changed.wait(seconds)

    def _wait_for_discovery(self, topic: str, position_ns: int) -> None:
        """Wait until the subscribers of a latched topic have discovered this node.

        That it knows them does not prove it. A latched message reaches them however late they discover it, and only
        then do they acknowledge it. One topic says nothing of another, which may have no subscriber at all.
        """
        self._undiscovered.remove(topic)
        self._publishers_by_topic[topic].wait_for_all_acked(Duration(seconds=_DISCOVERY_S))
        with self._changed:
            self._pacer.seek(position_ns)

    # -- messages ----------------------------------------------------------------------------------

    def _play_once(self) -> None:
        """Play from the start to the end, and from wherever ~/seek asks for."""
        start_ns: int | None = self._bag.start_ns
        while start_ns is not None:
            with self._changed:
                self._pacer.seek(start_ns)
            if start_ns > self._bag.start_ns:
                self._restore(start_ns)
            self._play_from(start_ns)
            with self._changed:
                start_ns, self._target_ns = self._target_ns, None

    def _restore(self, start_ns: int) -> None:
        """Publish what was in force at a position: the last message before it on each latched topic."""
        last: dict[str, RawMessage] = {}
        for message in self._bag.raw_messages(self._latched, stop_ns=start_ns):
            last[message.topic] = message
        for message in last.values():
            self._publish(message)

    def _play_from(self, start_ns: int) -> None:
        # Only a reading from the start checks that the recording holds what it declares.
        later = None if start_ns <= self._bag.start_ns else start_ns
        for message in self._bag.raw_messages(self._publishers_by_topic, start_ns=later):
            if not self._wait_until(message.log_time_ns):
                return
            self._publish_clock(message.log_time_ns)
            self._publish(message)
            if message.topic in self._frames:
                self._count_frame(message.log_time_ns)

    def _publish(self, message: RawMessage) -> None:
        publisher = self._publishers_by_topic[message.topic]
        try:
            publisher.publish(bytes(message.data))
        except (MessageError, RCLError) as error:
            if not rclpy.utilities.ok():
                raise
            # One damaged message in a recording leaves the others as they are.
            self.reporter.reject(error)
            return
        self.reporter.count_published(None)
        if message.topic in self._undiscovered:
            self._wait_for_discovery(message.topic, message.log_time_ns)

    def _count_frame(self, position_ns: int) -> None:
        with self._changed:
            self._played += 1
            if self._pacer.paused:
                self._pacer.seek(position_ns)
            if self._steps:
                self._steps -= 1
                self._changed.notify_all()
            if time.monotonic() - self._reported_s < _PROGRESS_S:
                return
            self._reported_s = time.monotonic()
            progress = self._progress()
        self.reporter.info(progress)

    def _wait_until(self, target_ns: int) -> bool:
        """Wait for a position of the recording; return False if the replay must end or go elsewhere."""
        while True:
            with self._changed:
                if self._ended or self._target_ns is not None:
                    return False
                position_ns = self._pacer.advance(time.monotonic())
                if self._pacer.paused:
                    if self._steps:
                        return True
                elif position_ns >= target_ns:
                    return True
                delay_s = self._pacer.wait_s(target_ns, _TICK_S)
            self._publish_clock(min(position_ns, target_ns))
            self._pause_for(delay_s)

    def _publish_clock(self, position_ns: int) -> None:
        if self._clock_publisher is not None:
            message = ClockMessage()
            fill_stamp(message.clock, position_ns)
            self._clock_publisher.publish(message)

    def _flush(self) -> None:
        """Give reliable subscribers time to receive the last messages."""
        for publisher in [] if self._ended else self._publishers_by_topic.values():
            publisher.wait_for_all_acked(Duration(seconds=_ACK_S))


def _split_names(text: str) -> list[str]:
    return text.replace(",", " ").split()


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(BagPlayer, args)


if __name__ == "__main__":
    raise SystemExit(main())
