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

"""Videos: what browsers play, grey levels that come back, nothing half-written."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from semcal_ros.core.errors import BagError
from semcal_ros.files.video import open_video, shade

WIDTH, HEIGHT = 160, 120
TEXT_ROWS = 40  # at the bottom
BLACK, WHITE = 30.0, 190.0


def pictures(count: int) -> list[np.ndarray]:
    """Smooth bodies that move by a pixel a frame, with noise of 2.3 grey levels of 200."""
    rng = np.random.default_rng(4)
    texture = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH + count)), (0, 0), 4)
    texture = 200.0 * (texture - texture.min()) / np.ptp(texture)
    clean = [texture[:, k : k + WIDTH] for k in range(count)]
    return [(p + rng.normal(0.0, 2.3, p.shape)).astype(np.float32) for p in clean]


def write(path: Path, frames: list[np.ndarray], expected: int | None = None) -> None:
    count = len(frames) if expected is None else expected
    with open_video(path, (WIDTH, HEIGHT), count, 12.5) as video:
        assert video is not None
        for number, frame in enumerate(frames):
            video.write(shade(frame, (BLACK, WHITE)), f"frame {number}")


def read(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]


@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "h264"), (".avi", "mjpeg")])
def test_frames_come_back(tmp_path: Path, suffix: str, codec: str) -> None:
    frames, path = pictures(20), tmp_path / f"v{suffix}"
    write(path, frames)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == codec
        assert stream.average_rate == 12.5
    found = read(path)
    assert len(found) == len(frames)
    for before, after in zip(frames, found, strict=True):
        shown = np.clip((before[:-TEXT_ROWS] - BLACK) * 255.0 / (WHITE - BLACK), 0.0, 255.0)
        error = after[:-TEXT_ROWS] - shown
        # The codec smooths away noise of 3.7 levels at most; a wrong range of levels (16 to 235
        # instead of 0 to 255) would be off by 10 on the average.
        assert np.sqrt(np.mean(error**2)) < 5.0
        assert abs(np.mean(error)) < 1.0
    assert np.ptp(found[0][-TEXT_ROWS:].astype(int)) > 200  # the caption, white with a black edge


def test_a_browser_can_begin_before_it_has_everything(tmp_path: Path) -> None:
    write(tmp_path / "v.mp4", pictures(5))
    data = (tmp_path / "v.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    with av.open(str(tmp_path / "v.mp4")) as container:
        assert container.streams.video[0].codec_context.pix_fmt == "yuv420p"


@contextmanager
def full_disk(free: int) -> Iterator[None]:
    """Files of this process can grow to this number of bytes only."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_a_full_disk_leaves_what_was_there(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"v{suffix}"
    path.write_bytes(b"old")
    with pytest.raises(BagError, match="free space"), full_disk(20_000):
        write(path, pictures(40))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_missing_frames_are_noticed(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="4 of 5 frames"):
        write(tmp_path / "v.mp4", pictures(4), expected=5)
    assert not list(tmp_path.iterdir())
