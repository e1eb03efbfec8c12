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

"""Sphere fit, moving least squares, mesh."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.applications.reconstruction import fit_sphere, triangulate_cloud
from semcal_ros.applications.reconstruction.surface import fit_local_surface
from semcal_ros.core.errors import StructureError

RADIUS_M = 450e-9


def cap(count, steepest_deg, seed=0, noise_m=0.0):
    """Evenly spread points of a cap about -z (golden angle), with radial noise."""
    rng = np.random.default_rng(seed)
    z = -np.linspace(1.0, np.cos(np.radians(steepest_deg)), count)
    turn = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    directions = np.column_stack([ring * np.cos(turn), ring * np.sin(turn), z])
    return directions * (RADIUS_M + noise_m * rng.normal(size=count))[:, None]


def test_sphere_of_exact_points():
    centre = np.array([1e-6, -2e-6, 3e-7])
    fit = fit_sphere(cap(100, 60.0) + centre)
    assert fit.converged
    assert fit.radius_m == pytest.approx(RADIUS_M, rel=1e-9, abs=0.0)
    assert np.allclose(fit.centre_m, centre, atol=1e-15)


def test_sphere_beside_a_tip():
    rng = np.random.default_rng(1)
    along = rng.uniform(0.5e-6, 3e-6, 90)
    turn = rng.uniform(0.0, 2.0 * np.pi, 90)
    tip = np.column_stack([along, 70e-9 * np.cos(turn), 70e-9 * np.sin(turn)])
    fit = fit_sphere(np.concatenate([cap(200, 80.0, noise_m=2e-9), tip]))
    assert fit.radius_m == pytest.approx(RADIUS_M, abs=4.0 * fit.radius_sigma_m)
    assert fit.inliers[:200].mean() > 0.98
    assert not fit.inliers[200:].any()


def test_radius_sigma_is_the_scatter():
    pulls = [
        (fit.radius_m - RADIUS_M) / fit.radius_sigma_m
        for fit in (fit_sphere(cap(150, 70.0, seed, 3e-9)) for seed in range(40))
    ]
    # 40 pulls of unit spread have an RMS within 0.67 and 1.37 in 99.8 of 100 cases.
    assert 0.67 < np.sqrt(np.mean(np.square(pulls))) < 1.37


def test_radius_gradient_is_the_derivative():
    points = cap(60, 70.0, noise_m=3e-9)
    fit = fit_sphere(points)
    rng = np.random.default_rng(2)
    change = 1e-12 * rng.normal(size=points.shape)
    moved = fit_sphere(points + change)
    assert np.array_equal(moved.inliers, fit.inliers)
    predicted = float(np.sum(fit.radius_gradient * change))
    assert moved.radius_m - fit.radius_m == pytest.approx(predicted, rel=0.02, abs=0.0)


def test_a_plane_is_no_sphere():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.normal(size=(50, 2)) * 1e-7, np.zeros(50)])
    with pytest.raises(StructureError):
        fit_sphere(flat)


def test_moving_least_squares_smooths_and_bends():
    noise_m = 5e-9
    points = cap(600, 75.0, noise_m=noise_m)
    surface = fit_local_surface(points, points, 120e-9).orient(points)
    inner = np.arange(600) < 450  # away from the border
    error = np.linalg.norm(surface.points_m, axis=1) - RADIUS_M
    assert np.std(error[inner]) < 0.5 * noise_m
    assert abs(np.mean(error[inner])) < 0.15 * noise_m
    assert np.median(surface.curvature_1_m[inner]) * RADIUS_M == pytest.approx(1.0, abs=0.1)
    outward = points / np.linalg.norm(points, axis=1)[:, None]
    angle = np.degrees(np.arccos(np.clip(np.sum(outward * surface.normals, axis=1), -1, 1)))
    assert np.median(angle[inner]) < 3.0
    pull = error[inner] / surface.sigma_m[inner]
    assert 0.6 < np.sqrt(np.mean(pull**2)) < 1.6


def test_mesh_of_a_whole_ball_is_watertight():
    points = cap(400, 180.0)
    mesh = triangulate_cloud(points, np.zeros(3), points / RADIUS_M, np.full(400, 1e-9))
    assert mesh.watertight
    # Euler's formula for a closed surface without handles.
    assert len(mesh.faces) == 2 * 400 - 4
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    volume = np.sum(np.einsum("fi,fi->f", a, np.cross(b, c))) / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * RADIUS_M**3, rel=0.03, abs=0.0)


def test_mesh_is_open_where_nothing_was_seen():
    points = cap(300, 75.0)
    mesh = triangulate_cloud(points, np.zeros(3), points / RADIUS_M, np.full(300, 1e-9))
    assert not mesh.watertight
    edge = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    length = np.linalg.norm(np.diff(mesh.vertices_m[edge], axis=1)[:, 0], axis=1)
    # No triangle spans the unseen side.
    assert length.max() < 0.35 * RADIUS_M
    # One border: V - E + F = 1.
    assert len(mesh.faces) == 2 * len(mesh.vertices_m) - 2 - mesh.boundary_edges
