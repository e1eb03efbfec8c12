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

"""How large each kind of distortion is: known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.camera.calibration_model import TERM_NAMES
from semcal_ros.core.camera.residual_field import zero_field
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.term_sizes import (
    TERM_KINDS,
    describe_term_sizes,
    displace_by,
    has_terms,
    largest_term_sizes,
    measure_along_axes,
    measure_terms,
)

# Half the width is 256 px; the first and the last pixel are 255.5 px from the middle.
PLAIN = ScanCamera(
    1000.0, 4e6, 1.0, 0.0, 255.5, 255.5, 50.0, 0.0, 0.0, 255.5, 255.5, 256.0, 512, 512
)
END = 255.5 / 256.0


def test_a_camera_without_distortion_has_none_of_any_kind():
    assert measure_terms(PLAIN) == dict.fromkeys(TERM_KINDS, 0.0)
    assert not has_terms(PLAIN)
    assert not has_terms(replace(PLAIN, xi_r=0.01, xi_t=0.01))
    assert has_terms(replace(PLAIN, coil_x2=0.001))


@pytest.mark.parametrize(
    ("changes", "kind", "expected"),
    [
        # In the corner, at q = (1, 1): r2 is 2, and q 2 / (1 + sqrt(1 - 4 xi_r r2)) is farther out.
        (
            {"xi_r": 0.01},
            "radial",
            256.0 * np.sqrt(2.0) * END * (2.0 / (1.0 + np.sqrt(1.0 - 0.08 * END**2)) - 1.0),
        ),
        # xi_r4 r2^2 q is 0.01 * 4 (1, 1).
        ({"xi_r4": -0.01}, "radial", 10.24 * np.sqrt(2.0) * END**5),
        # xi_t (r2 + 2 q*q) is 0.01 (4, 4).
        ({"xi_t": 0.01}, "decentring", 10.24 * np.sqrt(2.0) * END**2),
        ({"xi_u": -0.01}, "decentring", 10.24 * np.sqrt(2.0) * END**2),
        # Both together are along x alone.
        ({"xi_t": 0.005, "xi_u": 0.005}, "decentring", 10.24 * END**2),
        # Brown's along the diagonal: 0.01 (6, 6) in the corner.
        ({"xi_t": 0.01, "xi_v": 0.01}, "decentring", 15.36 * np.sqrt(2.0) * END**2),
        ({"xi_w": 0.01}, "decentring", 5.12 * np.sqrt(2.0) * END**2),
        # xi_s r2 (-q_y, q_x) is 0.01 * 2 (-1, 1).
        ({"xi_s": 0.01}, "spiral", 5.12 * np.sqrt(2.0) * END**3),
        # P3 and P2 are 1 at the border.
        ({"coil_x3": -0.01}, "coils", 2.56 * (2.5 * END**3 - 1.5 * END)),
        (
            {"coil_x2": 0.003, "coil_y2": 0.004},
            "coils",
            256.0 * 0.005 * (1.5 * END**2 - 0.5),
        ),
    ],
)
def test_the_largest_displacement_is_that_of_the_formula(changes, kind, expected):
    sizes = measure_terms(replace(PLAIN, **changes))
    assert sizes[kind] == pytest.approx(expected, rel=1e-9)
    assert [name for name, size in sizes.items() if size] == [kind]


@pytest.mark.parametrize("name", TERM_NAMES)
def test_every_term_is_of_a_kind(name):
    assert (
        len([size for size in measure_terms(replace(PLAIN, **{name: 0.01})).values() if size]) == 1
    )


def test_settling_is_largest_in_the_first_column():
    camera = replace(PLAIN, settling_2=0.01)
    moved = displace_by(camera, "settling", np.array([[0.0, 17.0], [100.0, 17.0]]))
    sizes = measure_terms(camera)
    assert sizes["settling"] == pytest.approx(moved[0, 0])
    assert 2.0 < moved[0, 0] < 2.56
    assert measure_along_axes(camera, "settling") == (sizes["settling"], 0.0)
    assert [name for name, size in sizes.items() if size] == ["settling"]


def test_coils_are_told_along_both_axes():
    camera = replace(PLAIN, coil_x2=0.003, coil_y2=-0.004, settling_1=0.01)
    size = 256.0 * (1.5 * END**2 - 0.5)
    assert measure_along_axes(camera, "coils") == pytest.approx((0.003 * size, 0.004 * size))


def test_the_residual_field_is_what_it_displaces():
    blank = zero_field((512, 512), (100.0, 1000.0), 1)
    ones = np.ones_like(blank.coefficients) * [0.3, -0.4] / 256.0
    camera = replace(PLAIN, residual=replace(blank, coefficients=ones).at(1000.0))
    assert measure_terms(camera)["residual field"] == pytest.approx(0.5)
    assert measure_along_axes(camera, "residual field") == pytest.approx((0.3, 0.4))


def test_all_kinds_together_are_what_the_camera_does():
    """First the lens, then the scan, then the field; to first order they add up."""
    tiny = {"xi_r": 2e-5, "xi_t": -1e-5, "xi_s": 1e-5, "xi_u": 2e-5, "xi_v": -1e-5, "xi_w": 3e-5}
    tiny |= {
        "xi_r4": -1e-5,
        "coil_x3": 1e-5,
        "coil_y2": -2e-5,
        "settling_2": 1e-5,
        "settling_4": -1e-5,
    }
    camera = replace(PLAIN, ex=240.0, ey=271.0, **tiny)
    xy = np.random.default_rng(0).uniform(0.0, 511.0, (50, 2))
    lens, scan = (
        sum(displace_by(camera, kind, xy) for kind in kinds)
        for kinds in (TERM_KINDS[:3], TERM_KINDS[3:])
    )
    np.testing.assert_allclose(camera.distort(xy) - xy, lens - scan, atol=1e-5)
    assert np.abs(lens).max() > 5e-3 < np.abs(scan).max()


def test_sizes_go_with_the_number_of_pixels():
    camera = replace(PLAIN, xi_s=0.01, coil_x3=0.01, settling_3=0.01, coil_y4=-0.004)
    sizes, larger = measure_terms(camera), measure_terms(camera.resized(2048, 2048))
    for kind in TERM_KINDS:
        # The outermost pixel lies nearer to the border.
        assert larger[kind] == pytest.approx(4.0 * sizes[kind], rel=0.05)


def test_where_the_lens_has_no_answer_does_not_count():
    # 4 xi_r r2 >= 1 in the corners.
    sizes = measure_terms(replace(PLAIN, xi_r=0.2))
    assert np.isfinite(sizes["radial"])
    assert sizes["radial"] > 50.0


def test_the_largest_over_some_cameras_is_that_of_each_kind_on_its_own():
    one, other = replace(PLAIN, xi_s=0.01), replace(PLAIN, xi_s=0.002, coil_x2=0.01)
    largest = largest_term_sizes([one, other])
    assert largest["spiral"] == measure_terms(one)["spiral"]
    assert largest["coils"] == measure_terms(other)["coils"]
    assert largest_term_sizes([]) == dict.fromkeys(TERM_KINDS, 0.0)


def test_sizes_in_words():
    sizes = {"radial": 1.84, "decentring": 0.3, "spiral": 0.0, "coils": 12.4, "settling": 0.0123}
    assert describe_term_sizes(sizes) == (
        "radial 1.8 px, decentring 0.3 px, coils 12 px, settling 0.012 px"
    )
    assert describe_term_sizes({}) == ""
