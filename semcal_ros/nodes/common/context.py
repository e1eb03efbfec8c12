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

"""What a node gives each of its inputs and outputs."""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.node import Node

from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.parameters import Parameters
from semcal_ros.nodes.common.reporter import Reporter


@dataclass(frozen=True, eq=False)
class NodeContext:
    """What the inputs and outputs of one node have in common.

    Attributes
    ----------
    node
        The node itself: its name, its clock, its timers.
    config
        What the topics of the microscope carry, and in which units.
    parameters
        The values of the node's parameters, which may change while it runs.
    endpoints
        Where to subscribe, to publish and to serve.
    reporter
        The counters and values of the diagnostics, and the log.
    """

    node: Node
    config: MicroscopeConfig
    parameters: Parameters
    endpoints: Endpoints
    reporter: Reporter
