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

"""Commands hold a few images of a recording at a time, however long it is."""

from __future__ import annotations

import weakref
from collections.abc import Iterator

import pytest

from semcal_ros.core.errors import StructureError
from semcal_ros.files.bags.writer import write_simulated
from semcal_ros.files.recordings import RecordedFrame, Recording
from semcal_ros.synthetic import Drift, drift_plan, preset
from semcal_ros.workflows.reconstruct import reconstruct
from semcal_ros.workflows.rectify import rectify
from semcal_ros.workflows.stack import stack
from semcal_ros.workflows.track_drift import track_drift
from tests.helpers.node_scenes import make_calibration

G, SIZE, COUNT = 5000.0, 96, 20
PLAN = drift_plan(
    preset("ideal").with_image_size(SIZE, SIZE),
    magnification=G,
    frames=COUNT,
    interval_s=1.0,
    drift=Drift(velocity_m_s=(20e-9, -10e-9)),
)
# The keyframe, its mean and its prepared reference, the frame at hand and the one before it.
MOST_IMAGES = 5


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("large") / "bag"
    write_simulated(path, PLAN.frames, map(PLAN.render, range(COUNT)), {})
    return path


class Counter:
    """Counts the images of a recording that are in memory."""

    def __init__(self) -> None:
        self.alive, self.read, self.most = 0, 0, 0

    def let_go(self) -> None:
        self.alive -= 1

    def watch(self, frames: Iterator[RecordedFrame]) -> Iterator[RecordedFrame]:
        for frame in frames:
            weakref.finalize(frame.image, self.let_go)
            self.alive += 1
            self.most = max(self.most, self.alive)
            self.read += 1
            yield frame


@pytest.fixture
def counter(monkeypatch):
    made, frames = Counter(), Recording.frames
    monkeypatch.setattr(Recording, "frames", lambda self: made.watch(frames(self)))
    return made


@pytest.mark.parametrize(
    "command", ["drift", "stack", "rectify", "rectify/", "rectify.tif", "ball"]
)
def test_few_images_are_in_memory(bag, counter, tmp_path, command):
    calibration = make_calibration()
    if command == "drift":
        track_drift(bag, calibration=calibration, config="virtual_sem")
    elif command == "stack":
        stack(bag, calibration=calibration, config="virtual_sem", output=tmp_path / "mean.tif")
    elif command == "ball":
        with pytest.raises(StructureError, match="turns"):  # it does not; but all frames are read
            reconstruct(bag, calibration=calibration, config="virtual_sem")
    else:
        rectify(bag, f"{tmp_path}/{command}", calibration=calibration, config="virtual_sem")
    assert counter.read >= COUNT
    assert counter.most <= MOST_IMAGES
