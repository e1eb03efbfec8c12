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

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from semcal_ros.config.config import load_config
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.files.images.write import (
    PixelScale,
    open_image_folder,
    open_tiff_stack,
    write_image,
)
from semcal_ros.files.recordings import RecordedFrame, open_recording

START_NS = 1_700_000_000_123_456_000
RNG = np.random.default_rng(2)
GREY = RNG.integers(0, 250, (64, 200)).astype(np.uint8)
SCALE = PixelScale(43.9e-9, 0.05e-9)


def read(path: Path) -> list[RecordedFrame]:
    with open_recording(path, load_config("generic")) as recording:
        return list(recording.frames())


def pixel_size_m(frame: RecordedFrame) -> float:
    width = load_config("generic").display_width_m
    return width / (frame.magnification * frame.image.shape[1])


@pytest.mark.parametrize("databar", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_a_stack_comes_back_with_scale_times_and_depth(
    tmp_path: Path, dtype: type, databar: bool
) -> None:
    images = [(GREY + k).astype(dtype) * (17 if dtype is np.uint16 else 1) for k in range(3)]
    stamps = [START_NS, START_NS + 533_000_000, START_NS + 1_100_000_000]
    with open_tiff_stack(tmp_path / "s.tif", databar=databar) as stack:
        for image, stamp_ns in zip(images, stamps, strict=True):
            stack.write(image, stamp_ns, SCALE)
    found = read(tmp_path / "s.tif")
    for frame, image, stamp_ns in zip(found, images, stamps, strict=True):
        # Without the databar, which the file says it has.
        np.testing.assert_array_equal(frame.image, image)
        assert frame.image.dtype == dtype
        assert pixel_size_m(frame) == pytest.approx(43.9e-9, rel=1e-9)
        # Times of files are used to the ms.
        assert abs(frame.stamp_ns - stamp_ns) < 1_000_000


def test_other_programs_read_pixel_size_and_colours(tmp_path: Path) -> None:
    colour = RNG.integers(0, 255, (40, 50, 3)).astype(np.uint8)
    write_image(tmp_path / "c.tif", colour, SCALE, stamp_ns=START_NS)
    with tifffile.TiffFile(tmp_path / "c.tif") as file:
        np.testing.assert_array_equal(file.asarray(), colour)
        assert file.is_ome and file.series[0].axes == "YXS"
        # What ImageJ goes by.
        tags = file.pages[0].tags
        assert tags["ResolutionUnit"].value == 3  # cm
        assert np.divide(*tags["XResolution"].value) == pytest.approx(0.01 / 43.9e-9, rel=1e-6)
        assert tags["DateTime"].value == "2023:11:14 22:13:20"
    write_image(tmp_path / "c.png", colour, SCALE)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "c.png"))[..., ::-1], colour)


def test_a_png_keeps_16_bits(tmp_path: Path) -> None:
    deep = GREY.astype(np.uint16) * 257
    write_image(tmp_path / "d.png", deep, SCALE)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED), deep)
    with pytest.raises(InvalidValueError, match=r"a \.tif, which holds"):
        write_image(tmp_path / "f.png", GREY.astype(np.float32), SCALE)
    assert not (tmp_path / "f.png").exists()


def test_a_stack_has_one_kind_of_image_and_one_pixel_size(tmp_path: Path) -> None:
    path = tmp_path / "s.tif"
    path.write_bytes(b"old")
    two_sizes = r"43\.9 and 21\.95 nm per px.*end its name with /"
    with pytest.raises(InvalidValueError, match=two_sizes), open_tiff_stack(path) as stack:
        stack.write(GREY, START_NS, SCALE)
        stack.write(GREY, START_NS, PixelScale(21.95e-9))
    two_kinds = "images of 200 x 64 uint8 and of 200 x 32 uint8"
    with pytest.raises(InvalidValueError, match=two_kinds), open_tiff_stack(path) as stack:
        stack.write(GREY, START_NS, SCALE)
        stack.write(GREY[:32], START_NS, SCALE)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["s.tif"]


def test_a_folder_has_a_file_per_image(tmp_path: Path) -> None:
    with open_image_folder(tmp_path / "out") as folder:
        folder.write(GREY, START_NS, SCALE, source_name="scan_a.tif")
        folder.write(GREY, START_NS, SCALE, source_name="scan_a.tif")  # its second page
        folder.write(GREY, START_NS, PixelScale(1e-9))
    names = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert names == ["frame_000003.tif", "scan_a.tif", "scan_a_000002.tif"]
    with pytest.raises(BagError, match="exists"), open_image_folder(tmp_path / "out"):
        pass
    with open_image_folder(tmp_path / "out", overwrite=True) as folder:
        folder.write(GREY, START_NS, SCALE)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["frame_000001.tif"]
    # As a microscope saves it: a TIFF, and not from here.
    cv2.imwrite(str(tmp_path / "out" / "hers.tif"), GREY)
    with (
        pytest.raises(BagError, match="other than TIFFs of semcal"),
        open_image_folder(tmp_path / "out", overwrite=True),
    ):
        pass
    (tmp_path / "out" / "hers.tif").unlink()
    (tmp_path / "out" / "notes.txt").write_text("hers")
    foreign = pytest.raises(BagError, match="something other than TIFFs")
    with foreign, open_image_folder(tmp_path / "out", overwrite=True):
        pass
    with pytest.raises(RuntimeError), open_image_folder(tmp_path / "other"):
        raise RuntimeError
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]
