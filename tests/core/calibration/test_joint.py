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

"""The adjustment over everything: what its covariance and its priors of the heights hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from semcal_ros.core.arrays import solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import refine, variance_factor
from semcal_ros.core.calibration.estimator.normal_equations import reduced_normal_equations
from semcal_ros.core.calibration.estimator.poses import mirror, restart_poses, right_way_up
from semcal_ros.core.calibration.estimator.posterior import estimate_changes, log_evidence
from semcal_ros.core.calibration.estimator.problem import (
    Priors,
    Setup,
    build_problem,
)
from semcal_ros.core.calibration.estimator.residuals import corner_residuals
from semcal_ros.core.calibration.estimator.thresholds import CHANGE_FALLS
from semcal_ros.core.calibration.pipeline import fit_joint
from semcal_ros.core.calibration.solve import JointFit
from semcal_ros.core.calibration.start import measure_misfit_px
from semcal_ros.core.camera.calibration_model import (
    columns_of,
    design_matrix,
    stack_coefficients,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import grid_views

JSM = preset("jsm820")
MAGNIFICATIONS = [100.0, 400.0, 1500.0, 5000.0, 10000.0]


@pytest.fixture(scope="module")
def setup() -> Setup:
    microscope = preset("jsm820")
    views = grid_views(microscope.camera_at, MAGNIFICATIONS, noise_px=0.05, views=3, seed=1)
    size, display_m = microscope.image_size, microscope.display_width_m
    return Setup(tuple(views), np.array(MAGNIFICATIONS), size, display_m, Priors())


@pytest.fixture(scope="module")
def fit(setup: Setup) -> JointFit:
    return fit_joint(setup)


def _padded(setup: Setup, fit: JointFit) -> tuple[Problem, State]:
    """The adjustment of the padded functions, whose changes are as large as they seem to be, and the end of the fit."""
    problem = build_problem(setup, fit.padded.functions, setup.views, fit.adjustment.spread)
    state = replace(fit.adjustment.result.state, theta=stack_coefficients(fit.padded.functions))
    result = refine(problem, state, max_iterations=0)
    sigma = estimate_changes(fit.padded.functions, problem, result)
    return replace(problem, prior_sigma=sigma), state


@pytest.mark.long
def test_the_covariance_holds_by_how_much_coefficients_that_were_left_out_would_move(
    setup: Setup, fit: JointFit
) -> None:
    adjustment = fit.adjustment
    start = stack_coefficients(fit.padded.functions)
    problem, state = _padded(setup, fit)
    freed = refine(problem, state)
    factor = max(variance_factor(adjustment.problem, adjustment.result), 1.0)
    change = np.abs(freed.state.theta - start)
    sigma = np.sqrt(np.diag(fit.covariance))
    added = np.sqrt(np.maximum(np.diag(fit.covariance) - np.diag(freed.covariance) * factor, 0.0))
    clear = change > 0.6 * sigma
    assert clear.sum() >= 8
    # The covariance takes one Gauss-Newton step, the adjustment here goes to its end: they differ
    # by less than half a sigma.
    assert np.all(np.abs(added - change)[clear] < 0.5 * sigma[clear])


def test_the_evidence_is_the_probability_of_the_data() -> None:
    """Of a linear model with a normal prior that is a normal distribution, whatever point the equations start from."""
    rng = np.random.default_rng(3)
    design, mean, at = rng.normal(size=(12, 4)), rng.normal(size=4), rng.normal(size=4)
    seen = rng.normal(size=12)
    found, true = [], []
    for sigma in (np.array([1.0, 0.5, 0.2, 0.1]), np.array([3.0, 1e-3, 2.0, 0.7])):
        matrix = design.T @ design + np.diag(sigma**-2.0)
        right = design.T @ (seen - design @ at) - (at - mean) / sigma**2
        found.append(log_evidence(matrix, right, at - mean, sigma))
        spread = np.eye(12) + design @ np.diag(sigma**2) @ design.T
        true.append(multivariate_normal(design @ mean, spread).logpdf(seen))
    assert np.diff(found) == pytest.approx(np.diff(true), rel=1e-9)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("kink", [False, True], ids=["smooth", "kinked"])
def test_changes_fall_as_quickly_as_those_of_the_microscope(kink: bool) -> None:
    """Functions that are nearly straight leave less open between magnifications than those with a kink."""
    magnifications = [100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0]

    def camera_at(g: float) -> ScanCamera:
        camera = JSM.camera_at(g)
        bend = abs(np.log2(g / 800.0)) if kink else 0.0
        return replace(camera, xi_r=3e-3 * (1.0 - bend), xi_t=5e-4 * bend)

    views = grid_views(camera_at, magnifications, noise_px=0.05, views=4, seed=2)
    setup = Setup(
        tuple(views), np.array(magnifications), JSM.image_size, JSM.display_width_m, Priors()
    )
    fit = fit_joint(setup)
    usual = build_problem(setup, fit.padded.functions, setup.views, fit.adjustment.spread)
    own = columns_of(fit.padded.functions)["xi_r"]
    factors = (fit.padded.problem.prior_sigma / usual.prior_sigma)[own.start + 1 : own.stop]
    fall = (factors[-1] / factors[0]) ** (1.0 / (len(factors) - 1))
    assert fall > 0.6 if kink else fall < 0.45


def test_the_part_of_the_corners_is_what_their_noise_does_and_the_parts_fit_in(
    setup: Setup, fit: JointFit
) -> None:
    """A tenth of the stated noise is added to the corners, and the scale scatters by that part of its sigma."""
    problem, start = _padded(setup, fit)
    sigma_px = np.concatenate([view.sigma_px for view in setup.views])[:, None]
    rows = np.stack(
        [design_matrix(fit.padded.functions, g, 1.0)[0] for g in (150.0, 700.0, 3000.0, 8000.0)]
    )
    rng = np.random.default_rng(0)

    def scale(noise_px: np.ndarray) -> np.ndarray:
        noisy = replace(problem, observed_px=problem.observed_px + noise_px)
        own = refine(noisy, start, max_iterations=0)
        step = reduced_normal_equations(noisy, start.theta, own.information, own.gradient)
        return np.asarray(rows @ solve_scaled(*step))

    # So little noise leaves the corners that count less as outliers the same.
    draws = [0.1 * sigma_px * rng.normal(size=problem.observed_px.shape) for _ in range(100)]
    scatter = 10.0 * np.std([scale(noise_px) for noise_px in draws], axis=0)
    stated = np.sqrt(np.einsum("gk,kl,gl->g", rows, fit.parts.corners, rows))
    # A standard deviation of 100 is good to 7 %.
    assert np.allclose(scatter, stated, rtol=0.2)
    # What is left is positive in every direction: coefficients that were left out, and by how much all would move.
    size = len(fit.parts.corners)
    rest = fit.covariance[:size, :size] - fit.parts.corners - fit.parts.visits
    for part in (fit.parts.corners, fit.parts.visits, rest):
        assert np.all(np.einsum("gk,kl,gl->g", rows, part, rows) > 0.0)


def test_what_is_mirrored_in_the_reference_plane_is_seen_at_the_same_places_and_turned_over(
    setup: Setup, fit: JointFit
) -> None:
    own = fit.adjustment
    flipped = mirror(own.functions, own.problem, own.result.state)
    np.testing.assert_allclose(
        corner_residuals(own.problem, flipped), own.result.residuals_px, rtol=0.0, atol=1e-9
    )
    wrong = refine(own.problem, flipped)
    right = right_way_up(setup, own.functions, own.problem, wrong)
    assert right.cost < wrong.cost
    # The sixth of the functions is constant.
    rho = sum(own.functions[name].size for name in list(own.functions)[:5])
    assert wrong.state.theta[rho] < 0.0 < right.state.theta[rho]


def test_a_pose_in_an_optimum_of_its_own_is_found_again(setup: Setup, fit: JointFit) -> None:
    own = fit.adjustment
    rotations = own.result.state.rotations.copy()
    # Half a turn about the normal: no small step brings it back.
    rotations[3] = rotations[3] @ np.diag([-1.0, -1.0, 1.0])
    lost = replace(own.result.state, rotations=rotations)
    found, changed = restart_poses(setup, own.problem, lost)
    assert changed >= 1
    np.testing.assert_allclose(found.rotations[3], own.result.state.rotations[3], atol=1e-3)


def test_the_misfit_of_a_start_is_the_distortion_that_a_plane_does_not_explain() -> None:
    """Less than the noise of the corners without any; 3 px of distortion leave the part that is no projection."""
    sizes = {}
    for name in ("no_distortion", "jsm820"):
        microscope = preset(name)
        views = grid_views(microscope.camera_at, MAGNIFICATIONS, noise_px=0.05, views=3, seed=1)
        sizes[name] = measure_misfit_px(
            Setup(
                tuple(views),
                np.array(MAGNIFICATIONS),
                microscope.image_size,
                microscope.display_width_m,
                Priors(),
            )
        )
    assert sizes["no_distortion"] < 0.05
    assert 0.1 < sizes["jsm820"] < 3.0


@pytest.mark.long
def test_magnifications_that_agree_make_the_prior_of_changes_about_half_as_wide() -> None:
    at_500 = JSM.camera_at(500.0)
    views = grid_views(
        lambda g: replace(at_500, magnification=g, m=at_500.m * g / 500.0),
        (500.0, 1000.0, 2000.0),
        noise_px=0.05,
        seed=1,
    )
    known = np.array([500.0, 1000.0, 2000.0])
    setup = Setup(tuple(views), known, JSM.image_size, JSM.display_width_m, Priors())
    fit = fit_joint(setup)
    usual = build_problem(setup, fit.padded.functions, setup.views, fit.adjustment.spread)
    ratios = _padded(setup, fit)[0].prior_sigma / usual.prior_sigma
    start = 0
    for name, function in fit.padded.functions.items():
        own = ratios[start : start + function.size]
        start += function.size
        # The constants, and what has no changes, keep their prior.
        assert own[0] == 1.0
        if name in ("aspect", "xi_r", "xi_t"):
            # The further ones of the lens fall, by the same factor with each order.
            fall = own[2] / own[1]
            assert min(abs(np.array(CHANGE_FALLS[1:]) / fall - 1.0)) < 1e-12 or name == "aspect"
            np.testing.assert_allclose(own[2:] / own[1:-1], fall, rtol=1e-12)
            assert fall == pytest.approx(1.0) or name != "aspect"
            # Two coefficients are determined at the most, and the usual size counts as a half.
            assert np.sqrt(0.5 / 2.5) - 1e-6 <= own[1] < 0.8
