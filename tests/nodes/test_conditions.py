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

"""The topic ``conditions`` over real DDS: who tells it, who replays it, and what the nodes that rectify do about it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterType, ParameterValue
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from semcal_ros.bridge.conditions import CONDITIONS_TYPE, fill_conditions, read_conditions
from semcal_ros.core.camera.records import Provenance
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from tests.helpers.node_scenes import (
    image_message,
    magnification_message,
    make_calibration,
    texture,
)
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

RECTIFIER, CORRECTOR = "/sem/rectifier", "/sem/stream_corrector"
SERVER = "/sem/parameter_server"
DIFFERENT = "other conditions: voltage 10 kV, calibrated at 5 kV"


@pytest.fixture
def peer() -> Iterator[Peer]:
    made = Peer("microscope")
    yield made
    made.close()


def status(**values: str) -> DiagnosticStatus:
    return DiagnosticStatus(values=[KeyValue(key=k, value=v) for k, v in values.items()])


def test_nodes_that_rectify_say_so_and_refuse_if_they_shall(peer: Peer, tmp_path: Path) -> None:
    made_at = Provenance(conditions={"acceleration_voltage_v": (5000.0, 5000.0)})
    replace(make_calibration(), provenance=made_at).save(tmp_path / "cal.yaml")
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    conditions = peer.node.create_publisher(DiagnosticStatus, "conditions", LATCHED)
    magnification.publish(magnification_message(1000.0))
    conditions.publish(status(accelerating_voltage_v="10000.0"))
    rectified = peer.collect(Image, "image_rect")
    stamp_s = 0

    def reach(wanted: Any, what: str) -> None:
        def reached() -> Any:
            nonlocal stamp_s
            stamp_s += 1
            image.publish(image_message(texture(), stamp_s))
            return wanted()

        peer.wait_for(reached, what)

    def choose(value: str) -> None:
        text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
        assert peer.set_parameter(RECTIFIER, "on_mismatch", text).successful

    given = {"calibration": tmp_path / "cal.yaml"}
    corrected: list[Any] = peer.collect(Image, "/other/image_rect")
    with (
        running("rectifier", given) as rectifier,
        running("parameter_server", given) as server,
        running(
            "stream_corrector",
            {**given, "on_mismatch": "refuse"},
            "-r",
            "image_rect:=/other/image_rect",
        ) as corrector,
    ):
        for name in (RECTIFIER, SERVER, CORRECTOR):
            reach(
                lambda name=name: DIFFERENT in peer.state(name).get("message", ""),
                f"{name} to warn",
            )
            # WARN is 1; a node without frames for a while is worse.
            assert int(peer.state(name)["level"]) >= 1
        reach(lambda: rectified, "an image under other conditions")
        reach(lambda: int(peer.state(CORRECTOR).get("frames_refused", "0")) > 2, "refused frames")
        assert corrected == []
        choose("refuse")
        # Those of before may still be on their way.
        refused_from_s = stamp_s + 1
        reach(lambda: int(peer.state(RECTIFIER).get("frames_refused", "0")) > 6, "refused frames")
        assert all(image.header.stamp.sec < refused_from_s for image in rectified)
        count = len(rectified)
        # What is no number is not known, and nothing to refuse.
        conditions.publish(status(accelerating_voltage_v="ten", detector="", model="\x01"))
        reach(lambda: len(rectified) > count, "images under unknown conditions")
        conditions.publish(status(accelerating_voltage_v="5000"))
        reach(
            lambda: peer.state(RECTIFIER).get("conditions") == "those of the calibration",
            "the conditions of the calibration",
        )
        reach(lambda: corrected, "a corrected image")
        # One line per change; the first may come with the start.
        for node in (rectifier, server, corrector):
            assert node.output.count("other conditions than those of the calibration") == 1
        assert "made: voltage 5 kV" in rectifier.output


def test_virtual_sem_tells_its_conditions_to_who_comes_late(peer: Peer) -> None:
    with running("virtual_sem", {"width": 64, "height": 64, "voltage_v": 5000.0}):
        peer.wait_for(lambda: peer.state("/sem/virtual_sem"), "the microscope")
        heard = peer.collect(DiagnosticStatus, "conditions", LATCHED)
        peer.wait_for(lambda: heard, "its conditions")
        first = read_conditions(heard[-1])
        assert first["accelerating_voltage_v"] == 5000.0
        assert first["model"] == "jsm820"
        assert first["frame_time_s"] > 64 * 64 * float(first["dwell_s"])
        turned = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=90.0)
        assert peer.set_parameter("/sem/virtual_sem", "scan_rotation_deg", turned).successful
        peer.wait_for(lambda: len(heard) > 1, "the scan rotation")
        assert read_conditions(heard[-1])["scan_rotation_rad"] == pytest.approx(1.5708, abs=1e-4)


def test_a_replay_of_the_inputs_tells_the_recorded_conditions(peer: Peer, tmp_path: Path) -> None:
    stamp_ns = 1_700_000_000 * 10**9
    told = blank_message(CONDITIONS_TYPE)
    fill_conditions(told, {"accelerating_voltage_v": 5000.0, "serial": "7"})
    number, frame = blank_message("std_msgs/msg/Float64"), blank_message("sensor_msgs/msg/Image")
    number.data = 1000.0
    frame.header.stamp.sec = stamp_ns // 10**9
    frame.height = frame.width = frame.step = 96
    frame.encoding, frame.data = "mono8", texture().reshape(-1)
    with BagWriter(tmp_path / "bag") as writer:
        # As a recorder that does not know of the durability has them.
        writer.write("/sem/conditions", stamp_ns - 2000, told)
        writer.write("/sem/magnification", stamp_ns - 1000, number)
        for _ in range(2):
            writer.write("/sem/image_raw", stamp_ns, frame)
            stamp_ns += 10 * 10**9
    with running("bag_player", {"bag": tmp_path / "bag", "topics": "inputs"}):
        peer.wait_for(lambda: peer.state("/sem/bag_player"), "the player")
        images = peer.collect(Image, "image_raw")
        peer.wait_for(
            lambda: peer.node.get_publishers_info_by_topic("/sem/conditions"), "its publisher"
        )
        heard = peer.collect(DiagnosticStatus, "conditions", LATCHED)
        peer.wait_for(lambda: heard, "the conditions")
        assert read_conditions(heard[0]) == {"accelerating_voltage_v": 5000.0, "serial": "7"}
        del images
