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

"""Under which conditions each image of a recording was taken.

As the stage, they are never an error: what cannot be read is not known.
"""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import Any

from semcal_ros.bridge.conditions import CONDITIONS_TYPE, NUMBERS, TEXTS, read_conditions
from semcal_ros.core.camera.conditions import FILE_NAMES
from semcal_ros.core.errors import SemcalError
from semcal_ros.files.bags.held_values import HeldValues
from semcal_ros.files.bags.reader import BagReader
from semcal_ros.files.bags.topics import topic_matches
from semcal_ros.files.tiff.sem_image import Conditions

CONDITIONS_TOPIC = "conditions"
"""Topic with what the microscope says of the conditions (diagnostic_msgs/DiagnosticStatus)."""

_METADATA_TOPIC, _METADATA_TYPE = "metadata", "std_msgs/msg/String"
# What an import writes of one image has a few hundred characters.
_LONGEST_TEXT = 100_000


class ConditionsTrack:
    """What a recording says of the conditions at each image.

    Parameters
    ----------
    reader, image_topic
        The open recording; of several topics, those beside the images are meant.
    """

    def __init__(self, reader: BagReader, image_topic: str) -> None:
        self._held: HeldValues[Conditions] | None = None
        self._by_stamp: dict[int, Conditions] = {}
        topic = _find_topic(reader, CONDITIONS_TOPIC, CONDITIONS_TYPE, image_topic)
        if topic:
            self._held = HeldValues(
                reader, topic, lambda message: Conditions.from_topic(read_conditions(message))
            )
        metadata = _find_topic(reader, _METADATA_TOPIC, _METADATA_TYPE, image_topic)
        if metadata:
            for raw in reader.raw_messages([metadata]):
                said = _read_metadata(reader.decode(raw))
                if said is not None:
                    self._by_stamp[said[0]] = said[1]

    def at(self, stamp_ns: int, log_time_ns: int) -> Conditions | None:
        """Return what is known at an image; an import's settings of the image itself count most."""
        of_image = self._by_stamp.get(stamp_ns)
        held = None if self._held is None else self._held.held_at(stamp_ns, log_time_ns)
        found = of_image or held
        return None if found == Conditions() else found


def find_conditions(reader: BagReader, image_topic: str) -> ConditionsTrack | None:
    """Read the conditions of a recording; None if there are none that can be read."""
    try:
        return ConditionsTrack(reader, image_topic)
    except SemcalError:
        return None


def _find_topic(reader: BagReader, name: str, kind: str, image_topic: str) -> str:
    named = [t.name for t in reader.topics if t.type == kind and topic_matches(name, t.name)]
    sibling = f"{image_topic.rpartition('/')[0]}/{name}"
    if sibling in named:
        return sibling
    return named[0] if len(named) == 1 else ""


def _read_metadata(message: Any) -> tuple[int, Conditions] | None:
    """Stamp and conditions of one image of an import; None for another text."""
    text = getattr(message, "data", "")
    if not isinstance(text, str) or len(text) > _LONGEST_TEXT:
        return None
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        return None
    stamp_ns = data.get("stamp_ns") if isinstance(data, dict) else None
    if not isinstance(stamp_ns, int):
        return None
    texts = {*(FILE_NAMES.get(key, key) for key in TEXTS), "beam"}
    numbers = {*(FILE_NAMES.get(key, key) for key in NUMBERS), "frame_interval_s"}
    numbers |= {"stage_tilt_rad", "stage_rotation_rad"}
    known: dict[str, Any] = {}
    for item in fields(Conditions):
        value = data.get(item.name)
        if item.name in texts and isinstance(value, str):
            known[item.name] = value[:200]
        elif item.name in numbers and type(value) in (int, float) and math.isfinite(value):
            known[item.name] = float(value)
    return stamp_ns, Conditions(**known)
