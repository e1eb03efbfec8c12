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

"""Find the cells of a pattern that repeats in two directions by its spatial frequencies and their local phases.

Whatever the cells look like, the frequencies of a lattice are sums of whole numbers of two of them. The phases of two
strong ones say where in its cell each place is, also where thin outlines, edges that are bright on one side, or film
between weak lines leave no regular saddle points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from semcal_ros.core.arrays import Array, Array32, Indices, Mask
from semcal_ros.core.corners.lattice import Lattice, enlarged
from semcal_ros.core.corners.spectrum import (
    Spectrum,
    clip_levels,
    compute_spectrum,
    follow_phase,
    list_octaves,
)
from semcal_ros.core.corners.thresholds import (
    BASES_TRIED,
    BASIS_PARTS,
    BASIS_RATIO_MAX,
    BASIS_SINE_MIN,
    CLEAR_POWER,
    EXPLAINED_MIN,
    FOLLOWED_AMONG,
    FREQUENCIES_MAX,
    FREQUENCY_OFF_BINS,
    FREQUENCY_UNSURE_PART,
    NEWTON_STEPS,
    PERIOD_MIN_PX,
    PERIODS_MIN,
)

# The image with all grey levels, and with clipped ones, in which a hole weighs no more than the lines.
_PREPARED: tuple[Callable[[Array32], Array32], ...] = (np.asarray, clip_levels)


@dataclass(frozen=True)
class _Basis:
    """Two frequencies (rows), cycles per pixel, and the multiples (n, 2) that others are of them."""

    frequencies: Array
    multiples: Indices


def find_cells(level: Callable[[int], Array32], size: tuple[int, int]) -> Lattice | None:
    """Find cells of a pattern that repeats in two directions; None if it does not.

    Parameters
    ----------
    level
        The image reduced by powers of two.
    size
        (width, height) of the image, px.

    Returns
    -------
    The lattice of equal places in its cells, of which it does not say which they are. Places are good to a tenth of
    the period.
    """
    for octave in list_octaves(size):
        spectra = [compute_spectrum(prepare(level(octave))) for prepare in _PREPARED]
        frequencies = _list_frequencies(spectra)
        basis = _find_basis(frequencies, np.array(spectra[0].transform.shape[::-1]))
        if basis is None:
            continue
        for prepare, clearness in zip(_PREPARED, frequencies.clearness, strict=True):
            clear = np.argsort(-clearness, kind="stable")[:FOLLOWED_AMONG]
            clear = clear[clearness[clear] > CLEAR_POWER]
            cells = _follow(level, prepare, octave, basis, frequencies.values, clear)
            if cells is not None:
                return cells
    return None


@dataclass(frozen=True)
class _Frequencies:
    """Frequencies (n, 2), cycles per pixel, and how clear they are in each of the prepared images (p, n)."""

    values: Array
    clearness: Array


def _list_frequencies(spectra: list[Spectrum]) -> _Frequencies:
    """Return the frequencies of an image with all grey levels and with clipped ones, the clearest first."""
    size = np.array(spectra[0].transform.shape[::-1])
    found = []
    for spectrum in spectra:
        radius = np.hypot(spectrum.fx, spectrum.fy)
        among = radius > PERIODS_MIN / size.min()
        among &= (radius < 1.0 / PERIOD_MIN_PX) & (spectrum.clearness > CLEAR_POWER)
        found.append(spectrum.find_frequencies(among, FREQUENCIES_MAX))
    values = np.concatenate(found)
    clearness = np.array([[_clearness_at(s, f) for f in values] for s in spectra])
    order = np.argsort(-clearness.max(axis=0), kind="stable") if len(values) else np.arange(0)
    kept = order[_find_distinct(values[order], size, len(values))]
    return _Frequencies(values[kept], clearness[:, kept])


def _clearness_at(spectrum: Spectrum, frequency: Array) -> float:
    near = spectrum.bins_from(frequency) < 2.0 * FREQUENCY_OFF_BINS
    return float(spectrum.clearness[near].max(initial=0.0))


def _find_distinct(frequencies: Array, size: Array, most: int) -> list[int]:
    """Return which (n, 2) frequencies are not near one before, or its opposite; at most so many."""
    kept: list[int] = []
    for k, frequency in enumerate(frequencies):
        others = frequencies[kept]
        near = np.minimum(_bins(frequency - others, size), _bins(frequency + others, size))
        if near.min(initial=np.inf) > 2.0 * FREQUENCY_OFF_BINS:
            kept.append(k)
        if len(kept) == most:
            break
    return kept


def _find_basis(frequencies: _Frequencies, size: Array) -> _Basis | None:
    """Return the widest two frequencies that the others are multiples of; ``size`` is (width, height)."""
    values = frequencies.values
    if len(values) < 2:
        return None
    roots = np.sqrt(frequencies.clearness.max(axis=0))
    pairs = [a + sign * b for a, b in combinations(values, 2) for sign in (1.0, -1.0)]
    parts = [values / n for n in range(1, BASIS_PARTS + 1)]
    tried = np.concatenate([*parts, np.array(pairs)])
    length = np.linalg.norm(tried, axis=1)
    order = np.argsort(length, kind="stable")
    tried = tried[order[length[order] > PERIODS_MIN / size.min()]]
    best: _Basis | None = None
    largest = 0.0
    for a, b in combinations(tried[_find_distinct(tried, size, BASES_TRIED)], 2):
        area = abs(float(a[0] * b[1] - a[1] * b[0]))
        shorter, longer = sorted((float(np.linalg.norm(a)), float(np.linalg.norm(b))))
        acute = area < BASIS_SINE_MIN * shorter * longer
        if acute or longer > BASIS_RATIO_MAX * shorter or area <= 1.02 * largest:
            continue
        basis = np.stack([a, b])
        multiples = np.rint(values @ np.linalg.inv(basis))
        off = _bins(values - multiples @ basis, size)
        orders = np.maximum(1.0, np.abs(multiples).sum(axis=1))
        fits = off < FREQUENCY_OFF_BINS * orders + FREQUENCY_UNSURE_PART * _bins(values, size)
        if roots[fits].sum() < EXPLAINED_MIN * roots.sum():
            continue
        if np.linalg.matrix_rank(multiples[fits]) == 2:
            refined = np.linalg.lstsq(multiples[fits], values[fits], rcond=None)[0]
            whole = np.where(fits[:, None], multiples, 0.0).astype(np.intp)
            best, largest = _Basis(refined, whole), area
    return None if best is None else _reduce(best)


def _reduce(basis: _Basis) -> _Basis:
    """Return the shortest basis of the same frequencies (Gauss)."""
    change = np.eye(2, dtype=np.intp)
    while True:
        shorter = change @ basis.frequencies
        if shorter[0] @ shorter[0] > shorter[1] @ shorter[1]:
            change, shorter = change[::-1], shorter[::-1]
        times = int(np.rint(shorter[0] @ shorter[1] / (shorter[0] @ shorter[0])))
        if times == 0:
            break
        change = np.stack([change[0], change[1] - times * change[0]])
    inverse = np.rint(np.linalg.inv(change)).astype(np.intp)
    return _Basis(change @ basis.frequencies, basis.multiples @ inverse)


def _bins(frequencies: Array, bins: Array) -> Array:
    return np.asarray(np.linalg.norm(frequencies * bins, axis=-1))


def _follow(
    level: Callable[[int], Array32],
    prepare: Callable[[Array32], Array32],
    octave: int,
    basis: _Basis,
    frequencies: Array,
    clear: Indices,
) -> Lattice | None:
    """Return equal places in all cells, by the phases of the two lowest clear frequencies that are independent."""
    order = clear[np.argsort(np.linalg.norm(frequencies[clear], axis=1), kind="stable")]
    known = [int(k) for k in order if np.any(basis.multiples[k])]
    pair = next(
        ([known[0], k] for k in known if round(np.linalg.det(basis.multiples[[known[0], k]]))), None
    )
    if pair is None:
        return None
    highest = float(np.linalg.norm(frequencies[pair], axis=1).max())
    # The coarsest scale that resolves both is as good as any for the phases, and costs least.
    further = max(0, int(np.log2(1.0 / highest / (1.6 * PERIOD_MIN_PX))))
    image = prepare(level(octave + further))
    scale = 2.0**further
    period = 1.0 / float(np.linalg.norm(scale * basis.frequencies, axis=1).min())
    one, two = (follow_phase(image, scale * frequencies[k], period) for k in pair)
    if one is None or two is None:
        return None
    from_phases = np.linalg.inv(basis.multiples[pair]) / (2.0 * np.pi)
    axes = np.linalg.inv(scale * basis.frequencies).T
    if np.linalg.det(axes) < 0.0:
        axes, from_phases = axes[::-1], from_phases[::-1]

    def cell_of(xy: Array) -> Array:
        return np.stack([one.at(xy), two.at(xy)], axis=1) @ from_phases.T

    height, width = image.shape
    middle = 0.5 * np.array([width - 1, height - 1])
    reach = int(np.ceil(np.hypot(width, height) / np.linalg.svd(axes, compute_uv=False)[1]))
    i, j = (g.ravel() for g in np.meshgrid(*2 * [np.arange(-reach, reach + 1)], indexing="ij"))
    ij = np.stack([i, j], axis=1).astype(np.intp)
    xy = middle + ij @ axes
    around = np.all((xy > -0.2 * middle) & (xy < 2.2 * middle), axis=1)
    ij, xy = ij[around], xy[around]
    start = np.rint(cell_of(middle[None]))
    for _ in range(NEWTON_STEPS):
        xy = xy - np.clip(cell_of(xy) - start - ij, -2.0, 2.0) @ axes
    inside: Mask = np.all((xy >= 0.0) & (xy <= [width - 1, height - 1]), axis=1)
    inside &= np.all(np.abs(cell_of(xy) - start - ij) < 0.1, axis=1)
    at = np.rint(xy[inside]).astype(np.intp)
    seen = one.seen & two.seen
    kept = np.flatnonzero(inside)[seen[at[:, 1], at[:, 0]]]
    if not len(kept):
        return None
    factor = 2.0 ** (octave + further)
    spread = np.broadcast_to(axes, (len(kept), 2, 2)).copy()
    return Lattice(ij[kept], enlarged(xy[kept], factor), factor * spread)
