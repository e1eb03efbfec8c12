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

"""Ten cantilevers of different looks: is what one of them shows true of all?

Each scene has its own tip, substrate, contrast (bright or dark beam), charging, direction, push and drift, drawn by
`random_cantilever` from its number. All are measured with the same calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semcal_ros import measure_cantilever
from semcal_ros.cli.output import echo_table
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import SemcalError
from semcal_ros.synthetic import VirtualMicroscope
from semcal_ros.synthetic.specimens.cantilever import (
    CantileverExperiment,
    cantilever_plan,
    random_cantilever,
)
from semcal_ros.synthetic.thresholds import CANTILEVER_PUSHES

HEADERS = ["scene", "tip", "substrate", "beam", "push nm"]
FIGURES = ["spread nm", "error nm RMS", "largest nm", "sigma nm", "error/sigma", "refused"]


@dataclass(frozen=True)
class SceneResult:
    """Errors of the frames of one scene but those of the reference pose.

    Attributes
    ----------
    experiment
        What was recorded.
    spread_m
        Standard deviation among the magnifications, RMS over poses 2 to 11.
    error_m, sigma_m
        (n,) errors against the truth and stated 1-sigmas; NaN in frames that were not measured.
    refused
        (n,) frames that were not measured, or whose drift was not.
    """

    experiment: CantileverExperiment
    spread_m: float
    error_m: Array
    sigma_m: Array
    refused: Array

    @property
    def rms_m(self) -> float:
        """RMS error."""
        return root_mean_square(self.error_m)


def root_mean_square(values: Array) -> float:
    """RMS of the known values."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def measure_scene(
    seed: int, microscope: VirtualMicroscope, view: Any, calibration: Path, config: Path
) -> SceneResult | str:
    """Record and measure a scene; the reason if it is refused as a whole."""
    experiment = random_cantilever(seed, base_in_view=view == "whole")
    plan = cantilever_plan(
        microscope,
        scene=experiment.scene,
        largest_deflection_m=experiment.largest_deflection_m,
        rotation_rad=experiment.rotation_rad,
        drift=experiment.drift,
        view=view,
        seed=seed,
    )
    frames = [
        (plan.render(k), frame.magnification, frame.start_time_s)
        for k, frame in enumerate(plan.frames)
    ]
    length_m, poses = experiment.scene.length_m, len(CANTILEVER_PUSHES)
    try:
        done = measure_cantilever(
            frames, calibration=calibration, config=config, length_m=length_m, poses=poses
        )
    except SemcalError as error:
        return f"{seed} {experiment.tip} {experiment.substrate}: {error}"
    errors, sigmas, refused = [], [], []
    for one in done.series:
        g = one.measured.magnification
        truth = [f.scene.deflection_m for f in plan.frames if f.magnification == g]
        for k in range(1, len(truth)):
            frame = one.measured.frames[k]
            errors.append(frame.deflection_m - truth[k])
            sigmas.append(frame.sigma_m)
            lost = not one.measured.drift.trusted[k] or not np.isfinite(frame.deflection_m)
            refused.append(lost)
    return SceneResult(
        experiment,
        done.repeatability.rms_spread_m,
        np.array(errors),
        np.array(sigmas),
        np.array(refused),
    )


def measure_scenes(
    count: int, microscope: VirtualMicroscope, view: Any, calibration: Path, config: Path
) -> list[SceneResult]:
    """Measure scenes one after the other, and print a row for each and a summary."""
    print(f"\n{count} scenes, view {view}, {microscope.width} px: " + ", ".join(HEADERS + FIGURES))
    rows, results = [], []
    for seed in range(count):
        result = measure_scene(seed, microscope, view, calibration, config)
        if isinstance(result, str):
            print("refused as a whole: scene " + result, flush=True)
            continue
        rows.append(show_scene(seed, result))
        print("  ".join(rows[-1]), flush=True)
        results.append(result)
    print()
    echo_table(HEADERS + FIGURES, rows)
    if results:
        show_summary(results, count)
    return results


def show_scene(seed: int, result: SceneResult) -> list[str]:
    """A row of the table."""
    one, error, sigma = result.experiment, result.error_m, result.sigma_m
    return [
        str(seed),
        one.tip,
        one.substrate,
        "dark" if one.is_dark else "bright",
        f"{1e9 * one.largest_deflection_m:.0f}",
        f"{1e9 * result.spread_m:.2f}",
        f"{1e9 * result.rms_m:.2f}",
        f"{1e9 * np.nanmax(np.abs(error)):.2f}",
        f"{1e9 * float(np.median(sigma)):.2f}",
        f"{root_mean_square(error / sigma):.2f}",
        f"{int(result.refused.sum())}/{len(error)}",
    ]


def show_summary(results: list[SceneResult], count: int) -> None:
    """Median and worst over the scenes, and what the frames of all of them have in common."""
    spread = 1e9 * np.array([r.spread_m for r in results])
    error = 1e9 * np.array([r.rms_m for r in results])
    deviation = np.concatenate([r.error_m / r.sigma_m for r in results])
    refused = np.concatenate([r.refused for r in results])
    print(
        f"{len(results)} of {count} scenes: spread {np.median(spread):.2f} nm in the median, {spread.max():.2f} nm "
        f"in the worst; error {np.median(error):.2f} and {error.max():.2f} nm RMS; error over sigma "
        f"{root_mean_square(deviation):.2f} over all frames; {100.0 * refused.mean():.1f} % of the frames refused"
    )
