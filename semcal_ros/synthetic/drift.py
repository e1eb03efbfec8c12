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

"""Specimen drift as a function of time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.synthetic.thresholds import WANDER_TERMS

DriftFunction = Callable[[Array], Array]
"""Displacement (n, 2) in m, sem frame, at times (n,) in s: what lay at X is seen at X + drift."""


@dataclass(frozen=True)
class Drift:
    """Thermal drift: constant velocity, an exponential settling, a smooth random wander and a
    vibration.

    The displacement is zero at time 0. The wander is a sum of sines with random phases whose
    amplitudes fall as 1/frequency, the spectrum of a random walk, cut off at both ends: it is
    smooth, determined by its seed, and can be evaluated at any time.

    Parameters
    ----------
    velocity_m_s
        Constant velocity (x, y).
    settling_m, settling_time_s
        Displacement that is reached, as ``settling (1 - exp(-t / time))``.
    wander_m
        RMS of each component of the wander.
    wander_period_s
        Longest and shortest period in the wander.
    vibration_m, vibration_hz
        Amplitude (x, y) and frequency of a sinusoidal vibration.
    seed
        Seed of the wander.
    """

    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    settling_m: tuple[float, float] = (0.0, 0.0)
    settling_time_s: float = 30.0
    wander_m: float = 0.0
    wander_period_s: tuple[float, float] = (120.0, 4.0)
    vibration_m: tuple[float, float] = (0.0, 0.0)
    vibration_hz: float = 50.0
    seed: int = 0

    def __call__(self, time_s: ArrayLike) -> Array:
        """Return the displacement (n, 2) in m at times (n,) in s."""
        t = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        settled = -np.expm1(-np.maximum(t, 0.0) / self.settling_time_s)
        drift: Array = t[:, None] * np.array(self.velocity_m_s)
        drift += settled[:, None] * np.array(self.settling_m)
        if self.vibration_m != (0.0, 0.0):
            wave = np.sin(2.0 * math.pi * self.vibration_hz * t)
            drift += wave[:, None] * np.array(self.vibration_m)
        if self.wander_m > 0.0:
            drift += self.wander_m * _evaluate_wander(t, self.seed, *self.wander_period_s)
        return drift


@lru_cache(maxsize=16)
def _draw_spectrum(seed: int, longest_s: float, shortest_s: float) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng([seed, 77])
    omega = 2.0 * math.pi / np.geomspace(longest_s, shortest_s, WANDER_TERMS)
    omega *= rng.uniform(0.9, 1.1, WANDER_TERMS)
    amplitude = 1.0 / omega
    amplitude *= math.sqrt(2.0) / np.linalg.norm(amplitude)
    return omega, amplitude, rng.uniform(0.0, 2.0 * math.pi, (2, WANDER_TERMS))


def _evaluate_wander(t: Array, seed: int, longest_s: float, shortest_s: float) -> Array:
    omega, amplitude, phase = _draw_spectrum(seed, longest_s, shortest_s)
    components = [
        (np.sin(t[:, None] * omega + phase[axis]) - np.sin(phase[axis])) @ amplitude
        for axis in (0, 1)
    ]
    return np.stack(components, axis=1)


NO_DRIFT = Drift()

DRIFTS: Mapping[str, Drift] = MappingProxyType(
    {
        "none": NO_DRIFT,
        "slow": Drift(velocity_m_s=(1.2e-9, -0.7e-9), wander_m=6e-9, seed=1),
        "settling": Drift(
            velocity_m_s=(2e-9, 1e-9), settling_m=(250e-9, -160e-9), wander_m=15e-9, seed=2
        ),
        "fast": Drift(
            velocity_m_s=(25e-9, -14e-9), settling_m=(-300e-9, 500e-9), wander_m=60e-9, seed=3
        ),
    }
)


def drift_preset(name: str) -> Drift:
    """Return the drift with this name.

    Raises
    ------
    InvalidValueError
        If there is no such preset.
    """
    if name not in DRIFTS:
        raise InvalidValueError(
            f"drift preset '{name}'",
            expected=f"one of {', '.join(DRIFTS)}",
            do=did_you_mean(name, DRIFTS),
        )
    return DRIFTS[name]
