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

"""Publishes the frames of a source: what is known of each of them first, then the image."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Header

from semcal_ros.bridge.conditions import fill_conditions
from semcal_ros.bridge.fields import fill_header, fill_stamp, optional_stamp_ns
from semcal_ros.bridge.images import fill_image
from semcal_ros.bridge.magnification import published_number
from semcal_ros.config.config import IMAGE_TYPE
from semcal_ros.core.errors import ConfigError, MicroscopeError
from semcal_ros.drivers.source import JOINTS, SourceFrame
from semcal_ros.middleware.message_types import message_class
from semcal_ros.nodes.common.context import NodeContext

_ENCODINGS = {"uint8": "mono8", "uint16": "mono16"}
# The moment of the acquisition that the header stamp means.
_PASSED = {"start": 0.0, "centre": 0.5, "end": 1.0}


class SourceOutput:
    """The topics ``image_raw``, ``magnification``, ``stage`` and ``conditions`` of a microscope.

    Parameters
    ----------
    context
        Of the node.
    stage, magnification
        Whether these topics are published.

    Raises
    ------
    ConfigError
        The configuration asks for something that cannot be published.
    """

    def __init__(self, context: NodeContext, *, stage: bool, magnification: bool) -> None:
        config, endpoints = context.config, context.endpoints
        self._config = config
        self._reporter = context.reporter
        if config.image.type != IMAGE_TYPE:
            raise ConfigError(
                f"config {config.name} with images in {config.image.type}",
                expected=f"{IMAGE_TYPE}, which is what this node publishes",
                do="name another configuration",
            )
        source = config.magnification
        if "[" in source.field:
            raise ConfigError(
                f"config {config.name} with a {source.quantity} in {source.field}",
                expected="a field without an index, such as data or vector.x",
                do="name another configuration",
            )
        kind = message_class(source.type)
        self._new_number = kind
        self._set_number(kind(), 1.0)
        self._images = endpoints.stream_publisher(Image, config.image.topic)
        self._numbers = endpoints.latched_publisher(kind, source.topic) if magnification else None
        self._conditions = endpoints.latched_publisher(DiagnosticStatus, "conditions")
        self._joints = None
        if stage and config.stage is not None:
            self._joints = endpoints.latched_publisher(JointState, config.stage.topic)
        self._number: float | None = None
        self._published_conditions: Mapping[str, float | str] | None = None
        self._published_stage: dict[str, float] | None = None
        self._image = Image()

    @property
    def listeners(self) -> int:
        """Number of subscribers of the images."""
        return int(self._images.get_subscription_count())

    def _set_number(self, message: Any, number: float) -> None:
        owner, *path = message, *self._config.magnification.field.split(".")
        try:
            for name in path[:-1]:
                owner = getattr(owner, name)
            setattr(owner, path[-1], type(getattr(owner, path[-1]))(number))
        except (AttributeError, TypeError, ValueError) as error:
            raise ConfigError(
                f"field {self._config.magnification.field} of {self._config.magnification.type}",
                expected="a field that holds a number",
                do="correct magnification.field in the configuration",
            ) from error

    def publish(self, frame: SourceFrame, *, stage: bool = True) -> int:
        """Publish a frame, after what has changed since the one before.

        Parameters
        ----------
        frame
            The frame.
        stage
            Whether what it says about the stage holds.

        Returns
        -------
        The header stamp, ns.

        Raises
        ------
        MicroscopeError
            Its pixels are of another type than 8 or 16 bit grey.
        """
        encoding = _ENCODINGS.get(np.dtype(frame.image.dtype).name)
        if encoding is None or frame.image.ndim != 2:
            raise MicroscopeError(
                f"a frame of {frame.image.dtype} with {frame.image.ndim} axes",
                expected="grey levels of 8 or 16 bit",
            )
        self._publish_magnification(frame)
        if stage:
            self.publish_stage(frame.stage, frame.start_ns)
        self.publish_conditions(frame.conditions)
        acquisition_s = frame.acquisition_s
        if acquisition_s is None and self._config.scan is not None:
            acquisition_s = self._config.scan.acquisition_time_s
        passed = _PASSED[self._config.image.stamp]
        stamp_ns = frame.start_ns + round(passed * (acquisition_s or 0.0) * 1e9)
        header = Header()
        fill_header(header, stamp_ns, self._config.frame_id)
        if self._images.hands_over:
            self._image = Image()
        fill_image(self._image, frame.image, encoding, header)
        self._images.publish(self._image)
        return stamp_ns

    def is_taken(self, wait_s: float = 0.0) -> bool:
        """Return whether all subscribers have told that they received what was published.

        Fast DDS asks them every three seconds.
        """
        timeout = Duration(nanoseconds=max(1, round(wait_s * 1e9)))
        return bool(self._images.wait_for_all_acked(timeout))

    def _publish_magnification(self, frame: SourceFrame) -> None:
        if self._numbers is None:
            return
        width_m = frame.field_width_m
        number = math.nan
        if width_m is not None and math.isfinite(width_m) and width_m > 0.0:
            number = published_number(self._config, width_m, frame.image.shape[1])
            self._reporter.note("magnification", self._config.display_width_m / width_m)
        else:
            self._reporter.note("magnification", "unknown")
        same = number == self._number or (math.isnan(number) and self._number is None)
        if self._number is not None and math.isnan(number) and math.isnan(self._number):
            same = True
        if same:
            return
        self._number = number
        message = self._new_number()
        self._set_number(message, number)
        if optional_stamp_ns(message) is not None:
            fill_stamp(getattr(message, "header", message).stamp, frame.start_ns)
        self._numbers.publish(message)

    def publish_stage(self, stage: Mapping[str, float], stamp_ns: int) -> None:
        """Publish where the stage is, if that has changed; a stage that is no longer known has no joints."""
        source = self._config.stage
        if self._joints is None or source is None:
            return
        joints = {getattr(source, joint): float(stage[joint]) for joint in JOINTS if joint in stage}
        if joints == self._published_stage or (not joints and self._published_stage is None):
            return
        self._published_stage = joints
        message = JointState(name=list(joints), position=list(joints.values()))
        fill_header(message.header, stamp_ns, "")
        self._joints.publish(message)
        self._reporter.note("stage_tilt_rad", stage.get("tilt", "unknown"))

    def publish_conditions(self, conditions: Mapping[str, float | str]) -> None:
        """Publish how the frames are taken, if that has changed."""
        if conditions == self._published_conditions or not (
            conditions or self._published_conditions
        ):
            return
        self._published_conditions = dict(conditions)
        message = DiagnosticStatus()
        fill_conditions(message, conditions, self._config.name)
        self._conditions.publish(message)
