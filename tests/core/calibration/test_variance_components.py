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

"""Spreads that are estimated with the rest, from what differs and not from what is common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.problem import (
    Priors,
    Spread,
    VarianceComponents,
    usual_lattice_sigmas,
)
from semcal_ros.core.calibration.estimator.thresholds import USUAL_LATTICES
from semcal_ros.core.calibration.estimator.variance_components import (
    _drift_sigma,
    _lattice_sigma,
    accelerate_components,
    largest_change,
)

USUAL_PX = 0.1
VISITS = np.repeat([0, 1, 2], 5)


@dataclass(frozen=True)
class _Effects:
    drift_sigma_px: Array
    visit: Array


@dataclass(frozen=True)
class _Problem:
    effects: _Effects
    unit_m: Array
    across: None = None


@dataclass(frozen=True)
class _Result:
    prior_residuals: dict[str, Array]
    prior_variance: dict[str, Array]
    mean_drift_variance: Array


def estimated(drift_px: Array, sigma_px: float) -> float:
    """The spread after one update from ``sigma_px``, where the views determine all drifts but the common one."""
    sigma = np.full(len(VISITS), sigma_px)
    problem = _Problem(_Effects(sigma, VISITS), np.full(len(VISITS), 1e-8))
    # Of five views, nothing is known of the mean, a fifth of the variance, and all of the rest.
    result = _Result(
        {"drift": -drift_px / sigma_px},
        {"drift": np.full(drift_px.shape, 0.2)},
        np.full((3, 2), 0.2 * sigma_px**2),
    )
    return float(_drift_sigma(problem, result, USUAL_PX)[0])  # type: ignore[arg-type]


@pytest.mark.parametrize("sigma_px", [0.1, 1.0, 6.0])
def test_a_drift_that_the_views_of_a_visit_share_does_not_widen_its_own_prior(
    sigma_px: float,
) -> None:
    common = np.array([[3.0, -5.0], [2.0, 4.0], [-6.0, 1.0]])[VISITS]
    assert estimated(common, sigma_px) < 1.01 * USUAL_PX


def test_drifts_that_differ_have_the_spread_of_their_differences() -> None:
    rng = np.random.default_rng(0)
    own = rng.normal(0.0, 0.7, (len(VISITS), 2))
    for common in (0.0, 4.0):
        sigma = 0.3
        for _ in range(30):
            sigma = estimated(own + common, sigma)
        # Fifteen views with two drifts each, of which three visits keep one: 24 degrees of freedom, 15 %.
        assert sigma == pytest.approx(0.7, rel=0.45)


def components(logarithms: Array) -> VarianceComponents:
    sigmas = np.exp(logarithms)
    spreads = (Spread(float(s), 1.0) for s in sigmas[:2])
    return VarianceComponents(*spreads, sigmas[2:5], sigmas[5:8], sigmas[8:])


def test_extrapolated_updates_reach_the_fixed_point_of_a_linear_map() -> None:
    """Three rates in ten spreads: with three differences the extrapolation is exact."""
    rng = np.random.default_rng(0)
    fixed, directions = rng.normal(0.0, 0.1, 10), rng.normal(size=(10, 3)) * 0.02
    moved = np.array([0.5, 0.62, 0.8])
    updates, part = [], np.ones(3)
    start = components(fixed + directions @ part)
    for _ in range(4):
        before = components(fixed + directions @ part)
        part = moved * part
        updates.append((before, components(fixed + directions @ part)))
    assert largest_change(start, components(fixed)) > 0.01
    assert largest_change(updates[-1][1], components(fixed)) > 1e-3
    assert largest_change(accelerate_components(updates), components(fixed)) < 1e-9


def test_updates_that_lead_far_away_are_not_extrapolated() -> None:
    first, second, third = (components(np.full(10, x)) for x in (0.0, 1.0, 1.99))
    assert largest_change(accelerate_components([(first, second), (second, third)]), third) == 0.0
    # Nor is a single one.
    assert largest_change(accelerate_components([(first, second)]), second) == 0.0


def lattice_spread(true: float, known: float, rng: np.random.Generator) -> float:
    """The spread of stretches, over the usual one, that 60 views tell of, each known to ``known`` usual spreads."""
    usual = usual_lattice_sigmas(Priors())
    seen = usual * np.hypot(true, known) * rng.normal(size=(60, 2))
    sigma = usual.copy()
    for _ in range(200):
        left = 1.0 / (1.0 + (sigma / (usual * known)) ** 2)
        found = {"lattice": -(1.0 - left) * seen / sigma}
        result = _Result(found, {"lattice": np.broadcast_to(left, seen.shape)}, np.zeros((0, 2)))
        sigma = _lattice_sigma(sigma, result, Priors(), USUAL_LATTICES)  # type: ignore[arg-type,assignment]
    return float(sigma[0] / usual[0])


@pytest.mark.long
def test_lattices_of_which_many_views_say_little_keep_their_usual_spread() -> None:
    """Sixty views whose tilts leave a stretch uncertain by twelve usual spreads say five by chance."""
    rng = np.random.default_rng(1)
    drawn = np.array([lattice_spread(1.0, 12.0, rng) for _ in range(100)])
    assert np.mean(drawn < 2.0) > 0.95


@pytest.mark.long
def test_lattices_that_are_stretched_have_a_spread_that_is_found() -> None:
    rng = np.random.default_rng(2)
    drawn = np.array([lattice_spread(6.0, 3.0, rng) for _ in range(100)])
    # The spread of 60 values with this noise is known to 11 %.
    assert np.mean(drawn) == pytest.approx(6.0, rel=0.05)
    assert np.std(drawn) < 0.15 * 6.0
