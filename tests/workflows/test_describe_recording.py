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

"""What a recording contains, against recordings whose contents are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from semcal_ros.files.recordings import RecordedFiles, open_recording
from semcal_ros.files.video import VIDEO_SUFFIXES, open_video
from semcal_ros.workflows import describe_recording as module
from semcal_ros.workflows.describe_recording import describe_recording
from semcal_ros.workflows.simulate import simulate
from tests.files.images.test_to_bag import write_tescan

RNG = np.random.default_rng(3)


def _images(count: int, levels: int = 256, dtype: str = "uint8") -> list[Any]:
    return list(RNG.integers(0, levels, (count, 24, 32)).astype(dtype))


def test_scale_visits_and_intervals_of_images_in_memory() -> None:
    """Magnifications 500, 1000, 500: 0.12 m / 500 = 240 um over 32 px."""
    frames = [
        (image, g, t)
        for image, g, t in zip(
            _images(6),
            (500.0, 500.0, 1000.0, 1000.0, 500.0, 500.0),
            (0.0, 0.5, 1.0, 1.5, 2.0, 2.5),
            strict=True,
        )
    ]
    found = describe_recording(frames)
    low, high = found.settings
    assert (low.frames, low.visits, high.frames, high.visits) == (4, 2, 2, 1)
    assert low.field_width_m == pytest.approx(240e-6, rel=1e-12)
    assert low.pixel_size_m == pytest.approx(7.5e-6, rel=1e-12)
    assert found.scale_source == "display width 0.12 m of the configuration generic"
    assert found.intervals is not None
    assert found.intervals.median_s == pytest.approx(0.5, rel=1e-9)
    assert (found.intervals.gaps, found.intervals.equal_stamps, found.equal_pixels) == (0, 0, 0)
    assert found.file_bytes is None and found.first_time is None
    assert (found.decoded, found.compared) == (6, 5)


def test_gaps_repeated_frames_and_equal_stamps_are_counted() -> None:
    images = _images(10)
    images[4] = images[3].copy()
    times = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 6.0, 9.0, 10.0]
    found = describe_recording([(i, 100.0, t) for i, t in zip(images, times, strict=True)])
    assert found.equal_pixels == 1
    times_found = found.intervals
    assert times_found is not None and times_found.regular
    assert (times_found.gaps, times_found.missing) == (1, 2)
    assert (times_found.equal_stamps, times_found.backwards) == (1, 0)
    assert (times_found.least_s, times_found.greatest_s) == pytest.approx((0.0, 3.0))


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: _images(2), (8, 8)),
        (lambda: _images(2, 4096, "uint16"), (16, 12)),
        (lambda: [16 * i for i in _images(2, 4096, "uint16")], (16, 12)),
        (lambda: _images(2, 65536, "uint16"), (16, 16)),
        (lambda: _images(2, 1000, "uint16"), (16, 10)),
    ],
)
def test_the_bits_that_are_used_are_recognised(make: Any, expected: tuple[int, int]) -> None:
    images = make()
    images[0][:12] = images[0].max()  # half of one of two images: a quarter
    (levels,) = describe_recording([(image, 100.0) for image in images]).grey_levels
    assert (levels.stored_bits, levels.used_bits) == expected
    assert levels.highest == max(int(image.max()) for image in images)


def test_saturated_pixels_are_counted() -> None:
    """12 bits in the upper ones of 16: white is 65520."""
    images = [16 * image for image in _images(2, 4000, "uint16")]
    images[0][:12] = 65520
    images[1][:6] = 0
    (levels,) = describe_recording([(image, 100.0) for image in images]).grey_levels
    assert levels.white_fraction == pytest.approx(0.25, abs=1e-9)
    assert levels.black_fraction == pytest.approx(0.125, abs=0.01)
    floats = [image.astype(np.float32) / 2 for image in images]
    (levels,) = describe_recording([(image, 100.0) for image in floats]).grey_levels
    assert (levels.used_bits, levels.highest) == (None, 32760.0)


def test_the_files_of_a_microscope_tell_how_they_were_taken(tmp_path: Path) -> None:
    told = "HV=5000.0\nWD=0.0091\nStageTilt={}\n"
    write_tescan(tmp_path / "a.tif", 1e-8, (20, 30), "10:00:00", angles=told.format(0.0))
    write_tescan(tmp_path / "b.tif", 2e-8, (20, 30), "10:00:05", angles=told.format(20.0))
    found = describe_recording(tmp_path)
    assert [s.pixel_size_m for s in found.settings] == pytest.approx([2e-8, 1e-8])
    assert found.scale_source == "the pixel size in the files"
    assert found.conditions["maker"] == ("tescan",)
    assert found.conditions["acceleration_voltage_v"] == (5000.0, 5000.0)
    assert found.conditions["working_distance_m"] == pytest.approx((0.0091, 0.0091))
    assert found.conditions["stage_tilt_rad"] == pytest.approx((0.0, np.radians(20.0)))
    assert found.last_time is not None and found.last_time.endswith("10:00:05")
    assert found.file_bytes == sum(path.stat().st_size for path in tmp_path.iterdir())


def _write_png(folder: Path) -> Path:
    cv2.imwrite(str(folder / "a.png"), _images(1)[0])
    return folder / "a.png"


def _write_stack(folder: Path) -> Path:
    tifffile.imwrite(folder / "s.tif", np.array(_images(4)), photometric="minisblack")
    return folder / "s.tif"


def _write_video(folder: Path) -> Path:
    with open_video(folder / "v.avi", (32, 24), 3, 10.0) as film:
        assert film is not None
        for image in _images(3):
            film.write(image, "")
    assert ".avi" in VIDEO_SUFFIXES
    return folder / "v.avi"


def _write_many(folder: Path) -> Path:
    for k, image in enumerate(_images(3)):
        cv2.imwrite(str(folder / f"p{k}.png"), image)
    return folder / "p*.png"


@pytest.mark.parametrize(
    ("write", "count"), [(_write_png, 1), (_write_stack, 4), (_write_video, 3), (_write_many, 3)]
)
def test_every_kind_of_file_is_described(tmp_path: Path, write: Any, count: int) -> None:
    found = describe_recording(RecordedFiles(write(tmp_path), pixel_size_m=43.9e-9))
    assert found.frame_count == count == found.decoded
    assert found.settings[0].pixel_size_m == pytest.approx(43.9e-9, rel=1e-9)
    assert found.scale_source == "the pixel size given"
    assert found.file_bytes is not None and found.file_bytes > 100
    assert (found.intervals is None) == (count == 1)
    assert found.grey_levels[0].stored_bits == 8


def test_without_a_scale_the_rest_is_told(tmp_path: Path) -> None:
    found = describe_recording(_write_stack(tmp_path))
    assert found.settings == () and found.magnifications == ()
    assert found.scale_source.startswith("not known (s.tif without a pixel size: ")
    assert "state it with --pixel-size" in found.scale_source
    assert (found.frame_count, found.grey_levels[0].stored_bits) == (4, 8)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("info") / "bag"
    simulate(path, "drift", microscope="ideal", specimen="gold", frames=12, size=32)
    return path


def test_a_bag_is_described(bag: Path) -> None:
    found = describe_recording(bag)
    assert found.frame_count == found.decoded == 12
    assert found.kinds == {"32 x 32 mono8": 12}
    assert found.scale_source.startswith("recorded magnifications, display width 0.12 m")
    assert found.file_bytes == sum(p.stat().st_size for p in bag.rglob("*") if p.is_file())
    assert found.intervals is not None and found.intervals.regular
    given = describe_recording(RecordedFiles(bag, roi=(0, 0, 16, 8)))
    assert given.kinds == {"16 x 8 mono8": 12}
    assert given.settings[0].pixel_size_m == found.settings[0].pixel_size_m


def test_of_long_recordings_only_some_images_are_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames 0, 1 and 8, 9 of ten, with the stamps and sizes of all."""
    images = _images(10)
    images[9] = images[8]
    images[5] = images[4]
    images[4][0, 0] = 255
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"p{k}.png"), image)
    monkeypatch.setattr(module, "_MOST_DECODED", 4)
    found = describe_recording(RecordedFiles(tmp_path, magnification=100.0))
    assert (found.frame_count, found.decoded, found.compared) == (10, 4, 2)
    assert found.equal_pixels == 1
    assert found.kinds == {"32 x 24 mono8": 10}
    in_memory = describe_recording([(image, 100.0) for image in images])
    assert (in_memory.decoded, in_memory.compared, in_memory.equal_pixels) == (4, 9, 2)


def test_outlines_agree_with_frames(bag: Path) -> None:
    with open_recording(bag) as opened:
        outlines = list(opened.outlines({0}))
        for outline, frame in zip(outlines, opened.frames(), strict=True):
            assert replace(outline, image=None, digest=None) == replace(
                outline,
                stamp_ns=frame.stamp_ns,
                magnification=frame.magnification,
                size_px=(frame.image.shape[1], frame.image.shape[0]),
                encoding=frame.encoding,
                image=None,
                digest=None,
            )
            assert outline.image is not None  # uncompressed: it costs nothing
        assert len({outline.digest for outline in outlines}) == 12
