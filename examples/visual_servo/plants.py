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

"""Stages and pictures that a controller does not expect: does it converge, or stop and say why?"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from joblib import Parallel, cpu_count, delayed

from examples.visual_servo.loop import Case, Run, Task, servo_run
from semcal_ros.applications.servoing import NestedTarget, PlanePose, find_target
from semcal_ros.synthetic import Pose, VirtualMicroscope
from semcal_ros.synthetic.stage import ActuatorFaults

FRAMES = 40
LAST = 5
MAGNIFICATION = 1000.0
# By how much the controller may be wrong about where the target is. The motion within a frame and the optical axis, as
# the true camera has it, are worth some px of 0.47 um.
KNOWN_M = 2.5e-6
# A calibration knows the axis to 9 px of 0.23 um (1 sigma), of its own 512, and one magnification does not tell more.
CALIBRATED_M = 3.0 * 9.0 * 0.23e-6


@dataclass(frozen=True)
class Plant:
    """One thing that is wrong."""

    name: str
    stage: Callable[[np.random.Generator], ActuatorFaults] = lambda _rng: ActuatorFaults()
    seen: Callable[[np.ndarray, np.random.Generator], np.ndarray] = lambda image, _rng: image
    #: Time of a frame, s; None: that of the microscope.
    frame_time_s: float | None = None
    late: float = field(default=0.0)


def either(rng: np.random.Generator, size: float) -> float:
    """A number of that size, of either sign."""
    return size * float(rng.choice((-1.0, 1.0)))


def askew(rng: np.random.Generator) -> ActuatorFaults:
    gain = 1.0 + either(rng, 0.1), 1.0 + either(rng, 0.1)
    return ActuatorFaults(gain, math.radians(either(rng, 3.0)))


def loose(rng: np.random.Generator) -> ActuatorFaults:
    x, y = rng.uniform(100e-9, 1e-6, 2)
    return ActuatorFaults(backlash_m=(float(x), float(y)))


def hide_half(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A gripper before half of the field, from one of its sides."""
    hidden, side = image.copy(), int(rng.integers(4))
    turned = np.rot90(hidden, side)
    turned[: len(turned) // 2] = int(np.percentile(image, 30))
    return hidden


PLANTS = (
    Plant("as assumed"),
    Plant("backlash of 0.1 to 1 um", stage=loose),
    Plant("10 % off, axes turned by 3 degrees", stage=askew),
    Plant("half of the field hidden", seen=hide_half),
    Plant("contrast reversed", seen=lambda image, _rng: np.iinfo(image.dtype).max - image),
    Plant("frames at 2 Hz, late by up to half", frame_time_s=0.4, late=0.5),
    Plant("all of stage and 2 Hz", stage=askew, frame_time_s=0.4, late=0.5),
)


@dataclass(frozen=True)
class Outcome:
    """What came of one run."""

    converged: bool
    final_px: float
    #: Frames without the target after which the stage moved.
    blind: int
    reasons: tuple[str, ...]


def run_plant(
    plant: Plant,
    case: Case,
    scope: VirtualMicroscope,
    seed: int,
    *,
    known_m: float = KNOWN_M,
    frames: int = FRAMES,
) -> Outcome:
    rng = np.random.default_rng(seed)
    turn, (x, y) = rng.uniform(-25.0, 25.0), rng.uniform(-45e-6, 45e-6, 2)
    if plant.frame_time_s is not None:
        timing = replace(scope.timing, frame_time_s=plant.frame_time_s, averages=1)
        scope = replace(scope, timing=timing)
    # The same body all the time.
    body = int(rng.integers(2**31))
    task = Task(
        scope,
        Pose.flat((float(x), float(y), 0.0), math.radians(float(turn))),
        PlanePose(3e-6, -2e-6, math.radians(5.0)),
        [(MAGNIFICATION, frames)],
        seed=seed,
        specimen="rough_target",
        stage=plant.stage(rng),
        seen=lambda image: plant.seen(image, np.random.default_rng(body)),
        late=plant.late,
    )
    return judge(servo_run(task, case), known_m)


def judge(run: Run, known_m: float = KNOWN_M) -> Outcome:
    final_px = float(np.sqrt(np.mean(np.square(run.true_px[-LAST:]))))
    # The referee looks for the target in the frame as the detector gave it. A marker that can just be read is found in
    # the raw frame or in the corrected one; where only the controller has found it, the truth tells whether it did.
    target = NestedTarget()
    blind = sum(
        bool(np.any(twist))
        and not abs(own - true) < known_m
        and not find_target(raw, target).accepted
        for raw, twist, own, true in zip(run.raw, run.twist, run.own_m, run.true_m(), strict=True)
    )
    return Outcome(all(run.converged[-LAST:]), final_px, blind, tuple(filter(None, run.reason)))


def try_plants(
    scope: VirtualMicroscope, case: Case, runs: int, known_m: float = KNOWN_M
) -> dict[str, list[Outcome]]:
    """All plants, each with that many starts."""
    jobs = [(plant, seed) for plant in PLANTS for seed in range(runs)]
    done = Parallel(n_jobs=cpu_count())(
        delayed(run_plant)(plant, case, scope, seed, known_m=known_m) for plant, seed in jobs
    )
    found: dict[str, list[Outcome]] = {plant.name: [] for plant in PLANTS}
    for (plant, _), outcome in zip(jobs, done, strict=True):
        found[plant.name].append(outcome)
    return found


def show_plants(found: dict[str, list[Outcome]]) -> None:
    print(f"\n{'':36}converged  standing  moved blind  error of the converged, px   it said last")
    print(f"{'':36}                                         median    worst")
    for name, outcomes in found.items():
        good = [o for o in outcomes if o.converged]
        error = [o.final_px for o in good] or [float("nan")]
        stands = sum(not o.converged and bool(o.reasons) for o in outcomes)
        said = sorted({o.reasons[-1] for o in outcomes if not o.converged and o.reasons})
        print(
            f"{name:36}{len(good):3} of {len(outcomes):2}{stands:10}{sum(o.blind for o in outcomes):13}"
            f"{np.median(error):14.3f}{max(error):9.3f}   {'; '.join(said) or '-'}"
        )
