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

"""Periods of an image. That defects decide, and nothing else, is tested in test_register.py."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.drift.scenes import KINDS, draw
from semcal_ros.core.arrays import Array
from semcal_ros.core.registration.periodicity import find_periods, find_repeating
from semcal_ros.core.registration.register import prepare_reference
from tests.helpers.drift_scenes import Texture

SIZE = 256


def waves(first: tuple[float, float], second: tuple[float, float], seed: int) -> Array:
    """A lattice with these periods, px, and noise of variance 1."""
    reciprocal = np.linalg.inv(np.array([first, second])).T
    y, x = np.mgrid[:SIZE, :SIZE]
    phases = [2.0 * np.pi * (k[0] * x + k[1] * y) for k in reciprocal]
    lattice = 2.0 * (np.cos(phases[0]) + np.cos(phases[1]))
    return np.asarray(lattice + np.random.default_rng(seed).normal(size=(SIZE, SIZE)))


@pytest.mark.parametrize(
    ("first", "second"),
    [((8.3, 1.2), (-1.1, 9.4)), ((12.0, 0.0), (0.0, 17.0)), ((20.0, 6.0), (-5.0, 23.0))],
)
def test_the_periods_of_a_lattice(first: tuple[float, float], second: tuple[float, float]) -> None:
    found = find_periods(np.asarray(waves(first, second, 0), dtype=np.float32), 1.0)
    assert found.shape == (2, 2)
    # Any two periods that span the same lattice, to a tenth of a pixel.
    counts = found @ np.linalg.inv(np.array([first, second]))
    np.testing.assert_allclose(counts, np.rint(counts), atol=0.02)
    assert abs(np.linalg.det(np.rint(counts))) == pytest.approx(1.0)


def test_lines_have_one_period() -> None:
    y, x = np.mgrid[:SIZE, :SIZE]
    lines = 3.0 * np.cos(2.0 * np.pi * (x + 0.3 * y) / 14.0)
    noise = np.random.default_rng(1).normal(size=(SIZE, SIZE))
    found = find_periods(np.asarray(lines + noise, dtype=np.float32), 1.0)
    assert len(found) >= 1
    across = np.array([1.0, 0.3])
    # The step across the lines is one period of 14 px along x, or none along them.
    counts = found @ across / 14.0
    np.testing.assert_allclose(counts, np.rint(counts), atol=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_a_texture_does_not_repeat(seed: int) -> None:
    texture = 40.0 * Texture(seed).view((0.0, 0.0), SIZE)
    noise = np.random.default_rng(seed).normal(size=texture.shape)
    assert len(find_periods(np.asarray(texture + noise, dtype=np.float32), 1.0)) == 0


def test_a_few_particles_in_much_noise_do_not_repeat() -> None:
    """Their structure is a fiftieth of the variance of the noise, which repeated as well as that at some lags."""
    found = 0
    y, x = np.mgrid[:SIZE, :SIZE]
    for seed in range(20):
        rng = np.random.default_rng(seed)
        image = np.full((SIZE, SIZE), 100.0)
        for _ in range(8):
            (left, top), radius = rng.uniform(0.0, SIZE, 2), rng.uniform(3.0, 8.0)
            image -= 60.0 / (1.0 + np.exp((np.hypot(x - left, y - top) - radius) / 0.7))
        image += rng.normal(0.0, 29.0, image.shape)
        found += len(find_periods(np.asarray(image, dtype=np.float32), 29.0**2)) > 0
    # By chance in one of a thousand, and where pairs of particles lie alike. All of them had some.
    assert found <= 1


def test_more_noise_than_was_measured_hides_no_period() -> None:
    """It is measured in a part of the image, and a lattice may be brighter than that."""
    lattice = waves((12.0, 3.0), (-3.0, 11.0), 2)
    noise = np.random.default_rng(2).normal(size=lattice.shape)
    image = np.asarray(lattice + 1.7 * noise, dtype=np.float32)
    assert find_periods(image, 0.5).shape == (2, 2)


def test_a_bright_tool_hides_no_period() -> None:
    lattice = waves((12.0, 3.0), (-3.0, 11.0), 2)
    lattice[60:200, :70] = 60.0
    assert find_periods(np.asarray(lattice, dtype=np.float32), 1.0).shape == (2, 2)


@pytest.mark.parametrize("rough", [0.0, 2.0])
def test_where_a_lattice_is_seen(rough: float) -> None:
    """Not where a tool is, whatever it shows; defects are of the lattice, also two that lie close together."""
    lattice = waves((10.0, 2.5), (-2.5, 9.0), 3)
    y, x = np.mgrid[:SIZE, :SIZE]
    for column, row in ((170.0, 60.0), (180.0, 72.0), (200.0, 180.0)):
        lattice -= 12.0 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / 18.0)
    texture = Texture(3).view((0.0, 0.0), SIZE)
    lattice[70:190, :90] = 20.0 + (rough * texture)[70:190, :90]
    image = np.asarray(lattice, dtype=np.float32)
    seen = find_repeating(image, find_periods(image, 1.0), 1.0, 16)
    assert not np.any(seen[70:190, :90])
    assert np.all(seen[:, 120:])
    assert np.all(seen[:40])


@pytest.mark.parametrize("seed", [100, 101, 102])
def test_a_few_particles_beside_a_tool_are_no_lattice(seed: int) -> None:
    """Some of them lie a period apart by chance: in a quarter of the picture, and not in most of it."""
    frames, _, _ = draw(KINDS["tool over sparse"], seed, 16)
    by_chance = prepare_reference(frames[15])
    assert len(find_periods(by_chance.coarse.pyramid.centred(1), by_chance.noise_variance)) > 0
    assert len(by_chance.periods) == 0
    with_tool, _, _ = draw(KINDS["tool over a lattice"], seed)
    assert len(prepare_reference(with_tool[29]).periods) == 2
