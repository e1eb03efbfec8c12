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

"""Bundle adjustment: the Schur-reduced solution equals the dense one, and outliers do not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.estimator.blocks import State, make_problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import refine, variance_factor
from semcal_ros.core.calibration.estimator.residuals import corner_residuals
from semcal_ros.core.calibration.stage import height_of_tilt
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.scan_distortion import Raster
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import grid_views

MICROSCOPE = preset("jsm820")
GS = np.array([200.0, 800.0])


def _problem(noise_px, views=None, height_sigma_m=4e-5):
    """Two magnifications, each with its own camera: theta holds both parameter vectors, relative to the truth."""
    cameras = np.stack([MICROSCOPE.camera_at(g).parameters for g in GS])
    designs = np.zeros((2, 10, 20))
    for k in range(2):
        designs[k, :, 10 * k : 10 * k + 10] = np.diag(np.where(cameras[k] == 0, 1.0, cameras[k]))
    views = views or grid_views(MICROSCOPE.camera_at, GS, noise_px=noise_px, seed=1)
    return make_problem(
        views,
        GS,
        designs,
        raster=Raster.of(512, 512),
        nominal_px_per_m=cameras[:, 0],
        prior_mean=np.ones(20),
        prior_sigma=np.full(20, 0.2),
        height_sigma_m=height_sigma_m,
    )


def _true_poses(seed=1):
    """The poses that ``grid_views`` draws, recovered by fitting them with the true cameras."""
    from semcal_ros.core.calibration.judgement.evaluate import fit_poses

    clean = grid_views(MICROSCOPE.camera_at, GS, seed=seed)
    return fit_poses(clean, MICROSCOPE.camera_at, height_sigma_m=1.0)


@pytest.fixture(scope="module")
def poses():
    return _true_poses()


def test_noise_free_views_are_explained_exactly(poses):
    # Pose fits end where another step would change the cost by 1e-9 of it.
    assert poses.rms_px() < 1e-4
    problem = _problem(0.0, height_sigma_m=10.0)
    result = refine(problem, State(np.ones(20), poses.rotations, poses.translations_m))
    assert result.converged
    assert result.rms_px() < 1e-4


def test_start_away_from_the_truth_converges_to_it(poses):
    problem = _problem(0.05)
    truth = refine(problem, State(np.ones(20), poses.rotations, poses.translations_m))
    rng = np.random.default_rng(0)
    turned = rotations_from_vectors(rng.normal(scale=0.02, size=(8, 3))) @ poses.rotations
    theta = np.ones(20)
    theta[[0, 10]] = 1.02
    theta[[6, 7, 16, 17]] = 0.0
    result = refine(
        problem, State(theta, turned, poses.translations_m + rng.normal(size=(8, 3)) * 1e-6)
    )
    assert result.converged
    assert result.cost == pytest.approx(truth.cost, rel=1e-6)


def test_covariance_equals_that_of_the_full_system(poses):
    """Eliminating the poses must not change the covariance of theta: compare with a dense numerical Jacobian.

    Every corner has a covariance of its own, with correlated axes.
    """
    rng = np.random.default_rng(5)
    views = []
    for view in grid_views(MICROSCOPE.camera_at, GS, seed=1):
        root = 0.05 * (np.eye(2) + rng.uniform(-0.4, 0.4, (len(view.image_xy), 2, 2)))
        noise = np.einsum("nij,nj->ni", root, rng.normal(size=view.image_xy.shape))
        spread = root @ np.swapaxes(root, 1, 2)
        views.append(replace(view, image_xy=view.image_xy + noise, covariance_px2=spread))
    inverse_roots = np.linalg.inv(
        np.linalg.cholesky(np.concatenate([v.covariance_px2 for v in views]))
    )
    problem = _problem(0.05, views)
    result = refine(problem, State(np.ones(20), poses.rotations, poses.translations_m))
    state, n_views = result.state, len(problem.group)
    # Huber weights are 1 for practically all corners of Gaussian noise; make it exact.
    assert result.huber_weight.min() > 0.7

    def whitened(x):
        shift = x[20:].reshape(n_views, 6)
        moved = State(
            state.theta + x[:20],
            rotations_from_vectors(shift[:, :3]) @ state.rotations,
            state.translations_m + shift[:, 3:] * problem.unit_m[:, None],
        )
        rows = np.einsum("nij,nj->ni", inverse_roots, corner_residuals(problem, moved))
        rows *= np.sqrt(result.huber_weight)[:, None]
        height, _, _ = height_of_tilt(
            np.zeros(n_views), moved.rotations, moved.translations_m, np.zeros(3)
        )
        height = height / problem.height_sigma_m
        prior = (moved.theta - problem.prior_mean) / problem.prior_sigma
        return np.concatenate([rows.ravel(), height, prior])

    size = 20 + 6 * n_views
    steps = np.full(size, 1e-6)
    columns = []
    for k in range(size):
        delta = np.zeros(size)
        delta[k] = steps[k]
        columns.append((whitened(delta) - whitened(-delta)) / (2 * steps[k]))
    jacobian = np.stack(columns, axis=1)
    dense = np.linalg.inv(jacobian.T @ jacobian)
    expected = np.sqrt(np.diag(dense)[:20])
    np.testing.assert_allclose(np.sqrt(np.diag(result.covariance)), expected, rtol=2e-3)
    rows = jacobian[2 * len(problem.board_m) :][:n_views]
    np.testing.assert_allclose(
        result.prior_variance["height"][:, 0], np.diag(rows @ dense @ rows.T), rtol=5e-3
    )


def test_outliers_lose_their_weight(poses):
    views = grid_views(MICROSCOPE.camera_at, GS, noise_px=0.05, seed=1)
    clean = refine(_problem(0.05, views), State(np.ones(20), poses.rotations, poses.translations_m))
    spoiled = list(views)
    wrong = views[3].image_xy.copy()
    wrong[:2] += [15.0, -9.0]
    spoiled[3] = replace(views[3], image_xy=wrong)
    result = refine(
        _problem(0.05, spoiled), State(np.ones(20), poses.rotations, poses.translations_m)
    )
    start = result.residuals_px.shape[0] - sum(len(v.image_xy) for v in views[3:])
    assert result.huber_weight[start : start + 2].max() < 0.05
    sigma = np.sqrt(np.diag(clean.covariance))
    # Two gross errors among some 100 corners of a view move no parameter by more than its own uncertainty.
    assert np.all(np.abs(result.state.theta - clean.state.theta) < 1.5 * sigma)


def _mean_square_over_stated(poses, outliers):
    """Of 60 draws of the noise, with some corners wrong by 30 sigmas: the errors of theta over what is stated."""
    clean = grid_views(MICROSCOPE.camera_at, GS, seed=1)
    start = State(np.ones(20), poses.rotations, poses.translations_m)
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        views = []
        for view in clean:
            xy = view.image_xy + rng.normal(0.0, 0.05, view.image_xy.shape)
            angle = rng.uniform(-np.pi, np.pi, len(xy))
            wrong = 1.5 * (rng.uniform(size=len(xy)) < outliers)
            xy += wrong[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            views.append(replace(view, image_xy=xy, sigma_px=np.full(len(xy), 0.05)))
        problem = _problem(0.05, views)
        result = refine(problem, start)
        variance = np.diag(result.covariance) * variance_factor(problem, result)
        squares.append((result.state.theta - 1.0) ** 2 / variance)
    return np.mean(squares, axis=0)


@pytest.mark.long
def test_outliers_widen_the_covariance_as_much_as_they_scatter_the_estimate(poses):
    # Some unknowns hang on priors, of heights and of their own, which do not scatter here: clean corners are the
    # measure.
    clean, spoiled = _mean_square_over_stated(poses, 0.0), _mean_square_over_stated(poses, 0.03)
    determined = clean > 0.5
    assert determined.sum() >= 8
    # 1-sigma of the ratio is 0.1: some independent unknowns, each drawn 60 times. The mean square of the weighted
    # residuals would make the covariance twice as large as it should be, and the ratio a half.
    assert np.mean(spoiled[determined]) / np.mean(clean[determined]) == pytest.approx(1.0, abs=0.3)


def test_fixed_theta_moves_only_the_poses(poses):
    problem = _problem(0.05)
    theta = np.full(20, 1.001)
    result = refine(problem, State(theta, poses.rotations, poses.translations_m), fixed_theta=True)
    assert result.converged
    np.testing.assert_array_equal(result.state.theta, theta)


def test_views_that_cannot_be_seen_are_no_result_and_do_not_spoil_the_others(poses):
    problem = _problem(0.05)
    far = poses.translations_m.copy()
    far[0, 2] = -1.0
    result = refine(problem, State(np.ones(20), poses.rotations, far))
    assert not result.converged
    assert set(problem.view_of_point[result.lost]) == {0}
    others = refine(problem, State(np.ones(20), poses.rotations, poses.translations_m))
    assert np.all(np.isfinite(result.covariance))
    sigma = np.sqrt(np.diag(result.covariance))
    # The same but for the corners of one view of many.
    assert np.all(np.abs(result.state.theta - others.state.theta) < 3.0 * sigma)


def test_views_are_checked():
    with pytest.raises(ValueError, match="shapes"):
        GridView(100.0, np.zeros((3, 2)), np.zeros((4, 2)), np.ones(3))
    with pytest.raises(ValueError, match="magnification"):
        GridView(0.0, np.zeros((3, 2)), np.zeros((3, 2)), np.ones(3))
    with pytest.raises(ValueError, match="not finite"):
        GridView(10.0, np.zeros((3, 2)), np.full((3, 2), np.nan), np.ones(3))
