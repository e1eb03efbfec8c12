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

"""`semcal doctor` beside running nodes: nothing is wrong with a sound system, and what is wrong is named."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64, String

from semcal_ros.bridge.fields import fill_stamp
from tests.helpers.node_scenes import (
    image_message,
    magnification_message,
    make_calibration,
    texture,
)
from tests.helpers.ros_process import BEST_EFFORT, LATCHED, RELIABLE, REPOSITORY, Peer, running

CALIBRATION = make_calibration()
# Imports and discovery on a machine that is busy with other things.
PATIENCE_S = 100.0


@pytest.fixture
def peer() -> Iterator[Peer]:
    made = Peer("driver", namespace="lab")
    yield made
    made.close()


@pytest.fixture
def calibration_file(tmp_path: Path) -> str:
    CALIBRATION.save(tmp_path / "cal.yaml")
    return str(tmp_path / "cal.yaml")


class Report:
    """What the command said, and its exit status."""

    def __init__(self, status: int, output: str) -> None:
        self.status = status
        self.findings: list[dict[str, str]] = json.loads(output)["findings"]

    def said(self, level: str) -> list[str]:
        keys = ("subject", "seen", "expected", "do")
        found = [f for f in self.findings if f["level"] == level]
        return [" | ".join(finding[key] for key in keys) for finding in found]

    def has(self, level: str, *words: str) -> bool:
        return any(all(word in text for word in words) for text in self.said(level))


def examine(
    peer: Peer,
    *arguments: str,
    tick: Callable[[], Any] = lambda: None,
    until: Callable[[Report], bool] = lambda _report: True,
) -> Report:
    """Run the command while the peer goes on; ``tick`` is called some times a second.

    In the few seconds that it listens a busy machine may not let everybody find each other: ``until`` says whether
    that has been so, and after three runs the last one counts.
    """
    for _ in range(3):
        report = _examine(peer, arguments, tick)
        if until(report):
            break
    return report


def _examine(peer: Peer, arguments: tuple[str, ...], tick: Callable[[], Any]) -> Report:
    environment = dict(os.environ)
    paths = [str(REPOSITORY), environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    with subprocess.Popen(
        [sys.executable, "-m", "semcal_ros", "doctor", "--json", "--seconds", "3", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:

        def ended() -> bool:
            tick()
            return process.poll() is not None

        try:
            peer.wait_for(ended, "semcal doctor to end", PATIENCE_S)
        finally:
            process.kill()
        output, errors = process.communicate()
    assert process.returncode in (0, 1), errors
    return Report(process.returncode, output)


@pytest.mark.long
def test_a_sound_system_has_no_problem(peer: Peer, calibration_file: str) -> None:
    scene = {"width": 96, "height": 96, "rate": 10.0, "magnification": 1000.0}
    known = {"calibration": calibration_file}
    with (
        running("virtual_sem", scene),
        running("stream_corrector", known),
        running("parameter_server", known),
    ):
        for name in ("virtual_sem", "stream_corrector", "parameter_server"):
            peer.wait_for(
                lambda n=name: peer.state(f"/sem/{n}").get("level") == "0", f"a sound {name}"
            )
        report = examine(
            peer, until=lambda r: r.status == 0 and r.has("ok", "/sem/image_rect", "Hz")
        )
        compared = examine(peer, "--calibration", calibration_file, until=lambda r: r.status == 0)
    assert (report.said("problem"), report.status) == ([], 0)
    assert (compared.said("problem"), compared.status) == ([], 0)
    for name in ("virtual_sem", "stream_corrector", "parameter_server"):
        assert report.has("ok", "nodes", f"/sem/{name}")
    assert report.has(
        "ok", "/sem/image_raw", "/sem/virtual_sem", "/sem/stream_corrector", "reliable"
    )
    assert report.has("ok", "images", "Hz", "96 x 96 mono8")
    assert report.has("ok", "/sem/image_rect", "Hz"), "\n".join(report.said("ok"))
    assert report.has("ok", "stamps", "ms old")
    assert report.has("ok", "clocks", "from publisher to here")
    assert report.has("ok", "magnification", "1000")
    assert report.has("ok", "/sem/stage", "sensor_msgs/msg/JointState by /sem/virtual_sem")
    assert report.has("ok", "stage", " tilt ", " degrees, rotation ")
    assert report.has("ok", "calibration", "topic calibration", "500x to 8000x", "1-sigma")
    assert report.has("ok", "parameters", "all nodes answer")
    assert report.has("ok", "time", "real")


@pytest.mark.long
def test_wrong_types_weak_and_doubled_publishers_and_clocks_are_named(peer: Peer) -> None:
    # Those who do not fit are the point here; the default would only log them.
    silent = PublisherEventCallbacks(use_default_callbacks=False)
    images = peer.node.create_publisher(
        Image, "/sem/image_raw", BEST_EFFORT, event_callbacks=silent
    )
    peer.node.create_publisher(String, "/sem/magnification", LATCHED, event_callbacks=silent)
    peer.node.create_publisher(String, "/sem/stage", LATCHED, event_callbacks=silent)
    # A viewer that insists on what this publisher does not offer.
    viewer = Peer("viewer", namespace="lab")
    viewer.collect(Image, "/sem/image_raw", RELIABLE)
    message = image_message(texture())

    def publish() -> None:
        fill_stamp(message.header.stamp, time.time_ns() + 10 * 10**9)
        images.publish(message)

    with running("rectifier"), running("rectifier"):
        # The nodes give way to the weaker offer.
        peer.wait_for(lambda: images.get_subscription_count() == 2, "both nodes")
        report = examine(peer, tick=publish, until=lambda r: r.has("ok", "images"))
    viewer.close()
    assert report.status == 1
    assert report.has("problem", "2 nodes have the name /sem/rectifier")
    assert report.has("problem", "/sem/magnification", "std_msgs/msg/String", "/lab/driver")
    assert report.has("problem", "/sem/stage", "std_msgs/msg/String", "sensor_msgs/msg/JointState")
    assert report.has("problem", "/lab/viewer asks for reliable", "/lab/driver offers best effort")
    assert report.has("problem", "stamps", "in the future")
    assert report.has("note", "/sem/image_raw", "best effort", "lost")
    assert not report.has("problem", "/sem/rectifier asks for")
    assert report.has("ok", "images", "96 x 96 mono8")


@pytest.mark.long
def test_a_calibration_that_does_not_fit_and_a_clock_nobody_uses_are_named(
    peer: Peer, calibration_file: str
) -> None:
    images = peer.node.create_publisher(Image, "/sem/image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "/sem/magnification", LATCHED)
    stage = peer.node.create_publisher(JointState, "/sem/stage", LATCHED)
    stage.publish(JointState(name=["alpha"], position=[0.1]))
    clock = peer.node.create_publisher(Clock, "/clock", QoSProfile(depth=10))
    magnification.publish(magnification_message(50.0))
    message = image_message(np.ascontiguousarray(texture()[:80]))

    def publish() -> None:
        fill_stamp(message.header.stamp, time.time_ns())
        images.publish(message)
        clock.publish(Clock())

    with running("rectifier", {"calibration": calibration_file}):
        peer.wait_for(lambda: images.get_subscription_count() == 1, "the node")
        report = examine(
            peer,
            "--calibration",
            calibration_file,
            tick=publish,
            until=lambda r: r.has("problem", "calibration", "databar_rows"),
        )
    assert report.status == 1
    assert report.has("problem", "calibration", "extrapolated to 50x", "500x to 8000x")
    assert report.has("problem", "calibration", "96 x 80 px", "96 x 96 px", "databar_rows")
    assert report.has(
        "note", "time", "/lab/driver publishes /clock", "/sem/rectifier", "use_sim_time"
    )
    assert report.has("note", "stage", "no joint tilt on /sem/stage")
    assert report.has("note", "/sem/rectifier", "outside the calibrated range")


@pytest.mark.long
def test_nothing_but_an_image_elsewhere(peer: Peer) -> None:
    peer.node.create_publisher(Image, "/camera/image_raw", RELIABLE)
    report = examine(peer)
    assert report.status == 1
    assert report.has("problem", "/sem/image_raw", "nobody publishes", "/camera/image_raw")
    assert report.has("note", "/sem/stage", "nobody publishes", "without the stage")
    assert report.has("note", "no node of the suite runs in /sem")
