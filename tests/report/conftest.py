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

"""One calibration and one page for all tests of the report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.report import write_calibration_report
from semcal_ros.report.html import encode
from tests.helpers.made_once import folder_once, made_once
from tests.helpers.report_samples import DISPLAY_M, HOSTILE, SIZE, found_of, grid_view, unused


@pytest.fixture(scope="session")
def result() -> CalibrationResult:
    rng = np.random.default_rng(7)
    views = [
        grid_view(g, tilt, 90.0 * k + 20.0, rng)
        for g in (100.0, 400.0, 1500.0, 5000.0)
        for k, tilt in enumerate((2.0, 25.0, 32.0, 28.0))
    ]
    made = made_once(
        "report",
        lambda: calibrate_views(views, image_size=(SIZE, SIZE), display_width_m=DISPLAY_M),
    )
    # The calibration's only warning of its own: no magnification was visited twice.
    (own,) = made.warnings
    assert "how repeatable" in own
    return replace(made, findings=())


@pytest.fixture(scope="session")
def page_path(result: CalibrationResult) -> Path:
    return folder_once("report-page", lambda folder: _write(result, folder)) / "report.html"


def _write(result: CalibrationResult, folder: Path) -> None:
    path = folder / "report.html"
    path.write_text("an older report")
    with pytest.MonkeyPatch.context() as patch:
        # Coarse figures: they are looked at elsewhere.
        patch.setattr(encode, "_FIGURE_DPI", 48.0)
        _write_report(result, path)


def _write_report(result: CalibrationResult, path: Path) -> None:
    written = write_calibration_report(
        result,
        path,
        detections=[found_of(v) for v in result.views],
        rejected=[
            unused(HOSTILE, 300.0, f"no grid {HOSTILE}"),
            unused("b\x00\ud800", 400.0, "blurred"),
            unused("frame 9", 400.0, "blank", np.full((SIZE, SIZE), 90, dtype=np.uint16)),
        ],
        images=[("Setup", np.zeros((40, 60, 3), dtype=np.uint8))],
        paper=True,
        title=f"Microscope {HOSTILE}",
    )
    assert written == path
