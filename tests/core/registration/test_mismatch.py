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

"""The reason of a rejection names what is really there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.registration.register import register_pair

RNG = np.random.default_rng(3)
SIZE = (256, 192)


def texture(seed: int) -> Array:
    picture = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=SIZE[::-1]), (0, 0), 2.0)
    return np.asarray(picture / picture.std() * 35.0 + 120.0)


def noisy(picture: Array) -> np.ndarray:
    return (picture + RNG.normal(size=picture.shape) * 3.0).clip(0, 255).astype(np.uint8)


def warped(picture: Array, matrix: list[list[float]]) -> Array:
    return np.asarray(
        cv2.warpAffine(
            picture, np.float64(matrix), SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
    )


def reason(first: Array, second: Array) -> str:
    found = register_pair(noisy(first), noisy(second)).rejection
    return "" if found is None else found.reason


@pytest.mark.parametrize("seed", range(3))
def test_reversed_contrast_is_called_so(seed: int) -> None:
    picture = texture(seed)
    moved = np.roll(picture, (3, -5), axis=(0, 1))
    assert reason(picture, moved) == ""
    assert reason(picture, 240.0 - moved).startswith("contrast reversed")


@pytest.mark.parametrize("seed", range(3))
def test_a_strained_specimen_is_called_so_with_its_strain(seed: int) -> None:
    picture = texture(10 + seed)
    text = reason(picture, warped(picture, [[1.06, 0.0, -8.0], [0.0, 1.0, 0.0]]))
    assert text.startswith("strained by ")
    # In the coordinates of the strained image, 6 % are 5.7 %; parts are found to a px of 85.
    assert float(text.split()[2]) == pytest.approx(5.7, abs=1.2)


def test_a_turned_specimen_is_called_so_with_its_angle() -> None:
    picture, angle = texture(20), 0.05
    c, s = np.cos(angle), np.sin(angle)
    text = reason(picture, warped(picture, [[c, -s, 8.0], [s, c, -6.0]]))
    assert text.startswith("turned by ")
    assert float(text.split()[2]) == pytest.approx(np.degrees(angle), abs=0.7)


@pytest.mark.parametrize("seed", range(4))
def test_another_place_is_neither(seed: int) -> None:
    """Nor is it a strain by chance."""
    assert reason(texture(30 + seed), texture(40 + seed)).startswith("no shift stands out")
