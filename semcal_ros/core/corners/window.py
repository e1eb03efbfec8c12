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

"""The pixels that determine each corner: half a square around it, near its two edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Array32, Mask
from semcal_ros.core.corners.thresholds import WINDOW_BLOCK_PIXELS, WINDOW_HALF_WIDTH


@dataclass(frozen=True)
class PixelWindows:
    """Pixels of n windows, padded to the same number p.

    Attributes
    ----------
    x, y
        (n, p) pixel positions relative to ``origin``.
    value
        (n, p) grey values.
    valid
        (n, p) 1 for pixels in the window and in the image, 0 for padding.
    origin
        (n, 2) positions on which the windows are centred.
    coverage
        (n,) part of the window that lies in the image.
    """

    x: Array32
    y: Array32
    value: Array32
    valid: Array32
    origin: Array
    coverage: Array

    def select(self, keep: Mask | slice) -> PixelWindows:
        """Return the windows where ``keep`` is true, or a slice of them without a copy."""
        return PixelWindows(*(getattr(self, f.name)[keep] for f in fields(self)))

    @staticmethod
    def join(parts: Sequence[PixelWindows]) -> PixelWindows:
        """Concatenate the windows of several sets, padded to the same number of pixels."""
        pixels = max(part.x.shape[1] for part in parts)

        def padded(name: str) -> Array32:
            out = np.zeros((sum(len(part.x) for part in parts), pixels), dtype=np.float32)
            first = 0
            for part in parts:
                values = getattr(part, name)
                out[first : first + len(values), : values.shape[1]] = values
                first += len(values)
            return out

        return PixelWindows(
            padded("x"),
            padded("y"),
            padded("value"),
            padded("valid"),
            np.concatenate([part.origin for part in parts]),
            np.concatenate([part.coverage for part in parts]),
        )


def gather_windows(
    image: Array32, origin: Array, axes: Array, bend: Array, band_px: float
) -> PixelWindows:
    """Gather the pixels within half a square of each origin and ``band_px`` of one of its edges.

    Parameters
    ----------
    image
        (h, w) float32.
    origin
        (n, 2) expected corner positions, px.
    axes, bend
        (n, 2, 2) first and second derivatives of the local lattice map.
    band_px
        Half-width of the bands along the edges. Pixels farther from both edges carry no
        information on the position of the corner.
    """
    reach = int(np.ceil(WINDOW_HALF_WIDTH * np.abs(axes).sum(axis=1).max(initial=0.0))) + 1
    block = max(1, int(WINDOW_BLOCK_PIXELS / (2 * reach + 1) ** 2))
    parts = []
    for first in range(0, max(1, len(origin)), block):
        rows = slice(first, first + block)
        parts.append(_gather_block(image, origin[rows], axes[rows], bend[rows], band_px, reach))
    return PixelWindows.join(parts)


def _gather_block(
    image: Array32, origin: Array, axes: Array, bend: Array, band_px: float, reach: int
) -> PixelWindows:
    height, width = image.shape
    start = np.floor(origin + 0.5).astype(np.int64)
    shift = (start - origin).astype(np.float32)
    inverse = np.linalg.inv(axes.transpose(0, 2, 1)).astype(np.float32)
    span = np.arange(-reach, reach + 1)
    along = span.astype(np.float32)
    x, y = along[None, None, :] + shift[:, :1, None], along[None, :, None] + shift[:, 1:, None]
    u = np.abs(inverse[:, 0, 0, None, None] * x + inverse[:, 0, 1, None, None] * y)
    v = np.abs(inverse[:, 1, 0, None, None] * x + inverse[:, 1, 1, None, None] * y)
    inside = np.maximum(u, v) <= np.float32(WINDOW_HALF_WIDTH)
    area = np.maximum(np.count_nonzero(inside, axis=(1, 2)), 1)
    columns, rows = start[:, :1] + span, start[:, 1:] + span
    inside &= ((columns >= 0) & (columns < width))[:, None, :]
    inside &= ((rows >= 0) & (rows < height))[:, :, None]
    coverage = np.count_nonzero(inside, axis=(1, 2)) / area
    cell = np.abs(np.linalg.det(axes))
    # u = 0 is the edge along j; a step of 1 in u moves cell / |axis j| px away from it.
    band = band_px + 0.13 * np.linalg.norm(bend, axis=2).max(axis=1)
    limit_u = (band * np.linalg.norm(axes[:, 1], axis=1) / cell).astype(np.float32)
    limit_v = (band * np.linalg.norm(axes[:, 0], axis=1) / cell).astype(np.float32)
    inside &= (u <= limit_u[:, None, None]) | (v <= limit_v[:, None, None])
    return _pack(image, inside, start, shift, origin, coverage)


def _pack(
    image: Array32,
    inside: Mask,
    start: NDArray[np.int64],
    shift: Array32,
    origin: Array,
    coverage: Array,
) -> PixelWindows:
    """Return the pixels marked in boxes (n, s, s) around ``start``, side by side."""
    side = inside.shape[1]
    count = np.count_nonzero(inside, axis=(1, 2))
    pixels = max(1, int(count.max(initial=1)))
    corner, place = np.divmod(np.flatnonzero(inside), side * side)
    row, column = np.divmod(place, side)
    row -= side // 2
    column -= side // 2
    first = np.cumsum(count) - count
    slot = np.arange(len(corner)) + (corner * pixels - first[corner])

    def spread(values: Array32) -> Array32:
        out = np.zeros(len(origin) * pixels, dtype=np.float32)
        out[slot] = values
        return out.reshape(-1, pixels)

    flat = (start[corner, 1] + row) * image.shape[1] + start[corner, 0] + column
    return PixelWindows(
        spread(column.astype(np.float32) + shift[corner, 0]),
        spread(row.astype(np.float32) + shift[corner, 1]),
        spread(image.ravel()[flat]),
        spread(np.ones(len(corner), dtype=np.float32)),
        origin,
        coverage,
    )
