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

"""Another value of a row of a table of thresholds, in a process that has not imported the package yet."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

# Parts and the like, which must stay below 1.
BOUNDED = ("of ", "correlation", "quantile", "probability", "sine", "squared cosine")


@dataclass(frozen=True)
class Change:
    """What to do with a row: ``factor`` above 1 makes it larger, below 1 smaller."""

    name: str
    factor: float


def is_numeric(value: object) -> bool:
    """Whether a value can be changed: words in order of likelihood cannot."""
    return not isinstance(value, dict | str | bool)


def vary(value: Any, unit: str, factor: float) -> Any:
    """Multiply a number, or each of several.

    Whole numbers stay whole, and differ by one at least. Parts of a whole above a half stay below one: it is what they
    lack that is divided, as long as the factor is no extreme.
    """
    if isinstance(value, tuple):
        return tuple(vary(part, unit, factor) for part in value)
    if isinstance(value, np.ndarray):
        return value * factor
    if isinstance(value, int):
        other = round(value * factor)
        return other if other != value else value + (1 if factor > 1.0 else -1)
    if 0.5 < value < 1.0 and unit.startswith(BOUNDED) and 0.01 < factor < 100.0:
        return 1.0 - (1.0 - value) / factor
    return value * factor


def install(room: str, change: Change | None) -> None:
    """Let the tables of this process have a changed row.

    Parameters
    ----------
    room
        The dotted name of the module with the table.
    change
        None changes nothing.

    Raises
    ------
    RuntimeError
        The room is imported already: the change would reach a part of it only.
    """
    from semcal_ros.core.thresholds import Table

    if room in sys.modules:
        raise RuntimeError(f"{room} is imported already")
    if change is None:
        return
    add = Table._add

    def changed(self: Table, name: str, value: Any, unit: str, *rest: Any) -> Any:
        # Rooms may have rows of the same name: the caller of the method that adds it is the table's module.
        if name == change.name and sys._getframe(2).f_globals["__name__"] == room:
            value = vary(value, unit, change.factor)
        return add(self, name, value, unit, *rest)

    Table._add = changed
