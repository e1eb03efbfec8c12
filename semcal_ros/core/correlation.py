"""Coarse search: normalised cross-correlation over the overlap, for every shift at once.

The correlation coefficient of what overlaps is exact at every shift (Padfield 2012,
doi:10.1109/TIP.2011.2181402): the cross term comes from one FFT product, means and energies of
rectangular overlaps from integral images. It does not favour small shifts, as a windowed phase
correlation does, and its heights can be compared with each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

__all__ = ["CoarsePeak", "coarse_peaks"]

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_LEVELS_PX = (128, 256, 512)
# A maximum over some 10^4 shifts of unrelated pictures stays below about 5 robust deviations.
_SIGNIFICANT = 7.0
# On a lattice the whole surface oscillates, so that its spread says nothing; its height does.
_HIGH = 0.5
_MAX_PEAKS = 8


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
        """Whether unrelated pictures are unlikely to give such a peak."""
        return self.significance >= _SIGNIFICANT or self.correlation >= _HIGH


def coarse_peaks(
    reference: Image, image: Image, min_overlap: float, guess_px: Array
) -> list[CoarsePeak]:
    """Local maxima of the correlation, best first, down to half of the height of the best.

    Parameters
    ----------
    reference, image
        Pictures of the same scale; sizes may differ.
    min_overlap
        Shifts are searched whose overlap is at least this fraction of the smaller picture, per axis
        and in area.
    guess_px
        (2,) predicted shift, near which peaks are listed even if many others are higher.

    Returns
    -------
    list
        Empty where no shift stands out, not even at half of the full resolution.
    """
    longest = max(*reference.shape, *image.shape)
    best: list[CoarsePeak] = []
    for level in _LEVELS_PX:
        factor = max(1, int(np.ceil(longest / level)))
        pair = _reduced(reference, factor), _reduced(image, factor)
        peaks = _peaks_at(*pair, factor, min_overlap, guess_px)
        if peaks and (not best or peaks[0].significance > best[0].significance):
            best = peaks
        if (peaks and peaks[0].significance >= _SIGNIFICANT) or factor == 1:
            break
    return best if best and best[0].significant else []


def _reduced(image: Image, factor: int) -> Image:
    """Area-averaged, with shading removed: only structure below an eighth of the field is
    compared.
    """
    height, width = image.shape[0] // factor, image.shape[1] // factor
    small = image[: height * factor, : width * factor]
    if factor > 1:
        reduced = cv2.resize(small, (width, height), interpolation=cv2.INTER_AREA)
        small = np.asarray(reduced, dtype=np.float32)
    background = cv2.GaussianBlur(small, (0, 0), max(height, width) / 16.0)
    return np.asarray(small - background, dtype=np.float32)


def _peaks_at(
    reference: Image, image: Image, factor: int, min_overlap: float, guess_px: Array
) -> list[CoarsePeak]:
    ncc, overlap, origin = _surface(reference, image, min_overlap)
    if ncc.size == 0 or not np.any(ncc > 0.0):
        return []
    # The spread of a chance correlation grows as the overlap shrinks.
    score = np.arctanh(np.clip(ncc, -0.999999, 0.999999)) * np.sqrt(overlap)
    searched = score[overlap >= min_overlap * min(reference.size, image.size)]
    if searched.size == 0:
        return []
    spread = 1.4826 * float(np.median(np.abs(searched - np.median(searched))))
    top = float(score.max())
    single = score.astype(np.float32)
    local = cv2.dilate(single, np.ones((5, 5), np.uint8)) <= single
    rows, cols = np.nonzero(local & (score >= 0.5 * top) & (score > 0.0))
    highest = np.argsort(-score[rows, cols], kind="stable")
    away = np.hypot(
        cols + origin[0] - guess_px[0] / factor, rows + origin[1] - guess_px[1] / factor
    )
    nearest = np.argsort(away, kind="stable")[:_MAX_PEAKS]
    # On a lattice the one near the prediction need not be among the highest.
    keep = [k for rank, k in enumerate(highest) if rank < _MAX_PEAKS or k in nearest]
    peaks = []
    for row, col in zip(rows[keep], cols[keep], strict=True):
        fine_row, fine_col = _vertex(score, int(row), int(col))
        shift = ((fine_col + origin[0]) * factor, (fine_row + origin[1]) * factor)
        height = float(score[row, col]) / max(spread, 1e-12)
        peaks.append(CoarsePeak(shift, float(ncc[row, col]), height, float(factor)))
    return peaks


def _vertex(score: Array, row: int, col: int) -> tuple[float, float]:
    """Vertex of the parabolas through the maximum and its neighbours along each axis."""

    def along(before: float, centre: float, after: float) -> float:
        curvature = before - 2.0 * centre + after
        return (
            0.0
            if curvature >= 0.0
            else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
        )

    height, width = score.shape
    d_row = d_col = 0.0
    if 0 < row < height - 1:
        d_row = along(score[row - 1, col], score[row, col], score[row + 1, col])
    if 0 < col < width - 1:
        d_col = along(score[row, col - 1], score[row, col], score[row, col + 1])
    return row + d_row, col + d_col


def _axis(n_reference: int, n_image: int, min_overlap: float) -> tuple[NDArray[np.intp], ...]:
    """Shifts along one axis, and the first and last-plus-one reference sample that overlaps."""
    shifts = np.arange(-(n_reference - 1), n_image)
    first = np.maximum(0, -shifts)
    last = np.minimum(n_reference, n_image - shifts)
    keep = last - first >= max(4.0, min_overlap * min(n_reference, n_image))
    return shifts[keep], first[keep], last[keep]


def _box_sums(
    values: Array, rows: tuple[NDArray[np.intp], ...], cols: tuple[NDArray[np.intp], ...]
) -> Array:
    table = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    np.cumsum(np.cumsum(values, axis=0), axis=1, out=table[1:, 1:])
    strips = table[rows[1]] - table[rows[0]]
    return np.asarray(strips[:, cols[1]] - strips[:, cols[0]])


def _surface(
    reference: Image, image: Image, min_overlap: float
) -> tuple[Array, Array, tuple[int, int]]:
    """Correlation coefficients, overlap in samples, and the (x, y) shift of element [0, 0]."""
    shift_y, first_y, last_y = _axis(reference.shape[0], image.shape[0], min_overlap)
    shift_x, first_x, last_x = _axis(reference.shape[1], image.shape[1], min_overlap)
    if shift_x.size == 0 or shift_y.size == 0:
        return np.zeros((0, 0)), np.zeros((0, 0)), (0, 0)
    size = [
        scipy.fft.next_fast_len(a + b - 1, real=True)
        for a, b in zip(reference.shape, image.shape, strict=True)
    ]
    product = scipy.fft.rfft2(image, size) * np.conj(scipy.fft.rfft2(reference, size))
    cross = scipy.fft.irfft2(product, size)[np.ix_(shift_y, shift_x)].astype(np.float64)

    here_y, here_x = (first_y, last_y), (first_x, last_x)
    there_y, there_x = (first_y + shift_y, last_y + shift_y), (first_x + shift_x, last_x + shift_x)
    r, i = reference.astype(np.float64), image.astype(np.float64)
    count = np.outer(last_y - first_y, last_x - first_x).astype(np.float64)
    sum_r, sum_i = _box_sums(r, here_y, here_x), _box_sums(i, there_y, there_x)
    energy_r = _box_sums(r * r, here_y, here_x) - sum_r * sum_r / count
    energy_i = _box_sums(i * i, there_y, there_x) - sum_i * sum_i / count
    floor = 1e-9 * max(float(np.sum(r * r)), float(np.sum(i * i)), 1e-300)
    scale = np.sqrt(np.maximum(energy_r, floor) * np.maximum(energy_i, floor))
    ncc = (cross - sum_r * sum_i / count) / scale
    smaller = float(min(reference.size, image.size))
    ncc[count < min_overlap * smaller] = 0.0
    return ncc, count, (int(shift_x[0]), int(shift_y[0]))
