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

"""The English of messages: numbers of things, and names that were misspelt."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Callable, Iterable
from typing import SupportsIndex

_NUMBER = re.compile(r"-?\d[\d.]*")


def counted(count: SupportsIndex, one: str, many: str = "") -> str:
    """Return a number of things in words, such as ``1 frame`` and ``2 frames``.

    Parameters
    ----------
    count
        How many there are.
    one, many
        What one of them and several are called, with a verb where the sentence needs it (``frame is``,
        ``frames are``); several get an s if nothing is given.
    """
    return f"{count} {one if count == 1 else many or one + 's'}"


def rounded_magnification(g: float) -> str:
    """Return a magnification without decimals, such as ``5250x``; those of photographs with three digits."""
    return f"{g:.0f}x" if g >= 10.0 else f"{g:.3g}x"


def format_length(length_m: float) -> str:
    """Format a length as options take it, such as ``25.1mm``."""
    units = (("m", 1.0), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9))
    unit, size_m = next((u for u in units if length_m >= u[1]), units[-1])
    return f"{float(f'{length_m / size_m:.4g}'):g}{unit}"


def in_nm(length_m: float) -> str:
    """Return a length to two digits in nm, without an exponent; those of photographs in um."""
    factor, unit = (1e9, "nm") if abs(length_m) < 1e-4 else (1e6, "um")
    return f"{float(f'{factor * length_m:.2g}'):.10g} {unit}"


def omit_numbers(text: str) -> str:
    """A text with dots in the place of its numbers, so that messages can be counted by kind."""
    return _NUMBER.sub("\u2026", text)


def group_by_kind(
    messages: Iterable[str], kind_of: Callable[[str], str] = omit_numbers
) -> list[str]:
    """Return one message of each kind, the first, with how many more there are.

    Parameters
    ----------
    messages
        In any order; the kinds come in the order of their first messages.
    kind_of
        What is the same for messages of a kind; by default all but the numbers.
    """
    kinds: dict[str, list[str]] = {}
    for message in messages:
        kinds.setdefault(kind_of(message), []).append(message)
    return [
        same[0] if len(same) == 1 else f"{same[0]} (and {len(same) - 1} more of this kind)"
        for same in kinds.values()
    ]


def printable(text: object, longest: int = 1000) -> str:
    """Return a text of others as one line: without control characters, and cut off where it is too long."""
    # Category C: control characters, those that turn the direction of writing, and halves of characters.
    shown = "".join(" " if unicodedata.category(c)[0] == "C" else c for c in str(text)[:longest])
    return shown.rstrip() + "..." * (len(str(text)) > longest)


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return the known name that looks most like a misspelt one; empty if none does."""
    names = {other.casefold(): other for other in known}
    found = difflib.get_close_matches(name.casefold(), list(names), 1)
    return names[found[0]] if found else ""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the question which of the known names a misspelt one stands for; empty if none looks like it."""
    nearest = nearest_name(name, known)
    return f"did you mean {nearest}?" if nearest else ""
