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

"""Where the stage is, from messages that name its joints (sensor_msgs/msg/JointState)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from semcal_ros.bridge.fields import require_fields
from semcal_ros.config.config import StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import MessageError

# A specimen that is tilted by a right angle is seen edge-on; some stages reach a degree or so more.
_MAX_TILT_RAD = 1.6
# No stage turns further than twice round, and angles of a scan end at half a turn or a turn.
_MAX_TURN_RAD = 4.0 * math.pi
# Motorised stages tilt by some degrees per second. A faster change of more than a small step is a
# wrong reading, or the time of a message is.
_STEP_RAD, _RATE_RAD_S = math.radians(10.0), math.radians(60.0)


def read_stage(message: Any, source: StageConfig) -> StageReading:
    """Read the joints that the configuration names; None for a joint that is missing.

    A position that is not finite is taken for missing: what is made of a calibration is the angles.

    Raises
    ------
    MessageError
        It is no JointState, names and positions do not match, or an angle is not finite.
    """
    require_fields(message, ("name", "position"), source.type)
    try:
        names = [str(name) for name in message.name]
        positions = [float(position) for position in message.position]
    except (TypeError, ValueError, OverflowError) as error:
        raise MessageError(
            f"a message of type {type(message).__name__} whose joints cannot be read: {error}",
            expected=source.type,
        ) from error
    if len(names) != len(positions) or len(names) != len(set(names)):
        raise MessageError(
            f"{len(positions)} positions of the joints {', '.join(names[:8]) or 'without names'}",
            expected="one position for each joint, and each joint once",
            do="check the node that publishes the stage",
        )
    known = dict(zip(names, positions, strict=True))
    wrong = [
        f"{joint} {known[joint]}"
        for joint in (source.tilt, source.rotation, source.scan_rotation)
        if not math.isfinite(known.get(joint, 0.0))
    ]
    if wrong:
        raise MessageError(
            f"a stage with {', '.join(wrong)}",
            expected="finite angles in rad",
            do="check the node that publishes the stage",
        )
    x_m, y_m = (
        value if value is not None and math.isfinite(value) else None
        for value in (known.get(source.x), known.get(source.y))
    )
    return StageReading(
        known.get(source.tilt),
        known.get(source.rotation),
        known.get(source.scan_rotation),
        x_m,
        y_m,
    )


def doubt_unit(reading: StageReading, source: StageConfig) -> str:
    """Return which angle no stage has in rad, such as ``"tilt 30 rad"``, or an empty text."""
    limits = (
        (source.tilt, reading.tilt_rad, _MAX_TILT_RAD),
        (source.rotation, reading.rotation_rad, _MAX_TURN_RAD),
        (source.scan_rotation, reading.scan_rotation_rad, _MAX_TURN_RAD),
    )
    for joint, angle, limit in limits:
        if angle is not None and abs(angle) > limit:
            return f"{joint} {angle:g} rad"
    return ""


def require_radians(reading: StageReading, source: StageConfig) -> None:
    """Raise :class:`MessageError` for an angle that no stage has in rad."""
    if doubt := doubt_unit(reading, source):
        raise MessageError(
            f"a stage with {doubt}",
            expected="radians; this looks like degrees",
            do="publish radians",
        )


def missing_joints(readings: Sequence[StageReading], source: StageConfig) -> list[str]:
    """Return the joints that should be there and are in no reading.

    These are the tilt in any case, and other angles to which the configuration gives a name of its own.
    """
    usual = StageConfig()
    joints = (
        (source.tilt, True, "tilt_rad"),
        (source.rotation, source.rotation != usual.rotation, "rotation_rad"),
        (
            source.scan_rotation,
            source.scan_rotation != usual.scan_rotation,
            "scan_rotation_rad",
        ),
    )
    return [
        joint
        for joint, wanted, name in joints
        if wanted and all(getattr(reading, name) is None for reading in readings)
    ]


def tilt_jump_rad(before: StageReading | None, after: StageReading | None, time_s: float) -> float:
    """Return the change of the tilt within ``time_s`` if no stage can make it, else zero."""
    if before is None or after is None or before.tilt_rad is None or after.tilt_rad is None:
        return 0.0
    change = abs(after.tilt_rad - before.tilt_rad)
    return change if change > _STEP_RAD and change > _RATE_RAD_S * abs(time_s) else 0.0
