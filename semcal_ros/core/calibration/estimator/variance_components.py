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

"""Spread of what varies between visits and views, estimated together with the calibration.

A magnification does not quite come back, a stage does not keep its height, and a specimen drifts
while it is scanned. Each is a random effect with a variance of its own. MacKay's fixed point for
the evidence (1992, doi:10.1162/neco.1992.4.3.415), a quick form of restricted maximum likelihood,
estimates it from the effects themselves: the sum of their squares over the number of them that the
data determine. A part of an observation of the usual spread stands for what is known beforehand,
so that a spread which the views do not determine stays at its usual value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import nnls

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.problem import (
    Priors,
    Setup,
    Spread,
    VarianceComponents,
    initial_components,
    usual_lattice_sigmas,
)
from semcal_ros.core.calibration.estimator.thresholds import (
    CHOICE_LATTICES_MAX,
    FLAT_RAD,
    SPREAD_COUNT_MIN,
    SPREAD_MAX,
    SPREAD_MEMORY,
    SPREAD_MIN,
    SPREAD_STEP_MAX,
    USUAL_WEIGHT,
)


def _update(
    sigma: float, usual: float, residuals: Array, variance: Array, beyond: float = USUAL_WEIGHT
) -> Spread:
    """Update a spread from the residuals of its prior, in sigmas, and their posterior variances.

    The usual spread counts as :data:`USUAL_WEIGHT` observed effects, and as ``beyond`` of them for a larger one.
    """
    known_part = np.maximum(1.0 - variance, 0.0)
    determined = float(np.sum(known_part))
    # The information of the data on an effect is (1 / variance - 1) / sigma^2.
    visible = float(np.sum(known_part / (known_part + variance * (sigma / usual) ** 2)))
    seen = sigma**2 * float(np.sum(residuals**2))
    known = beyond if seen > determined * usual**2 else USUAL_WEIGHT
    square = (seen + known * usual**2) / (determined + known)
    return Spread(
        float(np.clip(np.sqrt(square), SPREAD_MIN * usual, SPREAD_MAX * usual)), determined, visible
    )


def update_components(
    setup: Setup, problem: Problem, result: BundleResult, *, usual_lattices: float = USUAL_WEIGHT
) -> VarianceComponents:
    """Update all spreads from an adjustment with the ones before.

    Views without tilt have a spread of heights of their own: tilting moves the specimen, while
    views from above may all share one height.

    As long as the corners are believed less than stated (``setup.tempering``), what they show besides is no more than
    usual: it would be the distortion that the model does not have yet. Nor is it where a residual field has been taken
    off: what a field of limited strength leaves would pass for drift and for lattices that are stretched, by so much
    that tilts make room for them.

    ``usual_lattices`` is for how many lattices the usual spread of them counts against a larger one. A tilt does nearly
    what a stretch does, so that many views may say a little each; repeated updates follow even that.
    """
    found = _updated_components(setup, problem, result, usual_lattices)
    limited = setup.corrected or setup.tempering != 1.0
    return limit_components(setup, found) if limited else found


def limit_components(setup: Setup, found: VarianceComponents) -> VarianceComponents:
    """Return spreads that are at most the usual ones, but for the heights."""
    usual = initial_components(setup)

    def least(a: Spread, b: Spread) -> Spread:
        return a if a.sigma <= b.sigma else b

    return replace(
        limit_lattices(setup, found, 1.0),
        scale=least(found.scale, usual.scale),
        visit_height=least(found.visit_height, usual.visit_height),
        drift_sigma_px=np.minimum(found.drift_sigma_px, usual.drift_sigma_px),
    )


def limit_lattices(
    setup: Setup, found: VarianceComponents, most: float = CHOICE_LATTICES_MAX
) -> VarianceComponents:
    """Return spreads of which that of the lattices is at most so many usual ones.

    By default as for the choice of coefficients: under a wider one, what the model does not have yet passes for
    stretched lattices, for which tilts make room, and is never missed.
    """
    if found.lattice_sigma is None:
        return found
    largest = most * usual_lattice_sigmas(setup.priors)
    return replace(found, lattice_sigma=np.minimum(found.lattice_sigma, largest))


def accelerate_components(
    updates: Sequence[tuple[VarianceComponents, VarianceComponents]],
) -> VarianceComponents:
    """Return spreads nearer to the fixed point than those after the last of some updates (before, after).

    Anderson's extrapolation (1965, doi:10.1145/321296.321305) of the logarithms of the spreads: the updates alone gain
    a digit in five.
    """
    before, after = (
        np.stack([_log_sigmas(u[k]) for u in updates[-SPREAD_MEMORY:]]) for k in (0, 1)
    )
    moved = after - before
    if len(moved) > 1:
        weights = np.linalg.lstsq(np.diff(moved, axis=0).T, moved[-1], rcond=None)[0]
        step = np.diff(after, axis=0).T @ weights
        if np.max(np.abs(step)) < SPREAD_STEP_MAX:
            return _with_log_sigmas(updates[-1][1], after[-1] - step)
    return updates[-1][1]


def largest_change(before: VarianceComponents, after: VarianceComponents) -> float:
    """Return the largest change of the logarithm of a spread."""
    return float(np.max(np.abs(_log_sigmas(after) - _log_sigmas(before))))


def _log_sigmas(components: VarianceComponents) -> Array:
    lattice = np.zeros(0) if components.lattice_sigma is None else components.lattice_sigma
    visits = np.array([components.scale.sigma, components.visit_height.sigma])
    return np.log(
        np.concatenate([visits, components.height_sigma_m, components.drift_sigma_px, lattice])
    )


def _with_log_sigmas(components: VarianceComponents, logarithms: Array) -> VarianceComponents:
    sigmas, views = np.exp(logarithms), len(components.height_sigma_m)
    visits, heights, drifts, lattice = np.split(sigmas, [2, 2 + views, 2 + 2 * views])
    return VarianceComponents(
        replace(components.scale, sigma=float(visits[0])),
        replace(components.visit_height, sigma=float(visits[1])),
        heights,
        drifts,
        None if components.lattice_sigma is None else lattice,
    )


def _updated_components(
    setup: Setup, problem: Problem, result: BundleResult, usual_lattices: float
) -> VarianceComponents:
    priors = setup.priors
    flat: Mask = result.state.rotations[:, 2, 2] > np.cos(FLAT_RAD)
    if min(flat.sum(), (~flat).sum()) < SPREAD_COUNT_MIN:
        flat = np.zeros_like(flat)
    height = problem.height_sigma_m.copy()
    for own in (flat, ~flat):
        if np.any(own):
            # A view whose tilt passed the limit still has the spread of the others.
            sigma = height[own]
            residuals = result.prior_residuals["height"][own, 0] * sigma / sigma[0]
            variance = result.prior_variance["height"][own, 0]
            height[own] = _update(float(sigma[0]), priors.height_sigma_m, residuals, variance).sigma
    if len(height) < SPREAD_COUNT_MIN or problem.across is not None:
        # Otherwise a height would widen its own prior, and a camera could run away with it: of lines, those in two
        # directions can be at two heights as well as under an aspect ratio.
        height = np.minimum(height, priors.height_sigma_m)
    effects = problem.effects
    if effects is None:
        start = initial_components(setup)
        return replace(start, height_sigma_m=height)
    sigmas = (effects.scale_sigma, effects.height_sigma_m)
    usual = (priors.visit_scale_sigma, priors.visit_height_sigma_m)
    visits = [
        _update(
            sigma,
            own,
            result.state.visits[:, k] / sigma,
            result.visit_variance[:, k] / sigma**2,
        )
        for k, (sigma, own) in enumerate(zip(sigmas, usual, strict=True))
    ]
    return VarianceComponents(
        visits[0],
        visits[1],
        height,
        _drift_sigma(problem, result, setup.drift_sigma_px),
        _lattice_sigma(effects.lattice_sigma, result, priors, usual_lattices),
    )


def _lattice_sigma(
    sigma: Array | None, result: BundleResult, priors: Priors, beyond: float
) -> Array | None:
    if sigma is None:
        return None
    residuals, variance = result.prior_residuals["lattice"], result.prior_variance["lattice"]
    return np.array(
        [
            _update(s, usual, residuals[:, k], variance[:, k], beyond).sigma
            for k, (s, usual) in enumerate(zip(sigma, usual_lattice_sigmas(priors), strict=True))
        ]
    )


def _drift_sigma(problem: Problem, result: BundleResult, usual: float) -> Array:
    """Fit the squares of the drifts by a constant and a part that grows with the scale.

    A drift of the specimen is one in metres, that of the beam one in pixels. An effect that the
    data determine to ``1 - variance`` has so much of its variance as expected square. The drift that
    the views of a visit share does not count: nothing tells it from the aspect ratio and the skew, so
    that it would widen its own prior. Of lines in one direction even the drift of a single view cannot be told from
    these, and keeps its usual spread.
    """
    assert problem.effects is not None
    if problem.across is not None:
        return np.full(len(problem.group), usual)
    sigma, visit = problem.effects.drift_sigma_px, problem.effects.visit
    drift = sigma[:, None] * result.prior_residuals["drift"]
    count = np.bincount(visit)
    mean = np.stack([np.bincount(visit, weights=d) for d in drift.T], axis=1) / count[:, None]
    drift = drift - mean[visit]
    scale = np.min(problem.unit_m) / problem.unit_m
    design = np.stack([np.ones_like(scale), scale**2], axis=1)
    # Of the deviations from the mean, as much of the prior variance as the posterior does not leave.
    left = result.prior_variance["drift"] - result.mean_drift_variance[visit] / sigma[:, None] ** 2
    determined = np.sum(np.maximum(1.0 - 1.0 / count[visit, None] - left, 0.0), axis=1)
    square = np.sum(drift**2, axis=1)
    # The weights are those of chi-squares of the spread before, with as many degrees of freedom as
    # are determined; the last row is the usual one.
    root, known = np.sqrt(np.maximum(determined, 1e-6)), np.sqrt(USUAL_WEIGHT)
    rows = np.vstack([design * (root / sigma**2)[:, None], [known * usual**-2.0, 0.0]])
    found, _ = nnls(rows, np.append(square / (root * sigma**2), known))
    return np.sqrt(np.clip(design @ found, (SPREAD_MIN * usual) ** 2, (SPREAD_MAX * usual) ** 2))
