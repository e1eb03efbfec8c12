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

"""TIFFs that ImageJ saved: its scale, and the maker's text that it kept."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from semcal_ros.core.errors import TiffError
from semcal_ros.files.tiff.read import read_page_settings, read_sem_pages, read_sem_tiff
from tests.files.tiff.test_hitachi import hitachi_text
from tests.files.tiff.test_tiff import fei_text, jeol_text
from tests.helpers.sem_files import zeiss_text

PIXELS = (np.arange(20 * 32) % 251).astype(np.uint8).reshape(20, 32)


def write(
    path: Path, unit: str | None, per_unit: float, pixels: Any = PIXELS, **metadata: Any
) -> Path:
    """A file in ImageJ's form by tifffile, whose tests hold it against ImageJ."""
    named = metadata if unit is None else {"unit": unit, **metadata}
    tifffile.imwrite(path, pixels, imagej=True, resolution=(per_unit, per_unit), metadata=named)
    return path


@pytest.mark.parametrize(
    ("unit", "per_unit", "expected_m"),
    [
        ("micron", 5.928571, 1e-6 / 5.928571),
        ("um", 4.0, 0.25e-6),
        ("\\u00B5m", 4.0, 0.25e-6),
        ("nm", 0.04, 25e-9),
        ("mm", 2000.0, 0.5e-6),
        ("cm", 40000.0, 0.25e-6),
    ],
)
def test_scale(tmp_path: Path, unit: str, per_unit: float, expected_m: float) -> None:
    sem = read_sem_tiff(write(tmp_path / "i.tif", unit, per_unit))
    assert sem.maker == "imagej"
    # ImageJ's and tifffile's fractions have millionths.
    assert sem.pixel_size_m == pytest.approx(expected_m, rel=1e-6)
    assert sem.pixel_size_y_m == sem.pixel_size_m
    assert np.array_equal(sem.image, PIXELS)


@pytest.mark.parametrize(
    ("unit", "per_unit"),
    [(None, 1.0), ("pixel", 1.0), ("inch", 300.0), ("cm", 118.11), ("V", 3.0)],
)
def test_no_scale_of_a_specimen_is_refused(
    tmp_path: Path, unit: str | None, per_unit: float
) -> None:
    """Among them the dots per inch of a print, in inches and in cm."""
    with pytest.raises(TiffError, match=r"without a scale.*Set Scale"):
        read_sem_tiff(write(tmp_path / "i.tif", unit, per_unit))


def test_coarse_rounding_is_noted(tmp_path: Path) -> None:
    path = write(tmp_path / "i.tif", "nm", 1 / 2691)
    # ImageJ stores 372 millionths of a pixel per nm, which is good to 0.13 %; tifffile a fraction that is closer.
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        order = file.byteorder
        tags = file.pages.first.tags
        places = [tags[name].valueoffset for name in ("XResolution", "YResolution")]
    for place in places:
        data[place : place + 8] = struct.pack(order + "II", 372, 1_000_000)
    path.write_bytes(data)
    sem = read_sem_tiff(path)
    assert sem.pixel_size_m == pytest.approx(2691e-9, rel=0.5 / 372)
    assert any("rounded the pixel size to 0.1 %" in note for note in sem.notes)


@pytest.mark.parametrize(
    ("text", "maker", "pixel_m", "tilt_rad"),
    [
        (zeiss_text().decode("cp1252").rstrip("\x00"), "zeiss", 593.2882e-9, 2.0 * np.pi / 180.0),
        (fei_text().decode().rstrip("\x00"), "thermo_fisher", 269.792e-9, 0.25),
        (hitachi_text(), "hitachi", 9.921875e-9, 0.0),
        (jeol_text(), "jeol", 0.128 / 50 / 32, None),
    ],
)
def test_conditions_from_the_text_that_imagej_kept(
    tmp_path: Path, text: str, maker: str, pixel_m: float, tilt_rad: float | None
) -> None:
    path = write(tmp_path / "i.tif", None, 1.0, Info=text)
    sem = read_sem_tiff(path)
    assert sem.maker == maker
    # The copy of Zeiss's text lacks the numbers at its head, which have more digits than the 593.3 nm.
    assert sem.pixel_size_m == pytest.approx(pixel_m, rel=1e-4)
    assert sem.stage_tilt_rad == (None if tilt_rad is None else pytest.approx(tilt_rad))
    # The scale of ImageJ counts where it has one, and the contradiction is said.
    other = read_sem_tiff(write(tmp_path / "j.tif", "um", 0.5, Info=text))
    assert other.maker == maker
    assert other.pixel_size_m == pytest.approx(2e-6)
    assert any("the pixel size is ImageJ's, 2e-06 m" in note for note in other.notes)


@pytest.mark.parametrize("white_is_zero", [False, True])
def test_copy_of_32_bits_has_scale_and_conditions(tmp_path: Path, white_is_zero: bool) -> None:
    """What ImageJ saves after a filter; RosettaSciIO reads such copies, too."""
    levels = PIXELS.astype(np.float32) / 7.0
    path = write(tmp_path / "f.tif", "nm", 0.25, np.stack([levels, 2.0 * levels]), Info=jeol_text())
    if white_is_zero:
        data = bytearray(path.read_bytes())
        with tifffile.TiffFile(path) as file:
            order, tag = file.byteorder, file.pages.first.tags["PhotometricInterpretation"]
        data[tag.valueoffset : tag.valueoffset + 2] = struct.pack(order + "H", 0)
        path.write_bytes(data)
    first, second = read_sem_pages(path)
    assert first.image.dtype == np.float32 and first.image.flags.c_contiguous
    assert np.array_equal(first.image, -levels if white_is_zero else levels)
    assert np.array_equal(second.image, 2.0 * levels)
    assert (first.maker, first.pixel_size_m) == ("jeol", pytest.approx(4e-9))
    assert first.metadata()["bits"] == 32
    # Whole numbers of 32 bits are no grey levels of a known range.
    tifffile.imwrite(tmp_path / "u.tif", PIXELS.astype(np.uint32), description="ImageJ=1.54f")
    with pytest.raises(TiffError, match=r"32 bits per sample.*Type > 16-bit"):
        read_page_settings(tmp_path / "u.tif")


def test_text_that_does_not_fit_a_cropped_copy_is_left_out(tmp_path: Path) -> None:
    text = fei_text(columns=64).decode().rstrip("\x00")
    sem = read_sem_tiff(write(tmp_path / "i.tif", "um", 4.0, Info=text))
    assert sem.maker == "imagej"
    with pytest.raises(TiffError, match="without a scale"):
        read_sem_tiff(write(tmp_path / "i.tif", None, 1.0, Info=text))


def test_stack_with_its_frame_interval(tmp_path: Path) -> None:
    stack = np.stack([PIXELS, PIXELS[::-1], PIXELS // 2])
    path = write(tmp_path / "s.tif", "nm", 0.25, stack, finterval=0.5, axes="TYX")
    pages = list(read_sem_pages(path))
    assert [page.page for page in pages] == [0, 1, 2]
    assert all(np.array_equal(page.image, own) for page, own in zip(pages, stack, strict=True))
    assert {page.settings.frame_interval_s for page in pages} == {0.5}
    assert [page.pixel_size_m for page in pages] == pytest.approx([4e-9] * 3)


def test_channels_are_detectors(tmp_path: Path) -> None:
    stack = np.stack([np.stack([PIXELS, 255 - PIXELS])] * 3)
    pages = list(read_sem_pages(write(tmp_path / "c.tif", "nm", 0.25, stack, axes="TCYX")))
    assert [page.detector for page in pages] == ["channel 1", "channel 2"] * 3
    assert np.array_equal(pages[3].image, 255 - PIXELS)
    assert read_sem_tiff(pages[0].path, page=3).settings == pages[3].settings
    assert read_page_settings(pages[0].path)[0][1] == pages[0].settings
    maker = write(tmp_path / "c.tif", "nm", 0.25, stack, axes="TCYX", Info=jeol_text())
    assert [own.detector for _, own, _ in read_page_settings(maker)][:2] == [
        "LED channel 1",
        "LED channel 2",
    ]


def test_stack_without_directories_is_refused(tmp_path: Path) -> None:
    """ImageJ writes stacks above 4 GB with one directory for all."""
    path = tmp_path / "s.tif"
    tifffile.imwrite(
        path,
        PIXELS,
        description="ImageJ=1.53t\nimages=7\nunit=nm\n",
        resolution=(1, 1),
        metadata=None,
    )
    with pytest.raises(TiffError, match=r"7 images in 1 directories.*Image Sequence"):
        read_page_settings(path)
