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

"""Messages that a node of the same process hands over: in order, no more than may wait, and the lost ones counted."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.qos import stream_output, value_input

DEPTH = 8


@pytest.fixture
def nodes() -> Iterator[tuple[Node, Node]]:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    made = Node("giver", namespace="sem"), Node("taker", namespace="sem")
    yield made
    for node in made:
        node.destroy_node()
    rclpy.shutdown()


def test_what_waits_is_bounded_and_what_is_lost_is_counted(nodes: tuple[Node, Node]) -> None:
    giver, taker = nodes
    got: list[tuple[str, int]] = []

    def keep(message: Any, info: Any) -> None:
        got.append((message.data, info["publication_sequence_number"]))

    endpoints = Endpoints(taker)
    subscription = endpoints.subscribe(String, "words", keep, stream_output(DEPTH))
    raw = endpoints.subscribe(String, "words", keep, stream_output(DEPTH), raw=True)
    publisher = Endpoints(giver).stream_publisher(String, "words")
    endpoints.take_in_memory_from(giver)
    # What takes bytes stays with the middleware.
    assert (subscription.in_memory, raw.in_memory) == (True, False)
    publisher.publish(String(data="0"))
    subscription.take_waiting()
    for k in range(1, 16):
        publisher.publish(String(data=str(k)))
    assert endpoints.waiting == subscription.waiting == DEPTH
    subscription.take_waiting()
    assert got == [("0", 1), *((str(k), k + 1) for k in range(16 - DEPTH, 16))]
    assert subscription.lost == 15 - DEPTH
    # The middleware knows of this publisher, and of no other.
    endpoints.check_publishers()
    assert endpoints.conditions() == []


def test_an_executor_runs_one_callback_for_each_message(nodes: tuple[Node, Node]) -> None:
    giver, taker = nodes
    got: list[str] = []
    endpoints = Endpoints(taker)
    endpoints.subscribe(String, "word", lambda m, _i: got.append(m.data), value_input())
    publisher = Endpoints(giver).latched_publisher(String, "word")
    # Before anybody takes it: a latched one is kept.
    publisher.publish(String(data="early"))
    endpoints.take_in_memory_from(giver)
    for text in ("a", "b", "c"):
        publisher.publish(String(data=text))
    executor = SingleThreadedExecutor()
    executor.add_node(taker)
    end_s = time.monotonic() + 10.0
    while len(got) < 4 and time.monotonic() < end_s:
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    assert got == ["early", "a", "b", "c"]
