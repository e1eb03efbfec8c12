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

"""Subscriptions that are polled: an executor that leaves them alone, and what it still does for them."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from semcal_ros.nodes.common.qos import stream_output
from semcal_ros.nodes.common.subscription import AdaptiveSubscription
from semcal_ros.nodes.viewer import PolledGroup, ViewedImages
from tests.helpers.node_fakes import FakeEndpoints, fake_context
from tests.helpers.node_scenes import image_message
from tests.helpers.ros_process import Peer

IMAGE = np.zeros((8, 8), np.uint8)


class CountedGroup(PolledGroup):
    """Counts how often the executor gathers what it could wait for."""

    gathered = 0

    def can_execute(self, entity: Any) -> bool:
        self.gathered += 1
        return super().can_execute(entity)


def subscribe(peer: Peer, group: PolledGroup) -> AdaptiveSubscription:
    return AdaptiveSubscription(
        peer.node, Image, "image_raw", lambda *_: None, stream_output(4), group, raw=True
    )


def test_the_executor_sleeps_while_messages_wait(peer: Peer) -> None:
    """With its events in the wait set, it would go round ten thousand times in that time."""
    group = CountedGroup()
    subscription = subscribe(peer, group)
    publisher = peer.node.create_publisher(Image, "image_raw", 10)
    peer.wait_for(lambda: publisher.get_subscription_count() == 1, "the subscription")
    for stamp_s in (1.0, 2.0, 3.0):
        publisher.publish(image_message(IMAGE, stamp_s))
    peer.spin(0.3)
    group.gathered = 0
    peer.spin(1.0)
    # Some entities for each message, timer or discovery that came in this time.
    assert group.gathered < 1000
    taken = []
    while (message := subscription.take()) is not None:
        taken.append(message)
    assert len(taken) == 3


def test_a_publisher_that_offers_less_is_heard_once_events_are_open(peer: Peer) -> None:
    group = PolledGroup()
    subscription = subscribe(peer, group)
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = peer.node.create_publisher(Image, "image_raw", best_effort)
    peer.spin(0.5)
    assert subscription.downgraded == ""

    def heard() -> bool:
        publisher.publish(image_message(IMAGE))
        if subscription.take() is not None:
            return True
        group.open_events()
        time.sleep(0.01)
        return False

    peer.wait_for(heard, "an image of the publisher")
    assert subscription.downgraded == "reliability"


def test_what_moves_by_itself_is_outlined_in_the_corrected_picture() -> None:
    endpoints: Any = FakeEndpoints()
    images = ViewedImages(fake_context(endpoints, "virtual_sem"), PolledGroup())
    mask = np.zeros((32, 32), np.uint8)
    mask[8:16, 4:20] = 255
    info = {"source_timestamp": 1, "received_timestamp": 1}
    for topic, image in (("image_stabilized", mask + 7), ("stream_corrector/moving", mask)):
        data = serialize_message(image_message(image, 1.0))
        endpoints.subscriptions[topic].waiting.append((data, info))
    frame = images.take()
    assert frame is not None
    (points,) = frame.moving
    assert {(4, 8), (19, 8), (19, 15), (4, 15)} == set(points)
