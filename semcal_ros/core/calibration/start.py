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

"""From views and nominal values to a first state, coarse to fine.

Corners start as uncertain as a plane under a perspective leaves them: what they show besides is the distortion, which
the model does not have yet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import MEDIAN_CHI2_2
from semcal_ros.core.calibration.estimator.adjustment import SMOOTH, refit_functions
from semcal_ros.core.calibration.estimator.blocks import GRID_NAMES, MISS_NAMES, State
from semcal_ros.core.calibration.estimator.poses import (
    COARSE,
    adjust,
    refine_coarsely,
    resolve_mirrored_tilts,
    right_way_up,
    thin_view,
)
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.estimator.problem import (
    Functions,
    build_problem,
    constant_functions,
    stack_coefficients,
    stack_theta,
    with_coefficients,
)
from semcal_ros.core.calibration.estimator.variance_components import (
    VarianceComponents,
    initial_components,
    update_components,
)
from semcal_ros.core.calibration.initial_values import initial_values
from semcal_ros.core.calibration.stage import OFFSET_NAMES
from semcal_ros.core.calibration.views import add_excess_noise
from semcal_ros.core.camera.plane_geometry import fit_homography

__all__ = [
    "Start",
    "adapt_priors",
    "add_shared_unknowns",
    "measure_misfit_px",
    "start",
    "tempered",
    "with_excess",
]

# Updates of the variance components before anything is selected: they have to be near only, since every later
# adjustment updates them again.
_FIRST_UPDATES = 4
# Largest start of rho, 1/m. The depth gradient of weakly tilted views is noisy, and a pivot nearer
# than 5 mm would be noise.
_MAX_START_RHO = 200.0


def adapt_priors(setup: Setup) -> Setup:
    """Return the setup with priors of a photographic lens where the perspective is that strong."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    if not start.wide:
        return setup
    return replace(setup, priors=setup.priors.of_wide_views(start.rho))


def add_shared_unknowns(setup: Setup) -> Setup:
    """Return the setup with the unknowns of the grid, of the tilt axis and of the stage.

    A photograph has none of them: its priors (see :func:`adapt_priors`) are those of a lens.
    """
    if setup.priors.is_wide:
        return setup
    squares = tuple(f"square_{k}" for k in range(1, len(setup.squares_m)))
    stage = OFFSET_NAMES if any(v.has_stage_tilt for v in setup.views) else ()
    return replace(setup, shared=(*GRID_NAMES, *squares, *MISS_NAMES, *stage))


def measure_misfit_px(setup: Setup) -> float:
    """Return by how much the worst view departs from a plane under a perspective, 1-sigma per axis in px, beyond the
    sigmas of its corners.

    Where every corner is believed to its own noise while lens and scan are not known yet, poses, pivot and grid take
    their place, and no prior counts. An adjustment therefore starts from corners that are as uncertain as that.
    """
    worst = 0.0
    for view in setup.views:
        ones = np.ones((len(view.board_xy_m), 1))
        seen = np.hstack([view.board_xy_m, ones]) @ fit_homography(view.board_xy_m, view.image_xy).T
        square = np.sum((view.image_xy - seen[:, :2] / seen[:, 2:]) ** 2, axis=1)
        variance = float(np.median(square)) / MEDIAN_CHI2_2 - float(np.median(view.sigma_px)) ** 2
        worst = max(worst, variance)
    return float(np.sqrt(worst))


def with_excess(setup: Setup, sigma_px: float) -> Setup:
    """Return the setup with corners that are more uncertain by ``sigma_px`` per axis."""
    if sigma_px == 0.0:
        return setup
    return replace(setup, views=add_excess_noise(setup.views, sigma_px))


def tempered(setup: Setup, sigma_px: float) -> Setup:
    """Return the setup with observations, of corners and of the stage, that are believed less by the same factor."""
    noisy = with_excess(setup, sigma_px)
    own = np.concatenate([view.own_variance_share for view in noisy.views])
    return replace(noisy, tempering=float(np.median(own)) ** -0.5)


def _fit_start(setup: Setup) -> tuple[Functions, State, VarianceComponents]:
    """Fit moderately flexible functions, poses and variance components from nominal values."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    rho = start.rho if start.wide else min(max(start.rho, 0.0), _MAX_START_RHO)
    functions: Functions = constant_functions(setup, {"scale": start.scale_factor, "rho": rho})
    spread = initial_components(setup)
    problem = build_problem(setup, functions, setup.views, spread)
    theta = np.concatenate([stack_coefficients(functions), setup.shared_start()])
    state = State(theta, start.rotations, start.translations_m)
    state, _ = resolve_mirrored_tilts(problem, state)

    size = min(3, max(1, len(setup.magnifications) - 1))
    functions = refit_functions(functions, dict.fromkeys(SMOOTH, ("chebyshev_log", size)))
    problem = build_problem(setup, functions, setup.views, spread)
    state = replace(state, theta=stack_theta(setup, functions, state))
    result = adjust(problem, state, tolerance=COARSE)
    result = right_way_up(setup, functions, problem, result)
    for _ in range(_FIRST_UPDATES):
        # Before anything is selected: too wide a prior of the heights would let them imitate the
        # scale.
        spread = update_components(setup, problem, result)
        problem = build_problem(setup, functions, setup.views, spread)
        result = refine_coarsely(problem, result.state)
    return with_coefficients(functions, result.state.theta), result.state, spread


@dataclass(frozen=True)
class Start:
    """Where a fit starts.

    Attributes
    ----------
    setup
        The views as they were observed.
    tempered
        The same with corners that are as uncertain as the model.
    functions, state, spread
        Moderately flexible functions, poses and variance components.
    """

    setup: Setup
    tempered: Setup
    functions: Functions
    state: State
    spread: VarianceComponents


def start(setup: Setup) -> Start:
    """Fit poses and a camera that hardly depends on the magnification, to a part of the corners."""
    start_px = measure_misfit_px(setup)
    noisy = tempered(setup, start_px)
    if start_px > 0.0:
        # What a stage says wrongly must not lead poses astray that are so uncertain.
        noisy = replace(noisy, tempering=np.inf)
    thin = replace(noisy, views=tuple(thin_view(v) for v in noisy.views))
    return Start(setup, noisy, *_fit_start(thin))
