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

"""Numbers of things, and names that were misspelt."""

from __future__ import annotations

import re

from semcal_ros.core.wording import (
    counted,
    did_you_mean,
    group_by_kind,
    in_nm,
    omit_numbers,
    rounded_magnification,
)
from tests.helpers.project import ROOT


def test_sizes_of_photographs_have_no_exponent_either() -> None:
    assert [rounded_magnification(g) for g in (5250.4, 100.0, 0.361969)] == [
        "5250x",
        "100x",
        "0.362x",
    ]
    assert [in_nm(m) for m in (0.92e-6, 7.4e-5, 7.446e-3)] == ["920 nm", "74000 nm", "7400 um"]


def test_one_thing_is_not_several() -> None:
    assert [counted(n, "frame") for n in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
    assert counted(1, "image was", "images were") == "1 image was"
    assert counted(2, "vertex", "vertices") == "2 vertices"


def test_a_misspelt_name_is_recognised() -> None:
    assert did_you_mean("jsm280", ["generic", "jsm820"]) == "did you mean jsm820?"
    assert did_you_mean("GENERIC", ["generic", "jsm820"]) == "did you mean generic?"
    assert did_you_mean("xyz", ["generic", "jsm820"]) == ""


def test_messages_of_a_kind_differ_in_their_numbers_only() -> None:
    assert omit_numbers("tilt of -12.5 degrees") == omit_numbers("tilt of 3 degrees")


def test_one_message_of_each_kind_is_left_with_its_count() -> None:
    notes = ["frame 1: dark", "no scan", "frame 2: dark", "frame 12: dark"]
    assert group_by_kind(notes) == ["frame 1: dark (and 2 more of this kind)", "no scan"]


def test_no_message_counts_things_by_hand() -> None:
    """``{n} frames`` is wrong for one frame."""
    by_hand = re.compile(
        r"\{(?:len\([^{}]*\)|\w*count\w*|[^{}]*\.sum\(\)|np\.count_nonzero\([^{}]*\)|[^{}]*_count)\} "
        r"(?:frames|views|images|files|messages|problems|notes|keyframes|corners|points)\b"
    )
    found = [
        f"{path.relative_to(ROOT)}: {hit.group()}"
        for path in (ROOT / "semcal_ros").rglob("*.py")
        for hit in by_hand.finditer(path.read_text(encoding="utf-8"))
    ]
    assert found == []
