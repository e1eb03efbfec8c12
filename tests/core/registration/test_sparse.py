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


"""A few particles tell a shift as well as their gradients allow, and its sigma says so."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import special

from benchmarks.drift.scenes import KINDS, draw
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.registration.noise_spectrum import passed_variance
from semcal_ros.core.registration.register import prepare_reference, register
from semcal_ros.core.registration.tiles import (
    Pyramid,
    find_structure,
    make_level,
    residuals_at_gradients,
    tile_sums,
    tile_window,
)
from tests.helpers.long_tests import long_but


@pytest.mark.long
def test_few_particles_reach_the_bound_with_a_sigma_that_holds() -> None:
    scores, sigmas, bounds = [], [], []
    for seed in range(300, 308):
        frames, drift, bound_px = draw(KINDS["sparse"], seed)
        reference = prepare_reference(frames[0])
        for k in (9, 19, 29):
            found = register(
                reference, frames[k], guess_px=drift[k], guess_covariance=0.04 * np.eye(2)
            )
            assert found.accepted, found.reason
            sigma = np.sqrt(np.diag(found.covariance))
            scores.append((found.shift_px - drift[k]) / sigma)
            sigmas.append(float(np.hypot(*sigma)))
            bounds.append(np.sqrt(2.0) * bound_px)
    # 48 scores, in eights with the noise of one reference in common: as uncertain as 24 of their own, whose RMS is
    # within 0.55 to 1.45 but once in 1000 times.
    assert 0.55 < float(np.sqrt(np.mean(np.square(scores)))) < 1.45
    # From the scatter of eight scores alone, the sigma would be 2.5 times the bound.
    ratio = np.array(sigmas) / np.array(bounds)
    assert float(np.mean(ratio)) < 2.2


@pytest.mark.long
def test_chance_at_high_frequencies_does_not_tell_the_smoothing_of_a_few_particles() -> None:
    """One particle of 4 px is in the part whose spectrum is measured, ten are above it; none has fine structure."""
    y, x = np.mgrid[:384, :384].astype(float)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        image = 60.0 + rng.normal(0.0, 11.5, (384, 384))
        places = [rng.uniform(100.0, 280.0, 2), *rng.uniform([20, 20], [364, 50], (10, 2))]
        for place in places:
            away = np.minimum(np.hypot(x - place[0], y - place[1]) - 4.0, 30.0)
            image += 60.0 / (1.0 + np.exp(away / 0.6))
        assert prepare_reference(image.astype(np.float32)).levels[-1].sigma_px > 0.45


def _discs(places: np.ndarray, rng: np.random.Generator, electrons: float = 60.0) -> np.ndarray:
    """(192, 192) image of discs on a ground that gives next to no electrons, with counted ones."""
    y, x = np.mgrid[:192, :192].astype(float)
    signal = np.zeros((192, 192))
    for place in places:
        # An edge of 1 px.
        signal += special.expit(-2.0 * (np.hypot(x - place[0], y - place[1]) - 2.0))
    grey = rng.poisson(electrons * signal + 0.3) * (180.0 / electrons)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.long
def test_bright_particles_on_black_are_followed_within_their_sigma() -> None:
    """More than nine tenths of the picture are black, and all of the noise is where the particles are."""
    scores = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        places, tracker = rng.uniform(10.0, 182.0, (6, 2)), DriftTracker()
        velocity = rng.uniform(-0.7, 0.7, 2)
        for k in range(12):
            image = _discs(places + k * velocity, rng)
            assert np.mean(image == 0) > 0.5
            update = tracker.update(image, float(k))
            if k and update.accepted:
                sigma = np.sqrt(np.diag(update.covariance)[:2])
                scores.append((update.drift_px - k * velocity) / sigma)
    assert len(scores) >= 0.95 * 8 * 11
    # The eight series have the noise of their first frames in common with themselves: 16 scores of their own, whose RMS
    # is below 1.45 but once in 100 times.
    assert 0.5 < float(np.sqrt(np.mean(np.square(scores)))) < 1.45


@pytest.mark.parametrize("everywhere", [True, False])
def test_what_noise_does_where_the_gradients_are(everywhere: bool) -> None:
    """Of the same variance in all pixels, the weighted mean is the plain one; of a bright particle it is its own."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:256, :256].astype(float)
    inside = np.hypot(x - 127.0, y - 127.0) < 2.5
    clean = cv2.GaussianBlur(np.where(inside, 200.0, 0.0).astype(np.float32), (0, 0), 1.0)
    level = make_level(Pyramid(clean), 1, 1.0)
    assert level is not None
    window = tile_window(level, (256, 256), np.zeros(2))
    assert window is not None
    near = inside | (cv2.dilate(inside.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0)
    found, plain = [], []
    for _ in range(40):
        noise = rng.normal(0.0, 10.0, clean.shape) * (1.0 if everywhere else near)
        image = Pyramid(clean + noise.astype(np.float32))
        sums = tile_sums(level, window, image.centred(1), np.zeros(2), np.zeros((2, 2)))
        gain = np.ones(sums.energy.shape)
        squares = residuals_at_gradients(level, window, sums, gain)
        energy = np.einsum("rcii->rc", level.normal_matrices[window.rows, window.cols, :2, :2])
        row, col = np.unravel_index(np.argmax(energy), energy.shape)
        found.append(squares[row, col])
        grey = level.products[window.rows, window.cols, 2]
        left = sums.pixels - grey
        plain.append(left[row, col].var())
    expected = 100.0 * passed_variance(1.0)
    # 40 tiles with some ten independent pixels at their gradients each.
    if everywhere:
        assert np.mean(found) == pytest.approx(expected, rel=0.2)
        assert np.mean(plain) == pytest.approx(expected, rel=0.1)
    else:
        # At the edge of where the noise is, the smoothing takes some.
        assert np.mean(found) == pytest.approx(0.85 * expected, rel=0.2)
        assert np.mean(plain) < 0.7 * np.mean(found)


@pytest.mark.parametrize("jump", [(60.0, -44.0), (90.0, -60.0)])
@pytest.mark.parametrize("seed", long_but(lambda seed: seed == 0, range(2)))
def test_where_a_stage_has_taken_particles_away_from_under_a_tool_is_in_the_sigma(
    seed: int, jump: tuple[float, float]
) -> None:
    """The tool is left out, and of what was in sight too little is left: any other place may be in sight."""
    rng = np.random.default_rng(seed)
    places, tracker = rng.uniform(-90.0, 282.0, (40, 2)), DriftTracker()
    tool = np.array([[40.0, 90.0], [40.0, 99.0], [40.0, 108.0]])
    for k in range(12):
        drift = k * np.array([0.1, 0.15]) + (np.array(jump) if k > 9 else 0.0)
        image = _discs(np.vstack([places + drift, tool + [3.0 * k, 0.0]]), rng)
        update = tracker.update(image, float(k))
        assert update.accepted == (k <= 9)
        error = np.abs(update.drift_px - drift)
        assert np.all(error < 4.0 * update.sigma_px + 1e-9)


def _holes(places: np.ndarray, radii: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(256, 256) image of dark holes in a bright ground of 8 electrons per pixel."""
    y, x = np.mgrid[:256, :256].astype(float)
    signal = np.ones((256, 256))
    for place, radius in zip(places, radii, strict=True):
        away = np.hypot(x - place[0], y - place[1]) - radius
        signal *= 1.0 - 0.7 * special.expit(-2.0 * away)
    return np.clip(np.rint(15.0 * rng.poisson(8.0 * signal)), 0, 255).astype(np.uint8)


@pytest.mark.long
def test_holes_that_are_plain_to_see_at_few_electrons_are_followed() -> None:
    """Under the smoothing that is best for their edges, hardly a tile has more of a gradient than noise has."""
    tracked, scores = 0, []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        places, radii = rng.uniform(0.0, 256.0, (12, 2)), rng.uniform(4.0, 9.0, 12)
        tracker, velocity = DriftTracker(), rng.uniform(-0.7, 0.7, 2)
        for k in range(10):
            update = tracker.update(_holes(places + k * velocity, radii, rng), float(k))
            if k and update.accepted:
                tracked += 1
                sigma = np.sqrt(np.diag(update.covariance)[:2])
                scores.append((update.drift_px - k * velocity) / sigma)
    assert tracked >= 0.95 * 6 * 9
    # Twelve scores of their own, with the noise of first frames in common: below 1.5 but once in 100 times.
    assert 0.4 < float(np.sqrt(np.mean(np.square(scores)))) < 1.5


@pytest.mark.parametrize("sigma_px", [0.0, 0.8, 2.3])
def test_noise_shows_no_structure(sigma_px: float) -> None:
    """Once in 300 000 tiles by chance; these are some 3000."""
    for seed in range(6):
        noise = np.random.default_rng(seed).poisson(20.0, (384, 384)).astype(np.float32)
        level = make_level(Pyramid(noise), 1, sigma_px)
        assert level is not None
        level = replace(level, noise_variance=20.0 * passed_variance(sigma_px))
        assert not np.any(find_structure(level))
