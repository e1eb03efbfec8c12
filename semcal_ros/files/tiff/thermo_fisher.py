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

"""Thermo Fisher (FEI): tags 34680 (FEI_SFEG) and 34682 (FEI_HELIOS), text in sections.

The tags are in SI units throughout: ``StageT`` and ``StageR`` of ``[Stage]`` and ``ScanRotation`` of the
beam are in rad.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semcal_ros.core.errors import TiffError
from semcal_ros.files.tiff.sem_image import VendorSettings
from semcal_ros.files.tiff.values import check_pixel_size, first_date, plain_number, positive

__all__ = ["TAGS", "thermo_fisher_settings"]

# Private TIFF tags of FEI, now Thermo Fisher: FEI_HELIOS and FEI_SFEG.
TAGS = (34682, 34680)
# Beyond it a note says that pixels are not square; both sizes are used unchanged in any case.
_SQUARE_TOLERANCE = 1e-3


def _section(tag: Mapping[str, Any], name: object) -> Mapping[str, Any]:
    section = tag.get(str(name), {})
    return section if isinstance(section, Mapping) else {}


def _active(tag: Mapping[str, Any], kind: str, fallback: str) -> Mapping[str, Any]:
    """Section of the beam or scan that made the image, which ``[Beam]`` names."""
    return _section(tag, _section(tag, "Beam").get(kind, fallback)) or _section(tag, fallback)


def _databar_rows(path: Path, image: Mapping[str, Any], size_px: tuple[int, int]) -> int:
    """Rows below the scanned ones; the tag's DatabarHeight is 0 even where there is a bar."""
    width, height = size_px
    columns, rows = plain_number(image.get("ResolutionX")), plain_number(image.get("ResolutionY"))
    if columns is None or rows is None:
        return 0
    if int(columns) != width or not 0 < rows <= height:
        raise TiffError(
            f"{path.name} is {width} x {height} pixels, its tag says {columns:g} x {rows:g}",
            expected="the image as the microscope stored it",
            do="use the original file, not a resized or cropped copy",
        )
    return height - int(rows)


def _magnification(tag: Mapping[str, Any], field_width_m: float) -> tuple[float | None, list[str]]:
    canvas = positive(plain_number(_section(tag, "Image").get("MagCanvasRealWidth")))
    screen = positive(plain_number(_section(tag, "System").get("DisplayWidth")))
    notes = []
    if canvas is not None and screen is not None and abs(canvas / screen - 1.0) > 1e-3:
        notes.append(
            f"the tag allows two magnifications, {canvas / field_width_m:.4g} (canvas of "
            f"{canvas:g} m) and {screen / field_width_m:.4g} (screen of {screen:g} m), "
            "and the databar may show a third"
        )
    width = canvas or screen
    return (None if width is None else positive(width / field_width_m)), notes


def thermo_fisher_settings(
    path: Path, tag: Mapping[str, Any], size_px: tuple[int, int]
) -> VendorSettings:
    """Read the settings from the decoded tag.

    Raises
    ------
    TiffError
        The pixel size is missing or unusable, or the size of the file contradicts the tag.
    """
    stage = _section(tag, "Stage")
    beam, scan = _active(tag, "Beam", "EBeam"), _active(tag, "Scan", "EScan")
    common = _section(tag, "Scan")
    seen = scan.get("PixelWidth", common.get("PixelWidth"))
    pixel_m = check_pixel_size(
        path, plain_number(seen), "PixelWidth in tag 34682 (FEI_HELIOS) or 34680 (FEI_SFEG)", seen
    )
    pixel_y_m = plain_number(scan.get("PixelHeight", common.get("PixelHeight"))) or pixel_m
    check_pixel_size(path, pixel_y_m, "PixelHeight", pixel_y_m)
    magnification, notes = _magnification(tag, pixel_m * size_px[0])
    if abs(pixel_y_m / pixel_m - 1.0) > _SQUARE_TOLERANCE:
        notes.append(f"pixels are not square: {pixel_m:g} m wide, {pixel_y_m:g} m high")
    created = str(_section(tag, "PrivateFei").get("TimeOfCreation", ""))
    return VendorSettings(
        vendor="thermo_fisher",
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_y_m,
        displayed_magnification=magnification,
        databar_rows=_databar_rows(path, _section(tag, "Image"), size_px),
        working_distance_m=plain_number(beam.get("WD")),
        scan_rotation_rad=plain_number(beam.get("ScanRotation")),
        stage_tilt_rad=plain_number(stage.get("StageT")),
        stage_rotation_rad=plain_number(stage.get("StageR")),
        dwell_s=positive(plain_number(scan.get("Dwell", common.get("Dwelltime")))),
        frame_time_s=positive(plain_number(scan.get("FrameTime", common.get("FrameTime")))),
        detector=str(_section(tag, "Detectors").get("Name", "")),
        instrument=str(_section(tag, "System").get("SystemType", "")),
        time=first_date([(created, "%d.%m.%Y %H:%M:%S")]),
        notes=tuple(notes),
    )
