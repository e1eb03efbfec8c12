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

"""The zero-order hold against a plain model of what it promises."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.bridge.zero_order_hold import ZeroOrderHold
from semcal_ros.core.errors import InvalidValueError

STAMPS = st.lists(st.integers(0, 60), max_size=30)


@given(stamps=STAMPS, queries=st.lists(st.integers(-5, 70), min_size=1, max_size=20))
def test_latest_value_not_after_the_query(stamps: list[int], queries: list[int]) -> None:
    hold = ZeroOrderHold[int](max_length=100, jump_ns=1000)
    truth: dict[int, int] = {}
    for value, stamp in enumerate(stamps):
        assert not hold.insert(stamp, value)
        truth[stamp] = value
    assert len(hold) == len(truth)
    for query in queries:
        known = [stamp for stamp in truth if stamp <= query]
        assert hold.at(query) == (truth[max(known)] if known else None)


@given(stamps=STAMPS, length=st.integers(1, 5))
def test_the_newest_are_kept(stamps: list[int], length: int) -> None:
    hold = ZeroOrderHold[int](max_length=length, jump_ns=1000)
    for stamp in stamps:
        hold.insert(stamp, stamp)
    kept = sorted(set(stamps))[-length:]
    assert [hold.at(stamp) for stamp in kept] == kept
    assert len(hold) == len(kept)
    assert not kept or hold.at(kept[0] - 1) is None
    assert hold.newest_ns == (kept[-1] if kept else None)


def test_a_clock_that_goes_back_clears() -> None:
    hold = ZeroOrderHold[str](jump_ns=100)
    hold.insert(1000, "old")
    assert hold.insert(899, "new")
    assert len(hold) == 1
    assert hold.at(898) is None
    assert hold.at(10_000) == "new"


def test_a_late_value_is_sorted_in() -> None:
    hold = ZeroOrderHold[str](jump_ns=100)
    hold.insert(1000, "later")
    assert not hold.insert(900, "earlier")
    assert hold.at(999) == "earlier"
    assert hold.at(1000) == "later"


def test_clear_and_default_threshold() -> None:
    hold = ZeroOrderHold[int]()
    hold.insert(2_000_000_000, 1)
    assert not hold.insert(1_000_000_000, 2)
    assert hold.insert(999_999_999, 3)
    hold.clear()
    assert len(hold) == 0
    assert hold.at(10**12) is None
    assert hold.newest_ns is None


def test_refuses_nonsense() -> None:
    with pytest.raises(InvalidValueError):
        ZeroOrderHold[int](max_length=0)
    with pytest.raises(InvalidValueError):
        ZeroOrderHold[int](jump_ns=-1)
