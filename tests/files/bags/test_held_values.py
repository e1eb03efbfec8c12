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

"""Where the stage was, and under which conditions, at each frame of a recording; what is wrong is a note, no error."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semcal_ros.bridge.conditions import CONDITIONS_TYPE, Conditions, fill_conditions
from semcal_ros.config.config import MicroscopeConfig, StageConfig, load_config
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.recordings import RecordedFiles, RecordedFrame, open_recording
from semcal_ros.workflows.provenance import describe_provenance

S = 1_000_000_000
T0 = 1_700_000_000 * S
CONFIG = MicroscopeConfig(name="test", display_width_m=0.12)

Timed = tuple[str, int, Any]

GENERIC = load_config("generic")
FIRST_NS = 1_700_000_000 * 10**9
SECOND_NS = 10**9


def joints(positions: Mapping[str, float], stamp_ns: int = 0) -> Any:
    message = blank_message("sensor_msgs/msg/JointState")
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, S)
    message.name, message.position = list(positions), list(positions.values())
    return message


def stage_at(second: float, **positions: float) -> Timed:
    """A stamped message of the stage, received half a second late."""
    stamp_ns = T0 + round(second * S)
    return "/sem/stage", stamp_ns + S // 2, joints(positions, stamp_ns)


def image_at(second: float) -> Timed:
    message = blank_message("sensor_msgs/msg/Image")
    stamp_ns = T0 + round(second * S)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, S)
    message.height, message.width, message.encoding, message.step = 4, 6, "mono8", 6
    message.data = np.zeros(24, dtype=np.uint8)
    return "/sem/image_raw", stamp_ns, message


def read(
    path: Path, messages: Sequence[Timed], config: MicroscopeConfig = CONFIG
) -> tuple[list[RecordedFrame], str]:
    """Frames and notes of a recording with these messages."""
    magnification = blank_message("std_msgs/msg/Float64")
    magnification.data = 1000.0
    with BagWriter(path) as writer:
        writer.write("/sem/magnification", T0 - 10 * S, magnification)
        for topic, time_ns, message in sorted(messages, key=lambda item: item[1]):
            writer.write(topic, time_ns, message)
    with open_recording(path, config) as recording:
        return list(recording.frames()), " | ".join(recording.notes)


def tilts(frames: Sequence[RecordedFrame]) -> list[float | None]:
    return [None if f.stage is None else f.stage.tilt_rad for f in frames]


def test_a_frame_has_what_the_stage_said_last_before_its_stamp(tmp_path: Path) -> None:
    frames, notes = read(
        tmp_path / "bag",
        [
            image_at(0.0),
            # A position that is no number spoils no angle.
            stage_at(1.0, tilt=0.1, rotation=0.2, scan_rotation=0.3, x=1e-3, y=float("nan")),
            image_at(1.0),
            image_at(9.0),
            # By its stamp before the image; received after it.
            stage_at(9.9, tilt=0.4, rotation=-1.0, scan_rotation=0.0),
            image_at(10.0),
        ],
    )
    assert [f.stage for f in frames] == [
        None,
        StageReading(0.1, 0.2, 0.3, 1e-3),
        StageReading(0.1, 0.2, 0.3, 1e-3),
        StageReading(0.4, -1.0, 0.0),
    ]
    assert notes == ""


def test_the_recorders_time_counts_where_stamps_are_zero(tmp_path: Path) -> None:
    frames, notes = read(
        tmp_path / "bag",
        [
            ("/sem/stage", T0 + 1 * S, joints({"tilt": 0.1})),
            image_at(2.0),
            ("/sem/stage", T0 + 30 * S, joints({"tilt": 0.2})),
            image_at(31.0),
        ],
    )
    assert tilts(frames) == [0.1, 0.2]
    assert notes == ""


def test_the_configuration_names_topic_and_joints(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, stage=StageConfig(topic="/axes", tilt="T", rotation="R"))
    messages = [
        stage_at(0.0, tilt=0.9),
        ("/axes", T0, joints({"R": 3.0, "T": 0.5, "Z": 1.0}, T0)),
        image_at(1.0),
    ]
    frames, notes = read(tmp_path / "bag", messages, config)
    assert frames[0].stage == StageReading(0.5, 3.0)
    assert notes == ""


@pytest.mark.parametrize(
    "config",
    [
        dataclasses.replace(CONFIG, stage=None),
        dataclasses.replace(CONFIG, stage=StageConfig(topic="no_stage")),
    ],
)
def test_a_stage_can_be_ignored(tmp_path: Path, config: MicroscopeConfig) -> None:
    frames, notes = read(tmp_path / "bag", [stage_at(0.0, tilt=0.5), image_at(1.0)], config)
    assert (tilts(frames), notes) == ([None], "")


def test_the_stage_beside_the_images_is_meant(tmp_path: Path) -> None:
    other = ("/other/stage", T0, joints({"tilt": 0.7}, T0))
    frames, _ = read(tmp_path / "one", [other, stage_at(0.0, tilt=0.5), image_at(1.0)])
    assert tilts(frames) == [0.5]
    third = ("/third/stage", T0, joints({"tilt": 0.6}, T0))
    frames, notes = read(tmp_path / "two", [other, third, image_at(1.0)])
    assert tilts(frames) == [None]
    assert "several topics could be the stage (/other/stage, /third/stage)" in notes


# -- what wrong stages get -------------------------------------------------------------------------


def test_another_type_is_named(tmp_path: Path) -> None:
    twist = blank_message("geometry_msgs/msg/Twist")
    frames, notes = read(tmp_path / "bag", [("/sem/stage", T0, twist), image_at(1.0)])
    assert tilts(frames) == [None]
    assert notes == (
        "topic /sem/stage has type geometry_msgs/msg/Twist; expected sensor_msgs/msg/JointState for the stage: "
        "the stage is not used"
    )


@pytest.mark.parametrize(
    "angles",
    [{"tilt": 20.0}, {"tilt": -1.7}, {"rotation": 90.0}, {"scan_rotation": 45.0}],
    ids=lambda angles: next(iter(angles)),
)
def test_degrees_are_recognised_and_the_stage_is_left_out(
    tmp_path: Path, angles: dict[str, float]
) -> None:
    messages = [stage_at(0.0, tilt=0.0), image_at(1.0), stage_at(20.0, **angles), image_at(21.0)]
    frames, notes = read(tmp_path / "bag", messages)
    assert tilts(frames) == [None, None]
    ((joint, value),) = angles.items()
    assert notes == (
        f"/sem/stage: {joint} {value:g} rad looks like degrees; expected radians: the stage is not used"
    )


def test_right_angles_and_full_turns_are_radians(tmp_path: Path) -> None:
    messages = [
        stage_at(0.0, tilt=math.pi / 2, rotation=2 * math.pi, scan_rotation=-math.pi),
        image_at(1.0),
    ]
    frames, notes = read(tmp_path / "bag", messages)
    assert tilts(frames) == [math.pi / 2]
    assert notes == ""


def test_a_missing_tilt_is_named_and_the_rest_is_kept(tmp_path: Path) -> None:
    frames, notes = read(
        tmp_path / "bag", [stage_at(0.0, scan_rotation=0.5, alpha=0.1), image_at(1.0)]
    )
    assert frames[0].stage == StageReading(None, None, 0.5)
    assert notes == "no message on /sem/stage has the joint tilt"


def test_joints_that_the_configuration_renames_must_be_there(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, stage=StageConfig(rotation="R", scan_rotation="S"))
    frames, notes = read(tmp_path / "bag", [stage_at(0.0, tilt=0.1), image_at(1.0)], config)
    assert frames[0].stage == StageReading(0.1)
    assert "has the joint R" in notes
    assert "has the joint S" in notes


def test_joints_that_come_and_go_are_named(tmp_path: Path) -> None:
    messages = [stage_at(0.0, tilt=0.1), image_at(1.0), stage_at(20.0, z=1e-3), image_at(21.0)]
    frames, notes = read(tmp_path / "bag", messages)
    assert tilts(frames) == [0.1, None]
    assert notes == "1 of 2 messages on /sem/stage without the joint tilt"


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_value_that_is_not_finite_ends_the_reading_before(tmp_path: Path, value: float) -> None:
    frames, notes = read(
        tmp_path / "bag",
        [
            stage_at(0.0, tilt=0.1),
            image_at(1.0),
            stage_at(20.0, tilt=value),
            image_at(21.0),
            stage_at(40.0, tilt=0.2),
            image_at(41.0),
        ],
    )
    assert tilts(frames) == [0.1, None, 0.2]
    assert notes.startswith("1 message on /sem/stage ignored: a stage with tilt ")


@pytest.mark.parametrize(
    ("names", "positions"),
    [(["tilt", "rotation"], [0.1]), (["tilt"], []), (["tilt", "tilt"], [0.1, 0.2])],
)
def test_names_without_positions_leave_nothing(
    tmp_path: Path, names: list[str], positions: list[float]
) -> None:
    message = joints({}, T0)
    message.name, message.position = names, positions
    frames, notes = read(tmp_path / "bag", [("/sem/stage", T0, message), image_at(1.0)])
    assert tilts(frames) == [None]
    assert "no message of 1 is usable, the first: " in notes
    assert notes.endswith("the stage is not used")


def test_jumps_are_named(tmp_path: Path) -> None:
    frames, notes = read(
        tmp_path / "bag",
        [
            stage_at(0.0, tilt=0.1),
            image_at(1.0),
            # A stage may well have been moved so far since.
            stage_at(20.0, tilt=0.7),
            stage_at(20.1, tilt=0.1),
            stage_at(20.2, tilt=0.7),
            image_at(21.0),
        ],
    )
    assert tilts(frames) == [0.1, 0.7]
    assert "the tilt on /sem/stage jumps 2 times, first by 34.4 degrees within 0.1 s" in notes


def test_a_stage_that_moves_during_a_frame_tells_nothing_about_it(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, scan=ScanTiming(2.0))
    frames, notes = read(
        tmp_path / "bag",
        [
            stage_at(0.0, tilt=0.1),
            image_at(10.0),
            stage_at(11.0, tilt=0.2),
            image_at(20.0),
            # Less than the readings are trusted.
            stage_at(21.0, tilt=0.2001),
        ],
        config,
    )
    assert tilts(frames) == [None, 0.2]
    assert notes == "the stage moved during 1 image: its readings are not used there"


def pairs(**values: str) -> Any:
    """A message with these texts, whatever they are."""
    message = blank_message(CONDITIONS_TYPE)
    message.values = []
    for key, value in values.items():
        pair = blank_message("diagnostic_msgs/msg/KeyValue")
        pair.key, pair.value = key, value
        message.values.append(pair)
    return message


def write(path: Path, told: dict[int, tuple[str, Any]], frames: int = 3) -> Path:
    """A recording of one frame per second; ``told`` goes out half a second before the frame of its number."""
    with BagWriter(path) as writer:
        for index in range(frames):
            stamp_ns = FIRST_NS + index * SECOND_NS
            if index in told:
                topic, message = told[index]
                writer.write(topic, stamp_ns - SECOND_NS // 2, message)
            number = blank_message("std_msgs/msg/Float64")
            number.data = 1000.0
            writer.write("/sem/magnification", stamp_ns - 1000, number)
            image = blank_message("sensor_msgs/msg/Image")
            image.header.stamp.sec = stamp_ns // SECOND_NS
            image.height, image.width, image.step, image.encoding = 4, 4, 4, "mono8"
            image.data = np.zeros(16, np.uint8)
            writer.write("/sem/image_raw", stamp_ns, image)
    return path


def conditions_of(path: Path) -> list[Conditions | None]:
    with open_recording(RecordedFiles(path), GENERIC) as recording:
        return [frame.conditions for frame in recording.frames()]


def test_a_message_holds_until_the_next_one_and_reaches_the_provenance(tmp_path: Path) -> None:
    known = blank_message(CONDITIONS_TYPE)
    fill_conditions(known, {"accelerating_voltage_v": 5e3, "beam_current_a": 1e-10, "serial": "7"})
    path = write(
        tmp_path / "bag",
        {
            0: ("/sem/conditions", known),
            2: ("/sem/conditions", pairs(accelerating_voltage_v="10000")),
        },
    )
    first = Conditions(acceleration_voltage_v=5e3, beam_current_a=1e-10, serial_number="7")
    found = conditions_of(path)
    assert found == [first, first, Conditions(acceleration_voltage_v=1e4)]
    with open_recording(RecordedFiles(path), GENERIC) as recording:
        views = {str(k): frame for k, frame in enumerate(recording.frames())}
    origin = describe_provenance(path, GENERIC, views)
    assert origin.conditions == {
        "acceleration_voltage_v": (5e3, 1e4),
        "beam_current_a": (1e-10, 1e-10),
        "serial_number": ("7",),
    }


@pytest.mark.parametrize(
    "message",
    [
        pairs(),
        pairs(accelerating_voltage_v="5 kV", working_distance_m="nan", dwell_s=""),
        pairs(voltage="5000"),
    ],
)
def test_what_is_no_number_is_not_known(message: Any, tmp_path: Path) -> None:
    assert conditions_of(write(tmp_path / "bag", {0: ("/sem/conditions", message)})) == [None] * 3


def test_of_several_microscopes_the_one_of_the_images_counts(tmp_path: Path) -> None:
    told = {
        0: ("/sem/conditions", pairs(serial="own")),
        1: ("/other/conditions", pairs(serial="other")),
    }
    serials = [c.serial_number for c in conditions_of(write(tmp_path / "bag", told)) if c]
    assert serials == ["own"] * 3


@pytest.mark.parametrize(
    ("text", "serial"),
    [
        (json.dumps({"stamp_ns": FIRST_NS, "serial_number": "7", "dwell_s": "fast"}), "7"),
        (json.dumps({"stamp_ns": FIRST_NS + 1, "serial_number": "7"}), ""),
        ("[" * 5000, ""),
        ("{", ""),
        ("null", ""),
    ],
)
def test_an_imports_settings_count_for_their_own_image(
    text: str, serial: str, tmp_path: Path
) -> None:
    message = blank_message("std_msgs/msg/String")
    message.data = text
    found = conditions_of(write(tmp_path / "bag", {0: ("/sem/metadata", message)}))
    assert found == [Conditions(serial_number=serial) if serial else None, None, None]
