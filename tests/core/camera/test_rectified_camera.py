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

"""The camera of rectified images: square pixels, no skew, no distortion, and its uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from semcal_ros.core.camera.projection import ALL_NAMES, PARAMETER_NAMES
from semcal_ros.core.camera.residual_field import ResidualField, zero_field
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.rectification.raw_positions import RasterDrift, raw_from_output
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.synthetic import Detector, Pose, preset, render_frame
from semcal_ros.synthetic.microscope import Constant
from semcal_ros.synthetic.specimens.grid import ChessGrid

SIZE = (512, 384)
MIDDLE = np.array([255.5, 191.5])
SIGMAS = np.array([2e4, 0.003, 0.002, 4.0, 5.0, 2.0, 2e-3, 1e-3, 3.0, 4.0])
# Spiral, decentring along the other diagonal, coils, settling.
TERMS = {name: (-1.0) ** k * 0.003 for k, name in enumerate(ALL_NAMES[len(PARAMETER_NAMES) :])}
TERM_SIGMAS = np.full(len(TERMS), 1e-3)


def make_camera(**changes: float) -> ScanCamera:
    usual = dict(zip(PARAMETER_NAMES, (4e6, 1.06, 0.03, 240.0, 205.0), strict=False))
    usual |= {"rho": 50.0, "xi_r": 0.03, "xi_t": -0.01, "ex": 230.0, "ey": 171.0}
    return ScanCamera(
        magnification=1000.0, norm_px=256.0, width=SIZE[0], height=SIZE[1], **usual | changes
    )


def with_covariance(camera: ScanCamera, seed: int = 0) -> ScanCamera:
    """Everything correlates."""
    sigmas = sigmas_of(camera)
    size = len(sigmas)
    root = np.random.default_rng(seed).normal(size=(size, size)) + 2.0 * np.eye(size)
    root *= sigmas[:, None]
    return replace(camera, covariance=root @ root.T / size)


def sigmas_of(camera: ScanCamera) -> np.ndarray:
    return np.append(SIGMAS, TERM_SIGMAS)[: len(camera.names)]


def make_field(seed: int = 0) -> ResidualField:
    empty = zero_field(SIZE, (500.0, 2000.0), 1)
    rng = np.random.default_rng(seed)
    return replace(empty, coefficients=rng.normal(0.0, 0.004, empty.coefficients.shape))


CAMERA = make_camera()
POINTS = np.random.default_rng(5).uniform((-5e-5, -4e-5, -3e-4), (5e-5, 4e-5, 3e-4), (40, 3))


def test_a_square_grid_has_equal_pitches_and_right_angles():
    step = 10e-6
    corners = np.array([[0.0, 0.0, 0.0], [step, 0.0, 0.0], [0.0, step, 0.0]])
    zero, x, y = CAMERA.rect_from_raw(CAMERA.project(corners))
    # 10 um at 4 px per um; the axes of the image are those of the sem frame.
    np.testing.assert_allclose(x - zero, [40.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(y - zero, [0.0, 40.0], atol=1e-9)
    # The undistorted picture has neither.
    zero, x, y = CAMERA.undistort(CAMERA.project(corners))
    np.testing.assert_allclose(x - zero, [42.4, 0.0], atol=1e-9)
    np.testing.assert_allclose(y - zero, [1.2, 40.0 / 1.06], atol=1e-9)


def test_its_matrices_have_one_focal_length_and_exactly_no_skew():
    square = CAMERA.rectified
    assert square.K[0, 0] == square.K[1, 1] == pytest.approx(4e6 / 50.0)
    assert (square.K[0, 1], square.K[1, 0]) == (0.0, 0.0)
    assert square.K[2].tolist() == [0.0, 0.0, 1.0]
    assert square.P_affine[:, :2].tolist() == [[4e6, 0.0], [0.0, 4e6], [0.0, 0.0]]
    assert square.P_affine[2].tolist() == [0.0, 0.0, 50.0, 1.0]
    assert square.pixel_size_m == (0.25e-6, 0.25e-6)
    # The area of a pixel stays.
    assert np.prod(square.pixel_size_m) == pytest.approx(np.prod(CAMERA.pixel_size_m))
    parallel = make_camera(rho=0.0).rectified
    assert np.all(np.isfinite(parallel.P_affine))
    with pytest.raises(InvalidValueError, match="P_affine"):
        _ = parallel.K


def test_the_middle_of_the_undistorted_picture_stays():
    np.testing.assert_allclose(CAMERA.rect_from_ideal([MIDDLE]), [MIDDLE], atol=1e-12)
    seen = CAMERA.sem_from_ideal([MIDDLE])
    np.testing.assert_allclose(CAMERA.rectified.project(seen), [MIDDLE], atol=1e-9)


@pytest.mark.parametrize("camera", [CAMERA, make_camera(**TERMS)], ids=["plain", "terms"])
def test_it_projects_to_where_the_rectified_image_shows_a_point(camera):
    square = camera.rectified
    shown = camera.rect_from_raw(camera.project(POINTS))
    for seen in (square.project(POINTS), square.project_ideal(POINTS)):
        np.testing.assert_allclose(seen, shown, atol=1e-9)
    homogeneous = np.column_stack([POINTS, np.ones(len(POINTS))])
    for matrix in (square.P_affine, square.P):
        u = homogeneous @ matrix.T
        np.testing.assert_allclose(u[:, :2] / u[:, 2:], shown, atol=1e-9)


def test_it_is_its_own_rectified_camera_and_maps_nothing():
    square = CAMERA.rectified
    assert square.rectified is square
    xy = np.random.default_rng(1).uniform(0.0, 511.0, (50, 2))
    for same in (square.undistort, square.distort, square.rect_from_raw, square.raw_from_rect):
        np.testing.assert_allclose(same(xy), xy, atol=1e-10)


def test_a_camera_that_is_square_already_keeps_its_parameters():
    camera = make_camera(aspect=1.0, skew=0.0)
    square = camera.rectified
    expected = camera.parameters * [1, 1, 1, 1, 1, 1, 0, 0, 1, 1]
    np.testing.assert_allclose(square.parameters, expected, rtol=1e-14)


@settings(max_examples=50, deadline=None)
@given(
    st.floats(0.8, 1.25),
    st.floats(-0.2, 0.2),
    st.floats(-0.1, 0.1),
    st.floats(-0.02, 0.02),
    st.tuples(st.floats(0.0, 511.0), st.floats(0.0, 383.0)),
)
def test_there_and_back(aspect, skew, xi_r, xi_t, pixel):
    camera = make_camera(aspect=aspect, skew=skew, xi_r=xi_r, xi_t=xi_t, ex=250.0, ey=190.0)
    shown = camera.rect_from_raw([pixel])
    np.testing.assert_allclose(camera.raw_from_rect(shown), [pixel], atol=1e-8)
    there = camera.rect_from_ideal([pixel])
    np.testing.assert_allclose(camera.ideal_from_rect(there), [pixel], atol=1e-10)
    seen = camera.rectified.sem_from_ideal(shown)
    np.testing.assert_allclose(camera.project(seen), [pixel], atol=1e-8)


@pytest.mark.parametrize("size", [(1024, 768), (256, 192), (512, 512), (300, 211)])
@pytest.mark.parametrize("camera", [CAMERA, make_camera(**TERMS)], ids=["plain", "terms"])
def test_resizing_and_rectifying_commute(camera, size):
    camera = with_covariance(camera)
    one, other = camera.resized(*size).rectified, camera.rectified.resized(*size)
    np.testing.assert_allclose(one.parameters, other.parameters, rtol=1e-13)
    # The same field, about the middle.
    s = size[0] / SIZE[0]
    expected = s * (camera.rectified.project(POINTS) - MIDDLE) + 0.5 * (np.array(size) - 1.0)
    np.testing.assert_allclose(one.project(POINTS), expected, atol=1e-9)
    sigma = s * camera.rectified.project_sigma(POINTS)
    for resized in (one, other):
        np.testing.assert_allclose(resized.project_sigma(POINTS), sigma, rtol=1e-9)


# -- its uncertainty ------------------------------------------------------------------------------


def own_parameters(true: ScanCamera, used: ScanCamera) -> np.ndarray:
    """m, aspect, skew, px, py, rho of what is rectified with another camera, from four points."""
    matrix = used._rect_from_ideal @ true.ideal_from_sem_jacobian
    m = np.sqrt(np.linalg.det(matrix))
    centre = used.rect_from_ideal([[true.px, true.py]])[0]
    return np.array([m, matrix[0, 0] / m, matrix[0, 1] / m, *centre, true.rho])


def test_the_parameters_of_a_picture_that_another_camera_rectifies():
    """The covariance is that of what is left of the true parameters after the estimated map."""
    camera = with_covariance(CAMERA)
    jacobian = np.zeros((6, 10))
    for k, name in enumerate(PARAMETER_NAMES):
        step = 1e-4 * SIGMAS[k]
        ends = [
            own_parameters(replace(camera, **{name: getattr(camera, name) + s}), camera)
            for s in (step, -step)
        ]
        jacobian[:, k] = (ends[0] - ends[1]) / (2.0 * step)
    expected = jacobian @ camera.covariance @ jacobian.T
    unit = np.sqrt(np.diag(expected))
    stated = camera.rectified.covariance[:6, :6]
    scale = np.outer(unit, unit)
    np.testing.assert_allclose(stated / scale, expected / scale, atol=1e-6)
    # What was known of the distortion is still known.
    np.testing.assert_array_equal(camera.rectified.covariance[6:, 6:], camera.covariance[6:, 6:])


@pytest.mark.parametrize("terms", [False, True])
@pytest.mark.parametrize("field", [False, True])
def test_the_jacobian_is_that_of_what_another_camera_rectifies(field, terms):
    """Numerically: the true parameters move the raw pixel, the map stays as estimated."""
    camera = with_covariance(make_camera(**TERMS) if terms else CAMERA)
    sigmas = sigmas_of(camera)
    own_count = len(sigmas)
    if field:
        slice_ = make_field().at(1000.0)
        size = slice_.coefficients.size
        covariance, cross = 1e-6 * np.eye(size), np.zeros((own_count, size))
        camera = replace(
            camera,
            residual=replace(
                slice_,
                cross_covariance=cross,
                weights=np.ones(1),
                whole_covariance=covariance,
            ),
        )
    columns = []
    for k, name in enumerate(camera.names):
        step = 1e-4 * sigmas[k]
        up, down = (replace(camera, **{name: getattr(camera, name) + s}) for s in (step, -step))
        moved = [camera.rect_from_raw(c.project(POINTS)) for c in (up, down)]
        columns.append((moved[0] - moved[1]) / (2.0 * step))
    if field:
        for k in range(camera.residual.coefficients.size):
            change = np.zeros(camera.residual.coefficients.size)
            change[k] = 1e-6
            change = change.reshape(camera.residual.coefficients.shape)
            fields = (
                replace(camera.residual, coefficients=camera.residual.coefficients + s * change)
                for s in (1.0, -1.0)
            )
            moved = [
                camera.rect_from_raw(replace(camera, residual=f).project(POINTS)) for f in fields
            ]
            columns.append((moved[0] - moved[1]) / 2e-6)
    by_source = np.stack(columns, axis=2)
    square = camera.rectified
    own = square.project_jacobian(POINTS)
    # Its own parameters are linear in the raw camera's: undo that to compare.
    linear = np.eye(own.shape[2])
    linear[:own_count, :own_count] = camera._rectified_from_parameters
    units = np.concatenate([sigmas, np.full(own.shape[2] - own_count, 1e-3)])
    np.testing.assert_allclose(own @ linear * units, by_source * units, atol=2e-6)
    spread = np.einsum("nip,pq,niq->ni", by_source, camera.joint_covariance, by_source)
    np.testing.assert_allclose(square.project_sigma(POINTS), np.sqrt(spread), rtol=1e-5)


def test_the_jacobian_by_its_own_parameters_is_that_of_the_projection():
    square = with_covariance(CAMERA).rectified
    jacobian = square.project_jacobian(POINTS)
    for k, name in enumerate(PARAMETER_NAMES[:6]):
        step = 1e-4 * SIGMAS[k]
        up, down = (
            ScanCamera.project(replace(square, **{name: getattr(square, name) + s}), POINTS)
            for s in (step, -step)
        )
        numeric = (up - down) / (2.0 * step)
        np.testing.assert_allclose(jacobian[:, :, k] * SIGMAS[k], numeric * SIGMAS[k], atol=1e-6)


@pytest.mark.long
def test_sigma_is_the_scatter_of_pictures_of_other_true_cameras():
    """The estimated map applied to what cameras drawn from the covariance see."""
    camera = with_covariance(CAMERA)
    rng = np.random.default_rng(3)
    draws = rng.multivariate_normal(np.zeros(10), camera.covariance, 4000)
    seen = [
        camera.rect_from_raw(
            replace(
                camera, **dict(zip(PARAMETER_NAMES, camera.parameters + d, strict=True))
            ).project(POINTS[:8])
        )
        for d in draws
    ]
    # 4000 draws tell a sigma to 1.1 %; the map is not quite linear in the errors.
    np.testing.assert_allclose(
        np.std(seen, axis=0), camera.rectified.project_sigma(POINTS[:8]), rtol=0.05
    )


def test_the_pixel_size_is_as_uncertain_along_each_axis_as_the_raw_one():
    camera = with_covariance(CAMERA)
    square = camera.rectified
    relative = np.divide(camera.pixel_size_sigma_m, camera.pixel_size_m)
    np.testing.assert_allclose(
        np.divide(square.pixel_size_sigma_m, square.pixel_size_m), relative, rtol=1e-12
    )


def test_a_camera_that_is_known_exactly_has_no_sigma():
    assert CAMERA.rectified.covariance is None
    assert CAMERA.rectified.joint_covariance is None
    with pytest.raises(InvalidValueError, match="without covariance"):
        CAMERA.rectified.project_sigma(POINTS)


def test_points_without_a_raw_pixel_have_no_sigma():
    camera = with_covariance(make_camera(xi_r=0.2, xi_t=0.0))
    points = np.array([[0.0, 0.0, 0.0], [2e-4, 2e-4, 0.0], [0.0, 0.0, -0.03]])
    sigma = camera.rectified.project_sigma(points)
    assert np.all(np.isfinite(sigma[0]))
    assert np.all(np.isnan(sigma[1:]))


# -- images ---------------------------------------------------------------------------------------


def test_drift_moves_a_rectified_image_alike_along_both_axes():
    drift = RasterDrift(np.array([3e-6, -2e-6]), np.zeros(2))
    xy = np.random.default_rng(2).uniform(50.0, 300.0, (20, 2))
    raw = raw_from_output(xy, SIZE, CAMERA, drift, None)
    # What lay at X is seen at X + drift; 4 px per um along both axes.
    np.testing.assert_allclose(CAMERA.rect_from_raw(raw) - xy, [[12.0, -8.0]] * 20, atol=1e-9)


@pytest.mark.parametrize("g", [400.0, 2000.0, 10_000.0])
def test_the_corners_of_a_rectified_image_are_where_its_camera_says(g: float):
    """A rendered grid, with an aspect and a skew of several px, rectified with the true camera."""
    scope = replace(preset("jsm820"), aspect=Constant(1.02), skew=Constant(0.015))
    square_m = 24.0 * scope.nominal_pixel_size_m(g)
    pose = Pose.tilted(0.15, 0.4, 0.3)
    image = render_frame(scope, ChessGrid(square_m), pose, g, detector=Detector(), seed=1)
    camera = scope.camera_at(g)
    found = find_lattice(Rectifier("cubic").rectify(image, camera))
    assert not isinstance(found, Rejection), found.reason
    i, j = np.meshgrid(np.arange(-30, 31), np.arange(-30, 31))
    board = np.stack([i.ravel(), j.ravel(), np.zeros(i.size)], axis=1) * square_m
    corners = board @ pose.R.T + pose.t_m
    for expected, limit_px in (
        # Noise and interpolation of a corner; the mean of hundreds tells a shift much better.
        (camera.rectified.project(corners), (0.0, 0.06)),
        (camera.project_ideal(corners), (0.5, 20.0)),
    ):
        distance, nearest = KDTree(expected).query(found.xy)
        assert limit_px[0] < np.sqrt(np.mean(distance**2)) < limit_px[1]
        if limit_px[0] == 0.0:
            assert len(found.xy) > 250
            np.testing.assert_allclose(
                np.mean(found.xy - expected[nearest], axis=0), 0.0, atol=0.01
            )
