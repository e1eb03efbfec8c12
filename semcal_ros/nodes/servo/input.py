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

"""Input of rectified frames with their camera and drift for visual servoing."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64MultiArray

from semcal_ros.bridge.camera import (
    projection_from_message,
    stamped_projection_covariance_from_message,
    stamped_projection_from_message,
)
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.bridge.images import image_from_message, to_gray
from semcal_ros.core.arrays import Array
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.qos import image_input, stream_output, value_input
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.subscription import MessageInfo

# Frames that wait for their other parts: more than the queues of all inputs hold. Projections: as many magnifications
# as can be on their way with those frames.
_WAITING, _PROJECTIONS = 16, 16
# Frames are complete without these, which bags of earlier versions do not have.
_OPTIONAL = ("projection_stamped", "projection_covariance_stamped")


@dataclass(frozen=True)
class ServoFrame:
    """One rectified frame.

    Attributes
    ----------
    image
        (h, w) grey levels.
    k
        (3, 3) K of its camera_info; zero without a camera.
    drift_m
        (2,) drift that was removed from the image, m.
    projections
        (3, 4) P_g with the frame's own stamp; without one, the latest of all, the oldest first.
    covariance
        (12, 12) covariance of the P_g with the frame's own stamp, or None where it is not known.
    header, stamp_ns
        Its header.
    """

    image: NDArray[Any]
    k: Array
    drift_m: Array
    projections: tuple[Array, ...]
    header: Any
    stamp_ns: int
    covariance: Array | None = None


class ServoInput:
    """Subscribes to ``image_rect``, ``camera_info``, ``drift``, ``projection_stamped``, its covariance, ``projection``.

    All but the last are paired by stamp. The newest complete frame counts; older ones are dropped. A frame is complete
    without its ``projection_stamped`` and without the covariance of that.

    Parameters
    ----------
    context
        Of the node.
    on_frame
        Called with each frame; its exceptions of :data:`NODE_ERRORS` are counted and passed to ``on_error``.
    on_error
        Called with the reason why a frame cannot be used.
    with_drift
        Whether a frame needs a drift; otherwise no drift was removed from the image.
    """

    def __init__(
        self,
        context: NodeContext,
        on_frame: Callable[[ServoFrame], None],
        on_error: Callable[[str], None],
        *,
        with_drift: bool,
    ) -> None:
        endpoints = context.endpoints
        self._reporter = context.reporter
        self._on_frame = on_frame
        self._on_error = on_error
        self._parts: dict[str, dict[int, Any]] = {"image": {}, "info": {}}
        self._projections: deque[Array] = deque(maxlen=_PROJECTIONS)
        self._stamped: dict[int, Array] = {}
        self._covariances: dict[int, Array] = {}
        self._draining = False
        endpoints.subscribe(Float64MultiArray, "projection", self._on_projection, value_input())
        self._inputs = [
            endpoints.subscribe(
                Image, "projection_stamped", self._on_stamped_projection, stream_output()
            ),
            endpoints.subscribe(
                Image, "projection_covariance_stamped", self._on_covariance, stream_output()
            ),
            endpoints.subscribe(CameraInfo, "camera_info", self._keeps("info"), stream_output()),
            endpoints.subscribe(Image, "image_rect", self._keeps("image"), image_input()),
        ]
        if with_drift:
            self._parts["drift"] = {}
            drift = self._keeps("drift")
            kind = PoseWithCovarianceStamped
            self._inputs.append(endpoints.subscribe(kind, "drift", drift, stream_output()))

    @property
    def required_topics(self) -> tuple[str, ...]:
        """The topics without which no frame is complete."""
        return tuple(s.topic for s in self._inputs if s.topic not in _OPTIONAL)

    def _on_projection(self, message: Any, _info: MessageInfo) -> None:
        try:
            self._projections.append(projection_from_message(message))
        except NODE_ERRORS as error:
            self._reporter.reject(error)

    def _on_stamped_projection(self, message: Any, _info: MessageInfo) -> None:
        try:
            matrix = stamped_projection_from_message(message)
            _insert_newest(self._stamped, stamp_ns_from_msg(message), matrix)
        except NODE_ERRORS as error:
            self._reporter.reject(error)

    def _on_covariance(self, message: Any, _info: MessageInfo) -> None:
        try:
            matrix = stamped_projection_covariance_from_message(message)
            _insert_newest(self._covariances, stamp_ns_from_msg(message), matrix)
        except NODE_ERRORS as error:
            self._reporter.reject(error)

    def _keeps(self, part: str) -> Callable[[Any, MessageInfo], None]:
        def keep(message: Any, _info: MessageInfo) -> None:
            if part == "image":
                self._reporter.count_received()
            try:
                _insert_newest(self._parts[part], stamp_ns_from_msg(message), message)
            except NODE_ERRORS as error:
                self._reporter.reject(error)
                self._on_error(" ".join(str(error).split()))
            if not self._draining:
                self._drain()

        return keep

    def _drain(self) -> None:
        """Take all waiting messages, then process the newest frame that has all its parts."""
        self._draining = True
        try:
            for subscription in self._inputs:
                subscription.take_waiting()
        finally:
            self._draining = False
        complete = set.intersection(*(set(part) for part in self._parts.values()))
        if not complete:
            return
        newest = [stamp for stamp in self._parts["image"] if stamp in complete][-1]
        parts = {name: waiting[newest] for name, waiting in self._parts.items()}
        self._reporter.statistics.drop(list(self._parts["image"]).index(newest))
        for waiting in self._parts.values():
            for stamp in list(waiting)[: list(waiting).index(newest) + 1]:
                del waiting[stamp]
        self._work(newest, parts)

    def _work(self, stamp_ns: int, parts: dict[str, Any]) -> None:
        started_s = time.monotonic()
        try:
            image = parts["image"]
            grey = to_gray(image_from_message(image), image.encoding)
            drift_m = np.zeros(2)
            if "drift" in parts:
                place = parts["drift"].pose.pose.position
                drift_m = np.array([place.x, place.y])
            k = np.array(parts["info"].k, dtype=np.float64).reshape(3, 3)
            stamped = self._stamped.get(stamp_ns)
            projections = tuple(self._projections) if stamped is None else (stamped,)
            self._on_frame(
                ServoFrame(
                    grey,
                    k,
                    drift_m,
                    projections,
                    image.header,
                    stamp_ns,
                    None if stamped is None else self._covariances.get(stamp_ns),
                )
            )
        except NODE_ERRORS as error:
            self._reporter.reject(error)
            self._on_error(" ".join(str(error).split()))
        self._reporter.note("processing_ms", 1e3 * (time.monotonic() - started_s))


def _insert_newest(waiting: dict[int, Any], stamp_ns: int, value: Any) -> None:
    """Add what belongs to a stamp, and drop what has waited the longest."""
    waiting[stamp_ns] = value
    # In order of arrival: stamps go back when a clock does.
    while len(waiting) > _WAITING:
        del waiting[next(iter(waiting))]
