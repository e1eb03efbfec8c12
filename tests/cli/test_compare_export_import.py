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

"""``semcal compare``, ``export`` and ``import-calibration``, and what works with an imported calibration."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter, map_coordinates

from semcal_ros import Calibration
from semcal_ros.workflows.export_camera import EXPORT_FORMATS
from tests.helpers.node_scenes import make_calibration, write_recording
from tests.helpers.semcal_runs import refused, run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration, one with 1 % more px per m, and one of a range that the others do not cover."""
    place = tmp_path_factory.mktemp("life")
    made = make_calibration()
    made.save(place / "cal.yaml")
    scale = made.functions["scale"]
    wider = replace(scale, coefficients=scale.coefficients + [0.01, 0.0])
    other = replace(made, functions={**made.functions, "scale": wider})
    Calibration.from_model(other).save(place / "other.yaml")
    moved = {name: replace(f, g_range=(20e3, 80e3)) for name, f in made.functions.items()}
    far = replace(made, functions=moved, magnifications=(20e3, 80e3))
    Calibration.from_model(far).save(place / "far.yaml")
    (place / "sizes.csv").write_text("magnification,nm per px\n500,2500\n5000,248\n")
    return place


# -- compare -------------------------------------------------------------------------------------------


def test_calibrations_that_agree(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("compare", folder / "cal.yaml", folder / "cal.yaml") == 0
    assert capsys.readouterr().out.startswith("the calibrations agree from 500x to 8000x")
    assert run("compare", folder / "cal.yaml", folder / "cal.yaml", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["agree"] and said["largest_sigmas"] == pytest.approx(0.0, abs=1e-6)


def test_calibrations_that_differ(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, figure = folder / "difference.csv", folder / "difference.png"
    command = ("compare", folder / "cal.yaml", folder / "other.yaml", "--magnification", 2000)
    with pytest.raises(SystemExit) as ended:
        run(*command, "--table", table, "--figure", figure)
    assert ended.value.code == 1
    assert "DIFFER" in capsys.readouterr().out
    assert table.read_text().startswith("magnification,nm_per_px,")
    assert figure.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit) as ended:
        run(*command, "--json")
    said = json.loads(capsys.readouterr().out)
    assert ended.value.code == 1 and not said["agree"]
    (row,) = said["at"]
    # 1.01 to 1.02 px per m more: nm per px are 1 % less, to the next order.
    assert row["magnification"] == 2000.0
    assert abs(row["difference_percent"]) == pytest.approx(1.0, abs=0.02)
    assert row["difference_percent"] * row["nm_per_px"] == pytest.approx(
        100.0 * row["difference_nm_per_px"]
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("cal.yaml", "missing.yaml"), "missing.yaml"),
        (("cal.yaml", "sizes.csv"), "sizes.csv"),
        (("cal.yaml", "far.yaml"), "20000"),
        (("cal.yaml", "other.yaml", "--table", "t.txt"), "--table t.txt"),
        (("cal.yaml", "other.yaml", "--figure", "f.csv"), "--figure f.csv"),
        (("cal.yaml", "other.yaml", "--magnification", "-5"), "-5"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.chdir(folder)
    assert words in refused(capsys, "compare", *arguments)


# -- export --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rectified", [False, True])
@pytest.mark.parametrize("kind", EXPORT_FORMATS)
def test_every_format_is_written(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, rectified: bool
) -> None:
    path = tmp_path / f"out{EXPORT_FORMATS[kind][0]}"
    at = () if kind == "csv" else ("--magnification", 2000)
    if kind == "csv" and rectified:
        assert "rectified" in refused(
            capsys, "export", folder / "cal.yaml", "--format", kind, "--rectified", "-o", path
        )
        return
    options = ("--rectified",) * rectified
    command = ("export", folder / "cal.yaml", "--format", kind, *at, *options, "-o", path)
    assert run(*command) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith(f"{kind}: {path}\n") and path.stat().st_size > 100
    # Those that hold a polynomial only say by how much they differ of raw images, 0.3 px here.
    lossy = kind not in ("fiji", "csv") and not rectified
    assert ("--rectified is exact" in captured.err) == lossy
    if lossy:
        path.unlink()
        line = refused(capsys, *command, "--lossy", "0.1")
        assert "0.1 px or better" in line and "(--lossy 0." in line
        assert not path.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("cal.yaml", "--format", "ros", "-o", "a.yaml"), "--magnification"),
        (("cal.yaml", "--format", "ros", "--magnification", "500", "-o", "a.txt"), ".yaml, .yml"),
        (("sizes.csv", "--format", "ros", "--magnification", "500", "-o", "a.yaml"), "sizes.csv"),
        (("cal.yaml", "--format", "ros", "--magnification", "0", "-o", "a.yaml"), "0"),
        (("cal.yaml", "--format", "ros", "--magnification", "500", "-o", "no/a.yaml"), "no"),
        (("cal.yaml", "--format", "csv", "-o", "no/a.csv"), "no"),
    ],
)
def test_what_cannot_be_exported_is_refused(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.chdir(folder)
    assert words in refused(capsys, "export", *arguments)


# -- import-calibration, and what it is for ------------------------------------------------------------


@pytest.fixture(scope="module")
def nominal(folder: Path) -> Path:
    path = folder / "nominal.yaml"
    size = ("--image-size", "96x96", "--sigma", "2%")
    assert run("import-calibration", folder / "sizes.csv", *size, "-o", path) == 0
    return path


def test_a_table_becomes_a_calibration(nominal: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("at", nominal, 5000, "--json") == 0
    camera = Calibration.load(nominal).at(5000.0)
    assert camera.pixel_size_m[0] == pytest.approx(248e-9)
    assert camera.pixel_size_sigma_m[0] == pytest.approx(0.02 * 248e-9, rel=1e-6)
    assert json.loads(capsys.readouterr().out)["magnification"] == 5000.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("missing.csv", "--image-size", "96x96", "-o", "n.yaml"), "missing.csv"),
        (("cal.yaml", "--image-size", "96x96", "-o", "n.yaml"), "cal.yaml"),
        (("sizes.csv", "--image-size", "96x96", "-o", "no/n.yaml"), "no folder"),
        (("sizes.csv", "--image-size", "96x96", "--sigma", "-1%", "-o", "n.yaml"), "sigma"),
    ],
)
def test_what_cannot_be_imported_is_refused(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.chdir(folder)
    assert words in refused(capsys, "import-calibration", *arguments)
    assert not (folder / "n.yaml").exists()


def test_rectify_uses_an_imported_calibration(nominal: Path, tmp_path: Path) -> None:
    write_recording(tmp_path / "bag", [2000.0, 2000.0])
    out = tmp_path / "flat.tif"
    assert run("rectify", tmp_path / "bag", "--calibration", nominal, "-o", out) == 0
    with tifffile.TiffFile(out) as file:
        assert file.pages[0].shape == (96, 96)
        description = file.ome_metadata
    size = Calibration.load(nominal).at(2000.0).pixel_size_m[0]
    assert description is not None and "PhysicalSizeX=" in description
    said = float(description.split('PhysicalSizeX="')[1].split('"')[0])
    unit = (
        description.split('PhysicalSizeXUnit="')[1].split('"')[0]
        if "XUnit" in description
        else "um"
    )
    assert said * {"nm": 1e-9}.get(unit, 1e-6) == pytest.approx(size, rel=1e-6)


def test_heights_use_an_imported_calibration(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The pair differs by a tilt about x: rows are y cos t + h sin t."""
    rng, side, tilt = np.random.default_rng(5), 240, np.radians(8.0)
    texture = sum(
        f / f.std() for f in (gaussian_filter(rng.normal(size=(side, side)), s) for s in (1.2, 3.0))
    )
    height = gaussian_filter(rng.normal(size=(side, side)), 25.0)
    height *= 8.0 / height.std()
    rows, columns = np.indices((side, side), dtype=float)
    middle = 0.5 * (side - 1)
    at = (rows - middle - height * np.sin(tilt)) / np.cos(tilt) + middle
    tilted = map_coordinates(texture, [at, columns], order=3, mode="nearest")
    for name, picture in (("a.png", texture), ("b.png", tilted)):
        grey = 120.0 + 30.0 * picture + rng.normal(0.0, 2.0, picture.shape)
        cv2.imwrite(str(tmp_path / name), np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    cal = tmp_path / "nominal.yaml"
    size = ("--image-size", f"{side}x{side}", "--sigma", "2%")
    assert run("import-calibration", folder / "sizes.csv", *size, "-o", cal) == 0
    capsys.readouterr()
    pictures = (tmp_path / "a.png", tmp_path / "b.png", "--magnification", 5000)
    tilts = ("--tilts", "0deg,8deg", "--tilt-axis", "0deg", "--json")
    output = ("-o", tmp_path / "heights.tif")
    assert run("reconstruct", *pictures, *tilts, "--calibration", cal, *output) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["pixel_size_m"] == pytest.approx(248e-9)
    assert said["pixel_size_sigma_m"] == pytest.approx(0.02 * 248e-9, rel=1e-6)
    # 8 px RMS; the border of the picture, where rows have no partner, is missing.
    assert said["rms_m"] == pytest.approx(8.0 * 248e-9, rel=0.15)
