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

"""Operating conditions: how an image was taken, and as a diagnostic_msgs/msg/DiagnosticStatus with values in SI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import datetime
from typing import Any

from semcal_ros.bridge.fields import new_nested, require_fields
from semcal_ros.core.camera.conditions import FILE_NAMES

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


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """How an image was taken, in SI units; None, or an empty text, where a file does not say it.

    Parameters
    ----------
    maker
        ``zeiss``, ``thermo_fisher``, ``tescan``, ``jeol``, ``hitachi``, ``phenom``, ``olympus`` or, for a copy that
        ImageJ saved without the maker's metadata, ``imagej``.
    model, serial_number
        Name and serial number of the microscope.
    detector
        Detector or signal.
    beam
        ``electron`` or ``ion``.
    acceleration_voltage_v
        Acceleration voltage, without its sign.
    working_distance_m
        Working distance.
    beam_current_a
        Current of the beam on the specimen.
    scan_rotation_rad, stage_tilt_rad, stage_rotation_rad
        Angles in the maker's sense of rotation.
    dwell_s
        Time on each pixel in one pass.
    frame_time_s
        Time of one pass over the frame.
    frame_interval_s
        Time from one page of the file to the next.
    time
        Local time of the recording, without a time zone.
    """

    maker: str = ""
    model: str = ""
    serial_number: str = ""
    detector: str = ""
    beam: str = ""
    acceleration_voltage_v: float | None = None
    working_distance_m: float | None = None
    beam_current_a: float | None = None
    scan_rotation_rad: float | None = None
    stage_tilt_rad: float | None = None
    stage_rotation_rad: float | None = None
    dwell_s: float | None = None
    frame_time_s: float | None = None
    frame_interval_s: float | None = None
    time: datetime | None = None

    def conditions(self) -> dict[str, Any]:
        """All conditions by name as plain values for JSON."""
        values = {item.name: getattr(self, item.name) for item in fields(Conditions)}
        return {**values, "time": None if self.time is None else self.time.isoformat()}

    def topic_values(self) -> dict[str, float | str]:
        """What is known of what the topic ``conditions`` tells, by its keys."""
        found = {key: getattr(self, FILE_NAMES.get(key, key)) for key in (*NUMBERS, *TEXTS)}
        return {key: value for key, value in found.items() if value not in (None, "")}

    @classmethod
    def from_topic(cls, values: Mapping[str, float | str]) -> Conditions:
        """Make them of the values of the topic ``conditions``; other keys are left out."""
        known = {FILE_NAMES.get(k, k): v for k, v in values.items() if k in (*NUMBERS, *TEXTS)}
        return Conditions(**known)  # type: ignore[arg-type]


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
