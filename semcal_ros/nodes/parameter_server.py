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

"""Executable ``parameter_server``: serves the calibration at any magnification, on topics and as parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import TransformStamped
from rcl_interfaces.msg import ParameterDescriptor, ParameterType, SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Float64MultiArray, Header, String

from semcal_ros.bridge.continuous_parameters import is_continuous_parameter, read_parameter
from semcal_ros.bridge.magnification import MagnificationReading
from semcal_ros.bridge.projection import (
    StaticFrame,
    fill_camera_info,
    fill_projection,
    fill_projection_covariance,
    fill_static_frames,
    static_frames,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import ConfigError, InvalidValueError, SemcalError
from semcal_ros.middleware import message_class
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.parameters import (
    CALIBRATION,
    REPLAYED_CALIBRATION,
    ParameterDeclaration,
)
from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.frames.calibration_input import OUT_OF_RANGE, CalibrationInput, RangeWatch
from semcal_ros.nodes.frames.held_values import ConditionsWatch, MagnificationInput

if TYPE_CHECKING:
    from semcal_ros.nodes.frames.calibration_monitor import CalibrationMonitor

_SIZE = (
    ParameterDeclaration(
        "image_width", 0, "Width of the live frames; 0: that of the calibration.", "px", 0, 65536
    ),
    ParameterDeclaration(
        "image_height", 0, "Height of the live frames; 0: that of the calibration.", "px", 0, 65536
    ),
)
_MONITOR_PERIOD = ParameterDeclaration(
    "monitor_period",
    0.0,
    "Time between two frames that are looked at: where one shows the grid, the diagnostics say whether the calibration"
    " still holds. 0: none is.",
    "s",
    0.0,
    86400.0,
    fixed=True,
)
# Time to discover other publishers of a calibration, and to receive a calibration once one is discovered.
_LISTEN_FIRST_S, _LISTEN_AT_MOST_S = 3.0, 5.0
# How often the end of these times is checked: six times within the shorter one.
_TICK_S = 0.5
# How soon another publisher of `camera_info`, or its end, is noticed: about as long as discovery takes.
_WATCH_S = 0.5


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


class ParameterServer(SemNode):
    """Publishes ``calibration``, ``camera_info``, ``projection`` and its covariance; answers ``p@5250`` and the like.

    A calibration that another node publishes is taken over and republished for late subscribers.
    """

    def __init__(self) -> None:
        super().__init__(
            "parameter_server",
            (CALIBRATION, REPLAYED_CALIBRATION, OUT_OF_RANGE, *_SIZE, _MONITOR_PERIOD),
        )
        self._reading: MagnificationReading | None = None
        self._published_g: float | None = None
        self._range = RangeWatch(self.reporter)
        self._text = self.endpoints.latched_publisher(String, "calibration")
        self._info: Any = self.endpoints.latched_publisher(CameraInfo, "camera_info")
        self._info_topic = str(self._info.topic_name)
        self._projection = self.endpoints.latched_publisher(Float64MultiArray, "projection")
        self._covariance = self.endpoints.latched_publisher(
            Float64MultiArray, "projection_covariance"
        )
        self._frames = StaticFramesOutput(self.node_context)
        self._calibration = CalibrationInput(self.node_context, on_change=self._on_calibration)
        self._watch = ConditionsWatch(self.node_context, lambda: self._calibration.current)
        for setting in _SIZE:
            self.parameters.on_change(setting.name, lambda _value: self._refresh())
        self._magnification = MagnificationInput(self.node_context, self._on_reading)
        self._monitor: CalibrationMonitor | None = None
        if self.parameters[_MONITOR_PERIOD.name] > 0.0:
            # What finds grids and checks calibrations is twice as large as the rest of the node.
            from semcal_ros.nodes.frames.calibration_monitor import CalibrationMonitor

            self._monitor = CalibrationMonitor(
                self.node_context,
                self._magnification,
                lambda: (self._calibration.current, self._calibration.config),
                self.parameters[_MONITOR_PERIOD.name],
            )
        self._reload = self.endpoints.trigger_service("~/reload", self._on_reload)
        # A restarted server must not set all nodes back to its file while another node, such as calibration_server,
        # still holds a calibration that has come into force since.
        self._listened_s = 0.0
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._listening = self.create_timer(_TICK_S, self._publish_start, clock=steady)
        self._watching = self.create_timer(_WATCH_S, self._watch_camera, clock=steady)

    def idle(self) -> bool:
        """Return True: a constant magnification is normal."""
        return True

    def introduction(self) -> list[str]:
        """Extend the base class: also the calibration."""
        return [*super().introduction(), self._calibration.introduction]

    def conditions(self) -> list[str]:
        """Extend the base class: also report a calibration that is missing, or that does not cover the
        magnification, or whose scale is in doubt, or that was made under other conditions.
        """
        outside = ["magnification outside the calibrated range"] * self._range.is_outside
        doubts = self._calibration.conditions() + self._watch.conditions()
        doubts += [] if self._monitor is None else self._monitor.conditions()
        return super().conditions() + outside + doubts

    # -- topics ------------------------------------------------------------------------------------

    def _on_calibration(self) -> None:
        self._calibration.publish(self._text)
        self._refresh()

    def _publish_start(self) -> None:
        """Publish the file given at start once it is clear that no other calibration is in force."""
        self._listened_s += _TICK_S
        others = self.count_publishers(self._text.topic_name) > 1
        published = self._calibration.has_published
        if not published and self._listened_s < (_LISTEN_AT_MOST_S if others else _LISTEN_FIRST_S):
            return
        self._listening.cancel()
        if not published:
            self._calibration.publish(self._text)
            self._refresh()

    def _on_reading(self, reading: MagnificationReading) -> None:
        self._reading = reading
        self._update()

    def _refresh(self) -> None:
        self._published_g = None
        self._update()

    def _update(self) -> None:
        """Publish camera and projection if the magnification differs from the last one."""
        source = self._calibration
        if source.current is None or self._reading is None:
            return
        if not source.has_published:
            return  # the file given at start has to wait
        width = self.parameters["image_width"] or source.current.image_width
        height = self.parameters["image_height"] or source.current.image_height
        try:
            reading = MagnificationReading(
                self._reading.value, self._reading.stamp_ns, source.config
            )
            g = reading.magnification(width)
            if g == self._published_g:
                return
            camera = source.current.at(g).resized(width, height)
            self._range.check(source.current, camera, g)
            self._publish(camera, width, height)
        except SemcalError as error:
            self.reporter.reject(error)
            return
        self._published_g = g
        self.reporter.note("magnification", g)

    def _publish(self, camera: Any, width: int, height: int) -> None:
        covariance, projection = Float64MultiArray(), Float64MultiArray()
        fill_projection(projection, camera)
        # First: who has the projection can then use its covariance at once.
        if camera.covariance is not None:
            fill_projection_covariance(covariance, camera)
            self._covariance.publish(covariance)
        self._projection.publish(projection)
        self._frames.publish(camera)
        self.reporter.count_published(None)
        self._share_camera()
        if self._info is not None:
            self._publish_info(camera, width, height)

    def _share_camera(self) -> None:
        """Publish ``camera_info`` only where no other node publishes that of every image.

        Two sources would break its pairs, and a late subscriber would also get what is kept here, of a magnification
        that is over.
        """
        before = self._info
        others = self.count_publishers(self._info_topic) > int(before is not None)
        if others and before is not None:
            self.endpoints.withdraw("camera_info")
            self.reporter.forget("subscribers.camera_info")
            self._info = None
        elif not others and before is None:
            self._info = self.endpoints.latched_publisher(CameraInfo, "camera_info")

    def _watch_camera(self) -> None:
        without = self._info is None
        self._share_camera()
        if without and self._info is not None:
            self._refresh()

    def _publish_info(self, camera: Any, width: int, height: int) -> None:
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.config.frame_id)
        info = CameraInfo()
        flagged = not camera.in_range and self.parameters[OUT_OF_RANGE.name] == "flag"
        fill_camera_info(info, None if flagged else camera, header, width, height)
        self._info.publish(info)

    # -- services ----------------------------------------------------------------------------------

    def _on_reload(self) -> str:
        path = self.parameters["calibration"]
        if not path:
            raise InvalidValueError(
                "no calibration file to read again",
                expected="the parameter calibration to be set",
            )
        try:
            self._calibration.load(path)
        except SemcalError as error:
            self.reporter.reject(error)
            raise
        return f"read {path}"

    # -- continuous parameters -----------------------------------------------------------------------

    def _continuous(self, name: str) -> Parameter:
        """Return the value of ``kind@magnification``; if there is none, log why and return a parameter not set."""
        try:
            if self._calibration.current is None:
                raise InvalidValueError(
                    f"parameter {name} without a calibration",
                    expected="the parameter calibration to name a file",
                )
            value = read_parameter(name, self._calibration.current)
        except SemcalError as error:
            self.reporter.reject(error)
            return Parameter(name, Parameter.Type.NOT_SET, None)
        return Parameter(name, Parameter.Type.DOUBLE_ARRAY, value)

    def get_parameter(self, name: str) -> Parameter:
        """Extend the base class: continuous parameters are computed."""
        if is_continuous_parameter(name):
            return self._continuous(name)
        return super().get_parameter(name)

    def get_parameter_type(self, name: str) -> Any:
        """Extend the base class: a continuous parameter is an array of doubles, where it has a value."""
        if is_continuous_parameter(name):
            return self._continuous(name).type_.value
        return super().get_parameter_type(name)

    def describe_parameter(self, name: str) -> ParameterDescriptor:
        """Extend the base class: a continuous parameter is computed, and cannot be set."""
        if not is_continuous_parameter(name):
            return super().describe_parameter(name)
        return ParameterDescriptor(
            name=name,
            type=ParameterType.PARAMETER_DOUBLE_ARRAY,
            description="Computed from the calibration at the magnification after the @.",
            read_only=True,
        )

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Extend the base class: continuous parameters are refused."""
        for parameter in parameter_list:
            if is_continuous_parameter(parameter.name):
                reason = f"{parameter.name} is computed from the calibration and cannot be set"
                return SetParametersResult(successful=False, reason=reason)
        return super().set_parameters_atomically(parameter_list)


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(ParameterServer, args)


if __name__ == "__main__":
    raise SystemExit(main())
