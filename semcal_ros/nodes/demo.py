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

"""The nodes behind ``semcal demo``: a virtual microscope, its corrected stream, and the page that shows both."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import Float64

from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.viewer import Viewer, give_way

#: Magnifications that the knob goes through, up and down.
DEMO_MAGNIFICATIONS = (2000.0, 3000.0, 5000.0, 8000.0)
# Long enough for the drift to be known well at each of them.
_TURN_S = 15.0
_END_S = 20.0
_NAMESPACE = "/sem"


class _DemoViewer(Viewer):
    """The page, and somebody who turns the knob."""

    def __init__(self, begin: Callable[[str], None], duration_s: float) -> None:
        super().__init__()
        # The page has its port: what the nodes would do without it nobody would see.
        begin(self.server.address)
        ups_and_downs = (*DEMO_MAGNIFICATIONS, *DEMO_MAGNIFICATIONS[-2:0:-1])
        self._turns = [*ups_and_downs[1:], ups_and_downs[0]]
        self._turned = 0
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._knob = self.create_publisher(Float64, "virtual_sem/set_magnification", 10)
        self._turning = self.create_timer(_TURN_S, self._turn, clock=steady)
        if duration_s > 0.0:
            self._ending = self.create_timer(duration_s, self._end, clock=steady)

    def _turn(self) -> None:
        self._knob.publish(Float64(data=self._turns[self._turned % len(self._turns)]))
        self._turned += 1

    @staticmethod
    def _end() -> None:
        raise ExternalShutdownException


def _start(nodes: ExitStack, name: str, **parameters: object) -> None:
    """Start an executable, to be ended with the others."""
    command = [sys.executable, "-m", f"semcal_ros.nodes.{name}", "--ros-args"]
    command += ["-r", f"__ns:={_NAMESPACE}", "--log-level", "warn"]
    for key, value in parameters.items():
        command += ["-p", f"{key}:={value}"]
    # A group of its own: Ctrl-C reaches this process alone, which ends the others in order.
    process = subprocess.Popen(command, start_new_session=True)

    def end() -> None:
        process.terminate()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    nodes.callback(end)


def run_demo(
    calibration: Path, *, port: int, size: int, duration_s: float, say: Callable[[str, str], None]
) -> int:
    """Run the nodes and the page until Ctrl-C.

    Parameters
    ----------
    calibration
        Calibration of the virtual microscope `jsm820`.
    port
        Port of the page; 0 takes a free one.
    size
        Width and height of the images, px.
    duration_s
        End by itself after so long; 0: never.
    say
        Called with the address of the page and how to join, once the nodes have been started.

    Returns
    -------
    Exit status, as of :func:`~semcal_ros.nodes.common.run.run_node`.
    """
    # A domain of its own, so that it neither hears nor disturbs anybody else's microscope.
    domain = os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    arguments = ["--ros-args", "-r", f"__ns:={_NAMESPACE}", "--log-level", "warn"]
    given = {"config": "virtual_sem", "calibration": calibration}
    for key, value in {**given, "port": port}.items():
        arguments += ["-p", f"{key}:={value}"]
    with ExitStack() as nodes:

        def begin(address: str) -> None:
            first = DEMO_MAGNIFICATIONS[0]
            scene = {"specimen": "gold", "drift": "fast", "magnification": first}
            _start(nodes, "parameter_server", **given)
            _start(nodes, "stream_corrector", **given)
            _start(nodes, "virtual_sem", **scene, width=size, height=size)
            # After the others, which would inherit it.
            give_way()
            say(address, f"ROS_DOMAIN_ID={domain}, topics in {_NAMESPACE}; Ctrl-C ends it")

        return run_node(lambda: _DemoViewer(begin, duration_s), arguments)
