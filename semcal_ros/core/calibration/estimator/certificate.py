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

"""The certificate of a fit: that it ended at a minimum, and what the views determine there."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import equilibrate, solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.normal_equations import reduced_normal_equations
from semcal_ros.core.calibration.estimator.problem import Functions
from semcal_ros.core.camera.calibration_model import names_of
from semcal_ros.core.camera.fit_record import Certificate
from semcal_ros.core.errors import UnusableCalibrationError

__all__ = ["certify"]

# Of an unknown that is still on its way, in sigmas: far beyond what the last step of a converged fit leaves, which is
# some hundredths.
_LARGEST_REMAINING = 1.0
# Part of the prior variance of a constant beyond which the prior holds it.
_HELD = 0.64
_NAMED = 3


def certify(functions: Functions, problem: Problem, result: BundleResult) -> Certificate:
    """Certify an adjustment.

    Raises
    ------
    UnusableCalibrationError
        If one more Newton step would move an unknown by more than its sigma, or the equations have no solution. The
        message names the unknowns.
    """
    matrix, right = reduced_normal_equations(
        problem, result.state.theta, result.information, result.gradient
    )
    sigmas = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))
    scaled, _ = equilibrate(matrix)
    values = np.linalg.eigvalsh(scaled) if np.all(np.isfinite(scaled)) else np.zeros(1)
    names = [name for name in names_of(functions) for _ in range(functions[name].size)]
    names += list(problem.shared)
    if not (values[0] > 0.0 and np.all(np.isfinite(sigmas)) and np.all(sigmas > 0.0)):
        weak = [
            name for name, s in zip(names, sigmas, strict=True) if not (np.isfinite(s) and s > 0)
        ]
        raise UnusableCalibrationError(
            "a fit whose equations have no solution",
            expected=f"views that determine {', '.join(dict.fromkeys(weak)) or 'the camera'}",
            do="record views with more tilt, at more magnifications",
        )
    remaining = np.abs(solve_scaled(matrix, right)) / sigmas
    if float(remaining.max()) > _LARGEST_REMAINING:
        worst = [names[k] for k in np.argsort(-remaining) if remaining[k] > _LARGEST_REMAINING]
        raise UnusableCalibrationError(
            f"a fit that is not at a minimum: {', '.join(list(dict.fromkeys(worst))[:_NAMED])} would still move by "
            f"{remaining.max():.1f} sigma",
            expected="views of one flat grid, by one microscope, at the magnifications that are stated",
            do="leave out views that are not such, or record more",
        )
    held, start = [], 0
    for name in names_of(functions):
        prior = problem.prior_sigma[start]
        if np.isfinite(prior) and result.covariance[start, start] > _HELD * prior**2:
            held.append(name)
        start += functions[name].size
    return Certificate(
        remaining_sigmas=float(remaining.max()),
        last_decrease=max(result.last_decrease, 0.0),
        condition=float(values[-1] / values[0]),
        held=tuple(held),
    )
