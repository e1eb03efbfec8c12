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

"""What moves apart from the specimen is found, left out and said; where nothing says which is which, it is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.registration.agreement import MovingTiles, SpecimenSeen, TileNoise
from semcal_ros.core.registration.illumination import measure_illumination
from semcal_ros.core.registration.register import Registration, prepare_reference, register
from semcal_ros.core.registration.tiles import Pyramid
from tests.helpers.drift_scenes import Texture, noisy

SIZE = 256
GROUND, TOOL = Texture(3), Texture(9)


def with_tool(
    shift: tuple[float, float], reach: float, seed: int, level: float = 210.0
) -> tuple[np.ndarray, np.ndarray]:
    """A texture at a shift with a bright wedge from the left, and where the wedge is."""
    picture = GROUND.view(shift, SIZE)
    mask = np.zeros((SIZE, SIZE), dtype=np.uint8)
    corners = np.array([[-10, 20], [reach * 0.6, 20], [reach, 120], [reach * 0.6, 235], [-10, 235]])
    cv2.fillPoly(mask, [np.rint(corners * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    part = mask / 255.0
    whole = 110.0 + 35.0 * picture / picture.std()
    # The tool has a texture of its own, and takes it along.
    own = TOOL.view((reach, 0.0), SIZE)
    drawn = whole * (1.0 - part) + (level + 15.0 * own / own.std()) * part
    rng = np.random.default_rng(seed)
    return np.clip(drawn + rng.normal(0.0, 6.0, drawn.shape), 0, 255).astype(np.uint8), part > 0.5


def registered(
    before: float, after: float, shift: tuple[float, float], sigma_px: float | None = 0.5
) -> tuple[Registration, np.ndarray]:
    reference = prepare_reference(with_tool((0.0, 0.0), before, 0)[0])
    image, covered = with_tool(shift, after, 1)
    covariance = None if sigma_px is None else np.eye(2) * sigma_px**2
    guess = np.array(shift) + [0.2, -0.2]
    return register(reference, image, guess_px=guess, guess_covariance=covariance), covered


@pytest.mark.parametrize("reach", [60.0, 90.0, 130.0])
def test_a_tool_does_not_pull_the_specimen_along(reach: float) -> None:
    shift = (2.3, -1.4)
    found, covered = registered(reach - 12.0, reach, shift)
    assert found.accepted, found.reason
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.shift_px - shift) < np.maximum(4.0 * sigma, 0.01))
    assert np.max(sigma) < 0.05
    assert found.moving is not None
    shown = found.moving.draw((SIZE, SIZE)) > 0
    # Tiles of 8 to 10 px: the edge is known to one of them.
    inner = cv2.erode(covered.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    outer = cv2.dilate(covered.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    # What its texture has in common with the ground by chance is not seen to move.
    assert shown[inner].mean() > 0.5
    assert shown[~outer].mean() < 0.02
    assert found.moving.share == pytest.approx(covered.mean(), abs=0.1)


def test_where_all_moves_alike_nothing_is_left_out() -> None:
    for seed in range(5):
        pair = [
            noisy(GROUND.view(s, SIZE), 4.0, 2 * seed + k) for k, s in enumerate([(0, 0), (3.2, 1)])
        ]
        found = register(prepare_reference(pair[0]), pair[1])
        assert found.accepted
        assert found.moving is None


def test_half_and_half_without_a_prediction_is_refused() -> None:
    reference = noisy(GROUND.view((0.0, 0.0), SIZE), 4.0, 0)
    other = Texture(8)
    image = noisy(GROUND.view((6.0, 0.0), SIZE), 4.0, 1)
    reference[:, : SIZE // 2] = noisy(other.view((0.0, 0.0), SIZE), 4.0, 2)[:, : SIZE // 2]
    image[:, : SIZE // 2] = noisy(other.view((-6.0, 2.0), SIZE), 4.0, 3)[:, : SIZE // 2]
    assert not register(prepare_reference(reference), image).accepted
    # A prediction says which of the two is the specimen.
    for shift in ((6.0, 0.0), (-6.0, 2.0)):
        found = register(
            prepare_reference(reference),
            image,
            guess_px=shift,
            guess_covariance=np.eye(2) * 0.2**2,
        )
        assert found.accepted, found.reason
        np.testing.assert_allclose(found.shift_px, shift, atol=0.05)


def test_the_mask_lies_where_the_tiles_are() -> None:
    tiles = np.zeros((4, 5), dtype=bool)
    tiles[1:3, 2:4] = True
    moving = MovingTiles.of(tiles, np.array([3.0, 5.0]), np.array([10.0, 8.0]))
    drawn = moving.draw((64, 48))
    assert drawn.shape == (48, 64)
    rows, cols = np.nonzero(drawn)
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (13, 28, 23, 42)
    shifted = moving.draw((128, 96), moved_px=np.array([-3.0, -5.0]), scale=2.0)
    rows, cols = np.nonzero(shifted)
    # Each pixel of 8 to 23 and 20 to 39 is two by two.
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (16, 47, 40, 79)
    zoomed = moving.draw((64, 48), zoom=2.0)
    rows, cols = np.nonzero(zoomed)
    # From the middle, 24 and 32 px from the corner of the first pixel: rows 13 to 29 and columns 23 to 43.
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (2, 33, 14, 53)


def test_one_tile_alone_is_no_body() -> None:
    tiles = np.zeros((6, 6), dtype=bool)
    tiles[2, 3] = True
    assert MovingTiles.of(tiles, np.zeros(2), np.ones(2)).share == 0.0


def faint_ground(
    seed: int, shift: tuple[float, float], contrast: float, level: float = 0.0, lit: bool = False
) -> np.ndarray:
    """A ground that noise nearly hides, a part of it brighter by ``level``: covered by a body, or ``lit``."""
    picture = GROUND.view(shift, FAINT_SIZE)
    whole = 110.0 + contrast * picture / picture.std()
    body = 0.0 if level == 0.0 else FAINT_BODY
    drawn = whole + level * body if lit else whole * (1.0 - body) + (110.0 + level) * body
    return np.asarray(drawn + np.random.default_rng(seed).normal(0.0, 22.0, drawn.shape))


FAINT_SIZE = 384
_y, _x = np.mgrid[:FAINT_SIZE, :FAINT_SIZE]
FAINT_BODY = cv2.GaussianBlur((_x < 150 - 0.2 * np.abs(_y - 190)).astype(np.float64), (0, 0), 1.0)


@pytest.mark.parametrize("level", [-30.0, 60.0])
@pytest.mark.parametrize("contrast", [10.0, 20.0, 30.0])
def test_a_body_over_a_faint_ground_is_found_by_its_brightness(
    contrast: float, level: float
) -> None:
    shift = (2.3, -1.4)
    reference = prepare_reference(faint_ground(0, (0.0, 0.0), contrast))
    image = faint_ground(1, shift, contrast, level)
    found = register(
        reference, image, guess_px=np.array(shift) + 0.2, guess_covariance=np.eye(2) * 0.25
    )
    assert found.accepted, found.reason
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.shift_px - shift) < 3.5 * sigma)
    assert np.max(sigma) < 2.0 / contrast
    assert found.moving is not None
    shown = found.moving.draw((FAINT_SIZE, FAINT_SIZE)) > 0
    # No tile for itself says that the ground is missing: of a body that few of them see, 3 % are shown.
    assert shown[FAINT_BODY > 0.99].mean() > 0.75
    assert shown[FAINT_BODY < 0.01].mean() < 0.02


@pytest.mark.parametrize("level", [-30.0, 60.0])
@pytest.mark.parametrize("contrast", [20.0, 30.0])
def test_a_faint_ground_that_is_lit_otherwise_is_no_body(contrast: float, level: float) -> None:
    shift = (2.3, -1.4)
    reference = prepare_reference(faint_ground(0, (0.0, 0.0), contrast))
    image = faint_ground(1, shift, contrast, level, lit=True)
    found = register(
        reference, image, guess_px=np.array(shift) + 0.2, guess_covariance=np.eye(2) * 0.25
    )
    assert found.accepted, found.reason
    assert found.moving is None
    assert np.all(np.abs(found.shift_px - shift) < 3.5 * np.sqrt(np.diag(found.covariance)))


@pytest.mark.parametrize("level", [-60.0, 60.0])
@pytest.mark.parametrize("contrast", [20.0])
def test_what_covers_a_faint_ground_is_no_light(contrast: float, level: float) -> None:
    for seed in range(3):
        reference = prepare_reference(faint_ground(10 + seed, (0.0, 0.0), contrast))
        image = faint_ground(20 + seed, (0.0, 0.0), contrast, level).astype(np.float32)
        finest = reference.levels[-1]
        noise = TileNoise.of(finest.sigma_px, reference.noise_variance, 22.0**2)
        assert measure_illumination(finest, Pyramid(image), np.zeros(2), noise) is None


@pytest.mark.parametrize("level", [-60.0, 60.0])
@pytest.mark.parametrize("seed", range(2))
def test_beside_a_body_a_ground_is_followed_that_no_tile_shows_for_itself(
    seed: int, level: float
) -> None:
    tracker, tracked, velocity = DriftTracker(), 0, np.array([0.3, -0.2])
    for k in range(14):
        view = GROUND.view(tuple(k * velocity), FAINT_SIZE)
        body = (_x < 18.0 * (k - 2) - 0.2 * np.abs(_y - 190)).astype(np.float64)
        body = cv2.GaussianBlur(body, (0, 0), 1.0)
        drawn = (110.0 + 4.0 * view / view.std()) * (1.0 - body) + (110.0 + level) * body
        noise = np.random.default_rng([seed, k]).normal(0.0, 22.0, drawn.shape)
        update = tracker.update(drawn + noise, float(k))
        off = np.abs(update.drift_px - k * velocity)
        assert np.all((off < 0.1) | (off < 4.0 * update.sigma_px)), (k, off, update.sigma_px)
        tracked += update.accepted
    # Four, where only the tiles count that stand out one by one.
    assert tracked >= 10


def test_a_faint_ground_alone_has_no_body() -> None:
    reference = prepare_reference(faint_ground(0, (0.0, 0.0), 10.0))
    for seed in range(1, 21):
        image = faint_ground(seed, (2.3, -1.4), 10.0)
        found = register(reference, image, guess_px=(2.3, -1.4), guess_covariance=np.eye(2) * 0.25)
        # Single tiles, by chance.
        assert found.moving is None or found.moving.share < 0.02


def scratched(seed: int, across_px: float, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Scratches in one direction, moved across themselves, with a flat body that comes in from the left."""
    u = np.cos(0.3) * _x + np.sin(0.3) * _y - across_px
    places = np.random.default_rng(7).uniform(-100.0, 500.0, 90)
    scratches = np.sum([np.exp(-0.5 * ((u - place) / 1.5) ** 2) for place in places], axis=0)
    body = (_x < reach - 0.2 * np.abs(_y - 190)).astype(np.float64)
    body = cv2.GaussianBlur(body, (0, 0), 1.0)
    drawn = (60.0 + 60.0 * scratches) * (1.0 - body) + 190.0 * body
    rng = np.random.default_rng(seed)
    return np.asarray(drawn + rng.normal(0.0, 10.0, drawn.shape)), body


@pytest.mark.parametrize("reach", [70.0, 150.0])
def test_across_lines_a_shift_is_measured_beside_a_body(reach: float) -> None:
    across = np.array([np.cos(0.3), np.sin(0.3)])
    reference = prepare_reference(scratched(0, 0.0, -50.0)[0])
    image, body = scratched(1, 1.7, reach)
    found = register(
        reference,
        image,
        guess_px=1.9 * across,
        guess_covariance=np.eye(2) * 0.25,
        takes_lines=True,
    )
    assert found.accepted, found.reason
    assert found.along is not None
    assert abs(float(found.along @ across)) < 0.01
    sigma = float(np.sqrt(across @ found.covariance @ across))
    assert sigma < 0.03
    assert abs(float(found.shift_px @ across) - 1.7) < 4.0 * sigma
    assert found.moving is not None
    shown = found.moving.draw((FAINT_SIZE, FAINT_SIZE)) > 0
    assert shown[body > 0.99].mean() > 0.7
    assert shown[body < 0.01].mean() < 0.05


def test_lines_at_equal_distances_are_refused_also_where_they_are_predicted() -> None:
    """Any multiple of their distance fits as well, and a prediction that is off by one would choose that."""
    u = np.cos(0.3) * _x + np.sin(0.3) * _y
    rng = np.random.default_rng(3)
    for period in (4.0, 8.0):
        frames = [
            60.0 + 30.0 * (1.0 + np.cos(2.0 * np.pi * (u - moved) / period)) for moved in (0.0, 0.4)
        ]
        noisy_frames = [frame + rng.normal(0.0, 10.0, frame.shape) for frame in frames]
        for off in (0.2, period - 0.6):
            found = register(
                prepare_reference(noisy_frames[0]),
                noisy_frames[1],
                guess_px=(0.4 + off) * np.array([np.cos(0.3), np.sin(0.3)]),
                guess_covariance=np.eye(2) * 0.9,
                takes_lines=True,
            )
            assert not found.accepted, (period, off, found.shift_px)


@pytest.mark.parametrize(
    ("reach", "off_px", "sigma_px"),
    [
        pytest.param(150.0, 0.2, 3.0, id="predicted too roughly"),
        pytest.param(150.0, 3.5, 0.3, id="not predicted there"),
        pytest.param(290.0, 0.2, 0.5, id="less than the body"),
    ],
)
def test_across_lines_nothing_is_kept_that_the_prediction_does_not_tell(
    reach: float, off_px: float, sigma_px: float
) -> None:
    across = np.array([np.cos(0.3), np.sin(0.3)])
    found = register(
        prepare_reference(scratched(0, 0.0, -50.0)[0]),
        scratched(1, 1.7, reach)[0],
        guess_px=(1.7 + off_px) * across,
        guess_covariance=np.eye(2) * sigma_px**2,
        takes_lines=True,
    )
    assert not found.accepted


@pytest.mark.parametrize("part", [0.55, 0.7])
def test_a_stage_that_moves_within_a_frame_of_lines_is_no_tool(part: float) -> None:
    across = np.array([np.cos(0.3), np.sin(0.3)])
    reference = prepare_reference(scratched(0, 0.0, -50.0)[0])
    image, moved = scratched(1, 1.5, -50.0)[0], scratched(2, 7.5, -50.0)[0]
    line = int(part * FAINT_SIZE)
    image[line:] = moved[line:]
    found = register(
        reference, image, guess_px=1.5 * across, guess_covariance=np.eye(2) * 0.25, takes_lines=True
    )
    assert not found.accepted


def test_the_mask_of_a_part_of_an_image_of_lines_lies_at_its_place() -> None:
    across = np.array([np.cos(0.3), np.sin(0.3)])
    reference = prepare_reference(scratched(0, 0.0, -50.0)[0], region=(40, 0, 384, 384))
    image, body = scratched(1, 1.7, 150.0)
    found = register(
        reference,
        image,
        guess_px=1.9 * across,
        guess_covariance=np.eye(2) * 0.25,
        image_region=(40, 0, 384, 384),
        takes_lines=True,
    )
    assert found.accepted and found.moving is not None, found.reason
    shown = found.moving.draw((FAINT_SIZE, FAINT_SIZE)) > 0
    inside = _x >= 50
    assert shown[(body > 0.99) & inside].mean() > 0.7
    assert shown[body < 0.01].mean() < 0.05


def seen(
    offset: np.ndarray, shown: np.ndarray, pixels: np.ndarray | float = 100.0, gain: float = 1.0
) -> SpecimenSeen:
    """Tiles with a structure of 30 each, of which ``shown`` (rows, cols) is seen, under noise of variance 1."""
    ones = np.ones(offset.shape)
    noise = TileNoise(1.0, gain**2, 1.0, 1.0)
    return SpecimenSeen(offset, 30.0 * ones, 30.0 * gain * shown, pixels * ones, noise, 4.0, gain)


HALF = np.tile(np.arange(12) < 5, (12, 1))


@pytest.mark.parametrize("gain", [0.1, 1.0, 10.0])
def test_a_body_is_missed_by_its_tiles_together_whatever_the_contrast(gain: float) -> None:
    rng = np.random.default_rng(0)
    offset = gain * (30.0 * HALF + rng.normal(0.0, 1.0, HALF.shape))
    found = seen(offset, 1.0 - HALF, gain=gain)
    assert found.find_gain() == pytest.approx(gain)
    least = 0.6 * found.find_gain()
    assert np.array_equal(found.find_missing(least, least), HALF)
    # As bright, and it shows the specimen.
    lit = seen(offset, np.ones(HALF.shape), gain=gain)
    assert not np.any(lit.find_missing(least, least))


def test_of_a_body_that_stands_apart_little_need_be_known() -> None:
    """One tile in eight tells of the specimen. Under light that rises evenly, what shows less of it stays in."""
    rng = np.random.default_rng(0)
    body = np.zeros((12, 12), dtype=bool)
    body[4:7, 4:7] = True
    noise = rng.normal(0.0, 1.0, body.shape)
    shown = 1.0 - 0.8 * body
    standing = seen(30.0 * body + noise, shown)
    assert standing.apart > 4.5
    assert np.array_equal(standing.find_missing(0.2, 0.2), body)
    rising = np.tile(np.linspace(-30.0, 30.0, 12), (12, 1)) + noise
    even = seen(rising, np.where(rising > 0.0, 0.45, 1.0))
    assert even.apart < 4.5
    assert not np.any(even.find_missing(0.2, 0.2))


def test_tiles_without_pixels_are_of_no_class() -> None:
    rng = np.random.default_rng(0)
    offset = np.where(HALF, 30.0, -30.0) + rng.normal(0.0, 1.0, HALF.shape)
    pixels = np.full(HALF.shape, 100.0)
    offset[-4:], pixels[-4:] = 0.0, 1.0
    found = seen(offset, 1.0 - HALF, pixels)
    assert found.apart > 30.0
    missing = found.find_missing(0.6, 0.6)
    assert np.array_equal(missing[:-4], HALF[:-4]) and not np.any(missing[-4:])
