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

"""The publishers, subscriptions and services of a node, created alike and monitored together.

A short want of room in the middleware does not end a publisher, and it knows who waits for messages.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from typing import Any, Protocol

import rclpy.utilities
from rclpy._rclpy_pybind11 import RCLError, RMWError
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from semcal_ros.core.errors import MessageError
from semcal_ros.nodes.common.qos import (
    camera_output,
    latched,
    overridable,
    service_queue,
    stream_output,
)
from semcal_ros.nodes.common.reporter import NODE_ERRORS, describe_fault
from semcal_ros.nodes.common.subscription import AdaptiveSubscription, MessageInfo

# Fast DDS waits 100 ms by itself before it refuses, so these are a second. A stream does not want to wait for longer.
_TRIES = 10

Post = Callable[[Callable[[], None]], None]


class MemoryReceiver(Protocol):
    """Takes messages that a node of the same process publishes."""

    def deliver(self, message: Any, sent_ns: int, number: int) -> None:
        """Take a message, when it was published, ns, and its number among those of its publisher."""


class PatientPublisher(Publisher):
    """Publishes again where the middleware refuses, and raises what it says if that lasts.

    Nodes of the same process may get the messages :meth:`in memory <hand_to>`; the middleware then gets only those that
    somebody else subscribes to.

    Fast DDS 3 (Kilted) has been seen to refuse a message of a reliable publisher ("cannot publish data") on a busy
    machine when nothing is left between the messages. rclpy raises, and the node would end.
    """

    _has_published = False
    _receivers: tuple[MemoryReceiver, ...] = ()
    _number = 0
    # The last message, for receivers that come later, and when it was published.
    _last: tuple[Any, int] | None = None

    @property
    def hands_over(self) -> bool:
        """Whether messages go to receivers in memory, and so must not be changed once they are published."""
        return bool(self._receivers)

    def hand_to(self, receiver: MemoryReceiver) -> None:
        """Hand every message to ``receiver``, too; of a topic that keeps its last message, that one now."""
        self._receivers = (*self._receivers, receiver)
        if self._last is not None:
            message, sent_ns = self._last
            receiver.deliver(self._unpacked(message), sent_ns, self._number)

    def get_subscription_count(self) -> int:
        """Extend the base class: receivers in memory count."""
        return int(super().get_subscription_count()) + len(self._receivers)

    @property
    def _keeps(self) -> bool:
        return bool(self.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)

    @property
    def is_awaited(self) -> bool:
        """Whether the next message is worth making.

        It is if there is a subscriber, or if the middleware keeps an earlier message for those that come later: what is
        kept must not be older than the stream.
        """
        if self.get_subscription_count():
            return True
        return self._has_published and self._keeps

    def publish(self, msg: Any) -> None:
        """Extend the base class: hand it over in memory, and try again."""
        self._has_published = True
        if self._hand_over(msg):
            return
        for _ in range(_TRIES - 1):
            if self._takes(msg):
                return
        super().publish(msg)

    def _hand_over(self, message: Any) -> bool:
        """Hand a message to the receivers; return whether nobody else waits for it."""
        self._number += 1
        if not self._receivers and not self._keeps:
            return False
        sent_ns = time.time_ns()
        if self._keeps:
            self._last = message, sent_ns
        unpacked = self._unpacked(message) if self._receivers else message
        for receiver in self._receivers:
            receiver.deliver(unpacked, sent_ns, self._number)
        return not self._keeps and not super().get_subscription_count()

    def _unpacked(self, message: Any) -> Any:
        return unpack(message, self.msg_type) if isinstance(message, bytes) else message

    def _takes(self, msg: Any) -> bool:
        try:
            super().publish(msg)
        except RCLError:
            if not rclpy.utilities.ok():
                raise
            return False
        return True


def unpack(data: bytes, message_type: Any) -> Any:
    """Return the message of a type from its serialized bytes.

    Raises
    ------
    MessageError
        If they are damaged, as in a recording that was cut off.
    """
    try:
        return deserialize_message(data, message_type)
    except RMWError as error:
        raise _damaged(data) from error


def read_stamp_ns(data: bytes) -> int:
    """Read the stamp of a serialized message that begins with a header, ns.

    Raises
    ------
    MessageError
        If there are too few bytes for one.
    """
    try:
        # Four bytes of encapsulation, the second of which says the byte order; then the stamp, with which
        # std_msgs/Header and so every image begins.
        order = "<" if data[1] & 1 else ">"
        seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)
    except (IndexError, struct.error) as error:
        raise _damaged(data) from error
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _damaged(data: bytes) -> MessageError:
    return MessageError(
        f"a serialized message of {len(data)} bytes that cannot be read",
        expected="a message as it was published",
        do="check the recording or the bridge that it comes from",
    )


class Guard:
    """A condition that any thread may trigger; the node's executor runs its callback.

    Parameters
    ----------
    node
        The node.
    callback
        What is run.
    group
        Its callback group.
    """

    def __init__(
        self, node: Node, callback: Callable[[], None], group: CallbackGroup | None = None
    ) -> None:
        self._callback = callback
        self._condition = node.create_guard_condition(callback, callback_group=group)
        self.post: Post | None = None

    def trigger(self) -> None:
        """Let the callback run soon."""
        if self.post is None:
            self._condition.trigger()
        else:
            self.post(self._callback)


class Endpoints:
    """Creates what connects a node with others; everything it creates lives as long as the node.

    Parameters
    ----------
    node
        The ROS node that owns what is created.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscriptions: list[AdaptiveSubscription] = []
        self._publishers: dict[str, Any] = {}
        self._guards: list[Guard] = []
        self._post: Post | None = None

    def subscribe(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[Any, MessageInfo], None],
        profile: QoSProfile,
        group: CallbackGroup | None = None,
        *,
        raw: bool = False,
        source: str = "",
        streams: bool = False,
    ) -> AdaptiveSubscription:
        """Subscribe; the callback takes the message, or its bytes if ``raw``, and its information.

        ``source`` and ``streams`` are those of :class:`AdaptiveSubscription`.
        """
        subscription = AdaptiveSubscription(
            self._node,
            message_type,
            topic,
            callback,
            profile,
            group,
            raw=raw,
            source=source,
            streams=streams,
        )
        self._subscriptions.append(subscription)
        return subscription

    def stream_publisher(self, message_type: Any, topic: str, name: str | None = None) -> Any:
        """Create a publisher of messages that belong to single frames.

        ``name`` is the full name of a topic that follows another one.
        """
        return self._publisher(message_type, topic, stream_output(), name)

    def camera_publisher(self, message_type: Any, topic: str, name: str) -> Any:
        """Create a publisher of the cameras of single frames, with a name as for :meth:`stream_publisher`."""
        return self._publisher(message_type, topic, camera_output(), name)

    def beside(self, topic: str, neighbour: str) -> str:
        """Return the full name of a topic in the namespace of another one, which may have been remapped.

        A remap of ``topic`` itself counts more.
        """
        resolved = self._node.resolve_topic_name(topic)
        if resolved != self._node.resolve_topic_name(topic, only_expand=True):
            return resolved
        return f"{self._node.resolve_topic_name(neighbour).rpartition('/')[0]}/{topic}"

    def below(self, topic: str, name: str) -> str:
        """Return the full name ``<topic>/<name>``, where ``topic`` may have been remapped."""
        named = f"{topic}/{name}"
        resolved = self._node.resolve_topic_name(named)
        if resolved != self._node.resolve_topic_name(named, only_expand=True):
            return resolved
        return f"{self._node.resolve_topic_name(topic)}/{name}"

    def latched_publisher(self, message_type: Any, topic: str) -> Any:
        """Create a publisher whose last message also reaches late subscribers."""
        return self._publisher(message_type, topic, latched())

    def _publisher(
        self, message_type: Any, topic: str, profile: QoSProfile, name: str | None = None
    ) -> Any:
        publisher = self._node.create_publisher(
            message_type,
            name or topic,
            profile,
            qos_overriding_options=overridable(),
            publisher_class=PatientPublisher,
        )
        self._publishers[topic] = publisher
        return publisher

    def take_in_memory_from(self, source: Node) -> None:
        """Let the publishers of another node of this process hand their messages over to these subscriptions.

        Those that take serialized bytes stay with the middleware.
        """
        publishers = [p for p in source.publishers if isinstance(p, PatientPublisher)]
        for subscription in self._subscriptions:
            for publisher in publishers:
                if subscription.full_topic == publisher.topic_name and not subscription.is_raw:
                    subscription.receive_in_memory(self.guard)
                    publisher.hand_to(subscription)

    @property
    def waiting(self) -> int:
        """How many messages wait that were handed over in memory."""
        return sum(subscription.waiting for subscription in self._subscriptions)

    def withdraw(self, topic: str) -> None:
        """Destroy the publisher of a topic, and with it what it keeps for late subscribers."""
        self._node.destroy_publisher(self._publishers.pop(topic))

    def guard(self, callback: Callable[[], None], group: CallbackGroup | None = None) -> Guard:
        """Create a condition that any thread may trigger; the node's executor runs its callback."""
        guard = Guard(self._node, callback, group)
        guard.post = self._post
        self._guards.append(guard)
        return guard

    def run_guards_by(self, post: Post) -> None:
        """Let ``post`` run the callbacks of all conditions, one at a time and never beside others of the node."""
        self._post = post
        for guard in self._guards:
            guard.post = post

    def trigger_service(
        self,
        name: str,
        handler: Callable[[], str],
        group: CallbackGroup | None = None,
        on_answer: Callable[[bool, str], None] | None = None,
    ) -> Any:
        """Create a std_srvs/Trigger service, which does something and answers with a sentence.

        Parameters
        ----------
        name, group
            Where it is served.
        handler
            Does the work and returns the answer; an exception becomes the reason of a refusal.
        on_answer
            Called with the success flag and the answer.
        """

        def answer(_request: Any, response: Any) -> Any:
            try:
                response.message = handler()
                response.success = True
            except NODE_ERRORS as error:
                response.message = " ".join(str(error).split())
                response.success = False
            except Exception as error:
                # Who asks gets an answer, and what the node holds is not lost.
                response.message = describe_fault(error)
                response.success = False
            if on_answer is not None:
                on_answer(response.success, response.message)
            if response.success:
                self._node.get_logger().info(f"{name}: {response.message}")
            else:
                self._node.get_logger().warning(f"{name}: {response.message}")
            return response

        return self._node.create_service(
            Trigger, name, answer, qos_profile=service_queue(), callback_group=group
        )

    # -- watching ----------------------------------------------------------------------------------

    def check_publishers(self) -> None:
        """Check who publishes on the subscribed topics; call it periodically."""
        for subscription in self._subscriptions:
            subscription.check_publishers()

    def subscriber_counts(self) -> dict[str, int]:
        """Return the number of subscribers of each topic of this node."""
        return {topic: p.get_subscription_count() for topic, p in self._publishers.items()}

    def conditions(self) -> list[str]:
        """Return what is wrong with the subscribed topics, a few words each."""
        weak = [f"{s.topic} without {s.downgraded}" for s in self._subscriptions if s.downgraded]
        foreign = [(s.topic, s.foreign_types) for s in self._subscriptions if s.foreign_types]
        rivals = [s.rivals for s in self._subscriptions if s.rivals]
        return weak + [f"{types} on {topic}" for topic, types in foreign] + rivals

    def describe_topics(self) -> str:
        """Return the full names of all topics of this node, in words."""
        inputs = sorted({s.full_topic for s in self._subscriptions})
        outputs = sorted({str(p.topic_name) for p in self._publishers.values()})
        parts = [("subscribes to", inputs), ("publishes", outputs)]
        return "; ".join(f"{verb} {', '.join(names)}" for verb, names in parts if names)
