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

"""What every fuzz property shares: how many cases it runs, what may come out, and what is counted.

``SEMCAL_FUZZ_CASES`` is the number of cases of a property; each property takes its share of it. Without it every
property runs a few dozen, the same ones every time.
"""

from __future__ import annotations

import math
import os
import resource
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pytest
from hypothesis import HealthCheck, settings

from semcal_ros.cli import main
from semcal_ros.core.errors import SemcalError

__all__ = ["TALLIES", "Tally", "attempt", "check_refusal", "fuzz", "run_semcal"]

T = TypeVar("T")

_SHORT_RUN = 40
# Far above what a case takes (milliseconds, a few MB): beyond, its time or memory follows a number in the input.
_CPU_LIMIT_S = 10.0
_MEMORY_LIMIT_BYTES = 256 * 1024 * 1024
_LONGEST_MESSAGE = 2000
_STATUS, _RESET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass
class Tally:
    """How the cases of one property ended."""

    accepted: int = 0
    refused: int = 0

    @property
    def total(self) -> int:
        return self.accepted + self.refused


TALLIES: dict[str, Tally] = {}
"""What really ran, by the id of the test."""


def fuzz(share: float = 1.0) -> settings:
    """Settings of a property that runs ``share`` of the cases: less than 1 where a case is slow."""
    cases = int(os.environ.get("SEMCAL_FUZZ_CASES", _SHORT_RUN))
    return settings(
        max_examples=max(1, math.ceil(cases * share)),
        deadline=None,
        derandomize="SEMCAL_FUZZ_CASES" not in os.environ,
        print_blob=True,
        suppress_health_check=[
            HealthCheck.too_slow,
            HealthCheck.data_too_large,
            HealthCheck.function_scoped_fixture,  # only what reads the output of a case
        ],
    )


class _Stuck(BaseException):
    """Not an Exception, so that nothing on the way catches it."""


@contextmanager
def _limited_time() -> Iterator[None]:
    """Ends a case that uses too much time of the processor, however busy the machine is."""

    def stop(number: int, frame: object) -> None:
        raise _Stuck

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, _CPU_LIMIT_S)
    try:
        yield
    except _Stuck:
        raise AssertionError(f"a case needs over {_CPU_LIMIT_S} s of processor time") from None
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


def _memory(key: str) -> int:
    line = next(s for s in _STATUS.read_text().splitlines() if s.startswith(key + ":"))
    return int(line.split()[1]) * 1024


@contextmanager
def _limited_memory() -> Iterator[None]:
    """Fails where the process grew by more than the limit in between, freed again or not."""
    if not _RESET_PEAK.exists():  # only Linux tells; the peak of the whole run is checked elsewhere
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        yield
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    else:
        _RESET_PEAK.write_text("5")
        at_start = _memory("VmRSS")
        yield
        grown = _memory("VmHWM") - at_start
    assert grown < _MEMORY_LIMIT_BYTES, f"a case took {grown / 1e6:.0f} MB of memory"


def check_refusal(error: SemcalError) -> None:
    """Assert that an error is one line that a person can read."""
    message = str(error)
    assert message.strip(), repr(error)
    assert len(message.splitlines()) == 1, repr(message)
    assert len(message) <= _LONGEST_MESSAGE, (len(message), message[:200])


def attempt(action: Callable[[], T]) -> T | None:
    """One case: what ``action`` returns, or None where it refused the input as promised.

    Anything else is a failure: other exceptions, warnings, bad messages, too much time or memory.
    """
    tally = TALLIES.setdefault(os.environ["PYTEST_CURRENT_TEST"].rpartition(" ")[0], Tally())
    value: T | None = None
    refusal: SemcalError | None = None
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        with _limited_memory(), _limited_time():
            try:
                value = action()
            except SemcalError as error:
                refusal = error
    assert not heard, [str(warning.message) for warning in heard]
    if refusal is None:
        tally.accepted += 1
    else:
        check_refusal(refusal)
        tally.refused += 1
    return value


def run_semcal(capfd: pytest.CaptureFixture[str], *arguments: object) -> int:
    """Run the command ``semcal``: its status 0, or :class:`SemcalError` with the line of a refusal.

    Whatever else reaches the terminal on a refusal is a failure, also from libraries in C.
    """
    capfd.readouterr()
    try:
        status = main([str(argument) for argument in arguments])
    except SemcalError as error:
        raise AssertionError("the user sees a traceback") from error
    heard = capfd.readouterr()
    if status == 0:
        return 0
    assert status == 2, (status, heard.err)
    lines = heard.err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("semcal: "), lines
    assert "Traceback" not in heard.err
    raise SemcalError(lines[0])
