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

"""The node `microscope`: videos, a source from the documentation, and bad days of a source."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterType, ParameterValue
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64

from semcal_ros.bridge.conditions import read_conditions
from semcal_ros.files.video import VideoWriter
from tests.helpers.ros_process import LATCHED, Peer, ended, running
from tests.helpers.sem_files import number_in, numbered_image

NODE = "/sem/microscope"
REPOSITORY = Path(__file__).resolve().parents[2]
DISPLAY_M = 0.12


# -- video -----------------------------------------------------------------------------------------


@pytest.fixture
def film(tmp_path: Path) -> dict[str, Any]:
    """The settings of a node that plays a film of six seconds."""
    video = VideoWriter(tmp_path / "film.mp4", (128, 96), 10.0)
    for number in range(60):
        video.write(numbered_image(number), "")
    video.finish()
    video.release()
    return {"config": "virtual_sem", "source": "video", "video": tmp_path / "film.mp4"}


def test_a_video_with_its_magnification_from_a_parameter(peer: Peer, film: dict[str, Any]) -> None:
    images = peer.collect(Image, "image_raw")
    values = peer.collect(Float64, "magnification", LATCHED)
    with running("microscope", {**film, "field_width_m": 1e-5}) as node:
        peer.wait_for(lambda: len(images) >= 2 and values, "frames")
        assert values[0].data == pytest.approx(DISPLAY_M / 1e-5)
        pixels = np.frombuffer(images[0].data, np.uint8).reshape(96, 128)
        assert number_in(pixels) < 60
        wide = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=2e-5)
        assert peer.set_parameter(NODE, "field_width_m", wide).successful
        peer.wait_for(lambda: values[-1].data == pytest.approx(DISPLAY_M / 2e-5), "the new one")
        assert peer.node.count_publishers("/sem/stage") == 0
        assert "stamps are those of arrival" in node.output


def test_a_video_with_its_magnification_from_a_topic(peer: Peer, film: dict[str, Any]) -> None:
    """Another node publishes it: the source leaves the topic alone, and its frames are taken with what is there."""
    knob = peer.node.create_publisher(Float64, "magnification", LATCHED)
    knob.publish(Float64(data=5000.0))
    listener = "/sem/rectifier"
    with running("rectifier", {"config": "virtual_sem"}):
        peer.wait_for(lambda: peer.state(listener), "the listener")
        with running("microscope", {**film, "publish_magnification": False}):
            peer.wait_for(lambda: peer.state(listener).get("magnification") == "5000", "a frame")
            knob.publish(Float64(data=6000.0))
            peer.wait_for(lambda: peer.state(listener).get("magnification") == "6000", "the next")
            assert peer.node.count_publishers("/sem/magnification") == 1


def test_a_video_without_a_name() -> None:
    status, output = ended("microscope", {"source": "video"})
    assert status == 2
    assert "-p video:=/dev/video0" in output


# -- a source of one's own -------------------------------------------------------------------------


class Server:
    """A microscope with a socket, as in the documentation; it can hang, and go away."""

    def __init__(self) -> None:
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.sending = threading.Event()
        self.sending.set()
        self.ended = threading.Event()
        self.connections: list[socket.socket] = []
        self.dark = False
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                link, _ = self.socket.accept()
                self.connections.append(link)
                threading.Thread(target=self._send, args=(link,), daemon=True).start()

    def _send(self, link: socket.socket) -> None:
        number = 0
        with contextlib.suppress(OSError):
            while not self.ended.wait(0.05):
                self.sending.wait()
                image = numbered_image(number) // (50 if self.dark else 1)
                link.sendall(b"128 96 1e-6 1e-5\n" + (image * 0 if self.dark else image).tobytes())
                number += 1

    def hang_up(self) -> None:
        for link in self.connections:
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()
        self.connections.clear()

    def close(self) -> None:
        self.ended.set()
        self.sending.set()
        self.socket.close()
        self.hang_up()


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()


def example() -> str:
    text = (REPOSITORY / "doc" / "drivers.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return str(code)


@contextlib.contextmanager
def own_source(code: str, tmp_path: Path, *parameters: str) -> Iterator[None]:
    """A node with a source of its own, as a user's script."""
    script = tmp_path / "driver.py"
    script.write_text(code, encoding="utf-8")
    given = ["config:=virtual_sem", "diagnostics_period:=0.1", *parameters]
    words = [word for parameter in given for word in ("-p", parameter)]
    paths = [str(REPOSITORY), os.environ.get("PYTHONPATH", "")]
    process = subprocess.Popen(
        [sys.executable, str(script), "--ros-args", *words],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        stdin=subprocess.DEVNULL,
    )
    try:
        yield
        process.terminate()
        assert process.wait(20.0) == 0
    finally:
        process.kill()
        process.wait()


@pytest.mark.long
def test_the_example_of_the_documentation_and_its_bad_days(
    peer: Peer, server: Server, tmp_path: Path
) -> None:
    code = example()
    # What the page promises.
    assert len([line for line in code.splitlines() if line.strip()]) <= 42
    images = peer.collect(Image, "image_raw")
    values = peer.collect(Float64, "magnification", LATCHED)
    conditions = peer.collect(DiagnosticStatus, "conditions", LATCHED)

    def wait_state(words: str) -> None:
        peer.wait_for(lambda: words in peer.state(NODE).get("message", ""), words)

    def wait_frame() -> None:
        count = len(images)
        peer.wait_for(lambda: len(images) > count, "another frame")

    with own_source(code.replace("PORT", str(server.port)), tmp_path, "frame_timeout:=1.0"):
        wait_frame()
        peer.wait_for(lambda: values and conditions, "magnification and conditions")
        assert values[0].data == pytest.approx(DISPLAY_M / 1e-5)
        assert read_conditions(conditions[0]) == {"dwell_s": 1e-6, "maker": "us"}

        # It hangs, and goes on: said, and over by itself.
        server.sending.clear()
        wait_state("no frame for")
        server.sending.set()
        wait_frame()
        peer.wait_for(lambda: peer.state(NODE)["level"] == "0", "a state without complaint")

        # Its beam is blanked.
        server.dark = True
        wait_state("blank frames")
        server.dark = False
        peer.wait_for(lambda: peer.state(NODE)["level"] == "0", "a state without complaint")

        # It goes away, and comes back.
        server.hang_up()
        peer.wait_for(lambda: int(peer.state(NODE)["rejected"]) >= 1, "the loss")
        wait_frame()
        peer.wait_for(lambda: peer.state(NODE)["level"] == "0", "a state without complaint")


STUBBORN = """
import threading, time
import numpy as np
from semcal_ros.core.errors import MicroscopeError
from semcal_ros.drivers.source import SourceFrame
from semcal_ros.nodes.run_source import run_source

class Stubborn:
    streams, lossless = True, False
    def __init__(self, config):
        self.tilt, self.moves, self.width_m = 0.0, 0, 1e-5
    def open(self):
        return "a stubborn microscope"
    def read(self, timeout_s):
        time.sleep(0.05)
        image = np.random.default_rng(1).integers(0, 255, (32, 48)).astype(np.uint8)
        width_m = self.width_m if self.moves < 3 else 3e-5
        stage = {"tilt": self.tilt}
        return SourceFrame(image, time.time_ns(), 0.01, width_m, {"accelerating_voltage_v": 5e3}, stage)
    def close(self):
        pass
    def set_field_width(self, width_m):
        self.width_m = width_m
    def stage_position(self):
        return {"tilt": self.tilt}
    def stage_limits(self):
        return {"tilt": (-0.05, 0.2)}
    def move_stage(self, target):
        self.moves += 1
        if self.moves == 1:
            raise RuntimeError("the door is open")
        if self.moves == 2:
            time.sleep(3.0)
        self.tilt = target["tilt"]

raise SystemExit(run_source(Stubborn))
"""


@pytest.mark.long
def test_a_stage_that_refuses_or_hangs_moves_no_more_until_somebody_has_looked(
    peer: Peer, tmp_path: Path
) -> None:
    images = peer.collect(Image, "image_raw")
    values = peer.collect(Float64, "magnification", LATCHED)
    joints = peer.collect(JointState, "stage", LATCHED)
    told = peer.collect(DiagnosticStatus, f"{NODE}/motion", LATCHED)
    hand = peer.node.create_publisher(JointState, f"{NODE}/move_stage", 10)
    knob = peer.node.create_publisher(Float64, f"{NODE}/set_magnification", 10)

    def move(tilt: float) -> None:
        hand.publish(JointState(name=["tilt"], position=[tilt]))

    def wait_told(words: str) -> None:
        peer.wait_for(lambda: told and words in told[-1].message, words)

    with own_source(STUBBORN, tmp_path, "allow_motion:=true", "motion_timeout:=1.0"):
        peer.wait_for(lambda: images and joints and told, "frames and the stage")
        peer.wait_for(lambda: hand.get_subscription_count() == 1, "the stage's input")
        peer.wait_for(lambda: knob.get_subscription_count() == 1, "the knob")
        move(0.25)
        wait_told("limits of the microscope")
        assert told[-1].level == DiagnosticStatus.WARN

        # It refuses: told, and nothing moves any more.
        move(0.1)
        wait_told("the door is open")
        assert told[-1].level == DiagnosticStatus.ERROR
        peer.wait_for(
            lambda: "not moving any more" in peer.state(NODE).get("message", ""), "its state"
        )
        knob.publish(Float64(data=5000.0))
        wait_told("call ~/start")
        assert peer.trigger(f"{NODE}/start").success
        wait_told("allowed again")

        # It hangs: given up, and frames go on meanwhile.
        count = len(images)
        move(0.1)
        wait_told("has not finished within 1 s")
        assert len(images) > count + 5
        assert peer.trigger(f"{NODE}/start").success
        move(0.05)
        wait_told("has not returned")
        what = "the end of the move all the same"
        peer.wait_for(lambda: list(joints[-1].position) == [0.1], what)

        # It works again; and somebody turns the magnification that was set from here.
        knob.publish(Float64(data=DISPLAY_M / 2e-5))
        wait_told("done: magnification")
        peer.wait_for(lambda: values[-1].data == pytest.approx(DISPLAY_M / 2e-5), "magnification")
        move(0.15)
        wait_told("done: tilt")
        what = "the magnification that was turned"
        peer.wait_for(lambda: "turned at the microscope" in peer.state(NODE)["message"], what)
        assert values[-1].data == pytest.approx(DISPLAY_M / 3e-5)
        assert peer.trigger(f"{NODE}/start").success
        peer.wait_for(lambda: peer.state(NODE)["level"] == "0", "a state without complaint")
