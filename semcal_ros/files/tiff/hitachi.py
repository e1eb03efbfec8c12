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

"""Hitachi: a text file beside the image, ``[SemImageFile]`` and lines such as ``PixelSize=9.921875``.

``PixelSize`` is in nm. Where it is missing or 0, as of the S-4700, it follows from ``Magnification``, which
Hitachi states for a photograph 127 mm wide: files that have both say so (9.921875 nm x 1280 x 10000 = 127.0 mm).
Quantities have their units (``15000 Volt``, ``8100 um``). No source known to us gives the units of
``StagePositionT`` and ``StagePositionR``, so they are left out unless they are 0 or have a unit.
"""

from __future__ import annotations

import re
from pathlib import Path

from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.metadata import (
    angle_in_degrees,
    check_pixel_size,
    first_date,
    plain_number,
    positive,
    quantity,
)
from semcal_ros.files.images.sem_image import VendorSettings

USUAL_DISPLAY_WIDTH_M = 0.127
"""Width of the photograph (5 x 4 inches) to which Hitachi's magnification refers."""

_HEAD = "[SemImageFile]"
_BAR_NOTE = (
    "the file does not say whether a databar is in the image; give --databar-rows if there is one"
)


def hitachi_pairs(text: str) -> dict[str, str]:
    """Settings by name; empty if this is not a Hitachi text file."""
    head, _, rest = text.partition(_HEAD)
    if not _ or head.strip():
        return {}
    pairs: dict[str, str] = {}
    for line in rest.splitlines():
        key, equals, value = line.partition("=")
        if equals:
            pairs.setdefault(key.strip(), value.strip())
    return pairs


def _read_scan_size(path: Path, pairs: dict[str, str], size_px: tuple[int, int]) -> tuple[int, int]:
    """Return the columns and rows of ``DataSize``; a databar may follow them in the file."""
    match = re.fullmatch(r"(\d{1,6})\s*[xX*]\s*(\d{1,6})", pairs.get("DataSize", ""))
    if match is None:
        return size_px
    columns, rows = int(match.group(1)), int(match.group(2))
    if columns != size_px[0] or not 0 < rows <= size_px[1]:
        raise TiffError(
            f"{path.name} is {size_px[0]} x {size_px[1]} pixels, DataSize in its text file says {columns} x {rows}",
            expected="the image as the microscope stored it",
            do="use the original file, not a resized or cropped copy",
        )
    return columns, rows


def _read_pixel_size(
    path: Path, pairs: dict[str, str], columns: int
) -> tuple[float, bool, tuple[str, ...]]:
    """Return the pixel size in m, whether it rests on the usual display width, and notes."""
    stated = pairs.get("PixelSize")
    nanometres = quantity(stated, "m", default_unit="nm")
    if stated is not None and nanometres != 0.0:
        return check_pixel_size(path, nanometres, "PixelSize in its text file", stated), False, ()
    shown = positive(plain_number(pairs.get("Magnification", "")))
    if shown is None:
        raise TiffError(
            f"{path.name}: its text file has neither PixelSize nor Magnification",
            expected="the text file of a Hitachi SEM",
            do="export the image again with its text file",
        )
    note = (
        f"display width {USUAL_DISPLAY_WIDTH_M:g} m assumed: the text file has no pixel size; a distance that you "
        "know in the image checks it"
    )
    size_m = USUAL_DISPLAY_WIDTH_M / shown / columns
    return check_pixel_size(path, size_m, "Magnification in its text file", shown), True, (note,)


def _read_stage_angle(pairs: dict[str, str], key: str, notes: list[str]) -> float | None:
    text = pairs.get(key, "")
    if plain_number(text) == 0.0:
        return 0.0
    angle = angle_in_degrees(text)
    if text and angle is None:
        notes.append(f"{key} is {text[:40]!r} without a unit: it is left out")
    return angle


def hitachi_settings(path: Path, pairs: dict[str, str], size_px: tuple[int, int]) -> VendorSettings:
    """Read the settings from the text file of an image of (width, height) pixels.

    Raises
    ------
    TiffError
        There is neither a pixel size nor a magnification, or the sizes contradict each other.
    """
    columns, rows = _read_scan_size(path, pairs, size_px)
    pixel_m, assumed, about_size = _read_pixel_size(path, pairs, columns)
    notes = list(about_size) if rows < size_px[1] else [*about_size, _BAR_NOTE]
    voltage = pairs.get("AcceleratingVoltage", "")
    voltage_v = quantity(re.sub(r"[Vv]olts?", "V", voltage), "V")
    stamp = f"{pairs.get('Date', '')} {pairs.get('Time', '')}"
    return VendorSettings(
        maker="hitachi",
        beam="electron",
        model=pairs.get("InstructName") or pairs.get("Instrument name", ""),
        serial_number=pairs.get("SerialNumber", ""),
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_m,
        displayed_magnification=positive(plain_number(pairs.get("Magnification", ""))),
        databar_rows=size_px[1] - rows,
        working_distance_m=quantity(pairs.get("WorkingDistance", ""), "m"),
        acceleration_voltage_v=None if voltage_v is None else abs(voltage_v),
        stage_tilt_rad=_read_stage_angle(pairs, "StagePositionT", notes),
        stage_rotation_rad=_read_stage_angle(pairs, "StagePositionR", notes),
        detector=pairs.get("SignalName", ""),
        time=first_date([(stamp, "%Y/%m/%d %H:%M:%S"), (stamp, "%m/%d/%Y %H:%M:%S")]),
        display_width_assumed=assumed,
        notes=tuple(notes),
    )
