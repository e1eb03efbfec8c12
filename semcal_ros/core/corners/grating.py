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
how far each place is from the next line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Array32, Indices, Mask
from semcal_ros.core.corners.lattice import Lattice, LatticeStatus, enlarged
from semcal_ros.core.corners.spectrum import (
    clip_levels,
    compute_spectrum,
    follow_phase,
    list_octaves,
)
from semcal_ros.core.corners.thresholds import (
    ACROSS_POWER_MAX,
    LINES_DEGREE,
    LINES_POWER,
    LINES_RING_OCTAVES,
    NEWTON_STEPS,
    PERIOD_MIN_PX,
    PERIODS_MIN,
)
from semcal_ros.core.errors import Rejection


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
    waves = [_find_clearest_wave(level(octave), octave) for octave in list_octaves(size)]
    found = [wave for wave in waves if wave is not None and wave.power > LINES_POWER]
    if not found:
        return Rejection(
            LatticeStatus.NO_LATTICE, "no grating: no spatial frequency stands out of the picture"
        )
    # The finest scale sees most of what lies across the lines.
    wave = found[0]
    if wave.across > ACROSS_POWER_MAX:
        return Rejection(
            LatticeStatus.OTHER_PATTERN,
            "no grating: frequencies in another direction are as strong, as of a pattern that repeats in two: set the"
            " pattern to auto",
        )
    # The coarsest scale that resolves them is as good as any for the phase, and costs least.
    octave = max(0, int(np.log2(wave.period_px / wave.multiple / (1.6 * PERIOD_MIN_PX))))
    image = clip_levels(level(octave)) if wave.is_clipped else level(octave)
    lattice = _follow(image, wave.multiple * wave.frequency * 2.0 ** (octave - wave.octave))
    if isinstance(lattice, Rejection):
        return lattice
    of_period = np.all(lattice.ij % wave.multiple == 0, axis=1)
    factor = 2.0**octave
    return Lattice(
        lattice.ij[of_period] // wave.multiple,
        enlarged(lattice.xy[of_period], factor),
        lattice.axes[of_period] * (factor * wave.multiple),
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
    most = next(
        degree for degree, least in ((LINES_DEGREE, 150), (3, 20), (1, 0)) if len(ij) >= least
    )
    powers = [(a, n - a) for n in range(most + 1) for a in range(n + 1)]
    basis = np.stack([u**a * v**b for a, b in powers], axis=1)
    slope = np.stack([b * u**a * v ** max(b - 1, 0) for a, b in powers], axis=1)
    terms = np.linalg.lstsq(basis, xy, rcond=None)[0]
    along = slope @ terms
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    left = xy - basis @ terms
    across = left[:, 0] * along[:, 1] - left[:, 1] * along[:, 0]
    return LineFit(along, float(np.sqrt(np.mean(across**2))))


def _find_clearest_wave(image: Array32, octave: int) -> _Wave | None:
    """Find the strongest frequency, with or without clipped grey levels, whichever has it stand out more."""
    wave, clipped = _find_wave(image, octave), _find_wave(clip_levels(image), octave)
    if clipped is None or (wave is not None and wave.power >= clipped.power):
        return wave
    return replace(clipped, is_clipped=True)


def _find_wave(image: Array32, octave: int) -> _Wave | None:
    """Find the strongest frequency in the middle of an image; None where it has no contrast."""
    spectrum = compute_spectrum(image)
    radius = np.hypot(spectrum.fx, spectrum.fy)
    lowest = PERIODS_MIN / min(spectrum.transform.shape)
    allowed = (radius > lowest) & (radius < 1.0 / PERIOD_MIN_PX)
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
    others = spectrum.clearness[(octaves < LINES_RING_OCTAVES) & aside]
    relative = np.minimum(spectrum.power / highest, spectrum.clearness / clearest)
    return _Wave(
        frequency,
        clearest / float(np.median(others)) if len(others) else 0.0,
        float(np.max(relative[(radius > lowest) & aside], initial=0.0)),
        octave,
        spectrum.strongest_multiple(frequency, divisor),
    )


def _follow(image: Array32, frequency: Array) -> Lattice | Rejection[LatticeStatus]:
    """Return places on the lines of this frequency, by the phase of the image."""
    height, width = image.shape
    period = float(1.0 / np.linalg.norm(frequency))
    phase = follow_phase(image, frequency)
    if phase is None:
        return Rejection(
            LatticeStatus.NO_LATTICE, "no grating: its lines cannot be followed across the picture"
        )
    across = frequency * period**2
    # Right-handed with x to the right and y down.
    along = np.array([-across[1], across[0]])
    middle = 0.5 * np.array([width - 1, height - 1])
    reach = int(np.ceil(0.5 * np.hypot(width, height) / period)) + 2
    i, j = (g.ravel() for g in np.meshgrid(*2 * [np.arange(-reach, reach + 1)], indexing="ij"))
    ij = np.stack([i, j], axis=1).astype(np.intp)
    xy = middle + i[:, None] * across + j[:, None] * along
    first = np.round(float(phase.at(middle[None])[0]) / (2.0 * np.pi))
    for _ in range(NEWTON_STEPS):
        residual = phase.at(xy) - 2.0 * np.pi * (first + i)
        xy = xy - np.clip(residual / (2.0 * np.pi), -2.0, 2.0)[:, None] * across
    inside: Mask = np.all((xy >= 0.0) & (xy <= [width - 1, height - 1]), axis=1)
    inside &= np.abs(phase.at(xy) - 2.0 * np.pi * (first + i)) < 0.5
    at = np.rint(xy[inside]).astype(np.intp)
    kept = np.flatnonzero(inside)[phase.seen[at[:, 1], at[:, 0]]]
    axes = np.broadcast_to(np.stack([across, along]), (len(kept), 2, 2)).copy()
    return Lattice(ij[kept], xy[kept], axes)
