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

"""How an image is lit otherwise than its reference, and what it would show in the light of the reference.

A shadow that falls on a specimen, and a charge that builds up, change gain and offset of an image smoothly, but not
along the plane that least squares (:mod:`.inverse_compositional`) allow for. What they leave has slopes, which pull the
shift: a gain that rises along x has a product with the gradient along x.

Here each tile has a gain and a brightness of its own. The light differs where those that the tiles around each one
foretell leave clearly less of the image than one gain and one plane do for all: light is smooth, and what changes from
tile to tile is none. Only tiles that agree but for their light count, and of these the largest body: a tool shows
something else. Between the middles of tiles, the light is interpolated.

What follows the light from tile to tile does not tell a shift any more. It fails where this is most of the specimen's
gradients, as of clouds: then nothing says what is light and what is specimen (:attr:`Illumination.kept`). And it does
not tell a tool from light on a specimen that is too faint to be seen missing (:attr:`Illumination.is_sure`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np

from semcal_ros.core.arrays import AnyImage, Array, Image, Mask, median
from semcal_ros.core.registration.agreement import SpecimenSeen, TileNoise
from semcal_ros.core.registration.noise_spectrum import gaussian_taps, shared_pixels
from semcal_ros.core.registration.thresholds import (
    AGREEMENT_SIGMAS,
    BESIDES_MAX,
    COVERED_SIGMAS,
    GAIN_MIN,
    LIGHT_EXCESS_MIN,
    LIGHT_GAIN_CHANGE,
    LIGHT_GAIN_RATIO_MAX,
    LIGHT_GROUPS,
    LIGHT_NOISE_MIN,
    LIGHT_SHARE_MIN,
    LIGHT_SIGMAS,
    MISSING_MAX,
    RICH_SIGMAS,
    STRUCTURE_MIN,
    TELLING_TILES_MIN,
)
from semcal_ros.core.registration.tiles import (
    Pyramid,
    PyramidLevel,
    TileSums,
    TileWindow,
    tile_sums,
    tile_window,
)


@dataclass(frozen=True)
class Illumination:
    """The light of an image beside that of a reference, at the middles of tiles.

    Attributes
    ----------
    gain
        (rows, cols) contrast of the image over that of the reference, about that of most tiles.
    offset
        (rows, cols) brightness that the gain of each tile leaves, about the mean of the image.
    corner_px, side_px
        (2,) left and top of the first tile in the image, and width and height of a tile.
    kept
        (2,) part of the squares of the gradients along x and y that does not follow the light from tile to tile, and
        tells a shift.
    is_sure
        Whether the specimen is surely seen in all of that light, and nothing that covers it.
    """

    gain: Array
    offset: Array
    corner_px: Array
    side_px: Array
    kept: Array
    is_sure: bool

    def even_out(self, image: AnyImage, region: tuple[int, int, int, int] | None = None) -> Image:
        """An image (h, w) as it would be in the light of the reference; the one that was measured was its ``region``
        (left, top, right, bottom), None for all of it.
        """
        (height, width), (rows, cols) = image.shape, self.gain.shape
        left, top, right, bottom = (0, 0, width, height) if region is None else region
        (x, y), (side_x, side_y) = self.corner_px + [left, top], self.side_px
        by_x = _interpolate(width, cols, float(x), float(side_x))
        by_y = _interpolate(height, rows, float(y), float(side_y))
        gain, offset = (
            np.asarray(by_y @ plane.astype(np.float32) @ by_x.T)
            for plane in (self.gain, self.offset)
        )
        # A cubic overshoots.
        gain = np.clip(gain, 1.0 / LIGHT_GAIN_RATIO_MAX, LIGHT_GAIN_RATIO_MAX)
        mean = np.float32(image[top:bottom, left:right].mean(dtype=np.float64))
        return np.asarray((image.astype(np.float32) - mean - offset) / gain + mean)


def _interpolate(size: int, count: int, corner_px: float, side_px: float) -> Image:
    """(size, count) weights of the means of tiles at pixels: a cubic through their middles (Keys 1981,
    doi:10.1109/TASSP.1981.1163711), and half a tile beyond.
    """
    at = np.clip((np.arange(size) + 0.5 - corner_px) / side_px - 0.5, -0.5, count - 0.5)
    first = np.clip(np.floor(at).astype(int), 0, count - 2)
    t = at - first
    cubic = (
        -0.5 * t * (1.0 - t) ** 2,
        1.0 - 2.5 * t**2 + 1.5 * t**3,
        0.5 * t * (1.0 + 4.0 * t - 3.0 * t**2),
        -0.5 * t**2 * (1.0 - t),
    )
    weights = np.zeros((size, count + 2))
    for k, part in enumerate(cubic):
        weights[np.arange(size), first + k] = part
    # Beyond the last tiles it goes straight on.
    weights[:, 1] += 2.0 * weights[:, 0]
    weights[:, 2] -= weights[:, 0]
    weights[:, -2] += 2.0 * weights[:, -1]
    weights[:, -3] -= weights[:, -1]
    weights = weights[:, 1:-1]
    # The mean of a parabola over a tile is off the value at its middle by a 24th of its second difference.
    middles = np.eye(count)
    inner = np.arange(1, count - 1)
    middles[inner, inner - 1] = middles[inner, inner + 1] = -1.0 / 24.0
    middles[inner, inner] = 1.0 + 2.0 / 24.0
    return np.asarray(weights @ middles, dtype=np.float32)


@dataclass(frozen=True)
class _Tiles:
    """What tiles show beside their planes of brightness: (rows, cols) pixels that count, squares of the reference and
    of the image and their products, and the squares of the reference without its noise.

    ``noise`` is that of a pixel, which so many pixels ``shared`` have in common, and ``usual`` the gain of the whole
    image.
    """

    pixels: Array
    reference: Array
    image: Array
    common: Array
    structure: Array
    noise: TileNoise
    shared: float
    usual: float

    def left(self, gain: Array | float) -> Array:
        """(rows, cols) squares that a gain leaves."""
        return np.asarray(self.image - 2.0 * gain * self.common + gain**2 * self.reference)

    @property
    def least(self) -> float:
        """A gain that is nearer to that in the darkest shadow than to none."""
        return 0.5 * self.usual / LIGHT_GAIN_RATIO_MAX

    @cached_property
    def scatter2(self) -> Array:
        """(rows, cols) variance of the products of reference and image without the least of the structure."""
        reference, image = self.noise.reference, self.noise.image
        by_noise = self.pixels * reference * (image + 2.0 * self.least**2 * reference)
        structure = np.maximum(self.structure, 0.0)
        return np.asarray(
            self.shared * (by_noise + structure * (image + self.least**2 * reference))
        )

    def pool_gain(self, counts: Mask, weights: Array) -> Array:
        """(rows, cols) gain of those tiles around each one that count, with weights (3, 3): as far as their structure
        tells it, and the usual one else.
        """
        noise = self.noise.image + self.usual**2 * self.noise.reference
        errors = max(self.shared * noise, 1e-30)
        precision = 1.0 / (LIGHT_GAIN_CHANGE * self.usual) ** 2
        common, structure = (
            _pool(np.where(counts, part, 0.0), weights) / errors
            for part in (self.common, self.structure)
        )
        gain = (common + self.usual * precision) / (np.maximum(structure, 0.0) + precision)
        least, most = self.usual / LIGHT_GAIN_RATIO_MAX, self.usual * LIGHT_GAIN_RATIO_MAX
        return np.clip(gain, least, most)


def measure_illumination(
    level: PyramidLevel,
    image: Pyramid,
    shift: Array,
    noise: TileNoise,
    compared: tuple[TileWindow, TileSums] | None = None,
) -> Illumination | None:
    """The light of an image at a shift that is right to a part of a tile; None where it is that of the reference, but
    for one gain and one plane of brightness, or cannot be told.

    ``compared`` are the tiles with their sums where these are known.
    """
    left = _left_of_noise(level.side, level.sigma_px)
    if left < LIGHT_NOISE_MIN:
        return None
    if compared is None:
        pixels_of_image = image.centred(level.factor)
        found = tile_window(level, (pixels_of_image.shape[1], pixels_of_image.shape[0]), shift)
        if found is None:
            return None
        compared = found, tile_sums(level, found, pixels_of_image, shift, np.zeros((2, 2)))
    window, sums = compared
    own = level.normal_matrices[window.rows, window.cols]
    pixels = level.pixel_counts[window.rows, window.cols]
    planes = level.planes[window.rows, window.cols]
    seen = np.asarray(sums.pixels @ level.plane_terms, dtype=np.float64)
    free = left * pixels
    reference = own[..., 2, 2] - np.sum(planes[..., 2, :] ** 2, axis=-1)
    common = sums.cross[..., 2] - np.sum(planes[..., 2, :] * seen, axis=-1)
    structure = reference - free * noise.reference
    chance = noise.reference * np.sqrt(2.0 * shared_pixels(level.sigma_px) * pixels)
    usual_gain = _find_usual_gain(common, structure, noise.reference * free, chance)
    if not GAIN_MIN < usual_gain < 1.0 / GAIN_MIN:
        return None
    tiles = _Tiles(
        pixels,
        reference,
        sums.energy - np.sum(seen**2, axis=-1),
        common,
        structure,
        noise,
        shared_pixels(level.sigma_px),
        usual_gain,
    )
    brightness = np.stack([sums.cross[..., 3], own[..., 2, 3]], axis=-1) / pixels[..., None]
    offset = brightness[..., 0] - usual_gain * brightness[..., 1]
    # Beside their means alone, tiles show more of a faint specimen.
    means, of_image = own[..., 2, 3], sums.cross[..., 3]
    specimen = SpecimenSeen(
        offset,
        own[..., 2, 2] - means**2 / pixels - pixels * noise.reference,
        sums.cross[..., 2] - means * of_image / pixels,
        pixels,
        noise,
        tiles.shared,
        usual_gain,
    )
    # A shadow takes contrast with the brightness; what is brighter and takes it is a body.
    covered = specimen.find_missing((1.0 - MISSING_MAX) * usual_gain, tiles.least)
    whole = (pixels == np.max(pixels)) & ~covered
    gain, agrees = _find_gains(tiles, free, whole)
    if agrees.mean() < LIGHT_SHARE_MIN:
        return None
    # Of smoothed noise, few pixels are independent.
    by_chance = LIGHT_SIGMAS * np.sqrt(2.0 * tiles.shared / float(np.sum(pixels[agrees])))
    excess = _compare_with_foretold(tiles, level.side, agrees, seen, planes[..., 2, :]) - 1.0
    if excess < max(LIGHT_EXCESS_MIN, by_chance):
        return None
    is_sure = _is_seen_everywhere(tiles, agrees, offset)
    of_gradients = planes[..., :2, :]
    foretold = _interpolate_planes(of_gradients[..., 0] / np.sqrt(pixels)[..., None], level.side)
    lost = np.sum((of_gradients * foretold)[agrees], axis=(0, 2))
    # Noise of the reference has gradients, too, and no slopes.
    by_noise = noise.gradient * noise.reference / max(noise.passed, 1e-12)
    whole = np.einsum("tii->i", own[agrees, :2, :2]) - by_noise * np.sum(pixels[agrees])
    # Where the gain rises, what rises with it in a tile adds to its mean: that is specimen, and no light.
    rising = _interpolate_planes(gain[..., None], level.side)[..., 0, 1:]
    with_gain = np.sum(rising * planes[..., 2, 1:], axis=-1) / pixels
    offset = brightness[..., 0] - gain * brightness[..., 1] - with_gain
    first = np.array([window.cols.start, window.rows.start])
    return Illumination(
        gain / usual_gain,
        _fill(offset, agrees),
        np.array(level.origin) + first * np.array(level.side) + shift,
        np.array(level.side, dtype=np.float64),
        np.maximum(1.0 - lost / np.maximum(whole, 1e-30), 0.0),
        is_sure,
    )


@lru_cache(maxsize=16)
def _left_of_noise(side: tuple[int, int], sigma_px: float) -> float:
    """Part of the variance of smoothed white noise that a plane over a tile leaves."""
    taps = gaussian_taps(sigma_px)
    alike = np.correlate(taps, taps, "full") / float(taps @ taps)
    means, slopes = [], []
    for length in side:
        apart = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
        covariance = np.pad(alike[len(taps) - 1 :], (0, length))[apart]
        x = np.arange(length) - 0.5 * (length - 1)
        means.append(float(covariance.mean()))
        slopes.append(float(x @ covariance @ x / (x @ x)) / length)
    # The mean, and the slopes along x and y.
    return 1.0 - means[0] * means[1] - slopes[0] * means[1] - means[0] * slopes[1]


def _find_usual_gain(common: Array, structure: Array, by_noise: Array, chance: Array) -> float:
    """The gain of the median tile, from products (rows, cols) of reference and image and the squares of the reference
    without those ``by_noise``, of which ``chance`` is a standard deviation. That of all tiles together where few are
    sure, and 0 where noise hides it.
    """
    # Of tiles that barely stand out, those are chosen whose noise adds to their structure.
    rich = structure > RICH_SIGMAS * chance
    ratios = common[rich] / structure[rich]
    ratios = ratios[ratios > GAIN_MIN]
    if len(ratios) >= TELLING_TILES_MIN:
        return median(ratios)
    if np.sum(structure) < STRUCTURE_MIN * np.sum(by_noise):
        return 0.0
    return float(np.sum(common) / np.sum(structure))


def _compare_with_foretold(
    tiles: _Tiles, side: tuple[int, int], agrees: Mask, image: Array, reference: Array
) -> float:
    """What one gain and one plane of brightness leave over what is left by those that the tiles around each one
    foretell; 0 where too few tiles lie amid others. What changes from tile to tile cannot be foretold.

    ``image`` and ``reference`` (rows, cols, 3) are the planes over tiles, in orthonormal terms.
    """
    amid = cv2.erode(
        agrees.astype(np.uint8),
        np.ones((3, 3), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0.0,
    )
    inner = amid > 0
    if np.count_nonzero(inner) < TELLING_TILES_MIN:
        return 0.0
    image, reference = (_without_plane(part, inner, side) for part in (image, reference))
    common = float(np.sum((tiles.common + np.sum(image * reference, axis=-1))[inner]))
    squares = float(np.sum((tiles.reference + np.sum(reference**2, axis=-1))[inner]))
    # With its noise, the gain would leave a part of a coarse structure, which neighbours foretell.
    structure = squares - tiles.noise.reference * float(np.sum(tiles.pixels[inner]))
    usual = common / max(structure, 0.1 * squares)
    rest = image - usual * reference
    foretold = _interpolate_planes(rest[..., :1] / np.sqrt(side[0] * side[1]), side)[..., 0, :]
    means = rest[..., 0]
    beside = [np.roll(means, by, axis) for axis in (0, 1) for by in (-1, 1)]
    foretold[..., 0] = np.mean(beside, axis=0)
    before = tiles.left(usual) + np.sum(rest**2, axis=-1)
    # With another gain on the whole, it would not be the light that leaves more or less.
    gain = tiles.pool_gain(agrees, _around() - _middle()) * usual / tiles.usual
    after = tiles.left(gain) + np.sum((rest - foretold) ** 2, axis=-1)
    return float(before[inner].sum()) / max(float(after[inner].sum()), 1e-30)


def _without_plane(planes: Array, inner: Mask, side: tuple[int, int]) -> Array:
    """Planes over tiles (rows, cols, 3), in orthonormal terms, without the one over the field that fits the means of
    the ``inner`` tiles (rows, cols) best.
    """
    y, x = np.indices(inner.shape, dtype=np.float64)
    design, area = np.stack([np.ones(x.shape), x, y], axis=-1), np.sqrt(side[0] * side[1])
    terms = np.linalg.lstsq(design[inner], planes[inner, 0], rcond=None)[0]
    left = planes.copy()
    left[..., 0] -= design @ terms
    left[..., 1:] -= terms[1:] / area * _rise(side)
    return left


def _rise(side: tuple[int, int]) -> Array:
    """(2,) terms of a plane that rises along x and y by one from tile to tile."""
    lengths = np.array(side, dtype=np.float64)
    return np.asarray(np.sqrt(lengths.prod() * (1.0 - lengths**-2.0) / 12.0))


def _interpolate_planes(means: Array, side: tuple[int, int]) -> Array:
    """(rows, cols, k, 3) terms of planes over tiles, of what is interpolated between the means (rows, cols, k) of
    tiles and keeps them.
    """
    padded = np.pad(means, [(1, 1), (1, 1), (0, 0)], mode="edge")
    middle = padded[1:-1, 1:-1]
    left, right, above, below = (
        padded[1:-1, :-2],
        padded[1:-1, 2:],
        padded[:-2, 1:-1],
        padded[2:, 1:-1],
    )
    slopes = 0.5 * np.stack([right - left, below - above], axis=-1) * _rise(side)
    area = np.sqrt(side[0] * side[1])
    return np.concatenate([area * middle[..., None], slopes], axis=-1)


def _find_gains(tiles: _Tiles, free: Array, whole: Mask) -> tuple[Array, Mask]:
    """(rows, cols) gain of each tile and those around, and the largest body of ``whole`` tiles (rows, cols) that agree
    but for their light. ``free`` (rows, cols) pixels' noise is left beside planes.
    """
    noise, seen = tiles.noise, _may_be_seen(tiles, whole)
    agrees = seen
    for _ in range(2):
        gain = tiles.pool_gain(agrees, _around())
        expected = gain**2 * np.maximum(tiles.structure, 0.0)
        floor = gain**2 * noise.reference + noise.image
        scatter = np.sqrt(tiles.shared * (tiles.pixels * floor**2 + 2.0 * expected * floor))
        chance = AGREEMENT_SIGMAS * scatter
        # Where it is bright, electrons scatter more than where the noise was measured.
        agrees = tiles.left(gain) < BESIDES_MAX * expected + 2.0 * free * floor + chance
        agrees &= seen & (expected - gain * tiles.common < MISSING_MAX * expected + chance)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(
        agrees.astype(np.uint8), connectivity=4
    )
    if len(statistics) > 1:
        agrees = np.asarray(labels == 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA])))
    return gain, agrees


def _may_be_seen(tiles: _Tiles, whole: Mask) -> Mask:
    """Those of the ``whole`` tiles (rows, cols) where the specimen may be seen: what covers it has nothing in common
    with it.
    """
    seen = whole
    for weights in (_middle(), np.ones((3, 3))):
        more = _pool(tiles.common - tiles.least * tiles.structure, weights)
        seen = seen & (more > -COVERED_SIGMAS * np.sqrt(_pool(tiles.scatter2, weights)))
    return seen


def _is_seen_everywhere(tiles: _Tiles, agrees: Mask, offset: Array) -> bool:
    """Whether the specimen is surely seen wherever tiles agree. Those of one brightness tell it together: a tile of
    little structure does not.

    ``offset`` (rows, cols) is the brightness that the usual gain leaves.
    """
    values = np.stack([tiles.common, tiles.structure, tiles.scatter2])[:, agrees]
    by_brightness = values[:, np.argsort(offset[agrees])]
    for group in np.array_split(by_brightness, LIGHT_GROUPS, axis=1):
        common, structure, scatter2 = group.sum(axis=1)
        if common <= max(tiles.least * structure, COVERED_SIGMAS * np.sqrt(scatter2)):
            return False
    return True


def _around() -> Array:
    """(3, 3) binomial weights of a tile and those around, one in the middle."""
    return np.outer([0.5, 1.0, 0.5], [0.5, 1.0, 0.5])


def _middle() -> Array:
    """(3, 3) weights of a tile alone."""
    return np.diag([0.0, 1.0, 0.0])


def _pool(values: Array, weights: Array) -> Array:
    """Sums over each tile and those around, with weights (3, 3)."""
    return np.asarray(cv2.filter2D(values, -1, weights, borderType=cv2.BORDER_CONSTANT))


def _fill(values: Array, known: Mask) -> Array:
    """Values (rows, cols), from around where they are not known."""
    filled, weight = np.where(known, values, 0.0), known.astype(np.float64)
    while not np.all(weight > 0.0):
        around = _pool(weight, _around())
        reached = (weight <= 0.0) & (around > 0.0)
        mean = _pool(filled * weight, _around()) / np.maximum(around, 1e-30)
        filled = np.where(reached, mean, filled)
        weight = np.where(reached, 1.0, weight)
    return filled
