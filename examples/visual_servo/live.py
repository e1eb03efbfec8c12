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

"""The servoing example with the real nodes, as processes of their own over DDS.

The referee looks at the raw images with the true camera of the virtual microscope; the nodes have only the calibration.
"""

from __future__ import annotations

import json
import math
import time
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from examples.live_nodes import LiveNodes
from examples.visual_servo.loop import Run
from semcal_ros.applications.servoing import (
    NestedTarget,
    PlaneCamera,
    PlanePose,
    TargetView,
    find_target,
    fit_pose,
)
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.bridge.images import image_from_message
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.synthetic import VirtualMicroscope

NODES = ("parameter_server", "stream_corrector", "visual_servo", "virtual_sem")
START_S, STAGE_S = 180.0, 90.0
# Nearer than this the stage is where it was sent.
ARRIVED_M = 1e-7
# Frames at a magnification after it has converged there.
HELD = 6
# Frames after a change of the magnification that are waited for first.
CHANGING = 6
# How far a tip comes in, as parts of the field's width, and frames at each place.
TIP, TIP_FRAMES = (0.08, 0.16, 0.24, 0.32), 3


class Suite:
    """The nodes, and what this process hears of them."""

    def __init__(self, folder: Path, preset: str, drift: str, seed: int, goal: PlanePose) -> None:
        calibrated = {"calibration": (folder / "cal.yaml").absolute()}
        parameters = {
            "parameter_server": calibrated,
            "stream_corrector": calibrated,
            "visual_servo": {
                "goal_x_m": goal.x_m,
                "goal_y_m": goal.y_m,
                "goal_rotation_deg": math.degrees(goal.angle_rad),
            },
            "virtual_sem": {
                "preset": preset,
                "specimen": "target",
                "drift": drift,
                "seed": seed,
                "magnification": 500.0,
                "rotation_deg": 22.0,
            },
        }
        self._nodes = LiveNodes(folder / "logs")
        for name in NODES:
            self._nodes.start(name, {"config": "virtual_sem", **parameters[name]})
        rclpy.init()
        self._node = rclpy.create_node("referee", namespace="/sem")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self.images: dict[int, np.ndarray] = {}
        self.states: dict[str, dict[str, str]] = {}
        self.joints: dict[str, float] = {}
        queue = QoSProfile(depth=50)
        self._subscriptions = [
            self._node.create_subscription(Image, "image_raw", self._on_image, queue),
            self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, queue),
            self._node.create_subscription(
                JointState,
                "stage",
                self._on_stage,
                QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
            ),
        ]
        self._move = self._node.create_publisher(JointState, "virtual_sem/move_stage", queue)
        self._start = self._node.create_client(Trigger, "visual_servo/start")
        self._set = self._node.create_client(SetParameters, "virtual_sem/set_parameters")
        self.knob = self._node.create_publisher(Float64, "virtual_sem/set_magnification", queue)

    def _on_image(self, message: Image) -> None:
        self.images[stamp_ns_from_msg(message)] = image_from_message(message).copy()

    def _on_report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            node = status.name.partition(":")[0].rpartition("/")[2]
            self.states[node] = {value.key: value.value for value in status.values}

    def _on_stage(self, message: JointState) -> None:
        self.joints = dict(zip(message.name, message.position, strict=True))

    def close(self) -> None:
        """End the nodes, the servo before the microscope."""
        self._nodes.end()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def spin_until(self, condition, limit_s: float) -> bool:
        """Whether the condition came true in time."""
        until = time.monotonic() + limit_s
        while not condition():
            self._executor.spin_once(timeout_sec=0.05)
            self._nodes.check()
            if time.monotonic() > until:
                return False
        return True

    def begin(self, travel_m: tuple[float, float]) -> None:
        """Move the stage away from where it is, then let the servo take over."""
        ready = (
            lambda: self._move.get_subscription_count() and self.knob.get_subscription_count(),
            lambda: self._start.service_is_ready() and len(self.images) > 2 and self.joints,
        )
        if not all(self.spin_until(condition, START_S) for condition in ready):
            raise RuntimeError("the nodes were not found")
        # Not by a velocity for some seconds: on a machine with other work they are more, and the target is lost.
        target = {
            joint: self.joints[joint] + way for joint, way in zip(("x", "y"), travel_m, strict=True)
        }
        self._move.publish(JointState(name=list(target), position=list(target.values())))

        def has_arrived() -> bool:
            return all(abs(self.joints[name] - at) < ARRIVED_M for name, at in target.items())

        if not self.spin_until(has_arrived, START_S):
            raise RuntimeError("the stage did not move")
        answer = self._start.call_async(Trigger.Request())
        self.spin_until(answer.done, START_S)

    def set_tip(self, part: float) -> None:
        """Let a tip cover so much of the field from now on."""
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=part)
        request = SetParameters.Request(parameters=[Parameter(name="tip", value=value)])
        answer = self._set.call_async(request)
        if not self.spin_until(answer.done, START_S) or not answer.result().results[0].successful:
            raise RuntimeError("virtual_sem did not take the tip")

    def converged_at(self, g: float) -> bool:
        """Whether the servo itself says so, of frames of that magnification."""
        servo, corrector = (self.states.get(n, {}) for n in ("visual_servo", "stream_corrector"))
        same = float(corrector.get("magnification", "nan").replace("unknown", "nan")) == g
        return same and servo.get("servo_state") == "converged"


def live(
    folder: Path,
    microscope: VirtualMicroscope,
    preset: str,
    drift: str,
    seed: int,
    goal: PlanePose,
    travel_m: tuple[float, float],
    magnifications: list[float],
    *,
    with_tip: bool = False,
) -> tuple[Run, list[float]]:
    """Servo with the nodes through all magnifications: the truth of every frame that was heard, and the magnifications
    at which the servo did not converge. ``with_tip`` lets a tip enter the field from the left, to a third of it, at
    each of them.
    """
    run, missed = Run("live nodes"), []
    suite = Suite(folder, preset, drift, seed, goal)
    try:
        suite.begin(travel_m)
        for k, g in enumerate(magnifications):
            began, first = time.monotonic(), len(suite.images)
            suite.knob.publish(Float64(data=g))
            # What is told right after the change may be of the frames before it.
            suite.spin_until(lambda count=first + CHANGING: len(suite.images) >= count, STAGE_S)
            reached = suite.spin_until(lambda value=g: suite.converged_at(value), STAGE_S)
            entered, share = None, math.nan
            if with_tip and reached:
                entered = len(suite.images) - first
                for part in TIP:
                    suite.set_tip(part)
                    count = len(suite.images) + TIP_FRAMES
                    suite.spin_until(lambda count=count: len(suite.images) >= count, STAGE_S)
                share = float(suite.states["stream_corrector"].get("drift_moving_share", "nan"))
                # It holds what it has, with the tip in the picture.
                reached = suite.spin_until(lambda value=g: suite.converged_at(value), STAGE_S)
            if not reached:
                missed.append(g)
            frames = len(suite.images) - first
            held = len(suite.images) + HELD
            suite.spin_until(lambda count=held: len(suite.images) >= count, STAGE_S)
            errors_px = _judged(run, suite, microscope, goal, g, first)
            own = suite.states.get("visual_servo", {})
            is_seen = bool(np.any(np.isfinite(errors_px[-HELD:])))
            with_tip_px = errors_px[entered:]
            print(
                f"{g:6g}x {'converged' if reached else 'NOT converged'} after {frames:2} frames,"
                f" {time.monotonic() - began:4.0f} s; own error {float(own['servo_error_px']):.3f}"
                f" +- {float(own['servo_sigma_px']):.3f} px;"
                + (
                    f" truth {run.true_px[-1]:.3f} px, {1e9 * run.true_m()[-1]:.1f} nm"
                    if is_seen
                    else f" truth not seen in the last {HELD} frames"
                )
                + f"; resets {own['servo_resets']}"
                + (
                    f"; tip left out of {100.0 * share:.0f} % of the field, in {len(with_tip_px)} frames with it at"
                    f" most {np.nanmax(with_tip_px):.3f} px off"
                    if entered is not None and np.any(np.isfinite(with_tip_px))
                    else ""
                ),
                flush=True,
            )
            if not reached and not is_seen:
                # Nothing brings the target back into view.
                missed += magnifications[k + 1 :]
                break
            if with_tip:
                suite.set_tip(0.0)
    finally:
        suite.close()
    (folder / "live.json").write_text(
        json.dumps({"magnification": run.magnification, "true_px": run.true_px}, indent=1)
    )
    return run, missed


def _judged(
    run: Run, suite: Suite, microscope: VirtualMicroscope, goal: PlanePose, g: float, first: int
) -> np.ndarray:
    """Where the target was in the frames since the last change, by the true microscope.

    Returns how far it was from its place in each of them, px; NaN where it was not seen, as in mixed frames.
    """
    camera = microscope.camera_at(g)
    errors_px = []
    rectifier, plane = Rectifier("cubic"), PlaneCamera.from_camera(camera)
    for stamp in list(suite.images)[first:]:
        image = suite.images[stamp]
        view = find_target(rectifier.rectify(image, camera), NestedTarget())
        fit = fit_pose(without_residual(view, microscope, g), plane)
        if not fit.accepted or abs(fit.scale - 1.0) > 0.02:
            errors_px.append(math.nan)
            continue
        error = fit.pose.minus(goal)
        errors_px.append(float(np.hypot(*(camera.ideal_from_sem_jacobian @ error[:2]))))
        run.magnification.append(g)
        run.true_error.append(error)
        run.true_px.append(errors_px[-1])
        run.images[g] = image
    return np.array(errors_px)


def without_residual(view: TargetView, microscope: VirtualMicroscope, g: float) -> TargetView:
    """Corners that were found in an image rectified with the parameters alone, where they are without the residual."""
    if not view.accepted or microscope.residual.is_zero:
        return view
    camera = microscope.camera_at(g)
    plane = PlaneCamera.from_camera(camera)
    seen = plane.plane_from_px(view.xy.reshape(-1, 2))
    raw = camera.project(np.column_stack([seen, np.zeros(len(seen))]))
    true = camera.sem_from_ideal(microscope.undistort(g, raw))[:, :2]
    return view.with_corners(plane.project(true).reshape(view.xy.shape))
