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

"""From a folder of Zeiss TIFFs of a 10 um grid to a corrected TIFF with a scale bar, in two commands without YAML."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import tifffile

from semcal_ros import Calibration
from semcal_ros.cli import main
from semcal_ros.files.images.image_file import describe_image_file
from semcal_ros.synthetic import TYPICAL_GRID, calibration_plan, preset
from semcal_ros.synthetic.stage import STAGES
from tests.helpers.sem_files import save_zeiss_tiff

DISPLAY_M = 0.12
SIZE = 256
START = datetime(2026, 5, 4, 9, 30)


@pytest.mark.long
def test_zeiss_files_of_a_grid_to_a_corrected_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scope = preset("jsm820").with_image_size(SIZE, SIZE)
    plan = calibration_plan(
        scope,
        magnifications=[800.0, 1700.0],
        views=4,
        seed=3,
        stage=STAGES["one-axis"],
        grid=TYPICAL_GRID,
    )
    (tmp_path / "grid").mkdir()
    for k, frame in enumerate(plan.frames):
        stage = frame.position_read
        assert frame.square_m == 10e-6 and stage is not None
        save_zeiss_tiff(
            tmp_path / "grid" / f"grid_{k}.tif",
            plan.render(k),
            DISPLAY_M / frame.magnification / SIZE,
            magnification=frame.magnification,
            tilt_deg=float(np.degrees(stage.tilt_rad)),
            rotation_deg=float(np.degrees(stage.rotation_rad)),
            at=START + timedelta(seconds=round(frame.start_time_s)),
        )
    cal, out = tmp_path / "cal.yaml", tmp_path / "out.tif"
    assert main(["calibrate", f"{tmp_path}/grid", "-o", str(cal), "--squares", "10um"]) == 0
    told = capsys.readouterr()
    assert "8 of 8 views" in told.out and "the stage is known for 8 of 8 views" in told.out
    scan = tmp_path / "grid" / "grid_0.tif"
    given = ["--calibration", str(cal), "-o", str(out), "--scale-bar"]
    assert main(["rectify", str(scan), *given]) == 0
    (page,) = describe_image_file(out).pages
    g = plan.frames[0].magnification
    camera = Calibration.load(cal).at(g)
    assert page.pixel_size_m is not None
    off = page.pixel_size_m / scope.camera_at(g).rectified.pixel_size_m[0] - 1.0
    known = camera.rectified.pixel_size_sigma_m[0] / page.pixel_size_m
    # The one-axis stage of the virtual microscope leaves some parts in a thousand open, which it states.
    assert abs(off) < 3.0 * known < 0.02
    levels = tifffile.imread(out)
    assert levels.shape == (SIZE + page.databar_rows, SIZE) and page.databar_rows > 20
