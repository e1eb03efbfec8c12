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

"""Fuzzing: every property says how many cases really ran, and fails if they are too few."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest

from tests.helpers.fuzz_support import TALLIES, Tally

_SEEN: dict[str, tuple[int, int]] = {}


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for the files of all cases, which overwrite each other's."""
    return tmp_path_factory.mktemp("fuzz")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    yield
    test = getattr(item, "obj", None)
    settings = getattr(test, "_hypothesis_internal_use_settings", None)
    if settings is not None:
        ran = TALLIES.get(item.nodeid, Tally()).total
        assert ran >= settings.max_examples, f"{ran} cases ran of {settings.max_examples}"


def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    tally = TALLIES.get(item.nodeid)
    if call.when == "call" and tally is not None:
        item.user_properties.append(("fuzz_cases", (tally.accepted, tally.refused)))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    # Reports also come from other processes, which counts in this one do not.
    for name, value in report.user_properties:
        if name == "fuzz_cases":
            accepted, refused = value
            _SEEN[report.nodeid] = (accepted, refused)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if not _SEEN:
        return
    terminalreporter.section("fuzz cases (accepted + refused)")
    for test in sorted(_SEEN):
        accepted, refused = _SEEN[test]
        name = test.rpartition("fuzz/")[2]
        terminalreporter.write_line(
            f"{accepted + refused:8d} = {accepted:7d} + {refused:7d}  {name}"
        )
    total = sum(accepted + refused for accepted, refused in _SEEN.values())
    terminalreporter.write_line(f"{total:8d} cases in {len(_SEEN)} properties")
