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

"""The motion of what does not move with the specimen, such as a tool.

A body that moves is known by tiles only, and the ground that they show at its edge would pull its motion towards that
of the specimen. So two frames are compared pixel by pixel, at the shift of the specimen and at that of the body: what
disagrees with the first, and agrees better with the second, is the body, filled. Its shift is refined by these pixels.
How much of the ground is still among them is told by a second look, with a ring of more ground around them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from semcal_ros.core.arrays import AnyImage, Array, Image, Mask
from semcal_ros.core.drift.thresholds import (
    APART_PX_MIN,
    APART_SIGMAS,
    BODY_BEYOND_PX,
    BODY_DISAGREES,
    BODY_FLOOR_PX,
    BODY_FRAMES_MAX,
    BODY_GAINS,
    BODY_GAP_PX,
    BODY_HALVES_SIGMAS,
    BODY_LEFT_MAX,
    BODY_MARGIN_PX,
    BODY_PIXELS_MIN,
    BODY_REACH_PX,
    BODY_REST_FRAMES,
    BODY_REST_FRAMES_MAX,
    BODY_SEARCHES,
    BODY_SIGMA_PX_MAX,
    BODY_SMOOTHED_PX,
    BODY_SQUARE_PX,
    CONFIRMED_PX,
    CONFIRMED_SIGMAS,
    PART_OF_RING,
    RING_PX,
    TILE_PIXELS_MIN,
)
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.agreement import MovingTiles, fill_bodies
from semcal_ros.core.registration.fixed_pixels import grow_mask
from semcal_ros.core.registration.inverse_compositional import (
    Alignment,
    align_reweighted,
    shift_of_tiles,
)
from semcal_ros.core.registration.noise_spectrum import (
    estimate_noise_variance,
    passed_variance,
    smooth,
)
from semcal_ros.core.registration.reference import Region
from semcal_ros.core.registration.register import to_gray
from semcal_ros.core.registration.thresholds import SIDE_PX_MIN
from semcal_ros.core.registration.tiles import Pyramid, PyramidLevel, drop_pixels, make_level


@dataclass(frozen=True)
class OwnMotion:
    """Motion of the largest body that does not move with the specimen.

    Attributes
    ----------
    velocity_m_s
        (2,) displacement per s between two frames: what of the body lay at X is seen at ``X + velocity_m_s dt``, in the
        axes of the drift. It is not relative to the specimen, whose own velocity is that of the drift. In px per s
        where there is no camera.
    covariance
        (2, 2) of it.
    begin_s, end_s
        Centres of the acquisitions of the two frames, of which the later one may be some frames ago.
    """

    velocity_m_s: Array
    covariance: Array
    begin_s: float
    end_s: float


@dataclass(frozen=True)
class BodyFrame:
    """A frame in which something moves by itself.

    Attributes
    ----------
    image, region
        (h, w) or (h, w, 3) in rectified px, without the motion of the specimen during its scan, and the part of it that
        was scanned.
    moving
        Where something moves.
    drift
        (2,) drift of the specimen.
    px_from_unit
        (2, 2) px per unit of the drift.
    time_s
        Centre of its acquisition.
    """

    image: AnyImage
    region: Region
    moving: MovingTiles
    drift: Array
    px_from_unit: Array
    time_s: float


@dataclass(frozen=True)
class OwnMotionEstimator:
    """Measures the own motion of a body, from one frame to a later one again and again. Each frame makes another one.

    Attributes
    ----------
    latest
        The motion as it was measured last; None where it is not known, or nothing moves.
    guess
        Where to look the next time: as ``latest``, or a first measurement, whose start was searched for.
    base
        The frame from which it is measured next.
    since
        Number of frames since then.
    rest
        Number of frames to wait for the next one to measure from.
    failures
        Number of measurements in a row that failed.
    """

    latest: OwnMotion | None = None
    guess: OwnMotion | None = None
    base: BodyFrame | None = None
    since: int = 0
    rest: int = 0
    failures: int = 0

    def update(self, frame: BodyFrame | None) -> OwnMotionEstimator:
        """The estimator after a frame; None where nothing moves."""
        if frame is None:
            return OwnMotionEstimator()
        base = self.base
        if base is None or not _are_comparable(base, frame):
            waiting = replace(self, rest=self.rest - 1)
            if base is not None:
                waiting = replace(waiting, guess=None, latest=None)
            if waiting.rest > 0:
                return waiting
            return replace(waiting, base=_keep(frame), since=0)
        later = replace(self, since=self.since + 1)
        interval_s = frame.time_s - base.time_s
        moved_px = frame.px_from_unit @ (frame.drift - base.drift)
        expected_px = None
        if self.guess is not None:
            expected_px = interval_s * (frame.px_from_unit @ self.guess.velocity_m_s)
            is_near = float(np.hypot(*(expected_px - moved_px))) < APART_PX_MIN
            if is_near and later.since < BODY_FRAMES_MAX:
                return later
        elif later.since not in BODY_SEARCHES:
            return later
        found = measure_displacement(base, frame, moved_px, expected_px)
        if found is None:
            if expected_px is None and later.since < BODY_SEARCHES[-1]:
                # It may be a slow one.
                return later
            failures = self.failures + 1
            rest = min(BODY_REST_FRAMES * 2**failures, BODY_REST_FRAMES_MAX)
            return OwnMotionEstimator(since=later.since, rest=rest, failures=failures)
        unit_from_px = np.linalg.inv(frame.px_from_unit) / interval_s
        displacement, covariance = found
        guess = OwnMotion(
            unit_from_px @ displacement,
            unit_from_px @ covariance @ unit_from_px.T,
            base.time_s,
            frame.time_s,
        )
        if self.guess is not None and _is_confirmed(self.guess, guess, interval_s, frame):
            return OwnMotionEstimator(guess, guess, since=later.since, rest=BODY_REST_FRAMES)
        return OwnMotionEstimator(guess=guess, since=later.since)


def _is_confirmed(before: OwnMotion, now: OwnMotion, interval_s: float, frame: BodyFrame) -> bool:
    """Whether two measurements agree, but for what a body may become faster by."""
    change = now.velocity_m_s - before.velocity_m_s
    spread = before.covariance + now.covariance
    distance = float(np.hypot(*(interval_s * (frame.px_from_unit @ change))))
    return distance < CONFIRMED_PX or (
        float(change @ np.linalg.solve(spread, change)) < CONFIRMED_SIGMAS**2
    )


def _keep(frame: BodyFrame) -> BodyFrame:
    """The frame with an image of its own: a driver may use the memory again."""
    return BodyFrame(
        np.array(frame.image, copy=True),
        frame.region,
        frame.moving,
        frame.drift.copy(),
        frame.px_from_unit.copy(),
        frame.time_s,
    )


def _are_comparable(base: BodyFrame, frame: BodyFrame) -> bool:
    return (
        base.image.shape == frame.image.shape
        and frame.time_s > base.time_s
        and bool(np.allclose(base.px_from_unit, frame.px_from_unit))
    )


def measure_displacement(
    before: BodyFrame, now: BodyFrame, moved_px: Array, expected_px: Array | None
) -> tuple[Array, Array] | None:
    """Displacement of the largest body between two frames.

    Parameters
    ----------
    before, now
        The frames, of one size and scale.
    moved_px
        (2,) by how much the specimen moved.
    expected_px
        (2,) by how much the body is expected to have moved; None to search.

    Returns
    -------
    (2,) displacement in px and its (2, 2) covariance; None where it is not determined: a body without edges, one that
    moves as the specimen does or by too little, turns, or changes.
    """
    body = _find_body(before)
    if body is None:
        return None
    cut, inside = body
    left, top, right, bottom = cut
    reach = BODY_REACH_PX + BODY_MARGIN_PX
    wide = (
        max(left - reach, now.region[0]),
        max(top - reach, now.region[1]),
        min(right + reach, now.region[2]),
        min(bottom + reach, now.region[3]),
    )
    first, second = _cut(before.image, cut), _cut(now.image, wide)
    if min(second.shape) < SIDE_PX_MIN:
        return None
    noise = estimate_noise_variance(to_gray(now.image))
    smoothed = passed_variance(BODY_SMOOTHED_PX) * noise
    pair = _Pair(
        smooth(first, BODY_SMOOTHED_PX),
        smooth(second, BODY_SMOOTHED_PX),
        np.subtract(cut[:2], wide[:2]).astype(np.float64),
    )
    as_ground = pair.compare(moved_px)
    evidence = inside & (as_ground > BODY_DISAGREES * 2.0 * smoothed)
    if np.count_nonzero(evidence) < BODY_PIXELS_MIN:
        return None
    start = pair.search(evidence) if expected_px is None else expected_px
    level = make_level(Pyramid(first), 1, BODY_SMOOTHED_PX)
    if level is None or start is None:
        return None
    level = replace(level, noise_variance=smoothed)
    image = Pyramid(second)

    def show_body(shift: Array) -> Mask:
        return inside & fill_bodies(evidence & (pair.compare(shift) < as_ground), BODY_GAP_PX)

    first_px = _find_shift(level, image, show_body(start), start + pair.offset)
    if first_px is None or np.max(np.abs(first_px - pair.offset - start)) > BODY_BEYOND_PX:
        return None
    mask = show_body(first_px - pair.offset)
    best = _align(level, image, mask, first_px)
    if best is None:
        return None
    shift = best.shift_px - pair.offset
    if np.max(np.abs(shift - start)) > BODY_BEYOND_PX:
        return None
    covariance = best.covariance + BODY_FLOOR_PX**2 * np.eye(2)
    if not _is_body(best, covariance, shift - moved_px, smoothed):
        # A second look only adds to the covariance.
        return None
    with_ring = _find_shift(level, image, grow_mask(mask, RING_PX), best.shift_px)
    if with_ring is None:
        return None
    by_ring = PART_OF_RING * (with_ring - best.shift_px)
    covariance = best.covariance + np.diag(by_ring**2 + BODY_FLOOR_PX**2)
    return (shift, covariance) if _is_body(best, covariance, shift - moved_px, smoothed) else None


def _is_body(alignment: Alignment, covariance: Array, apart_px: Array, smoothed: float) -> bool:
    """Whether what was aligned is one body that moves apart from the specimen."""
    sigma = float(np.sqrt(np.max(np.linalg.eigvalsh(covariance))))
    halves = np.abs(alignment.half_difference_px) > BODY_HALVES_SIGMAS * np.sqrt(
        alignment.half_variance
    )
    return (
        sigma <= BODY_SIGMA_PX_MAX
        and BODY_GAINS[0] < alignment.gain < BODY_GAINS[1]
        and alignment.residual_rms**2 < BODY_LEFT_MAX * 2.0 * smoothed
        and not np.any(halves)
        and float(apart_px @ np.linalg.solve(covariance, apart_px)) > APART_SIGMAS**2
    )


def _find_body(frame: BodyFrame) -> tuple[Region, Mask] | None:
    """The part of a frame around its largest body, and which pixels of that part may show it."""
    tiles = frame.moving.tiles
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(
        tiles.astype(np.uint8), connectivity=8
    )
    if count < 2:
        return None
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    col, row, cols, rows = (int(v) for v in statistics[largest][:4])
    spans = []
    for axis, begin, length in ((0, col, cols), (1, row, rows)):
        corner, side = float(frame.moving.corner_px[axis]), float(frame.moving.side_px[axis])
        low = corner + side * (begin - 1) - BODY_MARGIN_PX
        high = corner + side * (begin + length + 1) + BODY_MARGIN_PX
        short = max(0.0, SIDE_PX_MIN - (high - low))
        spans.append(
            (
                max(int(np.floor(low - 0.5 * short)), frame.region[axis]),
                min(int(np.ceil(high + 0.5 * short)), frame.region[axis + 2]),
            )
        )
    (left, right), (top, bottom) = spans
    if min(right - left, bottom - top) < SIDE_PX_MIN:
        return None
    only = MovingTiles(labels == largest, frame.moving.corner_px, frame.moving.side_px, 0.0)
    x, y = np.arange(left, right, dtype=np.float64), np.arange(top, bottom, dtype=np.float64)
    return (left, top, right, bottom), only.grown().at(x, y)


def _cut(image: AnyImage, region: Region) -> Image:
    left, top, right, bottom = region
    return np.ascontiguousarray(to_gray(image[top:bottom, left:right]), dtype=np.float32)


@dataclass(frozen=True)
class _Pair:
    """Two smoothed images, of which the first lies ``offset`` (2,) right and down in the second."""

    first: Image
    second: Image
    offset: Array

    def compare(self, shift_px: Array) -> Image:
        """(h, w) squared difference about each pixel of the first where the second is shifted by so much."""
        x, y = (self.offset + shift_px).tolist()
        height, width = self.first.shape
        there = cv2.warpAffine(
            self.second,
            np.array([[1.0, 0.0, x], [0.0, 1.0, y]]),
            (width, height),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        size = (BODY_SQUARE_PX, BODY_SQUARE_PX)
        return np.asarray(cv2.boxFilter((there - self.first) ** 2, cv2.CV_32F, size))

    def search(self, mask: Mask) -> Array | None:
        """(2,) the whole shift, to 2 px, at which the second shows best what the first shows at a mask."""
        rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        part = slice(rows[0], rows[-1] + 1, 2), slice(cols[0], cols[-1] + 1, 2)
        template = np.ascontiguousarray(self.first[part])
        weight = np.ascontiguousarray(mask[part], dtype=np.float32)
        low = np.array([cols[0], rows[0]]) + self.offset - BODY_REACH_PX
        size = 2 * np.array(template.shape[::-1]) + 2 * BODY_REACH_PX
        warp = np.array([[2.0, 0.0, low[0]], [0.0, 2.0, low[1]]])
        wide = cv2.warpAffine(
            self.second,
            warp,
            (int(size[0]) // 2, int(size[1]) // 2),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        found = cv2.matchTemplate(wide, template, cv2.TM_SQDIFF, mask=weight)
        if not np.all(np.isfinite(found)):
            return None
        row, col = np.unravel_index(int(np.argmin(found)), found.shape)
        return 2.0 * np.array([col, row], dtype=np.float64) - BODY_REACH_PX


def _align(level: PyramidLevel, image: Pyramid, mask: Mask, start_px: Array) -> Alignment | None:
    """Refine a shift by the pixels of a mask alone."""
    part, counts = _keep_pixels(level, mask)
    found = align_reweighted(
        part,
        image,
        start_px,
        counts,
        lambda tiles: counts[tiles.rows, tiles.cols],
        looks=False,
    )
    return None if isinstance(found, Rejection) or not found.converged else found


def _find_shift(level: PyramidLevel, image: Pyramid, mask: Mask, start_px: Array) -> Array | None:
    """As :func:`_align`, the shift (2,) alone."""
    part, counts = _keep_pixels(level, mask)
    return shift_of_tiles(part, image, start_px, counts)


def _keep_pixels(level: PyramidLevel, mask: Mask) -> tuple[PyramidLevel, Array]:
    """The pixels of a mask alone, and which tiles (rows, cols) count then."""
    part = drop_pixels(level, ~mask)
    return part, np.asarray(part.normal_matrices[..., 3, 3] >= TILE_PIXELS_MIN, dtype=np.float64)
