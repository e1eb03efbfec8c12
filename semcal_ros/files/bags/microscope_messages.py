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

"""What a microscope says beside its images, as messages of a recording."""

from __future__ import annotations

from typing import Any

from semcal_ros.bridge.conditions import CONDITIONS_TYPE, fill_conditions
from semcal_ros.bridge.headers import fill_header
from semcal_ros.bridge.magnification import published_number
from semcal_ros.config.config import IMAGE_TYPE, STAGE_TYPE, MicroscopeConfig, StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import BagError
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.tiff.sem_image import Conditions

__all__ = [
    "check_recordable",
    "conditions_message",
    "magnification_message",
    "microscope_topic",
    "stage_message",
]

_NUMBER_TYPES = ("std_msgs/msg/Float64", "std_msgs/msg/Float32")


def microscope_topic(name: str) -> str:
    """Return the full name of a topic in a recording."""
    return name if name.startswith("/") else f"/sem/{name}"


def check_recordable(config: MicroscopeConfig) -> None:
    """Check that a recording can be made as a configuration describes it.

    Raises
    ------
    BagError
        Its images or magnifications are in messages of another type.
    """
    if config.image.type != IMAGE_TYPE:
        raise BagError(
            f"configuration {config.name!r} has its images in {config.image.type}",
            expected=f"{IMAGE_TYPE} for a recording",
            do="use --config generic",
        )
    source = config.magnification
    if source.type not in _NUMBER_TYPES or source.field != "data":
        raise BagError(
            f"configuration {config.name!r} has its {source.quantity} in {source.type}, "
            f"field {source.field}",
            expected="std_msgs/msg/Float64, field data, for a recording",
            do="use --config generic",
        )


def magnification_message(config: MicroscopeConfig, magnification: float, width_px: int) -> Any:
    """Return a magnification, or the quantity that the configuration has in its place."""
    message = blank_message(config.magnification.type)
    width_m = config.display_width_m / magnification
    message.data = published_number(config, width_m, width_px)
    return message


def stage_message(source: StageConfig, reading: StageReading | None, stamp_ns: int) -> Any:
    """Return the joints of the stage; none where they are not known, which ends the reading before."""
    stated = reading or StageReading()
    joints = {
        source.tilt: stated.tilt_rad,
        source.rotation: stated.rotation_rad,
        source.scan_rotation: stated.scan_rotation_rad,
        source.x: stated.x_m,
        source.y: stated.y_m,
    }
    known = {joint: value for joint, value in joints.items() if value is not None}
    message = blank_message(STAGE_TYPE)
    fill_header(message.header, stamp_ns, "")
    message.name, message.position = list(known), list(known.values())
    return message


def conditions_message(conditions: Conditions, name: str) -> Any:
    """Return how an image was taken."""
    message = blank_message(CONDITIONS_TYPE)
    fill_conditions(message, conditions.topic_values(), name)
    return message
