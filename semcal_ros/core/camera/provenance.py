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

"""Where a calibration comes from, and under which conditions it was recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from semcal_ros.core.camera.conditions import describe_condition
from semcal_ros.core.wording import printable

NOT_RECORDED = "not recorded"
"""What people read in the place of what is not known."""

# The microscope is named by these alone, without a label.
_MICROSCOPE = ("maker", "model", "serial_number")
# Of interest with the views, not with the microscope.
# What changes the scale of any microscope.
_ESSENTIAL = ("acceleration_voltage_v", "working_distance_m")
_OF_VIEWS = ("beam", "stage_tilt_rad", "stage_rotation_rad", "frame_interval_s")


@dataclass(frozen=True)
class Provenance:
    """Origin of a calibration; an empty text or collection where it is not recorded.

    Attributes
    ----------
    calibrated
        When it was computed: date and time (UTC).
    recorded
        Date and time (UTC) of the first and the last view, where the stamps are dates.
    software_version
        Version of the software that computed it.
    recording, recording_sha256
        Name of the recording, and the digest of its data files.
    configuration, configuration_sha256
        Name of the configuration, and the digest of the settings in effect.
    views
        Names of the views used.
    conditions
        How the views were taken, in SI units: the different texts, or the least and the greatest number.
    """

    calibrated: str = ""
    recorded: tuple[str, ...] = ()
    software_version: str = ""
    recording: str = ""
    recording_sha256: str = ""
    configuration: str = ""
    configuration_sha256: str = ""
    views: tuple[str, ...] = ()
    conditions: Mapping[str, tuple[str, ...] | tuple[float, ...]] = field(default_factory=dict)

    def describe_origin(self) -> str:
        """When, with what, and from what it was computed, in one line."""
        parts = [
            f"{self.calibrated} UTC" if self.calibrated else "",
            f"recording {self.recording}" if self.recording else "",
            f"configuration {self.configuration}" if self.configuration else "",
            f"semcal_ros {self.software_version}" if self.software_version else "",
        ]
        return printable(", ".join(filter(None, parts))) or NOT_RECORDED

    def describe_microscope(self) -> str:
        """Maker, model and serial number of the microscope, in one line."""
        known = [" or ".join(map(str, self.conditions.get(name, ()))) for name in _MICROSCOPE]
        return printable(" ".join(filter(None, known))) or NOT_RECORDED

    def describe_conditions(self) -> str:
        """The conditions of the beam and the scan, in one line."""
        parts = [
            " ".join(describe_condition(name, values))
            for name, values in self.conditions.items()
            if name not in (*_MICROSCOPE, *_OF_VIEWS)
        ]
        return ", ".join(parts) or NOT_RECORDED

    def describe_essentials(self) -> str:
        """What a calibration holds for, in a few words: voltage, working distance and the days of its views."""
        days = tuple(dict.fromkeys(date[:10] for date in self.recorded))
        parts = {
            describe_condition(name, ())[0]: describe_condition(
                name, self.conditions.get(name, ())
            )[1]
            for name in _ESSENTIAL
        } | {"date": " to ".join(days)}
        if not any(parts.values()):
            return f"conditions {NOT_RECORDED}"
        return printable(
            ", ".join(f"{name} {value or NOT_RECORDED}" for name, value in parts.items())
        )

    def describe(self) -> str:
        """All three, in one line for a log."""
        parts = (self.describe_origin(), self.describe_microscope(), self.describe_conditions())
        known = [part for part in parts if part != NOT_RECORDED]
        return printable(", ".join(known), 300) or NOT_RECORDED
