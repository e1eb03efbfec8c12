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

"""The command line on small recordings of the virtual SEM."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from semcal_ros import Calibration
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.files.bags.reader import open_bag
from semcal_ros.report.html import encode
from semcal_ros.workflows.simulate import simulate
from tests.helpers.made_once import folder_once
from tests.helpers.semcal_runs import refused, run

COMMANDS = ["at", "calibrate", "drift", "evaluate", "import", "info", "play", "rectify", "simulate"]


@pytest.fixture(scope="session")
def folder() -> Path:
    """Three magnifications of the grid, their calibration, and a short sweep and a drifting specimen."""
    return folder_once("cli", _record_and_calibrate)


def _record_and_calibrate(base: Path) -> None:
    grid = [x for g in (300, 1000, 3000) for x in ("--magnification", g)]
    assert run("simulate", base / "grid", "--views", 3, *grid) == 0
    with pytest.MonkeyPatch.context() as patch:
        # Coarse figures: here it counts that they are made.
        patch.setattr(encode, "_FIGURE_DPI", 48.0)
        outputs = ("-o", base / "cal.yaml", "--report", base / "r.html")
        assert run("calibrate", base / "grid", *outputs) == 0
    zoom = ("--magnification", 500, "--magnification", 2000)
    assert run("simulate", base / "zoom", "--plan", "zoom", "--frames", 4, *zoom) == 0
    gold = ("--magnification", 2500, "--bits", 16)
    assert run("simulate", base / "gold", "--plan", "drift", "--frames", 6, *gold) == 0


@pytest.mark.slow
def test_the_display_width_is_that_of_the_calibration(folder, tmp_path, capsys):
    """A configuration of another display width, whose topic says to which width its numbers refer."""
    config = tmp_path / "wide.yaml"
    config.write_text(
        "name: wide\ndisplay_width_m: 0.24\n"
        "magnification: {quantity: magnification, display_width_m: 0.12}\n"
    )
    views = tmp_path / "views"
    assert run("simulate", views, "--views", 1, "--seed", 7, "--magnification", 1000) == 0
    capsys.readouterr()
    assert run("evaluate", folder / "cal.yaml", views, "--json") == 0
    plain = json.loads(capsys.readouterr().out)
    assert run("evaluate", folder / "cal.yaml", views, "--json", "--config", config) == 0
    assert json.loads(capsys.readouterr().out) == plain


@pytest.mark.slow
def test_calibration_and_report_are_there(folder):
    assert (folder / "cal.yaml").read_text().startswith("# Calibration")
    assert "<html" in (folder / "r.html").read_text()


@pytest.mark.slow
def test_calibration_agrees_with_the_truth(folder, capsys):
    truth = json.loads((folder / "grid" / "truth.json").read_text())
    for row in truth["parameters"]:
        capsys.readouterr()
        assert run("at", folder / "cal.yaml", row["magnification"], "--json") == 0
        answer = json.loads(capsys.readouterr().out)
        sigma = max(answer["pixel_size_sigma_m"])
        # Three views at each of three magnifications tell neither how far the heights scatter nor how well the
        # scale comes back: that leaves most of a per cent.
        assert sigma < 1e-2 * answer["mean_pixel_size_m"]
        assert abs(answer["mean_pixel_size_m"] - 1 / row["m_px_per_m"]) < 3.0 * sigma
        assert answer["in_range"]
        assert np.shape(answer["P"]) == (3, 4)
        assert min(answer["projection_sigma_px"]) > 0


@pytest.mark.slow
def test_at_flags_extrapolation(folder, capsys):
    assert run("at", folder / "cal.yaml", 9000) == 0
    captured = capsys.readouterr()
    assert "nm per px" in captured.out
    assert "outside the calibrated range" in captured.err


@pytest.mark.slow
def test_evaluate_on_views_that_were_not_used(folder, capsys):
    other = folder / "other"
    assert run("simulate", other, "--views", 2, "--seed", 7, "--magnification", 1000) == 0
    assert run("evaluate", folder / "cal.yaml", other, "--json") == 0
    answer = json.loads(capsys.readouterr().out.split("\n", 1)[1])
    # Corner noise of the default detector is about 0.03 px.
    assert answer["views"] == 2
    assert answer["rms_px"] < 0.1
    # Its statistics are notes: what stands in them must not matter.
    edited = folder / "edited.yaml"
    text = yaml.safe_load((folder / "cal.yaml").read_text())
    for priors in (3, {"height_sigma_m": "low"}, {"height_sigma_m": -1.0}):
        text["statistics"] = {"priors": priors}
        edited.write_text(yaml.safe_dump(text))
        assert run("evaluate", edited, other, "--json") == 0
        assert json.loads(capsys.readouterr().out)["views"] == 2


@pytest.mark.slow
def test_rectify_pairs_every_image_with_a_camera_info(folder):
    out = folder / "zoom_rect"
    assert run("rectify", folder / "zoom", "--calibration", folder / "cal.yaml", "-o", out) == 0
    stamps: dict[str, list[int]] = {"/sem/image_rect": [], "/sem/camera_info": []}
    projections = []
    with open_bag(out) as bag:
        for message in bag.messages():
            if message.topic in stamps:
                stamps[message.topic].append(stamp_ns_from_msg(message.message))
            if message.topic == "/sem/projection":
                projections.append(np.array(message.message.data).reshape(3, 4))
    assert stamps["/sem/image_rect"] == stamps["/sem/camera_info"]
    assert len(set(stamps["/sem/image_rect"])) == 4
    # One projection for each of four magnifications, growing from 500x to 2000x.
    assert len(projections) == 4
    assert projections[-1][0, 0] / projections[0][0, 0] == pytest.approx(4.0, rel=0.02)


@pytest.mark.slow
def test_drift_follows_the_truth(folder):
    table = folder / "drift.csv"
    assert run("drift", folder / "gold", "--calibration", folder / "cal.yaml", "-o", table) == 0
    with table.open() as file:
        rows = list(csv.DictReader(file))
    truth = json.loads((folder / "gold" / "truth.json").read_text())["frames"]
    drift = np.array([f["drift_m"] for f in truth])
    found = np.array([[float(r["dx_m"]), float(r["dy_m"])] for r in rows])
    pixel = truth[0]["pixel_size_m"][0]
    # Sub-pixel registration of well textured frames: 0.01 px; a wrong sign would be ten times that.
    np.testing.assert_allclose(found, drift - drift[0], atol=0.02 * pixel)
    assert np.abs(drift[-1] - drift[0]).max() > 0.1 * pixel
    assert rows[0]["status"] == "keyframe"
    assert all(float(r["sigma_x_m"]) > 0 for r in rows[1:])


@pytest.mark.slow
def test_info_counts(folder, capsys):
    assert run("info", folder / "zoom") == 0
    out = capsys.readouterr().out
    assert "/sem/image_raw" in out
    assert "4 frames" in out
    assert "4 magnifications, 500 to 2000" in out
    assert "scale: recorded magnifications, display width 0.12 m" in out
    assert "interval: median" in out and "grey levels:" in out
    capsys.readouterr()
    assert run("info", folder / "zoom", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [s["frames"] for s in found["settings"]] == [1, 1, 1, 1]
    assert found["settings"][0]["pixel_size_m"] == pytest.approx(
        found["display_width_m"] / 500 / 512
    )


@pytest.mark.long
@pytest.mark.slow
def test_the_papers_method_runs(tmp_path):
    more = [x for g in (300, 800, 2000, 5000) for x in ("--magnification", g)]
    assert run("simulate", tmp_path / "grid", "--views", 3, "--size", 192, *more) == 0
    path = tmp_path / "cal.yaml"
    assert run("calibrate", tmp_path / "grid", "-o", path, "--method", "pda") == 0
    assert "method: pda" in path.read_text()


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(command, capsys):
    assert run(command, "--help") == 0
    out = capsys.readouterr().out
    assert "Example:" in out
    assert f"semcal {command}" in out


def test_help_lists_every_command(capsys):
    assert run("--help") == 0
    out = capsys.readouterr().out
    assert all(f"  {c} " in out for c in COMMANDS)


@pytest.mark.slow
def test_bad_input_is_one_line_and_status_2(folder, tmp_path, capsys):
    cal, out = folder / "cal.yaml", tmp_path / "out"
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "does not exist" in refused(
        capsys, "calibrate", tmp_path / "no", "-o", tmp_path / "c.yaml"
    )
    assert "expected" in refused(capsys, "info", empty)
    assert "magnification" in refused(capsys, "at", cal, "nan")
    assert "magnification" in refused(capsys, "at", cal, "--", "-3")
    assert "greater than 0" in refused(capsys, "at", cal, "0")
    assert "'abc' is not a valid float; see semcal at --help" in refused(capsys, "at", cal, "abc")
    assert "no such" in refused(capsys, "fly").lower()
    assert "1000,5000" in refused(
        capsys, "calibrate", folder / "grid", "-o", tmp_path / "c.yaml", "--breakpoints", "a,b"
    )
    assert "missing" in refused(capsys, "rectify", folder / "grid").lower()
    assert "not valid YAML" in refused(capsys, "at", _file(tmp_path / "a.yaml", "a: [1"), 100)
    assert "not a calibration" in refused(capsys, "at", _file(tmp_path / "b.yaml", "a: 1"), 100)
    newer = cal.read_text().replace("\nversion: 3\n", "\nversion: 999\n")
    assert "update" in refused(capsys, "at", _file(tmp_path / "n.yaml", newer), 100)
    assert "folder" in refused(
        capsys, "calibrate", folder / "grid", "-o", tmp_path / "x" / "c.yaml"
    )
    assert "config" in refused(capsys, "info", folder / "grid", "--config", "unknown_microscope")
    assert "grid" in refused(capsys, "calibrate", folder / "gold", "-o", tmp_path / "c.yaml")
    truncated = tmp_path / "t.mcap"
    data = next((folder / "grid").glob("*.mcap")).read_bytes()
    truncated.write_bytes(data[: len(data) // 2])
    refused(capsys, "rectify", truncated, "--calibration", cal, "-o", out)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "a.yaml",
        "b.yaml",
        "empty",
        "n.yaml",
        "t.mcap",
    ]


def _file(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.slow
def test_an_existing_output_is_not_touched(folder, tmp_path, capsys):
    before = sorted((p.name, p.stat().st_size) for p in (folder / "zoom").iterdir())
    line = refused(
        capsys,
        "rectify",
        folder / "gold",
        "--calibration",
        folder / "cal.yaml",
        "-o",
        folder / "zoom",
    )
    assert "exists" in line
    assert sorted((p.name, p.stat().st_size) for p in (folder / "zoom").iterdir()) == before


@pytest.mark.slow
def test_the_module_is_the_command(folder):
    done = subprocess.run(
        [sys.executable, "-m", "semcal_ros", "at", str(folder / "cal.yaml"), "1e3"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "nm per px" in done.stdout
    assert done.stderr == ""


@pytest.mark.slow
@pytest.mark.long
def test_the_snippets_of_the_page_on_python_run(folder, tmp_path):
    """One after the other, on the recordings of this module."""
    page = Path(__file__).resolve().parents[2] / "doc" / "python.md"
    snippets = re.findall(
        r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL
    )
    assert len(snippets) == 8
    for name in ("grid", "gold", "cal.yaml"):
        (tmp_path / name).symlink_to(folder / name)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join(snippets)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(page.parents[1])},
        capture_output=True,
        text=True,
        check=False,
        timeout=170,
    )
    assert done.returncode == 0, done.stderr
    assert "Calibration(joint, 300x to 3000x, 512 x 512 px, 9 views, RMS " in done.stdout
    assert {"calibration.png", "drift.csv", "gold_rect", "gold.tif"} <= {
        path.name for path in tmp_path.iterdir()
    }


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--height-sigma", "10 furlongs"), "is not a length such as 10um"),
        (("--height-sigma", "-1um"), "'-1um' is not 0 or above"),
        (("--squares-sigma", "0.5"), "0.5 is not in the range"),
        (("--untilted", "99"), "untilted '99'; expected numbers or file names of frames"),
    ],
)
def test_what_a_calibration_knows_beforehand_is_checked(folder, tmp_path, capsys, options, reason):
    command = ("calibrate", folder / "grid", "-o", tmp_path / "cal.yaml", *options)
    assert reason in refused(capsys, *command)
    assert not (tmp_path / "cal.yaml").exists()


def test_units_far_off_give_status_1_one_line_and_no_file(folder, tmp_path, capsys):
    written = tmp_path / "cal.yaml", tmp_path / "cal.html"
    outputs = ("-o", written[0], "--report", written[1])
    assert run("calibrate", folder / "grid", *outputs, "--display-width", "60m") == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert "a display width of 60m and squares of" in line
    assert not any(path.exists() for path in written)


@pytest.mark.slow
def test_what_is_known_beforehand_reaches_the_file(folder, tmp_path):
    """By each magnification for itself, which is quick."""
    known = ("--height-sigma", "25um", "--squares-sigma", "0.002", "--untilted", "none")
    command = ("calibrate", folder / "grid", "-o", tmp_path / "cal.yaml", "--method", "discrete")
    assert run(*command, *known) == 0
    saved = yaml.safe_load((tmp_path / "cal.yaml").read_text())
    assert saved["method"] == "discrete"
    assert saved["scale_sigma"]["height_m"] == 25e-6
    assert saved["scale_sigma"]["grid"] == 0.002


@pytest.mark.slow
def test_evaluate_says_how_far_nm_per_pixel_is_off(folder, tmp_path, capsys):
    other = tmp_path / "other"
    assert run("simulate", other, "--views", 2, "--seed", 7, "--magnification", 1000) == 0
    calibration = Calibration.load(folder / "cal.yaml")
    wide = {**calibration.functions}
    wide["scale"] = replace(wide["scale"], coefficients=wide["scale"].coefficients / 1.02)
    wrong = tmp_path / "wrong.yaml"
    Calibration.from_model(replace(calibration, functions=wide)).save(wrong)
    errors = {}
    for name, path in (("right", folder / "cal.yaml"), ("wrong", wrong)):
        capsys.readouterr()
        assert run("evaluate", path, other, "--json") == 0
        (row,) = json.loads(capsys.readouterr().out)["by_magnification"]
        errors[name] = row
        assert 0.0 < row["scale_sigma"] < 0.015
    assert abs(errors["right"]["scale_error"]) < 3.0 * errors["right"]["scale_sigma"]
    difference = errors["wrong"]["scale_error"] - errors["right"]["scale_error"]
    assert difference == pytest.approx(0.02, abs=0.002)
    # The reprojection error hardly sees it.
    assert errors["wrong"]["rms_px"] < 1.5 * errors["right"]["rms_px"]
    # Squares that are 2 % larger than the images' say the same.
    capsys.readouterr()
    larger = "25.5um,10.2um,5.1um,2.04um,1.02um"
    assert run("evaluate", folder / "cal.yaml", other, "--squares", larger, "--json") == 0
    (row,) = json.loads(capsys.readouterr().out)["by_magnification"]
    assert row["scale_error"] - errors["right"]["scale_error"] == pytest.approx(-0.02, abs=0.002)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--stage", "three-axis"), "three-axis"),
        (("--eucentric-error", "wide"), "'wide' is not a length such as 10um"),
        (("--eucentric-error", "-10um"), "'-10um' is not 0 or above"),
        (("--eucentric-error", "2cm"), "'2cm' is not a length such as 10um"),
        (("--eucentric-error", "20mm"), "misses the specimen by 20000 and 0 um"),
        (
            ("--stage", "two-axis", "--eucentric-error", "10um"),
            "a eucentric error of 10 um of a two-axis stage",
        ),
        (("--repeatability", "good"), "'good' is not a ratio such as 0.1%"),
        (("--repeatability", "15%"), "a repeatability of 15 %; expected 0 to 5 %"),
        (("--grid-stretch", "0.2"), "a grid with stretch 0.2"),
        (("--grid-bow", "1mm"), "a radius of 1 mm; expected at least 5 mm"),
        (("--grid-squares", "-1%"), "no negative spread"),
        (("--line-jitter", "9"), "a line jitter of 9 px; expected 0 to 4 px"),
    ],
)
def test_a_stage_or_a_grid_that_does_not_exist_is_refused(tmp_path, capsys, options, reason):
    command = ("simulate", tmp_path / "grid", "--size", 32, "--magnification", 1000)
    assert reason in refused(capsys, *command, *options)
    assert not (tmp_path / "grid").exists()


def test_the_defaults_of_the_options_are_those_of_python(tmp_path):
    assert run("simulate", tmp_path / "a", "--size", 32, "--magnification", 900, "--views", 1) == 0
    simulate(tmp_path / "b", magnifications=(900.0,), views=1, size=32)
    first, other = (json.loads((tmp_path / n / "truth.json").read_text()) for n in "ab")
    assert first == other


def test_options_of_stage_and_grid_reach_the_recording(tmp_path):
    stage = ("--eucentric-error", "0.3mm", "--repeatability", "0.4%", "--line-jitter", 0.2)
    grid = ("--grid-stretch", "0.1%", "--grid-shear", "-0.0005", "--grid-bow", "50mm")
    rest = ("--grid-wave", "1%", "--grid-squares", "0%", "--magnification", 900, "--views", 1)
    assert run("simulate", tmp_path / "a", "--size", 32, *stage, *grid, *rest) == 0
    truth = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert truth["stage"]["miss_m"] == [3e-4, 0.0]
    assert truth["stage"]["repeatability"] == 4e-3
    assert truth["stage"]["line_jitter_px"] == 0.2
    found = [truth["grid"][key] for key in ("stretch", "shear", "curvature_per_m", "wave")]
    assert found == pytest.approx([1e-3, -5e-4, 20.0, 1e-2])
    assert {row["error"] for row in truth["grid"]["square_errors"]} == {0.0}
    assert run("simulate", tmp_path / "b", "--size", 32, "--grid-bow", 0, *rest) == 0
    assert json.loads((tmp_path / "b" / "truth.json").read_text())["grid"]["curvature_per_m"] == 0.0
