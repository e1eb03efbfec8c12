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

"""A source in a thread of its own: it may hang, fail and come back."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from semcal_ros.core.errors import MicroscopeError, UnusableFrameError
from semcal_ros.drivers.runner import SourceRunner
from semcal_ros.drivers.source import SourceFrame


class Scripted:
    """A source whose reads are what a test puts into its list."""

    streams = True

    def __init__(self, *, lossless: bool = False) -> None:
        self.lossless = lossless
        self.opened = self.closed = 0
        self.script: list[object] = []
        self.hanging = threading.Event()
        self.released = threading.Event()

    def open(self) -> str:
        self.opened += 1
        return "a script"

    def close(self) -> None:
        self.closed += 1

    def read(self, timeout_s: float) -> SourceFrame | None:
        if not self.script:
            time.sleep(0.01)
            return None
        step = self.script.pop(0)
        if step == "hang":
            self.hanging.set()
            self.released.wait(10.0)
            return None
        if isinstance(step, Exception):
            raise step
        assert isinstance(step, int)
        return SourceFrame(np.zeros((2, 2), np.uint8), step)


@pytest.fixture
def make() -> Iterator[Callable[[Scripted], SourceRunner]]:
    runners: list[SourceRunner] = []

    def start(source: Scripted) -> SourceRunner:
        runners.append(SourceRunner(source, lambda: None))
        runners[-1].start()
        return runners[-1]

    yield start
    for runner in runners:
        runner.close()


def wait(condition: Callable[[], object]) -> None:
    until_s = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.005)


def take(runner: SourceRunner) -> int:
    wait(lambda: runner.waiting)
    frame = runner.take()
    assert frame is not None
    return frame.start_ns


def test_live_frames_that_nobody_takes_are_overtaken(make: Callable[..., SourceRunner]) -> None:
    source = Scripted()
    source.script = [1, 2, 3, 4]
    runner = make(source)
    wait(lambda: runner.state().skipped == 2)
    assert [take(runner), take(runner)] == [3, 4]


def test_frames_that_all_count_wait_also_over_a_stop(make: Callable[..., SourceRunner]) -> None:
    source = Scripted(lossless=True)
    source.script = [1, 2, 3, 4]
    runner = make(source)
    wait(lambda: runner.waiting == 2)
    runner.stop()
    wait(lambda: runner.state().phase == "stopped")
    runner.start()
    assert [take(runner) for _ in range(4)] == [1, 2, 3, 4]
    assert runner.state().skipped == 0


def test_what_fails_is_closed_and_opened_again(make: Callable[..., SourceRunner]) -> None:
    source = Scripted()
    source.script = [1, UnusableFrameError("a bad one"), 2, ValueError("of a maker's library"), 3]
    runner = make(source)
    assert [take(runner) for _ in range(3)] == [1, 2, 3]
    assert source.opened == 2
    problems = runner.problems()
    assert [str(problem) for problem in problems] == [
        "a bad one",
        "ValueError: of a maker's library",
    ]
    assert all(isinstance(problem, MicroscopeError) for problem in problems)
    assert runner.problems() == []


def test_a_source_that_hangs_holds_up_nobody(make: Callable[..., SourceRunner]) -> None:
    source = Scripted()
    source.script = ["hang", 1]
    runner = make(source)
    assert source.hanging.wait(10.0)
    time.sleep(0.1)
    begun_s = time.monotonic()
    assert runner.state().blocked_s >= 0.1
    assert runner.state().phase == "open"
    runner.stop()
    runner.start()
    assert time.monotonic() - begun_s < 1.0
    source.released.set()
    assert take(runner) == 1
    assert runner.state().blocked_s < 5.0


def test_the_end_closes_the_source(make: Callable[..., SourceRunner]) -> None:
    source = Scripted()
    runner = make(source)
    wait(lambda: runner.state().phase == "open")
    runner.close()
    assert source.closed >= 1
