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

"""``semcal extend``, and ``semcal plan --extend``, on recordings of the virtual microscope."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from semcal_ros import Calibration, extend
from semcal_ros.config.config import load_config
from semcal_ros.core.errors import CalibrationError
from semcal_ros.files.recordings import open_recording
from semcal_ros.synthetic import preset
from semcal_ros.workflows.calibrate_specimen import calibrate_specimen
from tests.helpers.calibrations import calibrated
from tests.helpers.node_scenes import make_calibration
from tests.helpers.semcal_runs import refused, run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration up to 10 000x with 512 px, and a ladder of 256 px up to 18 000x."""
    place = tmp_path_factory.mktemp("extend")
    Calibration.from_model(calibrated("jsm820").model).save(place / "cal.yaml")
    ladder = ("--magnification", 8000, "--magnification", 18000, "--views", 4)
    made = ("simulate", place / "ladder", "--plan", "ladder", "--size", 256, *ladder)
    assert run(*made, "--repeatability", "0.05%") == 0
    return place


@pytest.mark.long
def test_extend_writes_a_calibration_that_reaches_farther(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = folder / "new.yaml"
    assert run("extend", folder / "cal.yaml", folder / "ladder", "-o", new) == 0
    out = capsys.readouterr().out
    assert "range: 100x to 18000x, of which 100x to 10000x by the grid" in out
    assert out.splitlines()[-1] == f"calibration: {new}"
    found, truth = Calibration.load(new), preset("jsm820")
    for g in (11000.0, 14500.0, 17000.0):
        camera = found.at(g)
        assert camera.in_range
        wanted = truth.with_image_size(512, 512).camera_at(g)
        errors = np.subtract(camera.pixel_size_m, wanted.pixel_size_m)
        assert np.all(np.abs(errors) < 3.0 * np.array(camera.pixel_size_sigma_m))
        assert max(camera.pixel_size_sigma_m) < 4e-3 * camera.pixel_size_m[0]
    assert not found.at(19000.0).in_range
    # Programs that ask for a magnification get it as everywhere.
    assert run("at", new, 15000, "--budget") == 0
    assert "steps of the ladder beyond the grid" in capsys.readouterr().out
    assert run("info", new) == 0
    assert "origin" in (out := capsys.readouterr().out)
    assert "100x to 10000x a grid, the rest a specimen" in out
    assert run("extend", folder / "cal.yaml", folder / "ladder", "-o", new, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["grid_range"] == [100.0, 10000.0]
    assert [step["pictures"] for step in said["steps"]] == [4, 4, 4]


@pytest.mark.long
def test_a_rotation_that_nobody_says_is_found(folder: Path) -> None:
    pictures = []
    with open_recording(folder / "ladder", load_config("generic")) as recording:
        for frame in recording.frames():
            # Two magnifications are enough, one of them beyond the grid.
            if frame.magnification > 9000.0:
                continue
            pictures.append((frame.image, frame.magnification))
        count = len(pictures)
        pictures += [
            (frame.image, frame.magnification)
            for frame in recording.frames()
            if 9000.0 < frame.magnification < 13000.0
        ]
    assert len(pictures) == 2 * count == 8
    done = extend(folder / "cal.yaml", pictures)
    assert [step.turned for step in done.result.steps] == [1, 1]


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A calibration of 500x to 8000x, of images of 96 px."""
    make_calibration().save(tmp_path / "cal.yaml")
    return tmp_path


def test_what_cannot_be_extended_is_refused_in_a_line(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = ("simulate", small / "steps", "--plan", "steps", "--frames", 1, "--specimen", "gold")
    gap = ("--magnification", 7000, "--magnification", 14000, "--size", 96)
    assert run(*made, *gap) == 0
    capsys.readouterr()
    said = refused(capsys, "extend", small / "cal.yaml", small / "steps", "-o", small / "n.yaml")
    assert "a gap in the ladder from 7000x to 14000x" in said
    assert not (small / "n.yaml").exists()


def test_plan_lists_a_ladder(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("plan", small / "cal.yaml", "--extend", "100000x") == 0
    out = capsys.readouterr().out
    assert "100000" in out and "+90 deg" in out
    assert run("plan", small / "cal.yaml", "--extend", "100000x", "--json") == 0
    steps = json.loads(capsys.readouterr().out)
    assert steps[-1]["magnification"] == 100000.0
    for wrong in ((), ("--extend", "3000x", "--target", "0.1%")):
        assert "expected one of the two" in refused(capsys, "plan", small / "cal.yaml", *wrong)
    assert "magnification such as" in refused(capsys, "plan", small / "cal.yaml", "--extend", "k")


def test_without_a_grid_one_size_is_known(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = ("simulate", small / "steps", "--plan", "steps", "--frames", 1, "--specimen", "gold")
    assert run(*made, "--magnification", 7000, "--magnification", 10000, "--size", 96) == 0
    capsys.readouterr()
    common = ("calibrate", small / "steps", "-o", small / "n.yaml", "--specimen")
    for wrong, said in (
        ((), "without a known size"),
        (("--pixel-size", "9nm@7000", "--length", "1um@0,1,1,60,60"), "two known sizes"),
        (("--pixel-size", "9nm@7000", "--stage-scale", "1%"), "two known sizes"),
        (("--stage-scale", "x"), "not a ratio such as"),
        (("--pixel-size", "9nm@x"), "not a pixel size such as"),
        (("--length", "1um@0,1,1"), "not a length such as"),
        (("--pixel-size", "9nm@7000", "--method", "pda"), "--method with --specimen"),
        (("--pixel-size", "9nm@7000", "--untilted", "all"), "--untilted"),
        (("--pixel-size", "9nm@7000"), "pictures at 2 magnifications"),
    ):
        assert said in refused(capsys, *common, *wrong)
    plain = ("drift", small / "steps", "-o", small / "d.csv")
    assert "only calibrate --specimen" in refused(capsys, *plain, "--pixel-size", "9nm@7000")
    assert "--stage-scale without --specimen" in refused(capsys, *common[:4], "--stage-scale", "1%")
    assert "--length without --specimen" in refused(
        capsys, *common[:4], "--length", "1um@0,1,1,60,60"
    )


@pytest.mark.long
def test_without_a_grid_the_moves_of_the_stage_are_the_metre(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gold, new = tmp_path / "gold", tmp_path / "cal.yaml"
    size = ("--views", 4, "--magnification", 3000, "--magnification", 6500, "--size", 256)
    assert run("simulate", gold, "--plan", "ladder", *size) == 0
    capsys.readouterr()
    common = ("calibrate", gold, "-o", new, "--specimen", "--config", "virtual_sem")
    assert run(*common, "--stage-scale", "0.5%") == 0
    out = capsys.readouterr()
    assert "whose 1-sigma of 0.5" in out.err
    found, truth = Calibration.load(new), preset("jsm820").with_image_size(256, 256)
    for g in (3000.0, 4000.0, 6000.0):
        camera, wanted = found.at(g), truth.camera_at(g)
        ratio = np.divide(camera.pixel_size_m, wanted.pixel_size_m)
        # The stage of the virtual microscope is exact; a magnification comes back to 0.15 %.
        np.testing.assert_allclose(ratio, 1.0, atol=4e-3)
        stated = camera.pixel_size_sigma_m[0] / camera.pixel_size_m[0]
        assert 0.005 < stated < 0.01
    # Moved by the beam, or without positions, the pictures tell no metre.
    with open_recording(gold, load_config("virtual_sem")) as recording:
        pictures = [(frame.image, frame.magnification) for frame in recording.frames()]
    with pytest.raises(CalibrationError, match="moves of the stage that tell no length"):
        calibrate_specimen(pictures, stage_scale=0.005)
