"""Executable ``bag_player``: a recording on its own topics, at any rate, without a ROS installation's tools."""

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
from semcal_ros.nodes.common.parameters import Setting
from semcal_ros.nodes.common.qos import overridable, stream_output, value_input
from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.common.services import service_queue

__all__ = ["BagPlayer", "main"]


class _Pacer:
    """Position in a recording that advances with a wall clock, which is an argument.

    Parameters
    ----------
    rate
        Seconds of recording per second.
    paused
        Whether it stands still at first.
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
        """Position at a wall time that does not go back, ns."""
        if self._wall_s is not None and not self.paused:
            self.position_ns += round((wall_s - self._wall_s) * self.rate * 1e9)
        self._wall_s = wall_s
        return self.position_ns

    def wait_s(self, target_ns: int, at_most_s: float) -> float:
        """Seconds of wall time until a position is reached, limited; the limit itself while paused."""
        if self.paused:
            return at_most_s
        return min(max(target_ns - self.position_ns, 0) * 1e-9 / self.rate, at_most_s)


_SETTINGS = (
    Setting("bag", "", "Recording: a rosbag2 folder, or an .mcap or .db3 file.", fixed=True),
    Setting("rate", 1.0, "Speed of the replay.", "s of recording per s", 0.001, 1000.0),
    Setting("loop", False, "Begin again at the end."),
    Setting("clock", False, "Publish the time of the recording on /clock.", fixed=True),
    Setting("start_paused", False, "Wait for ~/pause to be called with false.", fixed=True),
    Setting(
        "wait_for_subscribers",
        0,
        "Start when images and magnification (all topics, where there are none) have so many subscribers each.",
        low=0,
        high=100,
        fixed=True,
    ),
)
_TICK_S = 0.02
# Parts of a message that were lost are sent again every three seconds.
_ACK_S = 10.0
_HEARD_S = 10.0
_DEPTH = 10


class BagPlayer(SemNode):
    """Publishes the stored bytes of a recording; the node ends with the recording unless it loops."""

    def __init__(self) -> None:
        # The middleware may end a node that is still being made.
        self._changed = threading.Condition()
        self._ended = False
        self._thread: threading.Thread | None = None
        super().__init__("bag_player", _SETTINGS)
        if not self.settings["bag"]:
            raise ConfigError(
                "no recording", expected="the parameter bag", do="give --ros-args -p bag:=PATH"
            )
        self.exit_status = 0
        self._bag = open_bag(self.settings["bag"])
        # Topics whose last message reaches those who come later.
        self._lasting: set[str] = set()
        self._unheard = self.settings["wait_for_subscribers"] > 0
        self._publishers_by_topic = self._make_publishers()
        self._clock_publisher = (
            self.create_publisher(ClockMessage, "/clock", 10) if self.settings["clock"] else None
        )
        self._pacer = _Pacer(self.settings["rate"], paused=self.settings["start_paused"])
        # Shutting the context down from the replay's own thread would make that thread wait for itself.
        self._end = self.create_guard_condition(self._leave)
        self.settings.on_change("rate", self._set_rate)
        self._service = self.create_service(
            SetBool, "~/pause", self._on_pause, qos_profile=service_queue()
        )
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)
        self._thread.start()

    def idle(self) -> bool:
        """A replay takes no frames in."""
        return True

    def conditions(self) -> list[str]:
        """As in the base class; also whether the replay is paused."""
        return super().conditions() + ["paused"] * self._pacer.paused

    def destroy_node(self) -> None:
        """Stop the replay first."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
            self._bag.close()
        super().destroy_node()

    # -- topics ------------------------------------------------------------------------------------

    def _make_publishers(self) -> dict[str, Any]:
        publishers: dict[str, Any] = {}
        for topic in self._bag.topics:
            publisher = self._make_publisher(topic)
            if publisher is not None:
                publishers[topic.name] = publisher
        if not publishers:
            raise BagError(
                f"{self.settings['bag']} has no topic that can be published",
                expected="at least one topic of an installed message type",
            )
        return publishers

    def _make_publisher(self, topic: BagTopic) -> Any:
        """Publisher of a topic, or None, counted, where its type is not installed."""
        try:
            message_type = message_class(topic.type)
        except ConfigError as error:
            self.reject(error)
            return None
        # A magnification stays valid: who comes later must learn it.
        lasting = topic.latched or self._is_magnification(topic)
        if lasting:
            self._lasting.add(topic.name)
        profile = value_input(1) if lasting else stream_output(_DEPTH)
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
            while self.settings["loop"] and not self._ended:
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
        wanted = self.settings["wait_for_subscribers"]
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
            self.count_published(None)
            if self._unheard and message.topic in self._lasting:
                self._be_heard(publisher, message.log_time_ns)

    def _be_heard(self, publisher: Any, position_ns: int) -> None:
        """Wait until subscribers have found this node, too: that it knows of them does not say so. They get a lasting
        message however late they find it, and only then answer.
        """
        self._unheard = False
        publisher.wait_for_all_acked(Duration(seconds=_HEARD_S))
        with self._changed:
            self._pacer.seek(position_ns)

    def _wait_until(self, target_ns: int) -> bool:
        """Wait for a position of the recording; False if the replay shall end."""
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
        """Give reliable subscribers the time to get the last messages."""
        for publisher in [] if self._ended else self._publishers_by_topic.values():
            publisher.wait_for_all_acked(Duration(seconds=_ACK_S))


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(BagPlayer, args)


if __name__ == "__main__":
    raise SystemExit(main())
