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

"""Lines in one direction: positions across them with a true sigma, the right period, refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from semcal_ros.core.corners import LatticeDetection, LatticeStatus, find_lattice
from semcal_ros.core.errors import Rejection
from tests.helpers.grids import Board, PatternBoard
from tests.helpers.long_tests import long_but


def found_in(board: PatternBoard, seed: int = 1) -> LatticeDetection:
    found = find_lattice(board.picture(np.random.default_rng(seed)), pattern="grating")
    assert isinstance(found, LatticeDetection), found.reason
    return found


@pytest.mark.parametrize(
    "board",
    [
        PatternBoard(20.0, turn_deg=7.0, pattern="grating", size=0.5, noise=5.0),
        PatternBoard(9.0, turn_deg=-63.0, pattern="grating", size=0.4, noise=10.0, inverted=True),
        PatternBoard(24.0, turn_deg=90.0, pattern="grating", size=0.2, noise=5.0, distortion=0.05),
        PatternBoard(45.0, turn_deg=130.0, pattern="grating", size=0.7, noise=3.0, blur_px=2.0),
    ],
    ids=["plain", "fine and noisy", "distorted", "coarse and blurred"],
)
def test_lines_are_found_with_a_true_sigma_across_them(board: PatternBoard) -> None:
    found = found_in(board)
    at = board.board_from_image(found.xy)
    # A line or the gap between two: which of them is where the finder begins is open.
    offset = float(np.angle(np.mean(np.exp(2j * np.pi * at[:, 0])))) / (2.0 * np.pi)
    assert min(abs(offset), 0.5 - abs(offset)) < 0.05 / board.square_px
    number = np.rint(at[:, 0] - offset)
    # Each number is one line, counted in either direction.
    step = np.diff(np.unique(np.stack([found.ij[:, 0], number]), axis=1))
    assert np.all(step[0] == 1)
    assert np.all(np.abs(step[1]) == 1)
    line = number + offset
    on_line = board.image_from_board(np.stack([line, at[:, 1]], axis=1))
    error = np.sum((found.xy - on_line) * found.across, axis=1)
    z = error / found.sigma_px
    # At least 25 numbers, of which the RMS is good to 14 %; of most boards hundreds.
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4
    true = board.image_from_board(np.stack([line, at[:, 1] + 1e-3], axis=1)) - on_line
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    # The part along a line that is not known is up to some pixels, and must not show across.
    assert np.sqrt(np.mean(np.sum(true * found.across, axis=1) ** 2)) < 1.5e-3


def test_a_double_period_is_seen_where_every_other_line_is_fainter() -> None:
    x = np.arange(240.0)
    line = np.floor(x / 12.0)
    bright = ((x % 12.0) < 6.0) * np.where(line % 2 == 0, 120.0, 80.0)
    picture = np.tile(40.0 + bright, (200, 1)) + np.random.default_rng(0).normal(0, 4, (200, 240))
    found = find_lattice(cv2.GaussianBlur(picture, (0, 0), 1.0), pattern="grating")
    assert isinstance(found, LatticeDetection)
    assert abs(found.spacing_px - 24.0) < 0.1


def phase_of_lines(
    side: int, period: float, turn: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance from the middle of the next line in periods, and the pixels' x and y."""
    y, x = np.mgrid[0:side, 0:side].astype(float)
    at = (x * np.cos(turn) + y * np.sin(turn)) / period
    return np.abs(at - np.rint(at)), x, y


def photographed(rng: np.random.Generator, mean: np.ndarray) -> np.ndarray:
    noisy = rng.normal(cv2.GaussianBlur(mean, (0, 0), 1.0), 8.0)
    return np.asarray(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("seed", long_but(lambda seed: seed < 2, range(6)))
def test_a_hole_or_a_deposit_with_more_contrast_than_the_lines_hides_no_others(seed: int) -> None:
    rng = np.random.default_rng(seed)
    side, period = 400, float(rng.uniform(12.0, 50.0))
    off, x, y = phase_of_lines(side, period, rng.uniform(0.0, np.pi))
    mean = np.where(off < rng.uniform(0.15, 0.35), 130.0, 70.0)
    cx, cy = rng.uniform(0.3, 0.7, 2) * side
    radius = rng.uniform(0.1, 0.16) * side
    square = np.maximum(np.abs(x - cx), 1.4 * np.abs(y - cy))
    mean[(square if seed % 2 else np.hypot(x - cx, y - cy)) < radius] = rng.choice([10.0, 245.0])
    found = find_lattice(photographed(rng, mean), pattern="grating")
    assert isinstance(found, LatticeDetection), found.reason
    # Lines that the hole covers are missing, and a period of 50 px has eight lines.
    assert found.spacing_px == pytest.approx(period, rel=0.01)


@pytest.mark.parametrize("period", [16.0, 30.0, 64.0])
@pytest.mark.parametrize("turn", long_but(lambda turn: turn == 0.3, [0.3, 2.2]))
def test_bright_edges_at_even_distances_are_not_taken_for_lines(period: float, turn: float) -> None:
    # Faces and gaps are of one width, and what tells them is a twentieth of the contrast of the edges.
    off, x, _ = phase_of_lines(384, period, turn)
    edges = np.exp(-0.5 * ((off - 0.25) / 0.05) ** 2)
    rng = np.random.default_rng(0)
    found = find_lattice(
        photographed(rng, 60.0 + 0.05 * x + 8.0 * (off < 0.25) + 160.0 * edges), pattern="grating"
    )
    assert isinstance(found, LatticeDetection), found.reason
    assert found.spacing_px == pytest.approx(period, rel=0.01)


@pytest.mark.parametrize(
    "board",
    [
        PatternBoard(20.0, turn_deg=7.0),
        PatternBoard(20.0, turn_deg=30.0, pattern="lines", size=0.3),
        Board(24.0, turn_deg=11.0, width=240, height=200),
    ],
    ids=["dots", "crossed lines", "chess"],
)
def test_what_repeats_in_two_directions_is_no_grating(board: Board) -> None:
    found = find_lattice(255.0 * board.clean(), pattern="grating")
    assert isinstance(found, Rejection)
    assert found.status is LatticeStatus.OTHER_PATTERN


def test_lines_at_uneven_distances_are_refused() -> None:
    x = np.arange(240.0)
    uneven = np.array([0.0, 1.6, 1.2, -1.4, -1.6, 0.3, 1.5, -1.2, -0.4, 1.6])
    places = 12.0 + 24.0 * np.arange(10.0) + uneven
    profile = np.exp(-0.5 * ((x - places[:, None]) / 5.0) ** 2).sum(axis=0)
    noise = np.random.default_rng(0).normal(0.0, 4.0, (200, 240))
    found = find_lattice(60.0 + 100.0 * np.tile(profile, (200, 1)) + noise, pattern="grating")
    assert isinstance(found, Rejection)
    assert "even distances" in found.reason


def test_texture_is_no_grating() -> None:
    texture = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(240, 320)), (0, 0), 3.0)
    found = find_lattice(texture, pattern="grating")
    assert isinstance(found, Rejection)
    assert found.status is LatticeStatus.NO_LATTICE


@pytest.mark.parametrize("turn_deg", [0.0, 3.0, 6.0, 20.0])
def test_auto_says_that_it_sees_parallel_lines(turn_deg: float) -> None:
    # At some angles the noise between the lines makes a lattice of crossed ones.
    board = PatternBoard(20.0, turn_deg=turn_deg, pattern="grating", noise=6.0, width=320)
    found = find_lattice(board.picture(np.random.default_rng(0)))
    assert isinstance(found, Rejection)
    assert found.status is LatticeStatus.OTHER_PATTERN
    assert "parallel lines" in found.reason
    assert "grating" in found.reason
