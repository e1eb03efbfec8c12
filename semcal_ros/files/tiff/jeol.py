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

"""JEOL: a text file beside the image with lines such as ``$CM_MAG 50``.

``$CM_STAGE_POSITION`` of newer programs names its axes (``X=37.1, Y=44.9, R=355.0, Z=16.9, T=0.0``; mm and
degrees). ``$CM_STAGE_POS`` of older ones has six bare numbers, of which the first three are x, y and z; no
source known to us says which of the others is the tilt, so they are left out.
"""

from __future__ import annotations

import math
from pathlib import Path

from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.metadata import (
    check_pixel_size,
    first_date,
    plain_number,
    positive,
    quantity,
    refuse_decimal_commas,
)
from semcal_ros.files.images.sem_image import VendorSettings

# Of a text with two, the first one counts.
_NUMBERS = (
    *("CM_FIELD_OF_VIEW", "CM_MAG", "SM_MICRON_BAR", "SM_WD", "SM_SCAN_ROTATION"),
    *("CM_ACCEL_VOLT", "CM_ACCEL_VOLTAGE"),
)
# By which a field of view and a magnification may differ: a unit that is lost is a factor of a thousand.
_CONTRADICTION = 100.0

USUAL_DISPLAY_WIDTH_M = 0.128
"""Width of the photograph to which JEOL's magnification usually refers.

JEOL states magnifications for a photograph of 128 mm x 96 mm, which is 0.1 mm per pixel of the usual
1280 x 960 image. It is not the width of 5 x 4 inch film, 127 mm, which is 0.8 % less. A micron bar
in the file decides where it contradicts.
"""


def jeol_pairs(text: str) -> dict[str, str]:
    """Settings by name, without their dollar signs; empty if this is not a JEOL text file."""
    pairs: dict[str, str] = {}
    for line in text.splitlines():
        if line.startswith("$"):
            key, _, value = line.strip().partition(" ")
            pairs.setdefault(key.lstrip("$"), value.strip())
    return pairs if any(key.startswith(("CM_", "SM_")) for key in pairs) else {}


def _read_scan_size(path: Path, pairs: dict[str, str], size_px: tuple[int, int]) -> tuple[int, int]:
    """Return the columns and rows of the scan; a databar may follow it in the file."""
    for key in ("CM_FULL_SIZE", "CM_IMAGE_SIZE"):
        numbers = [plain_number(word) for word in pairs.get(key, "").split()]
        if len(numbers) == 2 and numbers[0] and numbers[1]:
            columns, rows = int(numbers[0]), int(numbers[1])
            if columns != size_px[0] or not 0 < rows <= size_px[1]:
                raise TiffError(
                    f"{path.name} is {size_px[0]} x {size_px[1]} pixels, "
                    f"${key} says {columns} x {rows}",
                    expected="the image as the microscope stored it",
                    do="use the original file, not a resized or cropped copy",
                )
            return columns, rows
    return size_px


def _read_micron_bar(pairs: dict[str, str]) -> float | None:
    bar_px = positive(plain_number(pairs.get("SM_MICRON_BAR", "")))
    bar_m = positive(quantity(pairs.get("SM_MICRON_MARKER", ""), "m"))
    return None if bar_px is None or bar_m is None else bar_m / bar_px


def _read_pixel_size(
    path: Path, pairs: dict[str, str], columns: int
) -> tuple[float, bool, tuple[str, ...]]:
    """Return the pixel size in m, whether it rests on an assumed display width, and notes."""
    words = pairs.get("CM_FIELD_OF_VIEW", "").split()
    field_m = positive(quantity(words[0], "m", default_unit="um")) if words else None
    shown = positive(plain_number(pairs.get("CM_MAG", "")))
    if field_m is not None:
        by_magnification_m = field_m if shown is None else USUAL_DISPLAY_WIDTH_M / shown
        if not 1.0 / _CONTRADICTION < field_m / by_magnification_m < _CONTRADICTION:
            raise TiffError(
                f"{path.name}: $CM_FIELD_OF_VIEW is {pairs['CM_FIELD_OF_VIEW'][:40]}, and $CM_MAG {shown:g} is a field "
                f"of {1e6 * by_magnification_m:g} um",
                expected="a field of view in um, or with its unit, that fits the magnification",
                do="export the image again with its text file",
            )
        return check_pixel_size(path, field_m / columns, "$CM_FIELD_OF_VIEW", words[0]), False, ()
    from_bar = _read_micron_bar(pairs)
    if shown is None:
        if from_bar is None:
            raise TiffError(
                f"{path.name}: $CM_MAG in its text file is {pairs.get('CM_MAG', 'missing')[:40]}",
                expected="$CM_FIELD_OF_VIEW, $CM_MAG or a micron bar",
                do="export the image again with its text file",
            )
        return check_pixel_size(path, from_bar, "$$SM_MICRON_BAR", from_bar), False, ()
    assumed = USUAL_DISPLAY_WIDTH_M / shown / columns
    bar_px = positive(plain_number(pairs.get("SM_MICRON_BAR", "")))
    if from_bar is not None and bar_px is not None:
        agrees = abs(from_bar / assumed - 1.0) <= 1.5 / bar_px
        if not agrees:
            note = f"pixel size from the micron bar of {bar_px:g} px, good to {100 / bar_px:.1g} %"
            return check_pixel_size(path, from_bar, "$$SM_MICRON_BAR", from_bar), False, (note,)
        note = f"display width {USUAL_DISPLAY_WIDTH_M} m assumed; the micron bar agrees with it"
        return check_pixel_size(path, assumed, "$CM_MAG", shown), False, (note,)
    note = f"display width {USUAL_DISPLAY_WIDTH_M} m assumed: the file has no length"
    return check_pixel_size(path, assumed, "$CM_MAG", shown), True, (note,)


def _stage_angles(pairs: dict[str, str]) -> tuple[float | None, float | None, tuple[str, ...]]:
    """Return tilt and rotation of the stage, and a note where the file does not name them."""
    named = {}
    for part in pairs.get("CM_STAGE_POSITION", "").split(","):
        axis, _, value = part.partition("=")
        named[axis.strip().upper()] = plain_number(value)
    tilt, turn = (
        None if angle is None else math.radians(angle) for angle in (named.get("T"), named.get("R"))
    )
    if tilt is None and "CM_STAGE_POS" in pairs:
        return (
            None,
            None,
            ("$CM_STAGE_POS does not name its axes: the tilt of the stage is left out",),
        )
    return tilt, turn, ()


def jeol_settings(path: Path, pairs: dict[str, str], size_px: tuple[int, int]) -> VendorSettings:
    """Read the settings from the text file.

    Raises
    ------
    TiffError
        There is neither a field of view, nor a magnification, nor a micron bar; the sizes contradict each other; or
        numbers have decimal commas.
    """
    refuse_decimal_commas(
        path, {f"${key}": pairs[key].partition(" ")[0] for key in _NUMBERS if key in pairs}
    )
    columns, rows = _read_scan_size(path, pairs, size_px)
    pixel_m, assumed, notes = _read_pixel_size(path, pairs, columns)
    distance_mm = plain_number(pairs.get("SM_WD", ""))
    rotation = plain_number(pairs.get("SM_SCAN_ROTATION", ""))
    tilt, turn, left_out = _stage_angles(pairs)
    voltage_kv = plain_number(pairs.get("CM_ACCEL_VOLT", pairs.get("CM_ACCEL_VOLTAGE", "")))
    stamp = f"{pairs.get('CM_DATE', '')} {pairs.get('CM_TIME', '')}"
    return VendorSettings(
        maker="jeol",
        beam="electron",
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_m,
        displayed_magnification=positive(plain_number(pairs.get("CM_MAG", ""))),
        databar_rows=size_px[1] - rows,
        working_distance_m=None if distance_mm is None else distance_mm * 1e-3,
        scan_rotation_rad=None if rotation is None else math.radians(rotation),
        stage_tilt_rad=tilt,
        stage_rotation_rad=turn,
        detector=pairs.get("CM_DETECTOR_NAME") or pairs.get("CM_DETECTOR", ""),
        model=pairs.get("CM_INSTRUMENT", ""),
        acceleration_voltage_v=None if voltage_kv is None else 1e3 * abs(voltage_kv),
        time=first_date([(stamp, "%Y/%m/%d %H:%M:%S"), (stamp, "%Y/%m/%d %I:%M:%S %p")]),
        display_width_assumed=assumed,
        notes=(*notes, *left_out),
    )
