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

"""What a node says about who publishes to it, and about silence."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from semcal_ros.nodes.common.subscription import AdaptiveSubscription, SourceWatch

SEM, BAG = "/sem/virtual_sem", "/sem/bag_player"
NOTHING: tuple[list[str], list[str]] = ([], [])


def watch(*, streams: bool = True) -> SourceWatch:
    return SourceWatch("image", "/sem/image_raw", streams=streams, now_s=0.0)


def test_silence_is_told_once_after_five_seconds_and_its_end_too() -> None:
    image = watch()
    assert image.check(4.9, 0, []) == NOTHING
    (warning,), news = image.check(5.1, 0, [])
    assert warning.startswith("no image on /sem/image_raw for 5 s: nobody publishes there")
    assert news == []
    assert image.check(60.0, 0, [SEM]) == NOTHING
    assert image.check(61.0, 3, [SEM]) == ([], ["image on /sem/image_raw after 61 s"])
    assert image.check(65.9, 3, [SEM]) == NOTHING
    (warning,), _ = image.check(66.1, 3, [SEM])
    assert "1 publish there" in warning


def test_a_value_may_stay_the_same_for_ever_once_it_has_come() -> None:
    value = watch(streams=False)
    value.check(1.0, 1, [SEM])
    assert value.check(3600.0, 1, [SEM]) == NOTHING
    assert watch(streams=False).check(5.1, 0, [])[0]


def test_two_publishers_are_told_once_and_named_as_long_as_they_last() -> None:
    image = watch()
    image.check(1.0, 1, [SEM])
    assert image.rivals == ""
    (warning,), _ = image.check(2.0, 2, [SEM, BAG])
    assert image.rivals == f"2 publishers on /sem/image_raw: {BAG}, {SEM}"
    assert warning.startswith(image.rivals)
    assert image.check(3.0, 3, [SEM, BAG]) == NOTHING
    assert image.check(4.0, 4, [BAG]) == ([], ["one publisher on /sem/image_raw again"])
    assert image.rivals == ""


@pytest.mark.parametrize(("seconds", "told"), [(29.0, False), (31.0, True)])
def test_the_successor_of_a_killed_one_is_no_rival_but_a_lasting_namesake_is(
    seconds: float, told: bool
) -> None:
    image = watch()
    image.check(10.0, 1, [SEM, SEM])
    image.check(10.0 + seconds, 2, [SEM, SEM])
    assert image.rivals == (f"2 publishers on /sem/image_raw: {SEM} 2 times" if told else "")
    image.check(50.0, 3, [SEM])
    image.check(51.0, 4, [SEM, SEM])
    assert image.rivals == ""


def test_a_publisher_whose_name_is_not_known_yet_may_be_the_successor_of_a_killed_one() -> None:
    image = watch()
    assert image.check(1.0, 1, [""]) == NOTHING
    assert image.check(2.0, 2, [SEM, ""]) == NOTHING
    assert image.rivals == ""
    # With its name it is a rival at once, and without one after a while.
    assert image.describe_rivals(3.0, [SEM, BAG]).endswith(f"{BAG}, {SEM}")
    image.check(10.0, 3, [SEM, ""])
    image.check(41.0, 4, [SEM, ""])
    assert image.rivals == f"2 publishers on /sem/image_raw: {SEM}, without a name"


def test_ros_says_that_a_name_is_not_known_by_a_name() -> None:
    def publisher(name: str, namespace: str, kind: str = "std_msgs/msg/String") -> Any:
        return SimpleNamespace(node_name=name, node_namespace=namespace, topic_type=kind)

    subscription: Any = SimpleNamespace(_type_name="std_msgs/msg/String")
    found = [
        publisher("_NODE_NAME_UNKNOWN_", "_NODE_NAMESPACE_UNKNOWN_"),
        publisher("driver", "/"),
        publisher("virtual_sem", "/sem"),
        publisher("other", "/sem", "std_msgs/msg/Int8"),
    ]
    assert AdaptiveSubscription._sources(subscription, found) == ["", "/driver", SEM]
