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

"""One run of visual servoing without ROS: the same loop as the nodes', frame by frame, with the truth beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.applications.servoing import (
    NestedTarget,
    PlaneCamera,
    PlanePose,
    Servo,
    ServoSettings,
    find_target,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.synthetic import LiveScene, Pose, VirtualMicroscope, drift_preset
from semcal_ros.synthetic.stage import ActuatorFaults, StageActuator

# Between the end of a frame and the moment from which the stage obeys: transport and work.
LATENCY_S = 0.1
# As the node's parameter reset_beyond.
RESET_BEYOND = 0.15


@dataclass(frozen=True)
class Case:
    """What the controller knows of the microscope; images are corrected with it, or raw."""

    name: str
    camera_at: Callable[[float], ScanCamera]
    corrected: bool


@dataclass(frozen=True)
class Task:
    """The same for all cases."""

    microscope: VirtualMicroscope
    start: Pose
    goal: PlanePose
    schedule: Sequence[tuple[float, int]]
    drift: str = "slow"
    seed: int = 0
    settings: ServoSettings = field(default_factory=ServoSettings)
    stage: ActuatorFaults = field(default_factory=ActuatorFaults)
    #: What the detector makes of an image: a body in front of the target, a reversed contrast.
    seen: Callable[[np.ndarray], np.ndarray] = lambda image: image
    #: Largest fraction of the interval by which a frame is late.
    late: float = 0.0
    specimen: str = "target"


@dataclass
class Run:
    """One row per frame."""

    name: str
    magnification: list[float] = field(default_factory=list)
    true_error: list[np.ndarray] = field(default_factory=list)
    true_px: list[float] = field(default_factory=list)
    own_px: list[float] = field(default_factory=list)
    own_m: list[float] = field(default_factory=list)
    sigma_px: list[float] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    axis_px: list[np.ndarray] = field(default_factory=list)
    axis_sigma_px: list[float] = field(default_factory=list)
    converged: list[bool] = field(default_factory=list)
    reason: list[str] = field(default_factory=list)
    start_s: list[float] = field(default_factory=list)
    twist: list[np.ndarray] = field(default_factory=list)
    raw: list[np.ndarray] = field(default_factory=list)
    images: dict[float, np.ndarray] = field(default_factory=dict)

    def true_m(self) -> np.ndarray:
        """Distance of the target's origin from the goal, m."""
        return np.hypot(*np.array(self.true_error)[:, :2].T)


class Corrector:
    """What stream_corrector does: rectify, and take the drift, the travel of the stage included, out of the picture."""

    def __init__(self) -> None:
        self._tracker = DriftTracker()
        self._rectifier = Rectifier()

    def corrected(self, image, start_s, camera, timing):
        update = self._tracker.update(image, start_s, camera, timing)
        picture = self._rectifier.rectify(image, camera, update.raster, timing)
        if np.max(np.abs(update.drift_px)) > RESET_BEYOND * image.shape[1]:
            # What the node asks ~/reset for: the next frame has zero drift.
            self._tracker.reset()
        return picture, update.drift_m

    def reset(self) -> None:
        self._tracker.reset()


def servo_run(task: Task, case: Case) -> Run:
    """Servo through all magnifications of the task."""
    scope, run = task.microscope, Run(case.name)
    scene = LiveScene(
        scope,
        task.specimen,
        magnification=task.schedule[0][0],
        pose=task.start,
        drift=drift_preset(task.drift),
        seed=task.seed,
    )
    servo, corrector, target = Servo(task.goal, task.settings), Corrector(), NestedTarget()
    stage, rng = StageActuator(task.stage), np.random.default_rng(task.seed)
    period_s = scope.timing.acquisition_time_s + LATENCY_S

    def interval() -> float:
        return period_s * (1.0 + task.late * float(rng.random()))

    start_s, interval_s = 0.0, interval()
    for g, frames in task.schedule:
        scene.set_magnification(g, start_s)
        for _ in range(frames):
            frame = scene.frame(start_s)
            frame = replace(frame, image=task.seen(frame.image))
            camera, picture, shift_m = case.camera_at(g), frame.image, np.zeros(2)
            if case.corrected:
                picture, shift_m = corrector.corrected(picture, start_s, camera, scope.timing)
            view = find_target(picture, target)
            if case.corrected and not view.accepted:
                corrector.reset()
            command_s = start_s + interval_s
            step = servo.update(
                view,
                PlaneCamera.from_camera(camera),
                start_s + scope.timing.centre_offset_s,
                interval_s=interval_s,
                now_s=command_s,
                shift_m=shift_m,
            )
            interval_s = interval()
            x, y, turn = (float(v) for v in step.twist)
            for time_s, velocity in stage.obey((x, y), command_s, command_s + interval_s):
                scene.set_twist(time_s, velocity, turn)
            servo.record_command(command_s, step.twist)
            _record(run, task, g, frame, step)
            start_s = command_s
        run.images[g] = frame.image
    return run


def _record(run: Run, task: Task, g: float, frame, step) -> None:
    place, turn = frame.pose.t_m[:2] + frame.drift_m, frame.pose.R
    truth = PlanePose(float(place[0]), float(place[1]), math.atan2(turn[1, 0], turn[0, 0]))
    error = truth.minus(task.goal)
    slope = task.microscope.camera_at(g).ideal_from_sem_jacobian
    run.magnification.append(g)
    run.start_s.append(frame.start_time_s)
    run.twist.append(step.twist)
    run.raw.append(frame.image)
    run.true_error.append(error)
    run.true_px.append(float(np.hypot(*(slope @ error[:2]))))
    run.own_px.append(step.error_px)
    run.own_m.append(step.error_m)
    run.sigma_px.append(step.sigma_px)
    run.sigma_m.append(step.sigma_m)
    run.axis_px.append(step.axis_px)
    run.axis_sigma_px.append(step.axis_sigma_px)
    run.converged.append(step.converged)
    run.reason.append(step.reason)
