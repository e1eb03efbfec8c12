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

"""The numbers of the applications: those that are said to follow from something do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import trapezoid

from semcal_ros.applications.cantilever import thresholds as cantilever
from semcal_ros.applications.reconstruction import thresholds as reconstruction
from semcal_ros.applications.servoing import thresholds as servoing
from semcal_ros.core.robust_losses import TUKEY_CONSTANT

BOTH_SIDES = 2.0


@pytest.mark.parametrize(
    ("chance", "one_in"),
    [
        (BOTH_SIDES * stats.norm.sf(cantilever.WIDTH_SIGMAS), 150_000),
        (stats.chi2.sf(2.0 * cantilever.SPREAD_RATIO**2, 2), 520),
        (BOTH_SIDES * stats.norm.sf(cantilever.LENGTH_SIGMAS), 370),
        (BOTH_SIDES * stats.norm.sf(cantilever.SHAPE_SIGMAS), 370),
        (BOTH_SIDES * stats.norm.sf(cantilever.BASE_SLIP_SIGMAS), 370),
        (BOTH_SIDES * stats.norm.sf(reconstruction.CONTRADICTION_SIGMAS), 16_000),
        (BOTH_SIDES * stats.norm.sf(reconstruction.HEIGHT_SIGMAS), 80),
        (stats.chi2.sf(reconstruction.HUBER_SIGMAS**2, 2), 3),
        ((1.0 - 3.0**-4) ** reconstruction.SPHERE_TRIALS, 500),
        (BOTH_SIDES * stats.norm.sf(servoing.STEP_SIGMAS), 2100),
        (2 * BOTH_SIDES * stats.norm.sf(servoing.GATE_SIGMAS), 870_000),
    ],
)
def test_rates_are_those_of_the_distributions(chance: float, one_in: float) -> None:
    assert 1.0 / chance == pytest.approx(one_in, rel=0.12)  # one or two digits are stated


def _efficiency_of_tukey(constant: float) -> float:
    """Of an estimate of location with normal noise: the square of E psi' over E psi^2."""
    x = np.linspace(-constant, constant, 200_001)
    density, inside = stats.norm.pdf(x), 1.0 - (x / constant) ** 2
    slope = trapezoid((inside**2 - 4.0 * (x / constant) ** 2 * inside) * density, x)
    return float(slope**2 / trapezoid((x * inside**2) ** 2 * density, x))


def _noise_gain() -> float:
    """The variance after three steps over that of one, with the transfer function of a Gaussian in the plane."""
    frequency = np.linspace(0.0, 10.0, 100_001)
    gaussian = np.exp(-0.5 * frequency**2)
    three, one = (
        trapezoid(kept**2 * frequency, frequency)
        for kept in (1.0 - (1.0 - gaussian) ** 3, gaussian)
    )
    return float(three / one)


@pytest.mark.parametrize(
    ("value", "stated", "within"),
    [
        (_efficiency_of_tukey(TUKEY_CONSTANT), 0.95, 5e-5),
        (0.5 * cantilever.COARSE_PX * 0.5 * cantilever.STEP_RAD, 1.1, 0.05),
        (0.5 * cantilever.SEARCHED_PX * 0.5 * float(np.diff(cantilever.FINE_RAD)[0]), 0.6, 0.05),
        (max(cantilever.EDGE_WIDTHS_PX), 5.1, 0.05),
        (cantilever.MAKER_TOLERANCE / math.sqrt(3.0), 0.017, 5e-4),
        (1.0 / math.sqrt(35.0), 0.17, 0.005),
        (cantilever.LOSS_MAX, TUKEY_CONSTANT**2 / 3.0, 1e-12),
        (_noise_gain(), reconstruction.NOISE_GAIN, 1e-4),
        (np.sum(reconstruction.SECOND_DIFFERENCE**2), 1.0, 1e-12),
        (reconstruction.GREY_CORRELATION_MIN**2, 0.5, 0.011),
        (1.0 / math.sqrt(2.0 * (reconstruction.PATCH_GROUPS - 1)), 0.18, 0.005),
        (0.1 / math.sin(reconstruction.TILT_STEP_MIN_RAD), 11.0, 0.5),
        (math.degrees(math.acos(math.sqrt(reconstruction.COSINE2_MIN))), 84.0, 0.5),
        (servoing.MARKER_SIDE / servoing.MARKER_BITS, 0.12, 0.004),
        (8 * servoing.LEVELS_MAX, 50, 2),
        (servoing.COMMANDS_KEPT / servoing.LATENCY_MAX_S, 34.0, 0.2),
        # A delay of two frames: the limit of the gain is 2 sin(pi / 10).
        (2.0 * math.sin(math.pi / 10.0), 0.618, 5e-4),
        (servoing.GAIN_WITHOUT_TIMES_MAX, 0.25, 0.0),
    ],
)
def test_values_are_those_of_the_formulas(value: float, stated: float, within: float) -> None:
    assert value == pytest.approx(stated, abs=max(within, 1e-12))
