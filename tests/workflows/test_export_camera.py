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

"""Cameras in the files of other programs: read back as those programs do, and compared with the calibration."""

from __future__ import annotations

import ast
import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import yaml

from semcal_ros import Calibration
from semcal_ros.core.camera.pinhole_model import fit_pinhole
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.workflows.export_camera import export_calibration
from tests.helpers.node_scenes import make_calibration

G = 2500.0


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return make_calibration()


def points_of(camera: ScanCamera) -> np.ndarray:
    """Sem-frame points over the field, at heights within a tenth of its width."""
    x, y = np.meshgrid(np.linspace(5, camera.width - 6, 7), np.linspace(5, camera.height - 6, 6))
    flat = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1))
    field_m = camera.width / camera.m
    return np.concatenate([camera.sem_from_ideal(flat, h * field_m) for h in (-0.1, 0.0, 0.1)])


def worst(found: np.ndarray, camera: ScanCamera) -> float:
    return float(np.max(np.linalg.norm(found - camera.project(points_of(camera)), axis=1)))


def read_opencv(path: Path) -> tuple[np.ndarray, ...]:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    names = ("rotation_vector", "translation_vector", "camera_matrix", "distortion_coefficients")
    return tuple(file.getNode(name).mat() for name in names)


def test_opencv_projects_rectified_images_like_the_calibration(calibration, tmp_path):
    path = tmp_path / "camera.yaml"
    done = export_calibration(calibration, "opencv", path, magnifications=[G], rectified=True)
    camera = calibration.at(G).rectified
    xy, _ = cv2.projectPoints(points_of(camera)[:, None], *read_opencv(path))
    # A pinhole holds it exactly; doubles of 1e6 px focal length leave 1e-9 px.
    assert worst(xy.reshape(-1, 2), camera) < 1e-6
    assert done.worst_px < 1e-6


def test_the_stated_difference_of_raw_images_is_the_true_one(calibration, tmp_path):
    path = tmp_path / "camera.yaml"
    done = export_calibration(calibration, "opencv", path, magnifications=[G])
    camera = calibration.at(G)
    xy, _ = cv2.projectPoints(points_of(camera)[:, None], *read_opencv(path))
    # Other points than those of the fit, within its field.
    assert 0.5 * done.worst_px < worst(xy.reshape(-1, 2), camera) < 1.05 * done.worst_px
    # Without any distortion the same points are further off.
    ideal = camera.project_ideal(points_of(camera))
    assert done.worst_px < 0.5 * worst(ideal, camera)


@pytest.mark.parametrize("name", ["xi_u", "xi_v", "xi_s", "coil_x3"])
def test_a_camera_with_one_further_term_alone_is_no_pinhole(calibration, name):
    plain = replace(calibration.at(G), residual=None, xi_r=0.0, xi_t=0.0, skew=0.0)
    exact, nearly = (fit_pinhole(replace(plain, **{name: 0.004}, xi_r=r)) for r in (0.0, 1e-12))
    assert exact.worst_px == pytest.approx(nearly.worst_px, rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "suffix"), [("opencv", ".yaml"), ("ros", ".yaml"), ("colmap", ".txt")]
)
def test_what_a_format_cannot_hold_is_refused(calibration, tmp_path, kind, suffix):
    path = tmp_path / f"camera{suffix}"
    with pytest.raises(
        InvalidValueError, match=rf"{kind} .* at 2500x to 0\.2\d px.*0\.1 px"
    ) as refused:
        export_calibration(calibration, kind, path, magnifications=[G], lossy_px=0.1)
    assert not path.exists()
    # The bound that it proposes is one that it accepts.
    proposed = float(str(refused.value).split("--lossy ")[1].rstrip(")"))
    done = export_calibration(calibration, kind, path, magnifications=[G], lossy_px=proposed)
    assert 0.9 * proposed < done.worst_px <= proposed
    export_calibration(calibration, kind, path, magnifications=[G], lossy_px=1e-5, rectified=True)


def test_by_default_a_loss_of_more_than_a_pixel_or_so_is_refused(calibration, tmp_path):
    # A skew that no pinhole has.
    skew = replace(calibration.functions["skew"], coefficients=np.array([0.2]))
    bent = {**calibration.functions, "skew": skew}
    odd = Calibration.from_model(replace(calibration, functions=bent))
    assert fit_pinhole(odd.at(G)).worst_px > 1.5
    with pytest.raises(InvalidValueError, match="--lossy"):
        export_calibration(odd, "opencv", tmp_path / "camera.yaml", magnifications=[G])


def test_a_radial_distortion_about_the_principal_point_is_held(tmp_path):
    camera = ScanCamera(
        G, 2.1e7, 1.003, 0.0, 250.0, 260.0, 50.0, 0.004, 0.0, 250.0, 260.0, 256.0, 512, 512
    )
    # The division model and a polynomial of the same 8 unknowns agree to 0.01 px in this field.
    assert fit_pinhole(camera, 8).worst_px < 0.01
    assert fit_pinhole(camera, 5).worst_px < 0.01


def test_a_parallel_projection_gets_a_long_focal_length(tmp_path):
    camera = ScanCamera.nominal(5000.0, 512, 512, 0.12)
    made = fit_pinhole(camera)
    assert made.fx == pytest.approx(1e7)
    # Heights of a tenth of the field over the 10 million px: 256 px times 5e-6.
    assert made.worst_px == pytest.approx(256 * np.sqrt(2) * 51.2 / 1e7, rel=0.05)


def test_ros_reads_a_plumb_bob_camera(calibration, tmp_path):
    """As PinholeCameraModel does: K, D and P of the file, with x = X / Z."""
    path = tmp_path / "sem.yaml"
    export_calibration(calibration, "ros", path, magnifications=[G], rectified=True)
    data = yaml.safe_load(path.read_text())
    camera = calibration.at(G).rectified
    projection = np.array(data["projection_matrix"]["data"]).reshape(3, 4)
    points = points_of(camera) + [0.0, 0.0, 1.0 / camera.rho]
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ projection.T
    assert worst(homogeneous[:, :2] / homogeneous[:, 2:], camera) < 1e-6
    assert data["distortion_model"] == "plumb_bob"
    assert len(data["distortion_coefficients"]["data"]) == 5
    assert (data["image_width"], data["image_height"]) == (camera.width, camera.height)


def test_ros_rectifies_raw_images_as_the_calibration_does(calibration, tmp_path):
    """As image_proc does: a rectified pixel's ray is turned by R, distorted by D and projected by K."""
    path = tmp_path / "sem.yaml"
    done = export_calibration(calibration, "ros", path, magnifications=[G])
    data = yaml.safe_load(path.read_text())
    k, d, r, p = (
        np.array(data[f"{name}"]["data"])
        for name in (
            *("camera_matrix", "distortion_coefficients"),
            *("rectification_matrix", "projection_matrix"),
        )
    )
    camera = calibration.at(G)
    size = (camera.width, camera.height)
    x, y = cv2.initUndistortRectifyMap(
        k.reshape(3, 3), d, r.reshape(3, 3), p.reshape(3, 4)[:, :3], size, cv2.CV_32FC1
    )
    at = np.array([[10.0, 12.0], [48.0, 48.0], [85.0, 20.0]])
    found = np.array([[x[int(v), int(u)], y[int(v), int(u)]] for u, v in at])
    assert np.abs(found - camera.raw_from_rect(at)).max() < 1.05 * done.worst_px + 1e-3


def test_mrcal_grammar(calibration, tmp_path):
    """A Python literal with comments, whose model projects as OpenCV's does."""
    path = tmp_path / "sem.cameramodel"
    done = export_calibration(calibration, "mrcal", path, magnifications=[G])
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    model = ast.literal_eval("\n".join(lines))
    assert model["lensmodel"] == "LENSMODEL_OPENCV5"
    fx, fy, cx, cy, *distortion = model["intrinsics"]
    camera = calibration.at(G)
    assert model["imagersize"] == [camera.width, camera.height]
    turn, shift = np.array(model["extrinsics"][:3]), np.array(model["extrinsics"][3:])
    moved = points_of(camera) @ cv2.Rodrigues(turn)[0].T + shift
    x, y = (moved[:, :2] / moved[:, 2:]).T
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    seen = np.stack(
        [
            cx + fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)),
            cy + fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y),
        ],
        axis=1,
    )
    assert worst(seen, camera) < 1.05 * done.worst_px


def test_colmap_counts_from_the_corner_of_the_first_pixel(calibration, tmp_path):
    path = tmp_path / "cameras.txt"
    export_calibration(calibration, "colmap", path, magnifications=[G], rectified=True)
    (line,) = [t for t in path.read_text().splitlines() if not t.startswith("#")]
    number, model, width, height, *values = line.split()
    camera = calibration.at(G).rectified
    assert (number, model) == ("1", "FULL_OPENCV") and len(values) == 12
    assert (int(width), int(height)) == (camera.width, camera.height)
    fx, fy, cx, cy = map(float, values[:4])
    assert (cx, cy) == pytest.approx((camera.px + 0.5, camera.py + 0.5))
    assert fx == pytest.approx(camera.m / camera.rho) == pytest.approx(fy)


def test_colmap_itself_projects_alike(calibration, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "cameras.txt"
    done = export_calibration(calibration, "colmap", path, magnifications=[G])
    (line,) = [t for t in path.read_text().splitlines() if not t.startswith("#")]
    _, model, width, height, *values = line.split()
    read = pycolmap.Camera(
        model=model, width=int(width), height=int(height), params=[float(v) for v in values]
    )
    made = fit_pinhole(calibration.at(G))
    moved = points_of(calibration.at(G)) @ cv2.Rodrigues(made.rotation)[0].T + made.translation_m
    seen = np.asarray(read.img_from_cam(moved)) - 0.5
    assert worst(seen, calibration.at(G)) < 1.05 * done.worst_px


def test_the_map_for_imagej_rectifies(calibration, tmp_path):
    path = tmp_path / "scale.ijm"
    done = export_calibration(calibration, "fiji", path, magnifications=[G])
    camera = calibration.at(G)
    x_nm, y_nm = (1e9 * size for size in camera.pixel_size_m)
    assert f'setVoxelSize({x_nm!r}, {y_nm!r}, 1, "nm");' in path.read_text()
    shown = tifffile.imread(done.paths[1])
    at = np.array([[30.0, 80.0], [62.0, 14.0]])
    expected = camera.raw_from_rect(at)
    for (column, row), raw in zip(at.astype(int), expected, strict=True):
        # 32 bits hold a position of some tens of px to 4e-6.
        assert shown[:, row, column] == pytest.approx(raw, abs=1e-4)


def test_the_table_has_every_parameter_and_its_sigma(calibration, tmp_path):
    path = tmp_path / "parameters.csv"
    export_calibration(calibration, "csv", path, magnifications=[G, 3000.0])
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["magnification"]) for row in rows] == [G, 3000.0]
    camera = calibration.at(G)
    assert float(rows[0]["nm_per_px_x"]) == 1e9 * camera.pixel_size_m[0]
    assert float(rows[0]["xi_r"]) == camera.xi_r
    assert float(rows[0]["sigma_rho_1_per_m"]) == pytest.approx(np.sqrt(camera.covariance[5, 5]))


@pytest.mark.parametrize(
    ("kind", "name", "given", "what"),
    [
        ("ros", "a.csv", {"magnifications": [G]}, "ends in .yaml"),
        ("ros", "a.yaml", {}, "--magnification once"),
        ("colmap", "a.txt", {"magnifications": [G, 2 * G]}, "one: the file holds one camera"),
        ("csv", "a.csv", {"rectified": True}, "expected one of them"),
        ("hugin", "a.pto", {}, "opencv, ros"),
    ],
)
def test_what_contradicts_is_refused(calibration, tmp_path, kind, name, given, what):
    with pytest.raises(InvalidValueError, match=what):
        export_calibration(calibration, kind, tmp_path / name, **given)
    assert not list(tmp_path.iterdir())
