"""Where the scale seems to jump, because the microscope switches its scan range.

The finished adjustment is asked, by its own quadratic approximation, what a jump of the scale between two neighbouring
magnifications would gain. The answer is a hint for the user, never a change of the calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.calibration.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.normal_equations import Problem, theta_system
from semcal_ros.core.calibration.problem import Setup, variance_factor

__all__ = ["Jump", "likely_jump"]

Array = NDArray[np.float64]

# Half chi-squares, that is 2.7 standard deviations: a recording without jump has one in twenty chances to be suspected.
_LEAST_GAIN = 3.65


@dataclass(frozen=True)
class Jump:
    """A jump of the scale that the views ask for.

    Attributes
    ----------
    below, above
        Neighbouring magnifications between which it lies.
    relative, sigma
        Size relative to the scale, and its 1-sigma.
    """

    below: float
    above: float
    relative: float
    sigma: float


def likely_jump(setup: Setup, problem: Problem, result: BundleResult) -> Jump | None:
    """The jump that would improve an adjustment most, or None if none is worth mentioning.

    ``problem`` and ``result`` are the adjustment at its optimum. Breakpoints that it has already are left out.
    """
    matrix, right = theta_system(problem, result.state.theta, result.information, result.gradient)
    scale = 1.0 / np.sqrt(np.diag(matrix))
    scaled = matrix * np.outer(scale, scale)
    g = setup.magnifications
    nominal = setup.nominal_px_per_m(g)
    variance = max(variance_factor(problem, result), 1.0)
    best, best_gain = None, _LEAST_GAIN
    for k in range(1, len(g)):
        if any(g[k - 1] < b <= g[k] for b in setup.breakpoints):
            continue
        column = np.where(np.arange(len(g)) >= k, nominal, 0.0)
        pull = result.information[:, :, 0] * column[:, None]
        cross = scale * np.einsum("mpk,mp->k", problem.designs, pull)
        solved = np.linalg.solve(scaled, np.stack([cross, scale * right], axis=1))
        information = float(pull[:, 0] @ column) - cross @ solved[:, 0]
        information += setup.priors.scale_jump**-2.0
        gradient = float(result.gradient[:, 0] @ column) - cross @ solved[:, 1]
        gain = 0.5 * gradient**2 / information / variance
        if gain > best_gain:
            sigma = float(np.sqrt(variance / information))
            best_gain = gain
            best = Jump(float(g[k - 1]), float(g[k]), float(gradient / information), sigma)
    return best
