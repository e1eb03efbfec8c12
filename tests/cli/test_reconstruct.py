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

"""``semcal reconstruct`` on a small recording of the virtual ball, with a calibration of the grid."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from semcal_ros.applications.reconstruction import Roundness, SurfaceMesh
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.bags.writer import write_simulated
from semcal_ros.files.meshes import encode_mesh, save_cloud, save_mesh
from semcal_ros.synthetic import Detector
from semcal_ros.synthetic.drift import drift_preset
from semcal_ros.synthetic.specimens.ball import Turning, ball_microscope, ball_plan
from semcal_ros.workflows.reconstruct import describe_departure
from tests.helpers.made_once import folder_once
from tests.helpers.semcal_runs import run


@pytest.fixture(scope="module")
def folder():
    """A calibration from the grid, and 26 frames of the ball."""
    return folder_once("reconstruct", _record_and_calibrate)


def _record_and_calibrate(base):
    grid = [x for g in (9000, 9500, 10000) for x in ("--magnification", g)]
    assert run("simulate", base / "grid", "--views", 3, *grid) == 0
    assert run("calibrate", base / "grid", "-o", base / "cal.yaml") == 0
    (base / "strips.yaml").write_text(
        "name: strips\ndisplay_width_m: 0.12\n"
        "magnification: {topic: magnification, quantity: magnification}\n"
        "scan: {frame_time_s: 0.1, averages: 1, flyback_fraction: 0.1}\n"
    )
    plan = ball_plan(
        ball_microscope(height=256),
        frames=26,
        interval_s=4.0,
        magnifications=(9000.0, 9500.0, 10000.0),
        motion=Turning(104.0, rolls=1.0, yaws=1.0, roll_rad=np.radians(30.0)),
        drift=drift_preset("slow"),
        # Less noise than a fast scan has, as there are few frames.
        detector=Detector(electrons=400.0),
    )
    write_simulated(base / "ball", plan.frames, map(plan.render, range(len(plan))), plan.truth())


@pytest.mark.slow
@pytest.mark.long
def test_the_ball_comes_out(folder, capsys):
    capsys.readouterr()
    files = ("-o", folder / "ball.ply", "--cloud", folder / "c.ply", "--figure", folder / "b.png")
    options = ("--calibration", folder / "cal.yaml", "--config", folder / "strips.yaml")
    assert run("reconstruct", folder / "ball", *options, *files, "--spacing", 8, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    # 26 views of 8-bit frames: a few per cent of what 2000 frames have.
    assert result["diameter_m"] == pytest.approx(900e-9, rel=0.02)
    low, high = result["diameter_interval_m"]
    assert low < 900e-9 < high
    assert high - low < 0.06 * 900e-9
    assert result["is_ball"]
    # On a true ball, the most significant departure is what noise leaves: of many windows the largest.
    departure = result["departure"]
    assert abs(departure["height_m"]) < 5.0 * departure["height_sigma_m"]
    assert np.linalg.norm(departure["towards"]) == pytest.approx(1.0)
    assert not any("not a ball" in note for note in result["notes"])
    assert result["convexity"] > 0.8
    assert not result["watertight"]
    assert 0.1 < result["coverage"] < 0.6
    mesh = trimesh.load(folder / "ball.ply", process=False)
    assert (len(mesh.vertices), len(mesh.faces)) == (result["vertices"], result["faces"])
    size = np.linalg.norm(mesh.vertices - mesh.vertices.mean(axis=0), axis=1)
    assert 200.0 < np.median(size) < 450.0  # nm
    # Outwards: normals of faces point away from the middle of the ball, which lies behind (+z).
    assert np.mean(mesh.face_normals[:, 2]) < 0.0
    assert (folder / "b.png").read_bytes().startswith(b"\x89PNG")
    assert b"comment unit nm" in (folder / "c.ply").read_bytes()[:200]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("output", "reason"),
    [("ball.obj", "ball.obj"), ("missing/ball.ply", "no folder")],
)
def test_outputs_are_checked_before_any_work(folder, capsys, output, reason):
    options = ("--calibration", folder / "cal.yaml")
    assert run("reconstruct", folder / "ball", *options, "-o", folder / output) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert reason in line


@pytest.mark.slow
def test_a_specimen_that_does_not_turn_is_refused(folder, capsys):
    options = ("--calibration", folder / "cal.yaml", "-o", folder / "flat.ply")
    assert run("reconstruct", folder / "grid", *options) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (folder / "flat.ply").exists()


def test_a_departure_is_told_with_place_and_height():
    structure = SimpleNamespace(frames=np.array([3, 17]), adjustment=SimpleNamespace(reference=1))
    towards = np.array([0.0, 0.5, -np.sqrt(0.75)])
    found = Roundness(False, 2e-9, "bump", 45e-9, 2e-9, towards, 300)
    text = describe_departure(structure, SimpleNamespace(roundness=found))
    assert text.startswith("this is not a ball: a bump of 45.0 +- 2.0 nm lies 30 deg from")
    assert "towards 90 deg" in text
    assert "frame 17" in text
    dent = replace(found, height_m=-45e-9)
    assert "a dent of 45.0" in describe_departure(structure, SimpleNamespace(roundness=dent))
    other = replace(found, kind="ellipsoid")
    assert "ellipsoid by 45.0" in describe_departure(structure, SimpleNamespace(roundness=other))


def tetrahedron():
    vertices = 1e-7 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return SurfaceMesh(vertices, faces, np.tile([0.0, 0, 1], (4, 1)), np.full(4, 2e-9), 0)


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_mesh_files_come_back(tmp_path, suffix):
    path = tmp_path / f"mesh{suffix}"
    save_mesh(path, tetrahedron())
    back = trimesh.load(path)
    assert back.is_watertight
    assert back.volume == pytest.approx(100.0**3 / 6.0, rel=1e-5)  # nm^3, outwards
    assert list(tmp_path.iterdir()) == [path]


def test_a_cloud_says_its_unit_and_keeps_its_columns(tmp_path):
    points = 1e-6 * np.arange(12.0).reshape(4, 3)
    columns = {"sigma": np.arange(4.0), "on_ball": np.array([0.0, 1.0, 1.0, 0.0])}
    save_cloud(tmp_path / "a.ply", points, columns, unit="um")
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].decode().splitlines()
    assert "comment unit um" in header
    back = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_allclose(back.vertices, 1e6 * points)
    data = back.metadata["_ply_raw"]["vertex"]["data"]
    assert {name: data[name].ravel().tolist() for name in columns} == {
        name: values.tolist() for name, values in columns.items()
    }


def test_units_and_suffixes_are_checked(tmp_path):
    assert len(encode_mesh(tetrahedron(), ".PLY", unit="um")) > 100
    with pytest.raises(InvalidValueError, match="unit"):
        save_mesh(tmp_path / "a.ply", tetrahedron(), unit="inch")
    with pytest.raises(InvalidValueError):
        save_mesh(tmp_path / "a.obj", tetrahedron())
    with pytest.raises(InvalidValueError):
        save_cloud(tmp_path / "a.stl", np.zeros((3, 3)))
    with pytest.raises(InvalidValueError, match="sigma"):
        save_cloud(tmp_path / "a.ply", np.zeros((3, 3)), {"sigma": np.zeros(2)})
    assert not list(tmp_path.iterdir())
