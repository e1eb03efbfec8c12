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

"""Image files that no microscope described: stacks, videos, patterns, and what the user says about them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from semcal_ros.config.config import load_config
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import BagError, InvalidValueError, SemcalError
from semcal_ros.core.rectification.line_phase import estimate_line_phase
from semcal_ros.files.recordings import RecordedFiles, RecordedFrame, open_recording
from semcal_ros.files.video import open_video
from tests.files.images.test_to_bag import write_tescan

CONFIG = load_config("generic")
RNG = np.random.default_rng(0)
FRAMES = RNG.integers(0, 256, (4, 20, 30), dtype=np.uint8)


def read(given: RecordedFiles | Path) -> tuple[list[RecordedFrame], tuple[str, ...]]:
    with open_recording(given, CONFIG) as recording:
        frames = list(recording.frames())
        assert recording.frame_count == len(frames)
        return frames, recording.notes


def pixel_sizes(frames: list[RecordedFrame]) -> list[float]:
    return [CONFIG.display_width_m / f.magnification / f.image.shape[1] for f in frames]


def intervals_s(frames: list[RecordedFrame]) -> list[float]:
    return (np.diff([f.stamp_ns for f in frames]) * 1e-9).tolist()


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "int16"])
def test_a_plain_stack_needs_its_pixel_size(tmp_path: Path, dtype: str) -> None:
    tifffile.imwrite(tmp_path / "s.tif", FRAMES.astype(dtype), photometric="minisblack")
    with pytest.raises(BagError, match=r"s\.tif without a pixel size.*--pixel-size such as"):
        open_recording(tmp_path / "s.tif", CONFIG)
    frames, notes = read(RecordedFiles(tmp_path / "s.tif", 43.9e-9, frame_interval_s=0.533))
    assert [f.image.tolist() for f in frames] == FRAMES.tolist()
    assert {f.encoding for f in frames} == {
        {"uint8": "mono8", "uint16": "mono16"}.get(dtype, "32FC1")
    }
    assert pixel_sizes(frames) == pytest.approx([43.9e-9] * 4, rel=1e-12)
    assert intervals_s(frames) == pytest.approx([0.533] * 3, rel=1e-9)
    assert any("as given" in note for note in notes)


def test_colours_in_planes_are_those_of_pixels(tmp_path: Path) -> None:
    colours = np.random.default_rng(0).integers(0, 255, (3, 40, 50), dtype=np.uint8)
    planes, mixed = tmp_path / "planes.tif", tmp_path / "mixed.tif"
    tifffile.imwrite(planes, colours, photometric="rgb", planarconfig="separate")
    tifffile.imwrite(mixed, np.moveaxis(colours, 0, -1), photometric="rgb")
    found = [only_image(path) for path in (planes, mixed)]
    np.testing.assert_array_equal(*found)


def test_four_planes_are_four_images_or_one(tmp_path: Path) -> None:
    """What tifffile writes for a stack of four where it is not told that they are grey."""
    path = tmp_path / "stack.tif"
    tifffile.imwrite(
        path, np.zeros((4, 40, 50), np.uint8), photometric="rgb", planarconfig="separate"
    )
    with pytest.raises(SemcalError, match="4 planes"):
        only_image(path)


def only_image(path: Path) -> np.ndarray:
    with open_recording(RecordedFiles(path, pixel_size_m=1e-8), load_config("generic")) as opened:
        (frame,) = opened.frames()
        return frame.image


def test_an_ome_tiff_says_scale_and_interval(tmp_path: Path) -> None:
    tifffile.imwrite(
        tmp_path / "s.ome.tif",
        np.stack([FRAMES, 255 - FRAMES], axis=1),
        ome=True,
        photometric="minisblack",
        metadata={
            "axes": "TCYX",
            "PhysicalSizeX": 43.9,
            "PhysicalSizeXUnit": "nm",
            "PhysicalSizeY": 43.9,
            "PhysicalSizeYUnit": "nm",
            "TimeIncrement": 250.0,
            "TimeIncrementUnit": "ms",
        },
    )
    frames, notes = read(tmp_path / "s.ome.tif")
    assert [f.image.tolist() for f in frames] == FRAMES.tolist()
    assert pixel_sizes(frames) == pytest.approx([43.9e-9] * 4, rel=1e-12)
    assert intervals_s(frames) == pytest.approx([0.25] * 3, rel=1e-9)
    assert any("the first of 2 channels" in note for note in notes)


def test_a_hyperstack_of_imagej(tmp_path: Path) -> None:
    tifffile.imwrite(
        tmp_path / "s.tif",
        np.stack([FRAMES, 255 - FRAMES], axis=1),
        imagej=True,
        resolution=(1 / 0.05, 1 / 0.05),
        metadata={"axes": "TCYX", "unit": "um", "finterval": 0.5},
    )
    frames, notes = read(tmp_path / "s.tif")
    assert [f.image.tolist() for f in frames] == FRAMES.tolist()
    assert pixel_sizes(frames) == pytest.approx([50e-9] * 4, rel=1e-6)
    assert intervals_s(frames) == pytest.approx([0.5] * 3, rel=1e-9)
    assert any("the first of 2 channels" in note for note in notes)


def test_a_video_has_times_and_needs_a_scale(tmp_path: Path) -> None:
    blurred = [
        cv2.GaussianBlur(np.kron(f, np.ones((4, 4))), (0, 0), 3).astype(np.uint8) for f in FRAMES
    ]
    with open_video(tmp_path / "v.avi", (120, 80), 4, 12.5) as video:
        assert video is not None
        for frame in blurred:
            video.write(frame, "")
    frames, _ = read(RecordedFiles(tmp_path / "v.avi", magnification=5000.0))
    assert [f.magnification for f in frames] == [5000.0] * 4
    assert intervals_s(frames) == pytest.approx([0.08] * 3, rel=1e-6)
    for frame, written in zip(frames, blurred, strict=True):
        # JPEG at its best quality; the caption covers the bottom.
        error = frame.image[:50].astype(float) - written[:50]
        assert np.sqrt(np.mean(error**2)) < 2.0
    with pytest.raises(BagError, match="a video does not contain it"):
        open_recording(tmp_path / "v.avi", CONFIG)


def test_a_pattern_a_list_and_a_folder_are_the_same(tmp_path: Path) -> None:
    for k, frame in enumerate(FRAMES):
        cv2.imwrite(str(tmp_path / f"i{9 + k}.png"), frame)
    (tmp_path / "notes.txt").write_text("x")
    pattern = read(RecordedFiles(tmp_path / "i*.png", 1e-8))
    listed = read(RecordedFiles([tmp_path / f"i{9 + k}.png" for k in range(4)], 1e-8))
    folder = read(RecordedFiles(tmp_path, 1e-8))
    for frames, notes in (pattern, listed, folder):
        assert [f.image.tolist() for f in frames] == FRAMES.tolist()
        assert intervals_s(frames) == [1.0] * 3
        assert any("--frame-interval" in note for note in notes)
    with pytest.raises(BagError, match=r"no image file is called .*j\*\.png"):
        open_recording(tmp_path / "j*.png", CONFIG)
    with pytest.raises(BagError, match="does not have the name of an image"):
        open_recording(tmp_path / "notes.txt", CONFIG)


def test_a_photograph_says_when_it_was_taken(tmp_path: Path) -> None:
    for k, time in enumerate(("2024:05:01 10:00:07", "2024:05:01 10:00:02")):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = time
        Image.fromarray(FRAMES[k]).save(tmp_path / f"{k}.jpg", exif=exif, quality=100)
    frames, _ = read(RecordedFiles(tmp_path, 1e-5))
    assert [f.file_name for f in frames] == ["1.jpg", "0.jpg"]
    assert intervals_s(frames) == [5.0]


def test_a_region_keeps_the_pixel_size(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", FRAMES, photometric="minisblack")
    frames, _ = read(RecordedFiles(tmp_path / "s.tif", 1e-8, roi=(3, 2, 15, 10)))
    assert frames[1].image.tolist() == FRAMES[1][2:12, 3:18].tolist()
    assert pixel_sizes(frames) == pytest.approx([1e-8] * 4, rel=1e-12)
    with pytest.raises(BagError, match="--roi X,Y,WIDTH,HEIGHT within it"):
        read(RecordedFiles(tmp_path / "s.tif", 1e-8, roi=(20, 2, 15, 10)))


def test_the_databar_is_cut_as_given(tmp_path: Path) -> None:
    write_tescan(tmp_path / "t.tif", 1e-8, (20, 30), bar=4)
    assert read(tmp_path / "t.tif")[0][0].image.shape == (16, 30)
    assert read(RecordedFiles(tmp_path / "t.tif", databar_rows=0))[0][0].image.shape == (20, 30)


def test_the_user_knows_better_than_the_file(tmp_path: Path) -> None:
    write_tescan(tmp_path / "t.tif", 1e-8, (20, 30))
    frames, notes = read(RecordedFiles(tmp_path / "t.tif", pixel_size_m=2e-8))
    assert pixel_sizes(frames) == pytest.approx([2e-8])
    assert any("instead of 10 nm, which 1 file says" in note for note in notes)
    with pytest.raises(BagError, match="which contains its own"):
        open_recording(RecordedFiles(tmp_path / "t.tif", magnification=100.0), CONFIG)


def test_files_without_a_scale_are_left_out_where_others_have_one(tmp_path: Path) -> None:
    write_tescan(tmp_path / "a.tif", 1e-8, (20, 30))
    for name in "bc":
        cv2.imwrite(str(tmp_path / f"{name}.png"), FRAMES[0])
    frames, notes = read(tmp_path)
    assert [f.file_name for f in frames] == ["a.tif"]
    assert sum("no pixel size" in note for note in notes) == 1
    assert any("2 files such as b.png are skipped" in note for note in notes)


def test_a_magnification_may_refer_to_another_display(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), FRAMES[0])
    given = RecordedFiles(tmp_path / "a.png", magnification=1000.0, display_width_m=0.3)
    (frame,), _ = read(given)
    assert frame.magnification * 0.3 == pytest.approx(1000.0 * CONFIG.display_width_m)


@pytest.mark.parametrize(
    "wrong",
    [
        {"pixel_size_m": 0.0},
        {"pixel_size_m": float("nan")},
        {"magnification": -1.0},
        {"frame_interval_s": -1.0},
        {"databar_rows": -1},
        {"roi": (0, 0, 0, 5)},
        {"roi": (-1, 0, 5, 5)},
        {"display_width_m": 0.0},
        {"pixel_size_m": 1e-9, "magnification": 100.0},
    ],
)
def test_impossible_numbers_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidValueError):
        RecordedFiles("x", **wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("suffix", [".tif", ".png", ".mp4", ".avi", ".jpg"])
@pytest.mark.parametrize("content", [b"", b"x" * 100, b"II*\x00" + b"\xff" * 50])
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    with pytest.raises(SemcalError) as caught:
        read(RecordedFiles(path, 1e-8))
    assert "\n" not in str(caught.value)


def test_an_image_that_is_damaged_is_left_out(tmp_path: Path) -> None:
    tifffile.imwrite(
        tmp_path / "s.tif", FRAMES, photometric="minisblack", compression="deflate", rowsperstrip=20
    )
    with tifffile.TiffFile(tmp_path / "s.tif") as file:
        offset = file.pages[2].dataoffsets[0]
    data = bytearray((tmp_path / "s.tif").read_bytes())
    data[offset : offset + 50] = bytes(50)
    (tmp_path / "s.tif").write_bytes(data)
    with open_recording(RecordedFiles(tmp_path / "s.tif", 1e-8), CONFIG) as recording:
        frames = list(recording.frames())
        assert [f.image.tolist() for f in frames] == FRAMES[:2].tolist()
        assert len(recording.rejected) == 2


@pytest.mark.parametrize("suffix", ["bmp", "png"])
def test_a_picture_that_ends_early_costs_that_picture_only(tmp_path: Path, suffix: str) -> None:
    for k, frame in enumerate(FRAMES):
        cv2.imwrite(str(tmp_path / f"{k}.{suffix}"), frame)
    cut = tmp_path / f"2.{suffix}"
    cut.write_bytes(cut.read_bytes()[:-200])
    with open_recording(RecordedFiles(tmp_path, 1e-8), CONFIG) as recording:
        frames = list(recording.frames())
    assert [f.image.tolist() for f in frames] == FRAMES[[0, 1, 3]].tolist()


@pytest.mark.parametrize("declared", [True, False])
def test_lines_of_a_bidirectional_scan_are_moved_back_where_declared(
    tmp_path: Path, declared: bool
) -> None:
    x = np.arange(128.0)
    rng = np.random.default_rng(3)
    clean = cv2.GaussianBlur(rng.normal(size=(64, 128)), (0, 0), 2.0)
    clean = 120.0 + 30.0 * clean / clean.std()
    both = clean.copy()
    both[1::2] = [np.interp(x - 2.0, x, line) for line in clean[1::2]]
    noisy = [np.clip(both + rng.normal(0, 3, both.shape), 0, 255) for _ in range(3)]
    path = tmp_path / "lines.tif"
    tifffile.imwrite(path, np.array(noisy).astype(np.uint8), photometric="minisblack")
    config = replace(CONFIG, scan=ScanTiming(1.0, bidirectional=declared))
    with open_recording(RecordedFiles(path, 43.9e-9), config) as recording:
        frames = list(recording.frames())
        (note,) = [text for text in recording.notes if "odd lines" in text]
        (_, later) = next(recording.frames_from(2))
    assert ("moved back" in note) is declared
    assert np.array_equal(later.image, noisy[2].astype(np.uint8)) is not declared
    left = estimate_line_phase(frames[-1].image)
    assert abs(left.shift_px - (0.0 if declared else 2.0)) < 0.1
