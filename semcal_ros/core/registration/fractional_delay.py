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

"""Band-limited sub-pixel shifts and derivatives as short separable filters.

A pure translation needs no general remap: the same few weights serve every pixel of a row. The
weights minimise the squared error over the band in which a blurred image has its power
(least-squares fractional delay, Laakso et al. 1996, doi:10.1109/79.482137), so the interpolation
error stays below the noise and does not depend on the fraction. OpenCV's remap is no substitute:
version 4 rounds float maps to 1/32 px.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided

from semcal_ros.core.arrays import AnyImage, Array, Image
from semcal_ros.core.registration.thresholds import (
    BAND_EDGES,
    BAND_TAPS,
    FILTER_FREQUENCIES,
    FILTER_RIDGE,
    FLAT_BELOW,
)


@dataclass(frozen=True)
class Band:
    """Up to which frequency filters are accurate, and how long they are for that.

    Attributes
    ----------
    edge
        Frequency, rad per px.
    taps
        Even number of weights of a fractional shift.
    """

    edge: float
    taps: int

    @property
    def reach(self) -> int:
        """Pixels that the filters reach to either side."""
        return self.taps // 2

    @property
    def first(self) -> int:
        """Offset of the first weight of a shift."""
        return 1 - self.taps // 2

    @property
    def frequencies(self) -> Array:
        """(64,) frequencies at which the filters are fitted."""
        return np.asarray((np.arange(FILTER_FREQUENCIES) + 0.5) / FILTER_FREQUENCIES * self.edge)

    @property
    def weights(self) -> Array:
        """(64,) their weights: images have most of their power at low frequencies."""
        return np.asarray(1.0 / (FLAT_BELOW + self.frequencies**2))


#: For images that are smooth, and for sharp ones with little noise.
FINE, SHARP = (Band(edge, taps) for edge, taps in zip(BAND_EDGES, BAND_TAPS, strict=True))


@lru_cache(maxsize=2)
def _invert_normal_matrix(band: Band) -> Array:
    """(taps, taps) inverse of the normal equations of the weights."""
    offsets = np.arange(band.taps) + band.first
    difference = offsets[:, None] - offsets[None, :]
    cosines = np.cos(band.frequencies[:, None, None] * difference)
    normal = np.tensordot(band.weights, cosines, axes=1)
    normal += FILTER_RIDGE * normal[0, 0] * np.eye(band.taps)
    return np.asarray(np.linalg.inv(normal))


@lru_cache(maxsize=2)
def _shift_taps_by_wave(band: Band) -> tuple[Array, Array, Array]:
    """(64,) frequencies, and (taps, 64) weights of a shift by the cosines, and by the sines, of the shift times
    these.
    """
    frequencies = band.frequencies
    phase = np.outer(np.arange(band.taps) + band.first, frequencies)
    inverse, weights = _invert_normal_matrix(band), band.weights
    return frequencies, inverse @ (np.cos(phase) * weights), inverse @ (np.sin(phase) * weights)


def _make_shift_taps(fraction: float, band: Band) -> Array:
    """Weights w with ``f(x + fraction) = sum_k w[k] f(x + first + k)``, for a fraction in [0, 1]."""
    frequencies, cosines, sines = _shift_taps_by_wave(band)
    phase = fraction * frequencies
    taps = cosines @ np.cos(phase) + sines @ np.sin(phase)
    return np.asarray(taps / taps.sum())


@lru_cache(maxsize=2)
def _make_derivative_taps(band: Band) -> Array:
    """Antisymmetric weights of the first derivative at the centre tap."""
    reach = np.arange(1, band.reach + 1)
    sines = 2.0 * np.sin(band.frequencies[:, None] * reach)
    weighted = sines * band.weights[:, None]
    half = np.linalg.solve(sines.T @ weighted, weighted.T @ band.frequencies)
    half /= 2.0 * float(half @ reach)
    return np.concatenate([-half[::-1], [0.0], half])


def gradients(image: Image, band: Band) -> tuple[Image, Image]:
    """Derivatives (d/dx, d/dy) of ``image`` in units per px, each as large as ``image``."""
    taps = _make_derivative_taps(band)
    one = np.array([1.0])
    dx = cv2.sepFilter2D(image, cv2.CV_32F, taps, one, borderType=cv2.BORDER_REFLECT_101)
    dy = cv2.sepFilter2D(image, cv2.CV_32F, one, taps, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(dx, dtype=np.float32), np.asarray(dy, dtype=np.float32)


def gradients_transposed(image: Image, band: Band) -> tuple[Image, Image]:
    """What :func:`gradients` does to an image, transposed as a matrix, applied to ``image``.

    The sum of ``gradients(a, band)[k] * b`` is that of ``a * gradients_transposed(b, band)[k]``.
    """
    taps, reach = -_make_derivative_taps(band), band.reach
    one = np.array([1.0])
    found = []
    for turned in (image.T, image):
        # Along the rows of both, so that what is mirrored is folded back along the first axis.
        padded = cv2.copyMakeBorder(
            np.ascontiguousarray(turned), reach, reach, 0, 0, cv2.BORDER_CONSTANT, value=0
        )
        beyond = np.asarray(
            cv2.sepFilter2D(padded, cv2.CV_32F, one, taps, borderType=cv2.BORDER_CONSTANT),
            dtype=np.float32,
        )
        inside = beyond[reach:-reach]
        inside[1 : reach + 1] += beyond[reach - 1 :: -1]
        inside[-reach - 1 : -1] += beyond[: -reach - 1 : -1]
        found.append(inside)
    return np.ascontiguousarray(found[0].T), found[1]


def sample_tiles(
    image: Image,
    corner: tuple[int, int],
    tiles: tuple[int, int],
    side: tuple[int, int],
    fraction: Array,
    smoothing: Array,
    band: Band,
) -> Image:
    """As :func:`sample_shifted`, cut into tiles: (columns, rows, n) the pixels of each, row by row.

    Parameters
    ----------
    image
        (h, w) of float32.
    tiles, side
        Number of (columns, rows) and (width, height) of each.
    corner, fraction, smoothing, band
        As for :func:`sample_shifted`.

    Notes
    -----
    A filter along an axis is a product with a banded matrix, of which one tile at a time needs a small
    block. Half of the block is zeros, and it still takes half of the time of ``cv2.sepFilter2D``.
    """
    below = np.floor(fraction).astype(int)
    taps = [np.convolve(smoothing, _make_shift_taps(float(p), band)) for p in fraction - below]
    before, reach = len(smoothing) // 2 - band.first, len(taps[0]) - 1
    first = [c + int(b) - before for c, b in zip(corner, below, strict=True)]
    size = [n * s + reach for n, s in zip(tiles, side, strict=True)]
    source = _cut_mirrored(image, first, size)
    across, down = (_banded(t, s) for t, s in zip(taps, side, strict=True))
    columns, rows = tiles
    pitch, step = source.strides
    bands = as_strided(
        source, (rows, side[1] + reach, size[0]), (side[1] * pitch, pitch, step), writeable=False
    )
    lines = np.matmul(down, bands).reshape(rows * side[1], size[0])
    pitch, step = lines.strides
    strips = as_strided(
        lines,
        (columns, rows * side[1], side[0] + reach),
        (side[0] * step, pitch, step),
        writeable=False,
    )
    return np.asarray(np.matmul(strips, across.T).reshape(columns, rows, side[1] * side[0]))


def _banded(taps: Array, side: int) -> Image:
    """(side, side + taps - 1) matrix that applies a filter to as many pixels."""
    matrix = np.zeros((side, side + len(taps)), dtype=np.float32)
    matrix[:, : len(taps)] = taps
    # Read with rows that are shorter by one, each row lies one to the right of the row before.
    return matrix.ravel()[:-side].reshape(side, -1)


def _cut_mirrored(image: Image, first: Sequence[int], size: Sequence[int]) -> Image:
    """(width, height) pixels from (left, top) on, mirrored beyond the edges of the image."""
    (left, top), (width, height) = first, size
    right, bottom = left + width - image.shape[1], top + height - image.shape[0]
    part = image[max(top, 0) : top + height, max(left, 0) : left + width]
    if min(left, top) >= 0 and max(right, bottom) <= 0:
        return part
    borders = (max(-top, 0), max(bottom, 0), max(-left, 0), max(right, 0))
    return np.asarray(cv2.copyMakeBorder(part, *borders, cv2.BORDER_REFLECT_101), dtype=np.float32)


def sample_shifted(
    image: AnyImage,
    corner: tuple[int, int],
    size: tuple[int, int],
    fraction: Array,
    smoothing: Array,
    band: Band,
    delta: float,
) -> Image:
    """``image`` filtered and sample_shifted at ``corner + (col, row) + fraction``, plus ``delta``.

    Parameters
    ----------
    image
        (h, w) of uint8, uint16 or float32.
    corner, size
        (left, top) and (width, height) of the patch, which must lie inside the image.
    fraction
        (2,) sub-pixel shift (x, y), each in [-1, 1].
    smoothing
        Odd number of weights of a filter along x and along y.
    band
        In which the shift is accurate.
    delta
        Added to the result.

    Notes
    -----
    Beyond its edges the image is mirrored.
    """
    left, top = corner
    width, height = size
    below = np.floor(fraction).astype(int)
    kernels = [np.convolve(smoothing, _make_shift_taps(float(p), band)) for p in fraction - below]
    before = len(smoothing) // 2 - band.first
    after = len(kernels[0]) - 1 - before
    x0, y0 = left + int(below[0]), top + int(below[1])
    from_x, from_y = max(x0 - before, 0), max(y0 - before, 0)
    source = image[from_y : y0 + height + after, from_x : x0 + width + after]
    filtered = cv2.sepFilter2D(
        cast("Image", source),
        cv2.CV_32F,
        kernels[0],
        kernels[1],
        anchor=(before, before),
        delta=delta,
        borderType=cv2.BORDER_REFLECT_101,
    )
    patch = filtered[y0 - from_y : y0 - from_y + height, x0 - from_x : x0 - from_x + width]
    return np.asarray(patch, dtype=np.float32)
