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

"""The suite in one process: the same topics and parameters, frames in memory, and what one part does to the others."""

from __future__ import annotations

import json
import signal
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.bridge.projection import stamped_projection_from_message
from tests.helpers.installed_package import write_consumers
from tests.helpers.node_scenes import make_calibration
from tests.helpers.ros_process import NodeProcess, Peer

pytestmark = pytest.mark.slow

# What each consumer is called with goes to a file, one frame a line, with enough to tell it from any other frame.
CODE = """
import json
import zlib
from pathlib import Path

FOLDER = Path(__file__).parent


def note(name, frame):
    line = {
        "stamp_ns": frame.stamp_ns,
        "crc": zlib.crc32(frame.image.tobytes()),
        "g": frame.magnification,
        "valid": frame.valid,
        "reason": frame.reason,
        "P": frame.P.tolist(),
        "drift_m": frame.drift_m.tolist(),
    }
    with open(FOLDER / name, "a") as file:
        file.write(json.dumps(line) + "\\n")


def good(frame):
    note("good", frame)
    assert not frame.image.flags.writeable


class Bad:
    def __init__(self, node):
        self.node = node
        self.gain = node.declare_parameter("bad_gain", 1.0).value

    def __call__(self, frame):
        note("bad", frame)
        raise OSError(f"no stage for {self.gain:g} times the way")
"""
GIVEN = {
    "source": "virtual_sem",
    "specimen": "gold",
    "drift": "slow",
    "magnification": 2000.0,
    "width": 256,
    "height": 256,
    "rate": 10.0,
    "viewer": False,
    "config": "virtual_sem",
    "bad_gain": 3.0,
}


@dataclass
class Running:
    """The suite with its consumers, and a node that looks on."""

    folder: Path
    peer: Peer
    process: NodeProcess
    given: dict[str, Any]

    def lines(self, name: str) -> list[dict[str, Any]]:
        file = self.folder / name
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]

    def wait_for_more(self, name: str, count: int) -> list[dict[str, Any]]:
        before = len(self.lines(name))
        self.peer.wait_for(lambda: len(self.lines(name)) >= before + count, f"frames of {name}")
        return self.lines(name)[before:]

    def state(self, key: str, node: str = "/sem/suite") -> int:
        return int(self.peer.state(node).get(key, "-1"))


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("consumers")
    make_calibration().save(folder / "cal.yaml")
    path = write_consumers(folder, "suite_consumers", CODE, {"good": "good", "bad": "Bad"})
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        peer = Peer()
        given = {**GIVEN, "calibration": folder / "cal.yaml"}
        running = Running(folder, peer, NodeProcess("suite", given, cold=True), given)
        peer.wait_for(lambda: running.lines("good"), "the first frame")
        yield running
        status = running.process.stop()
        output = running.process.output
        running.process.close()
        peer.close()
        assert status == 0, output


def test_frames_go_from_node_to_node_and_nothing_is_published_to_nobody(suite: Running) -> None:
    suite.wait_for_more("good", 5)
    # Each node says itself who listens: the corrector to the source, and nobody to the corrector.
    suite.peer.wait_for(
        lambda: suite.state("subscribers.image_raw", "/sem/virtual_sem") == 1, "diagnostics"
    )
    suite.peer.wait_for(
        lambda: suite.state("received", "/sem/stream_corrector") >= 5, "diagnostics"
    )
    assert suite.state("subscribers.image_rect", "/sem/stream_corrector") == 0
    # On a busy machine, frames that have waited for too long are skipped, and counted as dropped.
    assert suite.state("rejected", "/sem/stream_corrector") == 0
    assert suite.peer.node.count_subscribers("/sem/image_raw") == 0
    lines = suite.lines("good")
    assert all(line["valid"] and line["g"] == 2000.0 for line in lines)
    stamps = [line["stamp_ns"] for line in lines]
    assert stamps == sorted(set(stamps))


def test_who_subscribes_gets_the_same_frames(suite: Running) -> None:
    peer = suite.peer
    images = peer.collect(Image, "image_rect")
    projections = peer.collect(Image, "projection_stamped")
    drifts = peer.collect(PoseWithCovarianceStamped, "drift")
    peer.wait_heard("/sem/stream_corrector", "image_rect", "projection_stamped", "drift")
    peer.wait_for(lambda: min(map(len, (images, projections, drifts))) > 5, "outputs")
    handed = {line["stamp_ns"]: line for line in suite.lines("good")}
    for message in images[:5]:
        stamp_ns = stamp_ns_from_msg(message)
        line = handed[stamp_ns]
        assert zlib.crc32(bytes(message.data)) == line["crc"]
        for projection in projections:
            if stamp_ns_from_msg(projection) == stamp_ns:
                assert np.array_equal(stamped_projection_from_message(projection), line["P"])
        for drift in drifts:
            if stamp_ns_from_msg(drift) == stamp_ns:
                position = drift.pose.pose.position
                assert [position.x, position.y] == line["drift_m"]


def test_parameters_are_those_of_the_chain(suite: Running) -> None:
    (pixel,) = suite.peer.get_parameters("/sem/parameter_server", "pixel_size@2000")
    expected = make_calibration().at(2000.0).pixel_size_m
    assert list(pixel.double_array_value) == pytest.approx(expected)
    value = Parameter("interpolation", value="cubic").get_parameter_value()
    assert suite.peer.set_parameter("/sem/stream_corrector", "interpolation", value).successful
    suite.wait_for_more("good", 2)


@pytest.mark.long
def test_a_new_magnification_reaches_its_own_frames(suite: Running) -> None:
    knob = suite.peer.node.create_publisher(Float64, "virtual_sem/set_magnification", 10)
    suite.peer.wait_for(knob.get_subscription_count, "the knob")
    suite.peer.spin(0.3)
    knob.publish(Float64(data=4000.0))
    suite.peer.wait_for(lambda: suite.lines("good")[-1]["g"] == 4000.0, "the magnification")
    knob.publish(Float64(data=20000.0))
    suite.peer.wait_for(lambda: suite.lines("good")[-1]["g"] == 20000.0, "the magnification")
    line = suite.lines("good")[-1]
    assert not line["valid"]
    assert "outside its range" in line["reason"]
    knob.publish(Float64(data=2000.0))
    suite.peer.wait_for(lambda: suite.lines("good")[-1]["g"] == 2000.0, "the magnification")
    for line in suite.lines("good"):
        if line["valid"]:
            camera = make_calibration().at(line["g"]).resized(256, 256).rectified
            assert np.array_equal(camera.P_affine, line["P"])


def test_a_consumer_that_raises_stops_nobody(suite: Running) -> None:
    suite.wait_for_more("bad", 3)
    suite.wait_for_more("good", 3)
    peer = suite.peer
    peer.wait_for(lambda: suite.state("consumer.bad.failed") >= 3, "the count of failures")
    assert suite.state("consumer.good.failed") == 0
    said = "consumer bad raised OSError: no stage for 3 times the way"
    assert said in peer.state("/sem/suite")["message"]
    # Logged with its traceback, though not for each frame.
    assert 1 <= suite.process.output.count("OSError: no stage") < suite.state("consumer.bad.failed")


@pytest.mark.long
def test_a_killed_suite_that_is_started_again_goes_on(suite: Running) -> None:
    assert suite.process.stop(signal.SIGKILL) == -signal.SIGKILL
    suite.process.close()
    before = len(suite.lines("good"))
    suite.process = NodeProcess("suite", suite.given, cold=True)
    suite.peer.wait_for(lambda: len(suite.lines("good")) > before + 3, "frames after the restart")
    lines = suite.lines("good")
    # The file is read again; the drift begins anew.
    assert lines[before]["valid"]
    assert lines[before]["drift_m"] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"rat": 5.0}, "parameter rat, which the suite does not have; expected rate, perhaps"),
        ({"consumers": "beat"}, "consumer beat, which no installed package has"),
        ({"source": "bag"}, "no recording; expected the parameter bag"),
        ({"source": "tape"}, "parameter source = 'tape'"),
    ],
)
def test_what_it_cannot_start_with_is_refused(given: dict[str, Any], why: str) -> None:
    process = NodeProcess("suite", {"viewer": False, "source": "virtual_sem", **given})
    try:
        assert process.wait() == 2
        assert why in process.output
        assert "Traceback" not in process.output
    finally:
        process.close()
