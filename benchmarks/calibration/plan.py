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

"""Twelve views that `semcal plan` proposes, beside twelve at random: how well nm per pixel is known afterwards.

    python -m benchmarks.calibration.plan [--quick]

A microscope is calibrated at 100x, 1000x and 10 000x only. Then four visits of three views follow: where `semcal plan`
says, or at magnifications drawn evenly in log g, with the tilts of the plan; or twelve visits of one view each at such
magnifications, with tilts drawn from 0 to 40 degrees. What counts is the largest stated 1-sigma of nm per pixel in the
range, and the largest error in the same range.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from joblib import Parallel, delayed

from benchmarks.calibration.check import STAGE
from benchmarks.calibration.coverage import PRESETS
from benchmarks.table import quick_from_command_line, show
from semcal_ros.core.calibration.judgement.plan import plan_views
from semcal_ros.core.calibration.judgement.thresholds import PLANNED_TILTS_RAD
from semcal_ros.core.calibration.judgement.update import update_calibration
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.uncertainty import worst_pixel_size
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import stage_views

SQUARES_M = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)
START = (100.0, 1000.0, 10000.0)
DRAWS = 6


def run(seed: int) -> list[tuple[str, float, float]]:
    """(way, largest stated sigma, largest error), both relative."""
    microscope, axis = preset(PRESETS[seed % len(PRESETS)]), StageAxis(STAGE.axis_rad or 0.0)
    rng = np.random.default_rng(seed)

    def views(visits: Sequence[float], tilts: Sequence[float]) -> list[GridView]:
        stage = replace(STAGE, tilts_rad=tuple(tilts))
        own = int(rng.integers(1 << 30))
        return stage_views(microscope.camera_at, visits, stage, seed=own, readings=True)

    before = calibrate_views(
        views(START, PLANNED_TILTS_RAD),
        image_size=microscope.image_size,
        display_width_m=microscope.display_width_m,
        options=CalibrationOptions(axis=axis),
    ).model

    def after(new: list[GridView]) -> tuple[float, float]:
        model = update_calibration(
            before, new, image_size=microscope.image_size, axis=axis, ageing=0.0
        ).model
        return _judge(model)

    def _judge(model: CalibrationModel) -> tuple[float, float]:
        errors = [
            np.divide(model.at(float(g)).pixel_size_m, microscope.camera_at(float(g)).pixel_size_m)
            for g in np.geomspace(START[0], START[-1], 25)
        ]
        return worst_pixel_size(model)[0], float(np.max(np.abs(np.array(errors) - 1.0)))

    planned = plan_views(before, 1e-9, squares_m=SQUARES_M, most_visits=4)
    visits = [visit.magnification for visit in planned.visits]
    out = [
        ("before", *_judge(before)),
        ("12 planned views", *after(views(visits, PLANNED_TILTS_RAD))),
    ]
    low, high = math.log(START[0]), math.log(START[-1])
    for _ in range(DRAWS):
        at = [float(g) for g in np.exp(rng.uniform(low, high, 4))]
        out.append(("4 visits at random, 3 views each", *after(views(at, PLANNED_TILTS_RAD))))
        single: list[GridView] = []
        for number, g in enumerate(np.exp(rng.uniform(low, high, 12))):
            (view,) = views([float(g)], [float(rng.uniform(0.0, math.radians(40.0)))])
            single.append(replace(view, name=f"{number}", visit=number))
        out.append(("12 visits at random, a view each", *after(single)))
    return out


def main() -> None:
    """Print the table."""
    count = 2 if quick_from_command_line(__doc__) else 8
    runs = Parallel(n_jobs=-1)(delayed(run)(seed) for seed in range(count))
    rows = [row for own in runs for row in own]
    names = list(dict.fromkeys(name for name, _, _ in rows))
    planned = _median(rows, "12 planned views", 1)
    table: list[list[object]] = []
    for name in names:
        sigmas = sorted(100.0 * sigma for own, sigma, _ in rows if own == name)
        sigma = _median(rows, name, 1)
        span = f"{sigmas[0]:.2g} to {sigmas[-1]:.2g}"
        table.append([name, 100.0 * sigma, span, sigma / planned, 100.0 * _median(rows, name, 2)])
    show(
        f"Largest 1-sigma of nm per pixel from 100x to 10 000x, {count} calibrations, {DRAWS} draws of each",
        ["", "median, %", "all, %", "over planned", "largest error, median, %"],
        table,
    )


def _median(rows: Sequence[tuple[str, float, float]], name: str, column: int) -> float:
    return float(np.median([row[column] for row in rows if row[0] == name]))


if __name__ == "__main__":
    main()
