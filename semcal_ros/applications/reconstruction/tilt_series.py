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

At high magnification an SEM is a parallel projection. A specimen that tilts by ``t`` about an axis in the image
keeps its coordinate ``u`` along the axis, and the one across becomes ``v' = v cos t + h sin t``, with the height
``h`` towards the gun. So the normals of the epipolar lines are the axis in both pictures, and the ratio of their
lengths is that of the magnifications (Hartley and Zisserman, Multiple View Geometry, 2nd ed., chapter 14); the tilt
does not follow from two pictures.

A pair with the relative tilt ``t`` has the disparity ``d = h tan t`` in the picture of the reference, up to a constant,
since nobody knows how far the specimen moved. So heights are known up to a constant, and are given about their median.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semcal_ros.applications.reconstruction.epipolar import fit_epipolar
from semcal_ros.applications.reconstruction.thresholds import (
    AXIS_DOUBT_RAD,
    CONTRADICTION_SIGMAS,
    COVERAGE_MIN,
    DESCRIPTOR_RATIO,
    DISPARITY_AGREEMENT_PX,
    GREY_CORRELATION_MIN,
    GREY_WINDOW_PX,
    KEPT_NOISE,
    MATCH_NEIGHBOURS,
    MATCH_STEPS,
    MATCH_TOLERANCE_PX,
    MATCHES_MIN,
    MATCHES_PART_MIN,
    NEIGHBOUR_SIGMAS,
    NOISE_GAIN,
    OVERLAP_MATCHES,
    OVERLAP_MIN,
    PARALLAX_MAX,
    PARALLAX_MIN,
    TILT_STEP_MAX_RAD,
    TILT_STEP_MIN_RAD,
    WINDOW_REACH,
)
from semcal_ros.core.arrays import AnyImage, Array, Image, Mask, check_positive, mad_sigma
from semcal_ros.core.errors import InvalidValueError, StructureError
from semcal_ros.core.wording import counted


@dataclass(frozen=True, eq=False)
class TiltGeometry:
    """Affine epipolar geometry of two pictures that differ by a tilt.

    Attributes
    ----------
    axis_rad, second_axis_rad
        Direction of the tilt axis in the first and the second picture, from +x towards +y.
    scale
        Magnification of the second picture over that of the first.
    covariance
        (3, 3) of these three.
    first, second
        (n, 2) verified matches, px.
    matches
        Number of matches before the geometry was verified.
    rms_px
        RMS distance of the verified matches from the epipolar geometry.
    """

    axis_rad: float
    second_axis_rad: float
    scale: float
    covariance: Array
    first: Array
    second: Array
    matches: int
    rms_px: float


@dataclass(frozen=True, eq=False)
class Disparity:
    """Disparity of two rectified pictures, on the grid of the first picture.

    Attributes
    ----------
    value_px
        (h, w) shift across the axis in px of the first picture; NaN where there is no match.
    sigma_px
        (h, w) its 1-sigma from the noise of the matching.
    """

    value_px: Array
    sigma_px: Array


def find_tilt_geometry(
    first: AnyImage,
    second: AnyImage,
    *,
    near_axis_rad: float,
    shown: tuple[Mask | None, Mask | None] = (None, None),
) -> TiltGeometry:
    """Match SIFT features both ways and fit the affine epipolar geometry that they agree on.

    Parameters
    ----------
    first, second
        (h, w) grey levels.
    near_axis_rad
        Of the two senses of the axis, the one within 90 degrees of this is meant.
    shown
        (h, w) true where the first and the second show the specimen; None for all of it.

    Raises
    ------
    StructureError
        If too few matches agree, they show no parallax, or the pictures have too little in common.
    """
    one, two = _match_features(first, second, shown)
    if OVERLAP_MATCHES <= len(one) < MATCHES_MIN:
        _check_overlap(one, two, first, second)
    if len(one) < MATCHES_MIN:
        raise _refuse_matches(f"only {counted(len(one), 'match', 'matches')}")
    centre, second_centre = _centre_of(first), _centre_of(second)
    found = fit_epipolar(one - centre, two - second_centre, MATCH_TOLERANCE_PX, trials=2000)
    kept = found.inliers.copy()
    kept[kept] = _agree_with_neighbours(one[kept], two[kept])
    if np.count_nonzero(kept) >= MATCHES_PART_MIN * len(one):
        _check_overlap(one[kept], two[kept], first, second)
    count = int(np.count_nonzero(kept))
    if count < max(MATCHES_MIN, MATCHES_PART_MIN * len(one)):
        raise _refuse_matches(
            f"only {count} of {counted(len(one), 'match', 'matches')} agree with a tilt"
        )
    one, two, matches = one[kept], two[kept], len(one)
    joint = np.hstack([two - second_centre, one - centre])
    values, vectors = np.linalg.eigh(np.cov(joint.T) * (count - 1))
    # Of one picture twice, rounding makes them zero or less.
    values = np.maximum(values, 1e-12 * values[-1])
    noise = values[0] / (count - 4)
    if np.sqrt(values[1] / values[0]) < PARALLAX_MIN:
        raise StructureError(
            f"the pictures show no parallax: {count} matches fit a flat specimen within "
            f"{np.sqrt(values[1] / count):.2f} px",
            expected="a specimen with relief, tilted between the pictures",
            do="tilt further, or record at a higher magnification",
        )
    normal = vectors[:, 0]
    # First-order perturbation of an eigenvector; the noise is part of the larger eigenvalues, too.
    spread = values[1:] / (values[1:] - values[0]) ** 2
    covariance = noise * (vectors[:, 1:] * spread) @ vectors[:, 1:].T
    parameters = _describe_normal(normal, near_axis_rad)
    if not 0.5 < parameters[2] < 2.0:
        raise StructureError(
            f"the pictures differ in magnification by a factor of {parameters[2]:.2f} along the axis",
            expected="pictures of one magnification",
        )
    step = 1e-6
    jacobian = np.stack(
        [
            (
                _describe_normal(normal + step * unit, parameters[0])
                - _describe_normal(normal - step * unit, parameters[0])
            )
            / (2.0 * step)
            for unit in np.eye(4)
        ],
        axis=1,
    )
    axis, second_axis, scale = (float(value) for value in parameters)
    return TiltGeometry(
        axis,
        second_axis,
        scale,
        jacobian @ covariance @ jacobian.T,
        one,
        two,
        matches,
        float(np.sqrt(noise)),
    )


def match_densely(
    first: AnyImage,
    second: AnyImage,
    geometry: TiltGeometry,
    tilt_rad: float,
    shown: tuple[Mask | None, Mask | None] = (None, None),
) -> Disparity:
    """Find the disparity ``v' / (scale cos t) - v`` of every pixel: semi-global search, then least squares.

    Both pictures are turned so that rows are epipolar lines, and the second is stretched by 1 / cos t, so that a flat
    specimen has a constant disparity.

    Parameters
    ----------
    first, second
        (h, w) grey levels.
    geometry
        Of the two.
    tilt_rad
        Tilt of the second picture against the first.
    shown
        As of :func:`find_tilt_geometry`.
    """
    width = int(np.ceil(np.hypot(*first.shape[:2])))
    middle = 0.5 * (width - 1)
    stretch = geometry.scale * np.cos(tilt_rad)
    ours = _rows_along(geometry.axis_rad, 1.0, 1.0)
    theirs = _rows_along(geometry.second_axis_rad, geometry.scale, stretch)
    across = (geometry.second - _centre_of(second)) @ np.linalg.inv(theirs).T
    here = (geometry.first - _centre_of(first)) @ np.linalg.inv(ours).T
    # What the verified matches share is taken out, in both directions, so that the search is short.
    shift = np.median(across - here, axis=0)
    parallax = (across - here)[:, 0] - shift[0]
    reach = 1.5 * float(np.max(np.abs(np.percentile(parallax, (0.5, 99.5))))) + 8.0
    left, left_seen = _resample(first, shown[0], ours, middle, (0.0, 0.0))
    right, right_seen = _resample(second, shown[1], theirs, middle, shift)
    disparity, valid = _search(left, right, left_seen, right_seen, int(np.ceil(reach / 8.0)) * 8)
    refined, sigma = _refine(left, right, disparity, valid & left_seen, right_seen)
    refined = refined + shift[0]
    back = cv2.invertAffineTransform(_affine(ours, _centre_of(first), middle, (0.0, 0.0)))
    height, columns = first.shape[:2]
    value, spread = (
        cv2.warpAffine(
            part.astype(np.float32),
            back,
            (columns, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderValue=float("nan"),
        ).astype(np.float64)
        for part in (refined, sigma)
    )
    return Disparity(value, spread)


def _centre_of(image: AnyImage) -> Array:
    return 0.5 * (np.array(image.shape[1::-1], dtype=np.float64) - 1.0)


def _refuse_matches(seen: str) -> StructureError:
    return StructureError(
        f"{seen} between two pictures",
        expected=f"at least {MATCHES_MIN} that agree, from pictures that overlap and look alike",
        do="tilt by less between pictures, keep detector and contrast, and avoid charging",
    )


def _to_bytes(image: AnyImage) -> NDArray[np.uint8]:
    grey = image.astype(np.float32)
    low, high = np.percentile(grey, (0.1, 99.9))
    scaled = (grey - low) * (255.0 / max(high - low, 1e-12))
    return np.clip(scaled, 0, 255).astype(np.uint8)


def _match_features(
    first: AnyImage, second: AnyImage, shown: tuple[Mask | None, Mask | None]
) -> tuple[Array, Array]:
    """Match features of two images, each the best for the other; a place that has two orientations counts once."""
    finder = cv2.SIFT.create(nfeatures=8000)
    (points, described), (others, other_described) = (
        finder.detectAndCompute(_to_bytes(image), None if mask is None else mask.astype(np.uint8))
        for image, mask in zip((first, second), shown, strict=True)
    )
    if min(len(points), len(others)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forward = matcher.knnMatch(described, other_described, k=2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(other_described, described)}
    good = [
        m
        for m, rival in forward
        if m.distance < DESCRIPTOR_RATIO * rival.distance and back[m.trainIdx] == m.queryIdx
    ]
    pairs = np.array([[*points[m.queryIdx].pt, *others[m.trainIdx].pt] for m in good])
    pairs = np.unique(pairs.reshape(-1, 4), axis=0)
    return pairs[:, :2], pairs[:, 2:]


def _agree_with_neighbours(first: Array, second: Array) -> Mask:
    """Which matches are shifted as those around them in the first picture.

    A wrong match that happens to lie on its epipolar line passes every test of the epipolar geometry. One of them,
    shifted by a hundred px where relief shifts by one, outweighs a thousand right ones in the direction of the axis.
    """
    if len(first) <= MATCH_NEIGHBOURS:
        return np.ones(len(first), dtype=np.bool_)
    shifts = second - first
    around = cKDTree(first).query(first, MATCH_NEIGHBOURS + 1)[1][:, 1:]
    apart = shifts - np.median(shifts[around], axis=1)
    spread = max(mad_sigma(apart[:, 0]), mad_sigma(apart[:, 1]))
    limit = max(MATCH_TOLERANCE_PX, NEIGHBOUR_SIGMAS * spread)
    return np.asarray(np.hypot(apart[:, 0], apart[:, 1]) < limit)


def _check_overlap(first: Array, second: Array, image: AnyImage, other: AnyImage) -> None:
    """Refuse pictures of which the matches, if an affine map describes them, have too little in common."""
    design = np.column_stack([first, np.ones(len(first))])
    matrix, _, rank, _ = np.linalg.lstsq(design, second, rcond=None)
    residual = second - design @ matrix
    extent = np.array(image.shape[1::-1], dtype=np.float64)
    # Wrong matches, or too few places for an affine map, tell no overlap.
    if rank < 3 or np.max(np.std(residual, axis=0) / extent) > PARALLAX_MAX:
        return
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    seen = np.column_stack([unit * extent, np.ones(4)]) @ matrix
    frame = unit * np.array(other.shape[1::-1], dtype=np.float64)
    area = cv2.intersectConvexConvex(seen.astype(np.float32), frame.astype(np.float32))[0]
    share = float(area) / abs(float(np.linalg.det(matrix[:2]))) / float(np.prod(extent))
    if share < OVERLAP_MIN:
        x, y = seen.mean(axis=0) - frame.mean(axis=0)
        raise StructureError(
            f"the pictures share {share:.0%} of their field: the second is shifted by {x:+.0f}, {y:+.0f} px",
            expected=f"at least {OVERLAP_MIN:.0%} in common",
            do="bring the same place back to the middle after tilting, or record at a lower magnification",
        )


def _describe_normal(normal: Array, near_axis_rad: float) -> Array:
    """Axis in both pictures and scale, from the plane ``a x' + b y' + c x + d y + e = 0``."""
    a, b, c, d = normal
    axis, second = np.arctan2(-d, -c), np.arctan2(b, a)
    if np.cos(axis - near_axis_rad) < 0.0:
        axis, second = axis + np.pi, second + np.pi
    axis = near_axis_rad + np.angle(np.exp(1j * (axis - near_axis_rad)))
    second = axis + np.angle(np.exp(1j * (second - axis)))
    return np.array([axis, second, np.hypot(c, d) / np.hypot(a, b)])


def _rows_along(axis_rad: float, along: float, across: float) -> Array:
    """(2, 2) matrix from (column v, row u) of a rectified picture to (x, y)."""
    c, s = np.cos(axis_rad), np.sin(axis_rad)
    return np.array([[-s * across, c * along], [c * across, s * along]])


def _affine(
    matrix: Array, centre: Array, middle: float, shift: Array | tuple[float, float]
) -> Array:
    offset = centre + matrix @ (np.asarray(shift) - middle)
    return np.hstack([matrix, offset[:, None]])


def _resample(
    image: AnyImage,
    shown: Mask | None,
    matrix: Array,
    middle: float,
    shift: Array | tuple[float, float],
) -> tuple[Image, Mask]:
    size = round(2 * middle + 1)
    warp = _affine(matrix, _centre_of(image), middle, shift)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    out = cv2.warpAffine(
        image.astype(np.float32), warp, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    inside = np.ones(image.shape[:2], np.uint8) if shown is None else shown.astype(np.uint8)
    seen = cv2.warpAffine(
        inside, warp, (size, size), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )
    return np.asarray(out, dtype=np.float32), seen > 0


def _blur(image: Array | Image) -> Image:
    return np.asarray(
        cv2.GaussianBlur(np.asarray(image, dtype=np.float32), (0, 0), GREY_WINDOW_PX),
        dtype=np.float32,
    )


def _flatten(image: Image) -> NDArray[np.uint8]:
    """Local mean and contrast divided out, as bytes: what the search compares."""
    centred = image - cv2.GaussianBlur(image, (0, 0), 8.0)
    contrast = np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), 8.0)) + 1e-6
    return np.clip(128.0 + 42.0 * centred / contrast, 0, 255).astype(np.uint8)


def _search(
    left: Image, right: Image, left_seen: Mask, right_seen: Mask, reach: int
) -> tuple[Array, Mask]:
    """Disparity to a px, with the search from the other side as a check."""
    count = max(16, -(-2 * reach // 16) * 16)
    block = 5
    one, two = _flatten(left), _flatten(right)

    def search(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> Array:
        pad = count
        matcher = cv2.StereoSGBM.create(
            minDisparity=-count // 2,
            numDisparities=count,
            blockSize=block,
            # The penalties that OpenCV's documentation gives for one channel.
            P1=8 * block * block,
            P2=32 * block * block,
            uniquenessRatio=5,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        wide = [cv2.copyMakeBorder(i, 0, 0, pad, pad, cv2.BORDER_REPLICATE) for i in (a, b)]
        found = matcher.compute(*wide)[:, pad:-pad].astype(np.float64) / 16.0
        # OpenCV's disparity counts to the left.
        return np.where(found < -count // 2, np.nan, -found)

    forward, back = search(one, two), search(two, one)
    rows, columns = np.indices(forward.shape)
    target = columns + np.nan_to_num(np.round(forward)).astype(int)
    inside = (target >= 0) & (target < forward.shape[1]) & np.isfinite(forward)
    target = np.clip(target, 0, forward.shape[1] - 1)
    agrees = np.abs(forward + back[rows, target]) <= DISPARITY_AGREEMENT_PX
    valid = inside & agrees & left_seen & right_seen[rows, target]
    return forward, valid


def _refine(
    left: Image, right: Image, start: Array, valid: Mask, right_seen: Mask
) -> tuple[Array, Array]:
    """Fit the disparity by least squares of grey levels in a window, free in brightness and contrast."""
    weight = _blur(valid.astype(np.float32))
    disparity = np.where(
        weight > 0.3, _blur(np.where(valid, start, 0.0)) / np.maximum(weight, 1e-6), np.nan
    )
    known = np.isfinite(disparity)
    disparity = np.where(known, disparity, 0.0)
    grid = np.indices(left.shape).astype(np.float32)
    rows, columns = grid[0], grid[1]
    mean = _blur(left)
    centred = left - mean
    variance = _blur(centred**2)

    def compare() -> tuple[Image, Image]:
        at = (columns + disparity).astype(np.float32)
        warped: Image = np.asarray(
            cv2.remap(right, at, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE),
            dtype=np.float32,
        )
        other = warped - _blur(warped)
        gain = _blur(centred * other) / np.maximum(_blur(other**2), 1e-6)
        slope = gain * (
            0.5 * np.diff(warped, axis=1, prepend=warped[:, :1])
            + 0.5 * np.diff(warped, axis=1, append=warped[:, -1:])
        )
        return np.asarray(centred - gain * other, np.float32), np.asarray(slope, np.float32)

    for _ in range(MATCH_STEPS):
        residual, slope = compare()
        change = _blur(slope * residual) / np.maximum(_blur(slope**2), 1e-6)
        disparity = disparity + np.clip(change, -1.0, 1.0)
    residual, slope = compare()
    # Two free values of brightness and contrast, and the shift, over the 4 pi sigma^2 px of the window.
    cells = 4.0 * np.pi * GREY_WINDOW_PX**2
    noise = _blur(residual**2) * (cells / (cells - 3.0)) / KEPT_NOISE
    information = _blur(slope**2)
    narrow = cv2.GaussianBlur(slope**2, (0, 0), GREY_WINDOW_PX / np.sqrt(2.0))
    # sum w^2 g^2 / (sum w g^2)^2, where w^2 is a Gaussian narrower by sqrt(2) and lower by the size of the window.
    sigma = np.sqrt(NOISE_GAIN * noise * narrow / cells) / np.maximum(information, 1e-12)
    rough = disparity.copy()
    for _ in range(MATCH_STEPS):
        rough = rough - _blur(rough)
    # What the steps have not given back yet, as far as it shows.
    sigma = np.sqrt(sigma**2 + _blur(rough**2))
    correlation = np.sqrt(np.clip(1.0 - _blur(residual**2) / np.maximum(variance, 1e-12), 0.0, 1.0))
    target = np.clip(np.round(columns + disparity).astype(int), 0, left.shape[1] - 1)
    good = (
        valid
        & known
        & (correlation > GREY_CORRELATION_MIN)
        & right_seen[rows.astype(int), target]
        # A step of more than this was beyond the reach of the least squares.
        & (np.abs(disparity - start) < 2.0)
        & (sigma < DISPARITY_AGREEMENT_PX)
    )
    return np.where(good, disparity, np.nan), np.where(good, sigma, np.nan)


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
    masks: Sequence[Mask | None] | None = None,
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
    masks
        For each picture (h, w) true where it shows the specimen, or None for all of it. There are no heights where the
        window of the matching reaches what it does not show.

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
    shown = [_shrink(mask) for mask in masks or [None] * len(images)]
    pairs = []
    for other in others:
        pair = find_tilt_geometry(
            images[reference],
            images[other],
            near_axis_rad=axis_rad,
            shown=(shown[reference], shown[other]),
        )
        _check_axis(pair, axis_rad)
        pairs.append(pair)
    turns = [tilts_rad[other] - tilts_rad[reference] for other in others]
    u, v = _coordinates(images[reference].shape, pairs[0].axis_rad, pixel_size_m)
    heights, noises = [], []
    for other, pair, turn in zip(others, pairs, turns, strict=True):
        found = match_densely(
            images[reference], images[other], pair, turn, (shown[reference], shown[other])
        )
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


def _shrink(mask: Mask | None) -> Mask | None:
    """Return a mask without the pixels whose windows reach beyond it."""
    if mask is None:
        return None
    reach = int(np.ceil(WINDOW_REACH * GREY_WINDOW_PX))
    # What lies beyond the picture is no reason: it is continued there.
    kept = cv2.erode(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8))
    return np.asarray(kept > 0)


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
