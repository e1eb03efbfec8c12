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

"""A publisher that a short want of room in the middleware does not end, and that knows who waits for messages."""

from __future__ import annotations

import time
from typing import Any, Protocol

import rclpy.utilities
from rclpy._rclpy_pybind11 import RCLError
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import deserialize_message

# Fast DDS waits 100 ms by itself before it refuses, so these are a second. A stream does not want to wait for longer.
_TRIES = 10


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
        serialized = isinstance(message, bytes)
        return deserialize_message(message, self.msg_type) if serialized else message

    def _takes(self, msg: Any) -> bool:
        try:
            super().publish(msg)
        except RCLError:
            if not rclpy.utilities.ok():
                raise
            return False
        return True
