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

"""SEM TIFFs of the makers: small files with the makers' tags, and hostile variants."""

from __future__ import annotations

import csv
import math
import struct
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.image_series import list_image_series
from semcal_ros.files.tiff.olympus import olympus_settings
from semcal_ros.files.tiff.read import read_page_settings, read_sem_tiff
from tests.helpers.sem_files import zeiss_text

PIXELS = (np.arange(20 * 32) % 251).astype(np.uint8).reshape(20, 32)


def fei_text(pixel: str = "2.69792e-07", rows: int = 16, columns: int = 32) -> bytes:
    return "\r\n".join(
        [
            "[System]", "SystemType=Scios", "Dnumber=9923184", "DisplayWidth=0.518",
            "[Beam]", "Beam=IBeam", "Scan=IScan",
            "[EBeam]", "WD=0.1", "ScanRotation=0",
            "[IBeam]", "HV=30000", "WD=0.00681643", "ScanRotation=0.5",
            "[EScan]", "PixelWidth=1e-3", "PixelHeight=1e-3",
            "[IScan]", "Dwell=1e-06", f"PixelWidth={pixel}", f"PixelHeight={pixel}",
            "FrameTime=1.75685",
            "[Image]", f"ResolutionX={columns}", f"ResolutionY={rows}", "MagCanvasRealWidth=0.138",
            "[Detectors]", "Name=ETD",
            "[Stage]", "StageX=1e-3", "StageR=-0.0123283", "StageT=0.25", "SpecTilt=0",
            "[PrivateFei]", "TimeOfCreation=10.11.2023 14:09:15", "DatabarHeight=0",
        ]
    ).encode("ascii") + b"\x00"  # fmt: skip


def tescan_bytes(pixel: str = "2.5012e-6", strip: str = "4") -> bytes:
    """Tag 50431: a thumbnail record that contains misleading text, then two text records."""

    def record(kind: int, payload: bytes) -> bytes:
        return struct.pack("<IH", len(payload) + 2, kind) + payload

    main = (
        f"Date=2016-05-16\r\nImageStripSize={strip}\r\nMagnification=108.08\r\nPixelSizeX={pixel}"
    )
    main += f"\r\nPixelSizeY={pixel}\r\nTime=16:03:27\r\nDevice=MIRA3 XMU\r\nSerialNumber=MI32\r\n"
    sem = "HV=10.0e3\r\nDetector=SE\r\nDwellTime=3.2000e-6\r\nScanRotation=90.0\r\n"
    sem += "StageTilt=-5.0\r\nStageRotation=180.0\r\nWD=13.250e-3\r\n"
    return b"".join(
        [
            record(1, b"\x00\x00\xff\xd8\nPixelSizeX=1\n\xff\xd9"),
            record(2, main.encode() + b"\x00"),
            record(3, sem.encode() + b"\x00"),
            record(0, b""),
        ]
    )


def jeol_text(**changes: str) -> str:
    values = {
        "$CM_FORMAT": "JEOL-SEM",
        "$CM_MAG": "50",
        "$CM_FULL_SIZE": "32 20",
        "$$SM_WD": "9.07",
        "$$SM_SCAN_ROTATION": "0.00",
        "$CM_DATE": "2025/11/20",
        "$CM_TIME": "13:42:14",
        "$CM_DETECTOR_NAME": "LED",
        "$CM_ACCEL_VOLT": "5.00",
        "$CM_INSTRUMENT": "4700F",
    }
    named = {("$$" if k.startswith("SM_") else "$") + k: v for k, v in changes.items()}
    return "\r\n".join(f"{k} {v}" for k, v in {**values, **named}.items() if v != "-")


def write_tagged(path: Path, code: int, data: bytes, pixels: np.ndarray = PIXELS) -> Path:
    kind = 7 if code == 50431 else 2
    tifffile.imwrite(path, pixels, extratags=[(code, kind, len(data), data, True)])
    return path


def write_jeol(path: Path, text: str, encoding: str = "utf-8") -> Path:
    tifffile.imwrite(path, PIXELS)
    path.with_suffix(".txt").write_bytes(text.encode(encoding))
    return path


def test_zeiss(tmp_path: Path) -> None:
    sem = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, zeiss_text()))
    assert sem.maker == "zeiss"
    # The head of the tag has more digits than the named value and rounds to it.
    assert sem.pixel_size_m == pytest.approx(5.932882e-07, rel=1e-12, abs=0)
    assert sem.displayed_magnification == 188.19
    assert sem.display_width_m == pytest.approx(5.932882e-07 * 32 * 188.19, rel=1e-12, abs=0)
    assert sem.working_distance_m == pytest.approx(5.243416e-3, rel=1e-12, abs=0)
    assert sem.scan_rotation_rad == pytest.approx(math.radians(30.0))
    assert sem.stage_tilt_rad == pytest.approx(math.radians(2.0))
    assert sem.stage_rotation_rad == pytest.approx(math.radians(233.5))
    assert sem.metadata()["stage_tilt_rad"] == sem.stage_tilt_rad
    # 100 ns x 2^(4 - 1): DP_DWELL_TIME is not the time on a pixel.
    assert sem.dwell_s == pytest.approx(0.8e-6, rel=1e-12, abs=0)
    assert sem.frame_time_s == pytest.approx(0.75276)
    assert sem.settings.acceleration_voltage_v == pytest.approx(5000.0)
    assert (sem.settings.model, sem.settings.serial_number) == ("Auriga 60", "Auriga 60-46-17")
    assert sem.detector == "InLens"
    assert sem.time == datetime(2023, 4, 11, 8, 40, 47)
    assert np.array_equal(sem.image, PIXELS)
    assert any("databar" in note for note in sem.notes)


@pytest.mark.parametrize(
    ("text", "expected_m"),
    [
        ("593.3 nm", 593.3e-9),
        ("1.187 \u00b5m", 1.187e-6),
        ("850.0 pm", 850e-12),
        ("0.001 mm", 1e-6),
        ("2.5e-7 m", 2.5e-7),
    ],
)
def test_zeiss_units(tmp_path: Path, text: str, expected_m: float) -> None:
    # The head contradicts the named value here, so the named one counts.
    data = zeiss_text(pixel=text, head=("4.0e-05", "7"))
    sem = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, data))
    assert sem.pixel_size_m == pytest.approx(expected_m, rel=1e-12, abs=0)


@pytest.mark.parametrize("tilt", ["35 mrad", "2.0", "none"])
def test_zeiss_angles_of_unknown_unit_are_left_out(tmp_path: Path, tilt: str) -> None:
    sem = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, zeiss_text(tilt=tilt)))
    assert sem.stage_tilt_rad is None
    assert sem.stage_rotation_rad == pytest.approx(math.radians(233.5))
    (note,) = [note for note in sem.notes if "AP_STAGE_AT_T" in note]
    assert "not an angle in degrees: it is left out" in note


def test_zeiss_magnification_in_thousands(tmp_path: Path) -> None:
    data = zeiss_text(mag="5.00 K X", head=("5.932882e-07", "5.0012e+03"))
    assert read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, data)).displayed_magnification == (
        5001.2
    )


@pytest.mark.parametrize(
    ("text", "expected_s", "noted"),
    [
        ("752.76 ms", 0.75276, False),
        ("40.5 Secs", 40.5, False),
        ("1.9 Mins", 114.0, True),
        ("2 Hours", 7200.0, True),
        ("12", None, False),
    ],
)
def test_zeiss_frame_times(
    tmp_path: Path, text: str, expected_s: float | None, noted: bool
) -> None:
    data = zeiss_text(changes={"AP_FRAME_TIME": f"Cycle Time = {text}"})
    sem = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, data))
    assert sem.frame_time_s == (None if expected_s is None else pytest.approx(expected_s))
    # Half of the last digit is 0.12 % of 40.5 and 2.6 % of 1.9.
    assert noted == any("the frame time is given as" in note for note in sem.notes)


@pytest.mark.parametrize(
    ("width", "screen", "head", "expected_m", "source"),
    [
        # A real file: 5.965 um, 5.825 nm of 1024 columns, and 5.824988e-09 at the head.
        ("18.99 \u00b5m", "18.54 nm", "1.854025625e-08", 5.932882e-07, "AP_WIDTH"),
        ("18.99 \u00b5m", "18.54 nm", "4e-05", 18.99e-6 / 32, "AP_WIDTH"),
        ("18.99 \u00b5m", "", "4e-05", 18.99e-6 / 32, "AP_WIDTH"),
        ("", "18.54 nm", "1.854025625e-08", 5.932882e-07, "1024 columns of the screen"),
        ("", "18.54 nm", "4e-05", 18.54e-9 * 32, "1024 columns of the screen"),
    ],
)
def test_zeiss_without_the_pixel_size_of_the_image(
    tmp_path: Path, width: str, screen: str, head: str, expected_m: float, source: str
) -> None:
    """Older programs write the width of the field, and the pixel size of the screen, which has 1024 columns."""
    changes = {
        "AP_IMAGE_PIXEL_SIZE": "",
        "AP_PIXEL_SIZE": screen and f"Pixel Size = {screen}",
        "AP_WIDTH": width and f"Width = {width}",
    }
    data = zeiss_text(head=(head, "188.19"), changes=changes)
    sem = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, data))
    assert sem.pixel_size_m == pytest.approx(expected_m, rel=1e-12, abs=0)
    (note,) = [note for note in sem.notes if "no AP_IMAGE_PIXEL_SIZE" in note]
    assert source in note


@pytest.mark.parametrize("bad", ["0 nm", "12", "inf m", "9 m"])
def test_zeiss_without_any_usable_size(tmp_path: Path, bad: str) -> None:
    changes = {"AP_IMAGE_PIXEL_SIZE": "", "AP_PIXEL_SIZE": f"Pixel Size = {bad}"}
    with pytest.raises(TiffError, match="PIXEL_SIZE"):
        read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, zeiss_text(changes=changes)))


def test_zeiss_sizes_that_do_not_fit_the_columns_are_noted(tmp_path: Path) -> None:
    wide = np.tile(PIXELS, (1, 2))
    sem = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, zeiss_text(), wide))
    assert any("resized or cropped copy" in note for note in sem.notes)
    width = {"AP_PIXEL_SIZE": "", "AP_WIDTH": "Width = 30.00 \u00b5m"}
    sem = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, zeiss_text(changes=width)))
    assert any("resized or cropped copy" in note for note in sem.notes)
    sem = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, zeiss_text()))
    assert not any("resized or cropped copy" in note for note in sem.notes)


def test_zeiss_dwell_that_does_not_fit_the_line_is_left_out(tmp_path: Path) -> None:
    data = zeiss_text(changes={"AP_LINE_TIME": "Line Time = 25 \u00b5s"})
    # 32 columns of 0.8 us are 25.6 us; the rounding of the stated 25 us reaches 25.5 us.
    assert read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, data)).dwell_s is None
    data = zeiss_text(changes={"AP_LINE_TIME": "", "DP_SCANRATE": ""})
    assert read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, data)).dwell_s is None


def test_tilt_correction_is_noted(tmp_path: Path) -> None:
    on = {"DP_TILT_CORRECTION": "Tilt Corrn. = On", "AP_TILT_ANGLE": "Tilt Angle = -37.0 \u00b0"}
    zeiss = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, zeiss_text(changes=on)))
    assert any("tilt correction was on for -37 degrees" in note for note in zeiss.notes)
    off = {**on, "DP_TILT_CORRECTION": "Tilt Corrn. = Off"}
    zeiss = read_sem_tiff(write_tagged(tmp_path / "z.tif", 34118, zeiss_text(changes=off)))
    assert not any("tilt correction" in note for note in zeiss.notes)
    text = fei_text().replace(
        b"[IBeam]", b"[IBeam]\r\nTiltCorrectionIsOn=yes\r\nTiltCorrectionAngle=0.5"
    )
    fei = read_sem_tiff(write_tagged(tmp_path / "f.tif", 34682, text))
    assert any("tilt correction was on for 28.6479 degrees" in note for note in fei.notes)
    tifffile.imwrite(tmp_path / "t.tif", PIXELS)
    (tmp_path / "t.hdr").write_text("PixelSizeX=1e-9\nTiltCorrection=20\n")
    tescan = read_sem_tiff(tmp_path / "t.tif")
    assert any("tilt correction was on for 20 degrees" in note for note in tescan.notes)


def test_thermo_fisher_pictures_that_are_no_scans_are_refused(tmp_path: Path) -> None:
    camera = (
        fei_text()
        .replace(b"Beam=IBeam", b"Beam=IRBeam")
        .replace(b"Scan=IScan", b"Scan=")
        .replace(b"PixelWidth", b"Width")
        .replace(b"Name=ETD", b"Name=Nav-Cam")
    )
    with pytest.raises(TiffError, match=r"picture of a camera \(Nav-Cam\)"):
        read_sem_tiff(write_tagged(tmp_path / "c.tif", 34682, camera))
    angles = fei_text().replace(b"[IBeam]", b"[IBeam]\r\nElectronChannelingPatternIsOn=On")
    with pytest.raises(TiffError, match="channeling pattern"):
        read_sem_tiff(write_tagged(tmp_path / "e.tif", 34682, angles))


def test_thermo_fisher_takes_the_active_beam_and_cuts_the_databar(tmp_path: Path) -> None:
    sem = read_sem_tiff(write_tagged(tmp_path / "f.tif", 34682, fei_text(rows=16)))
    assert sem.maker == "thermo_fisher"
    assert sem.pixel_size_m == 2.69792e-07
    assert sem.databar_rows == 4
    assert np.array_equal(sem.image, PIXELS[:16])
    assert sem.full_size_px == (32, 20)
    assert sem.working_distance_m == 0.00681643
    assert sem.scan_rotation_rad == 0.5
    assert (sem.stage_tilt_rad, sem.stage_rotation_rad) == (0.25, -0.0123283)
    assert sem.display_width_m == pytest.approx(0.138, rel=1e-12, abs=0)
    assert sem.frame_time_s == 1.75685
    assert sem.time == datetime(2023, 11, 10, 14, 9, 15)
    assert any("two magnifications" in note for note in sem.notes)
    assert sem.settings.acceleration_voltage_v == 30e3
    assert (sem.settings.beam, sem.settings.model) == ("ion", "Scios")
    assert sem.settings.serial_number == "9923184"
    other = read_sem_tiff(write_tagged(tmp_path / "g.tif", 34680, fei_text(rows=16)))
    assert other.pixel_size_m == sem.pixel_size_m


def test_one_pixel_size_in_two_spellings_is_one_magnification(tmp_path: Path) -> None:
    for number, pixel in enumerate(("1e-07", "1.0000000000000003e-07", "1e-07", "1.0001e-07")):
        write_tagged(tmp_path / f"{number}.tif", 34682, fei_text(pixel=pixel))
    series = list_image_series(sorted(tmp_path.iterdir()), display_width_m=0.128)
    first, second, third, other = (image.magnification for image in series.images)
    assert first == second == third
    assert other == pytest.approx(first / 1.0001, rel=1e-9)


def test_thermo_fisher_refuses_decimal_commas(tmp_path: Path) -> None:
    """Without the tilt, a calibration would be made as without a stage."""
    text = fei_text()
    assert text.count(b"StageT=") == 1
    start, _, rest = text.partition(b"StageT=")
    text = start + b"StageT=0,349\r\n" + rest.partition(b"\n")[2]
    with pytest.raises(TiffError, match="StageT is '0,349'"):
        read_sem_tiff(write_tagged(tmp_path / "f.tif", 34682, text))


def test_thermo_fisher_notes_a_field_that_its_pixels_do_not_have(tmp_path: Path) -> None:
    pixels = fei_text()
    for factor, noted in ((1.0, False), (2.0, True)):
        field = f"[IScan]\r\nHorFieldsize={factor * 32 * 2.69792e-07!r}".encode()
        text = pixels.replace(b"[IScan]", field)
        sem = read_sem_tiff(write_tagged(tmp_path / f"{factor}.tif", 34682, text))
        assert any("HorFieldsize" in note for note in sem.notes) == noted


def test_thermo_fisher_refuses_a_resized_copy(tmp_path: Path) -> None:
    path = write_tagged(tmp_path / "f.tif", 34682, fei_text(columns=64))
    with pytest.raises(TiffError, match="original file"):
        read_sem_tiff(path)


def test_the_xl_series_has_a_magnification_and_no_pixel_size(tmp_path: Path) -> None:
    """10000x of a picture 85 mm high and 1.333 times as wide, in 32 columns."""
    text = (
        b"[DatabarData]\r\nflAccV=5000\r\niImageType=2\r\n[ImageDevice]\r\nSizeY=85\r\nRatioXY=1.333\r\n"
        b"[MachineData]\r\nMachineNumber=688\r\n[Vector]\r\nMagnification=10000\r\nHighTension=5000\r\n"
        b"FWD=16.989\r\nScanRotation=180\r\nSpecimenRotation=288000000\r\nSpecimenTilt=7000000\0"
    )
    path = tmp_path / "xl.tif"
    tifffile.imwrite(path, PIXELS, extratags=[(34680, 2, len(text), text, True)])
    sem = read_sem_tiff(path)
    own = sem.settings
    assert sem.pixel_size_m == pytest.approx(85e-3 * 1.333 / 1e4 / 32, rel=1e-12)
    assert own.display_width_assumed
    assert own.displayed_magnification == 10000.0
    assert (own.maker, own.model, own.serial_number, own.beam) == (
        "thermo_fisher",
        "XL",
        "688",
        "ion",
    )
    assert (own.acceleration_voltage_v, own.working_distance_m) == (5e3, pytest.approx(16.989e-3))
    angles = own.scan_rotation_rad, own.stage_rotation_rad, own.stage_tilt_rad
    assert np.degrees(angles) == pytest.approx([180.0, 288.0, 7.0])
    assert any("wrong by some per cent" in note for note in sem.notes)


def test_olympus(tmp_path: Path) -> None:
    tag = {
        "datetime": datetime(2008, 2, 20, 10, 54),
        "pixelsizex": 4.6327e-08,
        "pixelsizey": 4.5e-08,
        "magnification": 220.0,
        "cameraname": "Sirion ",
    }
    own = olympus_settings(tmp_path / "sis.tif", tag)
    assert (own.maker, own.pixel_size_m, own.pixel_size_y_m) == ("olympus", 4.6327e-08, 4.5e-08)
    assert (own.displayed_magnification, own.detector) == (220.0, "Sirion")
    assert own.time == datetime(2008, 2, 20, 10, 54)
    assert own.notes == ("pixels are not square: 4.6327e-08 m wide, 4.5e-08 m high",)
    with pytest.raises(TiffError, match="pixelsizex in tag 33560"):
        olympus_settings(tmp_path / "sis.tif", {**tag, "pixelsizex": 0.0})


def test_tescan_in_sixteen_bits(tmp_path: Path) -> None:
    wide = PIXELS.astype(np.uint16) * 257
    sem = read_sem_tiff(write_tagged(tmp_path / "t.tif", 50431, tescan_bytes(), wide))
    assert sem.maker == "tescan"
    assert sem.pixel_size_m == 2.5012e-6
    assert sem.databar_rows == 4
    assert sem.image.dtype == np.uint16
    assert np.array_equal(sem.image, wide[:16])
    assert sem.displayed_magnification == 108.08
    assert sem.dwell_s == 3.2e-6
    assert sem.scan_rotation_rad == pytest.approx(math.pi / 2)
    assert sem.stage_tilt_rad == pytest.approx(math.radians(-5.0))
    assert sem.stage_rotation_rad == pytest.approx(math.pi)
    assert sem.working_distance_m == 0.01325
    assert sem.settings.acceleration_voltage_v == 10e3
    assert (sem.settings.model, sem.settings.serial_number) == ("MIRA3 XMU", "MI32")


def test_tescan_header_file(tmp_path: Path) -> None:
    path = tmp_path / "t.tif"
    tifffile.imwrite(path, PIXELS)
    text = "[MAIN]\nPixelSizeX=1e-9\nPixelSizeY=1e-9\nImageStripSize=0\n[SEM]\nWD=0.01\n"
    (tmp_path / "t-tif.hdr").write_text(text)
    assert read_sem_tiff(path).pixel_size_m == 1e-9


def test_jeol_stage_by_name_only(tmp_path: Path) -> None:
    named = jeol_text(CM_STAGE_POSITION="X=37.1761, Y=44.9344, R=354.9968, Z=16.90, T=12.50")
    sem = read_sem_tiff(write_jeol(tmp_path / "j.tif", named))
    assert sem.stage_tilt_rad == pytest.approx(math.radians(12.5))
    assert sem.stage_rotation_rad == pytest.approx(math.radians(354.9968))
    bare = jeol_text(CM_STAGE_POS="5.483 0.831 8.5 -0.0 0.0 0.000")
    sem = read_sem_tiff(write_jeol(tmp_path / "k.tif", bare))
    assert (sem.stage_tilt_rad, sem.stage_rotation_rad) == (None, None)
    assert any("$CM_STAGE_POS does not name its axes" in note for note in sem.notes)


def test_jeol_with_assumed_display_width(tmp_path: Path) -> None:
    sem = read_sem_tiff(write_jeol(tmp_path / "j.tif", jeol_text()))
    assert sem.maker == "jeol"
    assert sem.pixel_size_m == pytest.approx(0.128 / 50 / 32, rel=1e-12, abs=0)
    assert sem.settings.display_width_assumed
    assert any("assumed" in note for note in sem.notes)
    assert sem.working_distance_m == pytest.approx(9.07e-3)
    assert sem.time == datetime(2025, 11, 20, 13, 42, 14)
    assert sem.detector == "LED"
    assert sem.settings.acceleration_voltage_v == 5000.0
    assert sem.settings.model == "4700F"


@pytest.mark.parametrize(
    ("field", "encoding"),
    [
        ("64.0 40.0", "utf-8"),
        ("64.0um 40.0um", "utf-8"),
        ("64.0\u00b5m 40.0\u00b5m", "utf-8"),
        ("64.0\u03bcm 40.0\u03bcm", "utf-8"),
        ("64.0\u00b5m 40.0\u00b5m", "latin-1"),
        ("64.0\u00b5m 40.0\u00b5m", "utf-16"),
        ("0.064mm 0.040mm", "utf-8"),
    ],
)
def test_jeol_field_of_view_in_every_spelling(tmp_path: Path, field: str, encoding: str) -> None:
    text = jeol_text(CM_FIELD_OF_VIEW=field)
    sem = read_sem_tiff(write_jeol(tmp_path / "j.tif", text, encoding))
    assert sem.pixel_size_m == pytest.approx(2e-6, rel=1e-12, abs=0)
    assert not sem.settings.display_width_assumed


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"CM_FIELD_OF_VIEW": "64,0000 40,0000"}, r"\$CM_FIELD_OF_VIEW is '64,0000'"),
        ({"CM_FIELD_OF_VIEW": "64.0nm 40.0nm"}, r"\$CM_MAG 50 is a field of 2560 um"),
        ({"CM_MAG": "50,5"}, r"\$CM_MAG is '50,5'"),
        ({"SM_WD": "9,07"}, r"\$SM_WD is '9,07'"),
    ],
)
def test_jeol_refuses_decimal_commas_and_contradictions(
    tmp_path: Path, changed: dict[str, str], said: str
) -> None:
    """Left out, they would be replaced by a display width that is assumed."""
    with pytest.raises(TiffError, match=said):
        read_sem_tiff(write_jeol(tmp_path / "j.tif", jeol_text(**changed)))


def test_jeol_micron_bar_confirms_or_replaces_the_assumption(tmp_path: Path) -> None:
    agreeing = jeol_text(SM_MICRON_BAR="13", SM_MICRON_MARKER="1mm")
    sem = read_sem_tiff(write_jeol(tmp_path / "a.tif", agreeing))
    assert sem.pixel_size_m == pytest.approx(8e-5, rel=1e-12, abs=0)
    assert not sem.settings.display_width_assumed
    other = jeol_text(SM_MICRON_BAR="20", SM_MICRON_MARKER="1mm")
    sem = read_sem_tiff(write_jeol(tmp_path / "b.tif", other))
    assert sem.pixel_size_m == pytest.approx(5e-5, rel=1e-12, abs=0)


def test_databar_of_jeol_and_override(tmp_path: Path) -> None:
    path = write_jeol(tmp_path / "j.TIF", jeol_text(CM_FULL_SIZE="32 18"))
    assert read_sem_tiff(path).image.shape == (18, 32)
    assert read_sem_tiff(path, databar_rows=5).image.shape == (15, 32)
    with pytest.raises(TiffError, match="20 rows of databar"):
        read_sem_tiff(path, databar_rows=20)


@pytest.mark.parametrize(
    "bad", ["NaN nm", "-3 nm", "0 nm", "inf m", "1e400 nm", "5 furlong", "7", "9 m"]
)
def test_unusable_pixel_sizes_name_file_and_tag(tmp_path: Path, bad: str) -> None:
    path = write_tagged(tmp_path / "bad.tif", 34118, zeiss_text(pixel=bad))
    with pytest.raises(TiffError, match=r"bad\.tif: AP_IMAGE_PIXEL_SIZE"):
        read_sem_tiff(path)


@pytest.mark.parametrize("bad", ["nan", "-1e-7", "0", "1e300", "", "abc"])
def test_unusable_pixel_sizes_of_the_others(tmp_path: Path, bad: str) -> None:
    fei = write_tagged(tmp_path / "f.tif", 34682, fei_text(pixel=bad))
    tescan = write_tagged(tmp_path / "t.tif", 50431, tescan_bytes(pixel=bad))
    jeol = write_jeol(tmp_path / "j.tif", jeol_text(CM_MAG=bad or "-"))
    for path in (fei, tescan, jeol):
        with pytest.raises(TiffError) as caught:
            read_sem_tiff(path)
        assert path.name in str(caught.value)
        assert "\n" not in str(caught.value)


def test_databar_higher_than_the_image(tmp_path: Path) -> None:
    for strip in ("20", "99999", "-1"):
        path = write_tagged(tmp_path / "t.tif", 50431, tescan_bytes(strip=strip))
        with pytest.raises(TiffError, match="ImageStripSize"):
            read_sem_tiff(path)


def test_no_metadata_no_tiff_and_missing_file(tmp_path: Path) -> None:
    plain = tmp_path / "plain.tif"
    tifffile.imwrite(plain, PIXELS)
    with pytest.raises(TiffError, match=r"34118 \(Zeiss\)"):
        read_sem_tiff(plain)
    (tmp_path / "text.tif").write_text("hello")
    (tmp_path / "empty.tif").write_bytes(b"")
    for name in ("text.tif", "empty.tif", "missing.tif"):
        with pytest.raises(TiffError, match=name):
            read_sem_tiff(tmp_path / name)


def test_absurd_size_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = write_tagged(tmp_path / "big.tif", 34118, zeiss_text())
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        for tag in (file.pages.first.tags["ImageWidth"], file.pages.first.tags["ImageLength"]):
            width = struct.calcsize("<" + ("H" if tag.dtype == 3 else "I"))
            data[tag.valueoffset : tag.valueoffset + width] = b"\xff" * width
    path.write_bytes(data)
    with pytest.raises(TiffError, match="declares"):
        read_sem_tiff(path)


@pytest.mark.parametrize("photometric", ["minisblack", "miniswhite", "rgb", "palette"])
def test_pixels_become_grey(tmp_path: Path, photometric: str) -> None:
    data = zeiss_text()
    tags = [(34118, 2, len(data), data, True)]
    path = tmp_path / "p.tif"
    if photometric == "palette":
        ramp = np.arange(256, dtype=np.uint16)[::-1] * 257
        tifffile.imwrite(path, PIXELS, photometric=3, colormap=np.stack([ramp] * 3), extratags=tags)
    elif photometric == "rgb":
        tifffile.imwrite(path, np.stack([PIXELS] * 3, axis=-1), photometric=2, extratags=tags)
    else:
        tifffile.imwrite(path, PIXELS, photometric=photometric, extratags=tags)
    inverted = photometric in ("miniswhite", "palette")
    assert np.array_equal(read_sem_tiff(path).image, 255 - PIXELS if inverted else PIXELS)


@pytest.fixture(scope="module")
def templates(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("tiffs")
    return [
        write_tagged(folder / "z.tif", 34118, zeiss_text()).read_bytes(),
        write_tagged(folder / "f.tif", 34682, fei_text()).read_bytes(),
        write_tagged(folder / "t.tif", 50431, tescan_bytes()).read_bytes(),
    ]


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damaged_files_never_raise_anything_but_tiff_errors(
    tmp_path: Path, templates: list[bytes], data: st.DataObject
) -> None:
    blob = bytearray(data.draw(st.sampled_from(templates)))
    for _ in range(data.draw(st.integers(1, 5))):
        blob[data.draw(st.integers(0, len(blob) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "damaged.tif"
    path.write_bytes(blob[: data.draw(st.integers(8, len(blob)))])
    try:
        sem = read_sem_tiff(path)
    except TiffError as error:
        assert "\n" not in str(error)
    else:
        assert sem.image.dtype in (np.uint8, np.uint16)
        assert 1e-13 <= sem.pixel_size_m <= 1e-3


def test_truncated_pixels(tmp_path: Path) -> None:
    path = write_tagged(tmp_path / "z.tif", 34118, zeiss_text())
    path.write_bytes(path.read_bytes()[:-100])
    read_page_settings(path)
    with pytest.raises(TiffError, match="cannot be read"):
        read_sem_tiff(path)


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("zeiss_example_sem.tif", 0),
        ("tfs_example.tif", 68),
        ("tescan_example_sem1.tif", 120),
        ("jeol_example_sem.tif", 0),
    ],
)
def test_real_files_agree_with_the_truth_table(reference_data: Path, name: str, rows: int) -> None:
    folder = reference_data / "real_sem"
    with (folder / "metadata_truth.csv").open(newline="") as stream:
        truth = {row["file"]: row for row in csv.DictReader(stream)}[name]
    sem = read_sem_tiff(folder / name)
    # The table gives 4 to 6 digits.
    pixel_nm = float(truth["pixel_size_nm"].split()[0])
    assert sem.pixel_size_m * 1e9 == pytest.approx(pixel_nm, rel=2e-6, abs=0)
    assert sem.image.shape == (int(truth["frame_h_px"].split()[0]), int(truth["frame_w_px"]))
    assert sem.databar_rows == rows
    assert sem.working_distance_m == pytest.approx(float(truth["WD_mm"]) * 1e-3, rel=1e-4)
    assert sem.scan_rotation_rad == 0.0
    if sem.maker != "thermo_fisher":  # its shown magnification is only in the image
        assert sem.displayed_magnification == pytest.approx(
            float(truth["displayed_mag"].split()[0]), rel=1e-5
        )
        width_mm = float(truth["W_display_mm_implied(px*N*mag)"].split()[0])
        assert sem.display_width_m == pytest.approx(width_mm * 1e-3, rel=1e-5)
    # The table copies Zeiss's DP_DWELL_TIME, 50 ns, at which 1024 columns take 51 us; AP_LINE_TIME says 949 us.
    if sem.maker == "zeiss":
        assert sem.dwell_s == pytest.approx(0.8e-6, rel=1e-12, abs=0)
        truth["dwell_us"] = ""
    for key, value in (("dwell_us", sem.dwell_s), ("frame_time_s", sem.frame_time_s)):
        if truth[key]:
            scale = 1e-6 if key == "dwell_us" else 1.0
            assert value == pytest.approx(float(truth[key]) * scale, rel=1e-3, abs=0)


@pytest.mark.parametrize(
    ("name", "tilt_deg", "rotation_deg"),
    [
        ("zeiss_example_sem.tif", 2.0, 233.5),
        ("tfs_example.tif", 0.0, math.degrees(-0.0123283)),
        ("tescan_example_sem1.tif", 0.0, 0.0),
        # Its text file has no names for the numbers.
        ("jeol_example_sem.tif", None, None),
    ],
)
def test_real_files_say_where_their_stage_was(
    reference_data: Path, name: str, tilt_deg: float | None, rotation_deg: float | None
) -> None:
    (_, settings, _), *_ = read_page_settings(reference_data / "real_sem" / name)
    for angle, expected in (
        (settings.stage_tilt_rad, tilt_deg),
        (settings.stage_rotation_rad, rotation_deg),
    ):
        assert angle == (None if expected is None else pytest.approx(math.radians(expected)))
