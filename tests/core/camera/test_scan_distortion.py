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

"""Distortion along the axes of the raster, and the further terms of the lens: known answers, inverses, derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from semcal_ros.core.camera.projection import ALL_NAMES, PARAMETER_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_distortion import (
    ALONG_COUNT,
    SCAN_NAMES,
    SETTLING,
    Raster,
    deflection_shift,
    deflection_stretch,
    linearise_scan,
    raw_from_deflection,
    scan_functions,
)
from semcal_ros.core.camera.thresholds import SETTLING_TIMES

# The middle is at (255.5, 191.5), the borders at -0.5 and 511.5, and at -0.5 and 383.5.
SIZE = (512, 384)
RASTER = Raster.of(*SIZE)
PLAIN = ScanCamera(1000.0, 4e6, 1.0, 0.0, 255.5, 191.5, 50.0, 0.0, 0.0, 255.5, 191.5, 256.0, *SIZE)
# Up to 1.5 px of each coil and 0.8 px of each decay, and spiral and decentring of some px.
TERMS = {
    name: (-1.0) ** k * (0.006 if "coil" in name else 0.003)
    for k, name in enumerate(ALL_NAMES[len(PARAMETER_NAMES) :])
}
COUNT = len(SCAN_NAMES)
BENT = replace(
    PLAIN, aspect=1.02, skew=0.01, px=240.0, py=202.0, xi_r=0.04, xi_t=-0.01, ex=230.0, ey=171.0
)
WHOLE = replace(BENT, **TERMS)
POINTS = np.random.default_rng(5).uniform((-5e-5, -3e-5, -3e-4), (5e-5, 3e-5, 3e-4), (40, 3))

# The slopes of the polynomials add up to 83 at most, or to 111 where the picture is lower than wide, and those of the
# decays to 165: with amplitudes up to these the beam never stands still.
coil, settling = st.floats(-0.004, 0.004), st.floats(-0.003, 0.003)
scan = st.tuples(*[settling if "settling" in name else coil for name in SCAN_NAMES]).map(np.array)
pixels = st.lists(
    st.tuples(st.floats(-20.0, 530.0), st.floats(-20.0, 400.0)), min_size=1, max_size=20
).map(np.array)


def amplitudes(**values: float) -> np.ndarray:
    return np.array([values.get(name, 0.0) for name in SCAN_NAMES])


# -- sign and meaning -----------------------------------------------------------------------------


def test_a_coil_of_third_order_known_answer():
    """P3 is 1 at the right border, -1 at the left one, -7/16 halfway between the middle and the right border."""
    own = amplitudes(coil_x3=0.01)
    raw = np.array([[511.5, 10.0], [-0.5, 10.0], [383.5, 10.0], [255.5, 10.0]])
    shift = np.array([[2.56, 0.0], [-2.56, 0.0], [-1.12, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(deflection_shift(raw, own, RASTER), shift, atol=1e-12)
    # What lies 2.56 px beyond the right border is scanned at it: a camera shows it nearer to the middle.
    camera = replace(PLAIN, coil_x3=0.01)
    np.testing.assert_allclose(camera.undistort(raw), raw + shift, atol=1e-9)
    np.testing.assert_allclose(camera.distort(raw + shift), raw, atol=1e-9)
    assert camera.distort([[511.5, 10.0]])[0, 0] < 511.5


@pytest.mark.parametrize(("order", "value"), [(2, 1.0), (3, -1.0), (4, 1.0), (5, -1.0)])
def test_coils_across_the_lines_are_in_half_widths_as_those_along_them(order, value):
    """All Legendre polynomials are 1 at the lower border, and 1 or -1 at the upper one."""
    own = amplitudes(**{f"coil_y{order}": 0.01})
    raw = np.array([[10.0, 383.5], [10.0, -0.5]])
    shift = deflection_shift(raw, own, RASTER)
    np.testing.assert_allclose(shift, [[0.0, 2.56], [0.0, 2.56 * value]], atol=1e-12)
    assert replace(PLAIN, **{f"coil_y{order}": 0.01}).undistort(raw[:1])[0, 1] == pytest.approx(
        386.06
    )


@pytest.mark.parametrize("number", range(1, len(SETTLING_TIMES) + 1))
def test_settling_known_answer(number):
    """The decay is 1 at the start of the line; its best straight line over the picture is taken out."""
    time = SETTLING_TIMES[number - 1]

    def decay(u):
        return np.exp(-(1.0 + u) / time)

    mean = quad(decay, -1.0, 1.0, epsabs=1e-13)[0] / 2.0
    slope = quad(lambda u: u * decay(u), -1.0, 1.0, epsabs=1e-13)[0] * 1.5
    u = np.array([-1.0, -0.9, 0.0, 1.0])
    raw = np.stack([255.5 + 256.0 * u, np.full(4, 77.0)], axis=1)
    shift = deflection_shift(raw, amplitudes(**{f"settling_{number}": 0.01}), RASTER)
    np.testing.assert_allclose(shift[:, 0], 2.56 * (decay(u) - mean - slope * u), atol=1e-9)
    np.testing.assert_array_equal(shift[:, 1], 0.0)
    # A positive amplitude: the first columns show what lies farther to the right.
    assert shift[0, 0] > 1.0 > abs(shift[2, 0])
    camera = replace(PLAIN, **{f"settling_{number}": 0.01})
    assert camera.distorts_scan
    assert camera.distort([[1.0, 77.0]])[0, 0] < 0.5


def test_the_slowest_decay_takes_48_columns_of_512_and_each_other_one_half_of_the_next():
    columns = 256.0 * np.array(SETTLING_TIMES)
    np.testing.assert_allclose(columns[::-1], 48.0 / 2.0 ** np.arange(len(columns)), rtol=2e-3)
    assert SCAN_NAMES[SETTLING] == tuple(f"settling_{k + 1}" for k in range(len(columns)))


def test_spiral_known_answer():
    camera = replace(PLAIN, xi_s=0.01)
    # q = (1, 0) and (0, 0.5): xi_s r2 (-q_y, q_x) = 0.01 (0, 1) and 0.01 / 4 (-0.5, 0); y points down.
    raw = camera.distort([[511.5, 191.5], [255.5, 319.5]])
    np.testing.assert_allclose(raw, [[511.5, 194.06], [255.5 - 0.32, 319.5]], atol=1e-9)


def test_decentring_along_the_other_diagonal_known_answer():
    camera = replace(PLAIN, xi_u=0.01)
    # q = (1, 0): xi_u (1, -1) (r2 + 2 q*q) = 0.01 (3, -1)
    raw = camera.distort([[511.5, 191.5]])
    np.testing.assert_allclose(raw, [[511.5 + 7.68, 191.5 - 2.56]], atol=1e-9)
    # The coefficients along both diagonals make one along any direction: here along x alone.
    both = replace(PLAIN, xi_t=0.005, xi_u=0.005)
    np.testing.assert_allclose(both.distort([[511.5, 191.5]]), [[519.18, 191.5]], atol=1e-9)


def test_the_products_of_both_coordinates_known_answer():
    # q = (0.5, -0.25): 2 q_x q_y is -0.25.
    along = replace(PLAIN, xi_v=0.01).distort([[383.5, 127.5]])
    np.testing.assert_allclose(along, [[383.5 - 0.64, 127.5 - 0.64]], atol=1e-9)
    across = replace(PLAIN, xi_w=0.01).distort([[383.5, 127.5]])
    np.testing.assert_allclose(across, [[383.5 - 0.64, 127.5 + 0.64]], atol=1e-9)


def test_the_radial_distortion_of_the_fifth_order_known_answer():
    # q = (0.5, -0.5): r2 is 0.5, and xi_r4 r2^2 q is 0.01 / 4 (0.5, -0.5).
    raw = replace(PLAIN, xi_r4=0.01).distort([[383.5, 63.5]])
    np.testing.assert_allclose(raw, [[383.5 + 0.32, 63.5 - 0.32]], atol=1e-9)


@pytest.mark.parametrize("displaced", [(0.003, 0.0), (0.0, -0.002), (0.001, 0.004)])
def test_decentring_has_the_form_of_brown_in_any_direction(displaced):
    """Brown 1966, with the displacement d: d r2 + 2 q (q . d)."""
    d = np.array(displaced)
    xi_t, xi_u = 0.5 * d.sum(), 0.5 * (d[0] - d[1])
    camera = replace(PLAIN, xi_t=xi_t, xi_u=xi_u, xi_v=xi_t, xi_w=-xi_u)
    xy = np.random.default_rng(0).uniform(0.0, 511.0, (50, 2))
    q = (xy - [PLAIN.ex, PLAIN.ey]) / PLAIN.norm_px
    brown = d * np.sum(q * q, axis=1)[:, None] + 2.0 * q * (q @ d)[:, None]
    moved = camera.distort(xy) - PLAIN.distort(xy)
    np.testing.assert_allclose(moved, PLAIN.norm_px * brown, atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1])
def test_functions_have_no_constant_and_no_straight_line(axis):
    """So shift, scale and rotation of the picture are not theirs."""
    # Gauss: the fastest decay falls by e^-170 over the picture.
    nodes, weights = np.polynomial.legendre.leggauss(200)
    values = scan_functions(nodes, axis)
    assert len(values) == (ALONG_COUNT, len(SCAN_NAMES) - ALONG_COUNT)[axis]
    np.testing.assert_allclose(values @ weights, 0.0, atol=1e-12)
    np.testing.assert_allclose(values @ (nodes * weights), 0.0, atol=1e-12)


def test_beyond_the_picture_the_functions_go_on_as_straight_lines():
    for axis in (0, 1):
        end = scan_functions(np.array([1.0 - 1e-6, 1.0, 1.5, 2.0]), axis)
        np.testing.assert_allclose(end[:, 3] - end[:, 2], end[:, 2] - end[:, 1], atol=1e-12)
        slope = (end[:, 1] - end[:, 0]) / 1e-6
        np.testing.assert_allclose(2.0 * (end[:, 2] - end[:, 1]), slope, rtol=1e-3, atol=1e-4)


# -- inverse and derivatives ----------------------------------------------------------------------


@given(pixels, scan)
def test_the_raw_pixel_of_a_deflection_is_where_it_came_from(raw, own):
    deflection = raw + deflection_shift(raw, own, RASTER)
    # Rounding of coordinates of some hundred px, times the inverse of the least slope.
    np.testing.assert_allclose(raw_from_deflection(deflection, own, RASTER), raw, atol=1e-9)


@given(pixels, scan)
def test_the_deflection_of_a_raw_pixel_is_what_was_asked_for(deflection, own):
    raw = raw_from_deflection(deflection, own, RASTER)
    np.testing.assert_allclose(raw + deflection_shift(raw, own, RASTER), deflection, atol=1e-9)


def test_each_point_may_have_its_own_amplitudes():
    rng = np.random.default_rng(2)
    xy, table = rng.uniform(0.0, 380.0, (30, 2)), rng.uniform(-0.003, 0.003, (30, COUNT))
    shift = np.vstack(
        [deflection_shift(xy[k : k + 1], table[k], RASTER) for k in range(len(table))]
    )
    np.testing.assert_allclose(deflection_shift(xy, table, RASTER), shift, atol=1e-12)
    raw = np.vstack(
        [raw_from_deflection(xy[k : k + 1], table[k], RASTER) for k in range(len(table))]
    )
    np.testing.assert_allclose(raw_from_deflection(xy, table, RASTER), raw, atol=1e-9)


def test_derivatives_agree_with_differences():
    own = np.array([TERMS[name] for name in SCAN_NAMES])
    # Away from the borders, where the second derivative has a step.
    raw = np.random.default_rng(0).uniform((0.0, 0.0), (511.0, 383.0), (80, 2))
    found = linearise_scan(raw, own, RASTER)
    # Sums of the same terms in another order.
    np.testing.assert_allclose(deflection_stretch(raw, own, RASTER), found.stretch.T, rtol=1e-13)
    for axis in (0, 1):
        step = 1e-3 * np.eye(2)[axis]
        up, down = (raw + s + deflection_shift(raw + s, own, RASTER) for s in (step, -step))
        numeric = (up - down) / 2e-3
        # The third derivative of the fastest decay, which takes 3 columns, and the square of the step.
        np.testing.assert_allclose(found.stretch[axis], numeric[:, axis], atol=1e-8)
        np.testing.assert_allclose(numeric[:, 1 - axis], 0.0, atol=1e-9)
    for k in range(len(SCAN_NAMES)):
        # The deflection is linear in the amplitudes.
        change = deflection_shift(raw, own + np.eye(COUNT)[k], RASTER) - deflection_shift(
            raw, own, RASTER
        )
        axis = 0 if k < ALONG_COUNT else 1
        np.testing.assert_allclose(found.basis[k], change[:, axis], atol=1e-9)
        np.testing.assert_allclose(change[:, 1 - axis], 0.0, atol=1e-9)


def test_without_amplitudes_a_pixel_is_its_deflection():
    xy = np.random.default_rng(0).uniform(0.0, 380.0, (5, 2))
    np.testing.assert_array_equal(deflection_shift(xy, np.zeros(COUNT), RASTER), 0.0)
    np.testing.assert_array_equal(deflection_stretch(xy, np.zeros(COUNT), RASTER), 1.0)
    np.testing.assert_array_equal(raw_from_deflection(xy, np.zeros(COUNT), RASTER), xy)


def test_a_deflection_without_a_raw_pixel_is_nan():
    # u - 0.4 P2(u) = u - 0.6 u^2 + 0.2 turns back at u = 5 / 6, where it is 0.617.
    own = amplitudes(coil_x2=-0.4)
    at = 255.5 + 256.0 * np.array([0.0, 0.55, 0.65, 0.9])
    deflection = np.stack([at, np.full(4, 100.0)], axis=1)
    raw = raw_from_deflection(deflection, own, RASTER)
    assert np.isfinite(raw[:, 0]).tolist() == [True, True, False, False]
    known = raw[:2]
    np.testing.assert_allclose(
        known + deflection_shift(known, own, RASTER), deflection[:2], atol=1e-9
    )
    camera = replace(PLAIN, coil_x2=-0.4)
    assert np.isnan(camera.distort(deflection)).any(axis=1).tolist() == [False, False, True, True]
    # Points without a raw pixel have no derivative, those with one have.
    jacobian = camera.project_jacobian(camera.sem_from_ideal(deflection))
    finite = np.isfinite(jacobian).all(axis=(1, 2))
    assert finite.tolist() == [True, True, False, False]


# -- cameras --------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.floats(0, 511), st.floats(0, 383)), min_size=1, max_size=20), scan)
def test_undistorting_reverts_distorting_with_all_terms(points, own):
    raw = np.array(points)
    camera = replace(WHOLE, **dict(zip(SCAN_NAMES, own.tolist(), strict=True)))
    ideal = camera.undistort(raw)
    assert np.isfinite(ideal).all()
    np.testing.assert_allclose(camera.distort(ideal), raw, atol=1e-8)
    np.testing.assert_allclose(camera.undistort(camera.distort(ideal)), ideal, atol=1e-8)


def test_the_scan_distorts_what_the_lens_shows():
    """First the lens, then the raster: undistorting takes them off in the reverse order."""
    assert WHOLE.distorts_scan
    assert not BENT.distorts_scan
    own = np.array([TERMS[name] for name in SCAN_NAMES])
    lens = replace(WHOLE, **dict.fromkeys(SCAN_NAMES, 0.0))
    xy = np.random.default_rng(1).uniform((0.0, 0.0), (511.0, 383.0), (30, 2))
    expected = raw_from_deflection(lens.distort(xy), own, RASTER)
    np.testing.assert_allclose(WHOLE.distort(xy), expected, atol=1e-10)
    deflection = xy + deflection_shift(xy, own, RASTER)
    np.testing.assert_allclose(WHOLE.deflect(xy), deflection, atol=1e-10)
    np.testing.assert_allclose(WHOLE.undistort(xy), lens.undistort(deflection), atol=1e-9)


@pytest.mark.parametrize("size", [(1024, 768), (256, 192), (512, 512), (512, 300), (700, 211)])
def test_another_image_size_shows_the_same_field(size):
    sigmas = np.full(len(ALL_NAMES), 1e-3)
    sigmas[:10] = 2e4, 0.003, 0.002, 4.0, 5.0, 2.0, 2e-3, 1e-3, 3.0, 4.0
    camera = replace(WHOLE, covariance=np.diag(sigmas**2))
    resized, s = camera.resized(*size), size[0] / SIZE[0]
    shift = np.array([0.0, 0.5 * (size[1] - s * SIZE[1])])
    expected = (camera.project(POINTS) + 0.5) * s - 0.5 + shift
    np.testing.assert_allclose(resized.project(POINTS), expected, atol=1e-8)
    np.testing.assert_allclose(resized.project_sigma(POINTS), s * camera.project_sigma(POINTS))
    back = resized.resized(*SIZE)
    np.testing.assert_allclose(back.project(POINTS), camera.project(POINTS), atol=1e-8)
    raw = np.random.default_rng(0).uniform((0.0, 0.0), (511.0, 383.0), (20, 2))
    np.testing.assert_allclose(
        resized.deflect((raw + 0.5) * s - 0.5 + shift),
        (camera.deflect(raw) + 0.5) * s - 0.5 + shift,
        atol=1e-9,
    )


def test_a_camera_has_the_terms_that_it_needs():
    assert BENT.names == PARAMETER_NAMES
    assert len(BENT.parameters) == 10
    assert WHOLE.names == ALL_NAMES == (*PARAMETER_NAMES, *TERMS)
    np.testing.assert_array_equal(WHOLE.parameters[:10], BENT.parameters)
    np.testing.assert_array_equal(WHOLE.parameters[10:], list(TERMS.values()))
    # One term is enough, and so is a covariance with all: the terms may be zero at some magnification.
    assert replace(BENT, settling_3=0.001).names == ALL_NAMES
    assert replace(BENT, covariance=np.eye(len(ALL_NAMES))).names == ALL_NAMES
    assert replace(BENT, covariance=np.eye(10)).names == PARAMETER_NAMES
    np.testing.assert_array_equal(BENT.all_parameters[10:], 0.0)


def test_the_matrices_know_nothing_of_the_distortion():
    for name in ("P_affine", "P", "K", "pixel_size_m"):
        np.testing.assert_array_equal(getattr(WHOLE, name), getattr(BENT, name))
    covariance = np.diag(np.linspace(1.0, 2.0, len(ALL_NAMES)))
    np.testing.assert_array_equal(
        replace(WHOLE, covariance=covariance).P_affine_covariance,
        replace(BENT, covariance=covariance[:10, :10]).P_affine_covariance,
    )
    np.testing.assert_array_equal(WHOLE.rectified.P_affine, BENT.rectified.P_affine)


@pytest.mark.parametrize("name", TERMS)
def test_terms_that_are_not_finite_are_refused(name):
    with pytest.raises(ValueError, match="finite"):
        replace(PLAIN, **{name: float("nan")})
