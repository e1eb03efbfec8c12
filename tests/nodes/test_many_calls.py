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

"""Many clients call everything at once while frames stream; each call is answered, and nothing hangs."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from tests.helpers.calibration_session import PLAN
from tests.helpers.node_scenes import image_message, magnification_message, make_calibration
from tests.helpers.ros_process import LATCHED, RELIABLE, NodeProcess, Peer, running

CALIBRATION_SERVER, PARAMETER_SERVER = "/sem/calibration_server", "/sem/parameter_server"
CLIENTS, ROUNDS = 3, 6
# Of the usual ten answers a client that does not take them at once loses the rest.
MANY = QoSProfile(depth=1000)
TRIGGERS = {
    CALIBRATION_SERVER: ("add_view", "calibrate", "cancel", "save"),
    PARAMETER_SERVER: ("reload",),
}


@pytest.fixture
def peers() -> Iterator[list[Peer]]:
    made = [Peer(f"peer_{index}") for index in range(CLIENTS)]
    yield made
    for peer in made:
        peer.close()


@pytest.fixture
def nodes(tmp_path: Path) -> Iterator[list[NodeProcess]]:
    make_calibration().save(tmp_path / "cal.yaml")
    with ExitStack() as stack:
        yield [
            stack.enter_context(running(name, parameters))
            for name, parameters in (
                ("calibration_server", {"directory": tmp_path, "allow_writing": False}),
                ("parameter_server", {"calibration": tmp_path / "cal.yaml"}),
            )
        ]


def _set(name: str, text: str) -> SetParameters.Request:
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)
    return SetParameters.Request(parameters=[Parameter(name=name, value=value)])


def _calls(peer: Peer, folder: Path) -> list[tuple[Any, Any]]:
    """(client, request) of every service, once."""
    calls: list[tuple[Any, Any]] = []

    def add(kind: Any, name: str, request: Any) -> None:
        calls.append((peer.node.create_client(kind, name, qos_profile=MANY), request))

    for node, names in TRIGGERS.items():
        for name in names:
            add(Trigger, f"{node}/{name}", Trigger.Request())
    good, bad = str(folder / "cal.yaml"), "/etc/passwd"
    for path in (good, bad):
        add(SetParameters, f"{PARAMETER_SERVER}/set_parameters", _set("calibration", path))
        add(SetParameters, f"{CALIBRATION_SERVER}/set_parameters", _set("output", path))
    names = GetParameters.Request(names=["p@5250", "k@1000", "p@nonsense"])
    add(GetParameters, f"{PARAMETER_SERVER}/get_parameters", names)
    described = DescribeParameters.Request(names=["calibration"])
    add(DescribeParameters, f"{PARAMETER_SERVER}/describe_parameters", described)
    add(ListParameters, f"{CALIBRATION_SERVER}/list_parameters", ListParameters.Request())
    return calls


@pytest.mark.long
def test_every_call_is_answered(
    peers: list[Peer], nodes: list[NodeProcess], tmp_path: Path
) -> None:
    image = peers[0].node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peers[0].node.create_publisher(Float64, "magnification", LATCHED)
    magnification.publish(magnification_message(PLAN.frames[0].magnification))
    frames = itertools.count(1)
    # A grid, so that views are found and calibrations really begin.
    picture = PLAN.render(0)
    peers[0].node.create_timer(
        0.05, lambda: image.publish(image_message(picture, stamp_s=0.05 * next(frames)))
    )
    by_peer = [(peer, _calls(peer, tmp_path)) for peer in peers]
    for peer, calls in by_peer:
        for client, _ in calls:
            peer.wait_for(client.service_is_ready, client.srv_name)
    peers[0].wait_for(
        lambda: peers[0].state(CALIBRATION_SERVER).get("magnification", "unknown") != "unknown",
        "the first frames",
    )
    assert peers[0].trigger(f"{CALIBRATION_SERVER}/add_view").success
    pending = [
        client.call_async(request)
        for _ in range(ROUNDS)
        for _, calls in by_peer
        for client, request in calls
    ]
    assert len(pending) > 200
    # A calibration that nobody else cancels would have to come to its end.
    client = peers[0].node.create_client(Trigger, f"{CALIBRATION_SERVER}/cancel")
    peers[0].node.create_timer(0.5, lambda: client.call_async(Trigger.Request()))
    peers[0].wait_for(
        # Each is only spun here.
        lambda: [peer.spin(0.01) for peer in peers[1:]] and all(f.done() for f in pending),
        "all answers",
        # Thousands of messages; only who is left without an answer fails here.
        timeout_s=120.0,
    )
    assert " removed" in peers[0].trigger(f"{CALIBRATION_SERVER}/clear").message
    answers = [future.result() for future in pending]
    assert all(answer is not None for answer in answers)
    said = [answer.message for answer in answers if isinstance(answer, Trigger.Response)]
    for part in ("view 2 at", "cancelled the joint", "cancelled", "switched off", "read "):
        assert any(part in text for text in said), (part, set(said))
    results = [a.results[0] for a in answers if isinstance(a, SetParameters.Response)]
    assert sum(result.successful for result in results) == len(results) // 2
    assert all("inside" in r.reason for r in results if not r.successful)

    for node, process in zip((CALIBRATION_SERVER, PARAMETER_SERVER), nodes, strict=True):
        assert process.process.poll() is None
        before = len(peers[0].diagnostics)
        peers[0].wait_for(lambda b=before: len(peers[0].diagnostics) > b, "a report")
        assert peers[0].state(node)
    received = int(peers[0].state(CALIBRATION_SERVER)["received"])
    peers[0].wait_for(
        lambda: int(peers[0].state(CALIBRATION_SERVER)["received"]) > received, "more frames"
    )
