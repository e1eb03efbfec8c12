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

"""Grey values, noise, sampling and specimens of the virtual SEM."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic import (
    NOISE_FREE,
    SQUARES_M,
    ChessGrid,
    Detector,
    FlatSpecimen,
    GoldOnCarbon,
    Pose,
    drift_preset,
    preset,
    render_frame,
    render_reflectivity,
    square_for,
)

PLAIN = replace(NOISE_FREE, dark_yield=0.25, offset=0.1, gain=0.6)


def flat_image(detector: Detector, value: float = 0.4, seed: int = 0) -> NDArray[np.float64]:
    image = render_frame(
        preset("jsm820"), FlatSpecimen(value), Pose.flat(), 1000.0, detector=detector, seed=seed
    )
    return image.astype(np.float64)


def test_grey_value_of_a_flat_specimen_follows_the_stated_chain() -> None:
    image = flat_image(PLAIN)
    expected = round((0.1 + 0.6 * (0.25 + 0.75 * 0.4)) * 65535)
    assert np.all(image == expected)


def test_inversion_mirrors_the_grey_scale() -> None:
    upright, inverted = flat_image(PLAIN), flat_image(replace(PLAIN, inverted=True))
    assert np.abs(upright + inverted - 65535).max() <= 1  # rounding


@pytest.mark.parametrize("electrons", [20.0, 150.0, 2000.0])
def test_noise_variance_is_that_of_counting_plus_amplifier(electrons: float) -> None:
    # The two lower doses are drawn from the Poisson distribution, the highest as its normal limit.
    image = flat_image(replace(PLAIN, electrons=electrons, noise=0.01), seed=4) / 65535
    signal = 0.25 + 0.75 * 0.4
    variance = 0.6**2 * signal / electrons + 0.01**2
    # 2.6e5 pixels: the relative standard error of a variance is sqrt(2 / n) = 0.28 %.
    assert image.var() == pytest.approx(variance, rel=0.012)
    standard_error = math.sqrt(variance / image.size)
    assert image.mean() == pytest.approx(0.1 + 0.6 * signal, abs=4.5 * standard_error)
    # Neighbours are independent: their correlation is zero within five standard errors.
    residual = image - image.mean()
    correlation = np.mean(residual[:, 1:] * residual[:, :-1]) / image.var()
    assert abs(correlation) < 5 / math.sqrt(image.size)


def test_dark_regions_are_less_noisy_than_bright_ones() -> None:
    detector = replace(PLAIN, electrons=100.0)
    dark, bright = flat_image(detector, 0.0), flat_image(detector, 1.0)
    assert bright.var() / dark.var() == pytest.approx(4.0, rel=0.03)  # yields 1 and 0.25


@pytest.mark.parametrize(("bits", "dtype", "top"), [(8, np.uint8, 255), (16, np.uint16, 65535)])
def test_depths_use_their_whole_range_and_saturate(bits: int, dtype: type, top: int) -> None:
    board = ChessGrid(5e-6)
    detector = replace(NOISE_FREE, bits=bits, dark_yield=0.0, offset=-0.1, gain=1.2)
    image = render_frame(preset("jsm820"), board, Pose.flat(), 2000.0, detector=detector)
    assert image.dtype == dtype
    assert image.shape == (512, 512)
    assert image.min() == 0
    assert image.max() == top
    gentle = replace(detector, offset=0.2, gain=0.5)
    image = render_frame(preset("jsm820"), board, Pose.flat(), 2000.0, detector=gentle)
    assert image.min() == round(0.2 * top)
    assert image.max() == round(0.7 * top)


def test_sixteen_bits_resolve_more_than_eight() -> None:
    image = render_frame(
        preset("jsm820"), GoldOnCarbon(), Pose.flat(), 5000.0, detector=replace(PLAIN, blur_px=0.8)
    )
    assert len(np.unique(image)) > 5000


def test_other_depths_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="12 bits; expected 8 or 16"):
        Detector(bits=12)


def test_shading_is_a_gradient_of_the_yield() -> None:
    image = flat_image(replace(PLAIN, offset=0.0, shading=(0.2, -0.1))) / 65535
    centre = 0.6 * (0.25 + 0.75 * 0.4)
    columns, rows = image.mean(axis=0) / centre, image.mean(axis=1) / centre
    assert columns[-1] - columns[0] == pytest.approx(0.2, abs=1e-3)  # quantisation
    assert rows[-1] - rows[0] == pytest.approx(-0.1, abs=1e-3)


def test_blur_keeps_the_mean_and_reaches_over_the_border() -> None:
    microscope, board, pose = preset("jsm820"), ChessGrid(5e-6), Pose.flat(rotation_rad=0.08)
    spot = replace(NOISE_FREE, blur_px=2.0)
    blurred = render_frame(microscope, board, pose, 2000.0, detector=spot)
    sharp = render_frame(microscope, board, pose, 2000.0, detector=NOISE_FREE)
    assert blurred.mean() == pytest.approx(sharp.mean(), rel=0.01)
    # The border must be as blurred as the middle: no mirrored or constant rim.
    steps = np.abs(np.diff(blurred.astype(float), axis=1)).max(axis=0)
    assert steps[:3].max() < 1.05 * steps[50:-50].max()
    # An edge of height h blurred by sigma = 2 px has the steepest slope h / (2 sqrt(2 pi)) per px.
    height = 0.75 * 0.8 * 65535
    assert steps.max() == pytest.approx(height / (2 * math.sqrt(2 * math.pi)), rel=0.05)


@pytest.mark.parametrize("part", [0.1, 0.5])
def test_a_tip_covers_the_field_from_the_left_as_far_as_it_says(part: float) -> None:
    bare, covered = flat_image(PLAIN), flat_image(replace(PLAIN, tip=part))
    changed = np.abs(covered - bare) > 0.05 * 65535
    height, width = changed.shape
    reach = np.flatnonzero(changed[height // 2])
    assert reach.min() == 0
    assert abs(reach.max() - part * width) < 2.0
    assert not changed[:, int(part * width) + 2 :].any()
    with pytest.raises(InvalidValueError, match="part of it"):
        replace(PLAIN, tip=1.5)


def test_databar_is_appended_below_the_field() -> None:
    plain = render_frame(preset("jsm820"), ChessGrid(5e-6), Pose.flat(), 2000.0)
    with_bar = render_frame(
        preset("jsm820"), ChessGrid(5e-6), Pose.flat(), 2000.0, detector=Detector(databar_rows=40)
    )
    assert with_bar.shape == (552, 512)
    assert np.array_equal(with_bar[:512], plain)
    assert set(np.unique(with_bar[512:])) == {0, 255}


def test_frames_repeat_by_seed() -> None:
    def take(seed: int | tuple[int, ...]) -> NDArray[np.generic]:
        return render_frame(
            preset("jsm820"),
            GoldOnCarbon(3),
            Pose.flat(),
            5000.0,
            drift=drift_preset("fast"),
            seed=seed,
        )

    assert np.array_equal(take(7), take(7))
    assert np.array_equal(take((7, 1)), take((7, 1)))
    assert not np.array_equal(take(7), take(8))
    assert not np.array_equal(take((7, 1)), take((7, 2)))


# -- specimens ------------------------------------------------------------------------------------


def test_chess_board_has_its_corners_at_multiples_of_the_square() -> None:
    board = ChessGrid(2e-6)
    x = np.array([1e-6, 3e-6, 1e-6, 3e-6, -1e-6, 401e-6])
    y = np.array([1e-6, 1e-6, 3e-6, 3e-6, 1e-6, 1e-6])
    point = board.reflectivity(x, y, np.eye(2) * 1e-9)
    assert point.tolist() == [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]
    on_corner = board.reflectivity(np.array([4e-6]), np.array([6e-6]), np.eye(2) * 1e-7)
    assert on_corner[0] == pytest.approx(0.5)


@pytest.mark.parametrize("square_px", [0.37, 0.9, 1.3, 2.7])
def test_unresolved_squares_keep_their_mean_without_moire(square_px: float) -> None:
    g = 100.0
    microscope = preset("jsm820")
    board = ChessGrid(square_px * microscope.nominal_pixel_size_m(g))
    pose = Pose.tilted(0.3, 0.2, 0.4)
    image = render_reflectivity(microscope, board, pose, g)
    assert image.mean() == pytest.approx(0.5, abs=2e-3)
    # Moire would show as contrast at a scale of many pixels, where the truth is grey.
    coarse = image.reshape(16, 32, 16, 32).mean(axis=(1, 3))
    assert np.abs(coarse - 0.5).max() < 0.02


def test_four_samples_per_pixel_are_close_to_the_true_average() -> None:
    board, pose = ChessGrid(2e-6), Pose.tilted(0.5, 0.2, 0.4)
    quick = render_reflectivity(preset("jsm820"), board, pose, 5000.0)
    exact = render_reflectivity(preset("jsm820"), board, pose, 5000.0, supersampling=8)
    difference = quick.astype(float) - exact
    assert abs(difference.mean()) < 1e-4
    # On the 6 % of pixels that lie on an edge, the box filter is wrong by some per cent.
    assert np.sqrt(np.mean(difference**2)) < 0.006
    assert np.abs(difference).max() < 0.08


@pytest.mark.parametrize("g", [100.0, 500.0, 2000.0, 7000.0, 20000.0])
def test_gold_is_textured_at_every_magnification(g: float) -> None:
    image = render_reflectivity(preset("jsm820"), GoldOnCarbon(1), Pose.flat(), g).astype(float)
    assert image.min() >= 0.0
    assert image.max() <= 1.0
    assert 0.1 < image.mean() < 0.6
    assert image.std() > 0.06
    # Texture everywhere, not one particle: every 64 px tile has contrast and gradients.
    tiles = image.reshape(8, 64, 8, 64).std(axis=(1, 3))
    assert tiles.min() > 0.03
    slope = np.hypot(*np.gradient(image))
    assert np.median(slope) > 0.004


def test_gold_does_not_repeat_within_the_field() -> None:
    image = render_reflectivity(preset("ideal"), GoldOnCarbon(1), Pose.flat(), 1000.0).astype(float)
    image -= image.mean()
    spectrum = np.abs(np.fft.rfft2(image, s=(1024, 1024))) ** 2
    overlap = np.fft.irfft2(np.abs(np.fft.rfft2(np.ones_like(image), s=(1024, 1024))) ** 2)
    autocorrelation = np.fft.irfft2(spectrum) / np.maximum(overlap, 1.0)
    autocorrelation /= autocorrelation[0, 0]
    away = np.roll(autocorrelation, (512, 512), axis=(0, 1))[
        512 - 350 : 512 + 350, 512 - 350 : 512 + 350
    ]
    y, x = np.mgrid[-350:350, -350:350]
    # A repeated tile would give a second peak near 1.
    assert away[np.hypot(x, y) > 100].max() < 0.45


def test_gold_shows_the_same_particles_at_two_magnifications() -> None:
    microscope = preset("ideal")
    low = render_reflectivity(microscope, GoldOnCarbon(2), Pose.flat(), 2000.0).astype(float)
    high = render_reflectivity(microscope, GoldOnCarbon(2), Pose.flat(), 4000.0).astype(float)
    reduced = high.reshape(256, 2, 256, 2).mean(axis=(1, 3))
    middle = low[128:384, 128:384]
    # Different levels of the tile are filtered differently; position and brightness must agree.
    assert np.corrcoef(middle.ravel(), reduced.ravel())[0, 1] > 0.97
    assert middle.mean() == pytest.approx(reduced.mean(), rel=0.01)


def test_gold_seeds_give_different_specimens() -> None:
    images = [
        render_reflectivity(preset("ideal"), GoldOnCarbon(seed), Pose.flat(), 3000.0)
        for seed in (0, 1)
    ]
    assert abs(np.corrcoef(images[0].ravel(), images[1].ravel())[0, 1]) < 0.3


def test_square_choice_keeps_enough_squares_in_view() -> None:
    microscope = preset("jsm820")
    for g in np.geomspace(100.0, 10000.0, 40):
        pixel_m = microscope.nominal_pixel_size_m(g)
        span_px = square_for(pixel_m) / pixel_m
        assert 10.0 < span_px < 86.0
    assert square_for(1e-3) == max(SQUARES_M)
    assert square_for(1e-12) == min(SQUARES_M)
    with pytest.raises(InvalidValueError):
        ChessGrid(0.0)
