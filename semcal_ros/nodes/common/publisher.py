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

from typing import Any

import rclpy.utilities
from rclpy._rclpy_pybind11 import RCLError
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy

__all__ = ["PatientPublisher"]

# Fast DDS waits 100 ms by itself before it refuses, so these are a second. A stream does not want to wait for longer.
_TRIES = 10


class PatientPublisher(Publisher):
    """Publishes again where the middleware refuses, and raises what it says if that lasts.

    Fast DDS 3 (Kilted) has been seen to refuse a message of a reliable publisher ("cannot publish data") on a busy
    machine when nothing is left between the messages. rclpy raises, and the node would end.
    """

    _has_published = False

    @property
    def is_awaited(self) -> bool:
        """Whether the next message is worth making.

        It is if there is a subscriber, or if the middleware keeps an earlier message for those that come later: what is
        kept must not be older than the stream.
        """
        if self.get_subscription_count():
            return True
        keeps = self.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        return self._has_published and keeps

    def publish(self, msg: Any) -> None:
        """Extend the base class: try again."""
        self._has_published = True
        for _ in range(_TRIES - 1):
            if self._takes(msg):
                return
        super().publish(msg)

    def _takes(self, msg: Any) -> bool:
        try:
            super().publish(msg)
        except RCLError:
            if not rclpy.utilities.ok():
                raise
            return False
        return True
