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

"""Operations on arrays that every room needs."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.arrays import (
    check_image,
    equilibrate,
    invert_scaled,
    mad_sigma,
    median,
    quantile,
    solve_scaled,
)
from semcal_ros.core.errors import InvalidValueError

# Metres beside pixels beside radians.
UNITS = np.array([1e-9, 1.0, 1e6, 1e-3])


def _matrices(count: int) -> np.ndarray:
    roots = np.random.default_rng(1).normal(size=(count, 4, 4)) / UNITS
    return np.swapaxes(roots, 1, 2) @ roots


def test_a_matrix_is_scaled_to_ones_on_the_diagonal() -> None:
    matrix = _matrices(1)[0]
    scaled, scale = equilibrate(matrix)
    assert np.diag(scaled) == pytest.approx(np.ones(4), rel=1e-14)
    np.testing.assert_allclose(scaled / np.outer(scale, scale), matrix, rtol=1e-14)


def test_a_diagonal_that_rounding_made_negative_overflows_nothing() -> None:
    matrix = np.array([[1e12, 1e3], [1e3, -1e-7]])
    scaled, scale = equilibrate(matrix)
    np.testing.assert_allclose(scaled, [[1.0, 1e-3], [1e-3, -1e-7]])
    np.testing.assert_allclose(scale, [1e-6, 1.0])


def test_systems_in_mixed_units_are_solved_one_by_one_and_in_stacks() -> None:
    matrices = _matrices(3)
    wanted = np.random.default_rng(2).normal(size=(3, 4)) * UNITS
    rights = np.einsum("nij,nj->ni", matrices, wanted)
    np.testing.assert_allclose(solve_scaled(matrices, rights), wanted, rtol=1e-9)
    both = solve_scaled(matrices[0], np.stack([rights[0], 2.0 * rights[0]], axis=1))
    np.testing.assert_allclose(both, np.stack([wanted[0], 2.0 * wanted[0]], axis=1), rtol=1e-9)


def test_damping_counts_in_units_of_the_diagonal() -> None:
    matrices, rights = _matrices(2), np.ones((2, 4))
    heavy = matrices.copy()
    heavy[:, range(4), range(4)] *= 1.5
    expected = solve_scaled(heavy, rights)
    np.testing.assert_allclose(solve_scaled(matrices, rights, 0.5), expected, rtol=1e-9)
    assert solve_scaled(matrices[0], rights[0], 0.5) == pytest.approx(expected[0], rel=1e-9)


def test_inverses_in_mixed_units() -> None:
    matrices = _matrices(3)
    one = matrices @ invert_scaled(matrices)
    scales = UNITS[:, None] / UNITS
    np.testing.assert_allclose(one * scales, np.broadcast_to(np.eye(4), (3, 4, 4)), atol=1e-9)


def test_a_direction_without_information_is_left_out_of_the_pseudo_inverse() -> None:
    matrix = np.outer(1.0 / UNITS, 1.0 / UNITS)
    inverse = invert_scaled(matrix, rcond=1e-9)
    np.testing.assert_allclose(matrix @ inverse @ matrix, matrix, rtol=1e-9)
    empty = np.diag([4.0, 0.0])
    np.testing.assert_allclose(invert_scaled(empty, rcond=1e-9), np.diag([0.25, 0.0]))


def test_the_robust_sigma_is_that_of_the_majority() -> None:
    values = np.random.default_rng(3).normal(scale=2.0, size=20000)
    values[:2000] = 1e6
    # A tenth of outliers on one side shifts the quantile that is used from 50 to 55.6 %.
    assert mad_sigma(values) == pytest.approx(2.0 * 0.765 / 0.6745, rel=0.02)
    assert mad_sigma(values[2000:]) == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("count", [1, 2, 5, 48])
def test_medians_and_quantiles_are_those_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    assert median(values) == np.median(values)
    for part in (0.0, 0.3, 0.5, 1.0):
        # Both are the same two numbers, added up in another order.
        assert quantile(values, part) == pytest.approx(np.quantile(values, part), abs=1e-14)


def test_pictures_pass_as_they_are() -> None:
    grey, colour = np.zeros((4, 5), np.uint16), np.zeros((4, 5, 3), np.uint8)
    assert check_image(grey) is grey
    assert check_image(colour) is colour
    assert check_image(colour, channels=(3,), types=("uint8",), least_side=4) is colour


@pytest.mark.parametrize(
    ("image", "options"),
    [
        (np.zeros(4), {}),
        (np.zeros((4, 5, 2)), {}),
        (np.zeros((4, 5, 1)), {}),
        (np.zeros((1, 4, 5, 3)), {}),
        (np.zeros((0, 5)), {}),
        (np.zeros((4, 5), bool), {}),
        (np.zeros((4, 5), complex), {}),
        (np.zeros((4, 5, 3)), {"channels": (1,)}),
        (np.zeros((4, 5)), {"channels": (3,)}),
        (np.zeros((4, 5)), {"types": ("uint8",)}),
        (np.zeros((4, 5)), {"least_side": 5}),
    ],
)
def test_other_arrays_are_refused(image: np.ndarray, options: dict) -> None:
    with pytest.raises(InvalidValueError, match="an image of shape"):
        check_image(image, **options)


def test_the_refusal_says_what_would_be_taken() -> None:
    with pytest.raises(InvalidValueError) as error:
        check_image(np.zeros(3), types=("uint8", "float32"), least_side=32, do="cut it out")
    assert str(error.value) == (
        "an image of shape (3,) and type float64; expected (h, w) or (h, w, 3) of uint8, float32, "
        "at least 32 x 32 px; cut it out"
    )
