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

"""Dots, holes and crossed lines: positions, their covariances, and which pattern it is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.corners import LatticeDetection, LatticeStatus, find_lattice
from semcal_ros.core.corners.dots_and_lines import (
    bright_cells,
    fit_lattice_shapes,
    grow_at_scale,
    refine_cells,
)
from semcal_ros.core.corners.lattice import prepare_image, screen_image
from semcal_ros.core.errors import InvalidValueError, Rejection
from tests.helpers.grids import Board, PatternBoard, detected, rejected

TILTED = {"tilt_deg": 40.0, "axis_deg": 30.0, "perspective": 0.3, "distortion": 0.05}


def truth(board: PatternBoard, found: LatticeDetection) -> tuple[Array, Array]:
    """Indices on the board and true positions of the points found."""
    ij = np.rint(board.board_from_image(found.xy))
    return ij, board.image_from_board(ij)


def z_scores(board: PatternBoard, found: LatticeDetection) -> Array:
    """(n, 2) whitened errors."""
    error = found.xy - truth(board, found)[1]
    whiten = np.linalg.cholesky(np.linalg.inv(found.covariance_px2))
    return np.asarray(np.einsum("nba,nb->na", whiten, error))


def has_true_indices(board: PatternBoard, found: LatticeDetection) -> bool:
    """Whether the indices are those of the board, but for the origin and quarter turns."""
    ij, _ = truth(board, found)
    columns = np.column_stack([found.ij, np.ones(len(found.ij))])
    matrix = np.linalg.lstsq(columns, ij, rcond=None)[0]
    turn = np.rint(matrix[:2])
    same = np.abs(columns @ matrix - ij).max() < 1e-6
    return bool(same and np.linalg.det(turn) == 1.0 and np.abs(turn).sum() == 2.0)


def visible(board: PatternBoard, *, margin_px: float) -> int:
    """Number of points of the grid at least this far inside the image."""
    return len(board.corners(margin=margin_px)[0]) - len(board.missing)


@pytest.mark.parametrize(
    "board",
    [
        PatternBoard(20.0, turn_deg=7.0, size=0.5, noise=3.0),
        PatternBoard(24.0, turn_deg=7.0, size=0.3, noise=10.0, blur_px=2.0, contrast=60.0, inverted=True),
        PatternBoard(18.0, turn_deg=25.0, size=0.7, noise=6.0, blur_px=1.2, inverted=True, **TILTED),
        PatternBoard(20.0, turn_deg=40.0, size=0.25, noise=4.0, contrast=150.0, shading=0.3, **TILTED),
        PatternBoard(20.0, turn_deg=7.0, pattern="lines", size=0.2, noise=4.0, contrast=40.0),
        PatternBoard(24.0, turn_deg=-20.0, pattern="lines", size=0.1, noise=10.0, blur_px=2.0, inverted=True),
        PatternBoard(22.0, turn_deg=15.0, pattern="lines", size=0.4, noise=5.0, inverted=True, **TILTED),
    ],
    ids=["dots", "small noisy holes", "large holes, tilted", "small dots, tilted", "faint lines",
         "thin noisy dark lines", "wide dark lines, tilted"],
)  # fmt: skip
def test_points_are_found_with_a_true_sigma(board: PatternBoard) -> None:
    found = detected(board.picture(np.random.default_rng(1)))
    assert found.pattern == board.pattern
    assert has_true_indices(board, found)
    # Not those that the frame may cut, and nearly all others.
    # A crossing needs most of the lines on its way to the next.
    reach = board.square_px * (board.size / 2.0 if board.pattern == "dots" else 0.4)
    assert len(found.ij) >= 0.97 * visible(board, margin_px=reach + 3.0)
    z = z_scores(board, found)
    # About 200 numbers, of which the RMS is good to 5 %.
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25
    # The centre of the pattern is that of a mean of 60 cells; four sigmas.
    assert np.abs(z.mean(axis=0)).max() < 4.0 / np.sqrt(60)


def test_perspective_does_not_move_the_centres_of_large_dots() -> None:
    board = PatternBoard(
        36.0, tilt_deg=50.0, perspective=0.4, size=0.8, noise=1.0, contrast=150.0, height=240
    )
    found = detected(board.picture(np.random.default_rng(0)))
    cells, true_xy = truth(board, found)
    # The centroid of the image of a disc is off the image of its centre, here by up to 0.3 px.
    inside = np.linspace(-0.4, 0.4, 41)
    disc = np.stack(np.meshgrid(inside, inside), axis=-1).reshape(-1, 2)
    disc = disc[np.hypot(*disc.T) < 0.4]
    step = 1e-3

    def centroid(cell: Array) -> Array:
        at = board.image_from_board(cell + disc)
        along_u = board.image_from_board(cell + disc + [step, 0.0]) - at
        along_v = board.image_from_board(cell + disc + [0.0, step]) - at
        area = along_u[:, 0] * along_v[:, 1] - along_u[:, 1] * along_v[:, 0]
        return np.asarray((at * area[:, None]).sum(axis=0) / area.sum())

    bias = np.linalg.norm([centroid(cell) for cell in cells] - true_xy, axis=1)
    error = np.linalg.norm(found.xy - true_xy, axis=1)
    assert bias.max() > 0.25
    # Third orders, which the local maps lack, leave a tenth of it.
    assert np.sqrt(np.mean(error**2)) < 0.15 * np.sqrt(np.mean(bias**2))


@dataclass(frozen=True)
class RimmedDots(PatternBoard):
    """Dots with bright rims, brighter on one side: the topographic contrast of an electron image."""

    def _bright(self, uv: Array) -> Array:
        off = uv - np.rint(uv)
        radius = np.hypot(off[:, 0], off[:, 1])
        rim = np.abs(radius - self.size / 2.0) < 0.03
        side = 1.0 + 0.6 * off[:, 0] / np.maximum(radius, 1e-3)
        return np.asarray(0.2 + 0.25 * (radius < self.size / 2.0) + 0.5 * rim * side)


def test_rims_and_shadows_do_not_matter() -> None:
    board = RimmedDots(24.0, turn_deg=7.0, size=0.6, noise=5.0, contrast=150.0)
    found = detected(board.picture(np.random.default_rng(0)))
    assert found.pattern == "dots"
    assert has_true_indices(board, found)
    z = z_scores(board, found)
    # A shadow moves what looks like the centre of all dots alike.
    assert 0.8 < np.sqrt(np.mean((z - z.mean(axis=0)) ** 2)) < 1.25


@dataclass(frozen=True)
class HexagonalDots(PatternBoard):
    """Dots of which each has six neighbours."""

    def _bright(self, uv: Array) -> Array:
        rows = np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
        low = np.floor(uv @ np.linalg.inv(rows))
        corners = [low + [i, j] for i in (0, 1) for j in (0, 1)]
        nearest = np.min([np.linalg.norm(uv - c @ rows, axis=1) for c in corners], axis=0)
        return np.asarray(nearest < self.size / 2.0, dtype=np.float64)


@pytest.mark.parametrize(("size", "tilt_deg"), [(0.3, 40.0), (0.5, 20.0)])
def test_a_hexagonal_lattice_is_refused(size: float, tilt_deg: float) -> None:
    board = HexagonalDots(20.0, turn_deg=7.0, tilt_deg=tilt_deg, noise=4.0, size=size)
    assert rejected(board.picture(np.random.default_rng(0))).status is LatticeStatus.NO_LATTICE


def test_a_grid_is_followed_to_the_frame_from_a_small_part() -> None:
    """Growing from saddle points stops where dots are small and faint; fitting dots goes on from there."""
    board = PatternBoard(12.0, turn_deg=4.0, noise=3.0, width=400, height=60)
    image = screen_image(prepare_image(board.picture(np.random.default_rng(3)), 0))
    assert not isinstance(image, Rejection)
    saddles = grow_at_scale(image, 2.5, 0, (400, 60))
    assert saddles is not None
    whole = bright_cells(image, saddles)
    assert whole is not None
    # Dots of the left fifth, 25 rows away from the other end.
    part = whole.select(whole.xy[:, 0] < 80.0)
    shapes = fit_lattice_shapes(lambda _octave: image, part)
    assert shapes is not None
    found = refine_cells(image, part, shapes.dots)
    assert found is not None
    assert len(found.ij) >= 0.97 * visible(board, margin_px=9.0)


def test_missing_dots_are_left_out() -> None:
    board = PatternBoard(
        20.0, turn_deg=7.0, noise=4.0, missing=((0, 0), (2, 1), (2, 2), (-3, 2), (-1, -3))
    )
    found = detected(board.picture(np.random.default_rng(3)))
    ij, _ = truth(board, found)
    assert not {tuple(row) for row in ij.astype(int)} & set(board.missing)
    assert len(found.ij) >= 0.97 * visible(board, margin_px=8.0)
    assert 0.8 < np.sqrt(np.mean(z_scores(board, found) ** 2)) < 1.25


@pytest.mark.parametrize("pattern", ["dots", "lines"])
def test_a_chess_board_is_not_seen_in_another_pattern(pattern: str) -> None:
    size = {"dots": 0.5, "lines": 0.2}[pattern]
    image = PatternBoard(20.0, turn_deg=7.0, pattern=pattern, size=size, noise=4.0).picture(
        np.random.default_rng(0)
    )
    refused = find_lattice(image, pattern="chess")
    assert isinstance(refused, Rejection)
    assert refused.status is LatticeStatus.OTHER_PATTERN
    assert "by odds of" in refused.reason
    assert f"set the pattern to {pattern} or auto" in refused.reason
    assert detected(image, pattern=pattern).pattern == pattern


def test_the_user_may_call_dots_crosses() -> None:
    """Both have their points at the middle of the motif, and the same pitch."""
    board = PatternBoard(20.0, turn_deg=7.0, size=0.5, noise=4.0)
    image = board.picture(np.random.default_rng(0))
    found = detected(image, pattern="crosses")
    assert found.pattern == "crosses"
    assert found.odds < 1e-3
    assert detected(image).odds > 1e3
    np.testing.assert_allclose(found.xy, detected(image).xy, atol=1e-9)


def test_a_chess_board_is_no_grid_of_dots() -> None:
    image = Board(20.0, turn_deg=7.0, electrons=60.0, width=240, height=200).render(
        np.random.default_rng(0)
    )
    assert detected(image).pattern == "chess"
    for wanted in ("dots", "lines"):
        refused = find_lattice(image, pattern=wanted)
        assert isinstance(refused, Rejection)
        assert refused.reason == (
            f"a chess board, not {'dots' if wanted == 'dots' else 'crossed lines'}, by odds of"
            " more than a million to one: set the pattern to chess or auto"
        )


def test_dots_too_blurred_to_tell_from_squares_are_found_if_asked_for() -> None:
    board = PatternBoard(12.0, turn_deg=7.0, size=0.7, noise=4.0, blur_px=3.0)
    image = board.picture(np.random.default_rng(0))
    assert detected(image).pattern == "chess"
    found = detected(image, pattern="dots")
    assert has_true_indices(board, found)
    assert 0.8 < np.sqrt(np.mean(z_scores(board, found) ** 2)) < 1.25


def test_an_unknown_pattern_is_an_error() -> None:
    with pytest.raises(InvalidValueError, match="auto, chess, dots, crosses, lines"):
        find_lattice(np.zeros((64, 64), np.uint8), pattern="hexagons")


BRIGHT_EDGED = [
    (pitch, length, width)
    for pitch in (24.0, 40.0, 64.0)
    for length, width in ((0.30, 0.14), (0.35, 0.10), (0.35, 0.14), (0.35, 0.16), (0.35, 0.18))
]


@pytest.mark.parametrize(
    ("pitch", "length", "width"),
    [
        # The most slender and the stoutest arms.
        pytest.param(*case, marks=() if case[2] in (0.10, 0.18) else pytest.mark.long)
        for case in BRIGHT_EDGED
    ],
)
def test_crosses_with_bright_edges_are_no_chess_board(
    pitch: float, length: float, width: float
) -> None:
    # Half the length and half the width of the arms; edges that fade within five pixels, as secondary electrons do.
    side, fine, turn = 300, 3, 0.3
    y, x = np.mgrid[0 : side * fine, 0 : side * fine] / fine
    u = (x * np.cos(turn) + y * np.sin(turn)) / pitch
    v = (y * np.cos(turn) - x * np.sin(turn)) / pitch
    u, v = np.abs(u - np.rint(u)), np.abs(v - np.rint(v))
    # Distance from the edge of the nearest arm, in pitches.
    inside = np.maximum(np.minimum(length - u, width - v), np.minimum(width - u, length - v))
    level = np.where(inside > 0.0, 0.4 + 0.5 * np.exp(-0.2 * pitch * np.abs(inside)), 0.3)
    picture = cv2.resize(level, (side, side), interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
    counts = np.random.default_rng(0).poisson(200.0 * picture)
    found = find_lattice(counts.astype(np.float32))
    assert isinstance(found, LatticeDetection), found.reason
    assert found.pattern == "crosses"
    assert found.spacing_px == pytest.approx(pitch, rel=2e-3)
    assert found.odds > 20.0
