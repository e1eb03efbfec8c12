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

"""The observations, as plain values: of this machine and process, of the ROS graph, and of the messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from semcal_ros.bridge.magnification import MagnificationReading
from semcal_ros.core.calibration.stage import StageReading

SUITE = (
    "bag_player",
    "calibration_server",
    "drift_compensator",
    "microscope",
    "parameter_server",
    "rectifier",
    "stream_corrector",
    "suite",
    "virtual_sem",
    "visual_servo",
)
"""Names of the suite's nodes."""


@dataclass(frozen=True)
class Environment:
    """This machine and the environment of this process.

    Attributes
    ----------
    python
        Version, (major, minor).
    packages
        Versions of the installed distributions, by canonical name.
    requirements
        What each of these distributions requires, such as ``numpy>=1.26``.
    import_errors
        Reason by module, of those that cannot be imported.
    rclpy_file
        Where rclpy was imported from; empty if it was not.
    prefix
        Folder of this Python environment.
    installations
        ROS installations of this machine, such as ``/opt/ros/jazzy``.
    environment
        Environment variables.
    script_prefixes
        Prefixes in which a script of the user's looks packages up (``AMENT_PREFIX_PATH``); empty without rclpy.
    rmw
        The middleware in use; empty without rclpy.
    shm_free_bytes
        Room in /dev/shm, or None on a system without it.
    receive_buffer_bytes
        Largest receive buffer that the kernel grants a socket, or None if unknown.
    """

    python: tuple[int, int]
    packages: Mapping[str, str]
    requirements: Mapping[str, tuple[str, ...]]
    import_errors: Mapping[str, str]
    rclpy_file: str
    prefix: str
    installations: tuple[str, ...]
    environment: Mapping[str, str]
    script_prefixes: tuple[str, ...]
    rmw: str
    shm_free_bytes: int | None
    receive_buffer_bytes: int | None


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscription: its node, its type and the demanding half of its quality of service."""

    node: str
    type: str
    reliable: bool = True
    transient_local: bool = False

    @property
    def quality(self) -> str:
        """Reliability and durability in words."""
        durability = "transient local" if self.transient_local else "volatile"
        return f"{'reliable' if self.reliable else 'best effort'}, {durability}"


@dataclass(frozen=True)
class Graph:
    """The nodes, topics and parameters of a ROS graph, without the observer's own.

    Attributes
    ----------
    nodes
        Fully qualified names; a name that is used twice appears twice.
    publishers, subscriptions
        By topic.
    parameters
        By node of the suite: ``use_sim_time`` and ``config``, or None where it did not answer.
    """

    nodes: tuple[str, ...] = ()
    publishers: Mapping[str, tuple[Endpoint, ...]] = field(default_factory=dict)
    subscriptions: Mapping[str, tuple[Endpoint, ...]] = field(default_factory=dict)
    parameters: Mapping[str, tuple[bool, str] | None] = field(default_factory=dict)

    def suite(self, namespace: str | None = None) -> tuple[str, ...]:
        """Return the nodes of the suite, each once; those in one namespace if it is given."""
        found = dict.fromkeys(n for n in self.nodes if n.rpartition("/")[2] in SUITE)
        return tuple(n for n in found if namespace in (None, n.rpartition("/")[0]))


@dataclass(frozen=True)
class Arrival:
    """One message, ns: when it was received and published by the clocks of either host, and its stamp if it has one."""

    received_ns: int
    published_ns: int | None
    stamp_ns: int | None


@dataclass(frozen=True)
class ImageSeen:
    """The last image: px, encoding, bytes, why it cannot be used (empty if it can), and the rows of its data bar."""

    width: int
    height: int
    encoding: str
    bytes: int
    trouble: str = ""
    databar_rows: int = 0


@dataclass(frozen=True)
class CalibrationSeen:
    """One calibration.

    Attributes
    ----------
    source
        File, or topic.
    trouble
        Why it cannot be used; if set, nothing else is valid.
    width, height, display_width_m
        Of the calibration images, px, and the display, m.
    low, high
        Calibrated magnifications.
    sigma_px
        Predicted 1-sigma error at the centre and the worst corner of the live images at their magnification, px;
        None where that is not known.
    """

    source: str
    trouble: str = ""
    width: int = 0
    height: int = 0
    display_width_m: float = 0.0
    low: float = 0.0
    high: float = 0.0
    sigma_px: tuple[float, float] | None = None


@dataclass(frozen=True)
class NodeStatus:
    """The last diagnostics of a node: level as in diagnostic_msgs (0 OK, 1 WARN, 2 ERROR, 3 STALE), and its message."""

    node: str
    level: int
    message: str


@dataclass(frozen=True)
class Session:
    """What was received in some seconds.

    Attributes
    ----------
    seconds
        How long.
    graph
        At the end.
    arrivals
        By topic, in order.
    image
        The last one of the microscope; None where none came, or where it has to be decoded first.
    reading, reading_trouble
        The last magnification, and why it could not be read; None where none came.
    stage, stage_trouble
        The last reading of the stage, and why the last message could not be used; None where none came.
    conditions
        What the topic ``conditions`` said last; None where nothing came.
    calibration_text
        Of the topic; None where none came.
    statuses
        Of the suite's nodes.
    """

    seconds: float
    graph: Graph = field(default_factory=Graph)
    arrivals: Mapping[str, tuple[Arrival, ...]] = field(default_factory=dict)
    image: ImageSeen | None = None
    reading: MagnificationReading | None = None
    reading_trouble: str = ""
    stage: StageReading | None = None
    stage_trouble: str = ""
    conditions: Mapping[str, float | str] | None = None
    calibration_text: str | None = None
    statuses: tuple[NodeStatus, ...] = ()
