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

"""A calibration whose nm per pixel is in doubt says so in the diagnostics of every node that uses it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import Float64, String

from tests.helpers.node_scenes import (
    image_message,
    magnification_message,
    make_calibration,
    texture,
)
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

SOUND = make_calibration()
DOUBTED = replace(
    SOUND,
    statistics={
        "warnings": ["scale: the grid is worn", "few views", "scale:\x1b[31m " + 999 * "x"]
    },
)
STREAMS = ("/sem/rectifier", "/sem/stream_corrector")
SERVER = "/sem/parameter_server"
SUMMARY = "scale of the calibration: 2 warnings, the first: the grid is worn"


@pytest.fixture
def peer() -> Iterator[Peer]:
    made = Peer("microscope")
    yield made
    made.close()


def test_they_are_told_as_long_as_the_calibration_is_in_force(peer: Peer, tmp_path: Path) -> None:
    DOUBTED.save(tmp_path / "cal.yaml")
    # One section for all nodes, with a name that none of them has.
    (tmp_path / "all.yaml").write_text("/**: {ros__parameters: {calibraton: cal.yaml}}")
    further = ("--params-file", str(tmp_path / "all.yaml"))
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    magnification.publish(magnification_message(1000.0))
    stamp_s = 0

    def all_say(wanted: Callable[[dict[str, str]], bool]) -> Callable[[], bool]:
        def reached() -> bool:
            nonlocal stamp_s
            stamp_s += 1
            image.publish(image_message(texture(), stamp_s))
            return all(wanted(peer.state(node)) for node in (*STREAMS, SERVER))

        return reached

    with ExitStack() as stack:
        nodes = [
            stack.enter_context(
                running(name.rpartition("/")[2], {"calibration": tmp_path / "cal.yaml"}, *further)
            )
            for name in (*STREAMS, SERVER)
        ]
        # Worse than a warning: no frame has come yet.
        for name in STREAMS:
            peer.wait_for(
                lambda n=name: (
                    peer.state(n).get("level") == "3" and SUMMARY in peer.state(n)["message"]
                ),
                f"{name} without frames",
            )
        peer.wait_for(
            all_say(lambda s: s.get("level") == "1" and SUMMARY in s["message"]), "the warnings"
        )
        for name in (*STREAMS, SERVER):
            told = peer.state(name)["calibration_warnings"]
            assert told.startswith("the grid is worn | [31m xxx")
            assert told.endswith("x...")
            assert len(told) < 500
        for node in nodes:
            (line,) = [said for said in node.output.splitlines() if "subscribes to" in said]
            assert f"config generic; calibration {tmp_path}/cal.yaml; " in line
            for text in (SUMMARY, "not parameters of this node, and ignored: calibraton"):
                lines = [line for line in node.output.splitlines() if text in line]
                assert len(lines) == 1, node.output
                assert "[WARN]" in lines[0]
        text = peer.node.create_publisher(String, "calibration", LATCHED)
        text.publish(String(data=SOUND.dumps()))
        peer.wait_for(
            all_say(lambda s: "scale" not in s["message"] and "calibration_warnings" not in s),
            "silence about the scale",
        )
        assert (peer.state(SERVER)["level"], peer.state(SERVER)["message"]) == ("0", "ready")
