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

"""Which tiles of an image agree with a shift: what moves otherwise, or came in, is found and left out.

A tool over a specimen covers its structure and brings edges of its own. A tile agrees where the image shows as much of
the reference's structure as the gain says, little else, and no shift of its own. What a tile counts follows from its
gradients over their noise: ground without structure neither helps nor disagrees.

It fails where what moves has no structure and covers none, and where its structure looks like that of the specimen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Mask, median, quantile
from semcal_ros.core.registration.fixed_pixels import grow_mask
from semcal_ros.core.registration.fractional_delay import gradients
from semcal_ros.core.registration.inverse_compositional import TileStatistics
from semcal_ros.core.registration.noise_spectrum import passed_variance, shared_pixels, smooth
from semcal_ros.core.registration.odd_bodies import OddBodies, bodies_at_edges, find_odd_bodies
from semcal_ros.core.registration.thresholds import (
    AGREEMENT_SIGMAS,
    APART_MIN,
    BESIDES_MAX,
    BEST_TILES,
    BODY_TILES_MIN,
    CHANGE_PRECISION,
    COMPLETE_SHARE_MIN,
    COVERED_SIGMAS,
    DISAGREEING_MAX,
    GAIN_MIN,
    GAIN_RATIO_MAX,
    MISSING_MAX,
    MOVING_TILES_MIN,
    SHOWN_TILE_PX,
    STILL_SHIFT_PX_MIN,
    STILL_SIGMAS,
    STRETCH_PX_MAX,
    SUSPECT_SIGMAS,
    TELLING_SIGMA_PX_MAX,
    TELLING_TILES_MIN,
    TILE_SHIFT_PX_MAX,
)
from semcal_ros.core.registration.tiles import PyramidLevel, band_of


@dataclass(frozen=True)
class TileNoise:
    """Noise of a reference and of an image after smoothing, per pixel.

    Attributes
    ----------
    reference, image
        Variances in squared grey levels.
    gradient
        What a variance of one before smoothing gives in squares of a gradient along one axis.
    passed
        What smoothing leaves of a variance.
    """

    reference: float
    image: float
    gradient: float
    passed: float

    @classmethod
    def of(cls, sigma_px: float, reference: float, image: float) -> TileNoise:
        """From variances of white noise before smoothing by ``sigma_px``."""
        passed, gradient = _pass_noise(sigma_px)
        return cls(reference * passed, image * passed, gradient, passed)


@lru_cache(maxsize=16)
def _pass_noise(sigma_px: float) -> tuple[float, float]:
    """What smoothing leaves of the variance of white noise, and the square of a gradient along one axis."""
    impulse = np.zeros((65, 65), dtype=np.float32)
    impulse[32, 32] = 1.0
    slope = gradients(smooth(impulse, sigma_px), band_of(sigma_px))[0]
    return passed_variance(sigma_px), float(np.sum(slope**2))


@dataclass(frozen=True)
class Agreement:
    """Tiles that agree with a shift.

    Attributes
    ----------
    weights
        (rows, cols) 0 to 1 of the tiles that were compared: how much of their gradients is structure and not noise, and
        0 where they disagree.
    disagrees
        (rows, cols) the tiles that show something else.
    share
        Part of the compared tiles with structure that agrees.
    pull
        Part of all gradients that does not, and would pull the shift.
    informs
        (rows, cols) 0 to 1: what of the gradients of each tile is structure, whether it agrees or not.
    odd
        Bodies that only differ from all others, or may be the specimen as well as what agrees.
    """

    weights: Array
    disagrees: Mask
    share: float
    pull: float
    informs: Array
    odd: OddBodies

    @property
    def is_complete(self) -> bool:
        """Whether all of the image agrees: no body disagrees, even where the ground has no structure."""
        most = self.share > COMPLETE_SHARE_MIN and self.pull < 1.0 - COMPLETE_SHARE_MIN
        most = most and not self.odd.in_doubt
        return most and not np.any(keep_bodies(self.disagrees, BODY_TILES_MIN))

    @property
    def are_bodies(self) -> bool:
        """Whether the tiles that disagree lie together; scattered ones say that the images differ everywhere."""
        tiles = int(np.count_nonzero(self.disagrees))
        if tiles <= DISAGREEING_MAX * self.disagrees.size:
            return True
        _, _, statistics, _ = cv2.connectedComponentsWithStats(
            self.disagrees.astype(np.uint8), connectivity=4
        )
        areas = statistics[1:, cv2.CC_STAT_AREA]
        return bool(areas[areas >= BODY_TILES_MIN].sum() > 0.6 * tiles)


def information_weights(level: PyramidLevel, noise: TileNoise) -> Array:
    """(rows, cols) 0 to 1: what of the gradients of the tiles of a reference is structure and not noise.

    A tile next to a better one counts as much: structure that is cut by the edge of what counts pulls the shift.
    """
    gradient, shows = level.normal_matrices[..., :2, :2], level.shows_structure
    return _measure_structure(gradient, level.pixel_counts, level.sigma_px, noise, shows)[1]


def _measure_structure(
    gradient: Array, pixels: Array, sigma_px: float, noise: TileNoise, shows: Mask | None
) -> tuple[Array, Array]:
    """(rows, cols) 0 to 1 each: what of the gradients of each tile for itself is structure, 0 where it neither
    ``shows`` any nor has more of a gradient than noise; and what it counts as.

    A tile next to a better one counts as much. Where no tile for itself has most of the structure, but all together do,
    each counts as what they have in the mean.
    """
    energy = gradient[..., 0, 0] + gradient[..., 1, 1]
    expected = 2.0 * pixels * noise.gradient * noise.reference / max(noise.passed, 1e-12)
    # Smoothed noise has fewer independent pixels.
    scatter = expected * np.sqrt(shared_pixels(sigma_px) / pixels)
    excess = energy - expected
    is_structure = excess > AGREEMENT_SIGMAS * scatter
    if shows is not None:
        is_structure = is_structure | shows
    signal = np.where(is_structure, np.maximum(excess, 0.0), 0.0)
    own = np.asarray(signal / np.maximum(signal + expected, 1e-30))
    weights: Array = np.asarray(cv2.dilate(own, np.ones((3, 3), np.uint8)), dtype=np.float64)
    faint = ~is_structure
    rest = float(excess[faint].sum())
    by_chance = AGREEMENT_SIGMAS * float(np.sqrt(np.sum(scatter[faint] ** 2)))
    if shows is None and rest > max(by_chance, float(signal.sum())):
        weights = np.maximum(weights, rest / (rest + float(expected[faint].sum())))
    return own, weights


def find_agreement(
    tiles: TileStatistics,
    noise: TileNoise,
    suspected: Mask | None = None,
    stretch_px: float = 0.0,
    odd: Mask | None = None,
    *,
    looks_for_odd: bool = True,
) -> Agreement:
    """Which tiles agree with the shift at which they were compared.

    ``suspected`` (rows, cols) are those where something moved otherwise in the image before. ``stretch_px`` is by how
    much another scale may move the edges against the middle. ``odd`` (rows, cols) are the tiles of odd bodies at the
    shift before, if those are looked for.
    """
    shared, count = shared_pixels(tiles.sigma_px), tiles.pixels
    shows = tiles.shows_structure
    own, weights = _measure_structure(tiles.gradient, count, tiles.sigma_px, noise, shows)
    gain = _bound_gain(tiles, noise, weights)
    raw = tiles.image - 2.0 * gain * tiles.common + gain**2 * tiles.reference
    # Interpolation hides noise from where it is measured; what the best tiles leave is noise, too.
    # A tile of which little counts may leave anything.
    whole = count >= 0.5 * float(np.max(count))
    least = quantile((raw / count)[whole], BEST_TILES)
    floor = gain**2 * noise.reference + noise.image
    hidden = max(1.0, least / max(median(floor), 1e-30))
    floor = hidden * floor
    structure = gain**2 * np.maximum(tiles.reference - count * hidden * noise.reference, 0.0)
    # Scatter of sums of products of smoothed noise.
    scatter = np.sqrt(shared * (count * floor**2 + 2.0 * structure * floor))
    missing = structure - gain * tiles.common
    lack = missing - MISSING_MAX * structure
    lacks = lack > AGREEMENT_SIGMAS * scatter
    left = raw - count * floor
    # Where it is bright, electrons scatter more than where the noise was measured: twice as much is nothing.
    exceeds = (
        left > BESIDES_MAX * structure + count * floor + AGREEMENT_SIGMAS * np.sqrt(2.0) * scatter
    )
    disagrees = lacks | exceeds
    louder = replace(noise, reference=hidden * noise.reference, image=hidden * noise.image)
    disagrees = disagrees | _find_covered(tiles, louder, shared, median(gain))
    disagrees = disagrees | _moves(
        tiles, weights, louder, shared, ~disagrees, suspected, stretch_px
    )
    found = _find_odd(
        tiles,
        own,
        disagrees,
        suspected,
        louder,
        shared,
        odd,
        (lack, scatter),
        looks_for_odd=looks_for_odd,
    )
    disagrees = disagrees | found.tiles
    # By area: a bright tool has more of a gradient than all of the ground.
    share = float(weights[~disagrees].sum() / max(weights.sum(), 1e-30))
    # What is inside of a body moves with it, also where it shows nothing; its edge may run through the tiles around.
    body = fill_bodies(keep_bodies(disagrees, BODY_TILES_MIN))
    left_out = disagrees | (cv2.dilate(body.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    energy = weights * (tiles.gradient[..., 0, 0] + tiles.gradient[..., 1, 1])
    pull = float(energy[disagrees].sum() / max(energy.sum(), 1e-30))
    return Agreement(np.where(left_out, 0.0, weights), disagrees, share, pull, weights, found)


def _find_covered(tiles: TileStatistics, noise: TileNoise, shared: float, usual: float) -> Mask:
    """The tiles of bodies that are brighter or darker than the rest, and where the specimen is missing.

    ``usual`` is the gain of most tiles. That of the specimen is the one of the class that shows it: what covers it has
    none of its own.
    """
    found = SpecimenSeen(
        tiles.offset,
        tiles.reference - tiles.pixels * noise.reference,
        tiles.common,
        tiles.pixels,
        noise,
        shared,
        usual,
    )
    least = (1.0 - MISSING_MAX) * found.find_gain()
    return found.find_missing(least, least) if least > 0.0 else np.zeros_like(found.bright)


@dataclass(frozen=True)
class SpecimenSeen:
    """What tiles show of a specimen, in two classes by their brightness.

    Attributes
    ----------
    offset
        (rows, cols) by how much the image is brighter than its gain says.
    structure, common
        (rows, cols) squares of the reference without its noise, and its products with the image.
    pixels
        (rows, cols) number of pixels of each tile that count.
    noise, shared
        That of a pixel, which so many pixels have in common.
    usual
        The gain of most of the image.
    """

    offset: Array
    structure: Array
    common: Array
    pixels: Array
    noise: TileNoise
    shared: float
    usual: float

    @cached_property
    def _counts(self) -> Mask:
        """The tiles of which most is compared: the others have no brightness of their own."""
        return np.asarray(self.pixels >= 0.5 * np.max(self.pixels))

    @cached_property
    def bright(self) -> Mask:
        """The tiles of the brighter one of two classes (Otsu 1979, doi:10.1109/TSMC.1979.4310076)."""
        offset = self.offset[self._counts]
        least, most = float(offset.min()), float(offset.max())
        levels = np.rint((offset - least) * (255.0 / max(most - least, 1e-30))).astype(np.uint8)
        limit, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
        bright = np.zeros(self.offset.shape, dtype=bool)
        bright[self._counts] = levels > limit
        return bright

    @property
    def _classes(self) -> tuple[Mask, Mask]:
        return self.bright, self._counts & ~self.bright

    @cached_property
    def apart(self) -> float:
        """By how many of their standard deviations the two classes differ."""
        parts = [self.offset[part] for part in self._classes]
        if min(len(part) for part in parts) == 0:
            return 0.0
        count = sum(len(part) for part in parts)
        within = sum(float(part.var()) * len(part) for part in parts) / count
        # Where nothing scatters, the noise of the means is what is left.
        noise = self.noise.image + self.usual**2 * self.noise.reference
        within += self.shared * noise / float(np.max(self.pixels))
        return float(parts[0].mean() - parts[1].mean()) / max(float(np.sqrt(within)), 1e-30)

    def variance(self, least: float) -> Array:
        """(rows, cols) variance of the products less ``least`` times the structure."""
        reference, image = self.noise.reference, self.noise.image
        by_noise = self.pixels * reference * (image + 2.0 * least**2 * reference)
        seen = np.maximum(self.structure, 0.0) * (image + self.usual**2 * reference)
        return np.asarray(self.shared * (by_noise + seen))

    def find_gain(self) -> float:
        """The gain of the class that shows the specimen more surely; 0 where neither does."""
        gain, most, variance = 0.0, AGREEMENT_SIGMAS, self.variance(0.0)
        for part in self._classes:
            common = float(self.common[part].sum())
            sigmas = common / max(float(np.sqrt(variance[part].sum())), 1e-30)
            if sigmas > most:
                # What is left of a structure without its noise is known to the chance of that.
                pixels = float(self.pixels[part].sum())
                chance = np.sqrt(2.0 * self.shared * pixels) * self.noise.reference
                least = max(AGREEMENT_SIGMAS * float(chance), 1e-30)
                gain, most = common / max(float(self.structure[part].sum()), least), sigmas
        return gain

    def find_missing(self, bright: float, dark: float) -> Mask:
        """The tiles of bodies of one class each where the specimen is missing.

        The tiles of a body together show less of it, by 4.5 sigmas, than a gain of ``bright`` or ``dark``, and are
        nearer to none: no tile for itself tells that of a faint specimen. Where the classes differ as those of a body
        and the ground do, what does not surely show the specimen is missing, too: it would tell next to nothing.
        """
        missing = np.zeros(self.offset.shape, dtype=bool)
        seen, ones = self.variance(0.0), np.ones(self.offset.shape)
        for part, least in zip(self._classes, (bright, dark), strict=True):
            number, labels = cv2.connectedComponents(part.astype(np.uint8), connectivity=4)
            size, structure, common, by_chance, variance = (
                np.bincount(labels.ravel(), values.ravel(), number)
                for values in (ones, self.structure, self.common, seen, self.variance(least))
            )
            lack = least * structure - common
            bodies = (lack > AGREEMENT_SIGMAS * np.sqrt(variance)) & (lack > common)
            if self.apart > APART_MIN:
                bodies |= common < COVERED_SIGMAS * np.sqrt(by_chance)
            bodies &= size >= BODY_TILES_MIN
            missing |= part & bodies[labels]
        return missing


def _find_odd(
    tiles: TileStatistics,
    own: Array,
    disagrees: Mask,
    suspected: Mask | None,
    noise: TileNoise,
    shared: float,
    before: Mask | None,
    lack: tuple[Array, Array],
    *,
    looks_for_odd: bool,
) -> OddBodies:
    """The bodies that move otherwise than all others, of those whose gradients have a share ``own`` (rows, cols) of
    structure and which do not disagree already.

    ``lack`` (rows, cols) is by how much tiles miss more of their structure than they may, and its sigma.
    """
    structure, gain = own > 0.0, np.maximum(tiles.gain, 1e-6)
    informs, lost = structure & ~disagrees, structure & disagrees
    if np.any(informs):
        # What is not seen has no gain of its own.
        gain = np.where(lost, median(gain[informs]), gain)
    left = shared * (gain**2 * noise.reference + noise.image)
    information, variances = (by[..., None, None] * tiles.gradient for by in (own * gain, left))
    if suspected is not None:
        # What a tool covers has not moved.
        lost &= ~grow_mask(bodies_at_edges(suspected), 1)
    return find_odd_bodies(
        informs,
        information,
        -tiles.scores,
        variances,
        before,
        lost=lost,
        lack=lack,
        looks_for_odd=looks_for_odd,
    )


def keep_bodies(disagrees: Mask, least: int) -> Mask:
    """The tiles that lie together in bodies of at least so many; one alone is chance, or a particle that blinks."""
    if not np.any(disagrees):
        return np.zeros_like(disagrees)
    found = disagrees.view(np.uint8)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(found, connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] >= least
    return np.asarray(disagrees & large[labels])


def _bound_gain(tiles: TileStatistics, noise: TileNoise, weights: Array) -> Array:
    """The gain, within a factor of that of the median tile: what came in must not say how bright the specimen is."""
    known = tiles.reference - tiles.pixels * noise.reference
    telling = (weights > 0.0) & (known > tiles.pixels * noise.reference)
    gain = np.maximum(tiles.gain, 0.0)
    ratios = tiles.common[telling] / known[telling]
    # What came in has nothing in common with what it covers.
    ratios = ratios[ratios > GAIN_MIN]
    if len(ratios) < TELLING_TILES_MIN:
        return gain
    middle = median(ratios)
    return np.clip(gain, middle / GAIN_RATIO_MAX, middle * GAIN_RATIO_MAX)


def fill_bodies(found: Mask, gap: int = 3) -> Mask:
    """A mask (h, w) without holes: none between parts less than ``gap`` apart, and none that they enclose."""
    if not np.any(found):
        return np.zeros_like(found)
    # A body may come in over the edge: what it encloses with the edge is inside, too.
    rows, cols = found.shape
    edge = gap // 2 + 1
    padded = np.zeros((rows + 2 * edge, cols + 2 * edge), dtype=np.uint8)
    padded[edge : edge + rows, edge : edge + cols] = found
    joined = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((gap, gap), np.uint8))
    contours, _ = cv2.findContours(joined, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    drawn = cv2.drawContours(np.zeros_like(joined), contours, -1, 1, cv2.FILLED)
    return np.asarray(drawn[edge : edge + rows, edge : edge + cols] > 0)


def _moves(
    tiles: TileStatistics,
    weights: Array,
    noise: TileNoise,
    shared: float,
    counts: Mask,
    suspected: Mask | None,
    stretch_px: float,
) -> Mask:
    """The tiles with a shift of their own, beyond one that changes in proportion over the field.

    How it changes is told by what is not ``suspected``: a slow tool at an edge would be taken for a part of the change.
    """
    gain = np.maximum(tiles.gain, 1e-6)
    # Structure along both axes, by what of the gradient is none of the noise.
    energy = weights[..., None] * np.einsum("rcii->rci", tiles.gradient) * gain[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        own = -tiles.scores / energy
        variance = (
            shared
            * (gain**2 * noise.reference + noise.image)[..., None]
            / (energy * gain[..., None])
        )
    telling = (variance < TELLING_SIGMA_PX_MAX**2) & counts[..., None]
    rows, cols = weights.shape
    is_suspected = suspected is not None and bool(np.any(suspected))
    if not is_suspected and not np.any(
        np.abs(own[telling]) > TILE_SHIFT_PX_MAX + SUSPECT_SIGMAS * np.sqrt(variance[telling])
    ):
        # Nearly always: no tile is off at all.
        return np.zeros((rows, cols), dtype=bool)
    terms_of_tiles = _make_terms(rows, cols)
    found = np.zeros((rows, cols), dtype=bool)
    shifts, precisions = np.zeros((2, rows, cols)), np.zeros((2, rows, cols))
    for axis in (0, 1):
        known = telling[..., axis]
        if np.count_nonzero(known) < TELLING_TILES_MIN:
            continue
        design = terms_of_tiles[known]
        value, sigma = own[..., axis][known], np.sqrt(variance[..., axis][known])
        fitted = np.ones(len(value), dtype=bool)
        if suspected is not None and np.count_nonzero(known & ~suspected) >= TELLING_TILES_MIN:
            fitted = ~suspected[known]
        # What the ground leaves of a line; a bright edge is surer of itself than all the ground.
        spread = np.hypot(sigma, TILE_SHIFT_PX_MAX)
        terms, before = np.array([median(value[fitted]), 0.0, 0.0]), None
        for _ in range(3):
            left = np.abs(value - design @ terms)
            good = fitted & (left <= 3.0 * max(median(left[fitted]), TILE_SHIFT_PX_MAX))
            if before is not None and np.array_equal(good, before):
                break
            before = good
            scaled = design * (good / spread**2)[:, None]
            inverse = np.linalg.inv(scaled.T @ design + CHANGE_PRECISION * np.eye(3))
            terms = inverse @ (scaled.T @ value)
        value = _without_rows(value - design @ terms, known)
        left = np.abs(value)
        scatter = max(1.0, 1.4826 * median(left / sigma))
        uncertain = scatter * np.sqrt(float(inverse[1, 1]))
        allowed = STRETCH_PX_MAX + stretch_px * (axis == 0)
        if abs(float(terms[1])) > allowed + AGREEMENT_SIGMAS * uncertain:
            # What changes along a row is no drift: the specimen is strained or turned, and no part of it is a tool.
            return np.ones_like(found)
        found[known] |= left > TILE_SHIFT_PX_MAX + AGREEMENT_SIGMAS * sigma
        # What is too little in one tile its neighbours tell, if they move alike.
        precision, signed = precisions[axis], shifts[axis]
        precision[known], signed[known] = sigma**-2.0, value
        total = cv2.blur(precision, (3, 3), borderType=cv2.BORDER_CONSTANT)
        mean = cv2.blur(precision * signed, (3, 3), borderType=cv2.BORDER_CONSTANT)
        mean = mean / np.maximum(total, 1e-30)
        together = 1.0 / np.sqrt(np.maximum(9.0 * total, 1e-30))
        alike = np.sign(signed) == np.sign(mean)
        found |= known & alike & (np.abs(mean) > TILE_SHIFT_PX_MAX + AGREEMENT_SIGMAS * together)
    if suspected is not None and is_suspected:
        found |= _still_move(suspected & counts, shifts, precisions)
    return found


@lru_cache(maxsize=32)
def _make_terms(rows: int, cols: int) -> Array:
    """(rows, cols, 3) one, x and y of the tiles, from -1 to 1."""
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij")
    return np.stack([np.ones_like(x), x, y], axis=-1)


def _still_move(suspected: Mask, shifts: Array, precisions: Array) -> Mask:
    """The suspected tiles that still have a shift of their own: those of (2, rows, cols) ``shifts`` with ``precisions``
    that are nearer to the mean of their body than to none, where that mean is one.
    """
    _, labels = cv2.connectedComponents(suspected.astype(np.uint8), connectivity=8)
    count = int(labels.max()) + 1
    found = np.zeros(suspected.shape, dtype=bool)
    by_mean, of_mean = np.zeros(suspected.shape), np.zeros(suspected.shape)
    for shift, precision in zip(shifts, precisions, strict=True):
        total = np.bincount(labels.ravel(), precision.ravel(), count)
        weighted = np.bincount(labels.ravel(), (precision * shift).ravel(), count)
        mean = np.asarray(weighted, dtype=np.float64) / np.maximum(total, 1e-30)
        is_shift = np.abs(mean) > STILL_SHIFT_PX_MIN + STILL_SIGMAS / np.sqrt(
            np.maximum(total, 1e-30)
        )
        found |= is_shift[labels]
        by_mean += precision * shift * mean[labels]
        of_mean += precision * mean[labels] ** 2
    return np.asarray(found & suspected & (by_mean > 0.5 * of_mean))


def _without_rows(values: Array, known: Mask) -> Array:
    """Shifts of the known tiles without what the tiles of a row share: lines of a scan jitter as a whole."""
    grid = np.full(known.shape, np.inf)
    grid[known] = values
    counts = np.count_nonzero(known, axis=1)
    enough = counts >= TELLING_TILES_MIN // 2
    # The median of what is known of each row, which sorts to its front: a tenth of the time of numpy.nanmedian.
    ordered, middle = np.sort(grid[enough], axis=1), counts[enough] // 2
    row = np.arange(len(ordered))
    middles = 0.5 * (ordered[row, middle - 1 + counts[enough] % 2] + ordered[row, middle])
    grid[enough] -= middles[:, None]
    return np.asarray(grid[known])


@dataclass(frozen=True)
class MovingTiles:
    """Where an image shows something that moves otherwise than the specimen.

    Attributes
    ----------
    tiles
        (rows, cols) True where it does.
    corner_px, side_px
        (2,) left and top of the first tile in the image, and width and height of a tile, px.
    share
        Part of the compared field.
    """

    tiles: Mask
    corner_px: Array
    side_px: Array
    share: float

    @classmethod
    def of(cls, disagrees: Mask, corner_px: Array, side_px: Array) -> MovingTiles:
        """From the tiles that disagree: a body has no holes, and is more than one tile."""
        filled = fill_bodies(keep_bodies(disagrees, MOVING_TILES_MIN))
        return cls(filled, corner_px, side_px, float(filled.mean()))

    @classmethod
    def of_pixels(cls, mask: Mask) -> MovingTiles:
        """From the pixels of an image (h, w), in tiles of 8 px of which one pixel is enough; the share is that of the
        pixels.
        """
        side = SHOWN_TILE_PX
        grown = np.pad(mask, [(0, -n % side) for n in mask.shape])
        rows, cols = (n // side for n in grown.shape)
        # Whole lines first, which lie together in memory: a tenth of the time of both axes at once.
        lines = grown.reshape(rows, side, -1).any(axis=1)
        tiles = np.asarray(lines.reshape(rows, cols, side).any(axis=2))
        return cls(tiles, np.zeros(2), np.full(2, float(side)), float(mask.mean()))

    def at(self, x: Array, y: Array) -> Mask:
        """(rows, cols) whether something moves at the places ``x`` (cols,) and ``y`` (rows,) of the image, px."""
        cols, rows = (
            np.floor((at - first) / side).astype(int)
            for at, first, side in zip((x, y), self.corner_px, self.side_px, strict=True)
        )
        height, width = self.tiles.shape
        # None moves beyond the tiles.
        padded = np.pad(self.tiles, 1)
        rows, cols = np.clip(rows + 1, 0, height + 1), np.clip(cols + 1, 0, width + 1)
        return np.asarray(padded.take(rows, axis=0).take(cols, axis=1))

    def draw(
        self,
        size: tuple[int, int],
        *,
        moved_px: Array | None = None,
        scale: float = 1.0,
        zoom: float = 1.0,
    ) -> NDArray[np.uint8]:
        """(height, width) image of (width, height): 255 where something moves.

        The tiles are moved by ``moved_px`` (2,), then seen ``zoom`` times as large from the middle of the image, before
        that is made larger by ``scale``.
        """
        moved = np.zeros(2) if moved_px is None else moved_px
        places = []
        for count, by in zip(size, moved, strict=True):
            # Tiles are counted from the corner of the first pixel.
            seen, middle = (np.arange(count) + 0.5) / scale, 0.5 * count / scale
            places.append(middle + (seen - middle) / zoom - by)
        x, y = places
        return np.asarray(self.at(x, y).view(np.uint8) * np.uint8(255))

    def grown(self) -> MovingTiles:
        """The same with all tiles around."""
        tiles = cv2.dilate(np.pad(self.tiles, 1).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        return replace(self, tiles=tiles, corner_px=self.corner_px - self.side_px)
