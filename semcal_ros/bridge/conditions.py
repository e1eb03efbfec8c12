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

"""Operating conditions as a diagnostic_msgs/msg/DiagnosticStatus: text keys and values in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from semcal_ros.bridge.fields import new_nested, require_fields

NUMBERS = (
    "accelerating_voltage_v",
    "working_distance_m",
    "beam_current_a",
    "dwell_s",
    "frame_time_s",
    "scan_rotation_rad",
)
"""Keys whose values are numbers."""

TEXTS = ("detector", "maker", "model", "serial")
"""Keys whose values are texts."""

CONDITIONS_TYPE = "diagnostic_msgs/msg/DiagnosticStatus"
"""Type of the topic."""

# A detector has a name of a few words; what is longer is something else.
_LONGEST = 200


def fill_conditions(message: Any, conditions: Mapping[str, float | str], name: str = "") -> None:
    """Set a DiagnosticStatus to the known conditions; other keys, and what is not known, are left out.

    Parameters
    ----------
    message
        The message to fill.
    conditions
        Values by the keys of :data:`NUMBERS` and :data:`TEXTS`.
    name
        Of the microscope, for people.
    """
    message.name = name
    message.message = "operating conditions"
    message.values = [
        new_nested(message, "diagnostic_msgs/msg/KeyValue", key=key, value=_text(conditions[key]))
        for key in (*NUMBERS, *TEXTS)
        if conditions.get(key) not in (None, "")
    ]


def read_conditions(message: Any) -> dict[str, float | str]:
    """Return the known conditions of a DiagnosticStatus; what is no finite number, or no text, is not known.

    Raises
    ------
    MessageError
        It is a message of another type.
    """
    require_fields(message, ("values",), CONDITIONS_TYPE)
    found: dict[str, float | str] = {}
    for pair in message.values:
        # A recording may redefine the type.
        key, text = str(getattr(pair, "key", "")), str(getattr(pair, "value", "")).strip()
        if key in TEXTS and text:
            found[key] = text[:_LONGEST]
        elif key in NUMBERS:
            try:
                number = float(text)
            except ValueError:
                continue
            if math.isfinite(number):
                found[key] = number
    return found


def _text(value: float | str) -> str:
    return value[:_LONGEST] if isinstance(value, str) else repr(float(value))
