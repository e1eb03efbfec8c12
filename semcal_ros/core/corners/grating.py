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

"""Find the lines of a grating, which are parallel, by their spatial frequency and its local phase.

The strongest spatial frequency gives direction and period of the lines, and the phase of the picture at this frequency
how far each place is from the next line (Takeda et al. 1982, doi:10.1364/JOSA.72.000156). The phase is followed from
period to period by its derivatives, which never wrap where a distortion bends the lines by less than half a period
per period.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semcal_ros.core.arrays import Array, Array32, Image, Indices, Mask
from semcal_ros.core.corners.lattice import Lattice, enlarged
from semcal_ros.core.corners.saddle import LatticeStatus
from semcal_ros.core.errors import Rejection

__all__ = ["LineFit", "find_lines", "fit_lines"]

# Side of the part of the picture, at each of its scales, in which the frequency is looked for, px.
_PART_PX = 1024
# Periods that are looked for: at least so many in the part, and so many pixels long.
_LEAST_PERIODS, _LEAST_PERIOD_PX = 3.5, 5.0
# Power of the lines over the median at frequencies of the same size. The power of noise has an exponential
# distribution: the largest of half a million values is 19 times the median, and 200 times has a chance of 1e-55.
_PEAK = 200.0
# Power at a part of the frequency that makes it the frequency: over the same median, which chance exceeds
# once in 1e15, and over that of the frequency, whose side lobes behind the window are below.
_SUBMULTIPLE, _SIDE_LOBE = 50.0, 1e-3
# Power at any frequency that is no multiple, relative to that of the lines, from which the pattern repeats across them
# as well: equal crossed lines, dots and squares have 1.
_ACROSS = 0.1
# Bins beside the direction of the lines that belong to them: the main lobe of the window has two, and a distortion that
# bends lines by a tenth of their frequency has as many bins as a tenth of it.
_LOBE, _BENT = 3.0, 0.1
# Frequencies of the same size, in octaves either way: at the least number of periods, some 70 are no multiples.
_RING = 1.0
# Frequencies of the lines are compared up to this multiple of the clearest one. They are known to so many bins, and
# where lines are bent to that part of them.
_COMPARED, _OFF, _UNSURE = 2.2, 1.0, 0.02
_MOST_PEAKS = 12
# Clearness over that of the clearest, from which a maximum counts: those of a hole's edge are mostly below.
_FAINT_PEAK = 5e-3
# Power of a multiple over that of the frequency itself from which the lines are followed by the multiple.
_FAR_LARGER = 10.0
# Of narrow lines many harmonics are as strong as the fundamental, and a hole has the less power the higher they are.
_HIGHEST_HARMONIC = 9
# Median amplitude of a frequency over that of others of its size, from which it is everywhere, and their directions;
# and the low pass as a part of the picture: a hole of a third of the side then reaches a quarter of the places. The
# median over some twenty independent places scatters by a sixth where there is noise alone.
_EVERYWHERE, _PLACES = 2.5, 16
_OTHER_DIRECTIONS_DEG = (45.0, 90.0, 135.0)
# Part of the pixels whose grey levels are clipped at either end: holes and debris in a fifth of the picture then have
# no more contrast than lines that take more than that of their period.
_CLIPPED = 0.2
# What power is usual: the quantile in rings of this width in octaves. At the least number of periods a lobe of the
# window takes half of a ring.
_USUAL, _RING_OCTAVES = 0.25, 0.25
# Standard deviation of the low pass behind the demodulation, in periods: harmonics are down to 4e-5.
_SMOOTH = 0.75
# Degree of the smooth part of the phase. The rest is added to it.
_DEGREE = 5
# Part of the median amplitude below which there are no lines, such as under debris or beyond the end of the grating.
_FAINT = 0.3
# Residual phase beyond which lines were not followed, rad: half a period is pi.
_LOST = 2.0
# Newton steps from an even lattice to the lines.
_STEPS = 6


@dataclass(frozen=True)
class _Wave:
    """The strongest spatial frequency.

    Attributes
    ----------
    frequency
        (2,) cycles per pixel along x and y.
    power
        Power of the clearest one of its multiples over the median of others.
    across
        The largest power at other frequencies than its multiples, over its own.
    octave
        The scale at which it was found.
    multiple
        Which of its multiples has most of the power: lines whose edges are bright may have hardly any at the frequency
        itself.
    is_clipped
        Whether it was found in the image with clipped grey levels.
    """

    frequency: Array
    power: float
    across: float
    octave: int
    multiple: int
    is_clipped: bool = False

    @property
    def period_px(self) -> float:
        """The period in pixels of the whole picture."""
        return float(2.0**self.octave / np.linalg.norm(self.frequency))


def find_lines(
    level: Callable[[int], Array32], size: tuple[int, int]
) -> Lattice | Rejection[LatticeStatus]:
    """Find parallel lines, and places along them as far apart as the lines.

    Parameters
    ----------
    level
        The image reduced by powers of two.
    size
        (width, height) of the image, px.

    Returns
    -------
    A lattice whose ``i`` counts lines and whose ``j`` counts places along them, good to a tenth of the period, or why
    there is none: no frequency stands out, or lines or points repeat in another direction too.
    """
    octaves = range(max(0, int(np.ceil(np.log2(max(size) / _PART_PX)))) + 1)
    waves = [_find_clearest_wave(level(octave), octave) for octave in octaves]
    found = [wave for wave in waves if wave is not None and wave.power > _PEAK]
    if not found:
        return Rejection(
            LatticeStatus.NO_LATTICE, "no grating: no spatial frequency stands out of the picture"
        )
    # The finest scale sees most of what lies across the lines.
    wave = found[0]
    if wave.across > _ACROSS:
        return Rejection(
            LatticeStatus.OTHER_PATTERN,
            "no grating: frequencies in another direction are as strong, as of a pattern that repeats in two: set the"
            " pattern to auto",
        )
    # The coarsest scale that resolves them is as good as any for the phase, and costs least.
    octave = max(0, int(np.log2(wave.period_px / wave.multiple / (1.6 * _LEAST_PERIOD_PX))))
    image = _clip(level(octave)) if wave.is_clipped else level(octave)
    lattice = _follow(image, wave.multiple * wave.frequency * 2.0 ** (octave - wave.octave))
    if isinstance(lattice, Rejection):
        return lattice
    own = np.all(lattice.ij % wave.multiple == 0, axis=1)
    factor = 2.0**octave
    return Lattice(
        lattice.ij[own] // wave.multiple,
        enlarged(lattice.xy[own], factor),
        lattice.axes[own] * (factor * wave.multiple),
    )


@dataclass(frozen=True)
class LineFit:
    """A polynomial through all places on the lines of a grating.

    Attributes
    ----------
    along
        (n, 2) unit vectors towards growing j.
    scatter_px
        RMS departure from the polynomial across the lines, px.
    """

    along: Array
    scatter_px: float


def fit_lines(ij: Indices, xy: Array) -> LineFit:
    """Fit the directions of lines at all places on them, and how far they are from even distances.

    The part of a residual along a line is not known, and may be some pixels. Directions from neighbours alone are off
    by thousandths, which would turn it into hundredths of a pixel across, as if it were known.

    Parameters
    ----------
    ij, xy
        (n, 2) number of the line and of the place, and positions, px.
    """
    middle, scale = ij.mean(axis=0), np.maximum(0.5 * np.ptp(ij, axis=0), 1.0)
    u, v = ((ij - middle) / scale).T
    # At least twice as many places as terms, and more of them for what a lens alone does not need.
    most = next(degree for degree, least in ((_DEGREE, 150), (3, 20), (1, 0)) if len(ij) >= least)
    powers = [(a, n - a) for n in range(most + 1) for a in range(n + 1)]
    basis = np.stack([u**a * v**b for a, b in powers], axis=1)
    slope = np.stack([b * u**a * v ** max(b - 1, 0) for a, b in powers], axis=1)
    terms = np.linalg.lstsq(basis, xy, rcond=None)[0]
    along = slope @ terms
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    left = xy - basis @ terms
    across = left[:, 0] * along[:, 1] - left[:, 1] * along[:, 0]
    return LineFit(along, float(np.sqrt(np.mean(across**2))))


def _clip(image: Array32) -> Array32:
    """Clip the grey levels of an image, so that a hole or debris is no more than what lies beside the lines."""
    low, high = np.quantile(image[::4, ::4], [_CLIPPED, 1.0 - _CLIPPED])
    return np.clip(image, low, high)


def _find_clearest_wave(image: Array32, octave: int) -> _Wave | None:
    """Find the strongest frequency, with or without clipped grey levels, whichever has it stand out more."""
    wave, clipped = _find_wave(image, octave), _find_wave(_clip(image), octave)
    if clipped is None or (wave is not None and wave.power >= clipped.power):
        return wave
    return replace(clipped, is_clipped=True)


@dataclass(frozen=True)
class _Spectrum:
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
        return np.asarray(aside > _LOBE + _BENT * self.bins_from(np.zeros(2)))

    def centre_near(self, frequency: Array) -> Array:
        """Return the centre of the power near a frequency."""
        own = np.where(self.bins_from(frequency) < _LOBE, self.power, 0.0)
        return np.array([(own * self.fx).sum(), (own * self.fy).sum()]) / float(own.sum())

    def find_divisor(self, frequency: Array, lowest: float, highest: float) -> int:
        """Return by what a frequency of the lines is to be divided, so that all of them are its multiples."""
        height, width = self.transform.shape
        bins = float(np.hypot(frequency[0] * width, frequency[1] * height))
        ratios = self.find_ratios(frequency, lowest, highest)
        tolerance = _OFF + _UNSURE * ratios * bins
        most = max(1, min(_HIGHEST_HARMONIC, int(np.linalg.norm(frequency) / lowest)))
        for divisor in range(1, most + 1):
            off = np.abs(ratios - np.rint(ratios * divisor) / divisor) * bins
            if np.all(off < tolerance):
                return divisor
        return 1

    def find_faint_divisor(self, frequency: Array, lowest: float, highest: float) -> int:
        """Return by what a frequency is to be divided since the lines have that, too, however faintly.

        Every other line may differ from those beside it by a little.
        """
        for divisor in range(_HIGHEST_HARMONIC, 1, -1):
            unit = frequency / divisor
            if np.linalg.norm(unit) < lowest:
                continue
            off = self.bins_from(unit)
            at = np.unravel_index(np.argmax(np.where(off < _LOBE, self.clearness, 0.0)), off.shape)
            clear = self.clearness[at] > _SUBMULTIPLE and self.power[at] > _SIDE_LOBE * highest
            if off[at] < 0.5 * _LOBE and clear and self.is_everywhere(unit):
                return divisor
        return 1

    def find_ratios(self, frequency: Array, lowest: float, highest: float) -> Array:
        """Return the other frequencies of the lines over one of them.

        The power has a maximum there, while that of a hole rises towards lower frequencies, and it comes from
        everywhere in the picture and not from the edge of a hole.
        """
        own = float(np.linalg.norm(frequency))
        ratio = np.abs(self.fx * frequency[0] + self.fy * frequency[1]) / own**2
        side = 4 * int(_LOBE) + 1
        peaks = self.clearness == ndimage.maximum_filter(self.clearness, side, mode="wrap")
        clearest = float(self.clearness[peaks & (ratio < _COMPARED)].max())
        peaks &= self.clearness > max(_SUBMULTIPLE, _FAINT_PEAK * clearest)
        peaks &= self.power > _SIDE_LOBE * highest
        peaks &= ~self.is_aside(frequency) & (ratio > lowest / own) & (ratio < _COMPARED)
        rows, columns = np.nonzero(peaks)
        order = np.argsort(-self.clearness[rows, columns], kind="stable")[:_MOST_PEAKS]
        centres = [
            self.centre_near(np.array([self.fx[at], self.fy[at]]))
            for at in zip(rows[order], columns[order], strict=True)
        ]
        everywhere = [f for f in centres if self.is_everywhere(f)]
        return np.abs(np.array(everywhere).reshape(-1, 2) @ frequency) / own**2

    def is_everywhere(self, frequency: Array) -> bool:
        """Whether most of the image has this frequency, more than others of its size."""
        turns = np.radians([0.0, *_OTHER_DIRECTIONS_DEG])
        c, s = np.cos(turns), np.sin(turns)
        x, y = frequency
        directions = np.stack([c * x - s * y, s * x + c * y], axis=1)
        own, *others = (self._median_amplitude(f) for f in directions)
        return own > _EVERYWHERE * max(others)

    def _median_amplitude(self, frequency: Array) -> float:
        """Return the median amplitude over the places of the image, by the coefficients around the frequency."""
        size = np.array(self.transform.shape)
        period = 1.0 / float(np.linalg.norm(frequency))
        sigma = max(_SMOOTH * period, min(float(size.min()) / _PLACES, 3.0 * period))
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
            float(self.power[self.bins_from(m * frequency) < _LOBE].max())
            for m in range(1, most + 1)
        ]
        best = int(np.argmax(power))
        return best + 1 if power[best] > _FAR_LARGER * power[0] else 1


def _compute_spectrum(image: Image) -> _Spectrum:
    height, width = (min(side, _PART_PX) for side in image.shape)
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    part = image[top : top + height, left : left + width].astype(np.float64)
    window = np.outer(np.hanning(height), np.hanning(width))
    part = (part - float((part * window).sum() / window.sum())) * window
    transform = np.fft.fft2(part)
    power = np.abs(transform[:, : width // 2 + 1]) ** 2
    fy, fx = np.meshgrid(np.fft.fftfreq(height), np.fft.rfftfreq(width), indexing="ij")
    return _Spectrum(transform, power, power / _usual_power(power, np.hypot(fx, fy)), fx, fy)


def _find_wave(image: Image, octave: int) -> _Wave | None:
    """Find the strongest frequency in the middle of an image; None where it has no contrast."""
    spectrum = _compute_spectrum(image)
    radius = np.hypot(spectrum.fx, spectrum.fy)
    lowest = _LEAST_PERIODS / min(spectrum.transform.shape)
    allowed = (radius > lowest) & (radius < 1.0 / _LEAST_PERIOD_PX)
    if not np.any(allowed) or float(spectrum.power[allowed].max()) <= 0.0:
        return None
    # A hole or debris has more power at low frequencies than the lines, but in all directions.
    best = np.unravel_index(np.argmax(np.where(allowed, spectrum.clearness, 0.0)), radius.shape)
    frequency = np.array([spectrum.fx[best], spectrum.fy[best]])
    highest, clearest = float(spectrum.power[best]), float(spectrum.clearness[best])
    frequency = spectrum.centre_near(frequency)
    divisor = spectrum.find_divisor(frequency, lowest, highest)
    divisor *= spectrum.find_faint_divisor(frequency / divisor, lowest, highest)
    frequency = frequency / divisor
    aside = spectrum.is_aside(frequency)
    octaves = np.abs(np.log2(np.maximum(radius, 1e-9) / float(np.linalg.norm(frequency))))
    others = spectrum.clearness[(octaves < _RING) & aside]
    relative = np.minimum(spectrum.power / highest, spectrum.clearness / clearest)
    return _Wave(
        frequency,
        clearest / float(np.median(others)) if len(others) else 0.0,
        float(np.max(relative[(radius > lowest) & aside], initial=0.0)),
        octave,
        spectrum.strongest_multiple(frequency, divisor),
    )


def _usual_power(power: Array, radius: Array) -> Array:
    """Return a low quantile of the power at frequencies of each size, interpolated between rings."""
    at = np.log2(np.maximum(radius, radius[radius > 0.0].min())) / _RING_OCTAVES
    ring = np.rint(at).astype(int)
    rings = np.unique(ring)

    def low(values: Array) -> float:
        return float(np.quantile(values, _USUAL))

    usual = ndimage.labeled_comprehension(power, ring, rings, low, float, 0.0)
    return np.asarray(np.exp(np.interp(at, rings, np.log(np.maximum(usual, 1e-300)))))


def _follow(image: Array32, frequency: Array) -> Lattice | Rejection[LatticeStatus]:
    """Return places on the lines of this frequency, by the phase of the image."""
    height, width = image.shape
    period = float(1.0 / np.linalg.norm(frequency))
    amplitude, phase_rate, values = _demodulate(image, frequency, _SMOOTH * period)
    smooth = _fit_phase(amplitude, values, period)
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    weight = amplitude**2
    turned = values * np.exp(-1j * smooth(columns, rows))
    constant = float(np.angle(np.sum(turned * weight)))
    left = np.angle(turned * np.exp(-1j * constant))
    seen = amplitude > _FAINT * float(np.median(amplitude))
    if float(np.mean(np.abs(left[seen]) > _LOST)) > 0.1:
        return Rejection(
            LatticeStatus.NO_LATTICE, "no grating: its lines cannot be followed across the picture"
        )

    def phase(xy: Array) -> Array:
        x, y = xy.T
        rest = ndimage.map_coordinates(left, [y, x], order=1, mode="nearest")
        return phase_rate[0] * x + phase_rate[1] * y + smooth(x, y) + constant + rest

    across = frequency * period**2
    # Right-handed with x to the right and y down.
    along = np.array([-across[1], across[0]])
    middle = 0.5 * np.array([width - 1, height - 1])
    reach = int(np.ceil(0.5 * np.hypot(width, height) / period)) + 2
    i, j = (g.ravel() for g in np.meshgrid(*2 * [np.arange(-reach, reach + 1)], indexing="ij"))
    ij = np.stack([i, j], axis=1).astype(np.intp)
    xy = middle + i[:, None] * across + j[:, None] * along
    first = np.round(float(phase(middle[None])[0]) / (2.0 * np.pi))
    for _ in range(_STEPS):
        miss = phase(xy) - 2.0 * np.pi * (first + i)
        xy = xy - np.clip(miss / (2.0 * np.pi), -2.0, 2.0)[:, None] * across
    inside: Mask = np.all((xy >= 0.0) & (xy <= [width - 1, height - 1]), axis=1)
    inside &= np.abs(phase(xy) - 2.0 * np.pi * (first + i)) < 0.5
    at = np.rint(xy[inside]).astype(np.intp)
    kept = np.flatnonzero(inside)[seen[at[:, 1], at[:, 0]]]
    axes = np.broadcast_to(np.stack([across, along]), (len(kept), 2, 2)).copy()
    return Lattice(ij[kept], xy[kept], axes)


def _demodulate(image: Array32, frequency: Array, sigma: float) -> tuple[Array, Array, Array]:
    """Return the (h, w) amplitude, the (2,) phase per pixel that was taken off, and the (h, w) rest as unit phasors."""
    height, width = image.shape
    rate = 2.0 * np.pi * frequency
    level = cv2.GaussianBlur(image, (0, 0), sigma)
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    wave = np.exp(-1j * (rate[0] * columns + rate[1] * rows))
    mixed = (image - level) * wave
    real, imaginary = (
        cv2.GaussianBlur(np.ascontiguousarray(part, dtype=np.float32), (0, 0), sigma)
        for part in (mixed.real, mixed.imag)
    )
    values = real.astype(np.float64) + 1j * imaginary
    amplitude = np.abs(values)
    return amplitude, rate, values / np.maximum(amplitude, 1e-30)


def _fit_phase(amplitude: Array, values: Array, period: float) -> Callable[[Array, Array], Array]:
    """Fit a polynomial without a constant to the phase of phasors, by the differences of neighbours."""
    height, width = amplitude.shape
    step = max(1, round(period))
    scale = 0.5 * max(width, height)
    middle = 0.5 * np.array([width - 1, height - 1])
    powers = [(a, n - a) for n in range(1, _DEGREE + 1) for a in range(n + 1)]

    def basis(x: Array, y: Array) -> list[Array]:
        u, v = (x - middle[0]) / scale, (y - middle[1]) / scale
        return [u**a * v**b for a, b in powers]

    grid = values[::step, ::step]
    weight = amplitude[::step, ::step]
    rows, columns = np.mgrid[0:height:step, 0:width:step].astype(np.float64)
    terms = np.stack(basis(columns, rows), axis=-1)
    design, target, weights = [], [], []
    for axis in (0, 1):
        first = [slice(None)] * 2
        second = [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        a, b = tuple(first), tuple(second)
        target.append(np.angle(grid[b] * np.conj(grid[a])).ravel())
        weights.append(np.minimum(weight[a], weight[b]).ravel())
        design.append((terms[b] - terms[a]).reshape(-1, len(powers)))
    matrix, right, certain = (np.concatenate(parts) for parts in (design, target, weights))
    normal = matrix.T @ (matrix * certain[:, None])
    # The ridge is for pictures of few periods, which do not determine all terms.
    normal += 1e-6 * float(np.trace(normal)) / len(powers) * np.eye(len(powers))
    coefficients = np.linalg.solve(normal, matrix.T @ (right * certain))

    def smooth(x: Array, y: Array) -> Array:
        return np.asarray(sum(c * term for c, term in zip(coefficients, basis(x, y), strict=True)))

    return smooth
