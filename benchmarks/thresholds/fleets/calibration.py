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

"""Random microscopes of ``benchmarks.calibration.fleet`` with few corners, and a simulated stage.

Errors of microscopes are in px, after a pose fit; those of the stage are relative ones of nm per pixel between the
calibrated magnifications. Of the stage some tilts are stated wrongly. Its calibration is checked with views of the same
microscope and of one whose scale has changed by 1.2 %, renewed for that, and views are planned for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.calibration.check import STAGE
from benchmarks.calibration.fleet.score import judge
from benchmarks.thresholds.answers import Answer, digest_of
from semcal_ros.core.calibration.judgement.check import check_calibration
from semcal_ros.core.calibration.judgement.plan import judge_calibration, plan_views
from semcal_ros.core.calibration.judgement.update import update_calibration
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import stage_views

# Of seed 0: one axis and no residual distortion; a spiral, two visits and outliers; coils, settling and two visits;
# the same with a spiral, for which a residual field is taken.
MICROSCOPES = (180, 466, 232, 350)
# Of three magnifications, one view's stated wrongly.
MISSTATED = 450
VISITS = (300.0, 700.0, 1500.0, 3000.0, 6000.0, 3000.0, 1500.0, 700.0, 300.0)
CHECKED = (400.0, 1500.0, 4500.0)
WRONG_TILT_RAD, WRONG_TILTS = 0.15, (4, 11)
CHANGE, WRONG_SIGMAS = 0.012, 4.0
SQUARES_M = (10e-6, 5e-6, 2e-6)
MICROSCOPE = preset("jsm820")
AXIS = StageAxis(STAGE.axis_rad or 0.0)
OPTIONS = CalibrationOptions(axis=AXIS)


@dataclass(frozen=True)
class Drawn:
    """A microscope of the fleet, or views on the stage, with the calibration from before."""

    action: str
    index: int = 0
    views: tuple[GridView, ...] = ()
    model: CalibrationModel | None = None


def draw() -> dict[str, Any]:
    """Name the microscopes, whose corners are drawn in no time, and draw the views on the stage."""
    cases: dict[str, Any] = {f"microscope {n}": Drawn("judge", n) for n in MICROSCOPES}
    cases[f"microscope {MISSTATED}"] = Drawn("misstate", MISSTATED)
    views = _see(MICROSCOPE.camera_at, VISITS, 1)
    model = _calibrate(views).model
    for number in WRONG_TILTS:
        reading = views[number].stage
        assert reading is not None and reading.tilt_rad is not None
        wrong = replace(reading, tilt_rad=reading.tilt_rad + WRONG_TILT_RAD)
        views[number] = replace(views[number], stage=wrong)
    cases["stage"] = Drawn("calibrate", views=tuple(views))
    same, changed = _see(MICROSCOPE.camera_at, CHECKED, 2), _see(_changed_camera, CHECKED, 3)
    cases["check of the same"] = Drawn("check", views=tuple(same), model=model)
    cases["check of the changed"] = Drawn("check changed", views=tuple(changed), model=model)
    cases["update"] = Drawn("update", views=tuple(changed), model=model)
    cases["plan"] = Drawn("plan", model=model)
    return cases


def _changed_camera(g: float) -> ScanCamera:
    before = MICROSCOPE.camera_at(g)
    return replace(before, m=before.m * (1.0 + CHANGE))


def _see(camera_at: Callable[[float], ScanCamera], visits: tuple[float, ...], seed: int) -> Any:
    stage = replace(STAGE, tilts_rad=(0.0, 0.35, 0.6))
    return stage_views(camera_at, visits, stage, seed=seed, readings=True)


def _calibrate(views: list[GridView]) -> Any:
    return calibrate_views(
        views,
        image_size=MICROSCOPE.image_size,
        display_width_m=MICROSCOPE.display_width_m,
        options=OPTIONS,
    )


def run(case: Drawn) -> Answer:
    """Calibrate a microscope and judge it between the magnifications, or do what is named with views on the stage."""
    if case.action in ("judge", "misstate"):
        return _judge(case.index, misstate=case.action == "misstate")
    start, model, size = time.process_time(), case.model, MICROSCOPE.image_size
    if case.action == "calibrate":
        result = _calibrate(list(case.views))
        unused = sum("its tilt is not used" in warning for warning in result.warnings)
        decision = f"{len(result.warnings)} warnings, {unused} tilts not used"
        return _compare(decision, result.model, MICROSCOPE.camera_at, start)
    assert model is not None
    if case.action == "update":
        renewed = update_calibration(model, case.views, image_size=size, axis=AXIS)
        decision = renewed.check.verdict.name
        return _compare(decision, renewed.model, _changed_camera, start)
    if case.action == "plan":
        plan = plan_views(model, 1e-9, squares_m=SQUARES_M, most_visits=3)
        judged = judge_calibration(model)
        seconds = time.process_time() - start
        numbers = [(v.magnification, v.square_m, v.largest, v.at) for v in plan.visits]
        bits = digest_of(np.array(numbers), plan.largest, plan.floor, judged.floor)
        # What it promises to leave is the smaller the better.
        left = plan.visits[-1].largest if plan.visits else plan.largest
        return Answer(
            f"{len(plan.visits)} visits", len(plan.visits), left, left, digest=bits, seconds=seconds
        )
    done = check_calibration(model, case.views, image_size=size, axis=AXIS)
    seconds = time.process_time() - start
    truth = CHANGE if case.action == "check changed" else 0.0
    error = abs(done.scale_change - truth)
    names = ", ".join(change.name for change in done.changes)
    bits = digest_of(done.scale_change, done.scale_sigma, done.rms_px, done.misfit)
    return Answer(
        f"{done.verdict.name}, {names or 'nothing'} changed",
        done.views,
        error,
        error,
        error / done.scale_sigma,
        int(names != ("scale" if truth else "")),
        bits,
        seconds,
    )


def _compare(
    decision: str, model: CalibrationModel, truth: Callable[[float], ScanCamera], start: float
) -> Answer:
    """Compare nm per pixel with the truth."""
    seconds = time.process_time() - start
    errors, sigmas = [], []
    for g in np.geomspace(VISITS[0], max(VISITS), 16)[:-1].tolist():
        camera, true = model.at(g), np.array(truth(g).pixel_size_m)
        errors.append(np.array(camera.pixel_size_m) / true - 1.0)
        sigmas.append(np.array(camera.pixel_size_sigma_m) / true)
    error, score = np.array(errors), np.abs(errors) / np.array(sigmas)
    return Answer(
        decision,
        1,
        float(np.sqrt(np.mean(error**2))),
        float(np.abs(error).max()),
        float(np.sqrt(np.mean(score**2))),
        int(score.max() > WRONG_SIGMAS),
        digest_of(error, np.array(sigmas)),
        seconds,
    )


def _judge(index: int, *, misstate: bool) -> Answer:
    """Calibrate a microscope of the fleet."""
    found, _ = judge(0, index, misstate=misstate)
    if found.raised:
        return Answer("refused", digest=digest_of(found.raised), seconds=found.seconds)
    error, score = np.array(found.error_px), found.px_over_sigma
    lengths = found.nm_over_sigma.ravel()
    bits = digest_of(error, found.sigma_px, found.nm_error, found.nm_sigma, *found.messages)
    return Answer(
        f"{found.verdict}, field {found.has_field}, {len(found.messages)} warnings, "
        f"{found.views_left_out} left out",
        found.corners,
        float(np.sqrt(np.mean(error**2))),
        float(error.max()),
        float(np.sqrt(np.mean(np.concatenate([score, lengths]) ** 2))),
        int(found.verdict == "wrong"),
        bits,
        found.seconds,
    )
