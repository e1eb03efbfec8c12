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

"""Files of several images: all of them are read, each with its settings."""

from __future__ import annotations

import logging
import struct
import threading
from pathlib import Path

import numpy as np
import pytest
import tifffile

from semcal_ros.core.errors import TiffError
from semcal_ros.files.tiff.read import (
    open_tiff,
    read_page_settings,
    read_sem_pages,
    read_sem_tiff,
)
from tests.helpers.sem_files import zeiss_text

PIXELS = (np.arange(20 * 32) % 251).astype(np.uint8).reshape(20, 32)
TIMES = ("22:42:02", "22:45:19", "22:48:40")


def write(path: Path, compression: str | None = None) -> Path:
    """Three images as SmartSEM writes them: a tag for each."""
    with tifffile.TiffWriter(path) as file:
        for index, clock in enumerate(TIMES):
            data = zeiss_text(changes={"AP_TIME": f"Time :{clock}"})
            file.write(
                PIXELS + np.uint8(index),
                contiguous=False,
                metadata=None,
                compression=compression,
                extratags=[(34118, 2, len(data), data, True)],
            )
    return path


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_all_pages_with_their_own_settings(tmp_path: Path, compression: str | None) -> None:
    path = write(tmp_path / "z.tif", compression)
    pages = list(read_sem_pages(path, databar_rows=2))
    for index, page in enumerate(pages):
        assert page.page == page.metadata()["page"] == index
        assert np.array_equal(page.image, PIXELS[:18] + np.uint8(index))
        assert page.time is not None
        assert page.time.strftime("%H:%M:%S") == TIMES[index]
        alone = read_sem_tiff(path, page=index, databar_rows=2)
        assert np.array_equal(alone.image, page.image)
        assert alone.settings == page.settings
    listed = read_page_settings(path)
    assert listed == tuple((page.page, page.settings, (32, 20)) for page in pages)
    assert len(pages) == 3


def test_later_pages_packed_by_lzw(tmp_path: Path) -> None:
    """Pillow writes what tifffile needs a further package for."""
    image = pytest.importorskip("PIL.Image")
    frames = [image.fromarray(PIXELS + np.uint8(index)) for index in range(3)]
    plain = tmp_path / "l.tif"
    frames[0].save(plain, save_all=True, append_images=frames[1:], compression="tiff_lzw")
    (tmp_path / "l.hdr").write_text("PixelSizeX=1e-9\nPixelSizeY=1e-9\n")
    pages = list(read_sem_pages(plain))
    assert [int(page.image[0, 1]) for page in pages] == [1, 2, 3]
    assert {page.pixel_size_m for page in pages} == {1e-9}


def test_previews_are_left_out(tmp_path: Path) -> None:
    data, path = zeiss_text(), tmp_path / "z.tif"
    with tifffile.TiffWriter(path) as file:
        file.write(PIXELS, metadata=None, extratags=[(34118, 2, len(data), data, True)])
        file.write(PIXELS[::2, ::2], metadata=None, subfiletype=1)
        file.write(255 - PIXELS, metadata=None)
    pages = list(read_sem_pages(path))
    assert [page.page for page in pages] == [0, 2]
    assert np.array_equal(pages[1].image, 255 - PIXELS)


def test_a_page_of_another_size_without_metadata_is_refused(tmp_path: Path) -> None:
    data, path = zeiss_text(), tmp_path / "z.tif"
    with tifffile.TiffWriter(path) as file:
        file.write(PIXELS, metadata=None, extratags=[(34118, 2, len(data), data, True)])
        file.write(PIXELS[::2, ::2], metadata=None)
    with pytest.raises(TiffError, match=r"image 2 in z\.tif is 16 x 10 pixels without metadata"):
        list(read_sem_pages(path))
    with pytest.raises(TiffError, match=r"image 2 in z\.tif is 16 x 10 pixels without metadata"):
        read_sem_tiff(path, page=1)
    assert np.array_equal(read_sem_tiff(path).image, PIXELS)


def test_damage_in_a_later_directory_is_an_error_of_ours(tmp_path: Path) -> None:
    path = write(tmp_path / "z.tif")
    with tifffile.TiffFile(path) as file:
        tag = file.pages[1].tags["ImageWidth"]
        place = tag.offset + 4
    data = bytearray(path.read_bytes())
    data[place : place + 4] = struct.pack("<I", 2**31)
    path.write_bytes(data)
    with pytest.raises(TiffError, match="values in tag 256"):
        read_page_settings(path)
    with pytest.raises(TiffError, match="values in tag 256"):
        read_sem_tiff(path, page=1)
    assert np.array_equal(read_sem_tiff(path).image, PIXELS)


def test_directories_in_a_loop_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "z.tif")
    with tifffile.TiffFile(path) as file:
        offsets = [page.offset for page in file.pages]
        last = file.pages[2]
        place = offsets[2] + 2 + 12 * len(last.tags)
    data = bytearray(path.read_bytes())
    data[place : place + 4] = struct.pack("<I", offsets[0])
    path.write_bytes(data)
    with pytest.raises(TiffError, match="3 directories in a loop"):
        read_page_settings(path)
    data[place : place + 4] = struct.pack("<I", len(data) + 8)
    path.write_bytes(data)
    with pytest.raises(TiffError, match=r"z\.tif"):
        list(read_sem_pages(path))


def test_a_directory_that_the_parser_drops_is_missed(tmp_path: Path) -> None:
    """One of 5000 tags, which tifffile holds for a wrong offset: it ends the file there, without an error."""
    path = write(tmp_path / "z.tif")
    with tifffile.TiffFile(path) as file:
        place = file.pages[2].offset + 2 + 12 * len(file.pages[2].tags)
    data = bytearray(path.read_bytes())
    data += bytes(len(data) % 2)
    data[place : place + 4] = struct.pack("<I", len(data))
    data += struct.pack("<H", 5000) + struct.pack("<HHII", 700, 4, 1, 0) * 5000 + bytes(4)
    path.write_bytes(data)
    with pytest.raises(TiffError, match="4 directories, of which only 3 can be read"):
        read_page_settings(path)


def test_reading_page_by_page_leaves_the_loggers_alone(tmp_path: Path) -> None:
    pages = read_sem_pages(write(tmp_path / "z.tif"))
    next(pages)
    assert not logging.getLogger("tifffile").disabled
    pages.close()


def test_threads_that_read_at_once_leave_the_loggers_alone(tmp_path: Path) -> None:
    """The one that begins first ends first, while the parsers are still quiet for the other."""
    path = write(tmp_path / "z.tif")
    begun, other_begun, ended = (threading.Event() for _ in range(3))

    def read_first() -> None:
        with open_tiff(path):
            begun.set()
            other_begun.wait()
        ended.set()

    thread = threading.Thread(target=read_first)
    thread.start()
    begun.wait()
    with open_tiff(path):
        other_begun.set()
        ended.wait()
    thread.join()
    assert not logging.getLogger("tifffile").disabled


def test_a_page_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(TiffError, match=r"z\.tif"):
        read_sem_tiff(write(tmp_path / "z.tif"), page=3)
