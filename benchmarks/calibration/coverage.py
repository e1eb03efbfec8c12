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

"""Are the stated uncertainties true? Many simulated calibrations with the faults of real stages, scans and grids.

The views come from `semcal_ros.synthetic.stage`, which turns a rigid body about axes in space and knows neither priors
nor equations of the calibration. At magnifications between the calibrated ones, the calibrated camera is compared with
the next visit of the true one: its scale and the height of what is measured are drawn anew. Errors over the stated
sigmas are 1 (RMS) if these are honest. Points of one calibration share its errors, so the counts are over few
independent cases.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from joblib import Parallel, delayed

from benchmarks.table import quick_from_command_line, show, text
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import GridFaults, SimulatedStage, stage_views

PRESETS = ("jsm820", "strong_perspective", "off_centre", "pincushion")
UPWARDS = (100.0, 300.0, 700.0, 1500.0, 2500.0, 4000.0, 6000.0, 8000.0, 10000.0)
VISITS = (*UPWARDS, *UPWARDS[-2::-1])
POINTS = 20
# What the sizes of squares are drawn with, and what is measured lies at.
SQUARE_RATIO, HEIGHT_M = 3e-4, 1e-5


@dataclass(frozen=True)
class Case:
    """One row of the table: a stage, a grid, and what the calibration is told."""

    stage: SimulatedStage
    grid: GridFaults = field(default_factory=GridFaults)
    readings: bool = False
    outliers: float = 0.0
    height_sigma_m: float = HEIGHT_M


ANY = SimulatedStage(axis_rad=None)
ONE = SimulatedStage()
READ = replace(ONE, tilt_error_rad=0.004, reading_sigma_rad=0.003)
MISSED = {"miss_m": (1.6e-4, 0.0)}
CASES: Mapping[str, Case] = {
    "tilts in any direction": Case(ANY),
    "one tilt axis": Case(ONE),
    "one tilt axis, stage read": Case(READ, readings=True),
    "one tilt of 17 degrees": Case(replace(ONE, tilts_rad=(0.3,) * 4)),
    "axis missed by 160 um": Case(replace(ONE, **MISSED)),
    "axis missed by 160 um, stage read": Case(replace(READ, **MISSED), readings=True),
    "height per visit 40 um": Case(replace(ANY, visit_height_sigma_m=4e-5)),
    "common height 200 um, so stated": Case(
        replace(ANY, common_height_m=2e-4), height_sigma_m=2e-4
    ),
    "visits 0.1 %": Case(replace(ANY, scale_sigma=1e-3)),
    "visits 0.5 %": Case(replace(ANY, scale_sigma=5e-3)),
    "visits 2 %": Case(replace(ANY, scale_sigma=2e-2)),
    "grid stretched by 0.2 %": Case(ANY, GridFaults(stretch=2e-3)),
    "grid sheared by 1e-3": Case(ANY, GridFaults(shear=1e-3)),
    "grid wavy, 0.2 % of a square": Case(ANY, GridFaults(wave=2e-3)),
    "grid wavy, 1 % of a square": Case(ANY, GridFaults(wave=1e-2)),
    "grid bowed, R = 50 mm": Case(ANY, GridFaults(curvature=20.0)),
    "line jitter 0.05 px": Case(replace(ANY, line_jitter_px=0.05)),
    "2 % outliers of 1 px": Case(ANY, outliers=0.02),
    "drift shear 0.3 px": Case(replace(ANY, drift_sigma_px=0.3)),
    "2 views per visit": Case(replace(ANY, tilts_rad=(0.0, 0.5))),
}


def deviations(name: str, seed: int) -> tuple[np.ndarray, np.ndarray, bool, float]:
    """Errors over stated sigmas, of points and of nm per pixel; whether warned; largest relative sigma."""
    case, microscope = CASES[name], preset(PRESETS[seed % len(PRESETS)])
    views = stage_views(
        microscope.camera_at,
        VISITS,
        case.stage,
        replace(case.grid, squares_sigma=SQUARE_RATIO),
        outliers=case.outliers,
        seed=seed,
        readings=case.readings,
    )
    axis = StageAxis(case.stage.axis_rad or 0.0) if case.readings else StageAxis()
    result = calibrate_views(
        views,
        image_size=microscope.image_size,
        display_width_m=microscope.display_width_m,
        options=CalibrationOptions(axis=axis, height_sigma_m=case.height_sigma_m),
    )
    rng = np.random.default_rng(1000 + seed)
    # The views' common height is that of the calibration's plane; what is measured lies at 0.
    height_m = 0.0 if case.stage.common_height_m else rng.normal(0.0, case.height_sigma_m)
    middle = 0.5 * (np.array(microscope.image_size) - 1.0)
    pixel, scale, sigma = [], [], 0.0
    for g in np.exp(rng.uniform(np.log(UPWARDS[0]), np.log(UPWARDS[-1]), POINTS)):
        camera, truth = result.model.at(float(g)), microscope.camera_at(float(g))
        visit = 1.0 + case.stage.scale_sigma * rng.normal()
        true_m = np.array(truth.pixel_size_m) * (1.0 + truth.rho * height_m) / visit
        own_sigma = np.array(camera.pixel_size_sigma_m)
        scale.append((np.array(camera.pixel_size_m) - true_m) / own_sigma)
        sigma = max(sigma, float(np.max(own_sigma / true_m)))
        point = truth.sem_from_ideal(truth.undistort(rng.uniform(0.0, 511.0, (1, 2))))
        ideal = truth.project_ideal(point + [[0.0, 0.0, height_m]])
        seen = truth.distort(middle + visit * (ideal - middle))
        pixel.append((camera.project(point) - seen) / camera.project_sigma(point))
    warned = any(warning.startswith("scale:") for warning in result.warnings)
    return np.concatenate(pixel).ravel(), np.concatenate(scale), warned, sigma


def main() -> None:
    """Print the table."""
    count = 4 if quick_from_command_line(__doc__) else 20
    rows: list[list[object]] = []
    for name in CASES:
        results = Parallel(n_jobs=-1)(delayed(deviations)(name, seed) for seed in range(count))
        row: list[object] = [name]
        for k in (0, 1):
            z = np.concatenate([r[k] for r in results])
            row += [float(np.sqrt(np.mean(z**2))), f"{100.0 * np.mean(np.abs(z) < 1.96):.0f}"]
        row += [f"{100.0 * np.median([r[3] for r in results]):.2f}", sum(r[2] for r in results)]
        rows.append(row)
        # The whole takes an hour and more; what is known is told at once.
        print(*(text(value) for value in row), sep="  ", flush=True)
    show(
        f"Coverage of the stated uncertainty; {count} calibrations a row, {len(VISITS)} visits x 4 views",
        ["case", "px err/sigma", "95 %", "nm err/sigma", "95 %", "sigma of nm, %", "warned"],
        rows,
        "err/sigma: RMS, 1 if honest; 95 %: percent of the errors within 1.96 sigma.",
        "px: project_sigma of points in the field; nm: pixel_size_sigma_m; sigma: the largest of the range, median.",
        "warned: calibrations with a warning that begins with `scale:`.",
    )


if __name__ == "__main__":
    main()
