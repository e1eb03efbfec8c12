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

"""Warnings that stand in a calibration file, in a form that is safe to log and to publish."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

SCALE_PREFIX = "scale:"
"""Begin of the warnings that judge nm per pixel."""

# Longer than any warning of ours; a line of a terminal is about half of the shortened one.
_LONGEST, _SHORT = 400, 160
# More kinds of warnings than there are; the text of all then has at most 4 kB or so.
_MOST = 10


@dataclass(frozen=True)
class ScaleWarnings:
    """Warnings about nm per pixel.

    Attributes
    ----------
    count
        How many there are.
    texts
        The first of them, without the prefix, each on one line and of limited length.
    """

    count: int = 0
    texts: tuple[str, ...] = ()

    @property
    def summary(self) -> str:
        """How many there are, and the beginning of the first one; empty without any."""
        if not self.count:
            return ""
        counted = "a warning" if self.count == 1 else f"{self.count} warnings, the first"
        # Conditions are told apart by semicolons.
        first = _cut(self.texts[0], _SHORT).replace(";", ",")
        return f"scale of the calibration: {counted}: {first}"

    @property
    def details(self) -> str:
        """The text of all, separated by bars; empty without any."""
        more = self.count - len(self.texts)
        return " | ".join([*self.texts, *([f"and {more} more"] if more else [])])


def read_scale_warnings(statistics: Mapping[str, Any]) -> ScaleWarnings:
    """Return the warnings about nm per pixel among the statistics of a calibration.

    The statistics of a file may be anything: what is no list of texts has no warnings.
    """
    listed = statistics.get("warnings") if isinstance(statistics, Mapping) else None
    if not isinstance(listed, (list, tuple)):
        return ScaleWarnings()
    found = [w for w in listed if isinstance(w, str) and w.startswith(SCALE_PREFIX)]
    return ScaleWarnings(len(found), tuple(_clean(text) for text in found[:_MOST]))


def _clean(text: str) -> str:
    # Spaces may collapse, so more than is kept; the rest of a huge text is not looked at.
    rest = text[len(SCALE_PREFIX) :][: 4 * _LONGEST]
    # Category C: control characters, those that turn the direction of writing, and halves of characters.
    visible = "".join(" " if unicodedata.category(c).startswith("C") else c for c in rest)
    return _cut(" ".join(visible.split()), _LONGEST) or "without a text"


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 3].rstrip() + "..."
