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

"""What `semcal update` gives with ten views after a change of the scale, beside a full calibration.

    python -m benchmarks.calibration.update [--quick]

A microscope is calibrated (17 visits of nine magnifications, four views each); then its scale changes by 0.5 %. The
calibration is renewed with ten views, and the changed microscope calibrated anew with all 68. Both are compared with
the new truth between the calibrated magnifications. The stages, and the scatter of their visits, are those of
`benchmarks.calibration.check`; each run draws all of it anew.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from joblib import Parallel, delayed

from benchmarks.calibration.check import STAGE
from benchmarks.calibration.coverage import PRESETS, UPWARDS, VISITS
from benchmarks.table import quick_from_command_line, show
from semcal_ros.core.calibration.judgement.update import update_calibration
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import stage_views

CHANGE = 0.005
JUDGED = np.geomspace(UPWARDS[0], UPWARDS[-1], 21)
# Ten views: of ten magnifications one each, flat and tilted in turn, or of five with one flat and one tilted view.
TEN = tuple(float(g) for g in np.geomspace(120.0, 9000.0, 10))
FIVE = TEN[::2]
CameraAt = Callable[[float], ScanCamera]


def _views(
    camera_at: CameraAt, visits: Sequence[float], tilts: tuple[float, ...], seed: int
) -> list[GridView]:
    return stage_views(camera_at, visits, replace(STAGE, tilts_rad=tilts), seed=seed, readings=True)


def _one_each(camera_at: CameraAt, seed: int) -> list[GridView]:
    out: list[GridView] = []
    for number, g in enumerate(TEN):
        tilt = (0.0, 0.5)[number % 2]
        (view,) = _views(camera_at, (g,), (tilt,), 100 * seed + number)
        out.append(replace(view, name=f"{number}", visit=number))
    return out


def _two_each(camera_at: CameraAt, seed: int) -> list[GridView]:
    return _views(camera_at, FIVE, (0.0, 0.5), 100 * seed)


RENEWED = {"10 magnifications, a view each": _one_each, "5 magnifications, 2 views": _two_each}


def errors(model: CalibrationModel, camera_at: CameraAt) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of nm per pixel, and over their stated sigmas, (G, 2)."""
    relative, sigmas = [], []
    for g in JUDGED:
        own, true = model.at(float(g)), np.array(camera_at(float(g)).pixel_size_m)
        error = np.array(own.pixel_size_m) - true
        relative.append(error / true)
        sigmas.append(error / own.pixel_size_sigma_m)
    return np.array(relative), np.array(sigmas)


def run(seed: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Errors of the full calibration, and of each way to renew the one before."""
    microscope, axis = preset(PRESETS[seed % len(PRESETS)]), StageAxis(STAGE.axis_rad or 0.0)

    def changed(g: float) -> ScanCamera:
        own = microscope.camera_at(g)
        return replace(own, m=own.m * (1.0 + CHANGE))

    def calibrated(camera_at: CameraAt, number: int) -> CalibrationModel:
        return calibrate_views(
            _views(camera_at, VISITS, (0.0, 0.35, 0.55, 0.7), number),
            image_size=microscope.image_size,
            display_width_m=microscope.display_width_m,
            options=CalibrationOptions(axis=axis),
        ).model

    before = calibrated(microscope.camera_at, seed)
    out = {
        "not renewed": errors(before, changed),
        "calibrated anew, 68 views": errors(calibrated(changed, 1000 + seed), changed),
    }
    for name, draw in RENEWED.items():
        renewed = update_calibration(
            before, draw(changed, 2000 + seed), image_size=microscope.image_size, axis=axis
        ).model
        out[f"renewed, {name}"] = errors(renewed, changed)
    return out


def main() -> None:
    """Print the table."""
    count = 2 if quick_from_command_line(__doc__) else 12
    runs = Parallel(n_jobs=-1)(delayed(run)(seed) for seed in range(count))
    full = _rms([own["calibrated anew, 68 views"][0] for own in runs])
    table: list[list[object]] = []
    for name in runs[0]:
        relative, sigmas = ([own[name][k] for own in runs] for k in (0, 1))
        rms = _rms(relative)
        worst = max(float(np.abs(own).max()) for own in sigmas)
        table.append([name, 100.0 * rms, rms / full, _rms(sigmas), worst])
    show(
        f"nm per pixel after a change of the scale by {100.0 * CHANGE:g} %, {count} microscopes and stages",
        ["", "RMS error, %", "over that of 68 views", "RMS in sigmas", "largest in sigmas"],
        table,
    )


def _rms(values: Sequence[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
