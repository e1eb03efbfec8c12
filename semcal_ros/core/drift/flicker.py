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

"""Drift that is faster than the frames: 1/f noise along the slow axis of a scan.

Scanners creep, and fields and stages wander, with a power that falls as one over the frequency. What is
slower than a frame is drift, and the filter follows it. What is faster bends the columns of a frame to and fro.
A registration measures the mean over the frame; the specimen was elsewhere at its middle, and no scatter of
the tiles says so. With the one-sided density ``A^2 / f`` (f in cycles per frame, A^2 the variance of one e-fold of
frequencies) the variance of the two about each other is

    A^2 int (1 - sinc f)^2 / f df.

The density is told by how the shifts of the R rows of tiles depart from a line: in cosine modes m = 2, 3, ... down
the frame their power is ``A^2 / m + a``, with a white part from lines that jitter, which the covariance of a
registration has already. The noise of the images has the power of the difference of two halves of the
columns, in which what moves whole lines cancels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.drift.thresholds import (
    DENSITY_GAIN_MIN,
    FLICKER_FRAMES,
    FLICKER_GROWTH,
    FLICKER_ITERATIONS,
    FLICKER_MODES,
    FLICKER_OUTLIER,
    FLICKER_SHIFT_MAX,
    JITTER_GAIN_MIN,
    MIXED_GAIN_MIN,
    MOVING_RATIO_MIN,
    MOVING_SIGMAS,
    POWER_MIN,
    POWER_OF_MODE,
    VARIANCE_OF_MEAN,
    VARIANCE_OF_SHEAR,
)
from semcal_ros.core.registration.register import Registration

_MODES = np.arange(*FLICKER_MODES)


@dataclass(frozen=True)
class FlickerEstimator:
    """Density of the 1/f noise of a stream, from its latest registrations. Each makes another one.

    Attributes
    ----------
    powers
        (2, modes, 2) of each of the latest: of x and y, of the whole and of the noise of the images.
    count
        Number of registrations.
    due
        Their number at which the density is estimated the next time.
    """

    powers: tuple[Array, ...] = ()
    count: int = 0
    due: int = 1

    def add(
        self, registration: Registration, averaged: float, size: tuple[int, int]
    ) -> tuple[FlickerEstimator, bool]:
        """Add a registration against the mean of ``averaged`` frames of ``size`` (width, height); whether the
        next estimate is due.
        """
        if np.any(np.abs(registration.shift_px) > FLICKER_SHIFT_MAX * np.array(size)):
            return self, False
        power = registration.alignment.row_power(int(_MODES[-1]) + 1)
        if power is None:
            return self, False
        # The keyframe is bent, too.
        known = np.full((2, len(_MODES), 2), np.nan)
        modes = power.shape[1] - int(_MODES[0])
        known[:, :modes] = power[:, _MODES[:modes]] / (1.0 + 1.0 / averaged)
        count, due = self.count + 1, self.due
        if count >= due:
            due = min(int(np.ceil(FLICKER_GROWTH * count)), count + FLICKER_FRAMES)
        after = FlickerEstimator((*self.powers, known)[-FLICKER_FRAMES:], count, due)
        return after, due > self.due

    def variance_px2(self) -> Array:
        """(4,) variances of the shift of a frame (x, y) about that of its middle, and of its shear; zero
        where there is no 1/f noise to be seen.
        """
        if not self.powers:
            return np.zeros(4)
        powers = np.array(self.powers)
        total = np.nanmean(powers, axis=(1, 2, 3))
        powers = powers[total <= FLICKER_OUTLIER * np.median(total)]
        counts = np.count_nonzero(np.isfinite(powers[:, 0, :, 0]), axis=0).astype(np.float64)
        seen = counts > 0.0
        whole, noise = np.nanmean(powers[:, :, seen], axis=0)
        modes, counts = _MODES[seen], counts[seen]
        density = np.array([_fit_density(whole[:, k], noise[:, k], modes, counts) for k in (0, 1)])
        return np.concatenate([VARIANCE_OF_MEAN * density, VARIANCE_OF_SHEAR * density])


def _fit_density(whole: Array, noise: Array, modes: Indices, counts: Array) -> float:
    """A^2 from the mean powers of modes in ``counts`` frames, or 0 where jitter and the noise of the images explain
    them as well.
    """
    # The logarithm of a ratio of two chi-squares with n degrees of freedom has a sigma of 2 / sqrt(n).
    ratio = float(counts @ whole) / max(float(counts @ noise), POWER_MIN)
    chance = float(np.exp(2.0 * MOVING_SIGMAS / np.sqrt(np.sum(counts))))
    if ratio < chance:
        return 0.0
    level = np.full(len(modes), max(float(np.mean(noise)), POWER_MIN))
    white = np.ones((len(modes), 1))
    pink = (POWER_OF_MODE / modes)[:, None]

    def gain(before: Array, after: Array) -> float:
        return float(np.sum(counts * (np.log(before / after) + whole / before - whole / after)))

    _, plain = _fit_powers(whole, white, level, counts)
    values, fitted = _fit_powers(whole, pink, level, counts)
    mixed, fitted_mixed = _fit_powers(whole, np.column_stack([pink, white]), level, counts)
    needed = -JITTER_GAIN_MIN
    if gain(fitted, fitted_mixed) > JITTER_GAIN_MIN:
        # Lines do not jitter by an amount that is not seen.
        values, fitted, needed = mixed, fitted_mixed, MIXED_GAIN_MIN
    if ratio < MOVING_RATIO_MIN * chance:
        needed = DENSITY_GAIN_MIN
    return float(values[0]) if gain(plain, fitted) > needed else 0.0


def _fit_powers(whole: Array, columns: Array, level: Array, counts: Array) -> tuple[Array, Array]:
    """Most likely amounts, not negative, of the columns in powers above a level, and the powers that they predict.

    A power is a chi-square with one degree of freedom for each frame; each multiplicative step makes the
    amounts more likely (Fevotte and Idier 2011, doi:10.1162/NECO_a_00168).
    """
    amounts = np.full(columns.shape[1], float(np.mean(whole)))
    for _ in range(FLICKER_ITERATIONS):
        expected = columns @ amounts + level
        risen = columns.T @ (counts * whole / expected**2)
        amounts = amounts * np.sqrt(risen / (columns.T @ (counts / expected)))
    return amounts, columns @ amounts + level
