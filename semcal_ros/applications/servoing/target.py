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

"""A planar target that shows some of its markers at every magnification, and how it is found in an image.

Square markers of a coded dictionary lie in the eight outer cells of a 3 x 3 board; the middle cell
is the same board again, a third of the size, with other markers, and so on. A marker can be read
from about 20 px up to most of the field, a factor of about 20, so that at least two levels can be
read at any magnification. The origin, in the middle of all boards, is common to all.

The corners of a marker are where straight lines meet that are fitted to the sides.

Across a side, between white border and black frame, the grey level steps once. Its position follows
from the mean over a window centred on the side: a step at delta from the middle of a window of
half-width h makes the mean ``(black (h + delta) + white (h - delta)) / 2h``. Blur does not move it,
since it is the same to both sides. A line through the steps of a side is known to a few hundredths
of a pixel, and so are the corners, where two lines meet: the corner of a blurred image itself is
rounded, and a corner detector finds it further inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.applications.servoing.thresholds import (
    CONTRAST_MIN,
    LEVELS_MAX,
    MARKER_BITS,
    MARKER_SIDE,
    PLACES_MAX,
    PLACES_MIN,
    RAGGED_PART,
    RATIO,
    SEARCH_BLUR_PX,
    SEARCHED_PX,
    SETTLED_PX,
    SIDE_ENDS,
    SIDE_MIN_PX,
    STEP_SIGMAS,
    WINDOW,
    WINDOW_MAX_PX,
    WINDOW_MIN_PX,
    WINDOW_ROUNDS,
)
from semcal_ros.core.arrays import Array, Image, Mask, check_image, check_positive
from semcal_ros.core.errors import InvalidValueError

# All cells of the 3 x 3 but the middle one.
CELLS: tuple[tuple[int, int], ...] = tuple(
    (column, row) for row in (-1, 0, 1) for column in (-1, 0, 1) if (column, row) != (0, 0)
)
"""(column, row) of the eight outer cells, in the order of their markers."""


@lru_cache(maxsize=1)
def dictionary() -> cv2.aruco.Dictionary:
    """Return the code of the markers: fifty of 4 x 4 bits, at least four bits apart."""
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


@dataclass(frozen=True)
class NestedTarget:
    """Markers in nested boards around the origin of the target.

    Parameters
    ----------
    largest_cell_m
        Side of a cell of the largest board, m; that board is three cells wide.
    levels
        Number of boards, 1 to 6.

    Raises
    ------
    InvalidValueError
        For a size that is not positive, or more levels than the code has markers for.
    """

    largest_cell_m: float = 180e-6
    levels: int = LEVELS_MAX

    def __post_init__(self) -> None:
        check_positive(self.largest_cell_m, "a target with cells of", "m")
        if not 1 <= self.levels <= LEVELS_MAX:
            raise InvalidValueError(
                f"a target with {self.levels} levels", expected=f"1 to {LEVELS_MAX}"
            )

    @property
    def size(self) -> int:
        """Number of markers, numbered 0 to ``size - 1``: eight per level, largest first."""
        return len(CELLS) * self.levels

    def cell_m(self, level: int) -> float:
        """Return the side of a cell of a level, m."""
        return self.largest_cell_m / float(RATIO**level)

    def corners_m(self, ids: NDArray[np.int64]) -> Array:
        """Return the corners (n, 4, 2) of markers in the frame of the target, m.

        They start top left in the code's orientation and go clockwise, x to the right and y down.
        """
        level, place = np.divmod(np.asarray(ids, dtype=np.int64), len(CELLS))
        cell = self.largest_cell_m / RATIO ** level.astype(np.float64)
        half = 0.5 * MARKER_SIDE
        around = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        centre = np.array(CELLS, dtype=np.float64)[place]
        corners: Array = (centre[:, None, :] + around) * cell[:, None, None]
        return corners

    def bits(self, marker: int) -> NDArray[np.uint8]:
        """Return the (6, 6) squares of a marker, row by row: 1 is white."""
        if not 0 <= marker < self.size:
            raise InvalidValueError(f"marker {marker}", expected=f"0 to {self.size - 1}")
        drawn = cv2.aruco.generateImageMarker(dictionary(), int(marker), MARKER_BITS)
        return np.asarray(np.asarray(drawn) > 127, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class TargetView:
    """Markers of a target in one image.

    Attributes
    ----------
    ids
        (n,) numbers of the markers.
    target_xy_m
        (n, 4, 2) corners of the markers in the frame of the target, m.
    xy
        (n, 4, 2) the same corners in the image, px.
    covariance_px2
        (n, 8, 8) covariance of the four corners of each.
    reason
        Why there are no markers; empty if there are some.
    """

    ids: NDArray[np.int64]
    target_xy_m: Array
    xy: Array
    covariance_px2: Array
    reason: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the target was found."""
        return not self.reason

    def with_corners(self, xy: Array) -> TargetView:
        """Return the same markers with their corners (n, 4, 2) moved."""
        return TargetView(self.ids, self.target_xy_m, xy, self.covariance_px2, self.reason)

    def select(self, keep: Mask) -> TargetView:
        """Keep some of the markers."""
        return TargetView(
            self.ids[keep],
            self.target_xy_m[keep],
            self.xy[keep],
            self.covariance_px2[keep],
            self.reason,
        )


def find_target(image: ArrayLike, target: NestedTarget) -> TargetView:
    """Find the corners of all readable markers of ``target`` to a few hundredths of a pixel.

    Parameters
    ----------
    image
        (h, w) grey levels of integers or floats; markers are dark on white.
    target
        The target to find.

    Returns
    -------
    The markers; empty, with a reason, if the target is not in view or the image is blank.

    Raises
    ------
    InvalidValueError
        If the image is not a two-dimensional array of at least 32 x 32 px.
    """
    grey = check_image(image, channels=(1,), least_side=32)
    pixels = np.ascontiguousarray(grey, dtype=np.float32)
    if not np.all(np.isfinite(pixels)):
        return _reject("the image has values that are not finite")
    factor = -(-max(pixels.shape) // SEARCHED_PX)
    stretched = _stretch(pixels, factor)
    if stretched is None:
        return _reject("image: blank")
    ids, corners = _search_markers(stretched, factor, target)
    if len(ids) == 0:
        return _reject("no marker of the target in view")
    refined = refine_quads(pixels, corners)
    if not np.any(refined.good):
        return _reject("no marker of the target with four straight sides")
    good = refined.good
    return TargetView(
        ids[good], target.corners_m(ids[good]), refined.xy[good], refined.covariance_px2[good]
    )


def _reject(reason: str) -> TargetView:
    return TargetView(
        np.empty(0, np.int64),
        np.empty((0, 4, 2)),
        np.empty((0, 4, 2)),
        np.empty((0, 8, 8)),
        reason,
    )


def _stretch(image: NDArray[np.float32], factor: int) -> NDArray[np.uint8] | None:
    """Convert to 8 bits with less noise for the search; return None for a blank image."""
    small = image
    if factor > 1:
        height, width = (side // factor for side in image.shape)
        cut = image[: height * factor, : width * factor]
        small = cut.reshape(height, factor, width, factor).mean(axis=(1, 3), dtype=np.float32)
    smooth = cv2.GaussianBlur(small, (0, 0), SEARCH_BLUR_PX)
    # Pixels that were not scanned are 0 in a rectified image and say nothing about the contrast.
    seen = smooth[smooth > 0.0]
    if seen.size < 1024:
        return None
    low, high = (float(v) for v in np.percentile(seen[:: max(seen.size // 65536, 1)], (1.0, 99.0)))
    if not high - low > 1e-6 * max(abs(high), abs(low)):
        return None
    scaled = np.clip((smooth - low) * (255.0 / (high - low)), 0.0, 255.0)
    return np.asarray(scaled, dtype=np.uint8)


@lru_cache(maxsize=1)
def _create_detector() -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    # A code with a wrong bit may just as well belong to another marker.
    parameters.errorCorrectionRate = 0.0
    parameters.minMarkerPerimeterRate = 0.04
    parameters.adaptiveThreshWinSizeMin = 5
    parameters.adaptiveThreshWinSizeMax = 45
    parameters.adaptiveThreshWinSizeStep = 20
    return cv2.aruco.ArucoDetector(dictionary(), parameters)


def _search_markers(
    image: NDArray[np.uint8], factor: int, target: NestedTarget
) -> tuple[NDArray[np.int64], Array]:
    """Find numbers (n,) and rough corners (n, 4, 2) of readable markers, px of the whole image."""
    found, numbers, _ = _create_detector().detectMarkers(image)
    if numbers is None or len(found) == 0:
        return np.empty(0, np.int64), np.empty((0, 4, 2))
    ids = np.asarray(numbers, dtype=np.int64).reshape(-1)
    corners = np.asarray(found, dtype=np.float64).reshape(-1, 4, 2)
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    # The same marker twice: one of them is something else, and nothing shows which.
    seen, count = np.unique(ids, return_counts=True)
    keep = (ids < target.size) & np.isin(ids, seen[count == 1])
    keep &= sides.min(axis=1) >= SIDE_MIN_PX
    return ids[keep], (corners[keep] + 0.5) * factor - 0.5


@dataclass(frozen=True)
class RefinedQuads:
    """Corners of n markers.

    Attributes
    ----------
    xy
        (n, 4, 2) px.
    covariance_px2
        (n, 8, 8) of the corners ``x0, y0, x1, ...`` of each.
    good
        (n,) whether all four sides were found.
    """

    xy: Array
    covariance_px2: Array
    good: Mask


@dataclass(frozen=True)
class _Line:
    """Steps along one side: ``offset + slope * tau`` outward, tau from its middle, px."""

    offset: float
    slope: float
    offset_variance: float
    slope_variance: float


def refine_quads(image: Image, corners: Array) -> RefinedQuads:
    """Refine the corners (n, 4, 2) of dark markers on white, in order, given to about 2 px."""
    count = len(corners)
    xy, covariance = np.array(corners, dtype=np.float64), np.zeros((count, 8, 8))
    good = np.zeros(count, dtype=np.bool_)
    for index in range(count):
        refined = _refine_quad(image, xy[index])
        if refined is not None:
            xy[index], covariance[index] = refined
            good[index] = True
    return RefinedQuads(xy, covariance, good)


def _refine_quad(image: Image, quad: Array) -> tuple[Array, Array] | None:
    covariance = np.zeros((8, 8))
    for _ in range(WINDOW_ROUNDS):
        before = quad
        found = [
            _measure_side(image, quad[side], quad[(side + 1) % 4], _compute_winding(quad))
            for side in range(4)
        ]
        lines = [line for line in found if line is not None]
        if len(lines) < 4:
            return None
        quad, covariance = _intersect_lines(quad, lines)
        if not np.all(np.isfinite(quad)):
            return None
        if float(np.max(np.abs(quad - before))) < SETTLED_PX:
            break
    return quad, covariance


def _compute_winding(quad: Array) -> float:
    x, y = quad[:, 0], quad[:, 1]
    return float(np.sign(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))


def _make_side_frame(first: Array, second: Array, winding: float) -> tuple[float, Array, Array]:
    """Compute the length of a side, and the unit vectors along it and outward."""
    along = second - first
    length = float(np.hypot(along[0], along[1]))
    along = along / max(length, 1e-9)
    outward = winding * np.array([along[1], -along[0]])
    return length, along, outward


def _measure_side(image: Image, first: Array, second: Array, winding: float) -> _Line | None:
    length, along, outward = _make_side_frame(first, second, winding)
    places = int(min((1.0 - 2.0 * SIDE_ENDS) * length, PLACES_MAX))
    if places < PLACES_MIN:
        return None
    half = float(np.clip(WINDOW * length, WINDOW_MIN_PX, WINDOW_MAX_PX))
    tau = np.linspace(SIDE_ENDS - 0.5, 0.5 - SIDE_ENDS, places) * length
    across = np.linspace(-half, half, 2 * int(np.ceil(2.0 * half)) + 1)
    middle = 0.5 * (first + second)
    xy = middle + tau[:, None, None] * along + across[None, :, None] * outward
    height, width = image.shape
    if xy.min() < 0.0 or xy[..., 0].max() > width - 1 or xy[..., 1].max() > height - 1:
        return None
    seen = cv2.remap(
        image,
        xy[..., 0].astype(np.float32),
        xy[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
    ).astype(np.float64)
    inner, outer = across < -0.5 * half, across > 0.5 * half
    black, white = float(seen[:, inner].mean()), float(seen[:, outer].mean())
    rough = 0.5 * float(seen[:, inner].std() + seen[:, outer].std())
    if white - black < CONTRAST_MIN * rough or white <= black:
        return None
    # The trapezoidal mean: the two ends of the window count half.
    mean = (seen.sum(axis=1) - 0.5 * (seen[:, 0] + seen[:, -1])) / (seen.shape[1] - 1)
    step = half * (black + white - 2.0 * mean) / (white - black)
    return _fit_line(tau, np.clip(step, -half, half), half)


def _fit_line(tau: Array, step: Array, half: float) -> _Line | None:
    keep = np.ones(len(tau), dtype=np.bool_)
    offset = slope = sigma = 0.0
    for _ in range(2):
        if int(keep.sum()) < PLACES_MIN:
            return None
        design = np.column_stack([np.ones(int(keep.sum())), tau[keep]])
        (offset, slope), *_ = np.linalg.lstsq(design, step[keep], rcond=None)
        left = step - offset - slope * tau
        sigma = float(np.sqrt(np.sum(left[keep] ** 2) / max(int(keep.sum()) - 2, 1)))
        keep = np.abs(left) <= max(STEP_SIGMAS * sigma, 1e-6)
    count = int(keep.sum())
    if count < PLACES_MIN or sigma > RAGGED_PART * half:
        return None
    centred = tau[keep] - tau[keep].mean()
    # Neighbouring places share pixels through interpolation, partly even when a px or two apart.
    variance = max(sigma, 1e-3) ** 2 * 1.5
    return _Line(
        float(offset), float(slope), variance / count, variance / float(np.sum(centred**2))
    )


def _intersect_lines(quad: Array, lines: list[_Line]) -> tuple[Array, Array]:
    """Intersect neighbouring lines: corners and their (8, 8) covariance."""
    winding = _compute_winding(quad)
    frames = [_make_side_frame(quad[k], quad[(k + 1) % 4], winding) for k in range(4)]
    moved, gradient = np.empty((4, 2)), np.zeros((8, 8))
    for corner in range(4):
        # The corner ends the side before it and begins its own.
        sides = ((corner - 1) % 4, corner)
        normals = np.stack([frames[side][2] for side in sides])
        taus = [0.5 * frames[sides[0]][0], -0.5 * frames[sides[1]][0]]
        shifts = np.array(
            [lines[s].offset + lines[s].slope * t for s, t in zip(sides, taus, strict=True)]
        )
        inverse = (
            np.linalg.inv(normals) if abs(np.linalg.det(normals)) > 0.1 else np.full((2, 2), np.nan)
        )
        moved[corner] = quad[corner] + inverse @ shifts
        rows = slice(2 * corner, 2 * corner + 2)
        for place, (side, tau) in enumerate(zip(sides, taus, strict=True)):
            gradient[rows, 2 * side] = inverse[:, place]
            gradient[rows, 2 * side + 1] = inverse[:, place] * tau
    variances = np.array([v for line in lines for v in (line.offset_variance, line.slope_variance)])
    return moved, (gradient * variances) @ gradient.T
