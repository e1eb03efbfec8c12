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

"""The node `microscope` on a folder that another process fills."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64

from semcal_ros.bridge.conditions import read_conditions
from tests.helpers.node_scenes import stamp_of
from tests.helpers.ros_process import LATCHED, NodeProcess, Peer, ended, running
from tests.helpers.sem_files import PIXEL_M, number_in, numbered_image, save_sem_tiff

NODE = "/sem/microscope"
REPOSITORY = Path(__file__).resolve().parents[2]
WRITER = """
import sys, time
from pathlib import Path
from tests.helpers.sem_files import numbered_image, save_sem_tiff
folder, count, rate = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
begun = time.monotonic()
for number in range(count):
    time.sleep(max(0.0, begun + number / rate - time.monotonic()))
    save_sem_tiff(folder / f"{number:05d}.tif", numbered_image(number))
"""


@contextmanager
def writer(folder: Path, count: int, rate_hz: float) -> Iterator[subprocess.Popen[bytes]]:
    """A process that saves numbered pictures."""
    command = [sys.executable, "-c", WRITER, str(folder), str(count), str(rate_hz)]
    process = subprocess.Popen(command, cwd=REPOSITORY)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def settings(tmp_path: Path) -> dict[str, Any]:
    """Parameters of a node on a folder of its own."""
    (tmp_path / "sem").mkdir()
    return {
        "config": "virtual_sem",
        "source": "folder",
        "folder": tmp_path / "sem",
        "journal": tmp_path / "folder.journal",
        "settle": 0.15,
        "poll": 0.1,
    }


def numbers(images: list[Any]) -> list[int]:
    return [number_in(np.frombuffer(m.data, np.uint8).reshape(m.height, m.width)) for m in images]


def wait_open(peer: Peer) -> None:
    peer.wait_for(lambda: peer.state(NODE).get("source_state") == "open", "the open folder")


@pytest.mark.long
def test_a_picture_comes_with_magnification_stage_and_conditions(
    peer: Peer, settings: dict[str, Any]
) -> None:
    images = peer.collect(Image, "image_raw")
    values = peer.collect(Float64, "magnification", LATCHED)
    joints = peer.collect(JointState, "stage", LATCHED)
    conditions = peer.collect(DiagnosticStatus, "conditions", LATCHED)
    with running("microscope", settings):
        wait_open(peer)
        path = save_sem_tiff(settings["folder"] / "one.tif", numbered_image(1))
        what = "the picture with all of its topics"
        peer.wait_for(lambda: images and values and joints and conditions, what)
        # A display of 0.12 m, as the configuration has it.
        assert values[0].data == pytest.approx(0.12 / (128 * PIXEL_M))
        assert (list(joints[0].name), list(joints[0].position)) == (
            ["tilt", "rotation"],
            [0.1, 0.2],
        )
        told = read_conditions(conditions[0])
        assert told["accelerating_voltage_v"] == 5000.0
        assert (told["maker"], told["detector"]) == ("thermo_fisher", "ETD")
        sec, nanosec = stamp_of(images[0])
        assert sec * 10**9 + nanosec == path.stat().st_mtime_ns - 50_000_000
        assert images[0].header.frame_id == "sem_optical"
        assert peer.state(NODE)["level"] == "0"

        # The column at another voltage is told, until somebody says that it is meant.
        save_sem_tiff(settings["folder"] / "two.tif", numbered_image(2), hv=10e3)
        what = "the other voltage"
        peer.wait_for(lambda: "10000 V, 5000 V at the start" in peer.state(NODE)["message"], what)
        assert len(values) == len(joints) == 1
        peer.wait_for(lambda: len(conditions) == 2, "the new conditions")
        assert peer.trigger(f"{NODE}/start").success
        peer.wait_for(lambda: peer.state(NODE)["level"] == "0", "a state without complaint")

        # Black frames are told; they are frames all the same.
        for number in (3, 4):
            black = np.full((96, 128), 3 + number, np.uint8)
            save_sem_tiff(settings["folder"] / f"{number}.tif", black, hv=10e3)
        peer.wait_for(lambda: "blank frames" in peer.state(NODE)["message"], "blank frames")
        save_sem_tiff(settings["folder"] / "five.tif", numbered_image(5), hv=10e3)
        peer.wait_for(lambda: peer.state(NODE)["level"] == "0", "the end of the blank frames")
        assert len(images) == 5

        # Nothing is published after ~/stop, and nothing is lost by it.
        assert peer.trigger(f"{NODE}/stop").success
        peer.wait_for(lambda: "stopped" in peer.state(NODE)["message"], "the stopped source")
        save_sem_tiff(settings["folder"] / "six.tif", numbered_image(6), hv=10e3)
        peer.spin(0.5)
        assert len(images) == 5
        assert peer.trigger(f"{NODE}/start").success
        peer.wait_for(lambda: len(images) == 6, "the picture of meanwhile")
        assert numbers(images[-1:]) == [6]


@pytest.mark.long
def test_none_is_lost_and_none_comes_twice(peer: Peer, settings: dict[str, Any]) -> None:
    images = peer.collect(Image, "image_raw")
    with running("microscope", settings):
        wait_open(peer)
        with writer(settings["folder"], 40, 20.0):
            peer.wait_for(lambda: len(images) >= 40, "all pictures")
        peer.spin(0.5)
    assert sorted(numbers(images)) == list(range(40))


@pytest.mark.slow
@pytest.mark.long
def test_none_is_lost_by_kill_9(peer: Peer, settings: dict[str, Any]) -> None:
    images = peer.collect(Image, "image_raw")
    settings["max_rate"] = 200.0
    with writer(settings["folder"], 0, 1.0) as idle:
        assert idle.wait() == 0
    node = NodeProcess("microscope", settings)
    try:
        wait_open(peer)
        with writer(settings["folder"], 60, 15.0) as filling:
            peer.wait_for(lambda: len(images) >= 15, "some pictures")
            node.stop(signal.SIGKILL)
            before = len(images)
            peer.wait_for(lambda: filling.poll() is not None, "the last picture")
        with running("microscope", settings):
            peer.wait_for(lambda: len(set(numbers(images))) == 60, "all pictures")
            peer.spin(0.5)
    finally:
        node.close()
    found = numbers(images)
    assert sorted(set(found)) == list(range(60))
    assert before < 60
    # At most the one that had been published and was not yet in the journal.
    assert len(found) <= 61


@pytest.mark.long
def test_files_wait_for_a_subscriber(peer: Peer, settings: dict[str, Any]) -> None:
    with running("microscope", settings):
        wait_open(peer)
        for number in range(3):
            save_sem_tiff(settings["folder"] / f"{number}.tif", numbered_image(number))
        what = "the files that wait"
        peer.wait_for(lambda: "files wait for subscribers" in peer.state(NODE)["message"], what)
        images = peer.collect(Image, "image_raw")
        peer.wait_for(lambda: len(images) == 3, "the files that have waited")
    assert numbers(images) == [0, 1, 2]


def test_a_folder_is_moved_by_nobody_and_says_so(peer: Peer, settings: dict[str, Any]) -> None:
    told = peer.collect(DiagnosticStatus, f"{NODE}/motion", LATCHED)
    knob = peer.node.create_publisher(Float64, f"{NODE}/set_magnification", 10)
    with running("microscope", settings):
        wait_open(peer)
        peer.wait_for(lambda: knob.get_subscription_count() == 1, "the knob")
        knob.publish(Float64(data=2000.0))
        peer.wait_for(lambda: told and told[-1].message.startswith("set_magnification"), "refusal")
    assert "allow_motion:=true" in told[-1].message
    assert told[-1].level == DiagnosticStatus.WARN


def test_what_it_cannot_start_with(tmp_path: Path) -> None:
    status, output = ended("microscope", {"source": "folder"})
    assert status == 2
    assert "-p folder:=PATH" in output


@pytest.mark.long
def test_a_folder_that_is_not_there_yet(peer: Peer, settings: dict[str, Any]) -> None:
    settings["folder"].rmdir()
    images = peer.collect(Image, "image_raw")
    with running("microscope", settings):
        what = "a source that is lost"
        peer.wait_for(lambda: "source lost" in peer.state(NODE).get("message", ""), what)
        settings["folder"].mkdir()
        wait_open(peer)
        save_sem_tiff(settings["folder"] / "one.tif", numbered_image(1))
        peer.wait_for(lambda: images, "its first picture")
