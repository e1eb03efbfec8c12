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

from semcal_ros.core.calibration.bundle_adjustment import refine
from semcal_ros.core.calibration.joint import JointFit, fit_joint
from semcal_ros.core.calibration.priors import Priors, Setup
from semcal_ros.core.calibration.problem import build_problem, stack_coefficients, variance_factor
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.grid_views import grid_views

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


def test_the_covariance_holds_by_how_much_coefficients_that_were_left_out_would_move(
    setup: Setup, fit: JointFit
) -> None:
    adjustment = fit.adjustment
    start = stack_coefficients(fit.padded)
    problem = build_problem(setup, fit.padded, setup.views, adjustment.spread)
    freed = refine(problem, replace(adjustment.result.state, theta=start))
    factor = max(variance_factor(adjustment.problem, adjustment.result), 1.0)
    change = np.abs(freed.state.theta - start)
    sigma = np.sqrt(np.diag(fit.covariance))
    added = np.sqrt(np.maximum(np.diag(fit.covariance) - np.diag(freed.covariance) * factor, 0.0))
    clear = change > 0.6 * sigma
    assert clear.sum() >= 8
    # The covariance takes one Gauss-Newton step, the adjustment here goes to its end: they differ
    # by less than half a sigma.
    assert np.all(np.abs(added - change)[clear] < 0.5 * sigma[clear])
