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

from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import NormalDist
from typing import TYPE_CHECKING, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from semcal_ros.core.arrays import AnyImage, Array, Image, Indices, Mask
from semcal_ros.core.caches import LruCache
from semcal_ros.core.registration.fractional_delay import (
    FINE,
    SHARP,
    Band,
    gradients,
    gradients_transposed,
    sample_tiles,
)
from semcal_ros.core.registration.noise_spectrum import (
    gaussian_taps,
    passed_gradient,
    passed_variance,
    shared_pixels,
    smooth,
)
from semcal_ros.core.registration.thresholds import (
    AGREEMENT_SIGMAS,
    ALL_PIXELS,
    CURVATURES_KEPT,
    HESSIAN_BANDS,
    HESSIAN_PIXELS,
    SHARP_PX,
    SHOWS_SMOOTHING_PX,
    TILES_MIN,
    WINDOWS_KEPT,
)

if TYPE_CHECKING:
    from semcal_ros.core.registration.tile_least_squares import TileGeometry


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
    noise_variance
        Of the smoothed pixels, in squared grey levels.
    shows_structure
        (rows, cols) tiles that show structure, whatever their gradients (:func:`find_structure`); None where only these
        tell.
    dropped
        (rows, cols, n) True at pixels that do not count (:func:`drop_pixels`); None where all do.
    """

    factor: int
    sigma_px: float
    size: tuple[int, int]
    origin: tuple[int, int]
    side: tuple[int, int]
    mean: float
    products: Image
    normal_matrices: Array
    noise_variance: float = 0.0
    shows_structure: Mask | None = None
    dropped: Mask | None = None
    #: The level of which they were dropped.
    undropped: PyramidLevel | None = field(default=None, repr=False, compare=False)
    #: Geometry of the latest windows, by their keys.
    geometries: LruCache[tuple[int, int, int, int], TileGeometry] = field(
        default_factory=lambda: LruCache(WINDOWS_KEPT), repr=False, compare=False
    )
    _curvatures: LruCache[tuple[object, ...], _Curvature] = field(
        default_factory=lambda: LruCache(CURVATURES_KEPT), repr=False, compare=False
    )

    @property
    def margin(self) -> int:
        """Pixels that the filters reach beyond a tile."""
        return _margin(self.sigma_px)

    @property
    def pixel_counts(self) -> Array:
        """(rows, cols) number of pixels of each tile that count, at least 1."""
        return np.asarray(np.maximum(self.normal_matrices[..., 3, 3], 1.0))

    @cached_property
    def squared_gradients(self) -> Image:
        """(rows, cols, n) squares of the gradient at each tile's pixels, also at those that do not count."""
        if self.undropped is not None:
            return self.undropped.squared_gradients
        slopes = self.products[:, :, :2]
        return np.asarray(np.einsum("rckn,rckn->rcn", slopes, slopes))

    @cached_property
    def plane_terms(self) -> Image:
        """(n, 3) one, x and y at the pixels of a tile, orthonormal."""
        x, y = (np.arange(side) - 0.5 * (side - 1) for side in self.side)
        ones = np.ones(self.side[0] * self.side[1])
        terms = np.stack([ones, np.tile(x, len(y)), np.repeat(y, len(x))], axis=1)
        return np.asarray(terms / np.linalg.norm(terms, axis=0), dtype=np.float32)

    @cached_property
    def planes(self) -> Array:
        """(rows, cols, 3, 3) products of gradient by x, by y and grey level with :attr:`plane_terms`, also of pixels
        that do not count.
        """
        if self.undropped is not None:
            return self.undropped.planes
        return np.asarray(self.products @ self.plane_terms, dtype=np.float64)

    @cached_property
    def noise_products(self) -> Array:
        """(rows, cols, 2, 2) each tile's part in the covariance of the sum over tiles of the products of gradients with
        white noise of which, after the smoothing, variance one is left.

        Noise n = G w of white noise w, smoothed by G, has the product g' n = (G g)' w with a gradient g.
        """
        if self.undropped is not None:
            # In the proportion of the gradients that count: a mask of each frame would be smoothed anew.
            whole = self.undropped
            energies = [
                np.einsum("rcii->rc", level.normal_matrices[..., :2, :2]) for level in (self, whole)
            ]
            share = energies[0] / np.maximum(energies[1], 1e-30)
            return np.asarray(whole.noise_products * share[..., None, None])
        rows, cols = self.products.shape[:2]
        side_x, side_y = self.side
        planes = self.products[:, :, :2].reshape(rows, cols, 2, side_y, side_x)
        planes = planes.transpose(2, 0, 3, 1, 4).reshape(2, rows * side_y, cols * side_x)
        smoothed = np.stack([smooth(plane, self.sigma_px) for plane in planes])
        tiles = smoothed.reshape(2, rows, side_y, cols, side_x).transpose(1, 3, 0, 2, 4)
        tiles = np.ascontiguousarray(tiles).reshape(rows, cols, 2, -1)
        products = (tiles @ tiles.transpose(0, 1, 3, 2)).astype(np.float64)
        return np.asarray(products / passed_variance(self.sigma_px))


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
    pixels
        (rows, cols, n) the image's pixels, of which the sums are.
    """

    cross: Array
    energy: Array
    hessian: Array
    pixels: Image = field(repr=False)

    def weighted(self, weights: Array) -> TileSums:
        """The sums with weights (rows, cols) of the tiles, which the Hessian has already."""
        return replace(self, cross=self.cross * weights[..., None], energy=self.energy * weights)


@dataclass(frozen=True)
class _Curvature:
    """Second derivatives of the reference over some rows of tiles.

    The products of the reference's gradient with that of the image, summed over pixels, are those of the
    image itself with minus the second derivatives of the reference, which are computed once.

    Attributes
    ----------
    rows
        (k,) rows of tiles, counted from the first of the window.
    weights
        (3, columns, k * n) factors of their pixels for the elements xx, xy and yy of the Hessian.
    energy
        (columns, 2) squares of the reference's gradient by x and by y that take part.
    first
        First of the columns in the reference.
    """

    rows: Indices
    weights: Image
    energy: Array
    first: int


def band_of(sigma_px: float) -> Band:
    """Return the filters for an image that was smoothed by ``sigma_px``."""
    return SHARP if sigma_px < SHARP_PX else FINE


def _margin(sigma_px: float) -> int:
    # What lies farther out than that has four per cent of a Gaussian's weight.
    return band_of(sigma_px).reach + int(np.ceil(1.5 * sigma_px))


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
    if min(inside) < TILES_MIN * 6:
        return None
    side_x, side_y = (_tile_side(n) for n in inside)
    cols, rows = inside[0] // side_x, inside[1] // side_y
    smoothed = smooth(image, sigma_px)
    mean = float(smoothed.mean(dtype=np.float64))
    planes = np.stack([*gradients(smoothed, band_of(sigma_px)), smoothed - np.float32(mean)])
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


def find_structure(level: PyramidLevel) -> Mask:
    """Return which tiles (rows, cols) of a sparse picture show more than noise.

    They are looked at under a stronger smoothing than a shift is measured with: that is best for edges, which are
    sharp, and leaves so much noise that bodies which are plain to see do not stand out by their gradients.
    """
    rows, cols = level.products.shape[:2]
    side_x, side_y = level.side
    grey = level.products[:, :, 2].reshape(rows, cols, side_y, side_x).transpose(0, 2, 1, 3)
    whole = np.ascontiguousarray(grey.reshape(rows * side_y, cols * side_x))
    by_y, by_x = np.gradient(smooth(whole, SHOWS_SMOOTHING_PX))
    energy = (by_x**2 + by_y**2).reshape(rows, side_y, cols, side_x).sum(axis=(1, 3))
    sigma_px = float(np.hypot(level.sigma_px, SHOWS_SMOOTHING_PX))
    pixels = side_x * side_y
    noise = level.noise_variance / passed_variance(level.sigma_px)
    expected = 2.0 * pixels * noise * passed_gradient(sigma_px)
    # As rare as other deviations of tiles.
    freedom = 2.0 * pixels / shared_pixels(sigma_px)
    limit = float(chdtri(freedom, NormalDist().cdf(-AGREEMENT_SIGMAS))) / freedom
    return np.asarray(energy > limit * expected)


def drop_pixels(level: PyramidLevel, dropped: Mask) -> PyramidLevel:
    """The same resolution without the pixels of the reference where ``dropped`` (h, w), of its size, is True.

    They are no part of any sum then, neither of the reference nor of the image: what lies there does not say where the
    specimen is.
    """
    rows, cols = level.normal_matrices.shape[:2]
    (left, top), (side_x, side_y) = level.origin, level.side
    cut = dropped[top : top + rows * side_y, left : left + cols * side_x]
    tiles = np.ascontiguousarray(
        cut.reshape(rows, side_y, cols, side_x).transpose(0, 2, 1, 3)
    ).reshape(rows, cols, -1)
    some = tiles.any(axis=2)
    kept = (~tiles[some]).astype(np.float32)
    with_ones = np.concatenate(
        [level.products[some] * kept[:, None, :], kept[:, None, :]], axis=1, dtype=np.float32
    )
    normal_matrices = level.normal_matrices.copy()
    normal_matrices[some] = with_ones @ with_ones.transpose(0, 2, 1)
    return replace(
        level,
        normal_matrices=normal_matrices,
        dropped=tiles,
        undropped=level,
        geometries=LruCache(WINDOWS_KEPT),
    )


class Pyramid:
    """A grey image of any type at the resolutions that are asked for."""

    def __init__(self, image: AnyImage) -> None:
        self._levels: dict[int, AnyImage] = {1: image}
        self._centred: dict[int, Image] = {}

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

    @cached_property
    def mean(self) -> float:
        """Mean grey level."""
        return float(cv2.mean(cast("NDArray[np.float32]", self.full))[0])

    def centred(self, factor: int) -> Image:
        """As :meth:`at`, in single precision and without the mean."""
        if factor not in self._centred:
            level = self.at(factor).astype(np.float32)
            level -= np.float32(self.mean)
            self._centred[factor] = level
        return self._centred[factor]

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
        if last - first < TILES_MIN:
            return None
        ranges.append(slice(first, last))
        middle = origin + side * (np.arange(first, last) + 0.5) - 0.5 + shift[axis]
        middles.append((middle - 0.5 * (image_size[axis] - 1)) / image_size[axis])
    return TileWindow(ranges[1], ranges[0], middles[0], middles[1])


def tile_sums(
    level: PyramidLevel,
    window: TileWindow,
    image: Image,
    shift: Array,
    hessian: Array | None,
    enough: int = HESSIAN_PIXELS,
    weights: Array | None = None,
) -> TileSums:
    """Sums over the window's tiles of ``image`` sampled at the reference's pixels plus ``shift``.

    ``image`` is at the resolution of the level, about its mean (:meth:`Pyramid.centred`). ``hessian`` is
    that of an earlier shift of the same images, None to compute it from ``enough`` pixels; with ``weights``
    (rows, cols) of the window's tiles it is that of these tiles, from all of their pixels, and the sums are
    still those without.
    """
    rows, cols = window.rows, window.cols
    whole = np.rint(shift).astype(int)
    corner = (
        level.origin[0] + cols.start * level.side[0] + int(whole[0]),
        level.origin[1] + rows.start * level.side[1] + int(whole[1]),
    )
    count = cols.stop - cols.start, rows.stop - rows.start
    fraction = np.asarray(shift - whole, dtype=np.float64)
    band, smoothing = band_of(level.sigma_px), gaussian_taps(level.sigma_px)
    sampled = sample_tiles(image, corner, count, level.side, fraction, smoothing, band)
    if level.dropped is not None:
        sampled[level.dropped[rows, cols].transpose(1, 0, 2)] = 0.0
        enough = ALL_PIXELS
    if hessian is None and weights is not None:
        hessian = np.einsum("rc,rcij->ij", weights, _tile_hessians(level, window, sampled))
    elif hessian is None:
        hessian = _common_hessian(level, window, sampled, enough)
    tiles = sampled.transpose(1, 0, 2)
    cross = np.empty((count[1], count[0], 4))
    cross[..., :3] = (level.products[rows, cols] @ tiles[..., None])[..., 0]
    cross[..., 3] = tiles @ np.ones(tiles.shape[2], dtype=np.float32)
    energy = np.einsum("crn,crn->rc", sampled, sampled).astype(np.float64)
    return TileSums(cross, energy, hessian, tiles)


def residuals_at_gradients(
    level: PyramidLevel, window: TileWindow, sums: TileSums, gain: Array
) -> Array:
    """(rows, cols) squares of what ``gain`` (rows, cols) and each tile's offset leave of its pixels, as a mean with the
    squares of the reference's gradients for weights.

    Of a bright particle on a dark ground, noise is where the gradients are: the mean of all pixels is some times less.
    """
    grey = level.products[window.rows, window.cols, 2]
    counts = level.pixel_counts[window.rows, window.cols]
    sum_of_reference = level.normal_matrices[window.rows, window.cols, 2, 3]
    offset = (sums.cross[..., 3] - gain * sum_of_reference) / counts
    left = sums.pixels - gain[..., None] * grey - offset[..., None]
    energies = level.squared_gradients[window.rows, window.cols]
    if level.dropped is not None:
        energies = np.where(level.dropped[window.rows, window.cols], np.float32(0.0), energies)
    weighted = np.einsum("rcn,rcn,rcn->rc", energies, left, left)
    return np.asarray(weighted / np.maximum(energies.sum(axis=2, dtype=np.float64), 1e-30))


def _common_hessian(level: PyramidLevel, window: TileWindow, sampled: Image, enough: int) -> Array:
    """Products of both images' gradients, scaled from enough rows of tiles to all of them."""
    rows, cols = window.rows, window.cols
    picked, unused = _pick_rows(level, window, enough)
    # Where few pixels take part, those at the edge of the window count.
    exact = (cols.start, cols.stop) if len(picked) == len(window.y) else None
    curvature = level._curvatures.get_or_compute(
        (rows.start, rows.stop, enough, exact),
        lambda: _compute_curvature(level, rows, cols if exact else None, picked, unused),
    )
    own = slice(cols.start - curvature.first, cols.stop - curvature.first)
    pixels = sampled[:, curvature.rows].reshape(-1)
    xx, xy, yy = (float(part.reshape(-1) @ pixels) for part in curvature.weights[:, own])
    if level.dropped is not None:
        # The sum is of the pixels that count, all of them.
        return np.array([[xx, xy], [xy, yy]])
    normal_matrices = level.normal_matrices[rows, cols]
    whole = np.array([normal_matrices[..., 0, 0].sum(), normal_matrices[..., 1, 1].sum()])
    share = np.sqrt(whole / np.maximum(curvature.energy[own].sum(axis=0), 1e-30))
    return np.array([[xx, xy], [xy, yy]]) * np.outer(share, share)


def _tile_hessians(level: PyramidLevel, window: TileWindow, sampled: Image) -> Array:
    """(rows, cols, 2, 2) products of both images' gradients in each tile."""
    rows, cols = window.rows, window.cols
    everything = np.arange(len(window.y))
    curvature = level._curvatures.get_or_compute(
        (rows.start, rows.stop, ALL_PIXELS, (cols.start, cols.stop)),
        lambda: _compute_curvature(level, rows, cols, everything, 0),
    )
    weights = curvature.weights.reshape(3, len(window.x), len(window.y), -1)
    xx, xy, yy = np.einsum("pcrn,crn->prc", weights, sampled).astype(np.float64)
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(*xx.shape, 2, 2)


def _pick_rows(level: PyramidLevel, window: TileWindow, enough: int) -> tuple[Indices, int]:
    """Rows of tiles with enough pixels, in bands of equal height, and the lines at either end of a band that
    do not count, because their derivatives reach beyond it.
    """
    rows, band = len(window.y), band_of(level.sigma_px)
    lines = -(-enough // (len(window.x) * level.side[0] * HESSIAN_BANDS)) + 2 * band.reach
    tall = -(-lines // level.side[1])
    if tall * HESSIAN_BANDS >= rows:
        return np.arange(rows), 0
    middles = rows * (2 * np.arange(HESSIAN_BANDS) + 1) // (2 * HESSIAN_BANDS)
    return ((middles - tall // 2)[:, None] + np.arange(tall)).ravel(), band.reach


def _compute_curvature(
    level: PyramidLevel, rows: slice, cols: slice | None, picked: Indices, unused: int
) -> _Curvature:
    columns = slice(0, level.products.shape[1]) if cols is None else cols
    (side_x, side_y), band = level.side, band_of(level.sigma_px)
    # Of all rows, nothing is copied.
    chosen = picked if len(picked) < rows.stop - rows.start else slice(None)
    tiles = level.products[rows, columns][chosen, :, :2]
    count, across = tiles.shape[:2]
    planes = tiles.reshape(count, across, 2, side_y, side_x).transpose(2, 0, 3, 1, 4)
    slopes = np.ascontiguousarray(planes).reshape(2, count * side_y, across * side_x)
    if unused:
        # The bands lie one below the other; nothing that counts reaches from one to the next.
        bands = slopes.reshape(2, HESSIAN_BANDS, -1, across * side_x)
        bands[:, :, :unused] = bands[:, :, -unused:] = 0.0
    energy = np.einsum("kic,kic->kc", slopes, slopes).reshape(2, across, side_x)
    xx, xy = gradients_transposed(slopes[0], band)
    yx, yy = gradients_transposed(slopes[1], band)
    xy += yx
    xy *= np.float32(0.5)
    weights = np.empty((3, across, count, side_y, side_x), dtype=np.float32)
    for weight, second in zip(weights, (xx, xy, yy), strict=True):
        weight[:] = second.reshape(count, side_y, across, side_x).transpose(2, 0, 1, 3)
    flat = weights.reshape(3, across, -1)
    return _Curvature(picked, flat, energy.sum(axis=2, dtype=np.float64).T, columns.start)
