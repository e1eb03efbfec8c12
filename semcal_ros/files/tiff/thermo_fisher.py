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

"""Thermo Fisher (FEI): tags 34680 (FEI_SFEG) and 34682 (FEI_HELIOS), text in sections, and XML in tag 34683.

But for the old XL series all of them are in SI units: ``StageT`` and ``StageR`` of ``[Stage]`` and
``ScanRotation`` of the beam are in rad, and so are ``Tilt/Alpha``, ``Rotation`` and ``ScanRotation`` of
the XML, whose root is ``Metadata``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.metadata import (
    aspect_notes,
    check_pixel_size,
    date_of,
    first_date,
    number_of,
    plain_number,
    positive,
    quantity_of,
    refuse_decimal_commas,
    text_of,
    tilt_correction_note,
)
from semcal_ros.files.images.sem_image import VendorSettings

# Private TIFF tags of FEI, now Thermo Fisher: FEI_HELIOS and FEI_SFEG.
TAGS = (34682, 34680)
ROOT = "Metadata"
_BEAMS = {"EBeam": "electron", "IBeam": "ion", "Electron": "electron", "Ion": "ion"}
_NUMBERS = (
    *("PixelWidth", "PixelHeight", "HV", "WD", "ScanRotation", "StageT", "StageR"),
    *("Dwell", "Dwelltime", "FrameTime"),
)
# Relative difference of the width of the field from that of its pixels beyond which a note says so.
_FIELD_TOLERANCE = 1e-2
# Width of the picture for which the XL series states a magnification, m, where a file does not say it: the longer
# side of a Polaroid picture.
_XL_WIDTH_M = 0.1133


def thermo_fisher_sections(text: str) -> dict[str, dict[str, str]]:
    """Sections of the tag's text, as a copy by another program may keep it, in the form of the decoded tag."""
    sections: dict[str, dict[str, str]] = {}
    section: dict[str, str] = {}
    for line in text.splitlines():
        key, equals, value = line.strip().partition("=")
        if key.startswith("[") and key.endswith("]"):
            section = sections.setdefault(key[1:-1], {})
        elif equals:
            section[key.strip()] = value.strip()
    return sections


def _section(tag: Mapping[str, Any], name: object) -> Mapping[str, Any]:
    section = tag.get(str(name), {})
    return section if isinstance(section, Mapping) else {}


def _active(tag: Mapping[str, Any], kind: str, fallback: str) -> Mapping[str, Any]:
    """Section of the beam or scan that made the image, which ``[Beam]`` names."""
    return _section(tag, _section(tag, "Beam").get(kind, fallback)) or _section(tag, fallback)


def _databar_rows(
    path: Path, columns: float | None, rows: float | None, size_px: tuple[int, int]
) -> int:
    """Rows below the scanned ones; the tag's DatabarHeight is 0 even where there is a bar."""
    width, height = size_px
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


def _check_is_a_scan(
    path: Path, tag: Mapping[str, Any], beam: Mapping[str, Any], pixel_width: object
) -> None:
    """Refuse pictures of the chamber's cameras and channeling patterns, whose pixels are not on the specimen."""
    name = str(_section(tag, "Beam").get("Beam", "EBeam"))
    if name not in _BEAMS and pixel_width is None:
        detector = _section(tag, "Detectors").get("Name", name)
        raise TiffError(
            f"{path.name} is a picture of a camera ({detector}), not of a scanned beam",
            expected="an image of the electron or the ion beam",
            do="take the images of the beam only",
        )
    if str(beam.get("ElectronChannelingPatternIsOn", "")).lower() in ("on", "yes", "true"):
        raise TiffError(
            f"{path.name} is an electron channeling pattern, whose pixels are angles",
            expected="an image of the specimen",
            do="take the image without the channeling pattern mode",
        )


def _xl_settings(path: Path, tag: Mapping[str, Any], size_px: tuple[int, int]) -> VendorSettings:
    """Read the settings of the XL series (FEI, formerly Philips), in mm, degrees and micro-degrees.

    Its files have no pixel size. The magnification refers to a picture of ``SizeY`` mm, ``RatioXY`` times as wide.
    """
    vector, device = _section(tag, "Vector"), _section(tag, "ImageDevice")
    magnification = positive(plain_number(vector.get("Magnification")))
    height = positive(plain_number(device.get("SizeY")))
    ratio = positive(plain_number(device.get("RatioXY")))
    width_m = _XL_WIDTH_M if height is None or ratio is None else 1e-3 * height * ratio
    pixel = None if magnification is None else width_m / magnification / size_px[0]
    seen = vector.get("Magnification")
    pixel_m = check_pixel_size(path, pixel, "the pixel size by Magnification in [Vector]", seen)
    voltage, distance = plain_number(vector.get("HighTension")), plain_number(vector.get("FWD"))
    scan, tilt = plain_number(vector.get("ScanRotation")), plain_number(vector.get("SpecimenTilt"))
    rotation = plain_number(vector.get("SpecimenRotation"))
    kind = plain_number(_section(tag, "DatabarData").get("iImageType"))
    return VendorSettings(
        maker="thermo_fisher",
        model="XL",
        serial_number=str(_section(tag, "MachineData").get("MachineNumber", "")),
        beam={1.0: "electron", 2.0: "ion"}.get(kind or 0.0, ""),
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_m,
        displayed_magnification=magnification,
        display_width_assumed=True,
        acceleration_voltage_v=None if voltage is None else abs(voltage),
        working_distance_m=None if distance is None else 1e-3 * distance,
        scan_rotation_rad=None if scan is None else math.radians(scan),
        stage_tilt_rad=None if tilt is None else math.radians(1e-6 * tilt),
        stage_rotation_rad=None if rotation is None else math.radians(1e-6 * rotation),
        notes=(
            f"the pixel size follows from the magnification and a picture {1e3 * width_m:.1f} mm wide: "
            "it may be wrong by some per cent",
        ),
    )


def thermo_fisher_settings(
    path: Path, tag: Mapping[str, Any], size_px: tuple[int, int]
) -> VendorSettings:
    """Read the settings from the decoded tag.

    Raises
    ------
    TiffError
        The pixel size is missing or unusable, the size of the file contradicts the tag, or numbers have decimal commas.
    """
    if "Vector" in tag:
        return _xl_settings(path, tag, size_px)
    stage = _section(tag, "Stage")
    beam, scan = _active(tag, "Beam", "EBeam"), _active(tag, "Scan", "EScan")
    common = _section(tag, "Scan")
    for section in (stage, beam, common, scan):
        refuse_decimal_commas(path, {key: section[key] for key in _NUMBERS if key in section})
    seen = scan.get("PixelWidth", common.get("PixelWidth"))
    _check_is_a_scan(path, tag, beam, seen)
    pixel_m = check_pixel_size(
        path, plain_number(seen), "PixelWidth in tag 34682 (FEI_HELIOS) or 34680 (FEI_SFEG)", seen
    )
    pixel_y_m = plain_number(scan.get("PixelHeight", common.get("PixelHeight"))) or pixel_m
    check_pixel_size(path, pixel_y_m, "PixelHeight", pixel_y_m)
    magnification, notes = _magnification(tag, pixel_m * size_px[0])
    notes += aspect_notes(pixel_m, pixel_y_m)
    field_m = positive(plain_number(scan.get("HorFieldsize", common.get("HorFieldsize"))))
    if field_m is not None and abs(field_m / (pixel_m * size_px[0]) - 1.0) > _FIELD_TOLERANCE:
        notes.append(
            f"HorFieldsize, {1e6 * field_m:.4g} um, is not that of {size_px[0]} pixels of {1e9 * pixel_m:.4g} nm: "
            "the size of the pixels is taken"
        )
    image, voltage = _section(tag, "Image"), plain_number(beam.get("HV"))
    if str(beam.get("TiltCorrectionIsOn", "")).lower() in ("yes", "true", "on"):
        notes.append(tilt_correction_note(plain_number(beam.get("TiltCorrectionAngle"))))
    created = str(_section(tag, "PrivateFei").get("TimeOfCreation", ""))
    return VendorSettings(
        maker="thermo_fisher",
        beam=_BEAMS.get(str(_section(tag, "Beam").get("Beam", "EBeam")), ""),
        model=str(_section(tag, "System").get("SystemType", "")),
        serial_number=str(_section(tag, "System").get("Dnumber", "")),
        acceleration_voltage_v=None if voltage is None else abs(voltage),
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_y_m,
        displayed_magnification=magnification,
        databar_rows=_databar_rows(
            path,
            plain_number(image.get("ResolutionX")),
            plain_number(image.get("ResolutionY")),
            size_px,
        ),
        working_distance_m=plain_number(beam.get("WD")),
        scan_rotation_rad=plain_number(beam.get("ScanRotation")),
        stage_tilt_rad=plain_number(stage.get("StageT")),
        stage_rotation_rad=plain_number(stage.get("StageR")),
        dwell_s=positive(plain_number(scan.get("Dwell", common.get("Dwelltime")))),
        frame_time_s=positive(plain_number(scan.get("FrameTime", common.get("FrameTime")))),
        detector=str(_section(tag, "Detectors").get("Name", "")),
        time=first_date([(created, "%d.%m.%Y %H:%M:%S")]),
        notes=tuple(notes),
    )


def thermo_fisher_xml_settings(
    path: Path, root: ElementTree.Element, size_px: tuple[int, int]
) -> VendorSettings:
    """Read the settings from the root of the XML.

    Raises
    ------
    TiffError
        The pixel size is missing or unusable, or the size of the file contradicts the XML.
    """
    result, scan = "BinaryResult", "ScanSettings"
    x, y = f"{result}/PixelSize/X", f"{result}/PixelSize/Y"
    pixel_m = check_pixel_size(path, quantity_of(root, x, "m"), x, root.findtext(x))
    pixel_y_m = quantity_of(root, y, "m") or pixel_m
    check_pixel_size(path, pixel_y_m, y, root.findtext(y))
    notes = aspect_notes(pixel_m, pixel_y_m)
    if text_of(root, "Optics/SampleTiltCorrectionOn").lower() == "true":
        notes.append(tilt_correction_note(number_of(root, "Optics/SampleTiltCorrectionAngle")))
    voltage_v = number_of(root, "Optics/AccelerationVoltage")
    size = f"{result}/ImageSize"
    return VendorSettings(
        maker="thermo_fisher",
        beam=_BEAMS.get(text_of(root, "Acquisition/BeamType"), ""),
        model=text_of(root, "Instrument/InstrumentModel")
        or text_of(root, "Instrument/InstrumentClass"),
        serial_number=text_of(root, "Instrument/InstrumentID"),
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_y_m,
        databar_rows=_databar_rows(
            path, number_of(root, f"{size}/X"), number_of(root, f"{size}/Y"), size_px
        ),
        acceleration_voltage_v=None if voltage_v is None else abs(voltage_v),
        working_distance_m=number_of(root, "Optics/WorkingDistance"),
        scan_rotation_rad=number_of(root, f"{scan}/ScanRotation"),
        stage_tilt_rad=number_of(root, "StageSettings/StagePosition/Tilt/Alpha"),
        stage_rotation_rad=number_of(root, "StageSettings/StagePosition/Rotation"),
        dwell_s=positive(number_of(root, f"{scan}/DwellTime")),
        frame_time_s=positive(number_of(root, f"{scan}/FrameTime")),
        detector=text_of(root, "Detectors/ScanningDetector/DetectorName")
        or text_of(root, f"{result}/Detector"),
        time=date_of(root, "Acquisition/AcquisitionDatetime"),
        notes=tuple(notes),
    )
