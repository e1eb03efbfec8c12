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

__all__ = ["Provenance"]


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
