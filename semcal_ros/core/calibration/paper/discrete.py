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

"""Calibration of each magnification on its own: Algorithm 2 of the paper (method "discrete").

Per magnification: scale and poses with zero distortion, the distortion centre by Algorithm 1, then
bundle adjustment of everything from zero distortion. Where there is no distortion, its centre is
put on the image centre and only the tangential term is estimated. Directions that one magnification
cannot determine (principal point and pivot distance at high magnification) are held by the priors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.poses import adjust, resolve_mirrored_tilts
from semcal_ros.core.calibration.estimator.priors import HELD_SIGMA, Setup
from semcal_ros.core.calibration.estimator.problem import (
    build_problem,
    constant_functions,
    stack_coefficients,
    variance_factor,
)
from semcal_ros.core.calibration.initial_values import initial_values
from semcal_ros.core.calibration.paper.distortion_centre import (
    DistortionCentre,
    find_distortion_centre,
)
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES
from semcal_ros.core.camera.continuous_function import ContinuousFunction

__all__ = ["DiscreteFit", "fit_discrete", "table_functions"]


@dataclass(frozen=True)
class DiscreteFit:
    """Separate calibrations of M magnifications.

    Attributes
    ----------
    magnifications
        (M,) ascending.
    parameters
        (M, 10) in the order of ``FUNCTION_NAMES``.
    covariances
        (M, 10, 10).
    centres
        Result of Algorithm 1 at each magnification.
    results
        The adjustments.
    """

    magnifications: Array
    parameters: Array
    covariances: Array
    centres: tuple[DistortionCentre, ...]
    results: tuple[BundleResult, ...]

    def select(self, keep: Mask) -> DiscreteFit:
        """Return the calibrations of those magnifications where ``keep``, (M,), is true."""
        return DiscreteFit(
            self.magnifications[keep],
            self.parameters[keep],
            self.covariances[keep],
            tuple(c for c, kept in zip(self.centres, keep, strict=True) if kept),
            tuple(r for r, kept in zip(self.results, keep, strict=True) if kept),
        )


def _hold(problem: Problem, values: Mapping[str, float]) -> Problem:
    mean, sigma = problem.prior_mean.copy(), problem.prior_sigma.copy()
    for name, value in values.items():
        mean[FUNCTION_NAMES.index(name)] = value
        sigma[FUNCTION_NAMES.index(name)] = HELD_SIGMA
    return replace(problem, prior_mean=mean, prior_sigma=sigma)


def _with(state: State, values: Mapping[str, float]) -> State:
    theta = state.theta.copy()
    for name, value in values.items():
        theta[FUNCTION_NAMES.index(name)] = value
    return replace(state, theta=theta)


def _fit_one(setup: Setup, tau_px: float | None) -> tuple[DistortionCentre, Problem, BundleResult]:
    """Run steps 2 to 9 of Algorithm 2 for a setup with a single magnification."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    functions = constant_functions(setup, {"scale": start.scale_factor})
    problem = build_problem(setup, functions, setup.views, setup.priors.height_sigma_m)
    state = State(stack_coefficients(functions), start.rotations, start.translations_m)
    # Aspect and skew are freed only with the distortion, which they would imitate without it.
    held = _hold(problem, {"xi_r": 0.0, "xi_t": 0.0, "aspect": 1.0, "skew": 0.0})
    pinhole = adjust(held, resolve_mirrored_tilts(held, state)[0])

    centre = find_distortion_centre(setup.views, tau_px=tau_px)
    if centre.degenerate:
        middle = {"xi_r": 0.0, "ex": float(setup.centre_px[0]), "ey": float(setup.centre_px[1])}
        problem = _hold(problem, middle)
        return centre, problem, adjust(problem, _with(pinhole.state, middle))
    # A centre outside the image is noise; the adjustment then starts from the middle.
    inside = np.all((centre.centre_px > 0) & (centre.centre_px < np.array(setup.image_size)))
    ex, ey = centre.centre_px if inside else setup.centre_px
    return (
        centre,
        problem,
        adjust(problem, _with(pinhole.state, {"ex": float(ex), "ey": float(ey)})),
    )


def fit_discrete(setup: Setup, *, tau_px: float | None = None) -> DiscreteFit:
    """Calibrate every magnification of ``setup`` separately.

    ``tau_px`` selects the paper's fixed threshold of Algorithm 1 instead of the statistical test.
    """
    centres, results, parameters, covariances = [], [], [], []
    for g in setup.magnifications:
        own = replace(
            setup,
            views=tuple(v for v in setup.views if v.magnification == g),
            magnifications=np.array([g]),
            breakpoints=(),
        )
        centre, problem, result = _fit_one(own, tau_px)
        centres.append(centre)
        results.append(result)
        parameters.append(result.state.theta)
        covariances.append(result.covariance * variance_factor(problem, result))
    return DiscreteFit(
        setup.magnifications,
        np.stack(parameters),
        np.stack(covariances),
        tuple(centres),
        tuple(results),
    )


def table_functions(
    magnifications: Array, parameters: Array, covariances: Array
) -> tuple[dict[str, ContinuousFunction], Array]:
    """Interpolate linearly in log g between separate calibrations; covariance of all nodes.

    The discrete calibrations of the literature offer this between their magnifications.
    """
    g_range = (float(magnifications[0]), float(magnifications[-1]))
    functions = {
        name: ContinuousFunction("linear_log", parameters[:, i].copy(), g_range, magnifications)
        for i, name in enumerate(FUNCTION_NAMES)
    }
    return functions, _block_covariance(covariances)


def _block_covariance(covariances: Sequence[Array] | Array) -> Array:
    """Return the (10 M, 10 M) covariance, parameter-major, of M independent nodes."""
    stacked = np.asarray(covariances)
    count, size = stacked.shape[0], stacked.shape[1]
    full = np.zeros((size, count, size, count))
    for i in range(count):
        full[:, i, :, i] = stacked[i]
    return full.reshape(size * count, size * count)
