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

"""Drift within scans, from scans of one place with the raster turned by 90 degrees.

A specimen that drifts displaces the lines of a scan against each other: the displacement is a function of the slow
axis alone. In a second scan whose raster is turned by 90 degrees the slow axis is the other one. With ``r`` the row
and ``c`` the column of the specimen, the second scan is therefore displaced against the first by

    m(r, c) = d_2(c) - d_1(r),

which separates into the two functions but for a constant. Nothing is assumed of the drift but that it is smooth:
neither a constant velocity, nor the frame time, nor that the drift goes on between the scans as it was. The idea is
that of Ophus, Ciston and Nelson (2016), "Correcting nonlinear drift distortion of scanning probe and scanning
transmission electron microscopies from image pairs with orthogonal scan directions",
doi:10.1016/j.ultramic.2015.12.002, who move each line until the images agree. Here tiles of the images
are searched for in each other, and least squares over all pixels then give both functions at once.

It fails, and says so, where most tiles have too little structure; where some have, the uncertainty is large. On a
lattice, it cannot tell whether a scan was turned at all. It cannot tell from drift what is the same function of
the slow axes: an angle between the scans that is not 90 degrees (one degree is a drift by 1.7 % of the width during
each scan), and a raster whose sides differ (without a calibration). It does not see what changes between neighbouring
lines, such as jitter: the functions are cubic splines with a knot every 48 lines, 32 at most.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates, minimum_filter, spline_filter

from semcal_ros.core.arrays import (
    AnyImage,
    Array,
    Array32,
    Indices,
    Mask,
    check_image,
    invert_scaled,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.thresholds import (
    BEND_PX,
    COARSE_SIGMA_PX,
    COMMON_SLOPE_MIN,
    COMPARED_TILE_PX,
    DISPLACED_LINES_MAX,
    FAR_MEDIANS,
    FREEDOM_MIN,
    INTERPOLATED_PX,
    KNOT_PX,
    KNOTS_MAX,
    LINE_STEPS,
    PERIODIC_PEAK_MIN,
    ROUNDS_FREE,
    ROUNDS_MAX,
    SAME_PLACE_PX,
    SEARCHED_TILE_PX,
    SETTLED_SIGMAS,
    SPARSE_PX,
    STILL_PX,
    TILE_RIM_PX,
    TILE_VARIANCE_MIN,
    TILES_SMOOTHED_PX,
    ZERO_SIGMA_PX,
)
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.rectification.stack import Stack, StackedImage, find_scanned
from semcal_ros.core.registration.normalised_correlation import (
    CoarseReference,
    find_coarse_peaks,
)
from semcal_ros.core.registration.reference import Region, RegistrationSettings
from semcal_ros.core.registration.register import register_pair
from semcal_ros.core.registration.tiles import Pyramid
from semcal_ros.core.wording import counted

# Three rows of tiles; with fewer, there is no function of the slow axis.
_LEAST_SIDE_PX = 3 * SEARCHED_TILE_PX
_OTHER_SENSE = "try the other sense of rotation, -90 instead of 90 or the reverse"
_WHY_NOT = (
    "look whether both scans show one place, are turned by 90 degrees in the sense that is said,"
    " and are no lattice"
)


#: A tile: the two scans that are compared, and its top and left, px.
_Place = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class TurnedScan:
    """One scan.

    Attributes
    ----------
    image
        (h, w) grey levels as they were scanned: the rows are the lines.
    quarter_turns
        Scan rotation in units of 90 degrees. A positive one turns the specimen in the image from +x towards +y.
    camera
        Camera of the image, or None for raw pixels.
    mask
        (h, w) true where the image may be used, or None for all of it. Pixels that are no number never are.
    """

    image: AnyImage
    quarter_turns: int
    camera: ScanCamera | None = None
    mask: Mask | None = None


@dataclass(frozen=True, eq=False)
class ScanPairDrift:
    """Drift during n scans, each at k knots along its slow axis.

    All displacements are in the square that all scans show, turned as with no scan rotation; positive ones move the
    specimen towards +x and +y. Their zero is the mean over the first scan.

    Attributes
    ----------
    progress
        (k,) knots, as the part of the scan's lines that came before. Displacements are cubic splines through them.
    displacement_px
        (n, k, 2) displacement of the specimen.
    covariance_px2
        (n, k, 2, n, k, 2) its covariance, from the scatter of the tiles.
    tiles
        Number of tiles that were compared.
    """

    progress: Array
    displacement_px: Array
    covariance_px2: Array
    tiles: int

    @property
    def sigma_px(self) -> Array:
        """(n, k, 2) 1-sigma of the displacements."""
        size = self.displacement_px.size
        variances = np.diagonal(self.covariance_px2.reshape(size, size))
        return np.sqrt(variances).reshape(self.displacement_px.shape)

    def at(self, scan: int, progress: Array) -> Array:
        """Return the displacements (..., 2) of a scan at parts of its lines (...)."""
        return np.asarray(CubicSpline(self.progress, self.displacement_px[scan])(progress))


def measure_scan_pairs(scans: Sequence[TurnedScan]) -> ScanPairDrift:
    """Measure the drift during scans of one place with turned rasters.

    Parameters
    ----------
    scans
        Two or more, of one size and magnification; some must be turned by an odd number of quarters against others.

    Returns
    -------
    ScanPairDrift
        The drift of each scan.

    Raises
    ------
    InvalidValueError
        If the images differ in size or are too small, no two of them are turned against each other, or they do not
        match.
    """
    rasters = _prepare(scans)
    side = rasters[0].map_x.shape[0]
    if side < _LEAST_SIDE_PX:
        raise InvalidValueError(
            f"scans that share {side} x {side} px",
            expected=f"at least {_LEAST_SIDE_PX} px along each side",
        )
    pairs = [
        (i, j)
        for i, first in enumerate(scans)
        for j, second in enumerate(scans)
        if first.quarter_turns % 2 == 0 and second.quarter_turns % 2 == 1
    ]
    if len({index for pair in pairs for index in pair}) < len(scans):
        turns = ", ".join(f"{90 * (scan.quarter_turns % 4)}" for scan in scans)
        raise InvalidValueError(
            f"scans turned by {turns} degrees", expected="some that are turned by 90 against others"
        )
    # Of a tall frame, the square shows only the middle lines.
    lines = np.concatenate([raster.map_y.ravel() for raster in rasters]) / scans[0].image.shape[0]
    count = min(side // KNOT_PX, KNOTS_MAX)
    knots = lines.min() + (np.arange(count) + 0.5) / count * np.ptp(lines)
    drift = np.zeros((len(scans), count, 2))

    def warp() -> list[_Warped]:
        return [_warp(raster, knots, own) for raster, own in zip(rasters, drift, strict=True)]

    # The whole images first, to some pixels, since they are distorted; then tiles that are searched, near where they
    # should be; and least squares.
    warped = warp()
    for number in range(1, len(scans)):
        drift[number] = _measure_offset(warped[0], warped[number], number)
    drift = _search(warp(), pairs, knots, drift)
    allowed: set[_Place] | None = None
    for number in range(ROUNDS_MAX):
        found, compared = _refine(warp(), pairs, knots, drift, allowed)
        # A tile at the edge that came and went with each step would keep it from settling.
        if number >= ROUNDS_FREE:
            allowed = compared
        change = float(np.abs(found.displacement_px - drift).max())
        drift = found.displacement_px
        _check_speed(found, side)
        if change < STILL_PX:
            break
    if change > SETTLED_SIGMAS * float(found.sigma_px.max()) + STILL_PX:
        raise InvalidValueError(
            f"displacements that still change by {change:.2g} px after {ROUNDS_MAX} rounds",
            expected="scans with enough structure in all parts",
            do=_WHY_NOT,
        )
    _check(warp(), pairs)
    return found


def _check_speed(drift: ScanPairDrift, side: int) -> None:
    """Refuse a drift that no specimen has, and for which the lines would not be found."""
    lines = np.diff(drift.progress) * side / np.ptp(drift.progress)
    known = drift.sigma_px.max(axis=2) < BEND_PX
    speeds = np.abs(np.diff(drift.displacement_px, axis=1)).max(axis=2) / lines
    fastest = float(np.max(speeds, where=known[:, 1:] & known[:, :-1], initial=0.0))
    if fastest > DISPLACED_LINES_MAX:
        raise InvalidValueError(
            f"a drift by {fastest:.2g} px from line to line",
            expected=f"at most {DISPLACED_LINES_MAX:g} px",
            do=_WHY_NOT,
        )


def average_scans(scans: Sequence[TurnedScan], drift: ScanPairDrift) -> StackedImage:
    """Average scans without their drift: the square that all of them show, with no scan rotation.

    Parameters
    ----------
    scans, drift
        The scans, and what :func:`measure_scan_pairs` found of them.

    Returns
    -------
    StackedImage
        Mean, standard error, and number of scans in each pixel.
    """
    rasters = _prepare(scans)
    side = rasters[0].map_x.shape[0]
    stack = Stack((side, side))
    for raster, own in zip(rasters, drift.displacement_px, strict=True):
        warped = _warp(raster, drift.progress, own)
        stack.add(warped.image, warped.valid)
    return stack.result()


@dataclass(frozen=True, eq=False)
class _Raster:
    """A scan as (h, w) coefficients of a cubic spline, which of its pixels may be used, and where it shows each pixel
    of the common square: (s, s) raw columns and rows, each with its derivatives by row and column. ``offset`` (x, y) is
    what the middle of these maps lacks to that of the frame, 0 or 0.5 px.
    """

    coefficients: Array32
    usable: Mask
    map_x: Array32
    map_y: Array32
    slopes_x: tuple[Array32, Array32]
    slopes_y: tuple[Array32, Array32]
    offset: tuple[float, float]


@dataclass(frozen=True, eq=False)
class _Warped:
    """A scan in the common square without the drift known so far.

    ``image`` and ``valid`` are (s, s); ``progress`` is the part of the lines that came before each pixel.
    """

    image: Array32
    valid: Mask
    progress: Array32


def _prepare(scans: Sequence[TurnedScan]) -> list[_Raster]:
    if len(scans) < 2:
        raise InvalidValueError(f"{len(scans)} scan", expected="two or more")
    rectifier = Rectifier("cubic")
    rasters = []
    for number, scan in enumerate(scans, 1):
        image = check_image(scan.image)
        if image.ndim != 2 or image.shape != scans[0].image.shape:
            raise InvalidValueError(
                f"scan {number} of shape {image.shape}",
                expected=f"a grey image of shape {scans[0].image.shape[:2]}",
            )
        height, width = image.shape
        maps = rectifier.maps((width, height), scan.camera)
        # A raster turned by +90 degrees shows the specimen turned from +x towards +y, which numpy calls -1.
        x, y = (_middle_square(np.rot90(one, scan.quarter_turns)) for one in maps)
        usable = np.isfinite(image)
        if scan.mask is not None:
            usable &= scan.mask
        if not usable.any():
            raise InvalidValueError(f"scan {number} without a pixel that may be used")
        # The filter is recursive: one pixel that is no number would spoil all.
        grey = image.astype(np.float32)
        grey[~usable] = np.median(grey[usable])
        coefficients = spline_filter(grey, order=3, output=np.float32, mode="nearest")
        tall, wide = np.rot90(maps[0], scan.quarter_turns).shape
        rasters.append(
            _Raster(
                coefficients,
                _shrink(usable),
                x,
                y,
                _differentiate(x),
                _differentiate(y),
                (0.5 * ((wide - len(x)) % 2), 0.5 * ((tall - len(x)) % 2)),
            )
        )
    return rasters


def _shrink(usable: Mask) -> Mask:
    """Pixels whose neighbours, which an interpolation takes, may be used, too."""
    if usable.all():
        return usable
    side = 2 * (INTERPOLATED_PX + 1) + 1
    return np.asarray(minimum_filter(usable, size=side, mode="nearest"))


def _differentiate(values: Array32) -> tuple[Array32, Array32]:
    by_row, by_col = np.gradient(values)
    return np.asarray(by_row, dtype=np.float32), np.asarray(by_col, dtype=np.float32)


def _middle_square(values: Array32) -> Array32:
    height, width = values.shape
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return np.ascontiguousarray(values[top : top + side, left : left + side])


def _warp(raster: _Raster, knots: Array, displacement_px: Array) -> _Warped:
    """Resample a scan once, at the raw pixels where it shows the specimen without its drift."""
    height, width = raster.coefficients.shape
    side = raster.map_x.shape[0]
    rows, cols = np.indices((side, side), dtype=np.float32)
    x, y = raster.map_x, raster.map_y
    spline = CubicSpline(knots, displacement_px)
    for _ in range(LINE_STEPS if displacement_px.any() or any(raster.offset) else 0):
        moved = (spline(_progress(x, y, raster)) + raster.offset).astype(np.float32)
        at_x, at_y = cols + moved[..., 0], rows + moved[..., 1]
        x = _sample_map(raster.map_x, raster.slopes_x, at_x, at_y)
        y = _sample_map(raster.map_y, raster.slopes_y, at_x, at_y)
    # OpenCV rounds positions to 1/32 px, which is more than the displacements are known to.
    image = map_coordinates(raster.coefficients, [y, x], order=3, mode="nearest", prefilter=False)
    valid = find_scanned(x, y, (width, height), INTERPOLATED_PX)
    if not raster.usable.all():
        nearest = (
            np.clip(np.rint(at), 0, top - 1).astype(np.intp)
            for at, top in ((y, height), (x, width))
        )
        valid &= raster.usable[tuple(nearest)]
    return _Warped(image, valid, _progress(x, y, raster))


def _progress(x: Array32, y: Array32, raster: _Raster) -> Array32:
    """The part of the scan before raw pixels; the flyback, a fraction of one line, is not known here."""
    height, width = raster.coefficients.shape
    return np.asarray((y + x / width) / height, dtype=np.float32)


def _sample_map(
    values: Array32, slopes: tuple[Array32, Array32], at_x: Array32, at_y: Array32
) -> Array32:
    """A smooth map at places between and beyond its pixels, to first order."""
    last = values.shape[0] - 1
    x0 = np.clip(np.rint(at_x), 0, last).astype(np.intp)
    y0 = np.clip(np.rint(at_y), 0, last).astype(np.intp)
    by_row, by_col = (slope[y0, x0] for slope in slopes)
    return values[y0, x0] + by_col * (at_x - x0) + by_row * (at_y - y0)


def _find_valid_rectangle(valid: Mask) -> Region:
    """A rectangle of valid pixels, empty where there is none: edges are taken off where most is missing."""
    left, top, right, bottom = 0, 0, valid.shape[1], valid.shape[0]
    while right > left and bottom > top:
        part = ~valid[top:bottom, left:right]
        missing = part[:, 0].mean(), part[0].mean(), part[:, -1].mean(), part[-1].mean()
        if not part.any():
            return left, top, right, bottom
        edge = int(np.argmax(missing))
        left, top = left + (edge == 0), top + (edge == 1)
        right, bottom = right - (edge == 2), bottom - (edge == 3)
    return 0, 0, 0, 0


def _measure_offset(first: _Warped, other: _Warped, number: int) -> Array:
    """Offset (2,) of a whole scan from the first one to some pixels, without regard to how they are distorted."""
    cut = []
    for scan in (first, other):
        left, top, right, bottom = _find_valid_rectangle(scan.valid)
        cut.append((np.array([left, top], dtype=np.float64), scan.image[top:bottom, left:right]))
    reference = CoarseReference(Pyramid(cut[0][1]), RegistrationSettings().min_overlap)
    peaks = find_coarse_peaks(reference, Pyramid(cut[1][1]), cut[0][0] - cut[1][0])
    if not peaks:
        raise InvalidValueError(
            f"no shift at which scan {number + 1} shows what scan 1 does",
            expected="scans of one place that are turned by what is said",
            do=_OTHER_SENSE,
        )
    return np.array(peaks[0].shift_px) + cut[1][0] - cut[0][0]


@dataclass(frozen=True, eq=False)
class _Tiles:
    """What t tiles tell of the shift of their second scan against the first.

    ``information`` (t, 2, 2) is the matrix of their normal equations, ``right`` (t, 2) the right side; ``scans`` (t, 2)
    are the two, ``weights`` (t, 2, k) those of the knots of either in the mean over the tile, ``place`` (t,) numbers
    where in the square the tile lies.
    """

    information: Array
    right: Array
    scans: Indices
    weights: Array
    place: Indices

    def design(self, scans: int) -> Array:
        """(t, n k) the shift as a difference of displacements at knots."""
        count, _, knots = self.weights.shape
        design = np.zeros((count, scans, knots))
        numbers = np.arange(count)
        design[numbers, self.scans[:, 1]] += self.weights[:, 1]
        design[numbers, self.scans[:, 0]] -= self.weights[:, 0]
        return design.reshape(count, -1)


def _look_at_tiles(
    warped: Sequence[_Warped],
    pairs: Sequence[tuple[int, int]],
    side: int,
    knots: Array,
    look: Callable[[Array32, Array32], tuple[Array, Array] | None],
    allowed: set[_Place] | None = None,
) -> tuple[_Tiles, set[_Place]]:
    """Let ``look`` compare the tiles of all pairs, or of those that are allowed; what it gives are normal matrix and
    right side.

    Returns
    -------
    The tiles that could be compared, and which they are.
    """
    found = []
    # Weights of the knots: the spline through the unit vectors.
    weigh = CubicSpline(knots, np.eye(len(knots)))
    whole = warped[0].image.shape[0]
    edges = (whole % side) // 2 + side * np.arange(whole // side)
    for (i, j), top, left in itertools.product(pairs, edges.tolist(), edges.tolist()):
        if allowed is not None and (i, j, top, left) not in allowed:
            continue
        part = slice(top, top + side), slice(left, left + side)
        both = warped[i], warped[j]
        if not all(one.valid[part].all() for one in both):
            continue
        told = look(both[0].image[part], both[1].image[part])
        if told is None:
            continue
        sparse = tuple(slice(one.start + SPARSE_PX // 2, one.stop, SPARSE_PX) for one in part)
        means = [weigh(one.progress[sparse]).mean(axis=(0, 1)) for one in both]
        found.append((*told, (i, j), means, (top, left)))
    if not found:
        raise InvalidValueError(
            "no part of the scans that both show with the same structure",
            expected="scans of one place that are turned by what is said",
            do=_OTHER_SENSE,
        )
    information, right, scans, weights, places = (np.array(one) for one in zip(*found, strict=True))
    _, place = np.unique(places, axis=0, return_inverse=True)
    used = {(*pair, *where) for _, _, pair, _, where in found}
    return _Tiles(information, right, scans, weights, place.ravel()), used


def _search_tile(first: Array32, second: Array32) -> tuple[Array, Array] | None:
    """The shift of a tile to a pixel, however much it is strained; None where no shift stands out."""
    reference = CoarseReference(Pyramid(first), RegistrationSettings().min_overlap)
    peaks = find_coarse_peaks(reference, Pyramid(second), np.zeros(2))
    near = [peak for peak in peaks if peak.significant]
    if not near:
        return None
    # On a lattice all periods are about as high.
    high = [peak for peak in near if peak.correlation > PERIODIC_PEAK_MIN * near[0].correlation]
    best = min(high, key=lambda peak: math.hypot(*peak.shift_px))
    information = np.eye(2) / COARSE_SIGMA_PX**2
    return information, information @ np.array(best.shift_px)


def _compare_tile(first: Array32, second: Array32) -> tuple[Array, Array] | None:
    """Normal equations of Lucas and Kanade for a tile, gain and offset taken out; None where it shows nothing.

    The matrix is of products of the gradients of one image with those of the other, to which noise adds nothing on
    average; the right side, with the mean of both gradients, is zero on average where the images agree.
    """
    inner = slice(TILE_RIM_PX, -TILE_RIM_PX), slice(TILE_RIM_PX, -TILE_RIM_PX)
    greys, slopes = [], []
    for image in (first, second):
        smooth = cv2.GaussianBlur(image, (0, 0), TILES_SMOOTHED_PX)
        grey = (smooth[inner] - smooth[inner].mean()).ravel()
        spread = float(np.sqrt(np.mean(grey**2)))
        if spread == 0.0:
            return None
        greys.append(grey / spread)
        slopes.append(np.stack([one[inner].ravel() for one in np.gradient(smooth)[::-1]]) / spread)
    # What an offset or a gain would explain tells nothing of a shift.
    common = greys[0] + greys[1]
    common /= np.linalg.norm(common)
    slopes = [one - one.mean(axis=1, keepdims=True) for one in slopes]
    slopes = [one - np.outer(one @ common, common) for one in slopes]
    left = greys[0] - greys[1]
    variance = max(float(np.mean(left**2)), TILE_VARIANCE_MIN)
    cross = slopes[0] @ slopes[1].T
    own = math.sqrt(float(np.sum(slopes[0] ** 2)) * float(np.sum(slopes[1] ** 2)))
    if not float(np.trace(cross)) > COMMON_SLOPE_MIN * own:
        return None
    # Along an edge, or by chance across it, nothing is known of the shift; that is never less than nothing.
    values, vectors = np.linalg.eigh(0.5 * (cross + cross.T))
    known = vectors * (values > COMMON_SLOPE_MIN * own / 4.0)
    information = (known * values) @ known.T
    # Of a shift by d, the second image is the first one less its slope times d.
    right = known @ known.T @ (0.5 * (slopes[0] + slopes[1]) @ left)
    return information / variance, right / variance


def _solve(tiles: _Tiles, design: Array, prior: Array, drift: Array) -> tuple[Array, Array, Array]:
    """Least squares for the displacements (n, k, 2), with what tiles tell beyond ``drift``.

    ``design`` (t, n k) is that of the tiles, ``prior`` (n k, 2, n k, 2) the information that is there without them.

    Returns
    -------
    The displacements (n k, 2), the inverse of the normal matrix (n k, 2, n k, 2), and what is left of the right sides
    of the tiles (t, 2).
    """
    unknowns = design.shape[1]
    normal = np.einsum("tu,tab,tv->uavb", design, tiles.information, design, optimize=True) + prior
    known = drift.reshape(unknowns, 2)
    right = np.einsum("tu,ta->ua", design, tiles.right) - np.einsum("uavb,vb->ua", prior, known)
    inverse = invert_scaled(normal.reshape(2 * unknowns, -1))
    change = (inverse @ right.ravel()).reshape(unknowns, 2)
    left = tiles.right - np.einsum(
        "tab,tu,ub->ta", tiles.information, design, change, optimize=True
    )
    return known + change, inverse.reshape(unknowns, 2, unknowns, 2), left


def _search(
    warped: Sequence[_Warped], pairs: Sequence[tuple[int, int]], knots: Array, drift: Array
) -> Array:
    """The drift (n, k, 2) to a fraction of a pixel, from tiles that are searched one by one."""
    tiles, _ = _look_at_tiles(warped, pairs, SEARCHED_TILE_PX, knots, _search_tile)
    scans, count = drift.shape[:2]
    prior = _prior_information(scans, count)
    while True:
        found, _, left = _solve(tiles, tiles.design(scans), prior, drift)
        # Of the searched tiles, what is left in units of their sigma.
        far = np.hypot(*left.T) * COARSE_SIGMA_PX
        near = far <= max(FAR_MEDIANS * float(np.median(far)), COARSE_SIGMA_PX)
        if near.all():
            return found.reshape(drift.shape)
        tiles = _Tiles(*(getattr(tiles, name.name)[near] for name in fields(tiles)))


def _refine(
    warped: Sequence[_Warped],
    pairs: Sequence[tuple[int, int]],
    knots: Array,
    drift: Array,
    allowed: set[_Place] | None,
) -> tuple[ScanPairDrift, set[_Place]]:
    """One step of Gauss and Newton for the drift, and the tiles that it rests on."""
    tiles, used = _look_at_tiles(warped, pairs, COMPARED_TILE_PX, knots, _compare_tile, allowed)
    scans, count = drift.shape[:2]
    unknowns = scans * count
    design, prior = tiles.design(scans), _prior_information(scans, count)
    found, inverse, left = _solve(tiles, design, prior, drift)
    freedom = len(left) - unknowns
    if freedom < unknowns:
        raise InvalidValueError(
            f"{counted(len(left), 'tile')} of {COMPARED_TILE_PX} px that both scans show",
            expected=f"at least {2 * unknowns} for {counted(unknowns, 'displacement')}",
            do="take pictures that overlap by more",
        )
    # From the scatter of the tiles, which knows of all that the tiles do not: noise that interpolation has made
    # dependent, structure that differs, drift that is no function of the slow axis. What a tile has pulled the
    # solution towards itself is undone (the HC3 of MacKinnon and White 1985, doi:10.1016/0304-4076(85)90158-7), and
    # tiles at one place, which share the noise of a scan, count as one (Liang and Zeger 1986,
    # doi:10.1093/biomet/73.1.13).
    fitted = np.einsum("tu,uavb,tv->tab", design, inverse, design, optimize=True)
    free = np.eye(2) - tiles.information @ fitted
    undone = np.linalg.solve(free + FREEDOM_MIN * np.eye(2), left[..., None])[..., 0]
    scores = np.einsum("tu,ta->tua", design, undone).reshape(len(left), -1)
    places = np.zeros((tiles.place.max() + 1, scores.shape[1]))
    np.add.at(places, tiles.place, scores)
    meat = places.T @ places + prior.reshape(2 * unknowns, -1)
    flat = inverse.reshape(2 * unknowns, -1)
    result = ScanPairDrift(
        knots,
        found.reshape(drift.shape),
        (flat @ meat @ flat).reshape(scans, count, 2, scans, count, 2),
        len(left),
    )
    return result, used


def _prior_information(scans: int, count: int) -> Array:
    """(n k, 2, n k, 2) information on bends at the knots, and on the mean over the first scan."""
    unknowns = scans * count
    bends = np.diff(np.eye(count), n=2, axis=0) / BEND_PX
    one = np.kron(np.eye(scans), bends.T @ bends)
    mean = np.zeros(unknowns)
    mean[:count] = 1.0 / count / ZERO_SIGMA_PX
    one += np.outer(mean, mean)
    return np.einsum("uv,ab->uavb", one, np.eye(2))


def _check(warped: Sequence[_Warped], pairs: Sequence[tuple[int, int]]) -> None:
    """Refuse scans that do not match as they are now corrected."""
    for i, j in pairs:
        first, second = warped[i], warped[j]
        left, top, right, bottom = _find_valid_rectangle(first.valid & second.valid)
        part = slice(top, bottom), slice(left, right)
        found = register_pair(
            first.image[part], second.image[part], guess_covariance=np.diag([1.0, 1.0])
        )
        # It need not be accepted: what little is left between lines is no shift of the whole, and may not converge.
        same = found.correlation >= RegistrationSettings().min_correlation
        if not (same and math.hypot(*found.shift_px) < SAME_PLACE_PX):
            raise InvalidValueError(
                f"scans {i + 1} and {j + 1} do not match, corrected as well as they can be: {found.reason}",
                expected="scans of one place that are turned by what is said",
                do=_OTHER_SENSE,
            )
