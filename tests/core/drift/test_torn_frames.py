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

"""Frames of which a part is that of the frame before are told from whole ones, and from all that stays the same."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest

from semcal_ros.core.drift.torn_frames import TearTest
from semcal_ros.core.drift.tracker import DriftTracker
from tests.helpers.drift_scenes import Texture, noisy

H, W = 200, 160


def shares(frames: Sequence[np.ndarray]) -> list[float]:
    """Part of the lines of each frame that is old."""
    test, found = TearTest(), []
    for frame in frames:
        test = test.look_at(frame)
        found.append(test.share)
    return found


def noise(seed: int, shape: tuple[int, ...] = (H, W), sigma: float = 6.0) -> np.ndarray:
    grey = 120.0 + sigma * np.random.default_rng(seed).standard_normal(shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def torn(new: np.ndarray, old: np.ndarray, share: float, *, upper: bool) -> np.ndarray:
    """A frame whose upper or lower part is the old one."""
    lines = round(share * len(new))
    parts = (old[:lines], new[lines:]) if upper else (new[:-lines], old[-lines:])
    return np.concatenate(parts)


def with_bar(picture: np.ndarray, text: int) -> np.ndarray:
    """The picture over a data bar, in which letters are drawn: the last of them as ``text`` says."""
    bar = np.zeros((30, picture.shape[1]), np.uint8)
    rng = np.random.default_rng(3)
    for place in range(4, bar.shape[1] - 8, 8):
        last = place >= bar.shape[1] - 36
        glyph = (np.random.default_rng(text * 1000 + place) if last else rng).random((12, 6)) < 0.4
        bar[9:21, place : place + 6] = 250 * glyph
    return np.concatenate([picture[:-30], bar])


@pytest.mark.parametrize("upper", [False, True], ids=["lower", "upper"])
@pytest.mark.parametrize("share", [0.03, 0.5, 0.97])
def test_old_lines_at_an_edge_are_found(share: float, upper: bool) -> None:
    frames = [noise(k) for k in range(6)]
    frames[3] = torn(frames[3], frames[2], share, upper=upper)
    assert shares(frames) == pytest.approx([0.0, 0.0, 0.0, share, 0.0, 0.0])
    # As soon as there are two frames; noise alone tells then.
    assert shares(frames[2:]) == pytest.approx([0.0, share, 0.0, 0.0])


@pytest.mark.parametrize(
    "convert",
    [
        lambda f: f.astype(np.uint16) * 200,
        lambda f: f.astype(np.float32) / 255.0,
        lambda f: np.dstack([f, f, f]),
        lambda f: f[:, :101],
        lambda f: f[:, :5],
        np.asfortranarray,
    ],
    ids=["16 bits", "floats", "colour", "odd width", "narrow", "by columns"],
)
def test_of_all_types_and_widths(convert) -> None:
    frames = [noise(k) for k in range(5)]
    frames[3] = torn(frames[3], frames[2], 0.4, upper=False)
    expected = [0.0, 0.0, 0.0, 0.4, 0.0] if convert(frames[0]).shape[1] > 5 else [0.0] * 5
    assert shares([convert(f) for f in frames]) == pytest.approx(expected)


def test_a_tear_is_found_above_a_data_bar_and_beside_a_border() -> None:
    frames = [with_bar(noise(k), 0) for k in range(5)]
    frames[3] = torn(frames[3], frames[2], 0.5, upper=False)
    # The bar itself says nothing.
    assert shares(frames) == pytest.approx([0.0, 0.0, 0.0, 0.35, 0.0])
    for frame in frames:
        frame[:, :40] = frame[:, -40:] = 0
    assert shares(frames)[3] == pytest.approx(0.35)
    assert [s > 0.0 for s in shares(frames)] == [False, False, False, True, False]


def integrated() -> list[np.ndarray]:
    mean, frames = noise(0).astype(np.float64), []
    for k in range(1, 30):
        mean += (noise(k) - mean) / 64.0
        frames.append(np.rint(mean).astype(np.uint8))
    return frames


def slope_with_a_particle() -> list[np.ndarray]:
    """Without any noise: the particle leaves lines that then stay the same."""
    y, x = np.mgrid[:H, :W].astype(np.float64)
    grey = [
        50.0 + 0.3 * x + 0.2 * y + 90.0 * np.exp(-((x - 60) ** 2 + (y - 20 - 9 * k) ** 2) / 50.0)
        for k in range(8)
    ]
    return [g.astype(np.float32) for g in grey] + [np.rint(g).astype(np.uint8) for g in grey]


def woven() -> list[np.ndarray]:
    """Every frame has the even or the odd lines of a new field."""
    frame, frames = noise(0), []
    for k in range(1, 8):
        frame = frame.copy()
        frame[k % 2 :: 2] = noise(k)[k % 2 :: 2]
        frames.append(frame)
    return frames


def under_a_picture() -> list[np.ndarray]:
    """A still picture with noise of its own below the live one."""
    still = noise(99)
    return [torn(noise(k), still, 0.3, upper=False) for k in range(6)]


@pytest.mark.parametrize(
    "frames",
    [
        [noise(k) for k in range(5)],
        [with_bar(noise(k), 0) for k in range(5)],
        # Three frames for each text of a clock.
        [with_bar(noise(k), k // 3) for k in range(12)],
        [np.pad(noise(k), ((40, 40), (0, 0))) for k in range(5)],
        [noise(k // 2) for k in range(8)],
        [noise(0)] * 4,
        [np.zeros((H, W), np.uint8)] * 3,
        [torn(noise(k), noise(k - 1), 0.015, upper=False) for k in range(1, 6)],
        [noise(k, (H + 8 * (k % 2), W)) for k in range(5)],
        # Counts of few electrons: most pixels have none.
        [np.random.default_rng(k).poisson(0.01, (H, W)).astype(np.uint8) for k in range(6)],
        integrated(),
        slope_with_a_particle(),
        woven(),
    ],
    ids=[
        "noise",
        "data bar",
        "clock",
        "border",
        "sent twice",
        "still",
        "blank",
        "few lines",
        "sizes",
        "electrons",
        "integrated",
        "particle",
        "woven",
    ],
)
def test_what_stays_the_same_for_another_reason_is_no_tear(frames: list[np.ndarray]) -> None:
    assert not any(shares(frames))


def test_a_still_picture_below_the_live_one_costs_the_second_frame_only() -> None:
    assert [s > 0.0 for s in shares(under_a_picture())] == [False, True, False, False, False, False]


def test_a_picture_that_is_read_twice_while_it_is_built_up_is_whole_every_second_time() -> None:
    frames, picture = [], noise(0)
    for k in range(1, 6):
        picture = torn(noise(k), picture, 0.5, upper=False)
        frames.append(picture)
        picture = torn(picture, noise(k), 0.5, upper=False)
        picture = np.concatenate([picture[:100], noise(100 + k)[100:]])
        frames.append(picture)
    found = [s > 0.0 for s in shares(frames)]
    assert not any(a and b for a, b in itertools.pairwise(found))
    assert sum(found) >= 4


def test_a_torn_frame_is_refused_and_leaves_no_trace() -> None:
    """In a slow drift both halves match, the old one at its old place; one of the frames is looked at for overlays."""
    texture, step = Texture(seed=4, n=512), np.array([0.6, -0.4])
    frames = []
    for k in range(14):
        x, y = (k * step).tolist()
        picture = noisy(texture.view((x, y), 192), 6.0, k)
        frames.append(np.clip(np.rint(picture), 0, 255).astype(np.uint8))
    spoilt = {1: False, 7: True, 8: False, 11: True}
    given = [
        torn(f, given_before, 0.5, upper=spoilt[k]) if k in spoilt else f
        for k, (f, given_before) in enumerate(zip(frames, [frames[0], *frames], strict=False))
    ]
    tracker = DriftTracker()
    for k, image in enumerate(given):
        update = tracker.update(image, float(k))
        error = np.abs(update.drift_px - k * step)
        if k in (1, 7, 11):
            says = "coasting: image: torn: 50 % of its lines are those of the previous frame"
            assert update.status_text == says
            assert np.all(error < 4.0 * update.sigma_px)
        elif k != 8:
            assert update.accepted, update.status_text
            assert np.all(error < 4.0 * update.sigma_px + 0.01)
            assert update.fixed_share == 0.0
    assert tracker.state is not None and tracker.state.static.overlay is None
