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

``AP_IMAGE_PIXEL_SIZE`` is that of the stored image, ``AP_PIXEL_SIZE`` that of the screen, which has 1024 columns
(24.65 nm where an image of 2048 columns has 12.33 nm), and ``AP_WIDTH`` the width of the field (25.24 um). Older
programs write only the last two. The numbers at the head of the tag are those of the screen as well.

``DP_DWELL_TIME`` is not the time on a pixel: it is 50 or 100 ns at any speed. The help of SmartSEM gives 100 ns x
2^(speed - 1), and the line times of real files agree: 51.2 us x 1024 columns = 52.4 ms at speed 10, where
``AP_LINE_TIME`` is 52.7 ms.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semcal_ros.files.images.metadata import (
    angle_in_degrees,
    check_pixel_size,
    duration,
    first_date,
    plain_number,
    positive,
    quantity,
    rounding,
    tilt_correction_note,
)
from semcal_ros.files.images.sem_image import VendorSettings

# Private TIFF tag of Zeiss, CZ_SEM.
TAG = 34118
# The unnamed numbers at the head of the tag repeat some settings with more digits.
_PIXEL_SIZE, _MAGNIFICATION, _WORKING_DISTANCE = 3, 4, 9
_SCREEN_COLUMNS = 1024
# The stated values have three or four digits, so the two pixel sizes of a file agree to this.
_SIZE_TOLERANCE = 5e-3
_FASTEST_DWELL_S = 100e-9
_SPEEDS = range(1, 33)
# A frame time rounded more coarsely than this is remarked upon.
_COARSE_ROUNDING = 0.01
_BAR_NOTE = (
    "the file does not say how many rows the databar covers; give --databar-rows if there is one"
)


def zeiss_entries(text: str) -> dict[str, Any]:
    """Entries of the tag's text, as a copy by another program may keep it, in the form of the decoded tag."""
    entries: dict[str, Any] = {}
    for key, line in itertools.pairwise(text.splitlines()):
        named = re.fullmatch(r"\s*([^=:]*?)\s*[=:]\s*(.*?)\s*", line)
        if named is not None and re.fullmatch(r"[A-Z]{2}_[A-Z0-9_]+", key.strip()):
            value = named.group(2)
            entries[key.strip().lower()] = (
                named.group(1),
                {"On": True, "Off": False}.get(value, value),
            )
    return entries


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


def _field_width(tag: Mapping[str, Any]) -> tuple[float, str] | None:
    """Return the width of the field in m and the entry from which it follows."""
    width_text, screen_text = _text(tag, "ap_width"), _text(tag, "ap_pixel_size")
    width, screen = (positive(quantity(text, "m")) for text in (width_text, screen_text))
    if width is not None:
        return width, f"AP_WIDTH ({width_text})"
    if screen is not None:
        of_screen = f"AP_PIXEL_SIZE ({screen_text}) of the {_SCREEN_COLUMNS} columns of the screen"
        return screen * _SCREEN_COLUMNS, of_screen
    return None


def _pixel_size(path: Path, tag: Mapping[str, Any], columns: int, notes: list[str]) -> float:
    text, field, head = (
        _text(tag, "ap_image_pixel_size"),
        _field_width(tag),
        _head(tag, _PIXEL_SIZE),
    )
    stated = positive(quantity(text, "m"))
    if text is None and field is not None:
        stated = field[0] / columns
        notes.append(f"the file has no AP_IMAGE_PIXEL_SIZE: the pixel size follows from {field[1]}")
    if stated is not None and head is not None:
        stated = _refine(stated, head * _SCREEN_COLUMNS / columns, 1e-3 * stated)
    value = check_pixel_size(path, stated, "AP_IMAGE_PIXEL_SIZE in tag 34118 (CZ_SEM)", text)
    if field is not None and abs(value * columns / field[0] - 1.0) > _SIZE_TOLERANCE:
        notes.append(
            f"{columns} columns of AP_IMAGE_PIXEL_SIZE ({text}) are not the field of {field[1]}: the image may be "
            "a resized or cropped copy"
        )
    return value


def _dwell(tag: Mapping[str, Any], columns: int) -> float | None:
    """Time on a pixel from the scan speed, if the line has room for it."""
    speed = plain_number(_text(tag, "dp_scanrate"))
    if speed is None or speed not in _SPEEDS:
        return None
    dwell_s = _FASTEST_DWELL_S * 2.0 ** (speed - 1.0)
    line_s = positive(duration(_text(tag, "ap_line_time")))
    rounded = rounding(_text(tag, "ap_line_time")) or 0.0
    return dwell_s if line_s is None or dwell_s * columns <= line_s * (1.0 + rounded) else None


def _frame_time(tag: Mapping[str, Any], notes: list[str]) -> float | None:
    text = _text(tag, "ap_frame_time")
    value, rounded = positive(duration(text)), rounding(text)
    if value is not None and rounded is not None and rounded > _COARSE_ROUNDING:
        notes.append(f"the frame time is given as {text}, which is good to {rounded * value:.2g} s")
    return value


def _beam(tag: Mapping[str, Any]) -> str:
    imaging = _text(tag, "dp_fib_imaging")
    return "electron" if imaging in (None, "SEM") else "ion" if imaging == "FIB" else ""


def _voltage(tag: Mapping[str, Any]) -> float | None:
    for key in ("ap_actualkv", "ap_manualkv"):
        value = quantity(_text(tag, key), "V")
        if value is not None:
            return abs(value)
    return None


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


def zeiss_settings(path: Path, tag: Mapping[str, Any], size_px: tuple[int, int]) -> VendorSettings:
    """Read the settings from the decoded tag of an image of (width, height) pixels.

    Raises
    ------
    TiffError
        The pixel size of the image is missing or cannot be used.
    """
    notes = [_BAR_NOTE]
    pixel_m = _pixel_size(path, tag, size_px[0], notes)
    distance = quantity(_text(tag, "ap_wd"), "m")
    if tag.get("dp_tilt_correction", (None, None))[1] is True:
        notes.append(tilt_correction_note(angle_in_degrees(_text(tag, "ap_tilt_angle"))))
    date, clock = _text(tag, "ap_date") or "", _text(tag, "ap_time") or ""
    return VendorSettings(
        maker="zeiss",
        beam=_beam(tag),
        model=str(_text(tag, "dp_sem") or _text(tag, "dp_column_type") or ""),
        serial_number=str(_text(tag, "sv_serial_number") or ""),
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_m,
        displayed_magnification=_magnification(tag),
        working_distance_m=_refine(distance, _head(tag, _WORKING_DISTANCE), 6e-5),
        scan_rotation_rad=_rotation(tag),
        stage_tilt_rad=_stage_angle(tag, "ap_stage_at_t", notes),
        stage_rotation_rad=_stage_angle(tag, "ap_stage_at_r", notes),
        acceleration_voltage_v=_voltage(tag),
        dwell_s=_dwell(tag, size_px[0]),
        frame_time_s=_frame_time(tag, notes),
        detector=str(_text(tag, "dp_detector_channel") or ""),
        time=first_date(
            [(f"{date} {clock}", "%d %b %Y %H:%M:%S"), (f"{date} {clock}", "%d %B %Y %H:%M:%S")]
        ),
        notes=tuple(notes),
    )
