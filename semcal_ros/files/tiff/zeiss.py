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

"""Zeiss SmartSEM: tag 34118 (CZ_SEM).

The names are those of the parameters of SmartSEM's programming interface (CZEMApi): ``AP_STAGE_AT_T``
and ``AP_STAGE_AT_R`` are where the stage is, ``AP_SCANROTATION`` acts only while ``DP_SCAN_ROT`` is on.
Their units stand in the tag, which has degrees for all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semcal_ros.files.tiff.sem_image import VendorSettings
from semcal_ros.files.tiff.values import (
    angle_in_degrees,
    check_pixel_size,
    first_date,
    plain_number,
    positive,
    quantity,
)

__all__ = ["TAG", "zeiss_settings"]

# Private TIFF tag of Zeiss, CZ_SEM.
TAG = 34118
# The unnamed numbers at the head of the tag repeat some settings with more digits.
_PIXEL_SIZE, _MAGNIFICATION, _WORKING_DISTANCE = 3, 4, 9
_BAR_NOTE = (
    "the file does not say how many rows the databar covers; give databar_rows if there is one"
)


def _text(tag: Mapping[str, Any], key: str) -> str | None:
    """Return value and unit of a named entry, stored as (name, value) or (name, value, unit)."""
    entry = tag.get(key)
    if not isinstance(entry, tuple) or len(entry) < 2:
        return None
    return " ".join(str(part) for part in entry[1:])


def _head(tag: Mapping[str, Any], index: int) -> float | None:
    numbers = tag.get("", ())
    return plain_number(numbers[index]) if len(numbers) > index else None


def _refine(rounded: float | None, exact: float | None, tolerance: float) -> float | None:
    """Return the value with more digits if it rounds to the named one."""
    if rounded is None or exact is None:
        return rounded
    return exact if abs(exact - rounded) <= tolerance else rounded


def _magnification(tag: Mapping[str, Any]) -> float | None:
    text = (_text(tag, "ap_mag") or "").upper().removesuffix("X").strip()
    shown = plain_number(text.removesuffix("K").strip())
    if shown is None:
        return None
    value = shown * (1000.0 if text.endswith("K") else 1.0)
    return positive(_refine(value, _head(tag, _MAGNIFICATION), 0.006 * value))


def _pixel_size(path: Path, tag: Mapping[str, Any]) -> float:
    """AP_IMAGE_PIXEL_SIZE is that of the stored image, AP_PIXEL_SIZE that of the screen."""
    text = _text(tag, "ap_image_pixel_size")
    value = positive(quantity(text, "m"))
    if value is not None:
        value = _refine(value, _head(tag, _PIXEL_SIZE), 1e-3 * value)
    return check_pixel_size(path, value, "AP_IMAGE_PIXEL_SIZE in tag 34118 (CZ_SEM)", text)


def _rotation(tag: Mapping[str, Any]) -> float | None:
    if tag.get("dp_scan_rot", (None, None))[1] is False:
        return 0.0
    number = plain_number(str(_text(tag, "ap_scanrotation")).rstrip("\u00b0\u00c2 "))
    return None if number is None else math.radians(number)


def _stage_angle(tag: Mapping[str, Any], key: str, notes: list[str]) -> float | None:
    text = _text(tag, key)
    angle = angle_in_degrees(text)
    if text is not None and angle is None:
        notes.append(f"{key.upper()} is {text[:40]!r}, not an angle in degrees: it is left out")
    return angle


def zeiss_settings(path: Path, tag: Mapping[str, Any]) -> VendorSettings:
    """Read the settings from the decoded tag.

    Raises
    ------
    TiffError
        The pixel size of the image is missing or cannot be used.
    """
    pixel_m = _pixel_size(path, tag)
    distance = quantity(_text(tag, "ap_wd"), "m")
    notes = [_BAR_NOTE]
    date, clock = _text(tag, "ap_date") or "", _text(tag, "ap_time") or ""
    return VendorSettings(
        vendor="zeiss",
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_m,
        displayed_magnification=_magnification(tag),
        working_distance_m=_refine(distance, _head(tag, _WORKING_DISTANCE), 6e-5),
        scan_rotation_rad=_rotation(tag),
        stage_tilt_rad=_stage_angle(tag, "ap_stage_at_t", notes),
        stage_rotation_rad=_stage_angle(tag, "ap_stage_at_r", notes),
        dwell_s=positive(quantity(_text(tag, "dp_dwell_time"), "s")),
        frame_time_s=positive(quantity(_text(tag, "ap_frame_time"), "s")),
        detector=str(_text(tag, "dp_detector_channel") or ""),
        instrument=str(_text(tag, "sv_serial_number") or ""),
        time=first_date(
            [(f"{date} {clock}", "%d %b %Y %H:%M:%S"), (f"{date} {clock}", "%d %B %Y %H:%M:%S")]
        ),
        notes=tuple(notes),
    )
