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

"""What an image file says about its picture, in the words of the topics."""

from __future__ import annotations

from semcal_ros.bridge.stage import doubt_unit
from semcal_ros.config.config import StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.files.tiff.sem_image import VendorSettings

# What two numbers of one angle may differ by, and what counts as not rotated: rounding of a file's text.
_TURNED_RAD = 1e-3


def file_conditions(settings: VendorSettings | None) -> dict[str, float | str]:
    """Return how an image was taken, by the keys of the topic ``conditions``; what is not known is missing."""
    return {} if settings is None else settings.topic_values()


def file_stage(
    settings: VendorSettings | None, first_rotation_rad: float | None
) -> dict[str, float]:
    """Return the joints of the stage, as far as it is known what a file means by them.

    Makers do not say in which sense they count a rotation: one that is the same in all files only adds to the unknown
    direction of the specimen, and one that has changed is left out. With a scan rotation the direction of the tilt axis
    in the image is not known, so that nothing is left.

    Parameters
    ----------
    settings
        Of the file.
    first_rotation_rad
        The rotation of the first file, or None.
    """
    if settings is None or settings.stage_tilt_rad is None:
        return {}
    if abs(settings.scan_rotation_rad or 0.0) > _TURNED_RAD:
        return {}
    if doubt_unit(
        StageReading(settings.stage_tilt_rad, settings.stage_rotation_rad), StageConfig()
    ):
        return {}
    joints = {"tilt": settings.stage_tilt_rad}
    turn, first = settings.stage_rotation_rad, first_rotation_rad
    if turn is not None and first is not None and abs(turn - first) <= _TURNED_RAD:
        joints["rotation"] = turn
    return joints
