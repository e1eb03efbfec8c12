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

"""The frames of a live stream, each with the projection, the drift and the magnification of its own stamp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import Image

from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.bridge.projection import (
    stamped_projection_covariance_from_message,
    stamped_projection_from_message,
)
from semcal_ros.config.config import MicroscopeConfig, load_config
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.calibrated_frame import CalibratedFrame, describe_missing_camera
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.parameters import Parameters
from semcal_ros.nodes.common.qos import stream_output
from semcal_ros.nodes.common.reporter import NODE_ERRORS, Reporter
from semcal_ros.nodes.common.subscription import MessageInfo
from semcal_ros.nodes.frames.stream import FrameInput, StreamFrame

# Frames that wait for their other parts: more than the queues of all inputs hold.
_WAITING = 16
# Seconds between looks at the publishers.
_CHECKED_S = 1.0


class CalibratedStream:
    """Subscribes to the suite's outputs, and calls back with each frame once all of it is there.

    Topics are resolved in the namespace of the node, as those of the suite's own nodes: start yours in the namespace
    ``/sem``, or where the suite runs. All parts are paired by their stamps. A frame whose parts do not come is passed
    over with the first later one that is complete, and counted. The quality of service is that of the suite, and
    lowered where a publisher offers less. Callbacks run in the node's executor.

    Parameters
    ----------
    node
        The node that subscribes.
    on_frame
        Called with each frame. What it raises ends the executor, as a ``RuntimeError`` from it.
    config
        The ``msg_configs`` of the microscope, a name or a file: what its magnification topic carries.
    drift
        Whether the stream has a drift. Without ``drift_compensator`` or ``stream_corrector`` it has none.

    Attributes
    ----------
    missed
        Pictures that were passed over because not all that belongs to them came.
    """

    def __init__(
        self,
        node: Node,
        on_frame: Callable[[CalibratedFrame], object],
        *,
        config: MicroscopeConfig | str = "generic",
        drift: bool = True,
    ) -> None:
        self._on_frame = on_frame
        self.missed = 0
        chosen = load_config(config) if isinstance(config, str) else config
        endpoints = Endpoints(node)
        self._reporter = Reporter(node.get_logger(), node.get_clock())
        # Nothing is declared: a node of others has no parameters of the suite's.
        context = NodeContext(node, chosen, Parameters(node, ()), endpoints, self._reporter)
        self._images: dict[int, StreamFrame] = {}
        self._parts: dict[str, dict[int, Any]] = {"projection": {}, "covariance": {}}
        if drift:
            self._parts["drift"] = {}
            endpoints.subscribe(
                PoseWithCovarianceStamped,
                "drift",
                self._keeps("drift", _read_drift),
                stream_output(),
            )
        for name, topic, read in (
            (
                "covariance",
                "projection_covariance_stamped",
                stamped_projection_covariance_from_message,
            ),
            ("projection", "projection_stamped", stamped_projection_from_message),
        ):
            endpoints.subscribe(Image, topic, self._keeps(name, read), stream_output())
        # Frames that were scanned while the magnification changed are not valid, and are handed on for their picture.
        self._input = FrameInput(
            context, self._on_image, topic="image_rect", databar_rows=0, keep_mixed=True
        )
        # Publishers come and go, with another quality of service.
        self._timer = node.create_timer(_CHECKED_S, endpoints.check_publishers)

    def _keeps(self, name: str, read: Callable[[Any], Any]) -> Callable[[Any, MessageInfo], None]:
        def keep(message: Any, _info: MessageInfo) -> None:
            try:
                stamp_ns = stamp_ns_from_msg(message)
                kept, part = self._parts[name], read(message)
                # At the end, also where a bag plays again.
                kept.pop(stamp_ns, None)
                kept[stamp_ns] = part
            except NODE_ERRORS as error:
                self._reporter.reject(error)
                return
            while len(kept) > _WAITING:
                del kept[next(iter(kept))]
            self._hand_over(stamp_ns)

        return keep

    def _on_image(self, frame: StreamFrame) -> None:
        self._images.pop(frame.stamp_ns, None)
        self._images[frame.stamp_ns] = frame
        while len(self._images) > _WAITING:
            del self._images[next(iter(self._images))]
            self.missed += 1
        self._hand_over(frame.stamp_ns)

    def _hand_over(self, stamp_ns: int) -> None:
        """Call back with a frame if all of it has come."""
        frame = self._images.get(stamp_ns)
        if frame is None:
            return
        # A frame that was scanned while the magnification changed has no drift.
        needed = {name for name in self._parts if not (name == "drift" and frame.mixed)}
        if any(stamp_ns not in self._parts[name] for name in needed):
            return
        found = {name: self._parts[name][stamp_ns] for name in needed}
        # What came before and is not complete now never will be: the messages of a topic arrive in their order.
        self.missed += _drop_until(stamp_ns, self._images) - 1
        for name in needed:
            _drop_until(stamp_ns, self._parts[name])
        drift_m, covariance = found.get("drift", (np.zeros(2), np.zeros((2, 2))))
        handed_on = CalibratedFrame(
            frame.image,
            frame.stamp_ns,
            frame.magnification,
            found["projection"],
            found["covariance"],
            drift_m,
            covariance,
            _explain(frame, found["projection"]),
        )
        try:
            self._on_frame(handed_on)
        except NODE_ERRORS as error:
            # The input would take it for one of its messages.
            raise RuntimeError(f"on_frame raised: {error}") from error


def _drop_until(stamp_ns: int, waiting: dict[int, Any]) -> int:
    """Remove an entry and what came before it; how many those are."""
    count = list(waiting).index(stamp_ns) + 1
    for _ in range(count):
        del waiting[next(iter(waiting))]
    return count


def _read_drift(message: PoseWithCovarianceStamped) -> tuple[Array, Array]:
    position = message.pose.pose.position
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    return np.array([position.x, position.y]), covariance[:2, :2]


def _explain(frame: StreamFrame, projection: Array) -> str:
    """Say why lengths of a frame mean nothing; empty where they do."""
    # A node that starts late may get frames before the magnification that was set earlier.
    if projection[0, 0] > 0.0 and not frame.mixed and frame.magnification is not None:
        return ""
    return describe_missing_camera(frame.magnification, mixed=frame.mixed)
