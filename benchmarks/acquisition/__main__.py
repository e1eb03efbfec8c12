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

"""Views and minutes until nm per pixel is known to 0.1 %: with the planner, as in the paper, and at random.

A simulated microscope and a one-axis stage with their usual faults; the corners are drawn, not found in images.
Each row is one recording: the planner's (:mod:`semcal_ros.core.calibration.acquisition`); 21 magnifications with 5
tilts each, as the paper has them, and then more such rounds; visits of magnifications at random, with the tilts of the
planner. ``sigma`` is the largest stated 1-sigma of nm per pixel in the range, repeatability of a single setting aside;
``error`` the largest true one. The minutes are those of a stage that tilts in 5 s, a magnification that settles in
3 s, and two frames for each view.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.table import quick_from_command_line, show
from semcal_ros.core.calibration.acquisition import AcquisitionGoal, plan_survey
from semcal_ros.core.calibration.judgement.plan import ViewPlan, plan_views
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.synthetic import STAGES, TYPICAL_GRID, preset
from semcal_ros.synthetic.stage import stage_views

SEM = preset("jsm820")
SQUARES_M = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)
RANGE = (500.0, 10000.0)
TILT_S, SETTLE_S = 5.0, 3.0
PAPER_VISITS, PAPER_TILTS = 21, 5
MOST_VIEWS = 300
TARGET = 1e-3

Visits = Sequence[float]


def calibrate(visits: Visits, tilts_rad: Sequence[float], seed: int) -> CalibrationModel:
    """Calibrate from visits; the first of them are the same for every longer recording of a seed."""
    stage = replace(STAGES["one-axis"], tilts_rad=tuple(tilts_rad))
    views = stage_views(
        SEM.camera_at, visits, stage, TYPICAL_GRID, seed=seed, readings=True, most_corners=400
    )
    options = CalibrationOptions(axis=StageAxis())
    return calibrate_views(
        views,
        image_size=SEM.image_size,
        display_width_m=SEM.display_width_m,
        options=options,
    ).model


def largest_error(model: CalibrationModel) -> float:
    """Largest relative error of nm per pixel in the range."""
    return max(
        float(
            np.max(np.abs(np.divide(model.at(g).pixel_size_m, SEM.camera_at(g).pixel_size_m) - 1))
        )
        for g in np.geomspace(*RANGE, 60)
    )


def minutes(visits: int, tilts: int) -> float:
    """Time that a microscope takes."""
    view_s = TILT_S + 2.0 * SEM.timing.acquisition_time_s
    return (visits * (SETTLE_S + tilts * view_s)) / 60.0


def plan(model: CalibrationModel) -> ViewPlan:
    """What the planner proposes for one round."""
    return plan_views(model, TARGET, squares_m=SQUARES_M, most_visits=4, single_setting=False)


def record(
    first: Visits, more: Callable[[ViewPlan], Visits], tilts_rad: Sequence[float], seed: int
) -> tuple[Visits, float, CalibrationModel]:
    """Go on until the target is met, or there are too many views; the visits, the sigma and the calibration."""
    visits = list(first)
    while True:
        model = calibrate(visits, tilts_rad, seed)
        proposed = plan(model)
        if proposed.largest <= TARGET or len(visits) * len(tilts_rad) >= MOST_VIEWS:
            return visits, proposed.largest, model
        visits += more(proposed)


def main() -> None:
    """Print the table."""
    seeds = range(1 if quick_from_command_line(__doc__) else 3)
    goal = AcquisitionGoal(RANGE, SQUARES_M, SEM.display_width_m, TARGET)
    tilts = goal.tilts_rad
    survey = [request.magnification for request in plan_survey(goal)[:: len(tilts)]]
    paper = list(np.geomspace(*RANGE, PAPER_VISITS))
    paper_tilts = tuple(np.radians(np.linspace(0.0, 40.0, PAPER_TILTS)))
    rows: list[list[object]] = []
    for seed in seeds:
        rng = np.random.default_rng(seed)

        def drawn(_plan: object, rng: np.random.Generator = rng) -> Visits:
            return list(np.exp(rng.uniform(*np.log(RANGE), 4)))

        ways = (
            ("planner", survey, lambda plan: [v.magnification for v in plan.visits], tilts),
            ("paper, 21 x 5", paper, lambda _plan: paper, paper_tilts),
            ("random", [*RANGE, *drawn(None)], drawn, tilts),
        )
        for name, first, more, own_tilts in ways:
            visits, sigma, model = record(first, more, own_tilts, seed)
            row = [name, seed, len(visits) * len(own_tilts), minutes(len(visits), len(own_tilts))]
            rows.append([*row, 100.0 * sigma, 100.0 * largest_error(model)])
    show(
        f"views until nm per pixel is known to 0.1 % from {RANGE[0]:g}x to {RANGE[1]:g}x",
        ["", "seed", "views", "minutes", "sigma %", "error %"],
        rows,
    )


if __name__ == "__main__":
    main()
