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

"""Coarse search: normalised cross-correlation over the overlap, for every shift at once.

The correlation coefficient of what overlaps is exact at every shift (Padfield 2012,
doi:10.1109/TIP.2011.2181402): the cross term comes from one FFT product, means and energies of
rectangular overlaps from integral images. It does not favour small shifts, as a windowed phase
correlation does, and its heights can be compared with each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from semcal_ros.core.arrays import AnyImage, Array, Image, Indices, Mask, mad_sigma
from semcal_ros.core.caches import LruCache
from semcal_ros.core.registration.thresholds import (
    OVERLAP_SAMPLES_MIN,
    PEAK_CORRELATION_MIN,
    PEAK_HEIGHT_MIN,
    PEAK_SIGMAS,
    PEAKS_MAX,
    SEARCHED_PX,
    SHADING_PARTS,
    SURFACES_KEPT,
)
from semcal_ros.core.registration.tiles import Pyramid

# A maximum is higher than what lies around it.
_NEIGHBOURS = np.ones((5, 5), np.uint8)


@dataclass(frozen=True)
class CoarsePeak:
    """A local maximum of the correlation surface.

    Attributes
    ----------
    shift_px
        (x, y) shift in full-resolution px.
    correlation
        Correlation coefficient over the overlap.
    significance
        Height in robust standard deviations of the surface.
    step_px
        Full-resolution px per sample of the surface.
    """

    shift_px: tuple[float, float]
    correlation: float
    significance: float
    step_px: float

    @property
    def significant(self) -> bool:
        """Whether unrelated images are unlikely to give such a peak."""
        return self.significance >= PEAK_SIGMAS or self.correlation >= PEAK_CORRELATION_MIN


@dataclass(frozen=True)
class _SurfacePart:
    """What one image contributes to the surface of a pair of sizes: its spectrum, and the sum and the standard
    deviation (times the root of their number) of the samples that overlap at each shift.
    """

    spectrum: NDArray[np.complex64]
    sums: Image
    deviation: Image


@dataclass(frozen=True)
class _ReferencePart:
    """The same of the reference, as the surface uses it.

    ``spectrum`` is conjugate, ``means`` are those of what overlaps, ``weight`` turns products into scores, and
    is 0 where too little overlaps.
    """

    shape: tuple[int, ...]
    spectrum: NDArray[np.complex64]
    means: Image
    weight: Image


@dataclass(frozen=True)
class _SurfaceGeometry:
    """What a surface looks like for two sizes.

    ``reference_spans`` and ``image_spans`` are the first and last-plus-one samples of reference and
    image that overlap at each shift (rows, then columns), ``per_count`` (rows, cols) one over the number of
    overlapping samples, ``root`` the square root of that number, ``allowed`` whether it is enough, ``size`` that
    of the Fourier transforms. ``sampled`` are the indices of an eighth of the allowed shifts.
    """

    shift_x: Indices
    shift_y: Indices
    reference_spans: tuple[tuple[Indices, ...], tuple[Indices, ...]]
    image_spans: tuple[tuple[Indices, ...], tuple[Indices, ...]]
    per_count: Image
    root: Image
    allowed: Mask
    size: tuple[int, int]
    sampled: Indices


@dataclass(frozen=True)
class CoarseReference:
    """A reference image for :func:`find_coarse_peaks`.

    Parameters
    ----------
    pyramid
        The grey image.
    min_overlap
        Shifts are searched whose overlap is at least this fraction of the smaller image, per axis
        and in area.
    """

    pyramid: Pyramid
    min_overlap: float
    _parts: LruCache[tuple[int, tuple[int, ...]], _ReferencePart | None] = field(
        default_factory=lambda: LruCache(SURFACES_KEPT), repr=False, compare=False
    )

    def part(self, factor: int, image_shape: tuple[int, ...]) -> _ReferencePart | None:
        """The reference's part of the surface for one reduction and one size of reduced image; None
        where no shift overlaps enough.
        """
        return self._parts.get_or_compute(
            (factor, image_shape), lambda: self._prepare(factor, image_shape)
        )

    def _prepare(self, factor: int, image_shape: tuple[int, ...]) -> _ReferencePart | None:
        small = remove_shading(self.pyramid.at(factor))
        geometry = _plan_surface(small.shape, image_shape, self.min_overlap)
        if geometry is None:
            return None
        part = _prepare_part(small, geometry, *geometry.reference_spans)
        # The spread of a chance correlation grows as the overlap shrinks.
        weight = np.where(geometry.allowed, geometry.root / part.deviation, np.float32(0.0))
        means = part.sums * geometry.per_count
        return _ReferencePart(small.shape, np.conj(part.spectrum), means, weight)


def find_coarse_peaks(
    reference: CoarseReference, image: Pyramid, guess_px: Array, *, finest: bool = False
) -> list[CoarsePeak]:
    """Local maxima of the correlation, the highest first, down to half of the height of the highest.

    Parameters
    ----------
    reference, image
        Images of the same scale; sizes may differ.
    guess_px
        (2,) predicted shift, near which peaks are listed even if many others are higher.
    finest
        Search at the finest resolution at once, for textures of which reduced images show little.

    Returns
    -------
    list
        Empty where no shift stands out, not even at half of the full resolution.
    """
    longest = max(*reference.pyramid.full.shape, *image.full.shape)
    best: list[CoarsePeak] = []
    for level in SEARCHED_PX[-1:] if finest else SEARCHED_PX:
        factor = 1 << max(0, int(np.ceil(np.log2(longest / level))))
        peaks = _find_peaks_at(reference, image, factor, guess_px)
        if peaks and (not best or peaks[0].significance > best[0].significance):
            best = peaks
        if (peaks and peaks[0].significant) or factor == 1:
            break
    return best if best and best[0].significant else []


def remove_shading(image: AnyImage) -> Image:
    """Shading removed: only structure below an eighth of the field is compared."""
    small = np.asarray(image, dtype=np.float32)
    sigma = max(small.shape) / SHADING_PARTS
    # The shading is smooth: a sixteenth of the pixels tell it.
    tiny = cv2.resize(small, (0, 0), fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(tiny, (0, 0), 0.25 * sigma)
    background = cv2.resize(smooth, small.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(small - background, dtype=np.float32)


def _find_peaks_at(
    reference: CoarseReference, image: Pyramid, factor: int, guess_px: Array
) -> list[CoarsePeak]:
    small = remove_shading(image.at(factor))
    reference_part = reference.part(factor, small.shape)
    if reference_part is None:
        return []
    geometry = _plan_surface(reference_part.shape, small.shape, reference.min_overlap)
    assert geometry is not None
    image_part = _prepare_part(small, geometry, *geometry.image_spans)
    score = _score(reference_part, image_part, geometry)
    top = float(score.max())
    if not top > 0.0:
        return []
    searched = score.take(geometry.sampled)
    spread = mad_sigma(searched - np.median(searched))
    local = cv2.dilate(score, _NEIGHBOURS) <= score
    local &= score >= np.float32(PEAK_HEIGHT_MIN * top)
    rows, cols = np.divmod(np.flatnonzero(local), score.shape[1])
    highest = np.argsort(-score[rows, cols], kind="stable")
    origin = int(geometry.shift_x[0]), int(geometry.shift_y[0])
    distances = np.hypot(
        cols + origin[0] - guess_px[0] / factor, rows + origin[1] - guess_px[1] / factor
    )
    nearest = np.argsort(distances, kind="stable")[:PEAKS_MAX]
    # On a lattice the one near the prediction need not be among the highest.
    keep = [k for rank, k in enumerate(highest) if rank < PEAKS_MAX or k in nearest]
    peaks = []
    for row, col in zip(rows[keep], cols[keep], strict=True):
        fine_row, fine_col = _interpolate_vertex(score, int(row), int(col))
        shift = ((fine_col + origin[0]) * factor, (fine_row + origin[1]) * factor)
        height = float(score[row, col]) / max(spread, 1e-12)
        correlation = float(score[row, col] / geometry.root[row, col])
        peaks.append(CoarsePeak(shift, correlation, height, float(factor)))
    return peaks


def parabola_vertex(before: float, centre: float, after: float) -> float:
    """Where the parabola through a maximum and its neighbours has its vertex, samples from the maximum."""
    curvature = before - 2.0 * centre + after
    if curvature >= 0.0:
        return 0.0
    return float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))


def _interpolate_vertex(score: Image, row: int, col: int) -> tuple[float, float]:
    """Vertex of the parabolas through the maximum and its neighbours along each axis."""
    height, width = score.shape
    d_row = d_col = 0.0
    if 0 < row < height - 1:
        d_row = parabola_vertex(score[row - 1, col], score[row, col], score[row + 1, col])
    if 0 < col < width - 1:
        d_col = parabola_vertex(score[row, col - 1], score[row, col], score[row, col + 1])
    return row + d_row, col + d_col


def _overlap_along_axis(n_reference: int, n_image: int, min_overlap: float) -> tuple[Indices, ...]:
    """Shifts along one axis, and the first and last-plus-one reference sample that overlaps."""
    shifts = np.arange(-(n_reference - 1), n_image)
    first = np.maximum(0, -shifts)
    last = np.minimum(n_reference, n_image - shifts)
    keep = last - first >= max(OVERLAP_SAMPLES_MIN, min_overlap * min(n_reference, n_image))
    return shifts[keep], first[keep], last[keep]


@lru_cache(maxsize=8)
def _plan_surface(
    reference: tuple[int, ...], image: tuple[int, ...], min_overlap: float
) -> _SurfaceGeometry | None:
    shift_y, first_y, last_y = _overlap_along_axis(reference[0], image[0], min_overlap)
    shift_x, first_x, last_x = _overlap_along_axis(reference[1], image[1], min_overlap)
    if shift_x.size == 0 or shift_y.size == 0:
        return None
    # Shifts that are not searched may wrap around.
    size = [
        scipy.fft.next_fast_len(max(a + int(s[-1]), b - int(s[0])), real=True)
        for a, b, s in zip(reference, image, (shift_y, shift_x), strict=True)
    ]
    count = np.outer(last_y - first_y, last_x - first_x).astype(np.float64)
    smaller = float(min(reference[0] * reference[1], image[0] * image[1]))
    allowed = count >= min_overlap * smaller
    sampled = np.zeros_like(allowed)
    sampled[::4, ::2] = allowed[::4, ::2]
    return _SurfaceGeometry(
        shift_x=shift_x,
        shift_y=shift_y,
        reference_spans=((first_y, last_y), (first_x, last_x)),
        image_spans=(
            (first_y + shift_y, last_y + shift_y),
            (first_x + shift_x, last_x + shift_x),
        ),
        per_count=(1.0 / count).astype(np.float32),
        root=np.sqrt(count).astype(np.float32),
        allowed=allowed,
        size=(size[0], size[1]),
        sampled=np.flatnonzero(sampled),
    )


def _prepare_part(
    image: Image,
    geometry: _SurfaceGeometry,
    rows: tuple[Indices, ...],
    cols: tuple[Indices, ...],
) -> _SurfacePart:
    table, squares = cv2.integral2(image, sdepth=cv2.CV_64F, sqdepth=cv2.CV_64F)
    # Shading was removed, so that single precision is enough for differences of the sums.
    sums = _sum_boxes(np.asarray(table, dtype=np.float32), rows, cols)
    energies = _sum_boxes(np.asarray(squares, dtype=np.float32), rows, cols)
    energies -= sums * sums * geometry.per_count
    floor = 1e-9 * max(float(energies.max()), 1e-30)
    deviation = np.sqrt(np.maximum(energies, np.float32(floor)))
    return _SurfacePart(scipy.fft.rfft2(image, geometry.size), sums, deviation)


def _sum_boxes(
    table: Image,
    rows: tuple[Indices, ...],
    cols: tuple[Indices, ...],
) -> Image:
    strips = np.take(table, rows[1], axis=0) - np.take(table, rows[0], axis=0)
    # Columns are gathered as rows, which lie together in memory.
    strips = np.ascontiguousarray(strips.T)
    sums = np.take(strips, cols[1], axis=0) - np.take(strips, cols[0], axis=0)
    return np.asarray(sums.T)


def _score(reference: _ReferencePart, image: _SurfacePart, geometry: _SurfaceGeometry) -> Image:
    """Correlation coefficients at all shifts, times the root of the number of samples; 0 where too little
    overlaps.
    """
    wrapped = scipy.fft.irfft2(image.spectrum * reference.spectrum, geometry.size)
    # Negative shifts are at the end.
    below_y, below_x = -int(geometry.shift_y[0]), -int(geometry.shift_x[0])
    above_y, above_x = len(geometry.shift_y) - below_y, len(geometry.shift_x) - below_x
    if min(below_y, below_x, above_y, above_x) < 1:
        # Neither image contains all of the other one's overlaps.
        rows, cols = geometry.shift_y % geometry.size[0], geometry.shift_x % geometry.size[1]
        cross = wrapped[rows][:, cols]
    else:
        cross = np.empty(geometry.root.shape, dtype=np.float32)
        cross[:below_y, :below_x] = wrapped[-below_y:, -below_x:]
        cross[:below_y, below_x:] = wrapped[-below_y:, :above_x]
        cross[below_y:, :below_x] = wrapped[:above_y, -below_x:]
        cross[below_y:, below_x:] = wrapped[:above_y, :above_x]
    cross -= reference.means * image.sums
    cross /= image.deviation
    cross *= reference.weight
    return np.asarray(cross)
