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

"""The node `microscope` on the DemoMicroscope of OpenFIBSEM, in a process of its own."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterType, ParameterValue
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64

from semcal_ros.bridge.conditions import read_conditions
from tests.helpers.live_page import corrected_view, viewing
from tests.helpers.node_scenes import stamp_of
from tests.helpers.ros_process import LATCHED, Peer, running

NODE = "/sem/microscope"
DISPLAY_M = 0.12

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("fibsem") is None,
        reason="needs fibsem (requirements/microscope.txt)",
    ),
]


class Listener:
    """What a test hears of the node, and its hands."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self.images = peer.collect(Image, "image_raw")
        self.values = peer.collect(Float64, "magnification", LATCHED)
        self.joints = peer.collect(JointState, "stage", LATCHED)
        self.conditions = peer.collect(DiagnosticStatus, "conditions", LATCHED)
        self.motion = peer.collect(DiagnosticStatus, f"{NODE}/motion", LATCHED)
        self.knob = peer.node.create_publisher(Float64, f"{NODE}/set_magnification", 10)
        self.stage = peer.node.create_publisher(JointState, f"{NODE}/move_stage", 10)

    def wait_frames(self, count: int = 1) -> None:
        """Wait for that many further frames."""
        wanted = len(self.images) + count
        self.peer.wait_for(lambda: len(self.images) >= wanted, f"{count} frames", timeout_s=60.0)

    def move(self, **joints: float) -> dict[str, str]:
        """Ask for a move; returns what has become of it."""
        self.peer.wait_for(lambda: self.stage.get_subscription_count() == 1, "the stage")
        self.stage.publish(JointState(name=list(joints), position=list(joints.values())))
        return self.outcome()

    def outcome(self) -> dict[str, str]:
        """The state and the message of the command that was given last, at its end."""
        before = self.number()

        def ended() -> bool:
            return self.number() == before + 1 and self.state()["state"] != "moving"

        self.peer.wait_for(ended, "the end of the command")
        return self.state()

    def state(self) -> dict[str, str]:
        status = self.motion[-1]
        return {**{v.key: v.value for v in status.values}, "message": status.message}

    def number(self) -> int:
        return int(self.state()["number"]) if self.motion else 0


@pytest.fixture
def configuration(tmp_path: Path) -> Path:
    """The default configuration of fibsem, at an address without a network."""
    spec = importlib.util.find_spec("fibsem")
    assert spec is not None and spec.origin is not None
    default = Path(spec.origin).parent / "config" / "microscope-configuration.yaml"
    settings: dict[str, Any] = yaml.safe_load(default.read_text(encoding="utf-8"))
    settings["info"]["ip_address"] = "localhost"
    path = tmp_path / "fibsem.yaml"
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return path


@contextmanager
def demo(peer: Peer, configuration: Path, **parameters: Any) -> Iterator[Listener]:
    """The node with the DemoMicroscope."""
    heard = Listener(peer)
    given = {
        "config": "virtual_sem",
        "source": "openfibsem",
        "manufacturer": "Demo",
        "fibsem_config": configuration,
        **parameters,
    }
    with running("microscope", given):
        heard.wait_frames()
        peer.wait_for(lambda: heard.motion, "the word of the stage")
        yield heard


@pytest.mark.long
def test_live_frames_and_what_the_microscope_says(peer: Peer, configuration: Path) -> None:
    with demo(peer, configuration) as heard:
        heard.wait_frames()
        first, last = heard.images[0], heard.images[-1]
        assert (first.width, first.height, first.encoding) == (1536, 1024, "mono8")
        assert stamp_of(first) < stamp_of(last)
        # A field width of 150 um.
        assert heard.values[0].data == pytest.approx(DISPLAY_M / 150e-6)
        told = read_conditions(heard.conditions[0])
        assert told["accelerating_voltage_v"] == 2000.0
        assert told["detector"] == "ETD"
        assert (told["maker"], told["model"]) == ("Demo", "DemoMicroscope")
        # 1 us on each pixel.
        assert told["frame_time_s"] == pytest.approx(1.572864)
        joints = dict(zip(heard.joints[0].name, heard.joints[0].position, strict=True))
        assert set(joints) == {"tilt", "rotation", "x", "y", "z", "scan_rotation"}

        # Without allow_motion nothing moves.
        assert "allow_motion:=true" in heard.move(tilt=0.1)["message"]
        assert len(heard.joints) == len(heard.values) == 1
        assert peer.trigger(f"{NODE}/stop").success
        peer.wait_for(lambda: "stopped" in peer.state(NODE)["message"], "the stopped microscope")
        count = len(heard.images)
        # One frame takes 1.6 s, and the microscope pretends to take as long to send it.
        peer.spin(3.5)
        assert len(heard.images) == count
        assert peer.trigger(f"{NODE}/start").success
        heard.wait_frames()


@pytest.mark.long
def test_a_corrected_frame_on_the_page(
    peer: Peer, configuration: Path, calibration_file: Path
) -> None:
    given = {"config": "virtual_sem", "calibration": calibration_file}
    with (
        running("stream_corrector", given),
        viewing("--config", "virtual_sem") as address,
        running("parameter_server", given),
        demo(peer, configuration),
    ):
        view = corrected_view(address)
    pictures = {picture["name"]: picture for picture in view["pictures"]}
    # The whole field as the microscope scans it, though the calibration is of square images.
    assert pictures["corrected"]["size"] == [1536, 1024]
    # The nominal scale of 150 um, which this calibration changes by a per cent or two.
    scale = pictures["corrected"]["scale"]
    assert scale["calibrated"]
    assert scale["nm_per_px"] == pytest.approx(150e3 / 1536, rel=0.05)


@pytest.mark.long
def test_moves_within_limits(peer: Peer, configuration: Path) -> None:
    with demo(peer, configuration, allow_motion=True, max_tilt=0.5, step_tilt=0.2) as heard:
        assert heard.move(tilt=0.1)["state"] == "done"
        # Unknown on its way, then where it is. Only the last state is kept for a reader, so that one of them may be
        # skipped on a busy computer.
        peer.wait_for(
            lambda: heard.joints and list(heard.joints[-1].position[:1]) == [0.1],
            "the tilted stage",
        )
        assert all(list(joint.name) == [] for joint in heard.joints[1:-1])
        for refused, reason in (
            ({"tilt": 0.45}, "at most 0.2 rad"),
            ({"tilt": 0.6}, "soft limits"),
            ({"tilt": float("nan")}, "finite"),
            ({"z": 1e-5}, "locked"),
            ({"lid": 1.0}, "expected one of tilt"),
        ):
            state = heard.move(**refused)
            assert (state["state"], reason in state["message"]) == ("refused", True), state

        heard.peer.wait_for(lambda: heard.knob.get_subscription_count() == 1, "the knob")
        heard.knob.publish(Float64(data=2000.0))
        assert heard.outcome()["state"] == "done"
        peer.wait_for(lambda: heard.values[-1].data == pytest.approx(2000.0), "the magnification")
        heard.knob.publish(Float64(data=1.0))
        assert heard.outcome()["state"] == "refused"

        yes = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True)
        assert peer.set_parameter(NODE, "dry_run", yes).successful
        assert heard.move(tilt=0.2)["state"] == "dry_run"
        assert heard.move(tilt=0.6)["state"] == "refused"
        assert not peer.set_parameter(NODE, "allow_motion", yes).reason
        no = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=False)
        assert not peer.set_parameter(NODE, "allow_motion", no).successful
        heard.wait_frames()
        assert heard.joints[-1].position[0] == 0.1
