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

Calibrations and views come from `semcal_ros.synthetic.stage`, as in `benchmarks.calibration.coverage`: a stage with one
tilt axis that misses the specimen, visits that scatter by 0.15 %, lines that jitter. The check has 3 views at each of 4
magnifications, or of 12. A verdict is wrong if a calibration that holds is called
degraded, one that does not is called valid, or the change is not named.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections import Counter
from dataclasses import replace

from joblib import Parallel, delayed

from benchmarks.calibration.coverage import PRESETS, VISITS
from benchmarks.table import quick_from_command_line, show
from semcal_ros.core.calibration.calibrate import CalibrationOptions, calibrate_views
from semcal_ros.core.calibration.check import Verdict, check_calibration
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import SimulatedStage, stage_views

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
}
CHECKS = 8


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
            named = [change.name for change in done.changes]
            if done.verdict is Verdict.VALID:
                outcome = "valid"
            else:
                outcome = "named" if named == [name] else f"named {', '.join(named) or 'a pattern'}"
            out.append((kind, outcome))
    return out


def main() -> None:
    """Print the table."""
    count = 2 if quick_from_command_line(__doc__) else 5
    for title, visited in (("4", FEW), ("12", MANY)):
        runs = Parallel(n_jobs=-1)(delayed(outcomes)(seed, visited) for seed in range(count))
        results = [row for rows in runs for row in rows]
        table: list[list[object]] = []
        for kind, (_, _, name) in KINDS.items():
            found = Counter(outcome for own, outcome in results if own == kind)
            right = found["named"] if name else found["valid"]
            others = "; ".join(f"{n} x {text}" for text, n in found.most_common())
            part = 100.0 * right / found.total()
            table.append([kind, found.total(), f"{part:.0f}", others])
        show(
            f"Verdicts, {title} magnifications", ["changed", "checks", "right %", "outcomes"], table
        )


if __name__ == "__main__":
    main()
