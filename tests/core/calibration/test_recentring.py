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

"""A grid that lies beside the image is brought back by what two small moves of the stage teach."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.acquisition import (
    find_stage_move,
    grid_is_centred,
    image_from_stage,
    lattice_shift,
)
from semcal_ros.core.calibration.thresholds import PROBE_SQUARES
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError

SIZE = 320
SQUARE_M = 2e-6
SPACING_PX = 25.0
NOMINAL = SPACING_PX / SQUARE_M


def turn(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def seen_at(
    middle_px: Array, angle: float = 0.3, squares: int = 9, noise_px: float = 0.0
) -> LatticeDetection:
    """What is in the image of a square grid whose middle is somewhere."""
    ij = np.stack(np.meshgrid(*2 * [np.arange(squares + 1)]), axis=-1).reshape(-1, 2)
    xy = (ij - 0.5 * squares) * SPACING_PX @ turn(angle).T + middle_px
    xy = xy + noise_px * np.random.default_rng(0).normal(size=xy.shape)
    inside = np.all((xy > 3.0) & (xy < SIZE - 4.0), axis=1)
    return LatticeDetection(
        ij[inside], xy[inside], np.full(inside.sum(), 0.05), SPACING_PX, (SIZE, SIZE)
    )


MIDDLE = np.full(2, 0.5 * (SIZE - 1))


@pytest.mark.parametrize("seed", range(12))
def test_a_grid_beside_the_image_is_brought_to_its_middle(seed: int) -> None:
    """Whatever the direction and handedness of the stage, its tilt, and however little is seen at first."""
    rng = np.random.default_rng(seed)
    tilted = np.diag([1.0, np.cos(rng.uniform(0.0, 1.0))])
    handed = np.diag([1.0, rng.choice([-1.0, 1.0])])
    px_per_m = (
        turn(rng.uniform(0, 6)) @ tilted @ turn(rng.uniform(0, 6)) @ handed * SPACING_PX / SQUARE_M
    )
    off = rng.uniform(100.0, 190.0) * turn(rng.uniform(0, 6))[0]
    place = np.zeros(2)

    def look() -> LatticeDetection:
        return seen_at(MIDDLE + off + px_per_m @ place, noise_px=0.1)

    seen = look()
    assert not grid_is_centred(seen)
    ways = PROBE_SQUARES * SQUARE_M * np.eye(2)
    shifts = np.zeros((2, 2))
    for axis in range(2):
        place = place + ways[axis]
        after = look()
        shifts[axis] = lattice_shift(seen, after)
        seen = after
    learned = image_from_stage(ways, shifts, NOMINAL)
    # The noise of the median over tens of corners, on moves of 7.5 px.
    assert np.linalg.norm(learned - px_per_m) < 0.02 * np.linalg.norm(px_per_m)
    for _ in range(4):
        place = place + find_stage_move(look(), learned)
    assert grid_is_centred(look())
    assert np.hypot(*(off + px_per_m @ place)) < 0.08 * SIZE


def test_the_sign_of_a_shift_is_that_of_the_way() -> None:
    shift = lattice_shift(seen_at(MIDDLE), seen_at(MIDDLE + [6.0, -3.0]))
    assert shift == pytest.approx([6.0, -3.0])


def test_pictures_of_different_corners_are_refused() -> None:
    with pytest.raises(CalibrationError, match="do not move together"):
        lattice_shift(seen_at(MIDDLE), seen_at(MIDDLE, angle=0.8))


def test_a_stage_that_does_not_move_the_image_is_refused() -> None:
    ways = PROBE_SQUARES * SQUARE_M * np.eye(2)
    with pytest.raises(CalibrationError, match="does not follow x and y"):
        image_from_stage(ways, np.array([[7.5, 0.0], [0.3, 0.4]]), NOMINAL)
    with pytest.raises(CalibrationError, match="does not follow x and y"):
        image_from_stage(ways, np.zeros((2, 2)), NOMINAL)
