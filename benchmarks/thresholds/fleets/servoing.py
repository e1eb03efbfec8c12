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

"""A target in pictures of the simulator, and a servo that moves a stage without pictures.

Errors of pictures are those of the target's place, in px; those of a stage are how far the target is from its goal at
the end, in nm.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.thresholds.answers import Answer, digest_of
from semcal_ros.applications.servoing import (
    NestedTarget,
    PlaneCamera,
    PlanePose,
    Servo,
    ServoSettings,
    ServoStep,
    TargetView,
    find_target,
    fit_pose,
)
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.synthetic import Detector, Pose, preset, render_frame
from semcal_ros.synthetic.specimens.target import TargetSpecimen, random_target

Floats = NDArray[np.float64]

SCOPE = replace(preset("jsm820"), timing=ScanTiming(0.1))
TARGET = NestedTarget()
SIZE, POSES = 320, 8
WRONG_PX, WRONG_SIGMAS = 0.3, 4.0
SIGMA_PX, PERIOD_S, LATENCY_S = 0.03, 0.5, 0.2
GOAL = PlanePose(3e-6, -2e-6, 0.05)
QUICK = ServoSettings(gain_hz=2.0, travel_limit_px=40.0)
ZOOM = (500.0,) * 14 + (1200.0,) * 4 + (2500.0,) * 4 + (5000.0,) * 8
# While the target is on its way.
EARLY_ZOOM = (500.0,) * 5 + (1000.0,) * 8 + (2000.0,) * 20
JUDGED_FRAMES = 4


@dataclass(frozen=True)
class Pictures:
    """Pictures of a target, rectified, and where it lies in each; None where there is none."""

    images: tuple[Any, ...]
    poses: tuple[PlanePose | None, ...]
    magnification: float


@dataclass(frozen=True)
class Loop:
    """A stage and its servo.

    Attributes
    ----------
    settings
        Of the servo.
    drift_m_s, obeys, late_s
        Drift of the ground, what the stage does of a command, and how late beyond what it says.
    knock
        Whether the ground jumps once, by 3 um.
    axis_px
        By how much the cameras are off.
    renewed
        Whether another calibration comes into force, whose scale differs by 0.5 %.
    foretold
        Whether the latency is known.
    zoom
        Magnifications of the frames.
    """

    settings: ServoSettings = QUICK
    drift_m_s: tuple[float, float] = (0.0, 0.0)
    obeys: Floats = field(default_factory=lambda: np.eye(3))
    late_s: float = 0.0
    knock: bool = False
    axis_px: tuple[float, float] = (0.0, 0.0)
    renewed: bool = False
    foretold: bool = True
    zoom: tuple[float, ...] = ZOOM


def draw() -> dict[str, Any]:
    """Draw the pictures."""
    rng = np.random.default_rng(5)
    cases: dict[str, Any] = {}
    for g in (200.0, 1000.0, 5000.0):
        cases[f"target at {g:g}x"] = _take(rng, g, TargetSpecimen(), Detector())
    cases["few electrons"] = _take(rng, 1000.0, TargetSpecimen(), Detector(electrons=25.0))
    cases["blurred"] = _take(rng, 1000.0, TargetSpecimen(), Detector(blur_px=2.0))
    cases["rough target"] = _take(rng, 1000.0, random_target(1), Detector())
    dusty = cases["target at 1000x"]
    cases["dust"] = replace(dusty, images=tuple(_with_dust(rng, one) for one in dusty.images))
    small = [cv2.resize(one, (128, 128), interpolation=cv2.INTER_AREA) for one in dusty.images]
    cases["small markers"] = replace(dusty, images=tuple(small))
    noise = np.clip(rng.normal(100.0, 30.0, (SIZE, SIZE)), 0, 255).astype(np.uint8)
    cases["no target"] = Pictures((noise, cv2.blur(noise, (9, 9))), (None, None), 1000.0)
    steady = (25e-9, -14e-9)
    mirrored = np.diag([1.0, -1.0, 1.0])
    cases |= {
        "zoom": Loop(),
        "zoom and drift": Loop(drift_m_s=steady),
        "axis off": Loop(axis_px=(9.0, -6.0)),
        "late stage": Loop(late_s=0.28),
        "latency not known": Loop(replace(QUICK, gain_hz=100.0), foretold=False),
        "high gain": Loop(replace(QUICK, gain_hz=100.0), drift_m_s=steady),
        "knock": Loop(drift_m_s=steady, knock=True),
        "renewed calibration": Loop(renewed=True),
        "lame stage": Loop(obeys=0.95 * np.eye(3)),
        "weak stage": Loop(obeys=np.diag([0.6, 0.6, 1.0]), zoom=EARLY_ZOOM),
        "uneven stage": Loop(obeys=np.diag([0.7, 1.3, 1.0]), drift_m_s=steady, zoom=EARLY_ZOOM),
        "held for long": Loop(drift_m_s=(100e-9, -60e-9), zoom=ZOOM + (5000.0,) * 200),
        "stuck stage": Loop(obeys=np.zeros((3, 3)), zoom=(500.0,) * 20),
        "mirrored stage": Loop(obeys=mirrored, zoom=(500.0,) * 20),
        "eager stage": Loop(obeys=6.0 * np.eye(3), zoom=(500.0,) * 20),
    }
    return cases


def _take(rng: np.random.Generator, g: float, specimen: Any, detector: Detector) -> Pictures:
    scope, field_m = SCOPE.with_image_size(SIZE, SIZE), 0.12 / g
    camera = scope.camera_at(g)
    poses, images = [], []
    for number in range(POSES):
        x, y = rng.uniform(-0.06, 0.06, 2) * field_m
        pose = PlanePose(float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
        flat = Pose.flat((pose.x_m, pose.y_m, 0.0), pose.angle_rad)
        image = render_frame(scope, specimen, flat, g, detector=detector, seed=number)
        images.append(Rectifier("cubic").rectify(image, camera))
        poses.append(pose)
    return Pictures(tuple(images), tuple(poses), g)


def _with_dust(rng: np.random.Generator, image: Any) -> Any:
    """The same with bright grains that lie on the sides of markers and beside them."""
    out = image.copy()
    for x, y in rng.uniform(0.1 * SIZE, 0.9 * SIZE, (60, 2)):
        cv2.circle(out, (int(x), int(y)), int(rng.integers(1, 4)), 255, -1)
    return out


def run(case: Pictures | Loop) -> Answer:
    """Find a target in pictures, or servo a stage."""
    return _find(case) if isinstance(case, Pictures) else _servo(case)


def _find(case: Pictures) -> Answer:
    start = time.process_time()
    size = case.images[0].shape[0]
    camera = SCOPE.with_image_size(size, size).camera_at(case.magnification)
    plane = PlaneCamera.from_camera(camera)
    fits = [fit_pose(find_target(image, TARGET), plane) for image in case.images]
    seconds = time.process_time() - start
    found = [(fit, pose) for fit, pose in zip(fits, case.poses, strict=True) if fit.accepted]
    decision = f"{len(found)} of {len(fits)} found"
    bits = digest_of(*(fit.pose.values for fit, _ in found), *(fit.reason for fit in fits))
    false = sum(pose is None for _, pose in found)
    if not found or false:
        return Answer(decision, wrong=false, digest=bits, seconds=seconds)
    to_px = np.asarray(camera.ideal_from_sem_jacobian)
    off = [(fit, fit.pose.minus(pose)[:2]) for fit, pose in found if pose is not None]
    error = np.array([np.hypot(*(to_px @ miss)) for _, miss in off])
    score = np.array([miss @ np.linalg.solve(fit.covariance[:2, :2], miss) for fit, miss in off])
    return Answer(
        decision,
        sum(len(fit.view.ids) for fit, _ in found),
        float(np.sqrt(np.mean(error**2))),
        float(error.max()),
        float(np.sqrt(np.mean(score) / 2.0)),
        int(np.sum((error > WRONG_PX) & (score > WRONG_SIGMAS**2))),
        bits,
        seconds,
    )


def see_target(
    pose: PlanePose, camera: PlaneCamera, rng: np.random.Generator | None = None
) -> TargetView:
    """The markers that lie in a field of 512 px and are 20 to 350 px large; with noise from ``rng``."""
    ids = np.arange(TARGET.size)
    own = TARGET.corners_m(ids)
    xy = camera.project(pose.apply(own.reshape(-1, 2))).reshape(-1, 4, 2)
    side = np.linalg.norm(xy[:, 1] - xy[:, 0], axis=1)
    seen = np.all((xy > 3) & (xy < 508), axis=(1, 2)) & (side > 20) & (side < 350)
    if rng is not None:
        xy = xy + rng.normal(0.0, SIGMA_PX, xy.shape)
    covariance = np.broadcast_to(SIGMA_PX**2 * np.eye(8), (int(seen.sum()), 8, 8))
    reason = "" if np.any(seen) else "no marker of the target in view"
    return TargetView(ids[seen], own[seen], xy[seen], covariance, reason)


class _Stage:
    """Obeys after a latency, over a ground that drifts; frames are instants."""

    def __init__(self, case: Loop) -> None:
        self.case, self.servo = case, Servo(GOAL, case.settings)
        self.pose, self.drift_m = PlanePose(20e-6, -15e-6, 0.35), np.zeros(2)
        self.twist, self.time_s = np.zeros(3), 0.0
        self.rng = np.random.default_rng(1)

    @property
    def in_sem(self) -> PlanePose:
        """The target as it lies in the sem frame."""
        return self.pose.displace(float(self.drift_m[0]), float(self.drift_m[1]))

    def _go(self, duration_s: float) -> None:
        x, y, turn = (self.case.obeys @ self.twist) * duration_s
        self.pose = self.pose.displace(float(x), float(y), float(turn))
        self.drift_m = self.drift_m + np.multiply(self.case.drift_m_s, duration_s)
        self.time_s += duration_s

    def step(self, g: float, *, scale: float) -> ServoStep:
        """Frame, latency, command, and the rest of the period."""
        seen_at, true = self.time_s, PlaneCamera.from_camera(SCOPE.camera_at(g))
        view = see_target(self.in_sem, true, self.rng)
        self._go(LATENCY_S)
        off_x, off_y = self.case.axis_px
        off = np.array([[1.0, 0.0, off_x], [0.0, 1.0, off_y], [0.0, 0.0, 1.0]])
        known = off @ true.matrix @ np.diag([scale, scale, 1.0])
        step = self.servo.update(
            view,
            PlaneCamera(known),
            seen_at,
            interval_s=PERIOD_S,
            now_s=self.time_s if self.case.foretold else None,
        )
        self.servo.record_command(self.time_s, step.twist)
        self._go(self.case.late_s)
        self.twist = step.twist
        self._go(PERIOD_S - LATENCY_S - self.case.late_s)
        return step


def _servo(case: Loop) -> Answer:
    start = time.process_time()
    stage, steps, left = _Stage(case), [], []
    for number, g in enumerate(case.zoom):
        if case.knock and number == 12:
            stage.drift_m = stage.drift_m + 3e-6
        later = case.renewed and number >= len(case.zoom) - 8
        steps.append(stage.step(g, scale=1.005 if later else 1.0))
        left.append(stage.in_sem.minus(GOAL)[:2])
    seconds = time.process_time() - start
    moved = [step for step in steps if step.rejection is None]
    last = steps[-1]
    why = "" if last.rejection is None else f", {last.rejection.status.name}"
    settled = next((n for n, step in enumerate(steps) if step.converged), None)
    decision = f"{len(moved)} of {len(steps)} moved, converged at {settled}{why}"
    bits = digest_of(*(step.twist for step in steps), *(step.error for step in steps))
    if last.rejection is not None:
        return Answer(decision, len(moved), digest=bits, seconds=seconds)
    error = 1e9 * np.hypot(*np.array(left[-JUDGED_FRAMES:]).T)
    off_px = 1e-9 * error[-1] * SCOPE.camera_at(case.zoom[-1]).m
    return Answer(
        decision,
        len(moved),
        float(np.sqrt(np.mean(error**2))),
        float(error.max()),
        wrong=int(last.converged and bool(off_px > 2.0 * case.settings.tolerance_px)),
        digest=bits,
        seconds=seconds,
    )
