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

"""Where the stage was at each image of a recording.

A recording can always be calibrated without its stage. So nothing that is wrong with it is an error:
it is left out, in whole or in part, with a note that says why.
"""

from __future__ import annotations

import math
from itertools import pairwise

from semcal_ros.bridge.stage import doubt_unit, missing_joints, read_stage, tilt_jump_rad
from semcal_ros.bridge.zero_order_hold import scan_interval_ns
from semcal_ros.config.config import MicroscopeConfig, StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import SemcalError
from semcal_ros.core.wording import counted
from semcal_ros.files.bags.held_values import HeldValues
from semcal_ros.files.bags.reader import BagReader, BagTopic
from semcal_ros.files.bags.topics import topic_matches

_UNUSED = "the stage is not used"


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
    topic, reason = _find_topic(reader.topics, config.stage, image_topic)
    if topic is None:
        return None, [f"{reason}: {_UNUSED}"] if reason else []
    try:
        track = StageTrack(reader, topic.name, config)
    except SemcalError as error:
        return None, [f"{topic.name} cannot be read ({error}): {_UNUSED}"]
    if problem := track.problem():
        return None, [f"{topic.name}: {problem}: {_UNUSED}"]
    return track, track.notes()


def _find_topic(
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
