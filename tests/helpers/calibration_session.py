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

"""A calibration server with this side of its topics, and views of the grid with known truth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterType, ParameterValue
from sensor_msgs.msg import Image
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

from semcal_ros.synthetic import Detector, calibration_plan, preset
from tests.helpers.node_scenes import image_message, magnification_message
from tests.helpers.ros_process import LATCHED, RELIABLE, NodeProcess, Peer, running

SERVER = "/sem/calibration_server"
MAGNIFICATIONS = (500.0, 1000.0, 2000.0, 4000.0)
VIEWS = 4
SIZE = 384
PLAN = calibration_plan(
    preset("jsm820").with_image_size(SIZE, SIZE),
    magnifications=MAGNIFICATIONS,
    views=VIEWS,
    detector=Detector(),
    seed=5,
)


def text_value(text: object) -> ParameterValue:
    """A string as the value of a parameter."""
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(text))


def _read(path: Path) -> str:
    """What a file of /proc says; nothing when its process or thread has just ended."""
    try:
        return path.read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def is_alive(pid: int) -> bool:
    """Whether a process is there and has not ended."""
    return _read(Path(f"/proc/{pid}/stat")).rpartition(")")[2].split()[:1] not in ([], ["Z"])


def workers_of(pid: int) -> list[int]:
    """Process ids of the calibrations of a node that are more than a copy of the node."""
    threads = Path(f"/proc/{pid}/task").iterdir()
    children = [int(child) for t in threads for child in _read(t / "children").split()]
    return [child for child in children if "spawn_main" in _read(Path(f"/proc/{child}/cmdline"))]


@dataclass
class Session:
    """A calibration server, and this side of its topics."""

    peer: Peer
    node: NodeProcess
    folder: Path
    image: Any
    magnification: Any
    overlays: list[Any]
    progress: list[Any]
    texts: list[Any]
    published: int = 0

    def show(self, picture: np.ndarray, g: float) -> None:
        """Publish a frame and wait until the server has it."""
        self.publish(picture, g)
        self.wait_seen(g)

    def publish(self, picture: np.ndarray, g: float) -> None:
        """Publish a frame."""
        self.published += 1
        self.magnification.publish(magnification_message(g))
        self.image.publish(image_message(picture, stamp_s=float(self.published)))

    def wait_seen(self, g: float) -> None:
        """Wait until the server would make a view of the last frame, which has this magnification."""

        def seen() -> bool:
            state = self.peer.state(SERVER)
            return (
                float(state.get("picture_stamp", 0.0)) == self.published
                and state.get("magnification") == f"{g:.6g}"
            )

        self.peer.wait_for(seen, f"frame {self.published}")

    def call(self, service: str) -> Any:
        return self.peer.trigger(f"{SERVER}/{service}", timeout_s=120.0)

    def begin(self, service: str) -> Any:
        """Future of an answer."""
        client = self.peer.node.create_client(Trigger, f"{SERVER}/{service}")
        self.peer.wait_for(client.service_is_ready, service)
        return client.call_async(Trigger.Request())

    def add_view(self, index: int) -> None:
        """Show one frame of the plan and add it."""
        self.show(PLAN.render(index), PLAN.frames[index].magnification)
        answer = self.call("add_view")
        assert answer.success, answer.message

    def shown(self) -> dict[str, str]:
        """The last progress; ``message`` too."""
        last = self.progress[-1] if self.progress else DiagnosticStatus()
        return {**{v.key: v.value for v in last.values}, "message": last.message}

    def set_output(self, path: object) -> Any:
        return self.peer.set_parameter(SERVER, "output", text_value(path))


@contextmanager
def calibration_session(folder: Path, **parameters: Any) -> Iterator[Session]:
    """A server that may read and write in ``folder``."""
    peer = Peer()
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    received = (
        peer.collect(Image, f"{SERVER}/overlay"),
        peer.collect(DiagnosticStatus, f"{SERVER}/progress", LATCHED),
        peer.collect(String, "calibration", LATCHED),
    )
    given = {"config": "virtual_sem", "directory": folder, **parameters}
    try:
        with running("calibration_server", given) as node:
            peer.wait_heard(SERVER, "~/overlay", "calibration")
            peer.wait_for(lambda: image.get_subscription_count() == 1, "the subscription")
            yield Session(peer, node, folder, image, magnification, *received)
    finally:
        peer.close()
