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

"""The local phase of a picture at one spatial frequency, which says how far each place is from the next line.

The picture is demodulated (Takeda et al. 1982, doi:10.1364/JOSA.72.000156). The phase is followed from period to period
by its derivatives, which never wrap where a distortion bends the lines by less than half a period per period.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.polynomial.polynomial import polygrid2d, polyval2d
from scipy import ndimage

from semcal_ros.core.arrays import Array, Array32, Mask
from semcal_ros.core.corners.thresholds import (
    DEMODULATION_PERIODS,
    LINES_AMPLITUDE_MIN,
    LOST_PHASE_RAD,
    PATTERN_DEMODULATION_PERIODS,
    PHASE_DEGREE,
    PHASE_PLACES_MAX,
)

_POWERS = [(a, n - a) for n in range(1, PHASE_DEGREE + 1) for a in range(n + 1)]


@dataclass(frozen=True)
class SmoothPhase:
    """A polynomial in x and y about the middle of a picture, rad.

    Attributes
    ----------
    middle, scale
        (2,) what is zero, and what is 1, px.
    coefficients
        Of the terms without a constant.
    """

    middle: Array
    scale: float
    coefficients: Array

    def basis(self, x: Array, y: Array) -> Array:
        """Return the terms at positions, along a last axis."""
        u, v = self._scaled(x, y)
        return np.stack([u**a * v**b for a, b in _POWERS], axis=-1)

    def at(self, x: Array, y: Array) -> Array:
        """Return the phase at positions."""
        return np.asarray(polyval2d(*self._scaled(x, y), self._matrix))

    def of_pixels(self, width: int, height: int) -> Array:
        """Return the (height, width) phase of all pixels."""
        u, v = self._scaled(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        return np.asarray(polygrid2d(u, v, self._matrix).T)

    def _scaled(self, x: Array, y: Array) -> tuple[Array, Array]:
        return (x - self.middle[0]) / self.scale, (y - self.middle[1]) / self.scale

    @property
    def _matrix(self) -> Array:
        """Coefficients of u^a v^b at [a, b]."""
        matrix = np.zeros((PHASE_DEGREE + 1, PHASE_DEGREE + 1))
        matrix[tuple(np.transpose(_POWERS))] = self.coefficients
        return matrix


@dataclass(frozen=True)
class LocalPhase:
    """The phase at all places of a picture.

    Attributes
    ----------
    rate
        (2,) phase per pixel along x and y that was taken off before.
    smooth
        A polynomial that follows most of the rest.
    rest
        (h, w) what is left, rad.
    seen
        (h, w) where the frequency is strong enough.
    """

    rate: Array
    smooth: SmoothPhase
    rest: Array
    seen: Mask

    def at(self, xy: Array) -> Array:
        """Return the phase at (n, 2) positions, rad; it grows by a turn from line to line."""
        x, y = xy.T
        rest = ndimage.map_coordinates(self.rest, [y, x], order=1, mode="nearest")
        return np.asarray(self.rate[0] * x + self.rate[1] * y + self.smooth.at(x, y) + rest)


def follow_phase(
    image: Array32, frequency: Array, period_px: float | None = None
) -> LocalPhase | None:
    """Follow the phase at a frequency across a picture; None where that fails.

    Parameters
    ----------
    image
        (h, w).
    frequency
        (2,) cycles per pixel.
    period_px
        Period of the pattern, of which the frequency is a multiple; the frequency's own by default.
    """
    height, width = image.shape
    period = float(1.0 / np.linalg.norm(frequency))
    amplitude, rate, values = _demodulate(
        image,
        frequency,
        max(DEMODULATION_PERIODS * period, PATTERN_DEMODULATION_PERIODS * (period_px or 0.0)),
    )
    smooth = _fit_phase(amplitude, values, period)
    turned = values * np.exp(-1j * smooth.of_pixels(width, height))
    constant = float(np.angle(np.sum(turned * amplitude**2)))
    left = np.angle(turned * np.exp(-1j * constant))
    seen = amplitude > LINES_AMPLITUDE_MIN * float(np.median(amplitude))
    if float(np.mean(np.abs(left[seen]) > LOST_PHASE_RAD)) > 0.1:
        return None
    return LocalPhase(rate, smooth, left + constant, seen)


def _demodulate(image: Array32, frequency: Array, sigma: float) -> tuple[Array, Array, Array]:
    """Return the (h, w) amplitude, the (2,) phase per pixel that was taken off, and the (h, w) rest as unit phasors."""
    height, width = image.shape
    rate = 2.0 * np.pi * frequency
    level = cv2.GaussianBlur(image, (0, 0), sigma)
    wave = np.outer(
        np.exp(-1j * rate[1] * np.arange(height)), np.exp(-1j * rate[0] * np.arange(width))
    )
    mixed = (image - level) * wave
    real, imaginary = (
        cv2.GaussianBlur(np.ascontiguousarray(part, dtype=np.float32), (0, 0), sigma)
        for part in (mixed.real, mixed.imag)
    )
    values = real.astype(np.float64) + 1j * imaginary
    amplitude = np.abs(values)
    return amplitude, rate, values / np.maximum(amplitude, 1e-30)


def _fit_phase(amplitude: Array, values: Array, period: float) -> SmoothPhase:
    """Fit a polynomial without a constant to the phase of phasors, by the differences of neighbours."""
    height, width = amplitude.shape
    # Fine enough for a bend of a quarter of a period per period, if 1000 px wide.
    step = max(1, round(period), min(height, width) // PHASE_PLACES_MAX)
    fitted = SmoothPhase(
        0.5 * np.array([width - 1, height - 1]), 0.5 * max(width, height), np.zeros(0)
    )
    grid = values[::step, ::step]
    weight = amplitude[::step, ::step]
    rows, columns = np.mgrid[0:height:step, 0:width:step].astype(np.float64)
    terms = fitted.basis(columns, rows)
    design, target, weights = [], [], []
    for axis in (0, 1):
        first = [slice(None)] * 2
        second = [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        a, b = tuple(first), tuple(second)
        target.append(np.angle(grid[b] * np.conj(grid[a])).ravel())
        weights.append(np.minimum(weight[a], weight[b]).ravel())
        design.append((terms[b] - terms[a]).reshape(-1, len(_POWERS)))
    matrix, right, certain = (np.concatenate(parts) for parts in (design, target, weights))
    normal = matrix.T @ (matrix * certain[:, None])
    # The ridge is for pictures of few periods, which do not determine all terms.
    normal += 1e-6 * float(np.trace(normal)) / len(_POWERS) * np.eye(len(_POWERS))
    return replace(fitted, coefficients=np.linalg.solve(normal, matrix.T @ (right * certain)))
