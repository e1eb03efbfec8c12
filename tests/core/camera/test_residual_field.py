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

"""The residual field as a function: inverses, derivatives, and what it leaves to the rest of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semcal_ros.core.camera.distortion import LENS_NAMES, PRODUCTS
from semcal_ros.core.camera.residual_field import ResidualField, zero_field
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES
from semcal_ros.core.camera.thresholds import SETTLING_TIMES
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.raw_positions import RasterDrift, raw_from_output
from semcal_ros.core.rectification.rectifier import Rectifier

SIZE = (640, 480)
CAMERA = ScanCamera(
    1000.0, 4e6, 1.01, 0.002, 310.0, 250.0, 50.0, 0.02, -0.005, 300.0, 260.0, 320.0, *SIZE
)


def _field(seed=0, count=3, px=3.0):
    """A random field of a few px: neighbouring knots may differ by as much."""
    blank = zero_field(SIZE, (100.0, 10000.0), count)
    values = np.random.default_rng(seed).normal(size=blank.coefficients.shape) * px / 320.0
    # Smooth along both axes, as fields are: half of a coefficient comes from its neighbours.
    for axis in (1, 2):
        values = 0.5 * values + 0.25 * (np.roll(values, 1, axis) + np.roll(values, -1, axis))
    return replace(blank, coefficients=values)


def _camera(field, g=1000.0, **spread):
    return replace(CAMERA, residual=field.at(g, **spread))


def test_beyond_the_magnifications_the_field_of_the_nearer_end_holds():
    field = _field()
    np.testing.assert_array_equal(field.weights(50.0), field.weights(100.0))
    np.testing.assert_array_equal(field.weights(40000.0), field.weights(10000.0))
    assert field.weights(1000.0).sum() == pytest.approx(1.0)


def test_a_zero_field_displaces_nothing():
    camera = _camera(zero_field(SIZE, (100.0, 1000.0), 2))
    xy = np.random.default_rng(0).uniform(0, 480, (50, 2))
    np.testing.assert_array_equal(camera.without_residual(xy), xy)
    np.testing.assert_allclose(camera.distort(xy), CAMERA.distort(xy), atol=1e-10)


def test_the_field_is_added_to_the_raw_pixel():
    """One constant coefficient vector is a constant displacement: the basis is a partition of unity."""
    blank = zero_field(SIZE, (100.0, 1000.0), 1)
    ones = np.ones_like(blank.coefficients) * np.array([0.5, -0.25]) / 320.0
    camera = _camera(replace(blank, coefficients=ones))
    xy = np.array([[0.0, 0.0], [639.0, 479.0], [100.3, 20.0]])
    np.testing.assert_allclose(camera.without_residual(xy), xy + [0.5, -0.25], atol=1e-12)
    np.testing.assert_allclose(camera.distort(xy), CAMERA.distort(xy) - [0.5, -0.25], atol=1e-9)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 1000), st.floats(100.0, 10000.0))
def test_undistorting_reverts_distorting(seed, g):
    camera = _camera(_field(seed), g)
    rng = np.random.default_rng(seed)
    raw = rng.uniform((0.0, 0.0), (639.0, 479.0), (40, 2))
    # Both directions end within rounding of coordinates of some hundred px.
    np.testing.assert_allclose(camera.distort(camera.undistort(raw)), raw, atol=1e-8)
    assert np.abs(camera.without_residual(raw) - raw).max() > 0.1


def test_points_without_image_stay_without():
    camera = replace(_camera(_field()), xi_r=0.3)
    far = np.array([[3000.0, 250.0], [300.0, 250.0]])
    assert np.isnan(camera.distort(far)[0]).all()
    assert np.isfinite(camera.distort(far)[1]).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_weights_in_log_g_are_a_polynomial(count):
    field = _field(count=count)
    at = np.geomspace(100.0, 10000.0, 9)
    weights = np.stack([field.weights(g) for g in at])
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    assert weights.min() >= 0.0
    assert weights[0, 0] == pytest.approx(1.0) and weights[-1, -1] == pytest.approx(1.0)
    # A polynomial of degree count - 1 has no differences of that order plus one on equal steps of log g.
    np.testing.assert_allclose(np.diff(weights, n=count, axis=0), 0.0, atol=1e-12)


def test_beyond_the_range_the_field_of_the_nearer_end_holds():
    field = _field()
    for outside, edge in ((10.0, 100.0), (50000.0, 10000.0)):
        np.testing.assert_array_equal(field.at(outside).coefficients, field.at(edge).coefficients)


def test_overlaps_are_the_integrals_that_they_say():
    field = _field(3)
    overlaps = field.overlaps()
    # A camera with a field has no products of both coordinates.
    scan = 6 + len(LENS_NAMES) - len(PRODUCTS)
    assert overlaps.shape == (scan + len(SCAN_NAMES), field.slice_size)
    rows = overlaps @ field.at(1000.0).coefficients.ravel()
    # Gauss nodes, thirty between knots and the borders of the picture: there, fields and patterns are smooth.
    nodes, weights = np.polynomial.legendre.leggauss(30)
    axes = []
    for knots in (field.knots_x, field.knots_y):
        ends = np.union1d(knots, [-1.0, 1.0] if knots is field.knots_x else [])
        half = 0.5 * np.diff(ends)[:, None]
        at = 0.5 * (ends[1:] + ends[:-1])[:, None] + half * nodes
        axes.append((at.ravel(), (half * weights / (ends[-1] - ends[0])).ravel()))
    (x, along), (y, down) = axes
    q = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=1)
    weight = np.outer(down, along).ravel()
    shift = field.at(1000.0).displacement(q)
    r2 = np.sum(q * q, axis=1)
    radial, tangential = r2[:, None] * q, r2[:, None] + 2.0 * q * q
    spiral = r2[:, None] * np.stack([-q[:, 1], q[:, 0]], axis=1)
    one, zero = np.ones(len(q)), np.zeros(len(q))
    # Beyond the picture, functions of the scan go on as straight lines.
    inside, beyond = np.clip(q[:, 0], -1.0, 1.0), q[:, 0] - np.clip(q[:, 0], -1.0, 1.0)
    coil = 0.5 * (5.0 * inside**3 - 3.0 * inside) + 6.0 * beyond
    time = SETTLING_TIMES[2]
    decay = np.exp(-(1.0 + inside) / time)
    decay -= np.where(beyond < 0.0, beyond, 0.0) / time
    line = np.polynomial.Polynomial.fit(*_sampled_decay(time), 1)(q[:, 0])
    for row, pattern, tolerance in (
        (0, np.stack([one, zero], 1), 1e-12),
        (3, np.stack([q[:, 1], zero], 1), 1e-12),
        (6 + LENS_NAMES.index("xi_r"), radial, 1e-12),
        (6 + LENS_NAMES.index("xi_t"), tangential, 1e-12),
        (6 + LENS_NAMES.index("xi_s"), spiral, 1e-12),
        (6 + LENS_NAMES.index("xi_u"), tangential * [1.0, -1.0], 1e-12),
        (6 + LENS_NAMES.index("xi_r4") - len(PRODUCTS), r2[:, None] * radial, 1e-12),
        (scan + SCAN_NAMES.index("coil_x3"), np.stack([coil, zero], 1), 1e-8),
        # A decay is no polynomial, nor a coil one beyond the picture: six nodes in each cell are not quite exact.
        (scan + SCAN_NAMES.index("settling_3"), np.stack([decay - line, zero], 1), 1e-7),
    ):
        expected = weight @ np.sum(shift * pattern, axis=1)
        expected /= np.sqrt(weight @ np.sum(pattern**2, axis=1))
        assert rows[row] == pytest.approx(expected, abs=tolerance)
        assert abs(expected) > 1e-5


def _sampled_decay(time):
    u = (np.arange(200_000) + 0.5) / 1e5 - 1.0
    return u, np.exp(-(1.0 + u) / time)


def test_slopes_agree_with_differences():
    at = _field(1).at(1000.0)
    q = np.random.default_rng(0).uniform((-1.0, -0.75), (1.0, 0.75), (30, 2))
    for axis in (0, 1):
        step = 1e-6 * np.eye(2)[axis]
        numeric = (at.displacement(q + step) - at.displacement(q - step)) / 2e-6
        np.testing.assert_allclose(at.gradient(q)[:, :, axis], numeric, atol=1e-7)


def test_jacobian_agrees_with_differences():
    field = _field(1)
    camera = _camera(field)
    points = np.array([[0.0, 0.0, 0.0], [5e-5, -3e-5, 1e-4], [-7e-5, 4e-5, -2e-4]])
    jacobian = camera.project_jacobian(points)
    names = ("m", "aspect", "skew", "px", "py", "rho", "xi_r", "xi_t", "ex", "ey")
    for k, name in enumerate(names):
        step = 1e-6 * max(abs(getattr(camera, name)), 1e-3)
        up, down = (replace(camera, **{name: getattr(camera, name) + s}) for s in (step, -step))
        numeric = (up.project(points) - down.project(points)) / (2.0 * step)
        # Central differences: truncation and rounding stay below this.
        np.testing.assert_allclose(
            jacobian[:, :, k], numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max()
        )
    for k in (0, 41, 77, 120):
        shape = camera.residual.coefficients.shape
        step = np.zeros(shape).ravel()
        step[k] = 1e-6
        moved = [
            replace(
                camera,
                residual=replace(
                    camera.residual,
                    coefficients=camera.residual.coefficients + sign * step.reshape(shape),
                ),
            ).project(points)
            for sign in (1.0, -1.0)
        ]
        numeric = (moved[0] - moved[1]) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, 10 + k], numeric, rtol=1e-5, atol=1e-4)


def test_sigma_of_a_projection_contains_that_of_the_field():
    field = _field()
    # Only the field is uncertain: every coefficient by 0.5 px and independently.
    spread = np.eye(field.size) * (0.5 / 320.0) ** 2
    camera = replace(
        _camera(field, covariance=spread, cross=np.zeros((10, field.size))),
        covariance=np.zeros((10, 10)),
    )
    points = np.array([[5e-5, -3e-5, 0.0]])
    raw = camera.project(points)
    weights = field.weights(1000.0)
    basis = camera.residual.basis((raw - [319.5, 239.5]) / 320.0)
    each = 0.5 * np.sqrt(np.sum(weights**2) * np.sum(basis**2))
    # The displacement of a raw pixel moves its image less or more by the slope of the field.
    slope = np.linalg.inv(np.eye(2) + camera.residual.gradient((raw - [319.5, 239.5]) / 320.0)[0])
    expected = each * np.sqrt(np.sum(slope**2, axis=1))
    np.testing.assert_allclose(camera.project_sigma(points)[0], expected, rtol=1e-6)
    with pytest.raises(InvalidValueError, match="without covariance"):
        replace(camera, residual=field.at(1000.0)).project_sigma(points)


@pytest.mark.parametrize("size", [(1280, 960), (320, 240), (640, 400)])
def test_a_resized_camera_sees_the_same_field(size):
    field = _field()
    cross = np.random.default_rng(0).normal(size=(10, field.size))
    camera = replace(
        _camera(field, covariance=np.eye(field.size), cross=cross), covariance=np.eye(10)
    )
    resized = camera.resized(*size)
    points = np.array([[5e-5, -3e-5, 0.0], [-2e-5, 1e-5, 0.0]])
    s = size[0] / SIZE[0]
    shift = np.array([0.0, 0.5 * (size[1] - s * SIZE[1])])
    expected = (camera.project(points) + 0.5) * s - 0.5 + shift
    np.testing.assert_allclose(resized.project(points), expected, atol=1e-8)
    np.testing.assert_allclose(resized.project_sigma(points), s * camera.project_sigma(points))


def test_the_rectifier_follows_the_field_and_tells_fields_apart():
    rectifier = Rectifier()
    for seed in (0, 1):
        camera = _camera(_field(seed))
        drift = RasterDrift(np.array([2e-6, -1e-6]), np.zeros(2))
        for moved in (None, drift):
            map_x, map_y = rectifier.maps(SIZE, camera, moved)
            xy = np.random.default_rng(2).integers((0, 0), SIZE, (300, 2))
            truth = raw_from_output(xy.astype(float), SIZE, camera, moved, None)
            got = np.stack([map_x[xy[:, 1], xy[:, 0]], map_y[xy[:, 1], xy[:, 0]]], axis=1)
            # The rectifier's own promise.
            np.testing.assert_allclose(got, truth, atol=2e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"g_range": (0.0, 10.0)}, "magnification range"),
        ({"g_range": (20.0, 10.0)}, "magnification range"),
        ({"knots_x": np.arange(5.0)}, "knots"),
        ({"knots_y": np.array([0.0, 0, 0, 0, 2, 1, 3, 3, 3, 3])}, "knots"),
        ({"knots_x": np.full(12, np.nan)}, "knots"),
        ({"coefficients": np.zeros((1, 3, 3, 2))}, "shape"),
        ({"coefficients": np.zeros(3)}, "shape"),
    ],
)
def test_a_field_that_is_none_is_refused(changes, message):
    values = {
        name: getattr(_field(), name) for name in ("knots_x", "knots_y", "g_range", "coefficients")
    }
    with pytest.raises(InvalidValueError, match=message):
        ResidualField(**{**values, **changes})


def test_coefficients_with_gaps_are_refused():
    field = _field()
    spoiled = field.coefficients.copy()
    spoiled[0, 0, 0, 0] = np.nan
    with pytest.raises(InvalidValueError, match="gaps"):
        replace(field, coefficients=spoiled)
