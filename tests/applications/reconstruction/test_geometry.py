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

"""Structure from tracks: epipolar geometry, factorization, metric upgrade, adjustment."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.applications.reconstruction import (
    Observations,
    Tracks,
    adjust,
    factorize,
    fit_sphere,
    mirror_structure,
    upgrade_to_metric,
)
from semcal_ros.applications.reconstruction.epipolar import fit_epipolar
from semcal_ros.applications.reconstruction.reconstruct import mirror_poses
from semcal_ros.core.errors import StructureError
from tests.helpers.structure_scenes import RADIUS_M, aligned_rms_m, ball_scene

PIXEL_M = 0.12 / 9500.0 / 2048.0


def recovered(scene, sigma_px=0.2, height_sigma_m=5e-6):
    """Structure from the tracks alone, the mirror image chosen by the truth."""
    metric = upgrade_to_metric(factorize(scene.tracks))
    seen = Observations.from_tracks(scene.tracks, scene.cameras, sigma_px)
    start = (metric.rotations, metric.translations_m, metric.points_m)
    if aligned_rms_m(metric.points_m, scene.points_m) > aligned_rms_m(
        mirror_structure(metric.rotations, metric.points_m)[1], scene.points_m
    ):
        start = mirror_poses(*start)
    done = adjust(
        seen,
        scene.cameras,
        *start,
        reference=len(scene.cameras) // 2,
        height_sigma_m=height_sigma_m,
    )
    return metric, done


def test_exact_tracks_give_the_exact_shape_in_true_scale():
    scene = ball_scene(sigma_px=0.0, views=20, points=120)
    metric, done = recovered(scene)
    assert metric.positive
    # Perspective of 1 in 50 000 over the ball is all that the factorization leaves out.
    assert metric.orthonormality < 1e-3
    # The prior of the heights holds 0.3 um of them back, 15 parts per million of the scale.
    assert aligned_rms_m(done.points_m, scene.points_m) < 2e-5 * RADIUS_M


def test_noisy_tracks_with_gaps_reach_what_their_noise_allows():
    scene = ball_scene()
    _, done = recovered(scene)
    assert done.converged
    # The residuals tell the noise that was put in.
    assert done.sigma == pytest.approx(1.0, abs=0.05)
    error = aligned_rms_m(done.points_m, scene.points_m)
    stated = np.sqrt(np.mean(np.trace(done.point_covariance_m2, axis1=1, axis2=2)))
    # The alignment takes up six of the errors that the covariance, about a held view, contains.
    assert 0.6 * stated < error < 1.15 * stated
    # One look is wrong by 0.2 px; a point is seen some twenty times.
    assert error < 0.25 * PIXEL_M


@pytest.mark.slow
def test_the_uncertainty_of_the_diameter_is_the_scatter_over_recordings():
    pulls = []
    for seed in range(10):
        scene = ball_scene(views=16, points=120, seed=seed)
        # The scene's heights scatter by 0.3 um, those of two views about each other by 0.42 um.
        _, done = recovered(scene, height_sigma_m=0.42e-6)
        sphere = fit_sphere(done.points_m)
        sigma = 2.0 * np.sqrt(done.propagate_variance(sphere.radius_gradient))
        pulls.append((2.0 * sphere.radius_m - 2.0 * RADIUS_M) / sigma)
    # 10 pulls of unit spread have an RMS within 0.45 and 1.6 in 99.8 of 100 cases.
    assert 0.45 < np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_wrong_tracks_do_not_spoil_the_shape():
    scene = ball_scene(wrong=0.05)
    _, done = recovered(scene)
    view, point = np.nonzero(scene.tracks.seen)
    wrong = scene.wrong[view, point]
    assert np.median(done.weights[wrong]) < 0.1 < 0.6 < np.median(done.weights[~wrong])
    assert aligned_rms_m(done.points_m, scene.points_m) < 1.2e-9


def test_the_mirror_image_explains_parallel_tracks_as_well():
    scene = ball_scene(views=16, points=100)
    _, done = recovered(scene)
    seen = Observations.from_tracks(scene.tracks, scene.cameras, 0.2)
    start = mirror_poses(done.rotations, done.translations_m, done.points_m)
    other = adjust(seen, scene.cameras, *start, reference=done.reference)
    assert other.cost == pytest.approx(done.cost, rel=0.01)
    # It is another shape, not the same one seen from elsewhere.
    assert aligned_rms_m(other.points_m, scene.points_m) > 0.2 * RADIUS_M


def test_small_turns_leave_the_relief_uncertain_and_say_so():
    depth_sigma = []
    for turn in (30.0, 5.0):
        scene = ball_scene(views=16, points=120, roll_deg=turn, yaw_deg=0.5 * turn)
        _, done = recovered(scene)
        direction = done.rotations[done.reference][2]
        depth = (done.points_m - done.points_m.mean(axis=0)) @ direction
        gradient = np.outer(depth / np.sum(depth**2), direction)
        depth_sigma.append(np.sqrt(done.propagate_variance(gradient)))
    # The relief shows with the square of the turn.
    assert depth_sigma[1] > 8.0 * depth_sigma[0]


def test_views_from_one_direction_are_refused():
    scene = ball_scene(views=12, points=80, roll_deg=0.0, yaw_deg=0.0, sigma_px=0.0)
    with pytest.raises(StructureError):
        upgrade_to_metric(factorize(scene.tracks))


def test_views_without_common_points_are_refused():
    scene = ball_scene(views=12, points=80)
    seen = np.zeros_like(scene.tracks.seen)
    with pytest.raises(StructureError, match="share"):
        factorize(Tracks(scene.tracks.xy_m, seen))


def test_a_view_that_shares_nothing_stays_out():
    scene = ball_scene(views=20, points=120)
    seen = scene.tracks.seen.copy()
    seen[7] = False
    affine = factorize(Tracks(scene.tracks.xy_m, seen))
    assert not affine.views_placed[7]
    assert affine.views_placed.sum() == 19


def test_epipolar_geometry_does_not_depend_on_drift():
    scene = ball_scene(views=6, points=80)
    both = scene.tracks.seen[0] & scene.tracks.seen[3]
    first, second = (scene.tracks.xy_m[v, both] / PIXEL_M for v in (0, 3))
    still = fit_epipolar(first, second, 1.5)
    moved = fit_epipolar(first, second + np.array([300.0, -40.0]), 1.5)
    assert np.abs(still.normal @ moved.normal) == pytest.approx(1.0, abs=1e-9)
    # RMS distance in joint space is the noise of one coordinate; five parameters of it are spent.
    assert still.rms == pytest.approx(0.2, rel=0.3)
    homogeneous = [np.column_stack([xy, np.ones(len(xy))]) for xy in (first, second)]
    algebraic = np.einsum("ni,ij,nj->n", homogeneous[1], still.fundamental, homogeneous[0])
    assert np.allclose(algebraic, still.distances(first, second))


def test_robust_epipolar_geometry_finds_the_wrong_points():
    scene = ball_scene(views=6, points=800, wrong=0.2, seed=3)
    both = scene.tracks.seen[0] & scene.tracks.seen[3]
    first, second = (scene.tracks.xy_m[v, both] / PIXEL_M for v in (0, 3))
    found = fit_epipolar(first, second, 1.5)
    wrong = (scene.wrong[0] | scene.wrong[3])[both]
    # A wrong point may slide along its epipolar line; right ones are kept.
    assert np.mean(found.inliers[~wrong]) > 0.97
    assert np.mean(found.inliers[wrong]) < 0.3
