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

"""The reference of an alignment, cut into tiles.

Everything that least squares needs of an image are its products with the reference's gradients,
summed over tiles of some twenty pixels a side: gain and offset may then vary from tile to tile,
halves of the image can be compared and the scatter of the tiles tells the noise, all without
touching the pixels again. What does not depend on the image is computed once per reference.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import AnyImage, Array, Image
from semcal_ros.core.caches import LruCache
from semcal_ros.core.registration.fractional_delay import (
    FINE,
    SHARP,
    Band,
    gradients,
    sample_shifted,
)
from semcal_ros.core.registration.noise_spectrum import gaussian_taps, smooth

if TYPE_CHECKING:
    from semcal_ros.core.registration.tile_least_squares import TileGeometry

__all__ = [
    "ALL_PIXELS",
    "HESSIAN_PIXELS",
    "Pyramid",
    "PyramidLevel",
    "TileSums",
    "TileWindow",
    "make_level",
    "tile_sums",
    "tile_window",
]


# Tiles along a side that leave something to compare after gain and offset follow ramps.
_MIN_TILES = 3
#: Number of pixels from which the Gauss-Newton Hessian is taken at most: their gradients tell it to
#: 1 %, and the gradients of the image cost more than all other sums.
HESSIAN_PIXELS = 12_000
#: More than an image has.
ALL_PIXELS = 2**62
# They lie in bands at the top, in the middle and at the bottom of the overlap.
_HESSIAN_BANDS = 3
# Images that are smooth by less have structure beyond the band of the shorter filters.
_SHARP_PX = 0.3


@dataclass(frozen=True)
class PyramidLevel:
    """A reference at one resolution, prepared for alignment.

    Attributes
    ----------
    factor
        Full-resolution pixels per pixel of this level.
    sigma_px
        Width of the smoothing of both images, in px of this level.
    size
        (width, height) of the level.
    origin, side
        Left and top of the first tile, and width and height of a tile.
    mean
        Grey level that was subtracted.
    products
        (rows, cols, 3, n) gradient by x, by y and grey level of each tile's pixels.
    normal_matrices
        (rows, cols, 4, 4) products of those three and of the constant 1 with each other, summed
        over each tile.
    """

    factor: int
    sigma_px: float
    size: tuple[int, int]
    origin: tuple[int, int]
    side: tuple[int, int]
    mean: float
    products: Image
    normal_matrices: Array
    #: Geometry of the latest window, by its key.
    geometries: LruCache[tuple[int, int, int, int], TileGeometry] = field(
        default_factory=lambda: LruCache(1), repr=False, compare=False
    )

    @property
    def margin(self) -> int:
        """Pixels that the filters reach beyond a tile."""
        return _margin(self.sigma_px)


@dataclass(frozen=True)
class TileWindow:
    """The tiles whose pixels the image shows, as ranges of rows and columns of tiles.

    ``x`` (cols,) and ``y`` (rows,) are their middles in the image, in units of its width and of its
    height from its centre.
    """

    rows: slice
    cols: slice
    x: Array
    y: Array

    @property
    def key(self) -> tuple[int, int, int, int]:
        """First and last-plus-one row and column."""
        return self.rows.start, self.rows.stop, self.cols.start, self.cols.stop


@dataclass(frozen=True)
class TileSums:
    """Sums over tiles of an image sample_shifted at the reference's pixels.

    Attributes
    ----------
    cross
        (rows, cols, 4) products with gradient by x, by y, grey level and one.
    energy
        (rows, cols) squares.
    hessian
        (2, 2) Gauss-Newton Hessian of the shift: the image's own gradients times those of the
        reference, scaled to all tiles; noise does not contribute to it on average.
    """

    cross: Array
    energy: Array
    hessian: Array


def _band(sigma_px: float) -> Band:
    return SHARP if sigma_px < _SHARP_PX else FINE


def _margin(sigma_px: float) -> int:
    # What lies farther out than that has four per cent of a Gaussian's weight.
    return _band(sigma_px).reach + int(np.ceil(1.5 * sigma_px))


def _tile_side(length: int) -> int:
    """Side near a 24th of the length that leaves little of it over."""
    target = int(np.clip(length // 24, 6, 32))
    sides = np.arange(max(6, int(0.75 * target)), int(1.25 * target) + 1)
    return int(sides[np.argmin(length % sides)])


def make_level(pyramid: Pyramid, factor: int, sigma_px: float) -> PyramidLevel | None:
    """Prepare one resolution of an image, or None where it is too small for tiles.

    ``sigma_px`` is the smoothing in px of the level.
    """
    image = np.asarray(pyramid.at(factor), dtype=np.float32)
    margin = _margin(sigma_px)
    height, width = image.shape
    inside = (width - 2 * margin, height - 2 * margin)
    if min(inside) < _MIN_TILES * 6:
        return None
    side_x, side_y = (_tile_side(n) for n in inside)
    cols, rows = inside[0] // side_x, inside[1] // side_y
    smoothed = smooth(image, sigma_px)
    mean = float(smoothed.mean(dtype=np.float64))
    planes = np.stack([*gradients(smoothed, _band(sigma_px)), smoothed - np.float32(mean)])
    left = margin + (inside[0] - cols * side_x) // 2
    top = margin + (inside[1] - rows * side_y) // 2
    cut = planes[:, top : top + rows * side_y, left : left + cols * side_x]
    tiles = cut.reshape(3, rows, side_y, cols, side_x).transpose(1, 3, 0, 2, 4)
    products = np.ascontiguousarray(tiles).reshape(rows, cols, 3, side_y * side_x)
    normal_matrices = np.empty((rows, cols, 4, 4))
    normal_matrices[..., :3, :3] = products @ products.transpose(0, 1, 3, 2)
    normal_matrices[..., :3, 3] = normal_matrices[..., 3, :3] = products.sum(
        axis=3, dtype=np.float64
    )
    normal_matrices[..., 3, 3] = side_x * side_y
    return PyramidLevel(
        factor,
        sigma_px,
        (width, height),
        (left, top),
        (side_x, side_y),
        mean,
        products,
        normal_matrices,
    )


class Pyramid:
    """A grey image of any type at the resolutions that are asked for."""

    def __init__(self, image: AnyImage) -> None:
        self._levels: dict[int, AnyImage] = {1: image}

    def at(self, factor: int) -> AnyImage:
        """Averaged over squares of ``factor`` px, a power of two; what does not fill a square is
        left out.
        """
        if factor not in self._levels:
            finer = self.at(factor // 2)
            if factor == 2:
                # The average of several pixels is finer than their grey levels.
                finer = finer.astype(np.float32, copy=False)
            height, width = finer.shape[0] // 2, finer.shape[1] // 2
            part = cast("NDArray[np.float32]", finer[: 2 * height, : 2 * width])
            small = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
            self._levels[factor] = np.asarray(small)
        return self._levels[factor]

    @property
    def full(self) -> AnyImage:
        """The image itself."""
        return self._levels[1]


def tile_window(
    level: PyramidLevel, image_size: tuple[int, int], shift: Array
) -> TileWindow | None:
    """The tiles that an image of that size shows at a shift; None where there are too few."""
    ranges, middles = [], []
    for axis in (0, 1):
        origin, side, count = (
            level.origin[axis],
            level.side[axis],
            level.normal_matrices.shape[1 - axis],
        )
        low = level.margin - np.floor(shift[axis]) - origin
        high = image_size[axis] - level.margin - 1 - np.ceil(shift[axis]) - origin
        first = max(0, int(np.ceil(low / side)))
        last = min(count, int(np.floor(high / side)))
        if last - first < _MIN_TILES:
            return None
        ranges.append(slice(first, last))
        middle = origin + side * (np.arange(first, last) + 0.5) - 0.5 + shift[axis]
        middles.append((middle - 0.5 * (image_size[axis] - 1)) / image_size[axis])
    return TileWindow(ranges[1], ranges[0], middles[0], middles[1])


def _window_rectangle(level: PyramidLevel, window: TileWindow) -> tuple[int, int, int, int]:
    """Left, top, width and height of the window in the reference."""
    left = level.origin[0] + window.cols.start * level.side[0]
    top = level.origin[1] + window.rows.start * level.side[1]
    width = (window.cols.stop - window.cols.start) * level.side[0]
    height = (window.rows.stop - window.rows.start) * level.side[1]
    return left, top, width, height


def tile_sums(
    level: PyramidLevel,
    window: TileWindow,
    image: AnyImage,
    shift: Array,
    mean: float,
    hessian: Array | None,
    enough: int = HESSIAN_PIXELS,
) -> TileSums:
    """Sums over the window's tiles of ``image`` sample_shifted at the reference's pixels plus ``shift``.

    ``image`` is at the resolution of the level; ``mean`` is subtracted from it. ``hessian`` is
    that of an earlier shift of the same images, None to compute it from ``enough`` pixels.
    """
    left, top, width, height = _window_rectangle(level, window)
    side_x, side_y = level.side
    whole = np.rint(shift).astype(int)
    corner = (left + int(whole[0]), top + int(whole[1]))
    smoothing = gaussian_taps(level.sigma_px)
    fraction = np.asarray(shift - whole, dtype=np.float64)
    band = _band(level.sigma_px)
    sampled = sample_shifted(image, corner, (width, height), fraction, smoothing, band, -mean)
    rows, cols = height // side_y, width // side_x
    tiles = _split_into_tiles(sampled, level.side)
    products = level.products[window.rows, window.cols]
    cross = np.empty((rows, cols, 4))
    cross[..., :3] = (products @ tiles[..., None])[..., 0]
    cross[..., 3] = tiles @ np.ones(side_x * side_y, dtype=np.float32)
    energy = np.einsum("rcn,rcn->rc", tiles, tiles).astype(np.float64)
    return TileSums(
        cross,
        energy,
        _common_hessian(level, window, sampled, enough) if hessian is None else hessian,
    )


def _split_into_tiles(image: Image, side: tuple[int, int]) -> Image:
    """(rows, cols, n) the pixels of each tile."""
    rows, cols = image.shape[0] // side[1], image.shape[1] // side[0]
    cut = image.reshape(rows, side[1], cols, side[0]).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(cut).reshape(rows, cols, side[0] * side[1])


def _common_hessian(level: PyramidLevel, window: TileWindow, sampled: Image, enough: int) -> Array:
    """Products of both images' gradients, scaled from enough rows of tiles to all of them."""
    side, band = level.side[1], _band(level.sigma_px)
    rows = len(window.y)
    wanted = max(1, -(-enough // (sampled.shape[1] * side * _HESSIAN_BANDS)))
    bands = [(0, rows)]
    if wanted * _HESSIAN_BANDS < rows:
        starts = (
            rows * (2 * k + 1) // (2 * _HESSIAN_BANDS) - wanted // 2 for k in range(_HESSIAN_BANDS)
        )
        bands = [(first, first + wanted) for first in starts]
    normal_matrices = level.normal_matrices[window.rows, window.cols]
    total, used = np.zeros((2, 2)), np.zeros((4, 4))
    for first, last in bands:
        # The derivatives reach beyond the band, and are mirrored at the edges of the window.
        above = min(band.reach, first * side)
        part = sampled[first * side - above : last * side + band.reach]
        products = level.products[window.rows, window.cols][first:last, :, :2]
        used += normal_matrices[first:last].sum(axis=(0, 1))
        for axis, own in enumerate(gradients(part, band)):
            tiles = _split_into_tiles(own[above : above + (last - first) * side], level.side)
            total[:, axis] += (products @ tiles[..., None])[..., 0].sum(axis=(0, 1))
    whole = np.diag(normal_matrices.sum(axis=(0, 1)))[:2]
    share = np.sqrt(whole / np.maximum(np.diag(used)[:2], 1e-30))
    return np.asarray(0.5 * (total + total.T) * np.outer(share, share))
