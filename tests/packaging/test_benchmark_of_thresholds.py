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

"""What ``python -m benchmarks.thresholds`` does to a row, and how it tells what that changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.thresholds import reach
from benchmarks.thresholds.answers import Answer, compare
from benchmarks.thresholds.variation import vary
from tests.helpers.project import ROOT


@pytest.mark.parametrize(
    ("value", "unit", "larger", "smaller"),
    [
        (4.0, "px", 6.0, 4.0 / 1.5),
        (8, "points", 12, 5),
        # At least by one.
        (1, "round", 2, 0),
        ((2, 3), "order", (3, 4), (1, 2)),
        # Of a part, what it lacks changes; of a length below one, the length.
        (0.97, "of the structure", 0.98, 0.955),
        (0.8, "px", 1.2, 0.8 / 1.5),
        (0.5, "correlation", 0.75, 1.0 / 3.0),
    ],
)
def test_a_value_becomes_larger_and_smaller(
    value: Any, unit: str, larger: Any, smaller: Any
) -> None:
    assert vary(value, unit, 1.5) == pytest.approx(larger)
    assert vary(value, unit, 1.0 / 1.5) == pytest.approx(smaller)
    assert isinstance(vary(value, unit, 1.5), type(value))


def test_an_array_changes_as_a_whole() -> None:
    np.testing.assert_allclose(vary(np.array([0.0, 2.0]), "px", 1.5), [0.0, 3.0])


def test_what_follows_from_a_row_follows_and_other_tables_stay() -> None:
    """In a process of its own: a table cannot be changed once it is imported."""
    script = (
        "from benchmarks.thresholds.variation import Change, install\n"
        "table = 'semcal_ros.core.registration.thresholds'\n"
        "install(table, Change('DEFECT_EVIDENCE_MAX', 2.0))\n"
        "from semcal_ros.core.registration import periodicity, thresholds\n"
        "print(thresholds.DEFECT_EVIDENCE_MAX, thresholds.EVIDENCE_MIN, thresholds.PEAKS_MAX)\n"
        "try:\n"
        "    install(table, None)\n"
        "except RuntimeError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    values, refusal = done.stdout.splitlines()
    assert values == "60.0 120.0 8"
    assert "imported already" in refusal


def test_cases_that_enter_no_function_with_a_row_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = tmp_path / "semcal_ros" / "room"
    room.mkdir(parents=True)
    (room / "thresholds.py").write_text(
        "A = TABLE.stated('A', 1.0, 'px', 'a')\nB = TABLE.derived('B', 2.0 * A, 'px', 'b')\n"
        "C = TABLE.stated('C', 1.0, 'px', 'c')\nD = TABLE.stated('D', 1.0, 'px', 'd')\n"
    )
    (room / "use.py").write_text(
        "from semcal_ros.room.thresholds import A, B, C, D\n"
        "TWICE = 2.0 * C\n"
        "def use(value=D):\n    return B\n"
    )
    monkeypatch.setattr(reach, "ROOT", tmp_path)
    users = reach.find_users("semcal_ros.room.thresholds")
    # B follows from A; C and the default of a function act where a module is imported.
    assert users == {"A": {"A", "B"}, "B": {"B"}, "C": None, "D": None}


def test_names_are_those_of_the_functions_that_are_entered() -> None:
    from semcal_ros.core.registration import noise_spectrum

    # Not by its cache, which another test may have filled.
    read = reach.names_read(lambda: noise_spectrum.gaussian_taps.__wrapped__(1.0))
    assert "GAUSSIAN_SIGMAS" in read
    assert "RICH_PARTS" not in read


def _answer(**values: Any) -> Answer:
    return Answer(**{"decision": "found", "count": 100, "error": 0.1, "ratio": 1.0} | values)


@pytest.mark.parametrize(
    ("other", "is_alike"),
    [
        (_answer(), True),
        (_answer(error=0.104, ratio=0.96, count=99), True),
        (_answer(error=0.106), False),
        (_answer(ratio=1.06), False),
        (_answer(count=97), False),
        (_answer(decision="refused"), False),
        (_answer(wrong=1), False),
    ],
)
def test_limits_of_what_is_alike(other: Answer, is_alike: bool) -> None:
    assert compare({"a": _answer()}, {"a": other}).is_alike is is_alike


@pytest.mark.parametrize(("digest", "identical"), [("0", True), ("1", False)])
def test_the_last_bit_tells_what_a_row_reaches(digest: str, identical: bool) -> None:
    found = compare({"a": _answer(digest="0")}, {"a": _answer(digest=digest)})
    assert found.is_alike and found.identical is identical


def test_one_case_alone_may_change_by_more() -> None:
    usual = {str(k): _answer() for k in range(20)}

    def is_alike(error: float) -> bool:
        return compare(usual, usual | {"0": _answer(error=error)}).is_alike

    assert is_alike(0.12) and not is_alike(0.14)
