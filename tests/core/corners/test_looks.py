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

"""Pictures that nobody drew: some of `benchmarks.calibration.looks`, which tells what the rest does."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.calibration.looks.__main__ import judge
from benchmarks.calibration.looks.picture import draw_look, render
from semcal_ros.core.corners import LatticeDetection, find_lattice
from tests.helpers.long_tests import long_but

# What each of them was before: 4, 6, 81 and 73 are square pads and openings half a pitch wide, taken for chess boards
# of pads and gaps; 27 has rough edges 300 px apart, and stated 14 times too small a sigma; 96 large crossings and dust.
CASES = long_but(lambda index: index == 4, (1, 4, 6, 10, 27, 73, 81, 96))


@pytest.mark.slow
@pytest.mark.parametrize("index", CASES)
def test_a_random_picture_of_a_grid_is_found_within_its_sigmas(index: int) -> None:
    look = draw_look(0, index)
    outcome, trace = judge(look, render(look))
    assert not outcome.is_raised, trace
    assert outcome.faults == ()
    # A few dozen points whose scatter is estimated from themselves: 2 is far beyond chance.
    assert outcome.error_sigmas < 2.0


def draw_crosses(size: int, pitch: float, turn_deg: float, blur: float, seed: int) -> np.ndarray:
    """Plus signs with arms 0.35 pitches long and 0.1 wide, by their distance from the nearest pixel centre."""
    y, x = np.mgrid[0.0:size, 0.0:size] - 0.5 * size + 3.3
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    u, v = (c * x + s * y) / pitch, (-s * x + c * y) / pitch
    u, v = np.abs(u - np.rint(u)), np.abs(v - np.rint(v))

    def inside(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        along, across = (0.35 - a) * pitch / blur, (0.05 - b) * pitch / blur
        return 1.0 / ((1.0 + np.exp(-1.7 * along)) * (1.0 + np.exp(-1.7 * across)))

    level = 60.0 + 120.0 * np.maximum(inside(u, v), inside(v, u))
    noise = np.random.default_rng(seed).normal(0.0, 6.0, level.shape)
    return np.clip(np.rint(level + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("pitch", "turn_deg", "blur"), [(24.0, 0.0, 1.0), (40.0, 31.0, 2.0)])
def test_crosses_are_no_chess_board(pitch: float, turn_deg: float, blur: float) -> None:
    """Their saddle points are a chess board's of squares 0.7 pitches wide, turned by 45 degrees."""
    found = find_lattice(draw_crosses(320, pitch, turn_deg, blur, 1))
    assert isinstance(found, LatticeDetection)
    assert (found.pattern, found.odds) == ("crosses", 1e6)
    # Half a hundred points of a few hundredths of a pixel, over a dozen pitches: 0.1 % at five sigmas.
    assert found.spacing_px == pytest.approx(pitch, rel=2e-3)


def test_edges_that_are_rougher_than_the_noise_are_in_the_sigma() -> None:
    """The same crosses, shaken line by line: the noise of pixels does not tell it."""
    picture = draw_crosses(320, 24.0, 7.0, 1.0, 2)
    rng = np.random.default_rng(3)
    rows = np.arange(320)
    shaken = np.stack(
        [
            np.interp(rows + shift, rows, row)
            for shift, row in zip(rng.normal(0, 0.6, 320), picture, strict=True)
        ]
    ).astype(np.uint8)
    still, moved = (find_lattice(image) for image in (picture, shaken))
    assert isinstance(still, LatticeDetection)
    assert isinstance(moved, LatticeDetection)
    assert np.median(moved.sigma_px) > 1.5 * np.median(still.sigma_px)


def draw_rounded(
    square: float, rounded: float, edge: float, electrons: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Dark squares with rounded corners and bright edges on a bright ground, 640 px wide; and their (n, 2) corners."""
    size, turn = 640, np.radians(12.0)
    c, s = np.cos(turn), np.sin(turn)
    y, x = np.mgrid[0.0:size, 0.0:size] - 0.5 * size + 3.3
    u, v = (c * x + s * y) / square, (-s * x + c * y) / square
    is_dark = (np.floor(u) + np.floor(v)) % 2 == 0
    u, v = np.abs(u - np.floor(u) - 0.5), np.abs(v - np.floor(v) - 0.5)
    beyond = np.maximum(np.stack([u, v]) - 0.5 + rounded, 0.0)
    depth = rounded - np.hypot(*beyond) + np.maximum(0.0, 0.5 - rounded - np.maximum(u, v))
    soft = 1.0 / (1.0 + np.exp(-1.7 * depth * square / 1.5))
    bright = 0.75 - 0.4 * np.where(is_dark, soft, 0.0)
    bright += edge * np.exp(-np.minimum(0.5 - u, 0.5 - v) / 0.03)
    level = np.random.default_rng(seed).poisson(bright * electrons) * 150.0 / electrons
    k = np.arange(-9, 10) * square
    corners = np.stack(np.meshgrid(k, k), axis=-1).reshape(-1, 2) @ [[c, s], [-s, c]]
    return np.clip(np.rint(level), 0, 255).astype(np.uint8), corners + 0.5 * size - 3.3


@pytest.mark.parametrize(
    ("square", "rounded", "edge"), [(80.0, 0.15, 0.3), (80.0, 0.18, 0.2), (148.0, 0.15, 0.2)]
)
def test_rounded_squares_with_bright_edges_are_found(
    square: float, rounded: float, edge: float
) -> None:
    """Where four of them meet, a bright spot lies between two saddle points, of which either is found."""
    picture, corners = draw_rounded(square, rounded, edge, 300.0, seed=1)
    found = find_lattice(picture)
    assert isinstance(found, LatticeDetection)
    assert found.pattern == "chess"
    inside = np.all((corners >= 10.0) & (corners <= 629.0), axis=1)
    assert len(found.xy) > 0.8 * np.sum(inside)
    apart = np.linalg.norm(found.xy[:, None] - corners, axis=2)
    errors = found.xy - corners[np.argmin(apart, axis=1)]
    assert np.max(np.abs(errors)) < 1.5
    scores = errors / found.sigma_px[:, None]
    assert np.sqrt(np.mean(scores**2)) < 2.0
