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

"""A calibration in messages: its text in a std_msgs/msg/String, and its warnings, safe to log and to publish."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from semcal_ros.bridge.fields import require_fields
from semcal_ros.core.errors import InvalidValueError, MessageError

# A file's size grows with the square of its coefficients, 49 MB for 3000; ours have a few hundred,
# so about 0.5 MB.
MAX_TEXT_BYTES = 16 * 1024 * 1024
"""Limit far above any calibration, so that a wrong file or topic cannot exhaust memory in the parser.

It is the same for files and topics, so that a node can publish whatever it can read.
"""

SCALE_PREFIX = "scale:"
"""Begin of the warnings that judge nm per pixel."""

# Longer than any warning of ours; a line of a terminal is about half of the shortened one.
_LONGEST, _SHORT = 400, 160
# More kinds of warnings than there are; the text of all then has at most 4 kB or so.
_MOST = 10


def calibration_text_from_message(message: Any) -> str:
    """Return the text of a calibration, not yet parsed.

    Raises
    ------
    MessageError
        There is no text, or it is empty or longer than :data:`MAX_TEXT_BYTES`.
    """
    require_fields(message, ("data",), "std_msgs/msg/String")
    text = message.data
    if not isinstance(text, str):
        raise MessageError(
            f"a calibration of type {type(text).__name__}",
            expected="std_msgs/msg/String",
            do="check the type of the topic",
        )
    size = len(text.encode("utf-8", errors="replace"))
    if not text.strip() or size > MAX_TEXT_BYTES:
        raise MessageError(
            f"a calibration message with {size} bytes of text",
            expected=f"the text of a calibration file, 1 to {MAX_TEXT_BYTES} bytes",
            do="check which node publishes the calibration topic",
        )
    return text


def fill_calibration_text(message: Any, text: str) -> None:
    """Set the text; raises :class:`InvalidValueError` if a receiver would refuse it."""
    try:
        size = len(text.encode("utf-8"))
    except UnicodeEncodeError as error:
        raise InvalidValueError("a calibration text with an incomplete character") from error
    if not text.strip() or size > MAX_TEXT_BYTES:
        raise InvalidValueError(
            f"a calibration text of {size} bytes", expected=f"1 to {MAX_TEXT_BYTES} bytes"
        )
    message.data = text


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


def pick_scale_warnings(warnings: Iterable[str]) -> ScaleWarnings:
    """Return those of the warnings of a calibration that are about nm per pixel."""
    found = [text for text in warnings if text.startswith(SCALE_PREFIX)]
    return ScaleWarnings(len(found), tuple(_clean(text) for text in found[:_MOST]))


def _clean(text: str) -> str:
    # Spaces may collapse, so more than is kept; the rest of a huge text is not looked at.
    rest = text[len(SCALE_PREFIX) :][: 4 * _LONGEST]
    # Category C: control characters, those that turn the direction of writing, and halves of characters.
    visible = "".join(" " if unicodedata.category(c).startswith("C") else c for c in rest)
    return _cut(" ".join(visible.split()), _LONGEST) or "without a text"


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 3].rstrip() + "..."
