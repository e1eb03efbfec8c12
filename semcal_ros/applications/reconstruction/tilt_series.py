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

"""Heights of a specimen from two or three pictures of it at known tilts.

A pair with the relative tilt ``t`` has the disparity ``d = h tan t`` in the picture of the reference, up to a constant,
since nobody knows how far the specimen moved. So heights are known up to a constant, and are given about their median.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.applications.reconstruction.thresholds import (
    AXIS_DOUBT_RAD,
    CONTRADICTION_SIGMAS,
    COVERAGE_MIN,
    TILT_STEP_MAX_RAD,
    TILT_STEP_MIN_RAD,
)
from semcal_ros.applications.reconstruction.tilt_pair import (
    TiltGeometry,
    find_tilt_geometry,
    match_densely,
)
from semcal_ros.core.arrays import AnyImage, Array, check_positive, mad_sigma
from semcal_ros.core.errors import InvalidValueError, StructureError


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Heights towards the gun along the normal of the untilted stage, on the pixels of one picture.

    Attributes
    ----------
    height_m
        (h, w) about their median; NaN where they are not known.
    sigma_m
        (h, w) 1-sigma: noise of the matching, tilts, geometry and pixel size.
    noise_sigma_m
        (h, w) the part of the noise of the matching.
    reference
        Index of the picture whose pixels these are.
    pairs
        Epipolar geometry of the reference with each other picture, in their order.
    pixel_size_m
        Of the reference, along x and y.
    tilts_rad
        Tilts of all pictures.
    relief_ratio, relief_ratio_sigma
        Relief by the last pair over that by the first: 1 if the tilts are right; None for two pictures.
    """

    height_m: Array
    sigma_m: Array
    noise_sigma_m: Array
    reference: int
    pairs: tuple[TiltGeometry, ...]
    pixel_size_m: float
    tilts_rad: tuple[float, ...]
    relief_ratio: float | None = None
    relief_ratio_sigma: float | None = None

    @property
    def axis_rad(self) -> float:
        """Direction of the tilt axis in the reference."""
        return self.pairs[0].axis_rad

    @property
    def axis_sigma_rad(self) -> float:
        """Its 1-sigma."""
        return float(np.sqrt(self.pairs[0].covariance[0, 0]))

    @property
    def relief_m(self) -> float:
        """Height between the 0.5th and the 99.5th percentile."""
        low, high = np.nanpercentile(self.height_m, (0.5, 99.5))
        return float(high - low)

    @property
    def rms_m(self) -> float:
        """RMS height about the mean plane."""
        rows, columns = np.nonzero(np.isfinite(self.height_m))
        design = np.stack([rows, columns, np.ones(len(rows))], axis=1)
        heights = self.height_m[rows, columns]
        plane = np.linalg.lstsq(design, heights, rcond=None)[0]
        return float(np.sqrt(np.mean((heights - design @ plane) ** 2)))

    @property
    def median_sigma_m(self) -> float:
        """Median 1-sigma."""
        return float(np.nanmedian(self.sigma_m))

    @property
    def coverage(self) -> float:
        """Share of the pixels that have a height."""
        return float(np.mean(np.isfinite(self.height_m)))

    def list_points(self) -> tuple[Array, Array]:
        """List the (n, 3) points, m, z towards the gun, in the frame of the untilted stage, and their (n,) 1-sigma."""
        rows, columns = np.nonzero(np.isfinite(self.height_m))
        u, v = _coordinates(self.height_m.shape, self.axis_rad, self.pixel_size_m)
        turn = self.tilts_rad[self.reference]
        height = self.height_m[rows, columns]
        along = u[rows, columns]
        # v of the picture is v_s cos t + h sin t.
        across = (v[rows, columns] - height * np.sin(turn)) / np.cos(turn)
        c, s = np.cos(self.axis_rad), np.sin(self.axis_rad)
        points = np.stack([along * c - across * s, along * s + across * c, height], axis=1)
        return points, self.sigma_m[rows, columns]


def measure_heights(
    images: Sequence[AnyImage],
    tilts_rad: Sequence[float],
    pixel_size_m: float,
    *,
    pixel_size_sigma_m: float = 0.0,
    tilt_sigma_rad: float,
    axis_rad: float = 0.0,
) -> HeightMap:
    """Measure heights in two or three tilted pictures.

    Parameters
    ----------
    images
        Two or three (h, w) arrays of grey levels of one size and magnification.
    tilts_rad
        Tilt of each. A positive tilt moves what lies at +90 degrees from the axis away from the gun.
    pixel_size_m, pixel_size_sigma_m
        Pixel size, and its 1-sigma.
    tilt_sigma_rad
        1-sigma of each tilt.
    axis_rad
        About where the tilt axis points in the image, from +x towards +y; it decides between hills and dents.

    Raises
    ------
    InvalidValueError
        If the pictures or the tilts cannot be used.
    StructureError
        If the pictures do not show one specimen with relief, or contradict the tilts.
    """
    check_positive(pixel_size_m, "pixel_size_m =")
    if len(images) not in (2, 3) or len(tilts_rad) != len(images):
        raise InvalidValueError(
            f"{len(images)} pictures and {len(tilts_rad)} tilts",
            expected="two or three pictures and a tilt for each",
            do="give --tilts, such as --tilts 0deg,6deg,12deg",
        )
    if any(image.shape != images[0].shape for image in images):
        raise InvalidValueError(
            "pictures of different sizes", expected="one size", do="choose --roi X,Y,W,H"
        )
    order = np.argsort(tilts_rad)
    _check_tilts(np.asarray(tilts_rad, dtype=np.float64)[order])
    # The middle one of three shares most with both others; of two, the one tilted less.
    reference = int(order[1]) if len(images) == 3 else int(np.argmin(np.abs(tilts_rad)))
    others = [index for index in range(len(images)) if index != reference]
    pairs = []
    for other in others:
        pair = find_tilt_geometry(images[reference], images[other], near_axis_rad=axis_rad)
        _check_axis(pair, axis_rad)
        pairs.append(pair)
    turns = [tilts_rad[other] - tilts_rad[reference] for other in others]
    u, v = _coordinates(images[reference].shape, pairs[0].axis_rad, pixel_size_m)
    heights, noises = [], []
    for other, pair, turn in zip(others, pairs, turns, strict=True):
        found = match_densely(images[reference], images[other], pair, turn)
        depth = found.value_px * pixel_size_m / np.tan(turn)
        _check_coverage(depth)
        heights.append(depth - np.nanmedian(depth))
        noises.append(found.sigma_px * pixel_size_m / abs(np.tan(turn)))
    ratio = ratio_sigma = None
    # The noise of the reference is in both pairs: half of the variance of either. Opposite tilts would cancel it, but
    # measured errors cancel by less, as smoothed relief and false matches do not.
    common = 0.5 if len(turns) == 2 and turns[0] * turns[1] > 0.0 else 0.0
    if len(turns) == 2:
        ratio, ratio_sigma = _compare_reliefs(heights, noises, turns, tilt_sigma_rad)
    weights, depth, noise = _combine(heights, noises, common)
    median = np.nanmedian(depth)
    depth = depth - median
    variance = noise**2 + (depth * pixel_size_sigma_m / pixel_size_m) ** 2
    variance += _systematic_variance(
        depth, weights, u, v, pairs, turns, tilt_sigma_rad, tilts_rad[reference]
    )
    tilt_rad = tilts_rad[reference]
    height = depth * np.cos(tilt_rad) + v * np.sin(tilt_rad)
    height -= np.nanmedian(height)
    _check_coverage(height)
    return HeightMap(
        height,
        np.sqrt(variance) * np.cos(tilt_rad),
        noise * np.cos(tilt_rad),
        reference,
        tuple(pairs),
        pixel_size_m,
        tuple(float(tilt) for tilt in tilts_rad),
        ratio,
        ratio_sigma,
    )


def _check_tilts(ascending: Array) -> None:
    steps = np.diff(ascending)
    if (
        not np.all(np.isfinite(ascending))
        or np.any(steps < TILT_STEP_MIN_RAD)
        or (np.any(steps > TILT_STEP_MAX_RAD))
    ):
        shown = ", ".join(f"{np.degrees(tilt):g}" for tilt in ascending)
        raise InvalidValueError(
            f"tilts of {shown} degrees",
            expected=f"steps of {np.degrees(TILT_STEP_MIN_RAD):g} to {np.degrees(TILT_STEP_MAX_RAD):g} degrees",
            do="state what each picture was tilted by, as in --tilts 0deg,6deg,12deg",
        )


def _check_axis(pair: TiltGeometry, expected_rad: float) -> None:
    if abs(pair.axis_rad - expected_rad) > AXIS_DOUBT_RAD:
        one = np.degrees(np.angle(np.exp(1j * pair.axis_rad)))
        other = one - 180.0 * np.sign(one)
        raise StructureError(
            f"the tilt axis lies at {one:.1f} or {other:.1f} degrees in the image",
            expected=f"within 45 degrees of {np.degrees(expected_rad):g}: its sense tells hills from dents",
            do=f"give --tilt-axis {one:.0f}deg or --tilt-axis {other:.0f}deg",
        )


def _check_coverage(height: Array) -> None:
    share = float(np.mean(np.isfinite(height)))
    if share < COVERAGE_MIN:
        raise StructureError(
            f"only {share:.1%} of the picture has a height",
            expected=f"at least {COVERAGE_MIN:.0%}, from pictures that overlap and show texture",
            do="tilt by less between pictures, or record with less noise",
        )


def _coordinates(
    shape: tuple[int, ...], axis_rad: float, pixel_size_m: float
) -> tuple[Array, Array]:
    """Coordinates of the pixels along the axis and across it, m from the centre."""
    rows, columns = np.indices(shape[:2], dtype=np.float64)
    x, y = columns - 0.5 * (shape[1] - 1), rows - 0.5 * (shape[0] - 1)
    c, s = np.cos(axis_rad), np.sin(axis_rad)
    return pixel_size_m * (c * x + s * y), pixel_size_m * (c * y - s * x)


def _compare_reliefs(
    heights: list[Array], noises: list[Array], turns: list[float], tilt_sigma_rad: float
) -> tuple[float, float]:
    """Relief by the second pair over that by the first, about their planes; align their constants."""
    both = np.isfinite(heights[0]) & np.isfinite(heights[1])
    _check_coverage(np.where(both, heights[0], np.nan))
    rows, columns = np.nonzero(both)
    design = np.stack([rows, columns, np.ones(len(rows))], axis=1)
    one, two = (
        part[both] - design @ np.linalg.lstsq(design, part[both], rcond=None)[0] for part in heights
    )
    # Both have noise: the ratio of the spreads, with the sign of their correlation.
    noise = [float(np.median(part[both] ** 2)) for part in noises]
    spreads = [max(float(np.var(part)) - n, 0.0) for part, n in zip((one, two), noise, strict=True)]
    correlation = float(np.corrcoef(one, two)[0, 1])
    if correlation < 0.0:
        raise StructureError(
            f"the relief of one pair is the mirror image of the other (correlation {correlation:.2f})",
            expected="tilts in the order of the pictures",
            do="correct --tilts",
        )
    heights[1] -= np.median((heights[1] - heights[0])[both])
    ratio = float(np.sqrt(spreads[1] / max(spreads[0], 1e-300)))
    # d ln(1 / tan t) = -dt / (sin t cos t), and the reading of the reference is in both.
    rates = [2.0 / np.sin(2.0 * turn) for turn in turns]
    sigma = tilt_sigma_rad * float(
        np.sqrt(rates[0] ** 2 + rates[1] ** 2 + (rates[0] - rates[1]) ** 2)
    )
    return ratio, sigma


def _combine(
    heights: list[Array], noises: list[Array], common: float
) -> tuple[list[Array], Array, Array]:
    """Weigh pairs by their noise; return weights, heights and the 1-sigma of their noise."""
    if len(heights) == 1:
        return [np.ones_like(heights[0])], heights[0], noises[0]
    (one, two), (s, t) = heights, noises
    expected = np.sqrt(s**2 + t**2 - 2.0 * common * s * t)
    score = (two - one) / expected
    both = np.isfinite(score)
    # Where the pairs differ by more than their noise allows, the noise is what they differ by.
    growth = max(1.0, mad_sigma(score[both] - np.median(score[both])))
    s, t, expected = s * growth, t * growth, expected * growth
    wrong = both & (np.abs(two - one) > CONTRADICTION_SIGMAS * expected)
    weight = (t**2 - common * s * t) / expected**2
    weight = np.where(both, weight, np.isfinite(one).astype(np.float64))
    first, second = np.nan_to_num(one), np.nan_to_num(two)
    depth = weight * first + (1.0 - weight) * second
    sn, tn = np.nan_to_num(s), np.nan_to_num(t)
    noise = np.sqrt(
        (weight * sn) ** 2
        + ((1.0 - weight) * tn) ** 2
        + 2.0 * common * weight * (1.0 - weight) * sn * tn
    )
    lost = wrong | ~(np.isfinite(one) | np.isfinite(two))
    return [weight, 1.0 - weight], np.where(lost, np.nan, depth), np.where(lost, np.nan, noise)


def _systematic_variance(
    depth: Array,
    weights: list[Array],
    u: Array,
    v: Array,
    pairs: list[TiltGeometry],
    turns: list[float],
    tilt_sigma_rad: float,
    reference_tilt_rad: float,
) -> Array:
    """Variance from the tilts and the epipolar geometry, about the middle of what is seen."""
    seen = np.isfinite(depth)
    u = u - np.mean(u[seen])
    v = v - np.mean(v[seen])
    variance = np.zeros_like(depth)
    total = np.zeros_like(depth)
    for weight, pair, turn in zip(weights, pairs, turns, strict=True):
        # h = (v' - v cos t) / sin t
        rate = weight * (v - depth / np.tan(turn))
        variance += (tilt_sigma_rad * rate) ** 2
        total += rate
        # The direction in the second picture slants v' along u; the first slants v; the scale stretches v'.
        slant = np.stack([u / np.tan(turn), -u / np.sin(turn), -v / np.tan(turn)]) * weight
        variance += np.einsum("ihw,ij,jhw->hw", slant, pair.covariance, slant)
    # The reading of the reference also turns heights to the normal of the stage.
    return variance + (tilt_sigma_rad * (total - (v - depth * np.tan(reference_tilt_rad)))) ** 2
