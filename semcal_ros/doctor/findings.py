"""What a check says."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

__all__ = ["Finding", "Severity", "note", "ok", "problem"]


class Severity(Enum):
    """How bad it is: only a problem lets the command fail."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


@dataclass(frozen=True)
class Finding:
    """One line of advice.

    Attributes
    ----------
    level
        How bad it is.
    subject
        What was looked at, in a few words.
    seen, expected, do
        What was found, what would be well, and the next step; the last two are empty where all is well.
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
    """All is well."""
    return Finding(Severity.OK, subject, seen)


def note(subject: str, seen: str, *, expected: str = "", do: str = "") -> Finding:
    """Worth knowing, but nothing fails for it."""
    return Finding(Severity.NOTE, subject, seen, expected, do)


def problem(subject: str, seen: str, *, expected: str = "", do: str = "") -> Finding:
    """Something cannot work like this."""
    return Finding(Severity.PROBLEM, subject, seen, expected, do)
