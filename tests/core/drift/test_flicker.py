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

"""Drift that is faster than the frames, and lines that jitter."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.flicker import FlickerEstimator
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.tracker import DriftTracker
from tests.helpers.drift_scenes import Texture, noisy

SIZE, FRAMES = 128, 8


def flicker(frames: int, rows: int, seed: int, cut: float = 10.0) -> Array:
    """(frames rows,) 1/f noise at the rate of the lines, up to ``cut`` cycles per frame, whose variance is 1
    in each e-fold of frequencies.
    """
    count = 2 * frames * rows
    cycles = np.fft.rfftfreq(count) * rows
    step = cycles[1]
    # One-sided density 1 / f: a variance of step / f in each bin, of two quadratures.
    sigma = np.sqrt(step / np.maximum(cycles, step)) * (0.5 * count)
    sigma[(cycles == 0.0) | (cycles > cut)] = 0.0
    parts = np.random.default_rng(seed).standard_normal((2, cycles.size))
    return np.asarray(np.fft.irfft(sigma * (parts[0] + 1j * parts[1]), count)[: frames * rows])


@lru_cache(maxsize=1)
def scene() -> Array:
    picture = Texture(2, 2 * SIZE, 1.5, 4.0).view((0.0, 0.0), 2 * SIZE)
    return np.asarray(spline_filter(picture, order=3, mode="grid-wrap"))


def errors_in_sigmas(
    seed: int, density: tuple[float, float], jitter: tuple[float, float]
) -> tuple[Array, Array]:
    """(FRAMES - 1, 2) with hindsight and live, of a steady drift with 1/f noise and jitter of the lines."""
    lines = FRAMES * SIZE
    path = np.outer((np.arange(lines) + 0.5) / SIZE - 0.5, [0.4, -0.3])
    path += np.stack([a * flicker(FRAMES, SIZE, 2 * seed + k) for k, a in enumerate(density)], 1)
    seen = path + np.random.default_rng(seed).standard_normal((lines, 2)) * np.array(jitter)
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    history = DriftHistory()
    tracker = DriftTracker(history=history)
    timing = ScanTiming(1.0)
    live = []
    for k in range(FRAMES):
        by = seen[k * SIZE : (k + 1) * SIZE, :, None]
        at = y - by[:, 1], x - by[:, 0]
        picture = map_coordinates(scene(), at, order=3, mode="grid-wrap", prefilter=False)
        grey = np.clip(np.rint(noisy(np.asarray(picture), 6.0, 100 * seed + k)), 0, 255)
        live.append(tracker.update(grey.astype(np.uint8), float(k), None, timing))
    middles = path.reshape(FRAMES, SIZE, 2)[:, SIZE // 2 - 1 : SIZE // 2 + 1].mean(axis=1)
    both = []
    for updates in (history.smooth().updates, live):
        assert all(u.accepted for u in updates)
        error = np.array([u.drift_m for u in updates]) - (middles - middles[0])
        sigma = np.sqrt([np.diag(u.covariance)[:2] for u in updates])
        both.append(error[1:] / sigma[1:])
    return both[0], both[1]


@pytest.mark.long
@pytest.mark.parametrize(
    ("density", "jitter"),
    [((0.1, 0.1), (0.0, 0.0)), ((0.06, 0.12), (0.1, 0.3))],
)
def test_sigma_holds_with_flicker_and_jitter_in_both_axes(
    density: tuple[float, float], jitter: tuple[float, float]
) -> None:
    streams = [errors_in_sigmas(seed, density, jitter) for seed in range(8)]
    hindsight, live = (np.concatenate(ratios) for ratios in zip(*streams, strict=True))
    # The frames of a stream share the error of the first: some 16 independent numbers tell the RMS to 0.18.
    rms = np.sqrt(np.mean(hindsight**2, axis=0))
    assert np.all((rms > 0.65) & (rms < 1.45))
    # Live, the first frames cannot know yet; without the term all four exceed 2.4.
    assert np.all(np.sqrt(np.mean(live**2, axis=0)) < 1.8)


def test_what_does_not_flicker_is_as_certain_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = errors_in_sigmas(1, (0.0, 0.0), (0.0, 0.0))
    monkeypatch.setattr(FlickerEstimator, "variance_px2", lambda _self: np.zeros(4))
    plain = errors_in_sigmas(1, (0.0, 0.0), (0.0, 0.0))
    assert np.array_equal(ours[0], plain[0])
    assert np.array_equal(ours[1], plain[1])


def test_jitter_alone_is_not_taken_for_flicker() -> None:
    # The covariance of a registration has it already: from the scatter of the rows.
    ratios = errors_in_sigmas(3, (0.0, 0.0), (0.0, 0.3))[1]
    assert 0.5 < float(np.sqrt(np.mean(ratios[:, 1] ** 2))) < 1.6


class _Profiles:
    """Stands for a registration whose rows of tiles are displaced as given, with noise of its own."""

    def __init__(self, profile: Array, noise: Array) -> None:
        rows = len(profile)
        line = np.arange(rows) - 0.5 * (rows - 1)
        phase = np.outer(np.arange(rows) + 0.5, np.arange(10)) * np.pi / rows
        basis = np.sqrt(2.0 / rows) * np.cos(phase)
        powers = []
        for part in (profile + noise[0], noise[1]):
            left = part - np.outer(line, line @ part) / (line @ line)
            powers.append((basis.T @ left) ** 2 / rows)
        self._power = np.array(powers)
        self.alignment, self.shift_px = self, np.zeros(2)

    def row_power(self, modes: int) -> Array:
        assert modes == 10
        return self._power


def estimate(
    seed: int, densities: tuple[float, float], jitter: float, noise: float, frames: int
) -> Array:
    rng = np.random.default_rng(seed)
    rows, tile = 24, 8
    estimator = FlickerEstimator()
    paths = [a * flicker(frames, rows * tile, 7 * seed + k) for k, a in enumerate(densities)]
    path = np.stack(paths, axis=1) + jitter * rng.standard_normal((frames * rows * tile, 2))
    for profile in path.reshape(frames, rows, tile, 2).mean(axis=2):
        both = noise * rng.standard_normal((2, rows, 2))
        registration: Any = _Profiles(profile, both)
        estimator, _ = estimator.add(registration, 1e9, (200, 200))
    return estimator.variance_px2()


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_the_variance_is_that_of_the_mean_about_the_middle(jitter: float) -> None:
    found = np.mean([estimate(seed, (0.1, 0.05), jitter, 0.02, 60) for seed in range(8)], axis=0)
    # As 4000 frames of 192 lines have it, for a density of 1: the mean about the middle, and the fitted line
    # less what is slower than a quarter of a cycle per frame.
    path = flicker(4000, 192, 99).reshape(4000, 192)
    about = np.mean((path[:, 95:97].mean(axis=1) - path.mean(axis=1)) ** 2)
    assert found[:2] == pytest.approx([0.01 * about, 0.0025 * about], rel=0.3)
    line = np.arange(192) - 95.5
    shear = 12.0 * np.var(path @ line / 192**2) * 12.0
    assert found[2] < 0.01 * shear
    assert found[2] == pytest.approx(0.01 * shear, rel=0.4)


def test_noise_and_jitter_have_no_density() -> None:
    assert not np.any([estimate(seed, (0.0, 0.0), 0.0, 0.05, 40) for seed in range(12)])
    # Where the rows clearly move, one sigma decides; what it adds is less than what the jitter does to the mean.
    jittered = np.array([estimate(seed, (0.0, 0.0), 0.3, 0.02, 40) for seed in range(12)])
    assert np.mean(jittered[:, :2]) < 0.3**2 / 192


def test_a_drift_between_two_frames_has_it_twice() -> None:
    noise = ProcessNoise(1.0, 0.0, (0.04, 0.09, 0.5, 0.6))
    assert np.array_equal(noise.flicker_covariance, np.diag([0.08, 0.18]))
    added = noise.frame_covariance(2.0) - ProcessNoise(1.0, 0.0).frame_covariance(2.0)
    # What is measured is the mean over the frame, whose velocity alone is disturbed.
    assert np.diag(added) == pytest.approx([0.0, 0.0, 0.5, 0.6])
