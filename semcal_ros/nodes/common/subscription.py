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

"""A subscription that requests a lower quality of service when a publisher does not offer the requested one.

It can watch whether its topic has one source, and whether that sends.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSPolicyKind, QoSProfile

from semcal_ros.nodes.common.qos import overridable, relax

MessageInfo = Mapping[str, Any]
Callback = Callable[[Any, MessageInfo], None]

# The value reported by a middleware that does not number its messages.
_NO_NUMBER = 2**64 - 1
# The name that ROS gives a node of which it knows a publisher and not yet the name.
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"

# A person who starts things one after the other is not told at once; who waits for an image is told soon.
_SILENT_S = 5.0
# Fast DDS forgets a process that was killed after 20 s; until then its successor of the same name is not alone.
_FORGOTTEN_S = 30.0


def published_ns(info: MessageInfo) -> int:
    """Return when the message was published, ns, or when it was received if the middleware does not say."""
    return int(info["source_timestamp"] or info["received_timestamp"])


class MessageCounter:
    """Counts lost messages and restarts of publishers from the numbers that each publisher gives its messages.

    Attributes
    ----------
    lost
        Messages that were sent and did not arrive.
    restarts
        How often another publisher has begun.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.restarts = 0
        self.reset()

    def reset(self) -> None:
        """Forget the last message, so that the next one counts as the first."""
        self._last_number: int | None = None
        self._publishers = 0

    def count(self, number: int | None, publishers: int) -> None:
        """Count a message.

        Parameters
        ----------
        number
            Its number; None if the middleware does not number messages.
        publishers
            Number of publishers of the topic at present.
        """
        if number is None or number == _NO_NUMBER:
            return
        missed = 0 if self._last_number is None else number - self._last_number - 1
        # A killed publisher still counts for a while, so its successor raises the number of publishers; after
        # one that left in order, smaller message numbers follow. Several publishers number independently.
        another = publishers > self._publishers or (missed < 0 and publishers <= 1)
        if self._last_number is not None and another:
            self.restarts += 1
        # Without any publisher, the last one has ended since.
        elif missed > 0 and publishers <= 1:
            self.lost += missed
        self._publishers = publishers
        self._last_number = number


class AdaptiveSubscription:
    """Subscribes as requested, then with fewer demands after an incompatible-QoS event: else nothing would arrive.

    When the last publisher is gone, :meth:`check_publishers` returns to the requested quality. A publisher of the same
    process may hand its messages over :meth:`in memory <receive_in_memory>` instead.

    Parameters
    ----------
    node
        The node.
    message_type, topic
        What to subscribe to.
    callback
        Called with each message and its information from the middleware.
    profile
        The requested quality; overridable by parameters.
    raw
        Whether the callback takes the serialized bytes.
    source
        One word for what comes on a topic that must have one publisher; it is watched then.
    streams
        Whether that comes all the time.
    """

    def __init__(
        self,
        node: Node,
        message_type: Any,
        topic: str,
        callback: Callback,
        profile: QoSProfile,
        group: CallbackGroup | None = None,
        *,
        raw: bool = False,
        source: str = "",
        streams: bool = False,
    ) -> None:
        self._node = node
        self._type = message_type
        self._callback = callback
        self._group = group
        self._raw = raw
        self._refused: list[QoSPolicyKind] = []
        self.topic = topic
        self._counter = MessageCounter()
        self._foreign_types: set[str] = set()
        self._guard = node.create_guard_condition(self._relax, callback_group=group)
        # The override parameters are written into the profile.
        self._requested = self._profile = profile
        self._subscription = self._subscribe(overridable())
        self._full_topic = str(self._subscription.topic_name)
        self._paused = False
        self._received = 0
        # Of a latched value: whether to ask for it again, how often that was done, who published at the last message,
        # and the second subscription that asks.
        self._wants_again = False
        self.renewals = 0
        self._publishers = 0
        self._keeps_last = bool(source) and not streams
        self._asking: Any = None
        # What was handed over in memory and not taken yet, once it is.
        self._delivered: deque[tuple[Any, MessageInfo]] | None = None
        self._arrived: Any = None
        self._watch: SourceWatch | None = None
        if source:
            now_s = time.monotonic()
            self._watch = SourceWatch(source, self._full_topic, streams=streams, now_s=now_s)

    def pause(self) -> None:
        """Unsubscribe until :meth:`resume`, so that publishers have one subscriber less."""
        if not self._paused:
            self._paused = True
            self._node.destroy_subscription(self._subscription)

    def resume(self) -> None:
        """Subscribe again; a latched value comes once more."""
        if self._paused:
            self._paused = False
            self._subscription = self._subscribe()

    # -- in memory ---------------------------------------------------------------------------------

    @property
    def in_memory(self) -> bool:
        """Whether a publisher of the same process hands its messages over."""
        return self._delivered is not None

    @property
    def waiting(self) -> int:
        """How many messages that were handed over in memory have not been taken yet."""
        return len(self._delivered or ())

    @property
    def is_raw(self) -> bool:
        """Whether the callback takes the serialized bytes."""
        return self._raw

    def receive_in_memory(self, make_guard: Callable[..., Any]) -> None:
        """Take messages from :meth:`deliver` alone from now on.

        As many wait as the quality of service says; the oldest make room for newer ones, and are counted as lost.

        Parameters
        ----------
        make_guard
            :meth:`~semcal_ros.nodes.common.endpoints.Endpoints.guard` of the node.
        """
        self._node.destroy_subscription(self._subscription)
        depth = self.depth
        self._delivered = deque(maxlen=None if math.isinf(depth) else max(1, int(depth)))
        self._arrived = make_guard(self._on_delivered, self._group)
        self._counter.reset()

    def deliver(self, message: Any, sent_ns: int, number: int) -> None:
        """Take a message from a publisher of the same process, in any thread; the node's executor calls back.

        Parameters
        ----------
        message
            Nobody may change it any more.
        sent_ns
            When it was published, ns.
        number
            Its number among those of its publisher.
        """
        assert self._delivered is not None
        info = {
            "source_timestamp": sent_ns,
            "received_timestamp": sent_ns,
            "publication_sequence_number": number,
        }
        self._delivered.append((message, info))
        self._arrived.trigger()

    def _on_delivered(self) -> None:
        taken = self.take()
        if taken is not None:
            self._callback(*taken)
        # One message per turn of the executor, as from the middleware.
        if self._delivered:
            self._arrived.trigger()

    @property
    def downgraded(self) -> str:
        """The demands that were dropped, such as ``"reliability"``; empty if none were."""
        if self._profile is self._requested:
            return ""
        kinds = ("reliability", "durability")
        return ", ".join(
            k for k in kinds if getattr(self._profile, k) != getattr(self._requested, k)
        )

    @property
    def lost(self) -> int:
        """Messages that were sent and did not arrive."""
        return self._counter.lost

    @property
    def restarts(self) -> int:
        """How often another publisher has begun."""
        return self._counter.restarts

    @property
    def depth(self) -> float:
        """How many messages may wait."""
        profile = self._profile
        return math.inf if profile.history == HistoryPolicy.KEEP_ALL else profile.depth

    def _subscribe(self, options: Any = None) -> Any:
        self._counter.reset()
        # rclpy also passes the message information, which its annotations omit.
        callback: Any = self._on_message
        events = SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible)
        return self._node.create_subscription(
            self._type,
            self.topic,
            callback,
            self._profile,
            callback_group=self._group,
            event_callbacks=events,
            qos_overriding_options=options,
            raw=self._raw,
        )

    def _on_message(self, message: Any, info: MessageInfo) -> None:
        self._count(info)
        self._callback(message, info)

    def _count(self, info: MessageInfo) -> None:
        self._received += 1
        number = info.get("publication_sequence_number")
        # In memory there is one, whatever else is found on the topic.
        self._publishers = 1 if self.in_memory else self._subscription.get_publisher_count()
        self._counter.count(number, self._publishers)

    def take_waiting(self) -> None:
        """Run the callback for everything that has already arrived.

        An executor serves one message per topic and turn; otherwise a newer image would be handled before the
        values published ahead of it.
        """
        while (taken := self.take()) is not None:
            self._callback(*taken)

    def take(self) -> tuple[Any, MessageInfo] | None:
        """Return the next message that has already arrived, with its information, or None."""
        taken = self._next()
        if taken is None:
            return None
        message, info = taken
        self._count(info)
        return message, info

    def _next(self) -> Any:
        if self._delivered is not None:
            return self._delivered.popleft() if self._delivered else None
        if self._paused:
            return None
        handle = self._subscription.handle
        with handle:
            return handle.take_message(self._type, self._raw)

    def ask_again(self) -> None:
        """Ask, at the next check, publishers that keep their last message to send it once more.

        The callback gets it as any other; :attr:`renewals` says how often that was asked for.
        """
        self._wants_again = True

    # -- quality of service ------------------------------------------------------------------------

    def _on_incompatible(self, event: Any) -> None:
        # The subscription must not be destroyed inside its own event.
        self._refused.append(QoSPolicyKind(event.last_policy_kind))
        self._guard.trigger()

    def _relax(self) -> None:
        while self._refused:
            refused = self._refused.pop()
            weaker = relax(self._profile, refused)
            if weaker is None:
                continue
            self._profile = weaker
            if self._paused:
                continue
            self._node.destroy_subscription(self._subscription)
            self._subscription = self._subscribe()
            self._node.get_logger().warning(
                f"a publisher on {self.full_topic} does not offer the requested {refused.name.lower()};"
                f" subscribed again without it ({self.downgraded})"
            )

    def check_publishers(self) -> None:
        """Check who publishes; call it periodically.

        Warns of publishers of another type, which the middleware ignores silently, and of those that are one too many
        or silent; returns to the requested quality once there are no publishers left.
        """
        if self._paused:
            return
        publishers = self._node.get_publishers_info_by_topic(self._full_topic)
        foreign = {p.topic_type for p in publishers} - {self._type_name}
        for type_name in foreign - self._foreign_types:
            self._node.get_logger().warning(
                f"{type_name} is published on {self.full_topic}; expected {self._type_name}; correct the"
                " configuration or the publisher"
            )
        self._foreign_types = foreign
        if self.in_memory:
            pass
        elif self._profile is not self._requested and not publishers:
            self._node.destroy_subscription(self._subscription)
            self._profile = self._requested
            self._subscription = self._subscribe()
        elif self._keeps_last:
            self._renew()
        if self._watch is not None:
            names = self._sources(publishers)
            warnings, news = self._watch.check(time.monotonic(), self._received, names)
            for text in warnings:
                self._node.get_logger().warning(text)
            for text in news:
                self._node.get_logger().info(text)

    def _renew(self) -> None:
        """Ask again for the last message, also where a publisher has left and its message may be the newest one."""
        if self._asking is not None:
            self._node.destroy_subscription(self._asking)
            self._asking = None
        now = self._subscription.get_publisher_count()
        left = 0 < now < self._publishers
        self._publishers = min(self._publishers, now)
        if not (self._wants_again or left):
            return
        self._wants_again = False
        self.renewals += 1
        asked_ns = time.time_ns()

        def on_kept(message: Any, info: MessageInfo) -> None:
            # What is new also comes on the subscription itself, which goes on so that nothing is lost.
            if published_ns(info) < asked_ns:
                self._callback(message, info)

        callback: Any = on_kept
        self._asking = self._node.create_subscription(
            self._type,
            self.topic,
            callback,
            self._requested,
            callback_group=self._group,
            raw=self._raw,
        )

    def _sources(self, publishers: list[Any]) -> list[str]:
        return [
            "" if p.node_name == _UNKNOWN_NODE else f"{p.node_namespace.rstrip('/')}/{p.node_name}"
            for p in publishers
            if p.topic_type == self._type_name
        ]

    def publishers(self) -> list[str]:
        """Return the full names of the nodes that publish on the topic at this moment, once for each publisher.

        The name of a node that has been found just now may not be known yet, and is empty.
        """
        found = self._node.get_publishers_info_by_topic(self._full_topic)
        return self._sources(found)

    def find_rivals(self) -> str:
        """Return which publishers are one too many at this moment, in a few words; empty if none is."""
        if self._watch is None:
            return ""
        return self._watch.describe_rivals(time.monotonic(), self.publishers())

    @property
    def rivals(self) -> str:
        """What :meth:`find_rivals` returned at the last check."""
        return "" if self._watch is None else self._watch.rivals

    @property
    def full_topic(self) -> str:
        """The name of the topic after namespace and remaps."""
        return self._full_topic

    @property
    def foreign_types(self) -> str:
        """The other types published on the topic; empty if there are none."""
        return ", ".join(sorted(self._foreign_types))

    @property
    def _type_name(self) -> str:
        package = self._type.__module__.partition(".")[0]
        return f"{package}/msg/{self._type.__name__}"


class SourceWatch:
    """Watches one topic; :meth:`check` says what has changed.

    Parameters
    ----------
    what
        What comes on the topic, one word, such as ``image``.
    topic
        Its name, for messages.
    streams
        Whether silence counts at any time; otherwise only before the first message.
    now_s
        The time at the start, s, on a clock that does not stand still.
    """

    def __init__(self, what: str, topic: str, *, streams: bool, now_s: float) -> None:
        self._what = what
        self._topic = topic
        self._streams = streams
        self._received = 0
        self._heard_s = now_s
        self._silent = False
        self._namesakes_since_s: float | None = None
        self.rivals = ""

    def check(
        self, now_s: float, received: int, publishers: Sequence[str]
    ) -> tuple[list[str], list[str]]:
        """Return new warnings and new good news, given the messages so far and the names of all publishers.

        The name of a publisher that is not known is empty.
        """
        warnings, news = self._check_silence(now_s, received, len(publishers))
        before, self.rivals = self.rivals, self.describe_rivals(now_s, publishers)
        if self.rivals and not before:
            warnings.append(f"{self.rivals}: what they publish is mixed; end all but one")
        elif before and not self.rivals:
            news.append(f"one publisher on {self._topic} again")
        return warnings, news

    def _check_silence(
        self, now_s: float, received: int, publishers: int
    ) -> tuple[list[str], list[str]]:
        if received != self._received:
            silence_s, self._heard_s, self._received = now_s - self._heard_s, now_s, received
            if self._silent:
                self._silent = False
                return [], [f"{self._what} on {self._topic} after {silence_s:.0f} s"]
        expected = self._streams or received == 0
        if expected and not self._silent and now_s - self._heard_s >= _SILENT_S:
            self._silent = True
            why = "nobody publishes there" if publishers == 0 else f"{publishers} publish there"
            return [
                f"no {self._what} on {self._topic} for {_SILENT_S:.0f} s: {why};"
                " check that the microscope's driver runs, and the names of the topics in config"
            ], []
        return [], []

    def describe_rivals(self, now_s: float, publishers: Sequence[str]) -> str:
        """Return, in a few words, which publishers are one too many; empty if none is.

        Two of one name count only after a while: one of them may be a process that was killed. So does one whose name
        is empty, because it is not known yet: it may be the successor.
        """
        names = sorted(set(publishers) - {""})
        count = len(publishers)
        if count <= max(len(names), 1):
            self._namesakes_since_s = None
        elif self._namesakes_since_s is None:
            self._namesakes_since_s = now_s
        lasting = (
            self._namesakes_since_s is not None and now_s - self._namesakes_since_s >= _FORGOTTEN_S
        )
        if len(names) > 1 or lasting:
            if "" in publishers:
                listed = ", ".join([*names, "without a name"])
            else:
                listed = ", ".join(names if len(names) > 1 else [f"{names[0]} {count} times"])
            return f"{count} publishers on {self._topic}: {listed}"
        return ""
