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

"""The findings of checks."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

__all__ = ["Finding", "Severity", "note", "ok", "problem"]


class Severity(Enum):
    """How serious a finding is: only a problem makes the command fail."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


@dataclass(frozen=True)
class Finding:
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


def ok(subject: str, seen: str) -> Finding:
    """Make a finding that all is well."""
    return Finding(Severity.OK, subject, seen)


def note(subject: str, seen: str, *, expected: str = "", do: str = "") -> Finding:
    """Make a finding that is worth knowing but breaks nothing."""
    return Finding(Severity.NOTE, subject, seen, expected, do)


def problem(subject: str, seen: str, *, expected: str = "", do: str = "") -> Finding:
    """Make a finding that something cannot work."""
    return Finding(Severity.PROBLEM, subject, seen, expected, do)
