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

"""The servo of the page "Write your node" brings a bead to the middle, by velocities or by positions of a stage."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64

from semcal_ros.core.arrays import Array
from tests.helpers.bead_sweep import SIZE, make_pattern, picture
from tests.helpers.installed_package import write_consumers
from tests.helpers.long_tests import long_but
from tests.helpers.node_scenes import image_message, make_calibration
from tests.helpers.project import ROOT
from tests.helpers.ros_process import LATCHED, NodeProcess, Peer

pytestmark = pytest.mark.slow

PAGE = (ROOT / "doc" / "howto" / "write_a_node.md").read_text(encoding="utf-8")
MAGNIFICATION = 2000.0
PERIOD_S = 0.2
FRAMES = 16
GAIN = 2.0
CAMERA = make_calibration().at(MAGNIFICATION).resized(SIZE, SIZE)
PIXEL_M = float(CAMERA.pixel_size_m[0])


def servo() -> str:
    blocks = re.findall(r"(?:^    .*\n|^\n+(?=    ))+", PAGE, re.MULTILINE)
    (found,) = [block for block in blocks if "class Servo:" in block]
    return re.sub(r"^    ", "", found, flags=re.MULTILINE).lstrip("\n")


def middle_m() -> Array:
    """What the middle of the rectified picture shows."""
    rectified = CAMERA.rectified
    middle = np.array([0.5 * (SIZE - 1)] * 2) - [rectified.px, rectified.py]
    return np.asarray(np.linalg.solve(rectified.ideal_from_sem_jacobian, middle))


class Stage:
    """A microscope whose stage does what it is told, and takes a picture every now and then."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        node = peer.node
        self.images = node.create_publisher(Image, "image_raw", 10)
        self.magnification = node.create_publisher(Float64, "magnification", LATCHED)
        self.magnification.publish(Float64(data=MAGNIFICATION))
        self.stage = node.create_publisher(JointState, "stage", LATCHED)
        self.moved_m = np.zeros(2)
        self.tell()
        self.velocities = peer.collect(TwistStamped, "stage_velocity")
        self.goals = peer.collect(JointState, "microscope/move_stage")
        self.pattern = make_pattern()
        self.random = np.random.default_rng(0)

    def tell(self) -> None:
        position = [float(x) for x in self.moved_m]
        self.stage.publish(JointState(name=["x", "y"], position=position))

    def take(self, stamp_s: float, bead_m: Array) -> None:
        """A picture, then what the servo wants: the stage is there before the next one."""
        seen = picture(
            make_calibration(), MAGNIFICATION, bead_m + self.moved_m, self.pattern, self.moved_m
        )
        # No two pictures of a microscope are the same.
        noise = self.random.normal(0.0, 2.0, seen.shape)
        seen = np.clip(np.round(seen + noise), 0, 255).astype(np.uint8)
        said = len(self.velocities), len(self.goals)
        self.images.publish(image_message(seen, stamp_s))
        self.peer.spin(PERIOD_S)
        for command in self.velocities[said[0] :][-1:]:
            linear = command.twist.linear
            self.moved_m = self.moved_m + PERIOD_S * np.array([linear.x, linear.y])
        for goal in self.goals[said[1] :]:
            joints = dict(zip(goal.name, goal.position, strict=True))
            self.moved_m = np.array([joints["x"], joints["y"]])
            self.tell()
            self.peer.spin(0.02)


@pytest.fixture
def stage() -> Iterator[Stage]:
    peer = Peer()
    yield Stage(peer)
    peer.close()


@pytest.mark.parametrize("kind", long_but(lambda kind: kind == "Servo", ("Servo", "JointServo")))
@pytest.mark.long
def test_the_bead_comes_to_the_middle(
    stage: Stage, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_calibration().save(tmp_path / "cal.yaml")
    path = write_consumers(tmp_path, "page_servo", servo(), {"servo": kind})
    monkeypatch.setenv("PYTHONPATH", path)
    given: dict[str, Any] = {"calibration": tmp_path / "cal.yaml", "viewer": False, "gain": GAIN}
    process = NodeProcess("suite", {**given, "config": "virtual_sem"}, cold=True)
    bead_m = middle_m() + 20.0 * PIXEL_M * np.array([1.0, -0.7])
    try:
        stage.peer.wait_for(stage.images.get_subscription_count, "the corrector")
        said = stage.velocities if kind == "Servo" else stage.goals
        topic = "stage_velocity" if kind == "Servo" else "microscope/move_stage"
        stage.peer.wait_for(lambda: stage.peer.node.count_publishers(topic), "the servo")
        stage.peer.spin(1.0)
        stamp_s = time.time()
        # On a busy machine some frames pass without an answer in time.
        for k in range(2 * FRAMES):
            stage.take(stamp_s + k * PERIOD_S, bead_m)
            away_px = (bead_m + stage.moved_m - middle_m()) / PIXEL_M
            if k + 1 >= FRAMES and np.max(np.abs(away_px)) < 1.5:
                break
        assert len(said) > FRAMES // 2
    finally:
        status, output = process.stop(), process.output
        process.close()
    assert status == 0
    assert "Traceback" not in output
    # Each step leaves 1 - gain * period = 0.6 of the way, so that of 25 px less than a tenth of one remains; the
    # brightest pixel is known to half a pixel.
    assert np.max(np.abs(away_px)) < 1.5
