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

"""What the other topics of a recording said when an image was taken: its magnification, the stage, the conditions.

A recording can always be calibrated without its stage. So nothing that is wrong with it is an error:
it is left out, in whole or in part, with a note that says why. Conditions are never an error either: what cannot be
read is not known.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import fields
from itertools import pairwise
from typing import Any, Generic, TypeVar

from semcal_ros.bridge.conditions import (
    CONDITIONS_TYPE,
    NUMBERS,
    TEXTS,
    Conditions,
    read_conditions,
)
from semcal_ros.bridge.fields import optional_stamp_ns
from semcal_ros.bridge.magnification import MagnificationReading, read_magnification
from semcal_ros.bridge.stage import doubt_unit, missing_joints, read_stage, tilt_jump_rad
from semcal_ros.bridge.zero_order_hold import ZeroOrderHold, find_values, scan_interval_ns
from semcal_ros.config.config import MicroscopeConfig, StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.conditions import FILE_NAMES
from semcal_ros.core.errors import SemcalError
from semcal_ros.core.wording import counted
from semcal_ros.files.bags.reader import BagReader, BagTopic, RawMessage, topic_matches

T = TypeVar("T")

_UNUSED = "the stage is not used"

CONDITIONS_TOPIC = "conditions"
"""Topic with what the microscope says of the conditions (diagnostic_msgs/DiagnosticStatus)."""

_METADATA_TOPIC, _METADATA_TYPE = "metadata", "std_msgs/msg/String"
# What an import writes of one image has a few hundred characters.
_LONGEST_TEXT = 100_000


class HeldValues(Generic[T]):
    """All messages of a topic, each valid until the next one.

    Times are header stamps if every message has one, else the times of the recorder. A message with
    a bad value ends the validity of the one before it, so that no image gets a value that the
    microscope may have left.

    Parameters
    ----------
    reader, topic
        The recording, and the topic in it.
    read
        Makes a value of a message; raises :class:`SemcalError` for a bad one.

    Attributes
    ----------
    bad
        Reasons why messages were ignored.
    usable
        Number of messages with a usable value.
    by_stamp
        Whether header stamps are compared with those of the images, not the times of the recorder.
    timed
        (time in ns, value or None) of all messages, in the order of time.
    """

    def __init__(self, reader: BagReader, topic: str, read: Callable[[Any], T]) -> None:
        self.bad: list[str] = []
        self.usable = 0
        rows = [self._row(reader, raw, read) for raw in reader.raw_messages([topic])]
        self.by_stamp = bool(rows) and all(stamp_ns for stamp_ns, _, _ in rows)
        timed = [
            ((stamp_ns or 0) if self.by_stamp else logged, value)
            for stamp_ns, logged, value in rows
        ]
        self.timed: list[tuple[int, T | None]] = sorted(timed, key=lambda pair: pair[0])
        self._hold = ZeroOrderHold[Any](max_length=max(1, len(rows)))
        for time_ns, value in self.timed:
            self._hold.insert(time_ns, value)

    def _row(
        self, reader: BagReader, raw: RawMessage, read: Callable[[Any], T]
    ) -> tuple[int | None, int, T | None]:
        """Header stamp (None without one), receive time, and the value (None if it is bad)."""
        stamp_ns = None
        try:
            message = reader.decode(raw)
            stamp_ns = optional_stamp_ns(message)
            value = read(message)
        except SemcalError as error:
            self.bad.append(str(error))
            return stamp_ns, raw.log_time_ns, None
        self.usable += 1
        return stamp_ns, raw.log_time_ns, value

    def held_at(self, stamp_ns: int, log_time_ns: int) -> T | None:
        """Return the value at an image, or None before the first message and after a bad one."""
        held: T | None = self._hold.at(stamp_ns if self.by_stamp else log_time_ns)
        return held

    def held_during(self, start_ns: int, end_ns: int) -> list[T | None]:
        """Return all values of an interval, the one at its start first."""
        return [self._hold.at(start_ns), *self._hold.between(start_ns, end_ns)]


class MagnificationTrack(HeldValues[MagnificationReading]):
    """All magnification messages of a topic, each valid until the next one."""

    def __init__(self, reader: BagReader, topic: str, config: MicroscopeConfig) -> None:
        super().__init__(reader, topic, lambda message: read_magnification(message, config))
        self._config = config

    def at(self, stamp_ns: int, log_time_ns: int, image_width_px: int) -> float | None:
        """Return the magnification at an image, or None before the first message and after a bad one.

        Raises
        ------
        MessageError
            A pixel size gives no credible magnification for an image of this width.
        """
        sent_ns = None if self.by_stamp else log_time_ns
        reading, _ = find_values(self._hold, stamp_ns, sent_ns, self._config)
        return None if reading is None else float(reading.magnification(image_width_px))


class StageTrack(HeldValues[StageReading]):
    """All messages of the stage, each valid until the next one."""

    def __init__(self, reader: BagReader, topic: str, config: MicroscopeConfig) -> None:
        self._config = config
        source = config.stage or StageConfig()
        super().__init__(reader, topic, lambda message: read_stage(message, source))
        self._source = source
        self._topic = topic
        self._readings = [reading for _, reading in self.timed if reading is not None]

    def at(self, stamp_ns: int, log_time_ns: int) -> tuple[StageReading | None, bool]:
        """Return the reading at an image, None if it is not known; and whether the stage moved."""
        reading = self.held_at(stamp_ns, log_time_ns)
        interval = scan_interval_ns(stamp_ns, None if self.by_stamp else log_time_ns, self._config)
        if reading is None or interval is None:
            return reading, False
        others = [other for other in self.held_during(*interval) if other is not None]
        moved = any(self._differs(reading, other) for other in others)
        return (None if moved else reading), moved

    def _differs(self, one: StageReading, other: StageReading) -> bool:
        sigma = self._source.sigma
        angles = (
            (one.tilt_rad, other.tilt_rad, sigma.tilt),
            (one.rotation_rad, other.rotation_rad, sigma.rotation),
            (one.scan_rotation_rad, other.scan_rotation_rad, sigma.rotation),
        )
        return any(a is not None and b is not None and abs(a - b) > s for a, b, s in angles)

    def problem(self) -> str:
        """Return why no reading can be used; empty if they can."""
        if not self._readings:
            return f"no message of {len(self.bad)} is usable, the first: {self.bad[0]}"
        for reading in self._readings:
            if doubt := doubt_unit(reading, self._source):
                return f"{doubt} looks like degrees; expected radians"
        return ""

    def notes(self) -> list[str]:
        """Return what is odd about the readings although they are used."""
        notes = []
        if self.bad:
            notes.append(
                f"{counted(len(self.bad), 'message')} on {self._topic} ignored"
                + (", the first" if len(self.bad) > 1 else "")
                + f": {self.bad[0]}"
            )
        notes += [
            f"no message on {self._topic} has the joint {joint}"
            for joint in missing_joints(self._readings, self._source)
        ]
        for joint, name in (
            (self._source.tilt, "tilt_rad"),
            (self._source.rotation, "rotation_rad"),
            (self._source.scan_rotation, "scan_rotation_rad"),
        ):
            without = sum(getattr(reading, name) is None for reading in self._readings)
            if 0 < without < len(self._readings):
                notes.append(
                    f"{without} of {counted(len(self._readings), 'message')} on {self._topic} without the joint {joint}"
                )
        jumps = list(self._jumps())
        if jumps:
            degrees, seconds, at_ns = jumps[0]
            notes.append(
                f"the tilt on {self._topic} jumps {len(jumps)} times, first by {degrees:.1f} degrees within "
                f"{seconds:.3g} s at {at_ns * 1e-9:.3f} s: a wrong reading, or a wrong stamp"
            )
        return notes

    def _jumps(self) -> list[tuple[float, float, int]]:
        """(degrees, seconds, time in ns) of each change of the tilt that no stage can make."""
        tilts = [
            (time_ns, reading)
            for time_ns, reading in self.timed
            if reading is not None and reading.tilt_rad is not None
        ]
        seen = (
            (tilt_jump_rad(before, after, (end_ns - start_ns) * 1e-9), start_ns, end_ns)
            for (start_ns, before), (end_ns, after) in pairwise(tilts)
        )
        return [
            (math.degrees(change), (end_ns - start_ns) * 1e-9, end_ns)
            for change, start_ns, end_ns in seen
            if change
        ]


def find_stage(
    reader: BagReader, config: MicroscopeConfig, image_topic: str
) -> tuple[StageTrack | None, list[str]]:
    """Read the stage of a recording, if it has one.

    Parameters
    ----------
    reader
        The open recording.
    config
        Its stage section says what to look for.
    image_topic
        Topic of the images: of several stages, the one in the same namespace is meant.

    Returns
    -------
    track
        None where there is no stage, or none that can be used.
    notes
        What is wrong with it.
    """
    if config.stage is None:
        return None, []
    topic, reason = _find_stage_topic(reader.topics, config.stage, image_topic)
    if topic is None:
        return None, [f"{reason}: {_UNUSED}"] if reason else []
    try:
        track = StageTrack(reader, topic.name, config)
    except SemcalError as error:
        return None, [f"{topic.name} cannot be read ({error}): {_UNUSED}"]
    if problem := track.problem():
        return None, [f"{topic.name}: {problem}: {_UNUSED}"]
    return track, track.notes()


def _find_stage_topic(
    topics: tuple[BagTopic, ...], source: StageConfig, image_topic: str
) -> tuple[BagTopic | None, str]:
    named = [t for t in topics if t.count and topic_matches(source.topic, t.name)]
    fitting = [t for t in named if t.type == source.type]
    sibling = f"{image_topic.rpartition('/')[0]}/{source.topic}"
    fitting = [t for t in fitting if t.name == sibling] or fitting
    if len(fitting) == 1:
        return fitting[0], ""
    if fitting:
        seen = ", ".join(t.name for t in fitting[:4])
        return None, f"several topics could be the stage ({seen}); expected one {source.topic}"
    if named:
        return None, (
            f"topic {named[0].name} has type {named[0].type}; expected {source.type} for the stage"
        )
    return None, ""


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
        topic = _find_conditions_topic(reader, CONDITIONS_TOPIC, CONDITIONS_TYPE, image_topic)
        if topic:
            self._held = HeldValues(
                reader, topic, lambda message: Conditions.from_topic(read_conditions(message))
            )
        metadata = _find_conditions_topic(reader, _METADATA_TOPIC, _METADATA_TYPE, image_topic)
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


def _find_conditions_topic(reader: BagReader, name: str, kind: str, image_topic: str) -> str:
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
