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

"""The camera model: known answers, exact inverses, limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semcal_ros.core.camera.calibration_model import TERM_NAMES
from semcal_ros.core.camera.distortion import distort_normalised, undistort_normalised
from semcal_ros.core.camera.projection import project_points
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError

PLAIN = ScanCamera(
    1000.0, 4e6, 1.0, 0.0, 255.5, 255.5, 50.0, 0.0, 0.0, 255.5, 255.5, 256.0, 512, 512
)
BENT = replace(
    PLAIN, aspect=1.01, skew=0.002, px=240.0, py=262.0, xi_r=0.04, xi_t=-0.01, ex=230.0, ey=271.0
)

xi_r = st.floats(-0.15, 0.15)
xi_t = st.floats(-0.02, 0.02)
pixel = st.tuples(st.floats(0, 511), st.floats(0, 511))


def test_x_points_right_and_y_down():
    xy = PLAIN.project([[10e-6, 0.0, 0.0], [0.0, 10e-6, 0.0]])
    # 10 um at 4 px per um
    np.testing.assert_allclose(xy, [[295.5, 255.5], [255.5, 295.5]], atol=1e-9)


def test_a_point_farther_from_the_gun_is_seen_smaller():
    near, far = PLAIN.project([[20e-6, 0, 0.0], [20e-6, 0, 2e-3]])
    # w = 1 + 50 / m * 2 mm = 1.1
    assert near[0] - 255.5 == pytest.approx(80.0)
    assert far[0] - 255.5 == pytest.approx(80.0 / 1.1)


def test_aspect_and_skew_act_as_the_matrix_says():
    camera = replace(PLAIN, aspect=1.25, skew=0.1)
    xy = camera.project([[10e-6, 0, 0], [0, 10e-6, 0]]) - 255.5
    np.testing.assert_allclose(xy, [[50.0, 0.0], [4.0, 32.0]], atol=1e-9)
    assert camera.pixel_size_m == pytest.approx((0.2e-6, 0.3125e-6))


def test_positive_radial_coefficient_moves_points_outwards():
    camera = replace(PLAIN, xi_r=0.04)
    # r_d = 2 r / (1 + sqrt(1 - 4 xi r^2)) at r = 1: 2 / (1 + sqrt(0.84))
    expected = 255.5 + 256.0 * 2.0 / (1.0 + np.sqrt(0.84))
    assert camera.distort([[511.5, 255.5]])[0, 0] == pytest.approx(expected)


def test_tangential_term_known_answer():
    camera = replace(PLAIN, xi_t=0.01)
    # q = (1, 0): xi_t (r2 + 2 q*q) = 0.01 (3, 1)
    np.testing.assert_allclose(
        camera.distort([[511.5, 255.5]]), [[511.5 + 7.68, 255.5 + 2.56]], atol=1e-9
    )


@given(st.lists(pixel, min_size=1, max_size=20), xi_r, xi_t)
def test_undistorting_reverts_distorting(points, radial, tangential):
    camera = replace(BENT, xi_r=radial, xi_t=tangential)
    ideal = np.array(points)
    raw = camera.distort(ideal)
    valid = np.all(np.isfinite(raw), axis=1)
    # Newton ends within rounding of coordinates of order 1000 px.
    np.testing.assert_allclose(camera.undistort(raw[valid]), ideal[valid], atol=1e-8)


@given(st.lists(pixel, min_size=1, max_size=20), xi_r, xi_t)
def test_distorting_reverts_undistorting(points, radial, tangential):
    camera = replace(BENT, xi_r=radial, xi_t=tangential)
    raw = np.array(points)
    report = camera.undistort_report(raw)
    ideal = camera.undistort(raw)
    assert np.array_equal(np.isfinite(ideal).all(axis=1), report.converged)
    np.testing.assert_allclose(
        camera.distort(ideal[report.converged]), raw[report.converged], atol=1e-8
    )


@pytest.mark.parametrize("name", TERM_NAMES)
def test_every_term_is_projected_as_in_an_adjustment_and_undone(name):
    radial = replace(BENT, xi_t=0.0)
    camera = replace(radial, **{name: 0.005})
    points = np.random.default_rng(0).uniform(-5e-5, 5e-5, (20, 3))
    raw = camera.project(points)
    np.testing.assert_allclose(raw, project_points(camera.all_parameters, points, camera.raster))
    assert np.max(np.abs(raw - radial.project(points))) > 0.01
    np.testing.assert_allclose(camera.undistort(raw), camera.project_ideal(points), atol=1e-8)


def test_outside_of_the_domain_there_is_no_answer():
    # 4 xi_r r2 >= 1 beyond r = 1 for xi_r = 0.25
    q = np.array([[0.99, 0.0], [1.01, 0.0]])
    distorted = distort_normalised(q, 0.25, 0.0)
    assert np.isfinite(distorted[0]).all() and np.isnan(distorted[1]).all()
    # The distorted radius cannot exceed 1 / sqrt(xi_r) = 2.
    report = undistort_normalised(np.array([[1.5, 0.0], [2.5, 0.0], [np.nan, 0.0]]), 0.25, 1e-4)
    assert report.converged.tolist() == [True, False, False]
    assert np.isnan(report.q[1:]).all()


def test_inverse_reports_how_it_converged():
    report = BENT.undistort_report([[10.0, 20.0], [500.0, 490.0]])
    assert report.converged.all()
    assert 1 < report.iterations < 10
    assert report.residual.max() < 1e-10


def test_p_projects_homogeneous_points_to_ideal_pixels():
    points = np.random.default_rng(0).uniform(-4e-5, 4e-5, (50, 3))
    for matrix in (BENT.P, BENT.P_affine):
        h = np.column_stack([points, np.ones(50)]) @ matrix.T
        np.testing.assert_allclose(h[:, :2] / h[:, 2:], BENT.project_ideal(points), atol=1e-9)
    np.testing.assert_allclose(BENT.K, BENT.P[:, :3])
    assert BENT.K[0, 0] == pytest.approx(BENT.aspect * BENT.m / BENT.rho)
    assert BENT.K[0, 2] == pytest.approx(BENT.px)


@given(st.floats(1e-12, 1e-3))
@settings(max_examples=30)
def test_projection_is_smooth_through_the_parallel_limit(rho):
    points = np.array([[3e-5, -2e-5, 5e-5], [-4e-5, 1e-5, -5e-5]])
    parallel = replace(BENT, rho=0.0).project(points)
    # d x / d rho = m X Z <= 4e6 * 4e-5 * 5e-5 = 8e-3 px m
    for value in (rho, -rho):
        change = np.abs(replace(BENT, rho=value).project(points) - parallel).max()
        assert change <= 1.2e-2 * rho + 1e-9


def test_parallel_projection_has_no_k_and_says_so():
    camera = replace(PLAIN, rho=0.0)
    assert np.isfinite(camera.P_affine).all()
    with pytest.raises(InvalidValueError, match="P_affine"):
        _ = camera.K
    with pytest.raises(InvalidValueError, match="P_affine"):
        _ = camera.P


def test_points_behind_the_pivot_have_no_image():
    assert np.isnan(PLAIN.project([[0.0, 0.0, -0.021]])).all()


def test_sem_from_ideal_reverts_project_ideal():
    points = np.random.default_rng(1).uniform(-4e-5, 4e-5, (20, 3))
    for point in points:
        back = BENT.sem_from_ideal(BENT.project_ideal(point[None]), float(point[2]))
        np.testing.assert_allclose(back[0], point, atol=1e-15)


def test_jacobian_at_the_reference_plane():
    step = 1e-9
    base = BENT.project_ideal([[0, 0, 0]])[0]
    moved = BENT.project_ideal([[step, 0, 0], [0, step, 0]])
    np.testing.assert_allclose(((moved - base) / step).T, BENT.ideal_from_sem_jacobian, rtol=1e-5)


@pytest.mark.parametrize(("width", "height"), [(1024, 1024), (256, 256), (1024, 768), (100, 300)])
def test_another_image_size_shows_the_same_field(width, height):
    resized = BENT.resized(width, height)
    points = np.random.default_rng(2).uniform(-3e-5, 3e-5, (30, 3))
    s = width / 512
    offset = 0.5 * (height - s * 512)
    expected = (BENT.project(points) + 0.5) * s - 0.5 + [0.0, offset]
    # Pixel centres at integers: the outer border of the image, not its first centre, is what scales.
    np.testing.assert_allclose(resized.project(points), expected, atol=1e-8)
    assert (resized.width, resized.height) == (width, height)


def test_sigma_is_the_covariance_through_the_projection():
    covariance = np.zeros((10, 10))
    covariance[3, 3] = 0.25  # principal point x: 0.5 px
    covariance[0, 0] = (4e6 * 0.01) ** 2  # scale: 1 %
    camera = replace(PLAIN, covariance=covariance)
    sigma = camera.project_sigma([[0.0, 0.0, 0.0], [25e-6, 0.0, 0.0]])
    np.testing.assert_allclose(sigma, [[0.5, 0.0], [np.hypot(0.5, 1.0), 0.0]], atol=1e-12)
    # Twice the pixels, twice the error.
    doubled = camera.resized(1024, 1024).project_sigma([[25e-6, 0.0, 0.0]])
    np.testing.assert_allclose(doubled, 2 * sigma[1:], atol=1e-12)
    assert camera.pixel_size_sigma_m[0] == pytest.approx(0.01 * camera.pixel_size_m[0], abs=0.0)


def test_sigma_of_the_pixel_size_knows_how_scale_and_aspect_go_together():
    # Both are 1 % off, always together: x goes with 1 / (m a), y with a / m.
    both = np.zeros(10)
    both[:2] = 0.01 * PLAIN.m, 0.01 * PLAIN.aspect
    camera = replace(PLAIN, covariance=np.outer(both, both))
    x, y = np.array(camera.pixel_size_sigma_m) / camera.pixel_size_m
    assert x == pytest.approx(0.02)
    # The root of a rounding error.
    assert y == pytest.approx(0.0, abs=1e-9)


def test_sigma_without_covariance_is_refused():
    with pytest.raises(InvalidValueError, match="covariance"):
        PLAIN.project_sigma([[0, 0, 0]])


@pytest.mark.parametrize(
    "change",
    [
        {"m": 0.0},
        {"m": -1.0},
        {"aspect": 0.0},
        {"px": np.nan},
        {"rho": np.inf},
        {"magnification": 0.0},
    ],
)
def test_meaningless_cameras_are_refused(change):
    with pytest.raises(InvalidValueError):
        replace(PLAIN, **change)


def test_wrong_shapes_are_refused():
    with pytest.raises(InvalidValueError, match="shape"):
        PLAIN.project([1.0, 2.0, 3.0])
    with pytest.raises(InvalidValueError, match="shape"):
        PLAIN.distort([[1.0, 2.0, 3.0]])


def test_nominal_camera_follows_the_display_width():
    camera = ScanCamera.nominal(1000.0, 600, 400, 0.12)
    # 120 mm of display at 1000x show 120 um over 600 px
    assert camera.pixel_size_m == pytest.approx((0.2e-6, 0.2e-6))
    assert (camera.px, camera.py) == (299.5, 199.5)
