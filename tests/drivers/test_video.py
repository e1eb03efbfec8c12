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

"""A video file or device as the source of frames."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from semcal_ros.core.errors import MicroscopeError, UnusableFrameError
from semcal_ros.drivers.source import SourceFrame
from semcal_ros.drivers.video import SideFile, VideoSource
from semcal_ros.files.video import VideoWriter
from tests.helpers.sem_files import number_in, numbered_image

RATE_HZ = 20.0


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "film.mp4"
    video = VideoWriter(path, (128, 96), RATE_HZ)
    for number in range(10):
        video.write(numbered_image(number), "")
    video.finish()
    video.release()
    return path


def read(source: VideoSource) -> SourceFrame:
    until_s = time.monotonic() + 10.0
    while time.monotonic() < until_s:
        if (frame := source.read(0.2)) is not None:
            return frame
    raise AssertionError("no frame")


def test_a_file_is_played_at_its_own_rate(film: Path) -> None:
    source = VideoSource(str(film), lambda: 1e-5)
    assert "stamps are those of arrival" in source.open()
    begun_ns = time.time_ns()
    frames = [read(source) for _ in range(10)]
    assert [number_in(frame.image) for frame in frames] == list(range(10))
    assert frames[0].image.dtype == np.uint8 and frames[0].image.shape == (96, 128)
    assert begun_ns <= frames[0].start_ns <= frames[-1].start_ns <= time.time_ns()
    # Nine intervals; a busy machine makes them longer, never shorter.
    assert (frames[-1].start_ns - frames[0].start_ns) * 1e-9 > 8.5 / RATE_HZ
    assert {frame.field_width_m for frame in frames} == {1e-5}
    with pytest.raises(UnusableFrameError, match="has ended"):
        read(source)
    assert source.read(0.01) is None
    # ~/stop and ~/start play it again.
    source.close()
    source.open()
    assert number_in(read(source).image) == 0
    source.close()
    source.close()


@pytest.mark.parametrize("name", ["missing.mp4", "/dev/video_missing", "text.mp4"])
def test_what_is_no_video(name: str, tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    source = VideoSource(name if name.startswith("/") else str(tmp_path / name), lambda: None)
    with pytest.raises(MicroscopeError, match="FFmpeg"):
        source.open()
    source.close()


def test_a_side_file_says_the_magnification(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("semcal_ros.drivers.video._EXAMINE_S", 0.0)
    path = tmp_path / "mag.txt"
    side = SideFile(path, 0.12)
    assert side.field_width_m() is None
    for text, width_m in (
        ("magnification: 5000\n", 2.4e-5),
        ("# by the macro of the microscope\n\nfield_width_m = 1.5e-5  # m\n", 1.5e-5),
        ("12000", 1e-5),
    ):
        path.write_text(text)
        assert side.field_width_m() == pytest.approx(width_m)
    for wrong in ("", "5 kV", "magnification: -3", "magnification: 1e999", "field_width_m: x"):
        path.write_text(wrong + " \n")
        with pytest.raises(UnusableFrameError, match="magnification: 5000"):
            side.field_width_m()
        # Said once; what was there before holds no longer.
        assert side.field_width_m() is None
    path.unlink()
    assert side.field_width_m() is None
