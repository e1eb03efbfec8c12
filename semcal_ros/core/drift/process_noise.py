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

"""Process noise of the drift: how it changes by itself.

Between frames the acceleration is random and decays with a time constant (Singer 1970,
doi:10.1109/TAES.1970.310128). Without one it is white, which is the model of a nearly constant
velocity (Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2, doi:10.1002/0471221279). A drift whose
steps have no memory (charging, a beam that jumps) is a random walk, which is a white velocity beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.thresholds import (
    MEAN_POSITION_VARIANCE,
    MEAN_VELOCITY_VARIANCE,
    MEAN_WALK_VARIANCE,
    QUADRATURE_SPAN_MAX,
    SERIES_BELOW,
)

# The noise of a step is a Gauss-Legendre quadrature over the impulse responses; this order is exact
# to rounding up to 4 time constants, and longer steps are made by doubling. Van Loan's matrix
# exponential (1978, doi:10.1109/TAC.1978.1101743) needs exp(+dt / time constant) beside
# exp(-dt / time constant), so that it loses all digits from 40 time constants on, as after a pause;
# with scipy's expm it takes four times as long (1.0 instead of 0.25 ms, and it is needed for each
# frame).
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
# Fractions of a step at which the impulse response is needed: the nodes, and its end.
_FRACTIONS = np.append(0.5 * (_NODES + 1.0), 1.0)


@dataclass(frozen=True)
class ProcessNoise:
    """Random acceleration of the drift.

    Attributes
    ----------
    psd
        Power spectral density of the acceleration at low frequencies, length^2 / s^3.
    time_constant_s
        Time in which an acceleration decays, s; 0 for a white one.
    flicker
        Variances (x, y) of the drift at the middle of a frame about its mean over the frame that are due to 1/f
        noise (:mod:`semcal_ros.core.drift.flicker`), and of the mean velocity over the frame about that of
        the mean drift.
    walk_s2
        Density of the drift's random walk, length^2 / s, over ``psd``; 0 where it moves smoothly.
    """

    psd: float
    time_constant_s: float = 0.0
    flicker: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    walk_s2: float = 0.0

    @property
    def acceleration_variance(self) -> float:
        """Stationary variance of each component; 0 for a white one, which has none."""
        return 0.5 * self.psd / self.time_constant_s if self.time_constant_s > 0.0 else 0.0

    @property
    def flicker_covariance(self) -> Array:
        """(2, 2) covariance that 1/f noise adds to a drift between the middles of two frames: once for the frame
        and once for the first one, from which the drift counts.
        """
        return np.diag(2.0 * np.array(self.flicker[:2]))

    def frame_covariance(self, scan_s: float) -> Array:
        """(4, 4) covariance of the mean drift and the mean velocity over an acquisition, given
        drift, velocity and acceleration at its middle.

        It is exact for a white acceleration and a random walk; of an acceleration that lasts longer
        than the acquisition, the state knows a part, and the covariance is an upper bound.
        """
        psd = self.psd
        if self.time_constant_s > 0.0:
            psd *= min(1.0, 0.5 * scan_s / self.time_constant_s)
        variances = [
            psd * scan_s**3 * MEAN_POSITION_VARIANCE,
            psd * scan_s * MEAN_VELOCITY_VARIANCE,
        ]
        if scan_s > 0.0:
            walk = self.psd * self.walk_s2
            variances[0] += walk * scan_s * MEAN_WALK_VARIANCE
            # Of the mean velocity, which is the way from the first to the last line by the time between them.
            variances[1] += walk / scan_s
        return np.diag(np.repeat(variances, 2) + np.array([0.0, 0.0, *self.flicker[2:]]))

    def discretise(self, dt_s: float) -> tuple[Array, Array]:
        """(3, 3) transition matrix of ``[x, v, a]`` of one axis over an interval, and the (3, 3)
        covariance of its noise.
        """
        transition, unit = _discretise_unit(dt_s, self.time_constant_s)
        noise = unit * self.psd
        noise[0, 0] += self.psd * self.walk_s2 * dt_s
        return transition, noise


# The steps of a regular stream are alike, and an estimate of the noise goes through the same ones again and again.
@lru_cache(maxsize=1024)
def _discretise_unit(dt_s: float, time_constant_s: float) -> tuple[Array, Array]:
    """:meth:`ProcessNoise.discretise` of an acceleration of unit density; neither array may be changed."""
    if time_constant_s > 0.0:
        transition, noise = _discretise_fading(dt_s, 1.0 / time_constant_s)
    else:
        transition = np.array([[1.0, dt_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
        noise = np.zeros((3, 3))
        noise[0, :2] = dt_s**3 / 3.0, dt_s**2 / 2.0
        noise[1, :2] = dt_s**2 / 2.0, dt_s
    transition.flags.writeable = noise.flags.writeable = False
    return transition, noise


def _discretise_fading(dt_s: float, rate: float) -> tuple[Array, Array]:
    time_constants = max(dt_s * rate, 1e-300)
    doublings = max(0, int(np.ceil(np.log2(time_constants / QUADRATURE_SPAN_MAX))))
    step_s = dt_s / 2.0**doublings
    responses = _impulse_response(step_s * _FRACTIONS, rate)
    transition = np.eye(3)
    transition[:, 2] = responses[:, -1]
    transition[0, 1] = step_s
    # Noise that enters at some time before the end of the step acts for that time.
    at_nodes = responses[:, :-1]
    noise = (at_nodes * (0.5 * step_s * _WEIGHTS)) @ at_nodes.T
    for _ in range(doublings):
        noise = transition @ noise @ transition.T + noise
        transition = transition @ transition
    return transition, (noise + noise.T) * (0.5 * rate**2)


def _impulse_response(time_s: Array, rate: float) -> Array:
    """(3, n) drift, velocity and acceleration after n times, of an acceleration that is 1 at first
    and decays at a rate.
    """
    decay = np.expm1(-rate * time_s)
    drift = np.where(
        rate * time_s > SERIES_BELOW,
        (time_s + decay / rate) / rate,
        0.5 * time_s**2 * (1.0 - rate * time_s / 3.0 + (rate * time_s) ** 2 / 12.0),
    )
    return np.stack([drift, -decay / rate, 1.0 + decay])
