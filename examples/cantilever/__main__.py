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

"""Bending of a cantilever, as in section 4.3 of Malti et al. (2012), on the virtual SEM.

1. A chess grid is recorded and calibrated with `semcal calibrate`.
2. A cantilever of 35 x 3.5 um is recorded at 6450x, 7760x and 8890x, which were never calibrated: 11 poses, straight,
   pushed by up to 250 nm at pose 7, and back, under drift and with the noise of 8-bit frames.
3. `semcal measure cantilever` measures it; the result is compared with the truth.

At a display width of 0.12 m, 35 um are more than the field (18.6 um at 6450x). So there are two experiments: `end` has
the display width of the JSM-820 and only the free end in view; `whole` has one of 0.4 m and all of the cantilever.

4. The same for ten scenes that look different (tip, substrate, contrast, charging, direction, push, drift), measured
   with the same calibration: median and worst. `--scenes N` takes N of them, `--scenes 0` none.

`--figure-16a` adds the comparison of the paper: the same frames, measured with separate calibrations that were made at
exactly 6450x, 7760x and 8890x.

Everything lands in cantilever_output/. `--quick` takes fewer frames and magnifications, and no further scenes.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from examples.cantilever.figure_16a import (
    SCALES,
    compare_calibrations,
    draw_comparison,
    show_comparison,
)
from examples.cantilever.scenes import measure_scenes
from semcal_ros.files.bags.writer import SIMULATED_START_NS, write_simulated
from semcal_ros.synthetic import (
    STAGES,
    TYPICAL_GRID,
    Drift,
    RecordingPlan,
    VirtualMicroscope,
    calibration_plan,
    preset,
    truth_of,
)
from semcal_ros.synthetic.specimens.cantilever import CantileverPlan, cantilever_plan
from semcal_ros.synthetic.thresholds import CANTILEVER_MAGNIFICATIONS, CANTILEVER_PUSHES

GRID = (100, 250, 600, 1200, 2500, 4000, 5500, 7000, 8500, 10000)
QUICK_GRID = (1500, 4000, 7000, 10000)
LENGTH_M = 35e-6
DRIFT = Drift(velocity_m_s=(1.1e-9, -0.8e-9), settling_m=(90e-9, -60e-9), wander_m=12e-9, seed=5)


@dataclass(frozen=True)
class Experiment:
    """What is recorded."""

    name: str
    microscope: VirtualMicroscope
    size: int
    view: Any
    frames_per_pose: int


EXPERIMENTS = (
    Experiment("end", preset("jsm820"), 512, "end", 1),
    Experiment("whole", replace(preset("jsm820"), display_width_m=0.4), 1024, "whole", 2),
)


def semcal(*arguments: object) -> None:
    """Run the command as a user would, and stop if it fails."""
    command = [str(Path(sys.executable).with_name("semcal")), *map(str, arguments)]
    print("\n$ semcal", *arguments, flush=True)
    subprocess.run(command, check=True)


def record(plan: RecordingPlan | CantileverPlan, folder: Path) -> None:
    """Write a plan to a bag."""
    truth = plan.truth() if isinstance(plan, CantileverPlan) else truth_of(plan)
    write_simulated(folder, plan.frames, map(plan.render, range(len(plan))), truth)
    print(f"{len(plan)} frames: {folder}", flush=True)


def config_of(microscope: VirtualMicroscope, folder: Path) -> Path:
    """The microscope's configuration as a user would write it."""
    timing = microscope.timing
    path = folder / "microscope.yaml"
    path.write_text(
        "name: virtual SEM\n"
        f"display_width_m: {microscope.display_width_m}\n"
        "magnification: {quantity: magnification}\n"
        f"scan: {{frame_time_s: {timing.frame_time_s}, averages: {timing.averages}, "
        f"flyback_fraction: {timing.flyback_fraction}}}\n",
        encoding="utf-8",
    )
    return path


def compare(folder: Path) -> dict[str, float]:
    """Errors against the truth, nm, and errors over stated sigma."""
    truth = json.loads((folder / "bending" / "truth.json").read_text(encoding="utf-8"))["frames"]
    stamps = {SIMULATED_START_NS + round(f["start_time_s"] * 1e9): f for f in truth}
    errors: dict[str, list[float]] = defaultdict(list)
    poses: dict[tuple[str, int], list[float]] = defaultdict(list)
    with (folder / "bending.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            true = stamps[int(row["stamp_ns"])]["deflection_m"]
            if int(row["pose"]) == 1:
                continue  # the reference
            for name, value, sigma in (
                ("calibrated", "deflection_m", "sigma_m"),
                ("length", "deflection_by_length_m", "sigma_by_length_m"),
            ):
                error = float(row[value]) - true
                errors[name].append(error)
                errors[name + "_z"].append(error / float(row[sigma]))
                poses[name, int(row["pose"])].append(error)
    out = {name: float(np.sqrt(np.mean(np.square(v)))) for name, v in errors.items()}
    for name in ("calibrated", "length"):
        out[name + "_largest"] = float(np.max(np.abs(errors[name])))
        out[name + "_bias"] = float(np.mean(errors[name]))
    return out


def run(
    experiment: Experiment, output: Path, *, quick: bool, seed: int, shape: str, figure_16a: bool
) -> tuple[Path, Path]:
    """Record, calibrate and measure an experiment: its calibration and configuration."""
    folder = output / experiment.name
    folder.mkdir(parents=True)
    microscope = experiment.microscope
    config = config_of(microscope, folder)
    # As from a real stage: one tilt axis, which misses the specimen, and magnifications that do not quite come back.
    recorded = {"views": 3 if quick else 5, "stage": STAGES["one-axis"], "grid": TYPICAL_GRID}
    shown = QUICK_GRID if quick else GRID
    grid = calibration_plan(microscope, magnifications=shown, seed=seed, **recorded)
    record(grid, folder / "grid")
    calibration = folder / "cal.yaml"
    semcal("calibrate", folder / "grid", "--config", config, "-o", calibration)
    size = experiment.size // 2 if quick and experiment.size > 512 else experiment.size
    plan = cantilever_plan(
        microscope.with_image_size(size, size),
        view=experiment.view,
        frames_per_pose=experiment.frames_per_pose,
        pushes=(0.0, 0.4, 1.0, 0.0) if quick else CANTILEVER_PUSHES,
        drift=DRIFT,
        seed=seed,
    )
    record(plan, folder / "bending")
    poses = len({frame.pose for frame in plan.frames})
    measured = ("measure", "cantilever", folder / "bending")
    where = ("--config", config, "--length", LENGTH_M, "--poses", poses, "--shape", shape)
    outputs = ("-o", folder / "bending.csv", "--plot", folder / "poses.png")
    drawn = (*outputs, "--strip", folder / "strip.png")
    semcal(*measured, "--calibration", calibration, *where, *drawn)
    errors = compare(folder)
    for name in ("calibrated", "length"):
        if np.isfinite(errors[name]):
            print(
                f"{experiment.name}, scale from the {name}: error against the truth "
                f"{1e9 * errors[name]:.2f} nm RMS, {1e9 * errors[name + '_largest']:.2f} nm at most, "
                f"mean {1e9 * errors[name + '_bias']:.2f} nm; error over sigma {errors[name + '_z']:.2f}"
            )
    if not figure_16a:
        return calibration, config
    shown = CANTILEVER_MAGNIFICATIONS
    exactly = calibration_plan(microscope, magnifications=shown, seed=seed + 1, **recorded)
    record(exactly, folder / "grid_exactly")
    separate = folder / "separate.yaml"
    how = ("--config", config, "--method", "discrete")
    semcal("calibrate", folder / "grid_exactly", *how, "-o", separate)
    table = folder / "bending_separate.csv"
    semcal(*measured, "--calibration", separate, *where, "-o", table)
    truth = folder / "bending" / "truth.json"
    for scale in SCALES if experiment.view == "whole" else ("calibration",):
        compared = compare_calibrations(folder / "bending.csv", table, truth, scale=scale)
        show_comparison(compared)
        (folder / f"figure_16a_{scale}.png").write_bytes(draw_comparison(compared))
    return calibration, config


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer frames and magnifications")
    parser.add_argument(
        "--figure-16a", action="store_true", help="also measure with separate calibrations"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shape", default="free")
    parser.add_argument(
        "--scenes", type=int, metavar="N", help="scenes of other looks: 10, or none with --quick"
    )
    parser.add_argument("--only", choices=[e.name for e in EXPERIMENTS])
    parser.add_argument("-o", "--output", type=Path, default=Path("cantilever_output"))
    given = parser.parse_args()
    scenes = given.scenes if given.scenes is not None else 0 if given.quick else 10
    started = time.monotonic()
    shutil.rmtree(given.output, ignore_errors=True)
    for experiment in EXPERIMENTS:
        if given.only in (None, experiment.name):
            calibration, config = run(
                experiment,
                given.output,
                quick=given.quick,
                seed=given.seed,
                shape=given.shape,
                figure_16a=given.figure_16a,
            )
            if scenes > 0:
                scope = experiment.microscope.with_image_size(experiment.size, experiment.size)
                measure_scenes(scenes, scope, experiment.view, calibration, config)
    print(
        f"\nLook at {given.output}/*/poses.png and strip.png ({time.monotonic() - started:.0f} s)"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
