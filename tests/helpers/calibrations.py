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

"""Calibrations of virtual microscopes, each made once however many tests look at it."""

from __future__ import annotations

import hashlib
from functools import cache

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import grid_views
from tests.helpers.made_once import made_once

NOISE_PX = 0.05
CALIBRATED = (100.0, 300.0, 800.0, 1800.0, 3500.0, 6000.0, 10000.0)
DEFAULT = CalibrationOptions()
#: Magnifications of the paper's methods: enough for an equation of the third order with an error of its own.
CALIBRATED_EVENLY = (100.0, 1200.0, 2700.0, 5100.0, 7600.0, 10000.0)
#: Magnifications that no calibration has seen.
BETWEEN = (170.0, 500.0, 1300.0, 2600.0, 4800.0, 8000.0)


def seen_views(
    name: str, magnifications: tuple[float, ...] = CALIBRATED, views: int = 4, seed: int = 0
) -> list[GridView]:
    """Noisy views of a preset."""
    microscope = preset(name)
    return grid_views(
        microscope.camera_at,
        magnifications,
        noise_px=NOISE_PX,
        views=views,
        seed=seed,
        project=microscope.project,
    )


@cache
def calibrated(
    name: str,
    options: CalibrationOptions = DEFAULT,
    magnifications: tuple[float, ...] = CALIBRATED,
    views: int = 4,
    seed: int = 0,
) -> CalibrationResult:
    """A preset, calibrated from such views."""
    microscope = preset(name)
    asked = repr((name, options, magnifications, views, seed))
    return made_once(
        f"calibrated-{hashlib.sha256(asked.encode()).hexdigest()[:16]}",
        lambda: calibrate_views(
            seen_views(name, magnifications, views, seed),
            image_size=microscope.image_size,
            display_width_m=microscope.display_width_m,
            options=options,
        ),
    )
