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

"""Algorithm 1 and the differential equations of appendix A, on known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from semcal_ros.core.calibration.paper.discrete import DiscreteFit, find_distortion_centre
from semcal_ros.core.calibration.paper.pda import ode_weights, pda_functions
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic.stage import grid_views

BARREL = ScanCamera(
    500.0, 2.1e6, 1.0, 0.0, 255.5, 255.5, 50.0, 0.01, 0.0, 290.0, 240.0, 256.0, 512, 512
)

# The centre does not use them.
SIGMAS = np.full(20, 0.05)


def test_radial_centre_is_the_common_epipole():
    views = grid_views(lambda g: BARREL, [500.0], views=5, noise_px=0.02)
    found = find_distortion_centre(views)
    assert not found.degenerate
    # xi_r = 0.01 moves the corner of the image by 7 px; 0.02 px noise then places the centre to a few pixels.
    np.testing.assert_allclose(found.centre_px, [290.0, 240.0], atol=6.0)
    assert found.noise_rms_px == pytest.approx(0.02 * np.sqrt(2.0), rel=0.2)
    assert found.homography_rms_px > 10 * found.noise_rms_px


def test_without_distortion_the_situation_is_degenerate():
    views = grid_views(lambda g: replace(BARREL, xi_r=0.0), [500.0], views=5, noise_px=0.02)
    found = find_distortion_centre(views)
    assert found.degenerate
    assert found.p_value > 1e-3


def test_the_papers_threshold_never_holds_with_real_noise():
    views = grid_views(lambda g: replace(BARREL, xi_r=0.0), [500.0], views=5, noise_px=0.02)
    assert not find_distortion_centre(views, tau_px=1e-3).degenerate
    assert find_distortion_centre(views, tau_px=0.1).degenerate


def test_p_values_and_noise_are_true_of_small_boards():
    """Few corners leave few degrees of freedom, and each that is counted wrongly shows."""
    rng = np.random.default_rng(0)
    board = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    exact = 60.0 * board @ [[1.0, 0.1], [-0.2, 0.9]] + 100.0
    found = []
    for _ in range(150):
        views = [
            GridView(500.0, 1e-5 * board, exact + rng.normal(scale=0.05, size=exact.shape), SIGMAS)
            for _ in range(2)
        ]
        found.append(find_distortion_centre(views))
    # Without distortion all p-values are equally frequent.
    assert stats.kstest([f.p_value for f in found], "uniform").pvalue > 0.01
    # 150 x 40 degrees of freedom tell a variance to 1.8 %.
    variance = np.mean([f.noise_rms_px**2 for f in found])
    assert variance == pytest.approx(2.0 * 0.05**2, rel=0.07)


@pytest.mark.parametrize(("scatter", "allowed"), [(3.0, 3.0), (0.2, 1.0)])
def test_a_curve_is_as_uncertain_as_its_scatter_and_at_least_as_stated(scatter, allowed):
    """A constant through values with known scatter: its variance is that of their mean."""
    count, sigma = 8, 0.01
    # Alternating by so much that their variance with n - 1 is the square of the scatter.
    values = scatter * sigma * np.sqrt((count - 1) / count) * (-1.0) ** np.arange(count)
    g = np.geomspace(100.0, 10000.0, count)
    fit = DiscreteFit(
        g, np.tile(values[:, None], (1, 10)), np.tile(sigma**2 * np.eye(10), (count, 1, 1)), (), ()
    )
    _, covariance = pda_functions(fit, legendre_degree=0)
    expected = (allowed * sigma) ** 2 / count
    np.testing.assert_allclose(covariance, expected * np.eye(10), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(
    ("weights", "solution"),
    [
        ([2.0], lambda u: np.exp(-2.0 * u)),
        ([9.0, 0.0], lambda u: np.cos(3.0 * u)),
        ([4.0, 5.0], lambda u: np.exp(-u) + 0.7 * np.exp(-4.0 * u)),
    ],
)
def test_weights_of_a_known_equation(weights, solution):
    u = np.linspace(0.0, 1.0, 401)
    found = ode_weights(u, solution(u), np.ones(401), len(weights))
    # Repeated first-order differences at the two ends of 400 steps, where the solutions are steepest, cost 10 %.
    np.testing.assert_allclose(found, weights, rtol=0.1, atol=0.05)
