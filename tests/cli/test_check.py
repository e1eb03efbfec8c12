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

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from semcal_ros import Calibration
from semcal_ros.files.recordings import open_recording
from tests.helpers.made_once import folder_once
from tests.helpers.semcal_runs import refused, run

OTHER_VOLTAGE = (
    "other conditions than those of the calibration: voltage 10 kV, calibrated at 5 kV; check it (semcal check), or "
    "use one that was made under these conditions"
)


@pytest.fixture(scope="module")
def folder() -> Path:
    """A calibration, and two recordings of the grid by other seeds."""
    return folder_once("check", _record_and_calibrate)


def _record_and_calibrate(place: Path) -> None:
    magnifications = [part for g in (600, 1500, 4000) for part in ("--magnification", g)]
    common = ("simulate", "--size", 256, "--plan", "grid", *magnifications)
    assert run(*common, place / "grid", "--views", 4) == 0
    assert run(*common, place / "today", "--views", 2, "--seed", 3) == 0
    assert run("calibrate", place / "grid", "-o", place / "cal.yaml", "--residual", "off") == 0
    # The same with a display that is 4 % narrower: all magnifications are other ones.
    data = yaml.safe_load((place / "cal.yaml").read_text())
    data["display_width_m"] *= 0.96
    # And it was made at half of the voltage.
    data["provenance"]["conditions"]["acceleration_voltage_v"] = [5000.0, 5000.0]
    (place / "off.yaml").write_text(yaml.safe_dump(data))


@pytest.mark.slow
def test_the_exit_status_is_the_verdict(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("check", folder / "cal.yaml", folder / "today") == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{folder / 'cal.yaml'}: valid\n")
    assert "6 views" in out
    header, *rows = out.splitlines()[1:13]
    assert "z  px at most  nm at most  probability" in header
    assert "times those expected" in rows[-1] and "other distortion" in rows[-2]
    with pytest.raises(SystemExit) as ended:
        run("check", folder / "off.yaml", folder / "today", "--json")
    assert ended.value.code == 1
    said = json.loads(capsys.readouterr().out)
    assert said["verdict"] == "degraded"
    assert [note for note in said["notes"] if "conditions" in note] == [OTHER_VOLTAGE]
    (change,) = [own for own in said["changes"] if own["name"] == "scale"]
    assert change in said["tested"]
    assert change["z_scores"] == pytest.approx([change["values"][0] / change["sigmas"][0]])
    # nm are most at the lowest magnification of the views, 600x; px are the same at all, but for the distortion.
    pixel_m = np.mean(Calibration.load(folder / "off.yaml").at(600.0).pixel_size_m)
    assert change["largest_m"] == pytest.approx(change["largest_px"] * pixel_m, rel=0.1)
    assert {"z_score", "p_value"} <= set(said["shape"])
    assert said["misfit_z"] == pytest.approx((said["misfit"] - 1.0) / 0.1)
    # px per m of the file are 1 / 0.96 of those of the images.
    assert said["scale_change"] == pytest.approx(0.96 - 1.0, abs=3.0 * said["scale_sigma"])


@pytest.mark.slow
def test_bad_input_is_refused_in_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "check", folder / "cal.yaml", folder / "today", "--untilted", "99")
    assert "untilted '99'" in line
    line = refused(capsys, "check", folder / "cal.yaml", folder / "missing")
    assert "missing" in line


@pytest.mark.parametrize(
    ("option", "value"),
    # The last two are the defaults: who gives them means a grid all the same.
    [("--squares", "10um"), ("--pattern", "dots"), ("--pattern", "auto"), ("--untilted", "auto")],
)
def test_a_specimen_has_no_grid_options(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were ignored; now they are refused, before anything is read."""
    line = refused(capsys, "check", "cal.yaml", "steps", "--specimen", option, value)
    assert f"{option}, which is about a grid" in line
    assert f"leave out {option}" in line and "--specimen" in line


@pytest.mark.slow
def test_rejected_views_are_named_with_the_reason(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = tmp_path / "views"
    views.mkdir()
    with open_recording(folder / "today") as opened:
        for k, frame in enumerate(f for f in opened.frames() if f.magnification == 1500.0):
            cv2.imwrite(str(views / f"grid{k}.png"), frame.image)
    noise = np.random.default_rng(0).integers(0, 255, (256, 256)).astype(np.uint8)
    for k in range(2):
        cv2.imwrite(str(views / f"noise{k}.png"), noise)
    given = (folder / "cal.yaml", views, "--magnification", "1500")
    for command in (("check", *given), ("evaluate", *given)):
        assert run(*command) == 0
        (line,) = (x for x in capsys.readouterr().err.splitlines() if "rejected: " in x)
        assert "at 1500" in line and line.count("at 1500") == 2
        assert run(*command, "--json") == 0
        rejections = json.loads(capsys.readouterr().out)["rejections"]
        assert len(rejections) == 2 and all(r["reason"] for r in rejections)


@pytest.mark.slow
def test_other_conditions_are_told_by_all_that_use_a_recording(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = folder / "today"
    for cal, told in (("off.yaml", 1), ("cal.yaml", 0)):
        given = folder / cal
        rectify = (
            "rectify",
            views,
            "--calibration",
            given,
            "-o",
            f"{tmp_path / cal}/",
            "--no-drift",
        )
        for command in (("evaluate", given, views), rectify):
            assert run(*command) == 0
            assert capsys.readouterr().err.count(f"note: {OTHER_VOLTAGE}") == told


@pytest.mark.slow
def test_an_update_brings_the_scale_back(folder: Path, tmp_path: Path) -> None:
    new = tmp_path / "new.yaml"
    assert run("update", folder / "off.yaml", folder / "today", "-o", new) == 0
    # Now it is valid; before it was not.
    assert run("check", new, folder / "today") == 0
    truth = Calibration.load(folder / "cal.yaml")
    for g in (700.0, 3000.0):
        # The display of off.yaml is 4 % narrower, so the same field has another magnification.
        ours, true = Calibration.load(new).at(0.96 * g), truth.at(0.96 * g)
        sigma = np.hypot(ours.pixel_size_sigma_m[0], true.pixel_size_sigma_m[0])
        assert abs(ours.pixel_size_m[0] - true.pixel_size_m[0]) < 3.0 * sigma


def test_a_plan_is_printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("plan", folder / "cal.yaml", "--target", "0.01%", "--visits", 2) == 0
    out = capsys.readouterr().out
    assert out.startswith("now: nm per px known to 0.")
    assert "no number of views meets 0.01 %" in out
    assert run("plan", folder / "cal.yaml", "--target", "5%", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["reached"] and said["visits"] == []
