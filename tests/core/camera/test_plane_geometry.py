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

"""Rotations, homographies and the affine start of a pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.core.camera.plane_geometry import (
    cross_matrices,
    cross_products,
    fit_homography,
    mirrored_tilt,
    rotation_from_affine,
    rotations_from_vectors,
    transform_points,
    view_affine,
)

vector = st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3).map(np.array)


@given(vector)
def test_rotation_vectors(v):
    rotation = rotations_from_vectors(v[None])[0]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation @ v, v, atol=1e-12)
    assert np.trace(rotation) == pytest.approx(1.0 + 2.0 * np.cos(np.linalg.norm(v)))


def test_rotation_about_z_turns_x_towards_y():
    rotation = rotations_from_vectors(np.array([[0.0, 0.0, np.pi / 2]]))[0]
    np.testing.assert_allclose(rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


@given(vector, vector)
def test_cross_matrices(a, b):
    np.testing.assert_allclose(cross_matrices(a[None])[0] @ b, np.cross(a, b), atol=1e-14)
    np.testing.assert_allclose(cross_products(a[None], b[None])[0], np.cross(a, b), atol=1e-14)


@given(st.floats(-3, 3), st.floats(-np.pi, np.pi), st.floats(0.02, 1.2))
def test_rotation_is_recovered_from_its_affine_view(turn, axis, tilt):
    lean = rotations_from_vectors(tilt * np.array([[np.cos(axis), np.sin(axis), 0.0]]))[0]
    rotation = lean @ rotations_from_vectors(np.array([[0.0, 0.0, turn]]))[0]
    found = rotation_from_affine(7.5 * rotation[:2, :2], rotation[2, :2])
    # At small tilts the third row is a square root of rounding errors.
    np.testing.assert_allclose(found, rotation, atol=1e-6)
    other = rotation_from_affine(7.5 * rotation[:2, :2], -rotation[2, :2])
    np.testing.assert_allclose(other, mirrored_tilt(rotation[None])[0], atol=1e-6)


def test_homography_and_its_affine_part():
    h = np.array([[3e6, 1e5, 200.0], [-2e5, 2.5e6, 300.0], [800.0, -500.0, 1.0]])
    source = np.random.default_rng(0).uniform(-5e-5, 5e-5, (30, 2))
    target = transform_points(h, source)
    np.testing.assert_allclose(fit_homography(source, target), h, rtol=1e-6, atol=1e-6)

    at = np.array([210.0, 290.0])
    affine = view_affine(source, target, at)
    step = 1e-9
    base = transform_points(h, affine.board_xy_m[None])[0]
    np.testing.assert_allclose(base, at, atol=1e-6)
    moved = transform_points(h, affine.board_xy_m + step * np.eye(2))
    np.testing.assert_allclose(affine.matrix, ((moved - base) / step).T, rtol=1e-4)
