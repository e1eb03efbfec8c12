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

"""The spatial frequencies of a picture that repeats, in one direction or two, and the local phase at one of them.

Power is judged over what is usual for frequencies of the same size, and by the part of the picture that has it: holes
and debris have more of it than lines or dots do, but at frequencies of all directions, and at one place.

The local phase says how far each place is from the next line. The picture is demodulated (Takeda et al. 1982,
doi:10.1364/JOSA.72.000156). The phase is followed from period to period by its derivatives, which never wrap where a
distortion bends the lines by less than half a period per period.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.polynomial.polynomial import polygrid2d, polyval2d
from numpy.typing import NDArray
from scipy import ndimage

from semcal_ros.core.arrays import Array, Array32, Image, Mask
from semcal_ros.core.corners.thresholds import (
    BENT_LINES_PART,
    CLIPPED_PART,
    DEMODULATION_PERIODS,
    EVERYWHERE_RATIO,
    FAINT_PEAK,
    FREQUENCY_OFF_BINS,
    FREQUENCY_UNSURE_PART,
    HIGHEST_HARMONIC,
    LINES_AMPLITUDE_MIN,
    LOST_PHASE_RAD,
    MULTIPLE_POWER_RATIO,
    MULTIPLES_COMPARED,
    OTHER_DIRECTIONS_DEG,
    PATTERN_DEMODULATION_PERIODS,
    PEAKS_MAX,
    PHASE_DEGREE,
    PHASE_PLACES_MAX,
    PLACES_ACROSS,
    RING_OCTAVES,
    SIDE_LOBE_POWER,
    SPECTRUM_PX,
    SUBMULTIPLE_POWER,
    USUAL_QUANTILE,
    WINDOW_LOBE_BINS,
)

_POWERS = [(a, n - a) for n in range(1, PHASE_DEGREE + 1) for a in range(n + 1)]


@dataclass(frozen=True)
class Spectrum:
    """The middle of an image behind a window, and its power spectrum.

    Attributes
    ----------
    transform
        (h, w) coefficients of the windowed pixels.
    power
        (h, w // 2 + 1) power.
    clearness
        Power over what is usual for frequencies of the same size.
    fx, fy
        Frequencies, cycles per pixel.
    """

    transform: NDArray[np.complex128]
    power: Array
    clearness: Array
    fx: Array
    fy: Array

    def bins_from(self, frequency: Array) -> Array:
        """Return the distance of all frequencies from one, in bins."""
        height, width = self.transform.shape
        off = np.hypot((self.fx - frequency[0]) * width, (self.fy - frequency[1]) * height)
        return np.asarray(off)

    def is_aside(self, frequency: Array) -> Mask:
        """Return which frequencies are no multiples of one, within the window's lobes and the bend of the lines."""
        along = (self.fx * frequency[0] + self.fy * frequency[1]) / float(frequency @ frequency)
        height, width = self.transform.shape
        aside = np.hypot(
            (self.fx - along * frequency[0]) * width, (self.fy - along * frequency[1]) * height
        )
        return np.asarray(aside > WINDOW_LOBE_BINS + BENT_LINES_PART * self.bins_from(np.zeros(2)))

    def centre_near(self, frequency: Array) -> Array:
        """Return the centre of the power near a frequency."""
        near = np.where(self.bins_from(frequency) < WINDOW_LOBE_BINS, self.power, 0.0)
        return np.array([(near * self.fx).sum(), (near * self.fy).sum()]) / float(near.sum())

    def find_divisor(self, frequency: Array, lowest: float, highest: float) -> int:
        """Return by what a frequency of the lines is to be divided, so that all of them are its multiples."""
        height, width = self.transform.shape
        bins = float(np.hypot(frequency[0] * width, frequency[1] * height))
        ratios = self.find_ratios(frequency, lowest, highest)
        tolerance = FREQUENCY_OFF_BINS + FREQUENCY_UNSURE_PART * ratios * bins
        most = max(1, min(HIGHEST_HARMONIC, int(np.linalg.norm(frequency) / lowest)))
        for divisor in range(1, most + 1):
            off = np.abs(ratios - np.rint(ratios * divisor) / divisor) * bins
            if np.all(off < tolerance):
                return divisor
        return 1

    def find_faint_divisor(self, frequency: Array, lowest: float, highest: float) -> int:
        """Return by what a frequency is to be divided since the lines have that, too, however faintly.

        Every other line may differ from those beside it by a little.
        """
        for divisor in range(HIGHEST_HARMONIC, 1, -1):
            unit = frequency / divisor
            if np.linalg.norm(unit) < lowest:
                continue
            off = self.bins_from(unit)
            at = np.unravel_index(
                np.argmax(np.where(off < WINDOW_LOBE_BINS, self.clearness, 0.0)), off.shape
            )
            clear = (
                self.clearness[at] > SUBMULTIPLE_POWER
                and self.power[at] > SIDE_LOBE_POWER * highest
            )
            if off[at] < 0.5 * WINDOW_LOBE_BINS and clear and self.is_everywhere(unit):
                return divisor
        return 1

    def find_ratios(self, frequency: Array, lowest: float, highest: float) -> Array:
        """Return the other frequencies of the lines over one of them.

        The power has a maximum there, while that of a hole rises towards lower frequencies, and it comes from
        everywhere in the picture and not from the edge of a hole.
        """
        length = float(np.linalg.norm(frequency))
        ratio = np.abs(self.fx * frequency[0] + self.fy * frequency[1]) / length**2
        peaks = self.clearness[self.is_peak & (ratio < MULTIPLES_COMPARED)]
        # A picture of few pixels has few frequencies, and there may be no peak among the low ones.
        clearest = float(peaks.max(initial=0.0))
        among = self.clearness > max(SUBMULTIPLE_POWER, FAINT_PEAK * clearest)
        among &= self.power > SIDE_LOBE_POWER * highest
        among &= (
            ~self.is_aside(frequency) & (ratio > lowest / length) & (ratio < MULTIPLES_COMPARED)
        )
        return np.abs(self.find_frequencies(among) @ frequency) / length**2

    @cached_property
    def is_peak(self) -> Mask:
        """(h, w // 2 + 1) where the clearness is larger than around it."""
        side = 4 * int(WINDOW_LOBE_BINS) + 1
        return np.asarray(
            self.clearness == ndimage.maximum_filter(self.clearness, side, mode="wrap")
        )

    def find_frequencies(self, among: Mask, most: int = PEAKS_MAX) -> Array:
        """Return the (n, 2) clearest maxima of these frequencies that most of the image has, the clearest first."""
        rows, columns = np.nonzero(self.is_peak & among)
        order = np.argsort(-self.clearness[rows, columns], kind="stable")[:most]
        centres = [
            self.centre_near(np.array([self.fx[at], self.fy[at]]))
            for at in zip(rows[order], columns[order], strict=True)
        ]
        return np.array([f for f in centres if self.is_everywhere(f)]).reshape(-1, 2)

    def is_everywhere(self, frequency: Array) -> bool:
        """Whether most of the image has this frequency, more than others of its size."""
        turns = np.radians([0.0, *OTHER_DIRECTIONS_DEG])
        c, s = np.cos(turns), np.sin(turns)
        x, y = frequency
        directions = np.stack([c * x - s * y, s * x + c * y], axis=1)
        amplitude, *others = (self._median_amplitude(f) for f in directions)
        return amplitude > EVERYWHERE_RATIO * float(np.median(others))

    def _median_amplitude(self, frequency: Array) -> float:
        """Return the median amplitude over the places of the image, by the coefficients around the frequency."""
        size = np.array(self.transform.shape)
        period = 1.0 / float(np.linalg.norm(frequency))
        sigma = max(
            DEMODULATION_PERIODS * period, min(float(size.min()) / PLACES_ACROSS, 3.0 * period)
        )
        # What is beyond 3.5 standard deviations of the low pass is less than a hundredth.
        spread = size / (2.0 * np.pi * sigma)
        reach = np.minimum(np.ceil(3.5 * spread).astype(int), size // 2 - 1)
        centre = frequency[::-1] * size
        rows, columns = (
            np.arange(-n, n + 1) + round(float(at)) for n, at in zip(reach, centre, strict=True)
        )
        low_pass = np.outer(
            np.exp(-0.5 * ((rows - centre[0]) / spread[0]) ** 2),
            np.exp(-0.5 * ((columns - centre[1]) / spread[1]) ** 2),
        )
        near = self.transform[np.ix_(rows % size[0], columns % size[1])]
        places = np.abs(np.fft.ifft2(near * low_pass))
        height, width = places.shape
        # The window takes the outer parts down.
        inner = np.s_[height // 4 : height - height // 4, width // 4 : width - width // 4]
        return float(np.median(places[inner])) * places.size

    def strongest_multiple(self, frequency: Array, most: int) -> int:
        """Return by what the frequency is multiplied where its power is largest; 1 unless another is far larger."""
        power = [
            float(self.power[self.bins_from(m * frequency) < WINDOW_LOBE_BINS].max())
            for m in range(1, most + 1)
        ]
        best = int(np.argmax(power))
        return best + 1 if power[best] > MULTIPLE_POWER_RATIO * power[0] else 1


def compute_spectrum(image: Image) -> Spectrum:
    """Compute the spectrum of the middle of a (h, w) image, at most 1024 px wide."""
    height, width = (min(side, SPECTRUM_PX) for side in image.shape)
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    part = image[top : top + height, left : left + width].astype(np.float64)
    window = np.outer(np.hanning(height), np.hanning(width))
    part = (part - float((part * window).sum() / window.sum())) * window
    transform = np.fft.fft2(part)
    power = np.abs(transform[:, : width // 2 + 1]) ** 2
    fy, fx = np.meshgrid(np.fft.fftfreq(height), np.fft.rfftfreq(width), indexing="ij")
    return Spectrum(transform, power, power / _usual_power(power, np.hypot(fx, fy)), fx, fy)


def list_octaves(size: tuple[int, int]) -> range:
    """Return the scales of an image of this (width, height), down to the one that a spectrum shows as a whole."""
    return range(max(0, int(np.ceil(np.log2(max(size) / SPECTRUM_PX)))) + 1)


def clip_levels(image: Array32) -> Array32:
    """Clip the grey levels of an image, so that a hole or debris is no more than what lies beside the lines."""
    low, high = np.quantile(image[::4, ::4], [CLIPPED_PART, 1.0 - CLIPPED_PART])
    return np.clip(image, low, high)


def _usual_power(power: Array, radius: Array) -> Array:
    """Return a low quantile of the power at frequencies of each size, interpolated between rings."""
    at = np.log2(np.maximum(radius, radius[radius > 0.0].min())) / RING_OCTAVES
    ring = np.rint(at).astype(int)
    rings = np.unique(ring)

    def low(values: Array) -> float:
        return float(np.quantile(values, USUAL_QUANTILE))

    usual = ndimage.labeled_comprehension(power, ring, rings, low, float, 0.0)
    return np.asarray(np.exp(np.interp(at, rings, np.log(np.maximum(usual, 1e-300)))))


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
