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

"""A recording in the viewer: every frame can be gone to, played, and is corrected for its drift."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import load_config
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.files.recordings import RecordedFiles, open_recording
from semcal_ros.viewer.recording import RecordingSource
from semcal_ros.workflows.inputs import resolve_config
from tests.helpers.node_scenes import make_calibration, texture, write_recording

CALIBRATION = make_calibration()
COUNT = 12
PERIOD_S = 0.05


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "recording"
    write_recording(path, [1000.0 + 100.0 * k for k in range(COUNT)], PERIOD_S)
    return path


def wait_for(condition: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + 20.0
    while not (value := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return value


def show(
    path: Any, calibration: Calibration | None = CALIBRATION, *, drift: bool = False
) -> RecordingSource:
    config = resolve_config(None, calibration)
    return RecordingSource(lambda: open_recording(path, config), calibration, config, drift=drift)


@pytest.fixture
def source(bag: Path) -> Iterator[RecordingSource]:
    made = show(bag)
    yield made
    made.close()


def test_any_frame_can_be_gone_to(source: RecordingSource) -> None:
    wait_for(source.newest)
    for index in (7, 2, 11, 0, 1):
        source.act("seek", float(index))
        view = wait_for(lambda k=index: (v := source.newest()) and v.name == f"frame {k + 1}" and v)
        np.testing.assert_array_equal(view.pictures["raw"], texture(index))
        camera = CALIBRATION.at(1000.0 + 100.0 * index)
        flat = CALIBRATION.rectify(texture(index), camera.magnification)
        np.testing.assert_array_equal(view.pictures["corrected"], flat)
        timeline = source.describe().timeline
        assert timeline is not None
        assert (timeline.index, timeline.count) == (index, COUNT)
        assert timeline.time_s == pytest.approx(index * PERIOD_S, abs=1e-6)
        assert source.describe().magnification.text.startswith(f"{1000 + 100 * index}")
    source.act("seek", 1e9)
    wait_for(lambda: source.newest().name == f"frame {COUNT}")  # type: ignore[union-attr]
    wait_for(lambda: source.describe().timeline.duration_s == pytest.approx(0.55, abs=1e-6))  # type: ignore[union-attr]


def test_it_plays_in_its_own_time_to_its_end_and_again(source: RecordingSource) -> None:
    for _ in range(2):
        assert source.act("play", None) == "playing"
        began_s = time.monotonic()
        wait_for(lambda: source.describe().timeline.playing)  # type: ignore[union-attr]
        wait_for(lambda: not source.describe().timeline.playing)  # type: ignore[union-attr]
        # Eleven intervals of 50 ms; a busy machine takes longer.
        assert time.monotonic() - began_s > 0.5
        assert source.describe().timeline.index == COUNT - 1  # type: ignore[union-attr]


def test_playing_stops_with_pause_and_when_nobody_looks(source: RecordingSource) -> None:
    for stop in (lambda: source.act("pause", None), lambda: source.watch(0)):
        source.act("play", None)
        wait_for(lambda: source.describe().timeline.index > 0)  # type: ignore[union-attr]
        stop()
        time.sleep(2 * PERIOD_S)
        index = source.describe().timeline.index  # type: ignore[union-attr]
        time.sleep(4 * PERIOD_S)
        assert source.describe().timeline.index == index < COUNT - 1  # type: ignore[union-attr]
        source.act("seek", 0.0)
        wait_for(lambda: source.describe().timeline.index == 0)  # type: ignore[union-attr]


def test_drift_is_followed_beside_and_taken_out_of_the_picture(tmp_path: Path) -> None:
    """A texture that moves by whole pixels, 2 to the right and 1 down per frame, as a TIFF stack."""
    whole = texture(1, 160)
    frames = [whole[40 - k : 136 - k, 40 - 2 * k : 136 - 2 * k] for k in range(6)]
    tifffile.imwrite(tmp_path / "moving.tif", np.stack(frames))
    files = RecordedFiles(tmp_path / "moving.tif", pixel_size_m=10e-9, frame_interval_s=1.0)
    source = show(files, None, drift=True)
    try:
        wait_for(lambda: "all frames is known" in source.describe().notes[-1].text)
        source.act("seek", 5.0)
        view = wait_for(lambda: (v := source.newest()) and v.notes["frame"] == 5 and v)
        # Registration of this smooth texture is right to some hundredths of a pixel.
        assert view.drift_px == pytest.approx((10.0, 5.0), abs=0.1)
        inner = np.s_[:80, :80]
        error = view.pictures["corrected"][inner].astype(float) - frames[0][inner]
        assert np.abs(error).mean() < 2.0
        told = source.describe()
        assert told.drift.text.startswith("111.8")
        assert told.drift.at_nm == pytest.approx((100.0, 50.0), abs=1.0)
        assert len(told.drift.trace_nm) == 6
        assert any("--calibration" in note.do for note in told.notes)
        assert not view.calibrated
    finally:
        source.close()


def test_frames_from_a_number_on_are_those_of_the_whole(bag: Path, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "stack.tif", np.stack([texture(k) for k in range(5)]))
    stack = RecordedFiles(tmp_path / "stack.tif", pixel_size_m=10e-9, roi=(8, 8, 64, 64))
    for files, count in ((RecordedFiles(bag), COUNT), (stack, 5)):
        with open_recording(files, load_config("generic")) as recording:
            whole = list(recording.frames())
            assert len(whole) == count
            for start in (0, 3, count - 1, count):
                found = list(recording.frames_from(start))
                assert [number for number, _ in found] == list(range(start, count))
                for number, frame in found:
                    np.testing.assert_array_equal(frame.image, whole[number].image)
                    assert frame.stamp_ns == whole[number].stamp_ns


def test_what_cannot_be_shown_is_refused(source: RecordingSource, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="play, pause or seek"):
        source.act("reset", None)
    assert source.overlay() is None
    with pytest.raises(BagError):
        show(tmp_path / "nothing")


def test_what_moves_by_itself_is_outlined(tmp_path: Path) -> None:
    """A patch that stays in the picture while the specimen moves by 2 px a frame to the right."""
    whole, patch = texture(1, 224), texture(2, 40)
    frames = [whole[32:192, 40 - 2 * k : 200 - 2 * k].copy() for k in range(6)]
    for frame in frames[2:]:
        frame[60:100, 30:70] = patch
    tifffile.imwrite(tmp_path / "tool.tif", np.stack(frames))
    files = RecordedFiles(tmp_path / "tool.tif", pixel_size_m=10e-9, frame_interval_s=1.0)
    source = show(files, None, drift=True)
    try:
        wait_for(lambda: "all frames is known" in source.describe().notes[-1].text)
        source.act("seek", 5.0)
        view = wait_for(lambda: (v := source.newest()) and v.notes["frame"] == 5 and v)
        (places,) = (np.array(points) for points in view.moving)
        # It covers tiles of some 20 px, and lies 10 px farther left where the drift is taken out.
        assert np.allclose(places.mean(axis=0), (40.0, 80.0), atol=12.0)
        assert np.all(np.ptp(places, axis=0) > 30.0)
    finally:
        source.close()
