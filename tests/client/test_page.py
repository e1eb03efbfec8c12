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

"""The page "Write your node": its listings run, over a replay by the suite's own nodes, and say the truth."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from std_srvs.srv import SetBool

from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import Array
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from tests.helpers.node_scenes import make_calibration, texture
from tests.helpers.project import ROOT
from tests.helpers.ros_process import PATIENT, Peer, running

PAGE = (ROOT / "doc" / "howto" / "write_a_node.md").read_text(encoding="utf-8")
SIZE = 256
# Magnification and raw pixel of the bead, on a specimen that is as still as the microscope.
SWEEP = [
    (1000.0, (150.0, 120.0)),
    (1000.0, (152.3, 121.4)),
    (1600.0, (170.2, 90.5)),
    (2500.0, (60.7, 200.1)),
]


def listing(beginning: str) -> str:
    """The indented block of the page that contains a line with this beginning."""
    blocks = re.findall(r"(?:^    .*\n|^\n+(?=    ))+", PAGE, re.MULTILINE)
    (found,) = [b for b in blocks if any(line[4:].startswith(beginning) for line in b.splitlines())]
    return re.sub(r"^    ", "", found, flags=re.MULTILINE).lstrip("\n")


def bead_picture(place: tuple[float, float]) -> np.ndarray:
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    bright = 150.0 * np.exp(-0.5 * ((x - place[0]) ** 2 + (y - place[1]) ** 2) / 3.0**2)
    return np.clip(0.35 * texture(1, SIZE) + bright, 0, 255).astype(np.uint8)


def write_sweep(path: Path) -> None:
    with BagWriter(path) as writer:
        for index, (g, place) in enumerate(SWEEP):
            stamp_ns = 1_700_000_000_000_000_000 + index * 250_000_000
            value = blank_message("std_msgs/msg/Float64")
            value.data = g
            writer.write("/sem/magnification", stamp_ns - 100_000_000, value)
            frame = blank_message("sensor_msgs/msg/Image")
            frame.header.stamp.sec, frame.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            frame.height = frame.width = frame.step = SIZE
            frame.encoding, frame.data = "mono8", bead_picture(place).reshape(-1)
            writer.write("/sem/image_raw", stamp_ns, frame)


def truth_nm(calibration: Calibration, g: float, place: tuple[float, float]) -> Array:
    """Where the bead is from what the middle of the rectified picture shows."""
    camera = calibration.at(g).resized(SIZE, SIZE)
    rectified = camera.rectified
    ideal = camera.undistort(np.array([place]))[0] - [camera.px, camera.py]
    bead = np.linalg.solve(camera.ideal_from_sem_jacobian, ideal)
    middle = np.array([0.5 * (SIZE - 1)] * 2) - [rectified.px, rectified.py]
    return np.asarray(1e9 * (bead - np.linalg.solve(rectified.ideal_from_sem_jacobian, middle)))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep")
    write_sweep(folder / "recordings" / "sweep")
    make_calibration().save(folder / "cal.yaml")
    return folder


@pytest.mark.long
def test_the_tracker_prints_where_the_bead_is(sweep: Path) -> None:
    (sweep / "bead.py").write_text(listing("rclpy.init()"), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    playing = {"bag": sweep / "recordings/sweep", "start_paused": True, "wait_for_subscribers": 2}
    peer = Peer()
    with (
        running("stream_corrector", {"calibration": sweep / "cal.yaml", **PATIENT}),
        running("bag_player", playing),
        subprocess.Popen(
            [sys.executable, "bead.py"],
            cwd=sweep,
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        ) as bead,
    ):
        try:
            # Its own subscriptions beside those of the corrector.
            peer.wait_heard("/sem/stream_corrector", "image_rect", "projection_stamped", "drift")
            peer.call(SetBool, "bag_player/pause", SetBool.Request(data=False))
            assert bead.stdout is not None
            said = [bead.stdout.readline() for _ in SWEEP]
        finally:
            bead.kill()
    peer.close()
    for line, (g, place) in zip(said, SWEEP, strict=True):
        numbers = [float(n) for n in re.findall(r"-?\d+\.?\d*", line)]
        assert numbers[0] == g
        x, sx, y, sy = numbers[1:]
        off = np.array([x, y]) - truth_nm(make_calibration(), g, place)
        # The drift of a specimen that is still is known to some hundredths of a pixel.
        assert np.all(np.abs(off) < 3.0 * np.array([sx, sy])), line
        assert max(sx, sy) < 0.02 * 1e9 * make_calibration().at(g).pixel_size_m[0] * SIZE


def test_the_readme_shows_the_tracker() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    second = readme.split("\n## ")[2]
    assert listing("rclpy.init()").strip() in re.sub(r"^    ", "", second, flags=re.MULTILINE)


def test_the_same_without_ros(sweep: Path) -> None:
    code = "import sys; sys.modules['rclpy'] = None\n" + listing(
        "from semcal_ros.client import open_frames"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=sweep,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert [float(line.split()[0]) for line in lines] == [g for g, _ in SWEEP]
