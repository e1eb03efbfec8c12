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

"""What happens to a message that the middleware refuses."""

from __future__ import annotations

from typing import Any

import pytest
from builtin_interfaces.msg import Time
from rclpy._rclpy_pybind11 import RCLError
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Header, String

from semcal_ros.core.errors import MessageError
from semcal_ros.nodes.common.endpoints import PatientPublisher, read_stamp_ns, unpack


class Middleware:
    """Refuses so many messages, then takes the others."""

    def __init__(self, refusals: int, monkeypatch: pytest.MonkeyPatch, *, up: bool = True) -> None:
        self.refusals = refusals
        self.calls = 0
        self.taken: list[str] = []
        self.publisher: Any = object.__new__(PatientPublisher)
        self.publisher.qos_profile = QoSProfile(depth=1)
        monkeypatch.setattr(Publisher, "publish", lambda _self, message: self.take(message))
        monkeypatch.setattr("rclpy.utilities.ok", lambda: up)

    def take(self, message: str) -> None:
        self.calls += 1
        if self.calls <= self.refusals:
            raise RCLError("Failed to publish: cannot publish data")
        self.taken.append(message)


def test_a_refused_message_is_published_once_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    middleware = Middleware(3, monkeypatch)
    middleware.publisher.publish("first")
    middleware.publisher.publish("second")
    assert middleware.taken == ["first", "second"]


@pytest.mark.parametrize("length", [0, 3, 11, 30])
def test_a_message_that_was_cut_off_is_refused(length: int) -> None:
    data = serialize_message(Image(header=Header(stamp=Time(sec=3, nanosec=7)), encoding="mono8"))
    assert read_stamp_ns(data) == 3_000_000_007
    assert unpack(data, Image).encoding == "mono8"
    with pytest.raises(MessageError, match=f"a serialized message of {length} bytes"):
        unpack(data[:length], Image)
    if length < 12:
        with pytest.raises(MessageError, match="cannot be read"):
            read_stamp_ns(data[:length])


@pytest.mark.parametrize(("up", "calls"), [(True, 10), (False, 1)])
def test_a_refusal_that_lasts_or_comes_with_the_end_is_raised(
    monkeypatch: pytest.MonkeyPatch, up: bool, calls: int
) -> None:
    middleware = Middleware(1000, monkeypatch, up=up)
    with pytest.raises(RCLError, match="cannot publish data"):
        middleware.publisher.publish("lost")
    assert middleware.calls == calls


@pytest.mark.parametrize(
    ("durability", "published", "subscribers", "awaited"),
    [
        ("volatile", True, 0, False),
        ("volatile", False, 1, True),
        ("transient_local", False, 0, False),
        # What the middleware keeps would be of the last time that somebody listened.
        ("transient_local", True, 0, True),
    ],
)
def test_a_message_is_awaited_by_subscribers_now_or_later(
    monkeypatch: pytest.MonkeyPatch,
    durability: str,
    published: bool,
    subscribers: int,
    awaited: bool,
) -> None:
    publisher = Middleware(0, monkeypatch).publisher
    publisher.qos_profile = QoSProfile(depth=1, durability=DurabilityPolicy[durability.upper()])
    monkeypatch.setattr(Publisher, "get_subscription_count", lambda _self: subscribers)
    if published:
        publisher.publish("message")
    assert publisher.is_awaited is awaited


class Receiver:
    def __init__(self) -> None:
        self.taken: list[tuple[Any, int]] = []

    def deliver(self, message: Any, sent_ns: int, number: int) -> None:
        assert sent_ns > 0
        self.taken.append((message, number))


@pytest.mark.parametrize(("durability", "passed_on"), [("volatile", 0), ("transient_local", 2)])
def test_what_is_handed_over_in_memory_goes_to_the_middleware_only_where_somebody_waits(
    monkeypatch: pytest.MonkeyPatch, durability: str, passed_on: int
) -> None:
    middleware, receiver, others = Middleware(0, monkeypatch), Receiver(), 0
    publisher = middleware.publisher
    publisher.qos_profile = QoSProfile(depth=1, durability=DurabilityPolicy[durability.upper()])
    monkeypatch.setattr(Publisher, "get_subscription_count", lambda _self: others)
    publisher.hand_to(receiver)
    assert publisher.get_subscription_count() == 1
    for text in ("first", "second"):
        publisher.publish(text)
    assert receiver.taken == [("first", 1), ("second", 2)]
    assert len(middleware.taken) == passed_on
    others = 1
    publisher.publish("third")
    assert middleware.taken[-1] == "third"
    assert receiver.taken[-1] == ("third", 3)


def test_a_late_receiver_gets_the_last_message_of_a_latched_topic_unpacked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    publisher, receiver = Middleware(0, monkeypatch).publisher, Receiver()
    publisher.msg_type = String
    publisher.qos_profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for text in ("old", "new"):
        publisher.publish(serialize_message(String(data=text)))
    publisher.hand_to(receiver)
    ((message, number),) = receiver.taken
    assert (message.data, number) == ("new", 2)
