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

"""``semcal measure cantilever`` on small recordings of a bending cantilever."""

from __future__ import annotations

import csv
import struct
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.files.bags.writer import write_simulated
from semcal_ros.synthetic import Drift, preset
from semcal_ros.synthetic.specimens.cantilever import CantileverPlan, cantilever_plan
from tests.helpers.semcal_runs import refused, run

SIZE = 256
SCOPE = preset("ideal").with_image_size(SIZE, SIZE)
PLAN = cantilever_plan(
    SCOPE,
    pushes=(0.0, 1.0),
    magnifications=(6450.0, 8890.0),
    view="end",
    drift=Drift(velocity_m_s=(8e-9, -5e-9)),
    seed=7,
)
LENGTH = ("--length", 35e-6)


def recorded(
    path: Path, plan: CantileverPlan, images: dict[int, np.ndarray], frames: Iterable[int]
):
    """A bag of some frames of a plan."""
    chosen = list(frames)
    write_simulated(
        path, [plan.frames[k] for k in chosen], [images[k] for k in chosen], plan.truth()
    )
    return path


@pytest.fixture(scope="module")
def images() -> dict[int, np.ndarray]:
    return {k: PLAN.render(k) for k in range(len(PLAN))}


@pytest.fixture(scope="module")
def bag(tmp_path_factory, images) -> Path:
    return recorded(tmp_path_factory.mktemp("bending") / "all", PLAN, images, range(len(PLAN)))


@pytest.fixture(scope="module")
def calibration(tmp_path_factory) -> Path:
    """The true camera of the microscope, its scale known to 0.1 %."""
    camera = SCOPE.camera_at(7000.0)
    values = {name: getattr(camera, name) for name in ("aspect", "skew", "px", "py", "rho")}
    values |= {"scale": 1.0, "xi_r": 0.0, "xi_t": 0.0, "ex": camera.ex, "ey": camera.ey}
    functions = {
        name: ContinuousFunction("chebyshev_log", np.array([value]), (1000.0, 10000.0))
        for name, value in values.items()
    }
    model = Calibration(
        functions=functions,
        covariance=1e-6 * np.eye(len(functions)),
        image_width=SIZE,
        image_height=SIZE,
        display_width_m=SCOPE.display_width_m,
        magnifications=(1000.0, 10000.0),
        method="joint",
    )
    path = tmp_path_factory.mktemp("cal") / "cal.yaml"
    model.save(path)
    return path


@pytest.mark.slow
def test_an_imported_calibration_measures_the_same(bag, calibration, tmp_path):
    """Pixel sizes alone are enough where nothing is distorted; their sigma is that of the table."""
    sizes, nominal = tmp_path / "sizes.csv", tmp_path / "nominal.yaml"
    rows = [f"{g},{1e9 * SCOPE.camera_at(g).pixel_size_m[0]!r}" for g in (6450.0, 8890.0)]
    sizes.write_text("\n".join(["magnification,nm per px", *rows]) + "\n")
    size = ("--image-size", f"{SIZE}x{SIZE}", "--sigma", "1%")
    assert run("import-calibration", sizes, *size, "-o", nominal) == 0
    found = []
    for cal in (calibration, nominal):
        command = ("measure", "cantilever", bag, "--calibration", cal, *LENGTH)
        assert run(*command, "-o", tmp_path / "d.csv", "--config", "virtual_sem") == 0
        found.append(rows_of(tmp_path / "d.csv"))
    for exact, imported in zip(*found, strict=True):
        name = "deflection_m"
        assert float(imported[name]) == pytest.approx(float(exact[name]), rel=1e-3, abs=1e-10)
    bent = [row for row in found[1] if int(row["pose"]) == 2]
    assert all(float(r["sigma_m"]) >= 0.009 * abs(float(r["deflection_m"])) for r in bent)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_deflections_with_all_outputs(bag, calibration, tmp_path, capsys):
    table, plot, strip, video = (tmp_path / n for n in ("d.csv", "d.png", "s.png", "v.avi"))
    command = ("measure", "cantilever", bag, "--calibration", calibration, *LENGTH)
    outputs = ("-o", table, "--plot", plot, "--strip", strip, "--video", video, "--fps", 5)
    assert run(*command, *outputs, "--config", "virtual_sem") == 0
    captured = capsys.readouterr()
    assert "spread between magnifications (RMS, without pose 1): " in captured.out
    assert "6450x: the base is out of view" in captured.err
    rows = rows_of(table)
    assert [(float(r["magnification"]), int(r["pose"])) for r in rows] == [
        (6450.0, 1),
        (6450.0, 2),
        (8890.0, 1),
        (8890.0, 2),
    ]
    for row in rows[1::2]:
        value, sigma = float(row["deflection_m"]), float(row["sigma_m"])
        assert abs(value - 250e-9) < 4.0 * sigma
        # 0.1 % of 250 nm are always in it.
        assert 0.25e-9 < sigma < 8e-9
        assert row["deflection_by_length_m"] == "nan"
        assert row["drift_status"] == "tracked"
    for file in (plot, strip):
        assert cv2.imread(str(file)).std() > 5
    film = cv2.VideoCapture(str(video))
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) == 4


def write_tescan(path: Path, image: np.ndarray, pixel_m: float, time_s: float) -> None:
    """A file as TESCAN's microscopes write it, with a data bar of 20 rows and times in whole seconds."""
    minutes, seconds = divmod(int(time_s), 60)
    text = f"Date=2020-01-02\nTime=10:{minutes:02d}:{seconds:02d}\nImageStripSize=20\n"
    text += f"PixelSizeX={pixel_m!r}\nPixelSizeY={pixel_m!r}\n"
    data = struct.pack("<IH", len(text) + 2, 2) + text.encode()
    bar = np.zeros((20, image.shape[1]), image.dtype)
    tags = [(50431, 7, len(data), data, True)]
    tifffile.imwrite(path, np.concatenate([image, bar]), extratags=tags)


@pytest.mark.parametrize("bits", [8, 16])
def test_a_folder_of_tiffs(bits, images, calibration, tmp_path, capsys):
    """16 bits carry the same counts of electrons on a finer scale."""
    folder = tmp_path / "tiffs"
    folder.mkdir()
    for k, frame in enumerate(PLAN.frames):
        image = images[k] if bits == 8 else (images[k].astype(np.uint16) + 3) * 200
        pixel_m = SCOPE.nominal_pixel_size_m(frame.magnification)
        write_tescan(folder / f"bending_{k}.tif", image, pixel_m, frame.start_time_s)
    (folder / "notes.txt").write_text("pushed in the second pose")
    table = tmp_path / "d.csv"
    command = ("measure", "cantilever", folder, "--calibration", calibration, *LENGTH)
    assert run(*command, "--config", "virtual_sem", "-o", table) == 0
    assert "local times taken as UTC" in capsys.readouterr().err
    rows = rows_of(table)
    assert [int(r["pose"]) for r in rows] == [1, 2, 1, 2]
    assert {r["recording"] for r in rows} == {"tiffs"}
    for row, g in zip(rows[1::2], (6450.0, 8890.0), strict=True):
        # The magnification comes from the pixel size and the configuration's display width.
        assert float(row["magnification"]) == pytest.approx(g, rel=1e-9)
        assert abs(float(row["deflection_m"]) - 250e-9) < 4.0 * float(row["sigma_m"])
        assert float(row["sigma_m"]) < 8e-9
        assert row["drift_status"] == "tracked"


def test_a_single_frame_is_refused_in_one_line(images, calibration, tmp_path, capsys):
    one = recorded(tmp_path / "one", PLAN, images, (0,))
    command = ("measure", "cantilever", one, "--calibration", calibration, *LENGTH)
    line = refused(capsys, *command, "--config", "virtual_sem", "-o", tmp_path / "d.csv")
    assert "one: 1 frame at 6450x; expected 2 frames or more" in line


def test_recordings_of_their_own_and_clicks(bag, images, calibration, tmp_path, capsys):
    """One recording per magnification, the larger one first; base and tip given for each."""
    large = recorded(tmp_path / "large", PLAN, images, (1, 3))
    small = recorded(tmp_path / "small", PLAN, images, (0, 2))
    ends = []
    for index in (1, 0):
        truth = PLAN.truth()["frames"][index]
        base, tip = (",".join(f"{v:.1f}" for v in truth[k]) for k in ("base_px", "end_px"))
        ends += ["--base", base, "--tip", tip]
    command = ("measure", "cantilever", large, small, "--calibration", calibration, *LENGTH, *ends)
    shape = ("--shape", "beam", "--poses", 2, "--config", "virtual_sem")
    assert run(*command, *shape, "-o", tmp_path / "d.csv") == 0
    rows = rows_of(tmp_path / "d.csv")
    assert [r["recording"] for r in rows] == ["large", "large", "small", "small"]
    assert [float(r["magnification"]) for r in rows] == [8890.0, 8890.0, 6450.0, 6450.0]
    for row in rows[1::2]:
        # A beam that is loaded at 95 % of its length is no beam that is loaded at its end: 1 nm.
        assert abs(float(row["deflection_m"]) - 250e-9) < 4.0 * float(row["sigma_m"]) + 1e-9


def test_what_is_refused(bag, calibration, tmp_path, capsys):
    command = ("measure", "cantilever", bag, "--calibration", calibration, *LENGTH)
    output = ("-o", tmp_path / "d.csv")
    assert "for 3 poses" in refused(capsys, *command, *output, "--poses", 3)
    assert "not a pair of pixel" in refused(capsys, *command, *output, "--base", "12")
    assert "give neither" in refused(capsys, *command, *output, "--base", "12,30")
    assert "ends in .csv" in refused(capsys, *command, "-o", tmp_path / "d.txt")
    twice = refused(
        capsys, *command, *output, "--plot", tmp_path / "p.png", "--strip", tmp_path / "p.png"
    )
    assert "another output" in twice
    assert "--length" in refused(capsys, *command[:-2], *output)
    assert not (tmp_path / "d.csv").exists()


def test_a_recording_without_a_cantilever(calibration, tmp_path, capsys):
    blank = dict.fromkeys((0, 2), np.full((SIZE, SIZE), 90, np.uint8))
    bag = recorded(tmp_path / "blank", PLAN, blank, (0, 2))
    command = ("measure", "cantilever", bag, "--calibration", calibration, *LENGTH)
    assert "no strip in the image" in refused(capsys, *command, "-o", tmp_path / "d.csv")
