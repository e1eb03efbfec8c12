"""The pixels that tell about each corner: half a square around it, near its two edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["PixelWindows", "gather_windows"]

Array = NDArray[np.float64]
Single = NDArray[np.float32]

# Windows of neighbouring corners just touch, so that no pixel is used twice and the errors are
# independent.
HALF_WIDTH = 0.5


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
        (n, 2) the positions that the windows are centred on.
    coverage
        (n,) part of the window that lies in the image.
    """

    x: Single
    y: Single
    value: Single
    valid: Single
    origin: Array
    coverage: Array


def gather_windows(
    image: Single, origin: Array, axes: Array, bend: Array, band_px: float
) -> PixelWindows:
    """Pixels within half a square of each origin and within ``band_px`` of one of the two edges.

    Parameters
    ----------
    image
        (h, w) float32.
    origin
        (n, 2) expected corner positions, px.
    axes, bend
        (n, 2, 2) first and second derivatives of the local lattice map.
    band_px
        Half-width of the bands along the edges. Pixels farther from both edges do not tell where
        the corner is.
    """
    height, width = image.shape
    start = np.floor(origin + 0.5).astype(np.int64)
    shift = (start - origin).astype(np.float32)
    inverse = np.linalg.inv(axes.transpose(0, 2, 1)).astype(np.float32)
    reach = int(np.ceil(HALF_WIDTH * np.abs(axes).sum(axis=1).max())) + 1
    span = np.arange(-reach, reach + 1)
    grid_y, grid_x = (g.ravel() for g in np.meshgrid(span, span, indexing="ij"))
    x = grid_x.astype(np.float32)[None] + shift[:, :1]
    y = grid_y.astype(np.float32)[None] + shift[:, 1:]
    u = np.abs(inverse[:, 0, :1] * x + inverse[:, 0, 1:] * y)
    v = np.abs(inverse[:, 1, :1] * x + inverse[:, 1, 1:] * y)
    inside = np.maximum(u, v) <= HALF_WIDTH
    area = np.maximum(inside.sum(axis=1), 1)
    cell = np.abs(np.linalg.det(axes))
    # u = 0 is the edge along j; a step of 1 in u moves cell / |axis j| px away from it.
    height_u = (cell / np.linalg.norm(axes[:, 1], axis=1)).astype(np.float32)
    height_v = (cell / np.linalg.norm(axes[:, 0], axis=1)).astype(np.float32)
    sag = 0.13 * np.linalg.norm(bend, axis=2).max(axis=1)
    band = (band_px + sag).astype(np.float32)
    columns = start[:, :1] + grid_x
    rows = start[:, 1:] + grid_y
    inside &= (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    coverage = inside.sum(axis=1) / area
    inside &= (u * height_u[:, None] <= band[:, None]) | (v * height_v[:, None] <= band[:, None])

    count = inside.sum(axis=1)
    pixels = max(1, int(count.max(initial=1)))
    corner, cell_index = np.nonzero(inside)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    slot = np.arange(len(corner)) - first[corner]

    flat = rows * width + columns

    def pad(values: NDArray[np.float32]) -> Single:
        out = np.zeros((len(origin), pixels), dtype=np.float32)
        out[corner, slot] = values
        return out

    return PixelWindows(
        pad(x[corner, cell_index]),
        pad(y[corner, cell_index]),
        pad(image.ravel()[flat[corner, cell_index]]),
        pad(np.ones(len(corner), dtype=np.float32)),
        origin,
        coverage,
    )
