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

"""Executable ``virtual_sem``: a simulated live microscope with a stage and a magnification knob."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Twist
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64, Header

from semcal_ros.bridge.conditions import fill_conditions
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.images import fill_image
from semcal_ros.bridge.magnification import check_magnification
from semcal_ros.config.config import IMAGE_TYPE
from semcal_ros.core.errors import ConfigError, MicroscopeError, SemcalError
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.motion import MotionInterface, motion_with
from semcal_ros.nodes.common.parameters import CONFIG, ParameterDeclaration
from semcal_ros.nodes.common.qos import stream_output
from semcal_ros.nodes.common.run import run_node
from semcal_ros.synthetic import (
    DRIFTS,
    PRESETS,
    SIMULATED_VOLTAGE_V,
    SIMULATED_WORKING_DISTANCE_M,
    SPECIMEN_KINDS,
    STAGES,
    TYPICAL_GRID,
    Detector,
    GridFaults,
    LiveScene,
    Pose,
    SimulatedStage,
    StagePosition,
    VirtualMicroscope,
    conditions_of,
    drift_preset,
    make_stage,
    pose_at,
    pose_on_stage,
    preset,
    read_position,
)
from semcal_ros.synthetic.pose import rotation_about_beam

_PARAMETERS = (
    replace(CONFIG, default="virtual_sem"),
    ParameterDeclaration("preset", "jsm820", "Microscope.", choices=tuple(PRESETS), fixed=True),
    ParameterDeclaration(
        "specimen", "grid", "Specimen.", choices=tuple(SPECIMEN_KINDS), fixed=True
    ),
    ParameterDeclaration(
        "drift", "none", "Drift of the specimen.", choices=tuple(DRIFTS), fixed=True
    ),
    ParameterDeclaration("width", 512, "Image width.", "px", 32, 8192, fixed=True),
    ParameterDeclaration("height", 512, "Image height.", "px", 32, 8192, fixed=True),
    ParameterDeclaration(
        "seed", 0, "Seed of specimen and noise.", low=0, high=2**31 - 1, fixed=True
    ),
    ParameterDeclaration(
        "rate", 0.0, "Frames per second; 0: as fast as they are scanned.", "Hz", 0.0, 200.0
    ),
    ParameterDeclaration("bits", 8, "Depth of the pixels, 8 or 16.", low=8, high=16),
    ParameterDeclaration(
        "magnification", 1000.0, "Magnification at the start.", "", 1.0, 1e6, fixed=True
    ),
    ParameterDeclaration("tilt_deg", 0.0, "Tilt of the stage.", "degrees", -60.0, 60.0),
    ParameterDeclaration(
        "tilt_axis_deg", 0.0, "Direction of the tilt axis in the image.", "degrees", -360.0, 360.0
    ),
    ParameterDeclaration(
        "rotation_deg", 0.0, "Rotation of the specimen.", "degrees", -360.0, 360.0
    ),
    ParameterDeclaration(
        "scan_rotation_deg",
        0.0,
        "Rotation of the scan, which turns specimen and tilt axis in the image.",
        "degrees",
        -360.0,
        360.0,
    ),
    ParameterDeclaration(
        "height_m", 0.0, "Height of the specimen along the beam.", "m", -1e-3, 1e-3
    ),
    ParameterDeclaration(
        "voltage_v",
        SIMULATED_VOLTAGE_V,
        "Voltage that is told; the image does not depend on it.",
        "V",
        10.0,
        1e6,
    ),
    ParameterDeclaration(
        "working_distance_m",
        SIMULATED_WORKING_DISTANCE_M,
        "Working distance that is told; the image does not depend on it.",
        "m",
        1e-4,
        0.2,
    ),
    ParameterDeclaration(
        "stage",
        "one-axis",
        "One tilt axis, which says its tilt; or tilts about the specimen itself, as no stage does.",
        choices=tuple(STAGES),
        fixed=True,
    ),
    ParameterDeclaration(
        "eucentric_error_m",
        STAGES["one-axis"].miss_m[0],
        "How far the axis of a one-axis stage misses the specimen.",
        "m",
        0.0,
        5e-3,
        fixed=True,
    ),
    ParameterDeclaration(
        "repeatability",
        STAGES["one-axis"].scale_sigma,
        "1-sigma of the scale, each time that a magnification is set.",
        "",
        0.0,
        0.05,
        fixed=True,
    ),
    ParameterDeclaration(
        "grid_stretch",
        TYPICAL_GRID.stretch,
        "Relative difference of the grid's axes.",
        "",
        -0.05,
        0.05,
        fixed=True,
    ),
    ParameterDeclaration(
        "grid_shear",
        TYPICAL_GRID.shear,
        "How far the grid's axes are from a right angle.",
        "rad",
        -0.05,
        0.05,
        fixed=True,
    ),
    ParameterDeclaration(
        "grid_bow_m",
        1.0 / TYPICAL_GRID.curvature,
        "Radius to which the grid is bowed, 0.005 or more; 0: flat.",
        "m",
        0.0,
        1e6,
        fixed=True,
    ),
    ParameterDeclaration(
        "grid_wave",
        TYPICAL_GRID.wave,
        "Amplitude of a wave in the grid's rows, of a square.",
        "",
        -0.05,
        0.05,
        fixed=True,
    ),
    ParameterDeclaration(
        "grid_squares",
        TYPICAL_GRID.squares_sigma,
        "1-sigma of each size of the grid's squares.",
        "",
        0.0,
        0.05,
        fixed=True,
    ),
    ParameterDeclaration(
        "line_jitter",
        STAGES["one-axis"].line_jitter_px,
        "1-sigma of the shift of each scan line.",
        "px",
        0.0,
        4.0,
        fixed=True,
    ),
    ParameterDeclaration(
        "tip", 0.0, "Part of the field's width that a tip from the left covers.", "", 0.0, 1.0
    ),
    ParameterDeclaration(
        "grid_extent", 0, "Squares a side of the grid; 0: endless.", "", 0, 100_000, fixed=True
    ),
    ParameterDeclaration(
        "tilt_carries_away",
        False,
        "Whether a tilt about an axis that misses the specimen carries it away; else x and y bring it back.",
        fixed=True,
    ),
    # There is nothing to break, and nobody to ask.
    *motion_with(allow_motion=True, min_tilt=-1.05, min_magnification=1.0, max_magnification=1e8),
)
_POSE = ("tilt_deg", "tilt_axis_deg", "rotation_deg", "height_m", "scan_rotation_deg")
_ENCODINGS = {8: "mono8", 16: "mono16"}


class VirtualSem(SemNode):
    """Publishes ``image_raw`` and, whenever they change, ``magnification``, ``stage`` and ``conditions``.

    Listens to ``~/stage``, ``~/move_stage`` and ``~/set_magnification``.
    """

    def __init__(self) -> None:
        super().__init__("virtual_sem", _PARAMETERS)
        self._start_ns = self.get_clock().now().nanoseconds
        # A frame may take longer to draw than to scan: the stage moves when it is told to, and not after that.
        self._stage_lock = threading.RLock()
        self._mechanics = self._stage_with_faults()
        # Where x and y are, if a tilt does not move them.
        self._travel_m: tuple[float, float] | None = None
        if self.parameters["tilt_carries_away"] and self._mechanics.axis_rad is not None:
            self._travel_m = (0.0, 0.0)
        self._random = np.random.default_rng((self.parameters["seed"], 0x57A6))
        pose, self._position = self._placed()
        self._scene = LiveScene(
            self._microscope(),
            self.parameters["specimen"],
            magnification=self.parameters["magnification"],
            pose=pose,
            drift=drift_preset(self.parameters["drift"]),
            detector=self._detector(self.parameters["bits"]),
            seed=self.parameters["seed"],
            faults=self._mechanics,
            grid=self._grid_with_faults(),
        )
        for name in _POSE:
            self.parameters.on_change(name, self._set_pose)
        self.parameters.on_change("bits", self._set_bits, self._detector)
        self._set_tip(self.parameters["tip"])
        self.parameters.on_change("tip", self._set_tip)
        self.parameters.on_change("rate", self._set_rate)
        source = self._checked_source()
        self._images = self.endpoints.stream_publisher(Image, self.config.image.topic)
        self._magnification = self.endpoints.latched_publisher(Float64, source)
        self._announced: float | None = None
        self._announce()
        self._joints = None
        self._said: dict[str, float] | None = None
        if self._position is not None and self.config.stage is not None:
            self._joints = self.endpoints.latched_publisher(JointState, self.config.stage.topic)
            self._announce_stage()
        self._conditions = self.endpoints.latched_publisher(DiagnosticStatus, "conditions")
        self._published: dict[str, float | str] | None = None
        self._announce_conditions()
        for name in ("voltage_v", "working_distance_m"):
            self.parameters.on_change(name, lambda _value: self._announce_conditions())
        self._stage = self.create_subscription(
            Twist,
            "~/stage",
            self._on_stage,
            stream_output(10),
            callback_group=MutuallyExclusiveCallbackGroup(),
        )
        self._motion = MotionInterface(self.node_context, self)
        self._controls = [
            self.endpoints.trigger_service("~/start", self._start),
            self.endpoints.trigger_service("~/stop", self._stop),
        ]
        self._timer = self.create_timer(self._period_s(), self._take_frame)

    def idle(self) -> bool:
        """Return True: this node receives no frames."""
        return True

    def conditions(self) -> list[str]:
        """Extend the base class: also report whether it is stopped, and why nothing moves."""
        stopped = ["stopped"] if self._timer.is_canceled() else []
        return [*super().conditions(), *stopped, *self._motion.conditions()]

    # -- set-up ------------------------------------------------------------------------------------

    def _checked_source(self) -> str:
        source = self.config.magnification
        if self.config.image.type != IMAGE_TYPE:
            raise ConfigError(
                f"config {self.config.name} with images in {self.config.image.type}",
                expected=f"{IMAGE_TYPE}, which is what this node publishes",
                do="use the configuration virtual_sem",
            )
        if (source.quantity, source.type, source.field) != (
            "magnification",
            "std_msgs/msg/Float64",
            "data",
        ):
            raise ConfigError(
                f"config {self.config.name} with a {source.quantity} in {source.type}",
                expected="a magnification in std_msgs/msg/Float64, which is what this node publishes",
                do="use the configuration virtual_sem",
            )
        return source.topic

    def _microscope(self) -> VirtualMicroscope:
        microscope = preset(self.parameters["preset"])
        microscope = replace(microscope, display_width_m=self.config.display_width_m)
        if self.config.scan is not None:
            microscope = microscope.with_timing(self.config.scan)
        return microscope.with_image_size(self.parameters["width"], self.parameters["height"])

    def _detector(self, bits: int) -> Detector:
        return Detector(bits=bits, databar_rows=self.config.image.databar_rows or 0)

    def _stage_with_faults(self) -> SimulatedStage:
        name = self.parameters["stage"]
        one_axis = STAGES[name].axis_rad is not None
        return make_stage(
            name,
            eucentric_error_m=self.parameters["eucentric_error_m"] if one_axis else None,
            repeatability=self.parameters["repeatability"],
            line_jitter_px=self.parameters["line_jitter"],
        )

    def _grid_with_faults(self) -> GridFaults:
        radius_m = self.parameters["grid_bow_m"]
        return GridFaults(
            stretch=self.parameters["grid_stretch"],
            shear=self.parameters["grid_shear"],
            curvature=1.0 / radius_m if radius_m > 0.0 else 0.0,
            wave=self.parameters["grid_wave"],
            squares_sigma=self.parameters["grid_squares"],
            extent_squares=self.parameters["grid_extent"],
        )

    def _placed(self) -> tuple[Pose, StagePosition | None]:
        """Return where the specimen is, and what the stage says about it before it is moved."""
        tilt, axis, rotation = (math.radians(self.parameters[name]) for name in _POSE[:3])
        height_m = self.parameters["height_m"]
        scan = math.radians(self.parameters["scan_rotation_deg"])
        turn = rotation_about_beam(scan)
        if self._mechanics.axis_rad is None:
            pose = Pose.tilted(tilt, axis, rotation, (0.0, 0.0, height_m))
            return Pose(turn @ pose.R, turn @ pose.t_m), None
        if self._travel_m is None:
            pose, position = pose_on_stage(self._mechanics, tilt, rotation, axis, height_m=height_m)
        else:
            position = StagePosition(tilt, rotation, *self._travel_m)
            pose = pose_at(self._mechanics, position, axis, height_m=height_m)
        position = replace(position, scan_rotation_rad=scan)
        seen = Pose(turn @ pose.R, turn @ pose.t_m)
        return seen, read_position(self._mechanics, position, self._random)

    def _period_s(self) -> float:
        rate = self.parameters["rate"]
        return 1.0 / rate if rate > 0.0 else self._scene.microscope.timing.acquisition_time_s

    # -- control -----------------------------------------------------------------------------------

    def _set_pose(self, _value: float) -> None:
        pose, self._position = self._placed()
        self._scene.set_pose(pose, self._now_s())
        self._announce_stage()
        self._announce_conditions()

    def _set_bits(self, bits: int) -> None:
        self._scene.set_detector(bits=bits)

    def _set_tip(self, part: float) -> None:
        self._scene.set_detector(tip=part)

    def _set_rate(self, _value: float) -> None:
        self._timer.timer_period_ns = round(self._period_s() * 1e9)

    def _on_stage(self, message: Any) -> None:
        try:
            if not self.parameters["allow_motion"]:
                raise MicroscopeError(
                    "a velocity of the stage, which is not allowed",
                    expected="a node that may move its stage",
                    do="start it with -p allow_motion:=true",
                )
            with self._stage_lock:
                self._scene.set_twist(
                    self._now_s(), (message.linear.x, message.linear.y), message.angular.z
                )
                self._announce_stage()
        except SemcalError as error:
            self.reporter.reject(error)

    def _start(self) -> str:
        self._motion.acknowledge()
        was_running = not self._timer.is_canceled()
        self._timer.reset()
        return "running already" if was_running else "started"

    def _stop(self) -> str:
        was_running = not self._timer.is_canceled()
        self._timer.cancel()
        with self._stage_lock:
            self._scene.set_twist(self._now_s(), (0.0, 0.0))
            self._announce_stage()
        return "stopped, the stage too" if was_running else "not running"

    # -- what is asked of ~/move_stage and ~/set_magnification --------------------------------------

    def obstacle(self) -> str:
        """Return why nothing can be moved now; see :class:`~semcal_ros.nodes.common.motion.Performer`."""
        return "it is stopped" if self._timer.is_canceled() else ""

    def position(self) -> dict[str, float]:
        """Return what the stage says of its joints."""
        position = self._reading()
        return {} if position is None else position.joints

    def own_limits(self) -> dict[str, tuple[float, float]]:
        """Return the range of the parameters that the joints are."""
        angles = {"tilt": 60.0, "rotation": 360.0, "scan_rotation": 360.0}
        return {joint: (-math.radians(far), math.radians(far)) for joint, far in angles.items()}

    def move(self, target: Mapping[str, float]) -> None:
        """Move at once to where the stage then says that it is, but for the scatter of its readings."""
        constant = {
            "tilt": self._mechanics.tilt_error_rad,
            "rotation": self._mechanics.rotation_error_rad
            + self._scene.stage.rotation_at(self._now_s()),
            "scan_rotation": 0.0,
        }
        turned = [
            Parameter(f"{joint}_deg", value=math.degrees(target[joint] - constant[joint]))
            for joint in constant
            if joint in target
        ]
        for result in self.set_parameters(turned):
            if not result.successful:
                raise MicroscopeError(result.reason)
        if self._travel_m is not None and ("x" in target or "y" in target):
            x_m, y_m = self._travel_m
            self._travel_m = target.get("x", x_m), target.get("y", y_m)
            self._set_pose(0.0)
        elif "x" in target or "y" in target:
            # A tilt about an axis that misses the specimen has brought it back to the beam by x and y.
            with self._stage_lock:
                now_s, before = self._now_s(), self.position()
                x, y = self._scene.stage.position_at(now_s)[0]
                way = [target.get(joint, before[joint]) - before[joint] for joint in ("x", "y")]
                self._scene.place_stage(now_s, (float(x) + way[0], float(y) + way[1]))
        self._announce_stage()

    def set_magnification(self, magnification: float) -> None:
        """Set it at once."""
        self._scene.set_magnification(check_magnification(magnification), self._now_s())
        self._announce()

    def run(self, work: Callable[[], str], done: Callable[[str, SemcalError | None], None]) -> None:
        """Do it here: nothing takes any time."""
        try:
            answer = work()
        except SemcalError as error:
            done("", error)
        else:
            done(answer, None)

    # -- frames ------------------------------------------------------------------------------------

    def _now_s(self) -> float:
        return (self.get_clock().now().nanoseconds - self._start_ns) * 1e-9

    def _announce(self) -> None:
        """Publish the magnification if it has changed; the frame that is being scanned shows both."""
        if self._scene.magnification != self._announced:
            self._announced = self._scene.magnification
            self._magnification.publish(Float64(data=self._announced))
            self.reporter.note("magnification", self._announced)

    def _reading(self) -> StagePosition | None:
        """What the stage says, or None for one that says nothing."""
        if self._position is None:
            return None
        now_s, motion = self._now_s(), self._scene.stage
        x, y = motion.position_at(now_s)[0]
        return replace(
            self._position,
            rotation_rad=self._position.rotation_rad + motion.rotation_at(now_s),
            x_m=self._position.x_m + float(x),
            y_m=self._position.y_m + float(y),
        )

    def _announce_stage(self) -> None:
        """Publish where the stage is if it has moved."""
        with self._stage_lock:
            self._announce_reading(self._reading(), self._now_s())

    def _announce_reading(self, position: StagePosition | None, now_s: float) -> None:
        if self._joints is None or position is None or self.config.stage is None:
            return
        source = self.config.stage
        said = {getattr(source, joint): value for joint, value in position.joints.items()}
        if said == self._said:
            return
        first, self._said = self._said is None, said
        message = JointState(name=list(said), position=list(said.values()))
        # The frames that are being scanned when the node starts show the stage where it is now.
        since_s = now_s - self._scene.microscope.timing.acquisition_time_s if first else now_s
        fill_header(message.header, self._start_ns + round(since_s * 1e9), "")
        self._joints.publish(message)
        self.reporter.note("stage_tilt_rad", position.tilt_rad)

    def _announce_conditions(self) -> None:
        """Publish how the frames are taken if that has changed."""
        conditions = conditions_of(
            self._scene.microscope,
            voltage_v=self.parameters["voltage_v"],
            working_distance_m=self.parameters["working_distance_m"],
            scan_rotation_rad=math.radians(self.parameters["scan_rotation_deg"]),
        )
        if conditions != self._published:
            self._published = conditions
            message = DiagnosticStatus()
            fill_conditions(message, conditions, self.config.name)
            self._conditions.publish(message)

    def _take_frame(self) -> None:
        # The frame that has just been completed: the stamp is the time at which its first pixel was scanned.
        start_s = self._now_s() - self._scene.microscope.timing.acquisition_time_s
        try:
            frame = self._scene.frame(start_s)
            stamp_ns = self._start_ns + round((start_s - self.config.start_offset_s) * 1e9)
            self._announce_stage()
            header, message = Header(), Image()
            fill_header(header, stamp_ns, self.config.frame_id)
            fill_image(message, frame.image, _ENCODINGS[8 * frame.image.dtype.itemsize], header)
            self._images.publish(message)
            self.reporter.count_published(stamp_ns)
        except SemcalError as error:
            self.reporter.reject(error)


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(VirtualSem, args, threads=2)


if __name__ == "__main__":
    raise SystemExit(main())
