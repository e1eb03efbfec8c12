"""The corner finder on synthetic boards whose corners are known exactly."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from corner_boards import Board
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semcal_ros.core.corners import LatticeDetection, find_lattice

Array = NDArray[np.float64]


@lru_cache(maxsize=64)
def detect(board: Board, dtype: type = np.uint8) -> LatticeDetection:
    return find_lattice(board.render(np.random.default_rng(0), dtype))


def errors(board: Board, detection: LatticeDetection) -> Array:
    """(n, 2) errors of the detected corners against the nearest true one."""
    truth = board.corners(margin=0.0)[1]
    return detection.xy - truth[cKDTree(truth).query(detection.xy)[1]]


def found(board: Board, detection: LatticeDetection, margin: float = 5.0) -> float:
    """Part of the visible corners that were detected to within a pixel."""
    truth = board.corners(margin)[1]
    return float(np.mean(cKDTree(detection.xy).query(truth)[0] < 1.0))


def index_map(board: Board, detection: LatticeDetection) -> Array:
    """(3, 2) affine map from detected to true indices; fails unless it holds for every corner."""
    ij, xy = board.corners(margin=0.0)
    true_ij = ij[cKDTree(xy).query(detection.xy)[1]]
    design = np.column_stack([detection.ij, np.ones(len(detection.ij))])
    solution = np.linalg.lstsq(design, true_ij, rcond=None)[0]
    assert np.abs(design @ solution - true_ij).max() < 1e-6
    return np.asarray(solution)


BOARDS = {
    "10 px": Board(10.0, turn_deg=33.0, electrons=25.0),
    "11 px, tilt 40, like 100x": Board(
        11.0, tilt_deg=40.0, axis_deg=20.0, turn_deg=8.0, electrons=60.0
    ),
    "20 px, tilt 50, blur 2": Board(
        20.0, tilt_deg=50.0, axis_deg=20.0, turn_deg=33.0, electrons=100.0, blur_px=2.0
    ),
    "30 px, inverted, tilt 50, strong shading": Board(
        30.0,
        tilt_deg=50.0,
        axis_deg=70.0,
        turn_deg=73.0,
        electrons=50.0,
        shading=1.0,
        inverted=True,
    ),
    "30 px, distortion and perspective": Board(
        30.0, tilt_deg=40.0, axis_deg=70.0, distortion=0.06, perspective=0.3, electrons=50.0
    ),
    "30 px, barrel": Board(30.0, turn_deg=20.0, distortion=-0.1, electrons=50.0),
    "40 px, tilt 50, blur 2, 25 electrons": Board(
        40.0, tilt_deg=50.0, axis_deg=10.0, turn_deg=60.0, electrons=25.0, blur_px=2.0
    ),
    "80 px, tilt 50": Board(80.0, tilt_deg=50.0, axis_deg=100.0, turn_deg=20.0, electrons=50.0),
    "130 px": Board(130.0, turn_deg=20.0, electrons=25.0),
    "130 px, distortion": Board(130.0, turn_deg=40.0, electrons=25.0, distortion=0.05),
}


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_every_visible_corner_is_found_with_a_true_sigma(board: Board) -> None:
    detection = detect(board)
    assert detection.accepted, detection.reason
    assert found(board, detection) > 0.98
    error = errors(board, detection)
    score = error / detection.sigma_px[:, None]
    # A corner that is off by more than the noise allows is a false one; 5.5 sigma happens once in
    # 10^7.
    assert np.abs(score).max() < 5.5
    # Few corners leave the scatter of the scores itself uncertain: 3 / sqrt(2 * 2 n) on top of 15 %
    # model tolerance.
    slack = 0.15 + 3.0 / np.sqrt(4.0 * len(score))
    assert 1.0 - slack < score.std() < 1.0 + slack
    assert abs(error.mean()) < 4.0 * np.sqrt(np.mean(detection.sigma_px**2) / error.size) + 0.003


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_indices_are_consistent_and_right_handed(board: Board) -> None:
    detection = detect(board)
    turn = index_map(board, detection)[:2]
    # The true axes are right-handed, so the two differ by a rotation by a multiple of 90 degrees.
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(turn, np.round(turn), atol=1e-6)


@pytest.mark.parametrize("tilt", [0.0, 30.0, 50.0])
def test_spacing_is_that_without_foreshortening(tilt: float) -> None:
    board = Board(36.0, tilt_deg=tilt, axis_deg=25.0, turn_deg=15.0, electrons=100.0)
    # A 0.05 px corner over a local map of 5 x 5 squares: 0.3 % is several sigma.
    assert detect(board).spacing_px == pytest.approx(36.0, rel=3e-3)


def cramer_rao_sigma(board: Board, picture: Array, xy: Array) -> Array:
    """(n,) bound for corners at ``xy`` if only position and edge directions were unknown.

    The information is that of the Poisson counts in a window of half a square around each corner,
    with the derivative of the noise-free picture taken from the rendered board itself, by shifting
    it; nothing of the finder is used. Moving the picture in the window moves the corner; directions
    do not correlate with it in a symmetric window.
    """
    variance = picture / board.electrons
    by_y, by_x = np.gradient(picture)
    half = int(board.square_px * 0.5 / np.sqrt(2.0))
    sigmas = []
    for x, y in np.round(xy).astype(int):
        rows, columns = slice(y - half, y + half + 1), slice(x - half, x + half + 1)
        gradient = np.stack([by_x[rows, columns].ravel(), by_y[rows, columns].ravel()])
        information = (gradient / variance[rows, columns].ravel()) @ gradient.T
        sigmas.append(np.sqrt(np.trace(np.linalg.inv(information)) / 2.0))
    return np.array(sigmas)


@pytest.mark.parametrize("turn", [43.0, 37.0])
def test_error_is_near_the_cramer_rao_bound(turn: float) -> None:
    # Turned by about 45 degrees, the axis-parallel square window of the bound lies inside of the
    # cell around the corner.
    board = Board(40.0, turn_deg=turn, electrons=100.0, blur_px=1.0)
    detection = detect(board, np.float64)
    inside = np.all((detection.xy > 25) & (detection.xy < 486), axis=1)
    # Both windows hold the same length of the edges: half a square each way.
    bound = cramer_rao_sigma(board, board.clean(), detection.xy[inside])
    rms = np.sqrt(np.mean(errors(board, detection)[inside] ** 2))
    assert rms < 1.3 * np.sqrt(np.mean(bound**2))


def test_noise_free_board_is_found_to_a_hundredth() -> None:
    board = Board(40.0, turn_deg=10.0, tilt_deg=20.0, axis_deg=40.0)
    error = errors(board, detect(board, np.float64))
    # 8 x 8 samples per pixel render edges with errors of up to this size.
    assert np.sqrt(np.mean(error**2)) < 0.01


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_depth_does_not_matter(dtype: type) -> None:
    board = Board(30.0, turn_deg=20.0, electrons=50.0)
    reference, detection = detect(board, np.float64), detect(board, dtype)
    assert len(detection.xy) == len(reference.xy)
    # 8 bit: rounding adds a noise of 0.3 grey levels to about 10 of shot noise.
    assert np.abs(np.sort(detection.xy[:, 0]) - np.sort(reference.xy[:, 0])).max() < 0.05


def test_databar_is_left_out_and_other_sizes_work() -> None:
    board = Board(25.0, turn_deg=12.0, electrons=100.0, width=640, height=480)
    picture = board.render(np.random.default_rng(1))
    bar = np.zeros((40, 640), np.uint8)
    bar[:, ::7] = 255
    detection = find_lattice(np.vstack([picture, bar]), databar_rows=40)
    assert detection.accepted and detection.image_size == (640, 480)
    assert found(board, detection) > 0.99
    assert np.abs(errors(board, detection)).max() < 0.3


def test_bounded_board_gives_its_inner_corners_and_no_others() -> None:
    board = Board(40.0, turn_deg=12.0, electrons=100.0, bounds=(-5, -4, 5, 3))
    detection = detect(board)
    assert detection.accepted
    assert len(detection.xy) == 9 * 6
    assert np.abs(errors(board, detection)).max() < 0.2


def test_debris_and_missing_squares_do_not_make_false_corners() -> None:
    board = Board(40.0, turn_deg=25.0, electrons=100.0, tilt_deg=20.0)
    rng = np.random.default_rng(3)
    picture = board.render(rng)
    y, x = np.mgrid[0:512, 0:512]
    for _ in range(12):
        cx, cy, radius = rng.uniform(0, 512), rng.uniform(0, 512), rng.uniform(6, 20)
        picture[(x - cx) ** 2 + (y - cy) ** 2 < radius**2] = rng.integers(10, 150)
    detection = find_lattice(picture)
    assert detection.accepted
    # Debris hides some corners; the others are found, and none is off by half a pixel.
    assert found(board, detection) > 0.75
    assert np.abs(errors(board, detection)).max() < 0.5
    index_map(board, detection)


def test_detection_follows_a_shift_of_the_image() -> None:
    board = Board(24.0, turn_deg=30.0, electrons=80.0)
    picture = board.render(np.random.default_rng(5))
    whole, part = find_lattice(picture), find_lattice(picture[37:, 21:])
    shifted = part.xy + [21.0, 37.0]
    inside = np.all((part.xy > 15) & (part.xy < np.array(part.image_size) - 16), axis=1)
    distance = cKDTree(whole.xy).query(shifted[inside])[0]
    # The same pixels: only the first guess and the noise model differ.
    assert distance.max() < 0.02
