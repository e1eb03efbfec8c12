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

"""Visual servoing of the virtual SEM's stage while the magnification is stepped from 500x to 5000x.

1. The microscope is calibrated on a simulated recording of a chess grid, on a stage with one tilt axis that misses the
   specimen: once with the continuous model over all magnifications, once with the magnifications 500, 1000, 2000 and
   5000 one by one, linear in between.
2. The same controller brings the same target to the same place of the sem frame, three times: on raw images with the
   scale of the display, with the interpolated calibration, and with the continuous one.
3. What is judged is where the target really is.
4. The same for five seeds (--seeds), each with a calibration, a rough charging target and a drift of its own: median
   and worst.

    python -m examples.visual_servo [--quick] [--live [--tip] | --replay | --plants 10] [--seeds 5] [--preset jsm820]

With --live the nodes do it as processes of their own: virtual_sem, parameter_server, stream_corrector, visual_servo.
With --tip a tip then enters the picture at each magnification, to a third of it, and the servo has to hold the target.
It fails (exit status 1) where a preset with distortion that the parameters do not describe got no residual field, and
where the servo does not converge at a magnification.
With --replay the frames of the continuous case then become a recording, which bag_player replays to the nodes: what
visual_servo says of each frame is compared with the truth.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, cpu_count, delayed

from examples.visual_servo.loop import Case, Run, Task, servo_run
from semcal_ros import Calibration
from semcal_ros.applications.servoing import PlanePose, ServoSettings
from semcal_ros.config.config import load_config
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import UnusableCalibrationError
from semcal_ros.synthetic import (
    DRIFTS,
    PRESETS,
    SQUARES_M,
    STAGES,
    TYPICAL_GRID,
    Pose,
    RecordingPlan,
    VirtualMicroscope,
    calibration_plan,
    preset,
)
from semcal_ros.workflows.calibrate import calibrate_found, options_for
from semcal_ros.workflows.find_grid import NamedFrame, find_views

CONTINUOUS = (100.0, 250.0, 500.0, 1000.0, 2000.0, 3500.0, 5000.0, 7500.0, 10000.0)
DISCRETE = (500.0, 1000.0, 2000.0, 5000.0)
QUICK = (250.0, 500.0, 1000.0, 2000.0, 5000.0, 10000.0)
VIEWS = 4
QUICK_VIEWS = 3
QUICK_SIZE = 256
STEPS = 7
GOAL = PlanePose(3e-6, -2e-6, math.radians(5.0))
START = Pose.flat((40e-6, -28e-6, 0.0), math.radians(22.0))
# Near enough to the goal, in the truth: a pixel.
NEAR_PX = 1.0
LAST = 5


def named_frames(plan: RecordingPlan) -> Iterator[NamedFrame]:
    """Frames of the grid, with what the stage says about each."""
    for index, frame in enumerate(plan.frames):
        said = frame.position_read
        stage = said and StageReading(said.tilt_rad, said.rotation_rad, said.scan_rotation_rad)
        yield NamedFrame(f"frame {index}", plan.render(index), frame.magnification, stage)


def calibrations(
    microscope: VirtualMicroscope, seed: int, *, quick: bool
) -> tuple[Calibration, Calibration | None]:
    """The continuous and the discrete calibration from one recording.

    The discrete one is None where the few views of one magnification do not converge.
    """
    shown, views = (QUICK, QUICK_VIEWS) if quick else (CONTINUOUS, VIEWS)
    plan = calibration_plan(
        microscope,
        magnifications=shown,
        views=views,
        seed=seed,
        stage=STAGES["one-axis"],
        grid=TYPICAL_GRID,
    )
    found, rejected = find_views(named_frames(plan))
    common = {"display_width_m": microscope.display_width_m, "squares_m": SQUARES_M}
    # The direction of the tilt axis, as `semcal calibrate --config virtual_sem` takes it.
    options = options_for(load_config("virtual_sem"))
    continuous = calibrate_found(found, rejected, options=options, **common).calibration
    some = [view for view in found if view.magnification in DISCRETE]
    alone = replace(options, method="discrete")
    try:
        discrete = calibrate_found(some, [], options=alone, **common).calibration
    except UnusableCalibrationError as error:
        print(f"no discrete calibration: {error.seen}", flush=True)
        return continuous, None
    return continuous, discrete


def schedule(quick: bool) -> list[tuple[float, int]]:
    """(magnification, frames): 500x until the target is there, then up in equal ratios."""
    if quick:
        return [(500.0, 18), (1600.0, 5), (5000.0, 8)]
    steps = np.geomspace(500.0, 5000.0, STEPS).round(-1)
    return [(float(g), 22 if i == 0 else 12 if i == STEPS - 1 else 6) for i, g in enumerate(steps)]


def cases_of(
    scope: VirtualMicroscope, continuous: Calibration, discrete: Calibration | None
) -> list[Case]:
    def nominal(g: float) -> ScanCamera:
        return ScanCamera.nominal(g, scope.width, scope.height, scope.display_width_m)

    cases = [Case("uncalibrated", nominal, corrected=False)]
    if discrete is not None:
        cases.append(Case("interpolated", discrete.at, corrected=True))
    return [*cases, Case("continuous", continuous.at, corrected=True)]


def frames_to(near: np.ndarray) -> int | None:
    """Frames until it is near and stays so; None where it does not."""
    far = np.flatnonzero(~near)
    first = 0 if len(far) == 0 else int(far[-1]) + 1
    return None if first >= len(near) else first


def summary(run: Run) -> dict[str, Any]:
    """Figures of one run, plain numbers for JSON."""
    g = np.array(run.magnification)
    true_px, true_m = np.array(run.true_px), run.true_m()
    steps, jumps = {}, {}
    for value in dict.fromkeys(run.magnification):
        here = g == value
        steps[value] = frames_to(true_px[here] < NEAR_PX)
        jumps[value] = float(true_px[here][0])
    last = slice(-LAST, None)
    turn = np.abs(np.array(run.true_error)[last, 2])
    return {
        "final_true_nm": 1e9 * float(np.sqrt(np.mean(true_m[last] ** 2))),
        "final_true_px": float(np.sqrt(np.mean(true_px[last] ** 2))),
        "final_true_mrad": 1e3 * float(np.sqrt(np.mean(turn**2))),
        "final_own_nm": 1e9 * float(np.nanmean(run.own_m[-LAST:])),
        "final_own_px": float(np.nanmean(run.own_px[-LAST:])),
        "final_sigma_nm": 1e9 * float(np.nanmean(run.sigma_m[-LAST:])),
        "final_sigma_px": float(np.nanmean(run.sigma_px[-LAST:])),
        "worst_true_px_at_a_step": max(list(jumps.values())[1:], default=float("nan")),
        "frames_to_1_px": steps,
        "first_frame_px": jumps,
        "axis_found_px": [float(v) for v in run.axis_px[-1]],
        "axis_sigma_px": run.axis_sigma_px[-1],
        "true_px": run.true_px,
        "true_nm": (1e9 * true_m).tolist(),
        "converged_by_itself_at": frames_to(np.array(run.converged)),
        "frames_refused": sum(bool(reason) for reason in run.reason),
        "reasons": sorted({reason for reason in run.reason if reason}),
    }


def printed(results: dict[str, dict[str, Any]]) -> None:
    print(f"\n{'':14} final error, truth        own estimate +- 1 sigma      largest true error")
    print(f"{'':14}     nm      px    mrad         nm             px       after a step, px")
    for name, r in results.items():
        print(
            f"{name:14}{r['final_true_nm']:7.0f} {r['final_true_px']:7.2f} {r['final_true_mrad']:7.2f}"
            f"   {r['final_own_nm']:6.1f} +- {r['final_sigma_nm']:<5.2f}"
            f" {r['final_own_px']:5.2f} +- {r['final_sigma_px']:<5.3f} {r['worst_true_px_at_a_step']:10.2f}"
        )
    print(f"\nframes until the target is within {NEAR_PX:g} px of its place and stays there")
    magnifications = next(iter(results.values()))["frames_to_1_px"]
    print(f"{'':14}" + "".join(f"{g:>8g}x" for g in magnifications))
    for name, r in results.items():
        cells = ("never" if n is None else str(n) for n in r["frames_to_1_px"].values())
        print(f"{name:14}" + "".join(f"{cell:>9}" for cell in cells))


def show_seeds(found: list[dict[str, dict[str, Any]]]) -> None:
    """Median and worst of the final true error over several runs."""
    print(
        f"\nfinal true error over {len(found)} seeds      px: median   worst    nm: median   worst"
    )
    for name in dict.fromkeys(name for results in found for name in results):
        made = [results[name] for results in found if name in results]
        px, nm = (np.array([run[f"final_true_{unit}"] for run in made]) for unit in ("px", "nm"))
        label = name if len(made) == len(found) else f"{name} ({len(made)} of them)"
        print(f"{label:30}{np.median(px):20.3f}{px.max():8.3f}{np.median(nm):14.1f}{nm.max():8.1f}")


def run_cases(task: Task, cases: list[Case]) -> list[Run]:
    """All cases at the same time."""
    work = Parallel(n_jobs=min(cpu_count(), 3))
    return work(delayed(servo_run)(task, case) for case in cases)


def compare_plants(options: argparse.Namespace) -> int:
    """Stages and pictures that are not as assumed: with the camera as it is, and with a calibration of it."""
    from examples.visual_servo.plants import (
        CALIBRATED_M,
        KNOWN_M,
        MAGNIFICATION,
        show_plants,
        try_plants,
    )

    scope = preset(options.preset)
    small = scope.with_image_size(QUICK_SIZE, QUICK_SIZE)
    if scope.residual.is_zero:
        # What is seen is then the stage's and the picture's doing.
        case, known_m = Case("true camera", small.camera_at, corrected=True), KNOWN_M
        print(f"\n{options.preset}, true camera")
        show_plants(try_plants(small, case, options.plants, known_m))
    calibration, _ = calibrations(scope, options.seed + 1, quick=options.quick)
    has_field = calibration.at(MAGNIFICATION).residual is not None

    def estimated(g: float) -> ScanCamera:
        return calibration.at(g).resized(small.width, small.height)

    case = Case("calibration", estimated, corrected=True)
    print(f"\n{options.preset}, calibration {'with' if has_field else 'without'} a residual field")
    show_plants(try_plants(small, case, options.plants, CALIBRATED_M))
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer and smaller frames")
    parser.add_argument("--live", action="store_true", help="the nodes, over ROS")
    parser.add_argument(
        "--tip", action="store_true", help="live: a tip enters the picture at each magnification"
    )
    parser.add_argument(
        "--replay", action="store_true", help="the recording then replayed to the nodes"
    )
    parser.add_argument(
        "--plants",
        type=int,
        metavar="RUNS",
        help="stages and pictures that are not as assumed, so many runs of each: with the true camera, and with a "
        "calibration of the preset (scan_nonlinear: with a residual field)",
    )
    parser.add_argument("--rate", type=float, default=1.0, help="of the replay")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="jsm820")
    parser.add_argument("--drift", choices=tuple(DRIFTS), default="slow")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--seeds",
        type=int,
        help="so many calibrations, targets and drifts besides: 5, or none with --quick or --replay",
    )
    parser.add_argument("--fixed-axis", action="store_true", help="do not learn where the axis is")
    parser.add_argument("--output", type=Path, default=Path("visual_servo_output"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    scope = preset(options.preset)
    if options.quick and not options.live:
        scope = scope.with_image_size(QUICK_SIZE, QUICK_SIZE)
    if options.plants:
        return compare_plants(options)
    continuous, discrete = calibrations(scope, options.seed + 1, quick=options.quick)
    print(f"calibrated {options.preset} ({time.monotonic() - began:.0f} s)", flush=True)
    continuous.save(options.output / "cal.yaml")
    if options.live:
        from examples.visual_servo.live import live

        magnifications = [g for g, _ in schedule(options.quick)]
        chosen = options.preset, options.drift, options.seed
        travel_m = float(START.t_m[0]), float(START.t_m[1])
        has_field = continuous.at(magnifications[-1]).residual is not None
        if not has_field and not scope.residual.is_zero:
            print(
                f"a calibration without a residual field; {options.preset} has distortion that needs one",
                file=sys.stderr,
            )
            return 1
        print("with a residual field" if has_field else "without a residual field", flush=True)
        run, missed = live(
            options.output, scope, *chosen, GOAL, travel_m, magnifications, with_tip=options.tip
        )
        last = np.array(run.true_px)[np.array(run.magnification) == magnifications[-1]][-LAST:]
        if last.size:
            rms_px = float(np.sqrt(np.mean(last**2)))
            print(
                f"truth at {magnifications[-1]:g}x, RMS of the last {last.size} frames: {rms_px:.3f} px"
            )
        if missed or not last.size:
            at = (
                ", ".join(f"{g:g}x" for g in missed)
                or f"{magnifications[-1]:g}x (the target is not in view)"
            )
            print(f"NOT converged at {at}", file=sys.stderr)
            return 1
        return 0
    settings = ServoSettings(axis_sigma_px=0.0) if options.fixed_axis else ServoSettings()
    task = Task(scope, START, GOAL, schedule(options.quick), options.drift, options.seed, settings)
    cases = cases_of(scope, continuous, discrete)
    runs = run_cases(task, cases)
    print(f"servoed {len(runs)} times ({time.monotonic() - began:.0f} s)", flush=True)
    results = {run.name: summary(run) for run in runs}
    place = np.array([[GOAL.x_m, GOAL.y_m, 0.0]])
    sigma = continuous.at(5000.0).project_sigma(place)[0]
    printed(results)
    print(
        f"the continuous calibration itself knows that place at 5000x to {sigma.max():.2f} px (1 sigma)"
    )
    (options.output / "results.json").write_text(json.dumps(results, indent=1))
    from examples.visual_servo.picture import picture

    picture(options.output / "visual_servo.png", runs)
    print(
        f"{options.output}/results.json, {options.output}/visual_servo.png ({time.monotonic() - began:.0f} s)"
    )
    seeds = (
        options.seeds if options.seeds is not None else 0 if options.quick or options.replay else 5
    )
    if seeds > 0:
        # Another calibration, another target, and another drift each time.
        found = []
        for seed in range(options.seed, options.seed + seeds):
            if seed != options.seed:
                pair = calibrations(scope, seed + 1, quick=options.quick)
                cases = cases_of(scope, *pair)
            varied = replace(task, seed=seed, specimen="rough_target")
            found.append({run.name: summary(run) for run in run_cases(varied, cases)})
            print(f"seed {seed} ({time.monotonic() - began:.0f} s)", flush=True)
        show_seeds(found)
        (options.output / "seeds.json").write_text(json.dumps(found, indent=1))
    if options.replay:
        from examples.visual_servo.replay import replayed

        replayed(options.output, runs[-1], scope, GOAL, options.rate)
    return 0


if __name__ == "__main__":
    sys.exit(main())
