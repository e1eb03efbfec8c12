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

"""Tables of the numbers that decide something, each with its unit and where its value comes from.

A room of the package has one such table, its module ``thresholds``. A row is the definition of the number, too, so that
the code reads it as any other constant::

    TABLE = Table()

    IMBALANCE_MAX = TABLE.derived("IMBALANCE_MAX", 15.0, "chi-square", "By chance once in 1800 corners: exp(-15 / 2).")
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError

V = TypeVar(
    "V",
    int,
    float,
    tuple[int, int],
    tuple[float, float],
    tuple[int, ...],
    tuple[float, ...],
    tuple[tuple[float, float], ...],
    dict[str, int],
    dict[str, float],
    Array,
)


class Source(Enum):
    """Where the value of a number comes from."""

    DERIVED = "derived"
    """From a formula, a distribution or a publication, which the text gives."""
    MEASURED = "measured"
    """By a command of this repository, which the text gives."""
    DEFINED = "defined"
    """It says what something is, or how often chance may raise a false alarm; there is nothing to be found out."""
    COST = "cost"
    """It bounds time or memory, and hardly changes a result."""
    STATED = "stated"
    """Chosen by its author. The text says why, and what was seen; nothing here repeats it."""


@dataclass(frozen=True, eq=False)
class Threshold:
    """One row.

    Attributes
    ----------
    name
        Name of the constant.
    value
        A number, or several of one kind: a tuple, an array, or a dictionary of them by name.
    unit
        Unit, or what the number is a part or a multiple of.
    source
        Where the value comes from.
    text
        What the number is for, and the source itself.
    """

    name: str
    value: object
    unit: str
    source: Source
    text: str


class Table:
    """The numbers of a room, in the order in which they were added. Each method adds a row and returns its value."""

    def __init__(self) -> None:
        self._rows: dict[str, Threshold] = {}

    def __iter__(self) -> Iterator[Threshold]:
        return iter(self._rows.values())

    def derived(self, name: str, value: V, unit: str, text: str) -> V:
        """Add a number with a formula, a distribution or a publication."""
        return self._add(name, value, unit, Source.DERIVED, text)

    def measured(self, name: str, value: V, unit: str, text: str, *, command: str) -> V:
        """Add a number that a command of this repository shows."""
        return self._add(name, value, unit, Source.MEASURED, f"{text} ({command})")

    def defined(self, name: str, value: V, unit: str, text: str) -> V:
        """Add a number that says what something is."""
        return self._add(name, value, unit, Source.DEFINED, text)

    def cost(self, name: str, value: V, unit: str, text: str) -> V:
        """Add a bound of time or memory."""
        return self._add(name, value, unit, Source.COST, text)

    def stated(self, name: str, value: V, unit: str, text: str) -> V:
        """Add a number that was chosen."""
        return self._add(name, value, unit, Source.STATED, text)

    def _add(self, name: str, value: V, unit: str, source: Source, text: str) -> V:
        if name in self._rows:
            raise InvalidValueError(f"two thresholds {name}", expected="a name of its own for each")
        self._rows[name] = Threshold(name, value, unit, source, text)
        return value


def sigmas_of_chance(chance: float, sides: int = 2) -> float:
    """Return the number of sigmas that a normal deviate exceeds with this chance, on both sides or on one."""
    # Rooms without such a number have no need of scipy.
    from scipy.special import ndtri

    return -float(ndtri(chance / sides))
