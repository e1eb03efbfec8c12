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

"""What the corner finder refuses, and the reasons that it gives."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semcal_ros.core.corners import LatticeDetection, LatticeStatus, find_lattice
from semcal_ros.core.errors import InvalidValueError, Rejection
from tests.helpers.grids import Board, detected, rejected
from tests.helpers.long_tests import long_but


def blobs(seed: int) -> NDArray[np.uint8]:
    """Bright grains of many sizes, like gold on carbon."""
    rng = np.random.default_rng(seed)
    grains = np.zeros((512, 512), np.float32)
    for _ in range(700):
        centre = tuple(int(v) for v in rng.uniform(0, 512, 2))
        cv2.circle(grains, centre, int(rng.uniform(4, 14)), float(rng.uniform(0.5, 1.0)), -1)
    dose = 40.0 * cv2.GaussianBlur(grains, (0, 0), 1.2) + 10.0
    return rng.poisson(dose).clip(0, 255).astype(np.uint8)


def smooth_noise(seed: int, scale_px: float) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(size=(512, 512))
    if scale_px > 0:
        noise = cv2.GaussianBlur(noise, (0, 0), scale_px)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("image", "status"),
    [
        (np.full((128, 128), 90, np.uint8), LatticeStatus.BLANK),
        (np.full((128, 128), 255, np.uint8), LatticeStatus.BLANK),
        (np.full((128, 128), np.nan), LatticeStatus.NOT_FINITE),
        (
            np.random.default_rng(0).poisson(60.0, (256, 256)).astype(np.uint8),
            LatticeStatus.NO_LATTICE,
        ),
        (blobs(1), LatticeStatus.NO_LATTICE),
        (blobs(2), LatticeStatus.NO_LATTICE),
    ],
    ids=["blank", "all white", "not finite", "noise on nothing", "gold", "more gold"],
)
def test_boardless_images_are_refused_with_a_reason(
    image: NDArray[np.generic], status: LatticeStatus
) -> None:
    rejection = rejected(image)
    assert rejection.status is status
    assert status.value in rejection.reason


@pytest.mark.parametrize(
    "scale_px", long_but(lambda px: px in (1.0, 4.0), [0.0, 1.0, 2.0, 4.0, 8.0, 15.0])
)
def test_random_texture_of_any_grain_is_refused(scale_px: float) -> None:
    for seed in range(2):
        assert rejected(smooth_noise(seed, scale_px)).reason


def test_saturated_board_is_refused() -> None:
    picture = Board(30.0, electrons=30.0).render(np.random.default_rng(0), np.float64)
    rejection = rejected(np.clip(600.0 * picture, 0.0, 255.0).astype(np.uint8))
    assert rejection.status is LatticeStatus.SATURATED
    assert "saturated" in rejection.reason


@pytest.mark.slow
def test_regular_patterns_that_are_no_chess_board_are_refused() -> None:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:512, 0:512]
    patterns = {
        "stripes": (x // 20) % 2,
        "dots": (x % 30 - 15) ** 2 + (y % 30 - 15) ** 2 < 60,
        "squares with gaps": (x % 30 < 24) & (y % 30 < 24),
    }
    for name, pattern in patterns.items():
        image = rng.poisson(50.0 + 100.0 * pattern).astype(np.uint8)
        assert isinstance(find_lattice(image, pattern="chess"), Rejection), name
        if name == "stripes":
            assert rejected(image).reason


def joined(first: Board, second: Board) -> NDArray[np.uint8]:
    """Two boards in one image, side by side along a slanted line."""
    x = np.arange(512)[None, :] + 0.3 * np.arange(512)[:, None]
    picture = np.where(x < 330.0, first.clean(4), second.clean(4))
    return np.random.default_rng(5).poisson(80.0 * picture).astype(np.uint8)


@pytest.mark.parametrize(
    ("turn", "offset"),
    [(15.0, (0.6, 0.6)), (10.0, (0.55, 0.2))],
    ids=["turned by 5 deg", "shifted by a quarter"],
)
def test_two_boards_that_join_are_refused(turn: float, offset: tuple[float, float]) -> None:
    rejection = rejected(
        joined(Board(15.0, turn_deg=10.0), Board(15.0, turn_deg=turn, offset=offset))
    )
    assert rejection.status is LatticeStatus.TWO_BOARDS
    assert "two boards" in rejection.reason


@pytest.mark.slow
@pytest.mark.parametrize(("square", "turn"), [(15.0, 35.0), (24.0, 40.0)])
def test_two_boards_never_give_a_mixed_lattice(square: float, turn: float) -> None:
    boards = Board(15.0, turn_deg=10.0), Board(square, turn_deg=turn, offset=(0.1, 0.6))
    detection = find_lattice(joined(*boards))
    if isinstance(detection, LatticeDetection):
        miss = [cKDTree(b.corners(0.0)[1]).query(detection.xy)[0].max() for b in boards]
        # All corners belong to one board.
        assert min(miss) < 1.0 < max(miss)
    else:
        assert detection.status is LatticeStatus.TWO_BOARDS


def test_corners_of_the_wrong_contrast_do_not_belong_to_the_lattice() -> None:
    """Beyond a line of the board, light and dark squares are exchanged: the same places, the other sign."""
    board = Board(30.0)
    picture = board.clean(4)
    line = board.corners(0.0)[1]
    at = np.unique(np.rint(line[:, 0]))[-4] + 15
    picture[:, int(at) :] = picture.max() + picture.min() - picture[:, int(at) :]
    detection = detected(np.random.default_rng(5).poisson(80.0 * picture).astype(np.uint8))
    assert len(detection.xy) > 100
    # Corners next to the line have no contrast of either sign.
    assert detection.xy[:, 0].max() < at + 5.0


def test_too_few_corners_are_refused() -> None:
    board = Board(210.0, turn_deg=10.0, electrons=50.0)
    assert rejected(board.render(np.random.default_rng(0))).reason


@pytest.mark.parametrize(
    "image",
    [np.zeros((64, 64, 3), np.uint8), np.zeros((8, 8), np.uint8), np.zeros((64, 64), bool)],
    ids=["colour", "tiny", "bool"],
)
def test_what_is_not_an_image_raises(image: NDArray[np.generic]) -> None:
    with pytest.raises(InvalidValueError, match="expected"):
        find_lattice(image)
    with pytest.raises(InvalidValueError, match="databar"):
        find_lattice(np.zeros((64, 64), np.uint8), databar_rows=60)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_small_pictures_of_any_pattern_raise_no_numerical_warning(seed: int) -> None:
    """Found or refused; of a few of them no cell was left to compare the others with."""
    rng = np.random.default_rng((seed, 7))
    for _ in range(8):
        height, width = rng.integers(90, 180, 2)
        y, x = np.mgrid[0:height, 0:width]
        pitch = int(rng.integers(13, 24))
        waves = np.sin(2.0 * np.pi * x / pitch) * np.sin(2.0 * np.pi * y / pitch)
        bars = (x % pitch < 3) | (y % pitch < 3)
        for pattern in (60.0 * waves, 120.0 * bars):
            picture = 90.0 + pattern + rng.normal(0.0, rng.choice([1.0, 20.0]), x.shape)
            found = find_lattice(np.clip(picture, 0, 255).astype(np.uint8))
            if isinstance(found, Rejection):
                assert found.reason
            else:
                assert np.all(np.isfinite(found.xy))
                assert np.all(found.sigma_px > 0.0)
