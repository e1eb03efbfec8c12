"""Executable ``bag_player``: replays a recording on its own topics, at any rate, without ROS command-line tools."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from semcal_ros.bridge.headers import fill_stamp
from semcal_ros.core.errors import BagError, ConfigError, SemcalError
from semcal_ros.files.bags.reader import BagTopic, RawMessage, open_bag
from semcal_ros.middleware.message_types import message_class
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.qos import overridable, service_queue, stream_output, value_input
from semcal_ros.nodes.common.run import run_node

__all__ = ["BagPlayer", "main"]


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


_PARAMETERS = (
    ParameterDeclaration(
        "bag", "", "Recording: a rosbag2 folder, or an .mcap or .db3 file.", fixed=True
    ),
    ParameterDeclaration(
        "rate", 1.0, "Speed of the replay.", "s of recording per s", 0.001, 1000.0
    ),
    ParameterDeclaration("loop", False, "Start again at the end."),
    ParameterDeclaration(
        "clock", False, "Publish the time of the recording on /clock.", fixed=True
    ),
    ParameterDeclaration(
        "start_paused", False, "Wait for ~/pause to be called with false.", fixed=True
    ),
    ParameterDeclaration(
        "wait_for_subscribers",
        0,
        "Start once images and magnification (all topics, if there are none) have this many subscribers each.",
        low=0,
        high=100,
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
        self._undiscovered = self.parameters["wait_for_subscribers"] > 0
        self._publishers_by_topic = self._make_publishers()
        self._clock_publisher = (
            self.create_publisher(ClockMessage, "/clock", 10) if self.parameters["clock"] else None
        )
        self._pacer = _Pacer(self.parameters["rate"], paused=self.parameters["start_paused"])
        # Shutting the context down from the replay's own thread would make that thread wait for itself.
        self._end = self.create_guard_condition(self._leave)
        self.parameters.on_change("rate", self._set_rate)
        self._service = self.create_service(
            SetBool, "~/pause", self._on_pause, qos_profile=service_queue()
        )
        self._changed = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)
        self._thread.start()
        self.closing.callback(self._end_replay)

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
        self._thread.join(timeout=_END_S)

    # -- topics ------------------------------------------------------------------------------------

    def _make_publishers(self) -> dict[str, Any]:
        publishers: dict[str, Any] = {}
        for topic in self._bag.topics:
            publisher = self._make_publisher(topic)
            if publisher is not None:
                publishers[topic.name] = publisher
        if not publishers:
            raise BagError(
                f"{self.parameters['bag']} has no topic that can be published",
                expected="at least one topic of an installed message type",
            )
        return publishers

    def _make_publisher(self, topic: BagTopic) -> Any:
        """Make the publisher of a topic; count and return None if its type is not installed."""
        try:
            message_type = message_class(topic.type)
        except ConfigError as error:
            self.reporter.reject(error)
            return None
        # A magnification stays valid, so a node that is started later must receive it.
        is_latched = topic.latched or self._is_magnification(topic)
        if is_latched:
            self._latched.add(topic.name)
        profile = value_input(1) if is_latched else stream_output(_DEPTH)
        return self.create_publisher(
            message_type, topic.name, profile, qos_overriding_options=overridable()
        )

    def _is_magnification(self, topic: BagTopic) -> bool:
        source = self.config.magnification
        return topic.type == source.type and topic.name.endswith("/" + source.topic.lstrip("/"))

    # -- control -----------------------------------------------------------------------------------

    def _set_rate(self, rate: float) -> None:
        with self._changed:
            self._pacer.advance(time.monotonic())
            self._pacer.rate = rate
            self._changed.notify_all()

    def _on_pause(self, request: Any, response: Any) -> Any:
        with self._changed:
            self._pacer.advance(time.monotonic())
            self._pacer.paused = bool(request.data)
            self._changed.notify_all()
        response.success = True
        response.message = "paused" if request.data else "playing"
        return response

    # -- replay ------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._wait_for_subscribers()
            self._play_once()
            while self.parameters["loop"] and not self._ended:
                self._play_once()
            self._flush()
        except SemcalError as error:
            self.exit_status = 2
            self.get_logger().error(str(error))
        except RuntimeError:
            # Publishing fails once a signal has shut the middleware down.
            if self.context.ok():
                raise
        finally:
            if not self._ended and self.context.ok():
                self._end.trigger()

    def _leave(self) -> None:
        raise ExternalShutdownException

    def _wait_for_subscribers(self) -> None:
        wanted = self.parameters["wait_for_subscribers"]
        images = self.config.image.type
        streams = [t for t in self._bag.topics if t.type == images or self._is_magnification(t)]
        names = {t.name for t in streams} & set(self._publishers_by_topic)
        awaited = [self._publishers_by_topic[name] for name in names or self._publishers_by_topic]
        while not self._ended and any(p.get_subscription_count() < wanted for p in awaited):
            self._pause_for(_TICK_S)

    def _pause_for(self, seconds: float) -> None:
        with self._changed:
            if not self._ended:
                self._changed.wait(seconds)

    def _messages(self) -> Iterator[RawMessage]:
        return self._bag.raw_messages(self._publishers_by_topic)

    def _play_once(self) -> None:
        with self._changed:
            self._pacer.seek(self._bag.start_ns)
        for message in self._messages():
            if not self._wait_until(message.log_time_ns):
                return
            self._publish_clock(message.log_time_ns)
            publisher = self._publishers_by_topic[message.topic]
            publisher.publish(bytes(message.data))
            self.reporter.count_published(None)
            if self._undiscovered and message.topic in self._latched:
                self._wait_for_discovery(publisher, message.log_time_ns)

    def _wait_for_discovery(self, publisher: Any, position_ns: int) -> None:
        """Wait until the subscribers have discovered this node: that it knows them does not prove it.

        A latched message reaches them however late they discover it, and only then do they acknowledge it.
        """
        self._undiscovered = False
        publisher.wait_for_all_acked(Duration(seconds=_DISCOVERY_S))
        with self._changed:
            self._pacer.seek(position_ns)

    def _wait_until(self, target_ns: int) -> bool:
        """Wait for a position of the recording; return False if the replay must end."""
        while True:
            with self._changed:
                if self._ended:
                    return False
                position_ns = self._pacer.advance(time.monotonic())
                if position_ns >= target_ns and not self._pacer.paused:
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


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(BagPlayer, args)


if __name__ == "__main__":
    raise SystemExit(main())
