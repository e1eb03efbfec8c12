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

"""What visual servoing publishes: the velocity of the stage, and the distance of the target from its goal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from rclpy.duration import Duration

from semcal_ros.applications.servoing import ServoStep
from semcal_ros.bridge.drift import UNKNOWN_VARIANCE
from semcal_ros.bridge.headers import copy_header
from semcal_ros.core.arrays import Array
from semcal_ros.nodes.common.endpoints import Endpoints

__all__ = ["ErrorOutput", "StageOutput"]

# Longest wait for the acknowledgement of the final zero velocity: a stage that is gone must not
# hold up the end of the node. Chosen, not measured.
_LAST_WORD_S = 1.0


class StageOutput:
    """Publishes velocities of the stage; the last one is zero.

    Parameters
    ----------
    endpoints, topic
        Where to publish.
    """

    def __init__(self, endpoints: Endpoints, topic: str) -> None:
        self._publisher = endpoints.stream_publisher(Twist, topic)
        self.twist = np.zeros(3)

    @property
    def is_moving(self) -> bool:
        """Whether the last velocity was not zero."""
        return bool(np.any(self.twist))

    def send(self, twist: Array) -> None:
        """Publish (3,): x, y in m/s, rotation in rad/s."""
        message = Twist()
        message.linear.x, message.linear.y, message.angular.z = (float(v) for v in twist)
        self._publisher.publish(message)
        self.twist = np.array(twist)

    def repeat(self) -> None:
        """Publish the last velocity once more."""
        self.send(self.twist)

    def close(self) -> None:
        """Stop the stage and wait until it has received the zero velocity."""
        self.send(np.zeros(3))
        self._publisher.wait_for_all_acked(Duration(seconds=_LAST_WORD_S))


class ErrorOutput:
    """Publishes ``~/error``: target minus goal, in the sem frame, at the centre of a frame."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._publisher = endpoints.stream_publisher(PoseWithCovarianceStamped, "~/error")

    def publish(self, step: ServoStep, header: Any) -> None:
        """Publish the measured error; nothing if nothing was measured."""
        if not np.all(np.isfinite(step.error_covariance)):
            return
        message = PoseWithCovarianceStamped()
        copy_header(message.header, header)
        pose = message.pose.pose
        x, y, turn = (float(v) for v in step.error)
        pose.position.x, pose.position.y = x, y
        pose.orientation.z, pose.orientation.w = math.sin(0.5 * turn), math.cos(0.5 * turn)
        full = np.diag(np.full(6, UNKNOWN_VARIANCE))
        known = np.ix_((0, 1, 5), (0, 1, 5))
        full[known] = step.error_covariance
        message.pose.covariance = full.reshape(-1).tolist()
        self._publisher.publish(message)
