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

"""The corner finder on synthetic boards whose corners are known exactly."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from semcal_ros.core.arrays import Array
from semcal_ros.core.corners import LatticeDetection
from tests.helpers.grids import Board, detected, position_bound


@lru_cache(maxsize=64)
def detect(board: Board, dtype: type = np.uint8) -> LatticeDetection:
    return detected(board.render(np.random.default_rng(0), dtype))


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


@pytest.mark.slow
@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_every_visible_corner_is_found_with_a_true_sigma(board: Board) -> None:
    detection = detect(board)
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


BOUND_BOARDS = {
    "10 px, blur 2": Board(
        10.0, turn_deg=33.0, electrons=300.0, blur_px=2.0, width=300, height=300
    ),
    "10 px, tilt 50, blur 2": Board(
        10.0,
        tilt_deg=50.0,
        axis_deg=20.0,
        turn_deg=60.0,
        electrons=300.0,
        blur_px=2.0,
        width=300,
        height=300,
    ),
    "12 px, blur 2, 25 electrons": Board(
        12.0, turn_deg=71.0, electrons=25.0, blur_px=2.0, width=300, height=300
    ),
    "16 px, tilt 50, blur 1": Board(
        16.0,
        tilt_deg=50.0,
        axis_deg=80.0,
        turn_deg=15.0,
        electrons=100.0,
        blur_px=1.0,
        width=300,
        height=300,
    ),
    "25 px, 25 electrons": Board(
        25.0, turn_deg=20.0, electrons=25.0, blur_px=0.6, width=300, height=300
    ),
    "40 px, blur 1": Board(40.0, turn_deg=43.0, electrons=100.0, blur_px=1.0),
    "80 px, tilt 50, blur 1": Board(
        80.0, tilt_deg=50.0, axis_deg=10.0, turn_deg=50.0, electrons=100.0, blur_px=1.0
    ),
    "130 px, blur 1": Board(130.0, turn_deg=25.0, electrons=100.0, blur_px=1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("board", BOUND_BOARDS.values(), ids=BOUND_BOARDS.keys())
def test_error_is_near_the_cramer_rao_bound(board: Board) -> None:
    detection = detect(board, np.float64)
    ij, xy = board.corners(margin=0.5 * board.square_px)
    bound = np.linalg.inv(position_bound(board, ij))
    distance, nearest = cKDTree(detection.xy).query(xy)
    seen = distance < 1.5
    assert seen.mean() > 0.99
    error = detection.xy[nearest[seen]] - xy[seen]
    ratio = np.sqrt(np.einsum("ni,nij,nj->n", error, bound[seen], error).mean() / 2.0)
    # 1 is perfect; 15 % are for what else has to be fitted, the rest for the scatter of few corners.
    assert ratio < 1.15 + 3.0 / np.sqrt(4.0 * len(error))


@pytest.mark.parametrize("turn", [0.0, 90.0])
def test_edges_along_the_axes_of_the_image(turn: float) -> None:
    # Directions of the edges are at the cut of the arcus tangens.
    board = Board(14.0, turn_deg=turn, electrons=100.0)
    detection = detect(board)
    assert found(board, detection) > 0.99
    # The samples of the rendering move edges along them by up to 1/16 px, all corners alike.
    error = errors(board, detection)
    error -= error.mean(axis=0)
    # The finder's sigmas are true to some 5 %; 1300 corners tell them to 2 %.
    assert (error / detection.sigma_px[:, None]).std() < 1.15


@pytest.mark.parametrize("inverted", [False, True])
def test_wide_bright_squares_do_not_move_corners_at_the_border(inverted: bool) -> None:
    board = Board(115.0, turn_deg=7.0, tilt_deg=15.0, electrons=100.0, blur_px=1.5, growth_px=0.9)
    picture = board.render(np.random.default_rng(0))
    detection = detected(255 - picture if inverted else picture)
    error = errors(board, detection)
    centred = np.abs(detection.xy - board.centre).max(axis=1)
    border = centred > 256.0 - 0.35 * 115.0
    assert border.sum() >= 4
    # One-sided windows see the edges displaced by 0.9 px: unmodelled, that is over ten sigmas.
    assert np.abs(error[border] / detection.sigma_px[border, None]).max() < 4.5


@pytest.mark.parametrize("square", [13.0, 30.0, 100.0])
def test_charging_gradients(square: float) -> None:
    board = Board(square, turn_deg=28.0, tilt_deg=25.0, electrons=100.0)
    rng = np.random.default_rng(2)
    y, x = np.mgrid[0.0:512.0, 0.0:512.0]
    field = np.ones((512, 512))
    for _ in range(6):
        cx, cy, width = rng.uniform(0, 512), rng.uniform(0, 512), rng.uniform(60, 120)
        bump = np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2.0 * width**2))
        field += rng.uniform(-0.4, 0.8) * bump
    counts = rng.poisson(board.clean(4) * field * board.electrons) / board.electrons
    detection = detected(np.clip(counts * 80.0, 0, 255).astype(np.uint8))
    assert found(board, detection) > 0.98
    score = errors(board, detection) / detection.sigma_px[:, None]
    # As for even light, but that the gradients are not the straight ones of the model.
    assert score.std() < 1.2 + 3.0 / np.sqrt(4.0 * len(score))
    assert np.abs(score).max() < 6.0


def test_where_a_part_of_the_image_is_noisier_its_corners_count_as_less_certain() -> None:
    """Noise is learnt by grey value and not by place: there the misfit of each corner tells it."""
    board = Board(20.0, turn_deg=20.0, electrons=2000.0, width=300, height=300)
    picture = 140.0 * board.render(np.random.default_rng(0), np.float64)
    # Several times the noise of the rest.
    picture[:, 225:] += np.random.default_rng(1).normal(scale=4.0, size=(300, 75))
    detection = detected(picture)
    score = errors(board, detection) / detection.sigma_px[:, None]
    noisy = detection.xy[:, 0] > 235.0
    assert noisy.sum() > 30
    # 60 values and more: the spread is known to 10 %. Stated as elsewhere, it would be 1.7.
    assert 0.7 < score[noisy].std() < 1.3


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
    detection = detected(np.vstack([picture, bar]), databar_rows=40)
    assert detection.image_size == (640, 480)
    assert found(board, detection) > 0.99
    assert np.abs(errors(board, detection)).max() < 0.3


def test_bounded_board_gives_its_inner_corners_and_no_others() -> None:
    board = Board(40.0, turn_deg=12.0, electrons=100.0, bounds=(-5, -4, 5, 3))
    detection = detect(board)
    assert len(detection.xy) == 9 * 6
    assert np.abs(errors(board, detection)).max() < 0.2


@pytest.mark.parametrize(
    ("square", "distortion", "size"), [(70.0, -0.5, (512, 400)), (90.0, -0.4, (640, 480))]
)
def test_large_squares_under_the_distortion_of_a_wide_lens(
    square: float, distortion: float, size: tuple[int, int]
) -> None:
    """A quadratic map through their neighbours misses such corners by pixels, and their edges' bends by tenths."""
    board = Board(
        square,
        tilt_deg=25.0,
        axis_deg=30.0,
        turn_deg=8.0,
        distortion=distortion,
        perspective=0.5,
        blur_px=0.7,
        electrons=300.0,
        width=size[0],
        height=size[1],
        bounds=(-4, -3, 4, 3),
    )
    detection = detected(board.render(np.random.default_rng(1)), pattern="chess")
    _ij, truth = board.corners()
    assert len(detection.xy) == len(truth) == 35
    distance, nearest = cKDTree(truth).query(detection.xy)
    assert distance.max() < 0.5
    score = (detection.xy - truth[nearest]) / detection.sigma_px[:, None]
    # 70 coordinates: 1 +- 0.08 for true sigmas. At the rim the edges are no parabolas any more.
    assert np.sqrt(np.mean(score**2)) < 1.5


@pytest.mark.parametrize("square", [15.0, 40.0, 90.0])
def test_debris_and_missing_squares_do_not_make_false_corners(square: float) -> None:
    board = Board(square, turn_deg=25.0, electrons=100.0, tilt_deg=20.0)
    rng = np.random.default_rng(3)
    picture = board.render(rng)
    y, x = np.mgrid[0:512, 0:512]
    cells = np.floor(board.board_from_image(np.column_stack([x.ravel(), y.ravel()]))).astype(int)
    cells -= cells.min(axis=0)
    missing = rng.random(cells.max(axis=0) + 1) < 0.05
    spoilt = missing[cells[:, 0], cells[:, 1]].reshape(512, 512)
    picture[spoilt] = rng.poisson(35.0, int(spoilt.sum()))
    for _ in range(12):
        cx, cy, radius = rng.uniform(0, 512), rng.uniform(0, 512), rng.uniform(6, 20)
        grain = (x - cx) ** 2 + (y - cy) ** 2 < radius**2
        picture[grain] = rng.integers(10, 150)
        spoilt |= grain
    detection = detected(picture)
    # Corners with nothing near them are found, and none is off by half a pixel.
    near = round(0.5 * square)
    clear = cv2.dilate(spoilt.astype(np.uint8), np.ones((near, near), np.uint8)) == 0
    truth = board.corners(margin=5.0)[1]
    column, row = np.rint(truth).astype(int).T
    truth = truth[clear[row, column]]
    assert np.mean(cKDTree(detection.xy).query(truth)[0] < 0.5) > 0.9
    assert np.abs(errors(board, detection)).max() < 0.5
    index_map(board, detection)


@pytest.mark.parametrize("square", [15.0, 24.0, 45.0])
def test_grains_hidden_by_noise_and_blur_do_not_shift_corners(square: float) -> None:
    board = Board(square, turn_deg=25.0, electrons=25.0, tilt_deg=20.0, blur_px=2.0)
    rng = np.random.default_rng(7)
    picture = board.clean(4)
    y, x = np.mgrid[0:512, 0:512]
    covered = np.zeros((512, 512), bool)
    for _ in range(14):
        cx, cy, radius = rng.uniform(0, 512), rng.uniform(0, 512), rng.uniform(4, 20)
        # The grains are as blurred as the board.
        edge = np.clip(0.5 + (radius - np.hypot(x - cx, y - cy)) / (2.5 * board.blur_px), 0.0, 1.0)
        picture = picture * (1.0 - edge) + rng.uniform(0.1, 1.4) * edge
        covered |= edge > 0.02
    detection = detected((rng.poisson(picture * 25.0) / 25.0 * 120.0).clip(0, 255).astype(np.uint8))
    error = errors(board, detection)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(detection.covariance_px2), error)
    # Noise gives five sigmas once in 270 000 corners.
    assert np.mean(squared > 25.0) <= 3e-3
    near = round(0.7 * square)
    clear = cv2.dilate(covered.astype(np.uint8), np.ones((near, near), np.uint8)) == 0
    truth = board.corners(margin=5.0)[1]
    column, row = np.rint(truth).astype(int).T
    untouched = truth[clear[row, column]]
    # Four corners of every 1000 are given up wrongly: by the two checks, at 3.7 and 4 sigmas.
    assert np.mean(cKDTree(detection.xy).query(untouched)[0] < 1.5) > 0.985


def test_rejected_corners_have_positions() -> None:
    board = Board(40.0, turn_deg=12.0, electrons=100.0)
    picture = np.array(board.render(np.random.default_rng(4)))
    truth = board.corners(margin=30.0)[1]
    covered = truth[np.argmin(np.linalg.norm(truth - board.centre, axis=1))]
    cv2.circle(picture, tuple(int(v) for v in np.rint(covered)), 9, 140, -1)
    detection = detected(picture)
    assert detection.rejected == len(detection.rejected_xy) >= 1
    # Where the neighbours expect it, to a part of a pixel.
    assert cKDTree(detection.rejected_xy).query(covered)[0] < 0.5
    assert cKDTree(detection.xy).query(detection.rejected_xy)[0].min() > 20.0


@pytest.mark.parametrize("square", [12.0, 20.0, 40.0])
def test_board_in_a_corner_of_the_image(square: float) -> None:
    board = Board(
        square,
        turn_deg=20.0,
        tilt_deg=15.0,
        electrons=80.0,
        offset=(-170.0 / square, -170.0 / square),
        bounds=(-4, -4, 4, 4),
    )
    detection = detect(board)
    assert found(board, detection) == 1.0
    # Nothing on the border of the board, nothing beside it.
    assert np.abs(errors(board, detection)).max() < 0.5


def test_detection_follows_a_shift_of_the_image() -> None:
    board = Board(24.0, turn_deg=30.0, electrons=80.0)
    picture = board.render(np.random.default_rng(5))
    whole, part = detected(picture), detected(picture[37:, 21:])
    shifted = part.xy + [21.0, 37.0]
    inside = np.all((part.xy > 15) & (part.xy < np.array(part.image_size) - 16), axis=1)
    distance = cKDTree(whole.xy).query(shifted[inside])[0]
    # The same pixels: only the first guess and the noise model differ.
    assert distance.max() < 0.02
