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

"""Correspondences of pictures that are shifted, turned and zoomed, against the truth of another generator."""

from __future__ import annotations

import math

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import Rejection
from semcal_ros.core.ladder.correspondences import (
    Correspondences,
    PairFailure,
    Prepared,
    SmoothMap,
    match_pictures,
)
from tests.helpers.ladders import SIZE, make_scope, place_in, take

MIDDLE = 0.5 * (SIZE - 1)


def _match(
    g: tuple[float, float],
    places: tuple[tuple[float, float], tuple[float, float]],
    turns: tuple[float, float],
) -> Correspondences | Rejection[PairFailure]:
    scope = make_scope()
    first, second = (
        Prepared(take(scope, g[k], places[k], turns[k], seed=k).astype(np.float32)) for k in (0, 1)
    )
    # The prediction knows the zoom and the quarter turn, and nothing else.
    quarter = 0.5 * math.pi * round((turns[1] - turns[0]) / (0.5 * math.pi))
    c, s = math.cos(quarter) * g[1] / g[0], math.sin(quarter) * g[1] / g[0]
    return match_pictures(
        first, second, lambda xy: MIDDLE + (xy - MIDDLE) @ np.array([[c, s], [-s, c]])
    )


@pytest.mark.parametrize(
    ("g", "second", "turn"),
    [
        ((20000.0, 20000.0), (0.25, 0.1), 0.003),
        ((20000.0, 20000.0), (0.03, -0.02), 0.5 * math.pi + 0.004),
        ((20000.0, 30000.0), (0.05, 0.08), 0.004),
        ((20000.0, 30000.0), (-0.05, 0.02), -0.5 * math.pi),
    ],
)
def test_places_agree_within_the_stated_covariance(
    g: tuple[float, float], second: tuple[float, float], turn: float
) -> None:
    scope = make_scope()
    places = (0.0, 0.0), second
    found = _match(g, places, (0.0, turn))
    assert isinstance(found, Correspondences), found
    # In the middle of a block both pixels show the same place; the second one's pixel turns metres into px.
    here = place_in(scope, g[0], places[0], 0.0, found.first_xy)
    there = place_in(scope, g[1], places[1], turn, found.second_xy)
    px = (there - here) / (scope.display_m / g[1] / SIZE)
    c, s = math.cos(turn), math.sin(turn)
    error: Array = px @ np.array([[c, s], [-s, c]])
    scaled = np.einsum(
        "nji,nj->ni", np.linalg.cholesky(np.linalg.inv(found.covariance)), error
    ).ravel()
    # Some 30 blocks or more, whose spread is told to 1 / sqrt(2 * 60) = 9 %, and shares the noise of its pixels.
    assert len(found) >= 20
    assert 0.65 < float(np.std(scaled)) < 1.4
    # No common shift or scale beyond what their number allows.
    assert abs(float(np.mean(scaled))) < 4.0 / math.sqrt(len(scaled)) * 1.5
    assert float(np.sqrt(np.mean(error**2))) < 0.2


def test_other_places_are_no_match() -> None:
    found = _match((20000.0, 20000.0), ((0.0, 0.0), (3.0, 1.0)), (0.0, 0.0))
    assert isinstance(found, Rejection)
    assert found.status is PairFailure.NO_OVERLAP


def test_noise_is_featureless() -> None:
    rng = np.random.default_rng(0)
    pictures = [Prepared(rng.normal(100.0, 5.0, (128, 128)).astype(np.float32)) for _ in range(2)]
    found = match_pictures(*pictures, lambda xy: xy)
    assert isinstance(found, Rejection)
    assert found.status is PairFailure.FEATURELESS


def test_a_lattice_without_defects_is_refused() -> None:
    y, x = np.mgrid[0:192, 0:192].astype(np.float64)
    rng = np.random.default_rng(0)
    lattice = 100.0 + 20.0 * (np.cos(2 * np.pi * x / 13.0) + np.cos(2 * np.pi * y / 13.0))
    pictures = [
        Prepared((lattice + rng.normal(0.0, 2.0, lattice.shape)).astype(np.float32))
        for _ in range(2)
    ]
    found = match_pictures(*pictures, lambda xy: xy)
    assert isinstance(found, Rejection)
    assert found.status is PairFailure.PERIODIC


def test_smooth_map_is_exact_for_polynomials_and_its_jacobian_is_its_derivative() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(0.0, 199.0, (80, 2))

    def bent(points: Array) -> Array:
        x, y = (points / 100.0 - 1.0).T
        return np.stack([3.0 + x + 0.2 * x * y**2 - 0.1 * x**3, 1.0 - y + 0.3 * x**2 * y**2], 1)

    fitted = SmoothMap.fit(xy, bent(xy), (200, 200), 4)
    inside = rng.uniform(20.0, 180.0, (10, 2))
    np.testing.assert_allclose(fitted(inside), bent(inside), atol=1e-10)
    step = 1e-4
    for axis in (0, 1):
        move = step * np.eye(2)[axis]
        numerical = (fitted(inside + move) - fitted(inside - move)) / (2.0 * step)
        np.testing.assert_allclose(fitted.jacobian(inside)[:, :, axis], numerical, atol=1e-8)
    grid = fitted.on_grid()
    np.testing.assert_allclose(grid[:, 50, 70], fitted(np.array([[70.0, 50.0]]))[0], atol=1e-10)
