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

"""Hitachi: small TIFFs with the text file that its microscopes write beside them."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import tifffile

from semcal_ros.core.errors import TiffError
from semcal_ros.files.tiff.read import read_sem_tiff, side_file_settings

COLUMNS, ROWS = 32, 20
PIXELS = (np.arange(COLUMNS * ROWS) % 251).astype(np.uint8).reshape(ROWS, COLUMNS)


def hitachi_text(**changes: str) -> str:
    values = {
        "InstructName": "SU8230",
        "SerialNumber": "8230-01",
        "ImageName": "h.tif",
        "Date": "2019/03/12",
        "Time": "10:22:13",
        "DataSize": f"{COLUMNS}x{ROWS}",
        "PixelSize": "9.921875",
        "SignalName": "SE(U)",
        "AcceleratingVoltage": "15000 Volt",
        "DecelerationVoltage": "0 Volt",
        "Magnification": "10000",
        "WorkingDistance": "8100 um",
        "StagePositionT": "0",
        "StagePositionR": "12",
    }
    lines = [f"{key}={value}" for key, value in {**values, **changes}.items() if value != "-"]
    return "\r\n".join(["[SemImageFile]", *lines])


def write(path: Path, text: str, encoding: str = "utf-8") -> Path:
    tifffile.imwrite(path, PIXELS)
    path.with_suffix(".txt").write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_hitachi(tmp_path: Path, encoding: str) -> None:
    sem = read_sem_tiff(write(tmp_path / "h.tif", hitachi_text(), encoding))
    own = sem.settings
    assert sem.maker == "hitachi"
    assert sem.pixel_size_m == pytest.approx(9.921875e-9, rel=1e-12, abs=0)
    assert sem.displayed_magnification == 10000.0
    assert not own.display_width_assumed
    assert own.acceleration_voltage_v == 15e3
    assert own.working_distance_m == pytest.approx(8.1e-3)
    assert (own.model, own.serial_number, own.detector) == ("SU8230", "8230-01", "SE(U)")
    assert own.time == datetime(2019, 3, 12, 10, 22, 13)
    # 0 is 0 in any unit; 12 may be degrees or rad.
    assert (own.stage_tilt_rad, own.stage_rotation_rad) == (0.0, None)
    assert any("StagePositionR is '12' without a unit" in note for note in own.notes)
    assert any("databar" in note for note in own.notes)
    assert np.array_equal(sem.image, PIXELS)


@pytest.mark.parametrize("size", ["-", "0"])
def test_without_a_pixel_size_the_magnification_of_a_photograph_counts(
    tmp_path: Path, size: str
) -> None:
    """A real file (1280 columns) has both, 9.921875 nm and 10000: 127 mm."""
    assert pytest.approx(0.127) == 9.921875e-9 * 1280 * 10000
    sem = read_sem_tiff(write(tmp_path / "h.tif", hitachi_text(PixelSize=size)))
    assert sem.pixel_size_m == pytest.approx(0.127 / 10000 / COLUMNS, rel=1e-12, abs=0)
    assert sem.settings.display_width_assumed
    assert any("0.127 m assumed" in note for note in sem.notes)


def test_rows_beyond_the_scan_are_a_databar(tmp_path: Path) -> None:
    sem = read_sem_tiff(write(tmp_path / "h.tif", hitachi_text(DataSize=f"{COLUMNS}x{ROWS - 4}")))
    assert np.array_equal(sem.image, PIXELS[: ROWS - 4])
    assert not any("databar" in note for note in sem.notes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"DataSize": "64x20"}, "original file"),
        ({"DataSize": "32x21"}, "original file"),
        ({"PixelSize": "nan"}, "PixelSize"),
        ({"PixelSize": "-3"}, "PixelSize"),
        ({"PixelSize": "4 V"}, "PixelSize"),
        ({"PixelSize": "-", "Magnification": "0"}, "neither PixelSize nor Magnification"),
    ],
)
def test_unusable_values_are_refused(tmp_path: Path, change: dict[str, str], message: str) -> None:
    with pytest.raises(TiffError, match=message) as caught:
        read_sem_tiff(write(tmp_path / "h.tif", hitachi_text(**change)))
    assert "h.tif" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_side_file_of_another_format(tmp_path: Path) -> None:
    (tmp_path / "h.txt").write_text(hitachi_text())
    own = side_file_settings(tmp_path / "h.bmp", (COLUMNS, ROWS))
    assert own is not None
    assert own.maker == "hitachi"
    assert side_file_settings(tmp_path / "other.bmp", (COLUMNS, ROWS)) is None
