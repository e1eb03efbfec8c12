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

"""Small series of a cantilever that is pushed, drawn by the simulator, and what must not pass for one.

Errors are those of the deflection, in nm; the frames at rest are no part of them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from benchmarks.thresholds.answers import Answer, digest_of, refusal
from semcal_ros.applications.cantilever import SeriesSettings, compare_series, measure_series
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import SemcalError
from semcal_ros.synthetic import Detector, Drift, preset
from semcal_ros.synthetic.specimens.cantilever import (
    CantileverPlan,
    CantileverScene,
    cantilever_plan,
    random_cantilever,
)
from semcal_ros.synthetic.specimens.substrate import Substrate

LENGTH_M = 35e-6
DRIFT = Drift(velocity_m_s=(6e-9, -4e-9), settling_m=(60e-9, 90e-9), wander_m=10e-9, seed=4)
# Of the simulator, a dark beam and a bright one.
DRAWN = (5, 4)
WRONG_NM, WRONG_SIGMAS = 3.0, 4.0
PAINTED_PX_M, PAINTED_LENGTH_PX = 100e-9, 150
PAINTED_PUSHES_PX = (0.0, 1.0, 2.5, 4.0)


@dataclass(frozen=True)
class Drawn:
    """Frames, what is told of them, and their true deflections."""

    frames: list[NDArray[np.uint8]]
    times_s: list[float]
    camera: ScanCamera
    timing: ScanTiming | None
    settings: SeriesSettings
    truth_m: NDArray[np.float64]
    reference: tuple[int, ...] = (0,)


def draw() -> dict[str, Any]:
    """Draw the frames."""
    near = {"pushes": (0.0, 0.3, 0.6, 1.0), "magnifications": (7760.0,), "view": "end"}
    plans: dict[str, CantileverPlan] = {
        "end": cantilever_plan(_scope(256), drift=DRIFT, seed=1, **near),
        "noise": cantilever_plan(
            _scope(256), detector=Detector(electrons=40.0, blur_px=1.6), drift=DRIFT, seed=4, **near
        ),
        "edge-on": cantilever_plan(
            _scope(256), scene=CantileverScene(width_m=300e-9), seed=3, **near
        ),
        "bare ground": cantilever_plan(
            _scope(256),
            scene=CantileverScene(substrate=Substrate("islands", 0.2, 0.0, 1.5e-6, 5)),
            seed=5,
            **near,
        ),
        "base": cantilever_plan(_scope(256), drift=DRIFT, seed=6, **(near | {"view": "base"})),
    }
    cases = {name: _take(plan) for name, plan in plans.items()}
    whole = cantilever_plan(
        _scope(384, 0.4),
        pushes=(0.0, 0.5, 1.0),
        magnifications=(8890.0,),
        frames_per_pose=2,
        drift=DRIFT,
        seed=2,
    )
    cases["whole"] = _take(whole, reference=(0, 1))
    for seed in DRAWN:
        drawn = random_cantilever(seed, base_in_view=True)
        plan = cantilever_plan(
            _scope(512, 0.4),
            scene=drawn.scene,
            largest_deflection_m=drawn.largest_deflection_m,
            rotation_rad=drawn.rotation_rad,
            magnifications=(6450.0,),
            pushes=(0.0, 0.4, 1.0),
            drift=drawn.drift,
            seed=seed,
        )
        cases[f"drawn {seed}"] = _take(plan, length_m=drawn.scene.length_m)
    cases["two beams"] = _take_two()
    end = cases["end"]
    cases["wrong shape"] = replace(end, settings=SeriesSettings(LENGTH_M, "parabola"))
    cases["too short"] = replace(end, settings=SeriesSettings(0.2 * LENGTH_M))
    cases["wrong length"] = replace(cases["whole"], settings=SeriesSettings(0.93 * LENGTH_M))
    cases["other length"] = replace(cases["whole"], settings=SeriesSettings(0.966 * LENGTH_M))
    clicks = SeriesSettings(LENGTH_M, base_px=(50.0, 50.0), tip_px=(200.0, 200.0))
    cases["beside the beam"] = replace(end, settings=clicks)
    cases["at once"] = replace(end, times_s=[1e-3 * k for k in range(len(end.frames))])
    rng = np.random.default_rng(7)
    ground = [
        np.clip(gaussian_filter(rng.normal(90.0, 120.0, (256, 256)), 2.0), 0, 255).astype(np.uint8)
        for _ in end.frames
    ]
    cases["no beam"] = replace(end, frames=ground)
    return cases


def _scope(size: int, width_m: float = 0.12) -> Any:
    return replace(preset("jsm820"), display_width_m=width_m).with_image_size(size, size)


def _take(
    plan: CantileverPlan, *, length_m: float = LENGTH_M, reference: tuple[int, ...] = (0,)
) -> Drawn:
    return Drawn(
        [plan.render(k) for k in range(len(plan))],
        [frame.start_time_s for frame in plan.frames],
        plan.microscope.camera_at(plan.frames[0].magnification),
        plan.microscope.timing,
        SeriesSettings(length_m),
        np.array([frame.scene.deflection_m for frame in plan.frames]),
        reference,
    )


def paint_two_beams(pushes_px: Sequence[float]) -> list[NDArray[np.uint8]]:
    """Two parallel beams alike in 256 px, of which the lower one bends as one that is pushed at its end."""
    ground = gaussian_filter(np.random.default_rng(9).normal(0.0, 1.0, (256, 256)), 2.0)
    rows, columns = np.mgrid[:256, :256].astype(float)
    u = np.clip((columns - 39.5) / PAINTED_LENGTH_PX, 0.0, 1.0)
    frames = []
    for number, push in enumerate(pushes_px):
        image = 60.0 + 30.0 * ground
        for row, bent in ((80.0, 0.0), (150.0, push)):
            across = np.abs(rows - row - bent * 0.5 * (3.0 * u**2 - u**3))
            cover = ndtr(9.0 - across) * ndtr(39.5 + PAINTED_LENGTH_PX - columns)
            image = image + cover * (160.0 - image)
        image = image + ndtr(39.5 - columns) * (160.0 - image)
        noise = np.random.default_rng(number).normal(0.0, 5.0, image.shape)
        frames.append(np.clip(image + noise, 0, 255).astype(np.uint8))
    return frames


def _take_two() -> Drawn:
    frames = paint_two_beams(PAINTED_PUSHES_PX)
    camera = ScanCamera.nominal(6450.0, 256, 256, 6450.0 * 256 * PAINTED_PX_M)
    return Drawn(
        frames,
        [5.0 * k for k in range(len(frames))],
        camera,
        None,
        SeriesSettings(PAINTED_LENGTH_PX * PAINTED_PX_M),
        PAINTED_PX_M * np.array(PAINTED_PUSHES_PX),
    )


def run(case: Drawn) -> Answer:
    """Measure a series."""
    start = time.process_time()
    try:
        found = measure_series(
            case.frames,
            case.times_s,
            case.camera,
            case.timing,
            case.settings,
            reference=case.reference,
        )
        table = compare_series([found], poses=len(case.frames) // len(case.reference))
    except SemcalError as error:
        return refusal(error, time.process_time() - start)
    seconds = time.process_time() - start
    measured = np.array([frame.deflection_m for frame in found.frames])
    sigma = np.array([frame.sigma_m for frame in found.frames])
    pushed = ~np.isin(np.arange(len(measured)), case.reference)
    known = pushed & np.isfinite(measured) & np.isfinite(sigma)
    notes = f"{len(found.notes)} notes, {int(np.sum(found.drift.trusted))} with a drift"
    bits = digest_of(measured, sigma, table.sigma_m, found.undeformed.length_m, *found.notes)
    if not np.any(known):
        return Answer(f"{notes}, nothing known", 0, digest=bits, seconds=seconds)
    # Which side is positive depends on which end of the beam is taken for its base.
    error = 1e9 * (np.abs(measured) - np.abs(case.truth_m))[known]
    score = np.abs(error) / (1e9 * sigma[known])
    return Answer(
        notes,
        int(np.sum(known)),
        float(np.sqrt(np.mean(error**2))),
        float(np.abs(error).max()),
        float(np.sqrt(np.mean(score**2))),
        int(np.sum((score > WRONG_SIGMAS) & (np.abs(error) > WRONG_NM))),
        bits,
        seconds,
    )
