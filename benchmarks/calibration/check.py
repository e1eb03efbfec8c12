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

"""How often `semcal check` is wrong: of calibrations that hold, and after one thing has changed.

    python -m benchmarks.calibration.check [--quick]
    python -m benchmarks.calibration.check --reference FOLDER [--images] [--quick]

Calibrations and views come from `semcal_ros.synthetic.stage`, as in `benchmarks.calibration.coverage`: a stage with one
tilt axis that misses the specimen, visits that scatter by 0.15 %, lines that jitter. The check has 3 views at each of 4
magnifications, or of 12. A verdict is wrong if a calibration that holds is called
degraded, one that does not is called valid, or the change is not named.

With the folder of the reference recordings, the calibration is that of `grid_calibration`, which another simulator
made, and the views are drawn by the virtual SEM from the truth beside it: 100 sweeps of the flat grid over every third
magnification of `grid_zoom_sweep`, and 100 checks of three views at each of four magnifications. With --images they are
images, in which the corners are found; without, the corners with 0.04 px of noise.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from joblib import Parallel, delayed

from benchmarks.calibration.coverage import PRESETS, VISITS
from benchmarks.calibration.reference import (
    CHANGED,
    change,
    corners_of_sweep,
    corners_of_visits,
    load_microscope,
    sweep_magnifications,
    sweep_of,
    visits_of,
)
from benchmarks.table import show
from semcal_ros.core.calibration.judgement.check import CalibrationCheck, Verdict, check_calibration
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import SimulatedStage, stage_views
from semcal_ros.workflows.calibrate import calibrate
from semcal_ros.workflows.check_and_update import check

STAGE = SimulatedStage(
    miss_m=(1.0e-4, 0.0),
    scale_sigma=1.5e-3,
    line_jitter_px=0.05,
    tilt_error_rad=0.004,
    reading_sigma_rad=0.003,
)
FEW = (300.0, 1500.0, 3100.0, 8000.0)
MANY = tuple(round(600.0 * 10 ** (k / 11), 1) for k in range(12))
# What is changed, by how much, and the name under which it is reported.
KINDS = {
    "nothing": ("m", 0.0, ""),
    "scale +0.5 %": ("m", 0.005, "scale"),
    "scale -0.5 %": ("m", -0.005, "scale"),
    "aspect +0.2 %": ("aspect", 0.002, "aspect"),
    "centre of distortion +15 px": ("ex", 15.0, "centre of distortion"),
    # In half image widths: 3 px over 6 columns of 512, and 1 px of a cubic.
    "settling +3 px": ("settling_2", 3.0 / 256.0, "settling"),
    "coils +1 px": ("coil_x3", 1.0 / 256.0, "coils"),
    "spiral +0.003": ("xi_s", 0.003, "spiral"),
}
CHECKS = 8
# Known to the truth of the reference recordings, over their range.
FEW_OF_REFERENCE = (326.0, 943.0, 2424.0, 6000.0)


def _changed(camera_at, parameter, by):
    def camera(g):
        own = camera_at(g)
        value = getattr(own, parameter)
        return replace(own, **{parameter: value * (1.0 + by) if parameter == "m" else value + by})

    return camera


def outcomes(seed: int, visited: tuple[float, ...]) -> list[tuple[str, str]]:
    """(kind, outcome) of all checks of one calibration."""
    microscope = preset(PRESETS[seed % len(PRESETS)])
    axis = StageAxis(STAGE.axis_rad or 0.0)
    stage = replace(STAGE, tilts_rad=(0.0, 0.35, 0.7))
    views = stage_views(microscope.camera_at, VISITS, stage, seed=seed, readings=True)
    model = calibrate_views(
        views,
        image_size=microscope.image_size,
        display_width_m=microscope.display_width_m,
        options=CalibrationOptions(axis=axis),
    ).model
    out = []
    for number in range(CHECKS):
        for kind, (parameter, by, name) in KINDS.items():
            own = stage_views(
                _changed(microscope.camera_at, parameter, by),
                visited,
                stage,
                seed=1000 * (seed + 1) + number,
                readings=True,
            )
            done = check_calibration(model, own, image_size=microscope.image_size, axis=axis)
            out.append((kind, _outcome(done, name)))
    return out


def _outcome(done: CalibrationCheck, name: str) -> str:
    if done.verdict is Verdict.VALID:
        return "valid"
    named = [found.name for found in done.changes]
    return "named" if named == [name] else f"named {', '.join(named) or 'a pattern'}"


def _drawn(calibration, microscope, draw, magnifications, kind: str, seed: int) -> tuple[str, str]:
    """(kind, outcome) of one check of the reference microscope."""
    seen = draw(change(microscope, kind), magnifications, seed)
    if draw in (sweep_of, visits_of):
        done = check(calibration, seen).result
    else:
        done = check_calibration(calibration, seen, image_size=microscope.image_size)
    return kind, _outcome(done, CHANGED[kind][2])


def _show(title: str, names: dict[str, str], results: Sequence[tuple[str, str]]) -> None:
    table: list[list[object]] = []
    wrong = 0
    for kind, name in names.items():
        found = Counter(outcome for own, outcome in results if own == kind)
        right = found["named"] if name else found["valid"]
        wrong += found.total() - right
        others = "; ".join(f"{n} x {text}" for text, n in found.most_common())
        table.append([kind, found.total(), f"{100.0 * right / found.total():.0f}", others])
    part = f"{wrong} of {len(results)} verdicts are wrong: {100.0 * wrong / len(results):.1f} %"
    show(title, ["changed", "checks", "right %", "outcomes"], table, part)


def check_reference(folder: Path, count: int, images: bool) -> None:
    """Print the verdict on `grid_zoom_sweep`, and the tables of what is drawn."""
    calibration = calibrate(folder / "grid_calibration")
    print(f"grid_zoom_sweep: {check(calibration, folder / 'grid_zoom_sweep').result.summary}")
    microscope = load_microscope(folder)
    names = {kind: name for kind, (_, _, name) in CHANGED.items()}
    for title, draw, magnifications in (
        (
            "a sweep of 12 magnifications",
            sweep_of if images else corners_of_sweep,
            sweep_magnifications(folder)[::3],
        ),
        (
            "three views at each of 4 magnifications",
            visits_of if images else corners_of_visits,
            list(FEW_OF_REFERENCE),
        ),
    ):
        results = Parallel(n_jobs=-1)(
            delayed(_drawn)(calibration, microscope, draw, magnifications, kind, seed)
            for seed in range(count)
            for kind in CHANGED
        )
        _show(f"Verdicts, reference microscope, {title}", names, results)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument(
        "--reference", type=Path, metavar="FOLDER", help="folder of the reference recordings"
    )
    parser.add_argument("--images", action="store_true", help="with --reference: images")
    given = parser.parse_args()
    if given.reference is not None:
        check_reference(given.reference, 2 if given.quick else 25, given.images)
        return
    names = {kind: name for kind, (_, _, name) in KINDS.items()}
    for title, visited in (("4", FEW), ("12", MANY)):
        runs = Parallel(n_jobs=-1)(
            delayed(outcomes)(seed, visited) for seed in range(2 if given.quick else 5)
        )
        results = [row for rows in runs for row in rows]
        _show(f"Verdicts, {title} magnifications", names, results)


if __name__ == "__main__":
    main()
