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

"""Publishes the frames of the microscope for tf2, where its messages are installed."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped

from semcal_ros.bridge.static_frames import StaticFrame, fill_static_frames, static_frames
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import ConfigError
from semcal_ros.middleware.message_types import message_class
from semcal_ros.nodes.common.context import NodeContext

__all__ = ["StaticFramesOutput"]


class StaticFramesOutput:
    """The topic ``/tf_static``, which begins with the microscope's frames and is renewed when one of them changes.

    Parameters
    ----------
    context
        Of the node; its configuration names the frame of the images, and says how the stage is turned.
    """

    def __init__(self, context: NodeContext) -> None:
        self._config = context.config
        self._clock = context.node.get_clock()
        self._published: tuple[StaticFrame, ...] = ()
        self._new_message: Any = None
        try:
            self._new_message = message_class("tf2_msgs/msg/TFMessage")
        except ConfigError:
            # tf2 is not on PyPI, and who has no tf2 needs no frames.
            return
        self._publisher = context.endpoints.latched_publisher(self._new_message, "/tf_static")
        self.publish(None)

    def publish(self, camera: ScanCamera | None) -> None:
        """Tell the frames of a camera, if they are others than before."""
        frames = static_frames(self._config, camera)
        if self._new_message is None or frames == self._published:
            return
        self._published = frames
        message = self._new_message()
        fill_static_frames(message, frames, self._clock.now().nanoseconds, TransformStamped)
        self._publisher.publish(message)
