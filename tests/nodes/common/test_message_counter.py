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

"""Lost messages and restarted publishers, from the numbers of the messages alone."""

from __future__ import annotations

from typing import Any

from std_msgs.msg import String

from semcal_ros.nodes.common.qos import image_input
from semcal_ros.nodes.common.subscription import AdaptiveSubscription, MessageCounter


def counted(*messages: tuple[int | None, int]) -> tuple[int, int]:
    """(lost, restarts) after messages of (number, publishers)."""
    counter = MessageCounter()
    for number, publishers in messages:
        counter.count(number, publishers)
    return counter.lost, counter.restarts


def test_a_gap_is_lost() -> None:
    assert counted((1, 1), (2, 1), (5, 1)) == (2, 0)


def test_nothing_is_lost_before_the_first_message() -> None:
    assert counted((40, 1), (41, 1)) == (0, 0)


def test_a_message_after_its_publisher_has_ended_counts_too() -> None:
    assert counted((1, 1), (4, 0)) == (2, 0)


def test_a_publisher_that_was_killed_is_followed_by_one_more() -> None:
    """The killed one still counts, and the numbers of its successor may be larger."""
    assert counted((7, 1), (1, 2), (2, 2)) == (0, 1)
    assert counted((1, 1), (9, 2), (10, 2)) == (0, 1)


def test_a_publisher_that_left_is_followed_by_smaller_numbers() -> None:
    assert counted((7, 1), (1, 1), (2, 1)) == (0, 1)
    # Its last message may come after it.
    assert counted((7, 1), (8, 0), (1, 1)) == (0, 1)


def test_the_killed_one_that_is_forgotten_at_last_is_no_restart() -> None:
    assert counted((7, 1), (1, 2), (2, 1), (3, 1)) == (0, 1)


def test_several_publishers_at_once_lose_nothing_and_restart_nothing() -> None:
    assert counted((1, 2), (100, 2), (2, 2), (101, 2)) == (0, 0)


def test_a_middleware_without_numbers_counts_nothing() -> None:
    assert counted((None, 1), (None, 2), (2**64 - 1, 1), (2**64 - 1, 3)) == (0, 0)


def test_after_a_reset_the_next_message_follows_none() -> None:
    counter = MessageCounter()
    counter.count(1, 1)
    counter.reset()
    counter.count(9, 2)
    assert (counter.lost, counter.restarts) == (0, 0)


class Middleware:
    """What a subscription uses of its node; one publisher until another number is set."""

    publishers = 1
    topic_name = "/sem/image_raw"

    def create_guard_condition(self, *_args: Any, **_options: Any) -> None:
        return None

    def create_subscription(self, *_args: Any, **_options: Any) -> Middleware:
        return self

    def get_publisher_count(self) -> int:
        return self.publishers


def test_a_subscription_counts_what_it_hands_on() -> None:
    node: Any = Middleware()
    received: list[int] = []
    images = AdaptiveSubscription(
        node, String, "image_raw", lambda message, _info: received.append(message), image_input()
    )
    for number in (1, 2, 5):
        images._on_message(number, {"publication_sequence_number": number})
    assert (received, images.lost, images.restarts) == ([1, 2, 5], 2, 0)
    # A successor that begins before the killed one is forgotten.
    node.publishers = 2
    images._on_message(9, {"publication_sequence_number": 9})
    assert (images.lost, images.restarts) == (2, 1)
