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

"""Stripes do not pull the drift, and are not found where there are none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.drift.stripes import Stripes, find_lone_lines, find_stripes, suspect_stripes
from semcal_ros.core.drift.thresholds import STRIPE_CELLS_TRIED
from semcal_ros.core.drift.tracker import DriftTracker
from tests.helpers.drift_scenes import Texture, noisy

SIZE, CONTRAST, NOISE = 384, 13.0, 11.0
STEP = np.array([0.6, -0.4])
#: (h, w) brightness that the frame with this number has besides.
Drawn = Callable[[int], np.ndarray]
y = np.arange(SIZE)[:, None] * np.ones((1, SIZE))


def _frame(texture: Texture, shift: np.ndarray, seed: int, besides: np.ndarray) -> np.ndarray:
    x_px, y_px = shift.tolist()
    grey = noisy(texture.view((x_px, y_px), SIZE), NOISE, seed, contrast=CONTRAST) + besides
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _track(drawn: Drawn, frames: int = 14, seed: int = 3) -> tuple[list[DriftUpdate], np.ndarray]:
    """The updates, and their errors over sigma (n, 2)."""
    texture, tracker = Texture(seed), DriftTracker()
    updates = [
        tracker.update(_frame(texture, k * STEP, 100 * seed + k, drawn(k)), float(k))
        for k in range(frames)
    ]
    errors = np.array([u.drift_px for u in updates]) - np.outer(np.arange(frames), STEP)
    sigmas = np.array([u.sigma_px for u in updates])
    return updates, errors[1:] / sigmas[1:]


def _hum(amplitude: float, period: float, rolls: float = 0.0) -> Drawn:
    return lambda k: amplitude * np.sin(2.0 * np.pi * (y / period + rolls * k))


def _own_lines(amplitude: float) -> Drawn:
    return lambda k: amplitude * np.random.default_rng(k).normal(size=(SIZE, 1)) + 0.0 * y


def _cross_hair(amplitude: float) -> Drawn:
    """As recorded from a screen, with the noise of the picture: one line and one column."""
    lines = np.zeros((SIZE, SIZE))
    lines[SIZE // 2], lines[:, SIZE // 2] = amplitude, amplitude
    return lambda k: lines


@pytest.mark.parametrize(
    ("drawn", "stripes"),
    [
        pytest.param(_cross_hair(80.0), Stripes(lines=True, columns=True), id="cross-hair"),
        pytest.param(_hum(3.0, 8.5), Stripes(lines=True), id="hum"),
        pytest.param(_hum(8.0, 8.5, 0.13), Stripes(lines=True), id="hum that rolls"),
        pytest.param(lambda k: _hum(3.0, 8.5)(k).T, Stripes(columns=True), id="columns"),
        pytest.param(_own_lines(12.0), Stripes(lines=True), id="lines of their own"),
    ],
)
def test_stripes_do_not_pull_the_drift(drawn: Drawn, stripes: Stripes) -> None:
    """With a quarter of the specimen's contrast they had pulled it by 0.3 px, 25 sigmas."""
    updates, scores = _track(drawn)
    assert all(u.accepted for u in updates)
    assert updates[-1].stripes == stripes
    # They are found once the specimen has moved by a part of their period.
    assert np.max(np.abs(scores[6:])) < 4.0


@pytest.mark.long
def test_noise_and_what_moves_are_no_stripes() -> None:
    """Neither texture, nor lines of the specimen itself, which move with it; nor a tool with an edge along columns."""
    wires = np.random.default_rng(5).normal(size=(2 * SIZE, 1))
    wires = np.convolve(wires[:, 0], np.hanning(9), "same")[:, None] * np.ones((1, SIZE))

    def lines(k: int) -> np.ndarray:
        places = np.arange(SIZE) - k * STEP[1] + 100.0
        return 6.0 * np.interp(places, np.arange(2 * SIZE), wires[:, 0])[:, None] + 0.0 * y

    def tool(k: int) -> np.ndarray:
        return np.where(40.0 + 5.0 * k > y.T, 60.0, 0.0)

    for drawn in (lambda _k: 0.0 * y, lines, tool):
        updates, _ = _track(drawn, frames=12)
        assert updates[-1].stripes == Stripes()


def test_lone_lines_run_through_all_of_an_image() -> None:
    rng = np.random.default_rng(4)
    noise = [rng.normal(100.0, NOISE, (SIZE, SIZE)).astype(np.float32) for _ in range(50)]
    assert not any(find_lone_lines(image) for image in noise)
    (image, *_) = noise
    half = image.copy()
    half[100:102, : SIZE // 2] += 60.0
    assert not find_lone_lines(half)
    line = image.copy()
    line[100:102, 40:-40] -= 60.0
    assert find_lone_lines(line) == Stripes(lines=True)
    assert find_lone_lines(line.T) == Stripes(columns=True)
    # What hides it may be a tool.
    hidden = np.zeros((SIZE, SIZE), dtype=bool)
    hidden[90:110] = True
    assert not find_lone_lines(line, hidden)
    assert not find_lone_lines(line[:, :20].T)


def test_few_images_of_noise_look_like_stripes() -> None:
    """None of 400 directions does, so that the rate is below 0.75 % (95 % confidence)."""
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(100):
        pair = rng.normal(size=(2, 128, 160)).astype(np.float32)
        for stripes in (suspect_stripes(pair[0]), find_stripes(*pair, np.array([2.3, -1.6]))):
            found += stripes.lines + stripes.columns
    assert found == 0


def test_a_tool_that_is_known_is_not_suspected_to_be_stripes() -> None:
    """A bright tool with a slanted edge over a third of an image of noise, and then with stripes in all of it."""
    rng = np.random.default_rng(2)
    at_y, at_x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    tool = at_y < SIZE / 3.0 + 0.05 * at_x
    image = rng.normal(size=(SIZE, SIZE)) + 60.0 * tool
    striped = image + np.sin(2.0 * np.pi * at_y / 23.0)
    least = STRIPE_CELLS_TRIED
    assert suspect_stripes(image.astype(np.float32), None, least).lines
    assert suspect_stripes(image.astype(np.float32), tool, least) == Stripes()
    assert suspect_stripes(striped.astype(np.float32), tool, least) == Stripes(lines=True)
    # Of what is left beside a tool over most of the image, little says what its lines have in common.
    assert suspect_stripes(striped.astype(np.float32), at_y < 0.8 * SIZE, least) == Stripes()


def test_lines_without_stripes_have_one_median() -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 200, (65, 80)).astype(np.uint8)
    for stripes, axes in ((Stripes(True, False), (1,)), (Stripes(False, True), (0,))):
        freed = stripes.remove_from(image)
        assert freed.dtype == np.float32
        for axis in axes:
            np.testing.assert_allclose(np.median(freed, axis=axis), 0.0, atol=1e-4)
    assert Stripes().remove_from(image) is image
    assert Stripes(True, False) | Stripes(False, True) == Stripes(True, True)


def test_a_frozen_frame_stays_refused_where_stripes_are_suspected() -> None:
    """Noise never comes twice, with stripes or without."""
    texture, tracker = Texture(3), DriftTracker()
    frames = [_frame(texture, k * STEP, k, _own_lines(12.0)(k)) for k in range(3)]
    updates = [tracker.update(f, float(k)) for k, f in enumerate([*frames, frames[-1]])]
    assert "the same as the previous frame" in updates[-1].reason


def _pads(
    pitch: float, shift: np.ndarray, dust: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Pads along the rows, half of the pitch wide, with particles (n, 2), under a light that falls to three fifths from
    one corner to the other; in 8 grey levels for an electron of 40.
    """
    rows, cols = np.mgrid[:256, :320].astype(np.float64)
    edge = [
        np.clip(0.25 * pitch - np.abs((at - by) % pitch - 0.5 * pitch) + 0.5, 0.0, 1.0)
        for at, by in ((cols, shift[0]), (rows, shift[1]))
    ]
    picture = 0.25 + 0.35 * edge[0] * edge[1]
    for x, where in dust:
        far = np.hypot(cols - x - shift[0], rows - where - shift[1])
        picture = np.maximum(picture, 0.8 * np.clip(4.0 - far, 0.0, 1.0))
    light = 1.0 + 0.25 * (cols / 160.0 - 1.0) + 0.1 * (rows / 128.0 - 1.0)
    return np.clip(6.0 * rng.poisson(40.0 * light * picture), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("pitch", "count"),
    [
        pytest.param(40.0, 15, marks=pytest.mark.long),
        (64.0, 6),
        pytest.param(90.0, 6, marks=pytest.mark.long),
    ],
)
def test_pads_along_the_rows_are_neither_stripes_nor_followed_by_whole_periods(
    pitch: float, count: int
) -> None:
    """They were: hundreds of px off at a stated 0.1. More noise where the picture is brighter was taken for structure
    that a shift leaves, and the rows of pads for stripes.
    """
    rng, tracker = np.random.default_rng(7), DriftTracker()
    dust = rng.uniform(0.0, (320.0, 256.0), (count, 2))
    accepted = 0
    for k in range(24):
        drift = np.array([0.02 * k, -0.3 * k])
        update = tracker.update(_pads(pitch, drift, dust, rng), float(k))
        assert not update.stripes
        if k and update.accepted:
            accepted += 1
            assert np.all(np.abs(update.drift_px - drift) < np.maximum(0.1, 4.0 * update.sigma_px))
    assert accepted >= 22
