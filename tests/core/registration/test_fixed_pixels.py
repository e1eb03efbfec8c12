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

"""What stays in place in both images has no say in a shift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.drift.overlay import remove_overlay
from semcal_ros.core.registration.fixed_pixels import drop_fixed_pixels, grow_mask
from semcal_ros.core.registration.noise_spectrum import smooth
from semcal_ros.core.registration.register import prepare_reference, register
from semcal_ros.core.registration.tiles import drop_pixels
from tests.helpers.drift_scenes import Texture

SIZE = 256
GROUND = Texture(7)
NOISE = 6.0
SCALE = 30.0 / float(GROUND.view((0.0, 0.0), SIZE).std())


def picture(shift: tuple[float, float], seed: int) -> NDArray[np.float32]:
    clean = 110.0 + SCALE * GROUND.view(shift, SIZE)
    return np.random.default_rng(seed).normal(clean, NOISE).astype(np.float32)


def spots(seed: int, share: float = 0.05) -> Mask:
    """Squares of 9 px at random places."""
    rng = np.random.default_rng(seed)
    mask = np.zeros((SIZE, SIZE), dtype=bool)
    while mask.mean() < share:
        x, y = rng.integers(0, SIZE - 9, 2)
        mask[y : y + 9, x : x + 9] = True
    return mask


def with_spots(image: NDArray[np.float32], mask: Mask, level: float) -> NDArray[np.float32]:
    return np.where(mask, np.float32(level), image)


@pytest.mark.parametrize("shift", [(2.3, -1.6), (14.5, 9.25), (-31.7, 22.1)])
def test_a_shift_is_that_of_the_specimen_whatever_stays(shift: tuple[float, float]) -> None:
    mask = spots(1)
    errors: dict[bool, list[Array]] = {True: [], False: []}
    scores = []
    for seed in range(6):
        first, second = picture((0.0, 0.0), 2 * seed), picture(shift, 2 * seed + 1)
        for masked in (True, False):
            # Near the mean, as if the place had been filled.
            pair = [with_spots(image, mask, 118.0) for image in (first, second)]
            fixed = mask if masked else None
            found = register(
                prepare_reference(pair[0], fixed=fixed),
                pair[1],
                guess_px=np.add(shift, (0.4, -0.5)),
                guess_covariance=np.eye(2),
                fixed=fixed,
            )
            assert found.accepted, found.reason
            errors[masked].append(found.shift_px - shift)
            if masked:
                scores.append(errors[True][-1] / np.sqrt(np.diag(found.covariance)))
    rms = {masked: float(np.sqrt(np.mean(np.square(e)))) for masked, e in errors.items()}
    # Twelve errors of a sigma: their RMS is below 1.6 sigma but once in 1000 times (chi-square).
    assert np.sqrt(np.mean(np.square(scores))) < 1.6
    assert rms[True] < 0.02
    assert rms[True] < 0.75 * rms[False]


def test_the_values_of_dropped_pixels_do_not_matter() -> None:
    mask, shift = spots(2), (3.4, 1.7)
    first, second = picture((0.0, 0.0), 0), picture(shift, 1)
    found = []
    for levels in ((110.0, 110.0), (60.0, 170.0), (170.0, 170.0)):
        reference = prepare_reference(with_spots(first, mask, levels[0]), fixed=mask)
        image = with_spots(second, mask, levels[1])
        registration = register(
            reference, image, guess_px=shift, guess_covariance=np.eye(2), fixed=mask
        )
        assert registration.accepted, registration.reason
        found.append(registration.shift_px)
    # The smoothing is chosen anew for each pair; without the mask the third lies 0.6 px from the first.
    assert np.max(np.abs(np.subtract(found, found[0]))) < 0.01


def test_a_prediction_that_is_far_off_is_mended() -> None:
    mask, shift = spots(3), (9.3, -6.2)
    reference = prepare_reference(with_spots(picture((0.0, 0.0), 0), mask, 60.0), fixed=mask)
    image = with_spots(picture(shift, 1), mask, 60.0)
    near = register(reference, image, guess_px=shift, guess_covariance=np.eye(2), fixed=mask)
    far = register(
        reference, image, guess_px=(0.0, 0.0), guess_covariance=99.0 * np.eye(2), fixed=mask
    )
    assert near.accepted
    assert far.accepted
    np.testing.assert_allclose(far.shift_px, near.shift_px, atol=1e-3)


def test_sums_are_those_of_the_pixels_that_count() -> None:
    level = prepare_reference(picture((0.0, 0.0), 0)).levels[-1]
    mask = spots(4)
    part = drop_pixels(level, mask)
    rows, cols = level.normal_matrices.shape[:2]
    (left, top), (side_x, side_y) = level.origin, level.side
    rng = np.random.default_rng(0)
    for row, col in zip(rng.integers(0, rows, 20), rng.integers(0, cols, 20), strict=True):
        y, x = top + row * side_y, left + col * side_x
        kept = ~mask[y : y + side_y, x : x + side_x].ravel()
        columns = np.vstack([level.products[row, col], np.ones(side_x * side_y)])[:, kept]
        expected = columns.astype(np.float64) @ columns.astype(np.float64).T
        np.testing.assert_allclose(
            part.normal_matrices[row, col], expected, rtol=1e-5, atol=1e-3 * expected.max()
        )
    kept = np.count_nonzero(~mask[top : top + rows * side_y, left : left + cols * side_x])
    assert part.normal_matrices[..., 3, 3].sum() == pytest.approx(kept)


@pytest.mark.parametrize("masked", [False, True])
def test_products_with_noise_scatter_as_predicted(masked: bool) -> None:
    level = prepare_reference(picture((0.0, 0.0), 0)).levels[-1]
    assert level.sigma_px > 0.5
    if masked:
        level = drop_pixels(level, spots(5, 0.3))
    rows, cols = level.normal_matrices.shape[:2]
    (left, top), (side_x, side_y) = level.origin, level.side
    rng = np.random.default_rng(1)
    sums, variances = [], []
    for _ in range(400):
        noise = smooth(rng.normal(size=(SIZE, SIZE)).astype(np.float32), level.sigma_px)
        variances.append(float(noise.var()))
        cut = noise[top : top + rows * side_y, left : left + cols * side_x]
        tiles = cut.reshape(rows, side_y, cols, side_x).transpose(0, 2, 1, 3)
        tiles = tiles.reshape(rows, cols, -1)
        if level.dropped is not None:
            tiles = np.where(level.dropped, 0.0, tiles)
        products = np.einsum("rckn,rcn->rck", level.products[:, :, :2], tiles)
        sums.append(_sum_quarters(products))
    measured = np.var(np.array(sums), axis=0) / np.mean(variances)
    predicted = _sum_quarters(np.einsum("rckk->rck", level.noise_products))
    # Each of eight scatters by 7 %, their mean by 2.5 %.
    assert float(np.mean(measured / predicted)) == pytest.approx(1.0, abs=0.08)


def _sum_quarters(values: Array) -> Array:
    """(8,) sums over each quarter of the tiles."""
    rows, cols = (n // 2 for n in values.shape[:2])
    parts = [values[:rows, :cols], values[:rows, cols:], values[rows:, :cols], values[rows:, cols:]]
    return np.array([part.sum(axis=(0, 1)) for part in parts]).ravel()


def test_masks_grow_and_nothing_is_dropped_where_nothing_is_fixed() -> None:
    mask = np.zeros((9, 9), dtype=bool)
    mask[4, 4] = True
    assert np.count_nonzero(grow_mask(mask, 2)) == 25
    reference = prepare_reference(picture((0.0, 0.0), 0))
    region = (0, 0, SIZE, SIZE)
    assert drop_fixed_pixels(reference, None, region, np.zeros(2)) is reference
    away = np.zeros((SIZE, SIZE), dtype=bool)
    away[:5] = True
    # What the image shows there is seen by none of the reference's pixels.
    assert drop_fixed_pixels(reference, away, region, np.array([0.0, 40.0])) is reference
    part = drop_fixed_pixels(replace(reference, fixed=away), None, region, np.zeros(2))
    assert part.whole is reference or part.whole is not None
    assert part.levels[-1].dropped is not None


def test_what_fills_a_place_does_not_cost_another_step() -> None:
    # Of twice the size, so that there is a coarser level, whose start it would pull.
    size, shift = 2 * SIZE, np.array([1.3, -0.8])
    bar = np.zeros((size, size), dtype=bool)
    bar[-60:] = True
    pair = []
    for k, at in enumerate((np.zeros(2), shift)):
        clean = 110.0 + SCALE * GROUND.view(tuple(at), size)
        noisy = np.random.default_rng(k).normal(clean, NOISE)
        pair.append(remove_overlay(np.rint(noisy.clip(0, 255)).astype(np.uint8), bar))
    reference = prepare_reference(pair[0], fixed=bar)
    part = drop_fixed_pixels(reference, bar, None, shift)
    assert len(part.levels) > 1
    for level in part.levels:
        assert level.dropped is not None
        # The bar, and some pixels above it.
        assert 0.9 < level.dropped.mean() * size / 60.0 < 1.4
    found = register(reference, pair[1], guess_px=shift, guess_covariance=np.eye(2), fixed=bar)
    assert found.accepted
    assert found.alignment.iterations <= 1 + len(part.levels) - 1
