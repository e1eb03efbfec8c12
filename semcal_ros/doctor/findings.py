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

"""The findings of checks, and what the figures in them mean."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

# Words in a finding, and what the figure beside them is.
_FIGURES = (
    (" Hz", "Hz: messages per second while this command listened, or in the recording"),
    (
        "old when they arrive",
        "age of frames: from the stamp, the start of the scan, to the arrival; it includes the scan itself",
    ),
    (
        "from publisher to here",
        "from publisher to here: the transport alone, by the clocks of both",
    ),
    (
        "predicted 1-sigma error",
        "1-sigma error: standard deviation, by the calibration's covariance, of the pixel to which a point of known"
        " position is projected; most of it is common to all points of an image and drops out of distances in it",
    ),
    (
        "MiB of shared memory",
        "shared memory: the segment of each process; larger messages wait for room",
    ),
)


class Severity(Enum):
    """How serious a finding is: only a problem makes the command fail."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


@dataclass(frozen=True)
class CheckResult:
    """One line of advice.

    Attributes
    ----------
    level
        How serious it is.
    subject
        What was checked, in a few words.
    seen, expected, do
        What was found, what was expected, and the next step; the last two are empty if all is well.
    """

    level: Severity
    subject: str
    seen: str
    expected: str = ""
    do: str = ""

    def __str__(self) -> str:
        parts = [f"{self.subject}: {self.seen}"]
        if self.expected:
            parts.append(f"expected {self.expected}")
        if self.do:
            parts.append(self.do)
        return " ".join("; ".join(parts).split())


def ok(subject: str, seen: str) -> CheckResult:
    """Make a finding that all is well."""
    return CheckResult(Severity.OK, subject, seen)


def note(subject: str, seen: str, *, expected: str = "", do: str = "") -> CheckResult:
    """Make a finding that is worth knowing but breaks nothing."""
    return CheckResult(Severity.NOTE, subject, seen, expected, do)


def problem(subject: str, seen: str, *, expected: str = "", do: str = "") -> CheckResult:
    """Make a finding that something cannot work."""
    return CheckResult(Severity.PROBLEM, subject, seen, expected, do)


def explain_figures(findings: Iterable[CheckResult]) -> list[str]:
    """Return one sentence for each kind of figure that the findings show."""
    shown = [str(finding) for finding in findings]
    return [text for words, text in _FIGURES if any(words in line for line in shown)]
