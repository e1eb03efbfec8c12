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

"""Conditions that a recording tells: of the topic ``conditions``, and of an import's settings of each image."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semcal_ros.bridge.conditions import CONDITIONS_TYPE, Conditions, fill_conditions
from semcal_ros.config.config import load_config
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.recordings import RecordedFiles, open_recording
from semcal_ros.workflows.provenance import describe_provenance

CONFIG = load_config("generic")
FIRST_NS = 1_700_000_000 * 10**9
SECOND_NS = 10**9


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
    with open_recording(RecordedFiles(path), CONFIG) as recording:
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
    with open_recording(RecordedFiles(path), CONFIG) as recording:
        views = {str(k): frame for k, frame in enumerate(recording.frames())}
    origin = describe_provenance(path, CONFIG, views)
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
