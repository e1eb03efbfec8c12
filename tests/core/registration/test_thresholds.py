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

"""The numbers of registration: those that are said to follow from something do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from semcal_ros.core.arrays import Array
from semcal_ros.core.registration import thresholds as t
from semcal_ros.core.registration.fractional_delay import (
    FINE,
    SHARP,
    Band,
    gradients,
    sample_shifted,
)
from semcal_ros.core.registration.noise_spectrum import (
    estimate_noise_variance,
    gaussian_taps,
    measure_image,
    measure_richest_parts,
)

SIDE = 65
MIDDLE = SIDE // 2


@pytest.mark.parametrize(
    ("chance", "one_in"),
    [
        (2.0 * stats.norm.sf(t.HALVES_SIGMAS), 1.7e6),
        (stats.chi2.sf(t.NEAR_CHI2_MAX, 2), 1e4),
        (stats.norm.sf(t.AGREEMENT_SIGMAS), 300_000),
        (2.0 * stats.norm.sf(t.AGREEMENT_SIGMAS), 150_000),
        (2.0 * stats.norm.sf(t.SUSPECT_SIGMAS), 2100),
        (2.0 * stats.norm.sf(t.STILL_SIGMAS), 370),
        (stats.chi2.sf(t.PREDICTED_CHI2_MAX, 2), 90),
        (stats.chi2.sf(t.PERIODS_REACH_SIGMAS**2, 2), 3000),
        (2.0 * stats.norm.sf(t.DEFECT_SIGMAS), 1.7e6),
        (2.0 * stats.norm.sf(t.HALF_PERIOD_SIGMAS), 1.7e6),
        (1e4 * stats.norm.sf(5.0), 350),
        (1e4 * stats.norm.sf(t.PEAK_SIGMAS), 80e6),
        (stats.norm.sf(t.SIGNAL_SIGMAS), 44),
        (stats.chi2.sf(t.ROWS_RATIO_MIN * (t.NOISE_ROWS_MIN - 1), t.NOISE_ROWS_MIN - 1), 28),
        (stats.norm.sf(t.CHANCE_SIGMAS), 3.5e6),
        (stats.norm.sf(t.DEVIATIONS_MIN), 3.5e6),
        (500.0 * stats.chi2.sf(t.PULL_CHI2_MIN, 2), 20),
    ],
)
def test_rates_are_those_of_the_distributions(chance: float, one_in: float) -> None:
    assert 1.0 / chance == pytest.approx(one_in, rel=0.05)  # two digits are stated


@pytest.mark.parametrize(
    ("value", "stated", "within"),
    [
        (t.SIDE_PX_MIN - 2 * FINE.reach, 6 * 6, 0.0),
        ((t.LEVEL_PX_MIN - 2 * FINE.reach) // 6, 24, 0.0),
        # Coefficients of the spectrum of a real image, for each ring.
        (t.TEXTURE_PX_MIN * (t.TEXTURE_PX_MIN // 2 + 1) / t.SPECTRUM_RINGS, 3.0, 0.0),
        (t.HALVES_PX_MAX / 300.0, 1e-3, 1e-12),
        (1.0 - t.CORRELATION_MIN**2, 2.0 / 3.0, 0.03),
        (stats.norm.cdf(1.0 / t.SIGMA_PX_MAX) - stats.norm.cdf(-1.0 / t.SIGMA_PX_MAX), 0.95, 0.005),
        (t.CHANGE_PRECISION**-0.5, 32.0, 0.5),
        (1.0 / math.sqrt(2.0 * (t.COMMON_TILES_MIN - 1)), 0.18, 0.005),
        (math.degrees(math.asin(t.PERIODS_SINE_MIN)), 17.0, 0.5),
        (t.EVIDENCE_MIN / t.DEFECT_EVIDENCE_MAX, 2.0, 0.0),
        (math.sin(math.radians(10.0)) ** 2, t.LINES_POWER_MAX, 5e-4),
        (t.PARTS**2 - t.PARTS_FOUND_MIN, t.PARTS, 0.0),
        (t.PART_LEAD_MIN * 60.0, 6.0, 1e-9),
        (t.PARTS_SIDE_PX_MAX * (t.PARTS - 1) / t.PARTS, 170.0, 1.0),
        (t.SMOOTHINGS_PX[2] / t.SMOOTHINGS_PX[1], 1.12, 0.005),
        (math.exp(-0.5 * t.GAUSSIAN_SIGMAS**2), 0.002, 5e-4),
        (t.FILTER_FREQUENCIES, 4 * max(t.BAND_TAPS), 0.0),
        (1.0 / math.sqrt(t.HESSIAN_PIXELS), 0.01, 1e-3),
        # The step where all of the gradient lies along what is held.
        (1.0 / (1.0 + t.HELD_INFORMATION), 0.01, 2e-4),
        (math.hypot(1.0, t.REMAINING_SIGMAS), 1.007, 5e-4),
        (1.0 / math.sqrt(2.0 * t.BLOCKS_MIN), 0.12, 0.005),
        (stats.norm.cdf(3.0), t.THREE_SIGMAS, 5e-6),
        (math.exp(math.sqrt(2.0 / (t.NOISE_ROWS_MIN - 1))), 1.6, 0.005),
        (stats.chi2.median(2), t.MEDIAN_CHI2, 5e-4),
        # Of white noise after the Gaussian.
        (math.exp(-(t.AFFINE_LAGS_PX**2) / (4.0 * t.AFFINE_SMOOTHED_PX**2)), 8e-4, 5e-5),
    ],
)
def test_figures_follow_from_what_is_stated(value: float, stated: float, within: float) -> None:
    assert value == pytest.approx(stated, abs=within)


def test_limits_lie_where_they_are_said_to_lie() -> None:
    assert 2.0 * t.COARSE_STEP_PX < 0.5
    assert t.BLOCK_SIGMAS > 3.0 * 4.0
    assert len(gaussian_taps(float(t.SMOOTHINGS_PX[-1]))) < t.SMOOTHING_FREQUENCIES


def _impulse() -> Array:
    image = np.zeros((SIDE, SIDE), dtype=np.float32)
    image[MIDDLE, MIDDLE] = 1.0
    return image


def _shift_impulse(fraction: float, band: Band) -> Array:
    """(n,) what a shift makes of an impulse in the middle of a row."""
    shift = np.array([fraction, 0.0])
    shifted = sample_shifted(_impulse(), (0, 0), (SIDE, SIDE), shift, np.ones(1), band, 0.0)
    return shifted[MIDDLE].astype(np.float64)


def test_filters_of_smooth_images_smear_little_farther_than_stated() -> None:
    """Half a pixel is the widest of the shifts."""
    slope = gradients(_impulse(), FINE)[0][MIDDLE].astype(np.float64)
    for response in (slope, _shift_impulse(0.5, FINE)):
        beyond = np.abs(np.arange(SIDE) - MIDDLE) > t.SMEARED_PX
        # The weights of a shift lie about half a pixel beside the middle.
        assert np.sum(response[beyond] ** 2) < 0.05 * np.sum(response**2)


def test_shifts_are_as_accurate_as_stated_up_to_the_edge_of_their_band() -> None:
    places = np.arange(SIDE) - MIDDLE
    worst = []
    for band in (FINE, SHARP):
        for fraction in np.linspace(0.05, 0.95, 19):
            frequencies = np.linspace(0.0, band.edge, 200)
            waves = np.exp(-1j * np.outer(frequencies, places)) @ _shift_impulse(fraction, band)
            worst.append(np.abs(waves - np.exp(1j * frequencies * fraction)).max())
    assert 0.01 < max(worst) < 0.012


def test_the_noise_is_told_as_well_as_stated() -> None:
    rng = np.random.default_rng(5)
    side = t.NOISE_SPECTRUM_PX
    found = [estimate_noise_variance(rng.normal(size=(side, side))) for _ in range(400)]
    # The scatter of 400 numbers is known to 4 %.
    assert np.std(found) == pytest.approx(0.07, abs=0.01)


def test_noise_is_seldom_taken_for_structure() -> None:
    rng = np.random.default_rng(6)

    def signals(count: int, side: int) -> Array:
        found = [measure_image(rng.normal(size=(side, side))) for _ in range(count)]
        return np.array([image.signal_variance / image.noise_variance for image in found])

    # 12 of 600 are stated; four of their standard deviations, 3.4, to either side.
    assert 1 <= np.count_nonzero(signals(600, 96) > t.SIGNAL_MIN) <= 25
    assert signals(60, 192).max() < t.SIGNAL_MIN
    # Two of 19 000 are stated.
    assert max(measure_image(rng.normal(size=(96, 96))).significance for _ in range(300)) < (
        t.SIGNIFICANCE_MIN
    )
    parts = [measure_richest_parts(rng.normal(size=(192, 192))) for _ in range(60)]
    assert max(p.signal_variance / p.noise_variance for p in parts) < 0.7 * t.PARTS_SIGNAL_MIN
