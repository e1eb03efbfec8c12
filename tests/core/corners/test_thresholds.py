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

"""The numbers of the search for corners: those that are said to follow from something do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

from semcal_ros.core.corners import thresholds as t
from semcal_ros.core.corners.local_map import fit_local_maps


@pytest.mark.parametrize(
    ("chance", "one_in"),
    [
        (stats.chi2.sf(t.IMBALANCE_MAX, 2), 1800),
        (stats.norm.sf(t.CHI2_SIGMAS), 1e9),
        (2.0 * stats.norm.sf(t.BLUR_SIGMAS), 16_000),
        (stats.chi2.sf(t.RESIDUAL_SIGMAS[-1] ** 2, 2), 940),
        (stats.norm.sf(t.SCATTER_SIGMAS), 390),
        # The power of noise has an exponential distribution, whose quantile p is -log(1 - p) means.
        (np.exp(-t.NOISE_POWERS), 8100),
        ((1.0 - t.USUAL_QUANTILE) ** t.CLEAR_POWER, 3e12),
        ((1.0 - t.USUAL_QUANTILE) ** t.SUBMULTIPLE_POWER, 1.8e6),
        (5e5 * 0.5**t.LINES_POWER, 1.0 / 3e-55),
        (stats.f.sf(t.AMBIGUOUS_RATIO, 28, 28), 28),
        # Four parameters of a relief among 56 real and imaginary parts.
        (stats.f.sf((t.RELIEF_GAIN_MIN - 1.0) * 52 / 4, 4, 52), 19_000),
    ],
)
def test_rates_are_those_of_the_distributions(chance: float, one_in: float) -> None:
    assert 1.0 / chance == pytest.approx(one_in, rel=0.12)  # one or two digits are stated


@pytest.mark.parametrize(
    ("value", "stated", "within"),
    [
        (t.COMPARABLE_RATIO, 20.0 ** (2 / 28), 0.01),
        (t.BLUR_MIN_PX, 1.0 / np.sqrt(12.0), 0.01),
        (np.exp(-0.5 * t.BAND_BLURS**2), 0.011, 0.001),
        (np.exp(-2.0 * (np.pi * t.DEMODULATION_PERIODS) ** 2), 1.5e-5, 1e-6),
        (np.exp(-2.0 * (np.pi * t.PATTERN_DEMODULATION_PERIODS) ** 2), 0.018, 0.001),
        (t.CELL_SINE_MIN, np.cos(np.radians(75.0)), 0.01),
        (t.BASIS_SINE_MIN, np.sin(2.0 * np.arctan(np.cos(np.radians(66.0)))), 0.01),
        (t.BASIS_RATIO_MAX, 1.0 / np.cos(np.radians(58.0)), 0.02),
        ((0.5 - t.HOPELESS_PART) / np.sqrt(0.25 / t.CORNER_SAMPLE), 3.2, 0.05),
        (t.ANGLE_MAX / t.ANGLE_PRIOR, 6.7, 0.05),
        (t.ALONG_SIGMA * np.sqrt(12.0 / 1e6), 0.1, 0.01),
        (np.sqrt(t.SADDLE_THRESHOLD), 0.32, 0.005),
        # The second derivative of a step that a normal distribution of sigma 1 blurs is 0.242 at most.
        (0.242 / 8.0 / t.SAMPLES_PER_KNOT**2, 0.002, 0.0002),
        # 1 / (2 density median) of a chi-square.
        (
            t.MEDIAN_SIGMA_1,
            0.5 / (stats.chi2.pdf(stats.chi2.median(1), 1) * stats.chi2.median(1)),
            1e-3,
        ),
        (
            t.MEDIAN_SIGMA_2,
            0.5 / (stats.chi2.pdf(stats.chi2.median(2), 2) * stats.chi2.median(2)),
            1e-9,
        ),
        # What is left of a step at a distance of so many blur widths.
        (0.5 * special.erfc(t.NEIGHBOUR_BLURS * t.WINDOW_HALF_WIDTH / np.sqrt(2.0)), 3e-5, 3e-6),
    ],
)
def test_figures_follow_from_what_is_stated(value: float, stated: float, within: float) -> None:
    assert value == pytest.approx(stated, abs=within)


def test_the_error_function_is_as_good_as_its_source_says() -> None:
    z = np.linspace(0.0, 5.0, 5001)
    step = 1.0 / (1.0 + t.ERF_P * z)
    series = sum(c * step**k for k, c in enumerate(t.ERF_C, 1))
    assert np.abs(1.0 - series * np.exp(-(z**2)) - special.erf(z)).max() < 1.5e-7


def test_the_side_lobes_of_the_window_are_below_what_counts() -> None:
    """Of a Hann window, sampled 64 times per bin."""
    size = 256
    power = np.abs(np.fft.rfft(np.hanning(size), 64 * size)) ** 2
    beside = power[np.arange(len(power)) > 2.1 * 64] / power[0]
    assert 6e-4 < beside.max() < 8e-4 < t.SIDE_LOBE_POWER


def test_the_ridge_takes_a_thousandth_off_a_bend() -> None:
    i, j = (g.ravel() for g in np.meshgrid(np.arange(-2, 3), np.arange(-2, 3), indexing="ij"))
    cells = np.stack([i, j], axis=1)
    bent = np.stack([10.0 * i + 0.005 * i**2, 10.0 * j], axis=1)
    maps = fit_local_maps(np.zeros((1, 2), dtype=np.intp), cells, bent)
    assert 1.0 - maps.bend[0, 0, 0] / 0.01 == pytest.approx(0.9e-3, abs=0.05e-3)


def test_medians_of_noise_scatter_as_stated() -> None:
    """EVERYWHERE_RATIO is ten deviations above the median of the others."""
    rng = np.random.default_rng(5)
    places = np.abs(rng.normal(size=(20_000, 20)) + 1j * rng.normal(size=(20_000, 20)))
    medians = np.median(places, axis=1)
    scatter = float(medians.std() / medians.mean())
    assert scatter == pytest.approx(0.15, abs=0.01)
    assert (t.EVERYWHERE_RATIO - 1.0) / scatter == pytest.approx(10.0, abs=0.5)
