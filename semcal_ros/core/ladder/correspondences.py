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

"""Dense sub-pixel correspondences between two pictures of one specimen, shifted, turned or zoomed.

The second picture is resampled to the geometry in which the first one sees the specimen, as far as that is known. What
is left is a small displacement, which is measured in blocks of some thirty pixels by least squares with a gain and an
offset of each block, as in :mod:`semcal_ros.core.registration`. A smooth map takes up the displacements, and the second
picture is resampled anew, until nothing is left. So neither a turn nor a zoom, nor noise in the gradients, pulls the
result: it is a place where the step is zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from scipy import ndimage

from semcal_ros.core.arrays import Array, Image, Mask, mad_sigma
from semcal_ros.core.errors import Rejection
from semcal_ros.core.ladder.thresholds import (
    BLOCK_SIGMA_MAX_PX,
    BLOCK_SIGMAS,
    BLOCK_STEP_MAX_PX,
    BLOCKS_AGREEING_MIN,
    BLOCKS_MIN,
    COARSE_DEGREE,
    COARSE_FACTORS,
    COARSE_PASSES,
    CORRELATION_MIN,
    FINE_DEGREE,
    FINE_PASSES,
    GAIN_MAX,
    GAIN_MIN,
    INTERPOLATION_PX,
    LAST_STEP_PX,
    OVERLAP_MIN,
    PIXEL_SIGMA,
    SECOND_PEAK_MAX,
    SIGNAL_MIN,
    TILES,
)
from semcal_ros.core.registration.noise_spectrum import (
    ImageStatistics,
    measure_image,
    passed_gradient,
    passed_variance,
    shared_pixels,
)
from semcal_ros.core.registration.normalised_correlation import CoarseReference, find_coarse_peaks
from semcal_ros.core.registration.periodicity import find_periods
from semcal_ros.core.registration.tiles import (
    Pyramid,
    PyramidLevel,
    make_level,
    tile_sums,
    tile_window,
)


class PairFailure(Enum):
    """Why two pictures were not matched."""

    FEATURELESS = "featureless"
    NO_OVERLAP = "no overlap"
    PERIODIC = "periodic"
    INCONSISTENT = "inconsistent"


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """A map of the plane by polynomials: x and y of a picture as functions of the pixel of another.

    Attributes
    ----------
    coefficients
        (2, d + 1, d + 1) of Chebyshev polynomials in x and y, from -1 to 1 over the picture.
    size
        (width, height) of the picture whose pixels are mapped.
    """

    coefficients: Array
    size: tuple[int, int]

    @classmethod
    def fit(
        cls,
        xy: Array,
        mapped: Array,
        size: tuple[int, int],
        degree: int,
        weights: Array | None = None,
    ) -> SmoothMap:
        """Fit a map of a total degree to points (n, 2) and their images (n, 2) by least squares with weights (n,)."""
        pairs = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        u, v = _unit(xy, size)
        design = np.stack(
            [_chebyshev(u, degree)[i] * _chebyshev(v, degree)[j] for i, j in pairs], axis=1
        )
        root = np.ones(len(xy)) if weights is None else np.sqrt(weights)
        found = np.linalg.lstsq(design * root[:, None], mapped * root[:, None], rcond=None)[0]
        coefficients = np.zeros((2, degree + 1, degree + 1))
        for (i, j), value in zip(pairs, found, strict=True):
            coefficients[:, i, j] = value
        return cls(coefficients, size)

    def __call__(self, xy: Array) -> Array:
        """Map points (n, 2)."""
        u, v = _unit(xy, self.size)
        return np.stack([chebyshev.chebval2d(u, v, c) for c in self.coefficients], axis=1)

    def on_grid(self) -> Array:
        """(2, height, width) images of all pixels."""
        width, height = self.size
        u = 2.0 * np.arange(width) / max(width - 1, 1) - 1.0
        v = 2.0 * np.arange(height) / max(height - 1, 1) - 1.0
        return np.stack([chebyshev.chebgrid2d(u, v, c).T for c in self.coefficients])

    def jacobian(self, xy: Array) -> Array:
        """(n, 2, 2) derivatives at points (n, 2)."""
        u, v = _unit(xy, self.size)
        out = np.empty((len(xy), 2, 2))
        for row, c in enumerate(self.coefficients):
            for axis, side in ((0, self.size[0]), (1, self.size[1])):
                slope = chebyshev.chebder(c, axis=axis)
                out[:, row, axis] = chebyshev.chebval2d(u, v, slope) * 2.0 / max(side - 1, 1)
        return out

    def plus(self, other: SmoothMap) -> SmoothMap:
        """The sum of two maps of one picture."""
        n = max(self.coefficients.shape[1], other.coefficients.shape[1])
        total = np.zeros((2, n, n))
        for part in (self.coefficients, other.coefficients):
            total[:, : part.shape[1], : part.shape[2]] += part
        return SmoothMap(total, self.size)


def _unit(xy: Array, size: tuple[int, int]) -> tuple[Array, Array]:
    width, height = size
    return 2.0 * xy[:, 0] / max(width - 1, 1) - 1.0, 2.0 * xy[:, 1] / max(height - 1, 1) - 1.0


def _chebyshev(u: Array, degree: int) -> Array:
    return np.asarray(chebyshev.chebvander(u, degree).T)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A picture with what every match of it needs.

    Attributes
    ----------
    image
        (h, w) grey levels.
    """

    image: Image
    _levels: dict[int, PyramidLevel | None] = field(default_factory=dict, repr=False)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self.image.shape[1], self.image.shape[0]

    @cached_property
    def pyramid(self) -> Pyramid:
        """The picture at several resolutions."""
        return Pyramid(self.image)

    @cached_property
    def statistics(self) -> ImageStatistics:
        """Its noise, structure, and the smoothing that suits it."""
        return measure_image(self.image)

    @cached_property
    def coarse(self) -> CoarseReference:
        """Its side of the search over all shifts."""
        return CoarseReference(self.pyramid, OVERLAP_MIN)

    @cached_property
    def periods(self) -> Array:
        """(k, 2) periods of what repeats in it, px."""
        return find_periods(self.pyramid.centred(1), self.statistics.noise_variance)

    @cached_property
    def is_featureless(self) -> bool:
        """Whether it shows no more than noise."""
        # Chance makes less than 6 % of pictures of 96 px and more, as in registration.
        return self.statistics.signal_variance < 0.06 * self.statistics.noise_variance

    def level(self, factor: int) -> PyramidLevel | None:
        """Its tiles at a reduction; None where it is too small."""
        if factor not in self._levels:
            sigma = max(self.statistics.sigma_px, 0.6)
            self._levels[factor] = make_level(self.pyramid, factor, max(sigma / factor, 0.6))
        return self._levels[factor]


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Where two pictures show the same.

    Attributes
    ----------
    first_xy, second_xy
        (n, 2) raw pixels of either.
    covariance
        (n, 2, 2) of ``second_xy``, px^2.
    map
        The smooth map from the first to the second picture.
    correlation
        Median correlation of the blocks, 0 to 1.
    excess
        By how much the scatter of the blocks exceeds what their residuals say; the covariance contains it.
    rejected
        Number of blocks that show something else.
    """

    first_xy: Array
    second_xy: Array
    covariance: Array
    map: SmoothMap
    correlation: float
    excess: float
    rejected: int

    def __len__(self) -> int:
        return len(self.first_xy)


def match_pictures(
    first: Prepared,
    second: Prepared,
    predict: Callable[[Array], Array],
    *,
    search: bool = True,
) -> Correspondences | Rejection[PairFailure]:
    """Find where the second picture shows what the first one does.

    Parameters
    ----------
    first, second
        The pictures; the first one has the larger pixels where they differ.
    predict
        From pixels (n, 2) of the first to those of the second, right up to a shift, half a degree, and a per cent.
    search
        Whether to search over all shifts; otherwise the prediction is right to two pixels.
    """
    found = _begin(first, second, predict, search=search)
    if isinstance(found, Rejection):
        return found
    smooth = found
    for factor in COARSE_FACTORS:
        for _ in range(COARSE_PASSES):
            blocks = _measure_blocks(first, second, smooth, factor)
            if blocks is None or len(blocks.xy) < 6:
                break
            step = _fit_step(blocks, first.size, COARSE_DEGREE)
            smooth = _follow(smooth, step)
            if step.rms_px < 0.05 * factor:
                break
    blocks = None
    for number in range(FINE_PASSES):
        blocks = _measure_blocks(first, second, smooth, 1)
        if blocks is None or len(blocks.xy) < BLOCKS_MIN:
            return Rejection(PairFailure.NO_OVERLAP, "too little in common, or another place")
        step = _fit_step(blocks, first.size, 2 if number == 0 else FINE_DEGREE)
        if number == FINE_PASSES - 1 or (number > 0 and step.rms_px < LAST_STEP_PX):
            break
        smooth = _follow(smooth, step)
    assert blocks is not None
    return _conclude(blocks, step, smooth)


def locate_picture(
    first: Prepared, second: Prepared, predict: Callable[[Array], Array]
) -> SmoothMap | Rejection[PairFailure]:
    """Find to a pixel where the second picture shows what the first one does; arguments as of :func:`match_pictures`.

    It asks for less in common: whether both show one place, not how each part of it is displaced.
    """
    return _begin(first, second, predict, search=True)


def _begin(
    first: Prepared, second: Prepared, predict: Callable[[Array], Array], *, search: bool
) -> SmoothMap | Rejection[PairFailure]:
    for picture, name in ((first, "first"), (second, "second")):
        if picture.is_featureless:
            return Rejection(PairFailure.FEATURELESS, f"the {name} picture shows noise only")
    smooth = _fit_prediction(predict, first.size)
    return _search(first, second, smooth) if search else smooth


def _fit_prediction(predict: Callable[[Array], Array], size: tuple[int, int]) -> SmoothMap:
    width, height = size
    x, y = np.meshgrid(np.linspace(0, width - 1, 13), np.linspace(0, height - 1, 13))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    mapped = predict(xy)
    known = np.all(np.isfinite(mapped), axis=1)
    return SmoothMap.fit(xy[known], mapped[known], size, FINE_DEGREE)


def _follow(smooth: SmoothMap, step: _Step) -> SmoothMap:
    """The map after a displacement in the first picture: what is at u lies at u + s of the resampled one."""
    width, height = smooth.size
    x, y = np.meshgrid(np.linspace(0, width - 1, 13), np.linspace(0, height - 1, 13))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    moved = smooth(xy + step.map(xy))
    return SmoothMap.fit(xy, moved, smooth.size, FINE_DEGREE)


def _scale_of(smooth: SmoothMap) -> float:
    middle = 0.5 * (np.array(smooth.size, dtype=np.float64) - 1.0)
    return float(np.sqrt(abs(np.linalg.det(smooth.jacobian(middle[None])[0]))))


def _blurred(second: Prepared, scale: float) -> Image:
    """The finer picture with the resolution of the coarser one."""
    sigma = PIXEL_SIGMA * np.sqrt(max(scale**2 - 1.0, 0.0))
    image = second.image.astype(np.float32)
    if sigma < 0.1:
        return image
    return np.asarray(ndimage.gaussian_filter(image, sigma, mode="mirror"), dtype=np.float32)


def _search(
    first: Prepared, second: Prepared, smooth: SmoothMap
) -> SmoothMap | Rejection[PairFailure]:
    """Move the map to where both pictures correlate best."""
    middle = 0.5 * (np.array(smooth.size, dtype=np.float64) - 1.0)
    linear = smooth.jacobian(middle[None])[0]
    inverse = np.linalg.inv(linear)
    width, height = second.size
    corners = np.array(
        [[0.0, 0.0], [width - 1.0, 0.0], [0.0, height - 1.0], [width - 1.0, height - 1.0]]
    )
    centre = corners.mean(axis=0)
    # The largest upright rectangle about the middle that stays inside.
    turned = np.abs((corners - centre) @ inverse.T)
    half = np.array([np.min(turned[:, 0]), np.min(turned[:, 1])])
    if np.any(half < 16.0):
        return Rejection(PairFailure.NO_OVERLAP, "less than 32 px in common")
    columns = np.arange(-np.floor(half[0]), np.floor(half[0]) + 1.0)
    rows = np.arange(-np.floor(half[1]), np.floor(half[1]) + 1.0)
    x, y = np.meshgrid(columns, rows)
    at = centre[:, None, None] + np.einsum("ij,jhw->ihw", linear, np.stack([x, y]))
    canvas = ndimage.map_coordinates(
        _blurred(second, _scale_of(smooth)), at[::-1], order=1, mode="nearest"
    ).astype(np.float32)
    # Where the prediction has the middle of the first picture on the canvas.
    guess = inverse @ (smooth(middle[None])[0] - centre) + np.array([-columns[0], -rows[0]])
    peaks = find_coarse_peaks(first.coarse, Pyramid(canvas), guess - middle)
    if not peaks:
        return Rejection(PairFailure.NO_OVERLAP, "no shift at which both show the same")
    best = peaks[0]
    if best.correlation < CORRELATION_MIN and not best.significant:
        return Rejection(
            PairFailure.NO_OVERLAP, f"they correlate by {best.correlation:.2f} at most"
        )
    others = [
        peak
        for peak in peaks[1:]
        if np.max(np.abs(np.subtract(peak.shift_px, best.shift_px))) > 4.0 * best.step_px
        and peak.correlation > SECOND_PEAK_MAX * best.correlation
    ]
    if others and len(first.periods):
        return Rejection(
            PairFailure.PERIODIC, "a specimen that repeats: several shifts fit as well"
        )
    shift = np.array(best.shift_px)
    # What lies in the middle of the first picture lies there on the canvas.
    seen = centre + linear @ (middle + shift + [columns[0], rows[0]])
    offset = seen - smooth(middle[None])[0]
    moved = smooth.coefficients.copy()
    moved[:, 0, 0] += offset
    return SmoothMap(moved, smooth.size)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Displacements (n, 2) of blocks at ``xy`` (n, 2) in px of the first picture, their covariances (n, 2, 2), and
    correlations (n,).
    """

    xy: Array
    shift: Array
    covariance: Array
    correlation: Array


@dataclass(frozen=True, eq=False)
class _Step:
    """A smooth displacement, its RMS over the blocks, and which blocks follow it."""

    map: SmoothMap
    rms_px: float
    inside: Mask
    residual: Array


def _measure_blocks(
    first: Prepared, second: Prepared, smooth: SmoothMap, factor: int
) -> _Blocks | None:
    level = first.level(factor)
    if level is None:
        return None
    at = smooth.on_grid()
    width, height = second.size
    reach = 3.0
    inside = (at[0] >= reach) & (at[0] <= width - 1 - reach)
    inside &= (at[1] >= reach) & (at[1] <= height - 1 - reach)
    if np.count_nonzero(inside) < 32 * 32:
        return None
    source = _blurred(second, _scale_of(smooth))
    seen = np.full(at.shape[1:], float(source.mean()), dtype=np.float32)
    seen[inside] = ndimage.map_coordinates(source, at[::-1, inside], order=3, mode="mirror")
    image = Pyramid(seen)
    # Filters reach beyond a tile.
    margin = level.margin * factor
    sure = ndimage.minimum_filter(inside, size=2 * margin + 1, mode="constant", cval=False)
    window = tile_window(level, level.size, np.zeros(2))
    if window is None:
        return None
    sums = tile_sums(level, window, image.centred(factor), np.zeros(2), np.zeros((2, 2)))
    normal = level.normal_matrices[window.rows, window.cols]
    count = [n // TILES for n in normal.shape[:2]]
    if min(count) < 1:
        return None

    def gather(values: Array) -> Array:
        cut = values[: count[0] * TILES, : count[1] * TILES]
        shape = (count[0], TILES, count[1], TILES, *values.shape[2:])
        summed = cut.reshape(shape).sum(axis=(1, 3))
        return np.asarray(summed.reshape(count[0] * count[1], *values.shape[2:]))

    side = np.array(level.side) * TILES
    x = level.origin[0] + window.cols.start * level.side[0] + side[0] * np.arange(count[1])
    y = level.origin[1] + window.rows.start * level.side[1] + side[1] * np.arange(count[0])
    known = np.array(
        [
            bool(
                sure[
                    int(top * factor) : int((top + side[1]) * factor),
                    int(left * factor) : int((left + side[0]) * factor),
                ].all()
            )
            for top in y
            for left in x
        ]
    )
    middle_x, middle_y = np.meshgrid(x + 0.5 * (side[0] - 1), y + 0.5 * (side[1] - 1))
    xy = (np.stack([middle_x.ravel(), middle_y.ravel()], axis=1) + 0.5) * factor - 0.5
    blocks = _solve_blocks(first, level, gather(normal), gather(sums.cross), gather(sums.energy))
    keep = known & np.all(np.isfinite(blocks.shift), axis=1)
    keep &= np.sqrt(np.einsum("nii->n", blocks.covariance)) < BLOCK_SIGMA_MAX_PX
    keep &= np.hypot(*blocks.shift.T) < 2.0 * BLOCK_STEP_MAX_PX
    return _Blocks(
        xy[keep],
        factor * blocks.shift[keep],
        factor**2 * blocks.covariance[keep],
        blocks.correlation[keep],
    )


def _solve_blocks(
    first: Prepared, level: PyramidLevel, normal: Array, cross: Array, energy: Array
) -> _Blocks:
    """Least squares for shift, gain and offset of each block."""
    pixels = normal[:, 3, 3]
    noise = first.statistics.noise_variance / level.factor**2
    clean = normal.copy()
    # The noise of the reference makes its gradients steeper than they are.
    for axis in (0, 1):
        clean[:, axis, axis] -= pixels * noise * passed_gradient(level.sigma_px)
    clean[:, 2, 2] -= pixels * noise * passed_variance(level.sigma_px)
    signal = np.einsum("nii->ni", clean)[:, :3] / np.maximum(
        np.einsum("nii->ni", normal)[:, :3], 1e-30
    )
    good = np.all(signal > SIGNAL_MIN, axis=1)
    shift = np.full((len(normal), 2), np.nan)
    covariance = np.full((len(normal), 2, 2), np.inf)
    centred = normal[:, 2, 2] - normal[:, 2, 3] ** 2 / pixels
    own = energy - cross[:, 3] ** 2 / pixels
    common = cross[:, 2] - normal[:, 2, 3] * cross[:, 3] / pixels
    correlation = common / np.sqrt(np.maximum(centred * own, 1e-30))
    for k in np.flatnonzero(good):
        try:
            values = np.linalg.solve(clean[k], cross[k])
            inverse = np.linalg.inv(clean[k])
        except np.linalg.LinAlgError:
            continue
        gain = values[2]
        spread = np.diag(inverse)[:2]
        if not (GAIN_MIN < gain < GAIN_MAX and np.all(spread > 0.0)):
            continue
        shift[k] = -values[:2] / gain
        plain = np.linalg.solve(normal[k], cross[k])
        variance = max(float(energy[k] - plain @ cross[k]), 0.0) / pixels[k]
        covariance[k] = inverse[:2, :2] * variance * shared_pixels(level.sigma_px) / gain**2
    return _Blocks(np.empty((0, 2)), shift, covariance, correlation)


def _fit_step(blocks: _Blocks, size: tuple[int, int], degree: int) -> _Step:
    """Fit a smooth displacement to blocks, without those that do not follow."""
    weights = 1.0 / (np.einsum("nii->n", blocks.covariance) + INTERPOLATION_PX**2)
    inside = np.ones(len(blocks.xy), dtype=bool)
    for _ in range(4):
        fitted = SmoothMap.fit(
            blocks.xy[inside], blocks.shift[inside], size, degree, weights[inside]
        )
        residual = blocks.shift - fitted(blocks.xy)
        scaled = residual * np.sqrt(weights)[:, None]
        spread = max(mad_sigma(scaled[inside]), 1e-12)
        now = np.all(np.abs(scaled) < BLOCK_SIGMAS * spread, axis=1)
        if np.count_nonzero(now) < 2 * (degree + 1) * (degree + 2) // 2 or np.array_equal(
            now, inside
        ):
            break
        inside = now
    moved = fitted(blocks.xy[inside])
    rms = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    return _Step(fitted, rms, inside, residual)


def _conclude(
    blocks: _Blocks, step: _Step, smooth: SmoothMap
) -> Correspondences | Rejection[PairFailure]:
    inside = step.inside
    share = float(np.mean(inside))
    correlation = float(np.median(blocks.correlation[inside]))
    if correlation < CORRELATION_MIN:
        return Rejection(PairFailure.NO_OVERLAP, f"blocks that correlate by {correlation:.2f}")
    if share < BLOCKS_AGREEING_MIN:
        return Rejection(
            PairFailure.INCONSISTENT,
            f"{100.0 * (1.0 - share):.0f} % of the blocks do not move with the rest",
        )
    covariance = blocks.covariance[inside] + INTERPOLATION_PX**2 * np.eye(2)
    residual = step.residual[inside]
    root = np.linalg.cholesky(np.linalg.inv(covariance))
    scaled = np.einsum("nji,nj->ni", root, residual)
    # The smooth map takes some of the scatter.
    count = np.count_nonzero(inside)
    freedom = (step.map.coefficients.shape[1]) * (step.map.coefficients.shape[1] + 1) / 2.0
    excess = float(mad_sigma(scaled)) / np.sqrt(max(1.0 - freedom / count, 0.1))
    covariance = covariance * excess**2
    xy = blocks.xy[inside]
    there = smooth(xy + blocks.shift[inside])
    turned = smooth.jacobian(xy)
    return Correspondences(
        xy,
        there,
        turned @ covariance @ np.swapaxes(turned, 1, 2),
        smooth,
        correlation,
        excess,
        int(np.count_nonzero(~inside)),
    )
