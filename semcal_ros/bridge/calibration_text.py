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

"""A calibration file's text in a std_msgs/msg/String."""

from __future__ import annotations

from typing import Any

from semcal_ros.bridge.fields import require_fields
from semcal_ros.core.errors import InvalidValueError, MessageError

# A file's size grows with the square of its coefficients, 49 MB for 3000; ours have a few hundred,
# so about 0.5 MB.
MAX_TEXT_BYTES = 16 * 1024 * 1024
"""Limit far above any calibration, so that a wrong file or topic cannot exhaust memory in the parser.

It is the same for files and topics, so that a node can publish whatever it can read.
"""


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
