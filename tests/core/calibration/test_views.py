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

"""Square sizes from how the spacing changes with the magnification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.views import GridView, assign_squares, views_from_detections
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError, InvalidValueError

SQUARES = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)


def _covariances(n, seed=0):
    root = np.random.default_rng(seed).normal(size=(n, 2, 2)) + 2.0 * np.eye(2)
    return 0.01 * root @ np.swapaxes(root, 1, 2)


def _detection(ij, xy, spacing_px, covariance_px2):
    sigma = np.sqrt(np.trace(covariance_px2, axis1=1, axis2=2) / 2.0)
    return LatticeDetection(ij, xy, sigma, spacing_px, (512, 512), covariance_px2)


def _spacings(g, squares, factor):
    return squares * g * 512 / 0.12 * factor


@pytest.mark.parametrize("factor", [1.0, 0.93, 1.3, 2.4, 0.4, 4.2])
def test_squares_are_found_under_a_wrong_display_width(factor):
    g = np.array([100.0, 500.0, 1000.0, 2500.0, 5000.0, 10000.0])
    squares = np.array([25e-6, 25e-6, 10e-6, 5e-6, 2e-6, 1e-6])
    wobble = np.array([1.0, 1.02, 0.99, 1.01, 0.98, 1.0])
    found = assign_squares(_spacings(g, squares, factor) * wobble, g * 512 / 0.12, SQUARES)
    np.testing.assert_allclose(found.square_m, squares)
    assert found.scale_factor == pytest.approx(factor, rel=0.03)
    assert found.spread < 1.05


def test_with_one_square_size_the_display_width_decides():
    g = np.array([1000.0, 1100.0])
    found = assign_squares(_spacings(g, 10e-6, 1.2), g * 512 / 0.12, SQUARES)
    np.testing.assert_allclose(found.square_m, 10e-6)
    assert found.scale_factor == pytest.approx(1.2)


def test_views_get_metres():
    ij = np.array([[i, j] for i in range(4) for j in range(3)])
    detection = _detection(ij, ij * 42.67 + 100.0, 42.67, _covariances(12))
    views, assignment = views_from_detections(
        [detection], [1000.0], display_width_m=0.12, squares_m=SQUARES, names=["a"]
    )
    # The origin is the corner nearest to the middle of the image.
    middle = ij[np.argmin(np.sum((detection.xy - 255.5) ** 2, axis=1))]
    np.testing.assert_allclose(views[0].board_xy_m, (ij - middle) * 10e-6, atol=1e-18)
    assert views[0].name == "a"
    np.testing.assert_array_equal(views[0].covariance_px2, detection.covariance_px2)
    assert assignment.square_m.tolist() == pytest.approx([10e-6])


def test_no_detections_are_refused():
    with pytest.raises(CalibrationError, match="no image"):
        views_from_detections([], [], display_width_m=0.12, squares_m=SQUARES)


def test_whitening_turns_the_covariance_into_the_unit_matrix():
    n = 20
    view = GridView(1.0, np.zeros((n, 2)), np.zeros((n, 2)), np.ones(n), "", _covariances(n))
    xx, yx, yy = view.whitening.T
    matrix = np.stack([np.stack([xx, 0 * xx], 1), np.stack([yx, yy], 1)], 1)
    unit = matrix @ view.covariance_px2 @ np.swapaxes(matrix, 1, 2)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(2), (n, 2, 2)), atol=1e-12)
    plain = replace(view, covariance_px2=None, sigma_px=np.full(n, 0.25))
    np.testing.assert_array_equal(plain.whitening, np.tile([4.0, 0.0, 4.0], (n, 1)))


def test_a_part_of_a_view_keeps_what_belongs_together():
    n = 6
    xy = np.arange(2.0 * n).reshape(n, 2)
    view = GridView(1.0, xy, 10.0 + xy, np.arange(1.0, n + 1), "a", _covariances(n))
    part = view.chosen(np.array([4, 1]))
    for name in ("board_xy_m", "image_xy", "sigma_px", "covariance_px2"):
        np.testing.assert_array_equal(getattr(part, name), getattr(view, name)[[4, 1]])


@pytest.mark.parametrize(
    "spoiled",
    [
        np.zeros((3, 2, 2)),
        -np.tile(np.eye(2), (3, 1, 1)),
        np.tile([[1.0, 2.0], [2.0, 1.0]], (3, 1, 1)),
        np.tile([[1.0, 0.5], [0.2, 1.0]], (3, 1, 1)),
        np.tile([[np.nan, 0.0], [0.0, 1.0]], (3, 1, 1)),
        np.tile(np.eye(2), (2, 1, 1)),
    ],
)
def test_a_covariance_that_is_none_is_refused(spoiled):
    with pytest.raises(InvalidValueError, match="positive definite"):
        GridView(1.0, np.zeros((3, 2)), np.zeros((3, 2)), np.ones(3), "", spoiled)
