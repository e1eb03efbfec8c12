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

"""Drift of the background while the cantilever and its pusher move.

The tracker fits one shift to the whole image. Everything that moves on its own is therefore
smoothed away first: the beam, whose position is known, and every area that changes over the
recording by more than noise and drift explain. The covered areas are fixed to the specimen and
move with its drift; otherwise their rims would hold the tracker back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.cantilever.plane import Axis, PlaneMap
from semcal_ros.applications.cantilever.thresholds import (
    BEAM_PART_MAX,
    CELL_LIMIT,
    CELL_PX,
    DRIFT_PASSES,
    FILL_PX,
    INDEPENDENT_PX,
    MOVING_CELLS_MIN,
    MOVING_PART_MIN,
    ROUGH_ERROR_PX,
    ROUGH_SIDE_PX,
    SAME_DRIFT_PX,
    SOFT_PX,
    STILL_WEIGHT,
    STRIP_SIDE_PX,
    TEXTURE_ASPECTS,
    TEXTURE_SIDE_PX,
    TILE_MIN_PX,
    TILES,
    TILES_MIN,
)
from semcal_ros.core.arrays import Array, Image, Mask
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.reference import Region, RegistrationSettings
from semcal_ros.core.registration.register import prepare_reference, register
from semcal_ros.core.wording import omit_numbers


@dataclass(frozen=True)
class GroundRegion:
    """A part of the ground that was compared with the first frame on its own.

    Attributes
    ----------
    box_px
        Left, top, right and bottom in the first frame.
    failures
        For each frame after the first, why it was not followed or does not move with the others; None where it does.
    """

    box_px: Region
    failures: tuple[Rejection[MatchFailure] | None, ...]

    @property
    def lost(self) -> int:
        """In how many frames it was not followed."""
        return sum(failure is not None for failure in self.failures)

    @property
    def reason(self) -> str:
        """The most frequent reason; empty where it was followed in all frames."""
        kinds = Counter(omit_numbers(f.reason) for f in self.failures if f is not None)
        return kinds.most_common(1)[0][0] if kinds else ""


@dataclass(frozen=True)
class Background:
    """The drift, and the part of the image that it was measured in.

    Attributes
    ----------
    path
        Drift of all frames.
    weight
        (h, w) float32 weights of the raw pixels at zero drift: 1 where nothing moves on its own.
    regions
        Parts of the ground, each judged on its own in the first look at the drift.
    """

    path: DriftPath
    weight: Image
    regions: tuple[GroundRegion, ...] = ()


def follow_background(
    images: Sequence[NDArray[np.generic]],
    times_s: Sequence[float],
    plane: PlaneMap,
    axis: Axis,
    margin_m: float,
    on_frame: Callable[[], None] = lambda: None,
) -> Background:
    """Track the drift of one magnification's frames.

    Parameters
    ----------
    images
        (h, w) grey images of one size.
    times_s
        Start time of each acquisition.
    plane
        Coordinates of the pixels.
    axis
        The cantilever.
    margin_m
        Largest distance of the moving beam from its edges at rest.
    on_frame
        Called after each frame.
    """
    grey = [np.asarray(image, dtype=np.float32) for image in images]
    along, across = axis.coordinates(plane.x_m, plane.y_m)
    first, last = axis.visible_m
    beam = (np.abs(across) < axis.half_width_m + margin_m) & (along > first - margin_m)
    beam &= along < last + margin_m
    if axis.base_seen:
        # The holder stands still.
        beam &= along > first - 0.2 * axis.half_width_m
    shifts, regions = _estimate_rough_drift(grey, beam)
    notify = on_frame
    for _ in range(DRIFT_PASSES):
        background = _track(grey, times_s, plane, beam, shifts, notify)
        found = background.path.drift_px
        found = np.where(np.isfinite(found), found, shifts)
        if np.max(np.abs(found - shifts)) < SAME_DRIFT_PX:
            break
        shifts, notify = found, lambda: None
    return replace(background, regions=regions)


def _track(
    images: Sequence[Image],
    times_s: Sequence[float],
    plane: PlaneMap,
    beam: Mask,
    shifts: Array,
    on_frame: Callable[[], None],
) -> Background:
    """Track the drift in images whose moving areas are covered, given their shifts to some tenths of a px."""
    moving = _find_changes(images, shifts, beam)
    weight = np.asarray(np.clip(2.0 * _soften(beam | moving) - 1.0, 0.0, 1.0), dtype=np.float32)
    history = DriftHistory()
    texture = _find_texture(weight, float(np.max(np.abs(shifts))))
    # The plane of the undeformed specimen knows a shift alone.
    settings = DriftSettings(
        registration=RegistrationSettings(texture_region=texture), similarity=False
    )
    tracker = DriftTracker(settings, history=history)
    for image, time_s, shift in zip(images, times_s, shifts, strict=True):
        shifted = _shift_image(weight, shift)
        tracker.update(_cover(image, shifted), time_s, plane.camera, plane.timing)
        on_frame()
    return Background(history.smooth(), weight)


def _estimate_rough_drift(
    images: Sequence[Image], beam: Mask
) -> tuple[Array, tuple[GroundRegion, ...]]:
    """Estimate the shift of each image against the first one, (n, 2) px, to about 0.1 px, and judge its parts.

    The shift is the median over the tiles: a pusher moves or covers only some of them. Where fewer than three are
    followed, the shift of the frame before stays.
    """
    shrink = max(1, min(beam.shape) // ROUGH_SIDE_PX)
    if shrink > 1:
        size = (beam.shape[1] // shrink, beam.shape[0] // shrink)
        small = [
            np.asarray(
                cv2.resize(
                    p[: size[1] * shrink, : size[0] * shrink], size, interpolation=cv2.INTER_AREA
                ),
                dtype=np.float32,
            )
            for p in images
        ]
        reduced = beam[: size[1] * shrink : shrink, : size[0] * shrink : shrink]
        shifts_px, regions = _estimate_rough_drift(small, reduced)
        return shrink * shifts_px, tuple(
            replace(r, box_px=tuple(shrink * side for side in r.box_px)) for r in regions
        )
    height, width = beam.shape
    side = max(TILE_MIN_PX, min(height, width) // TILES)
    tiles = []
    for top in np.linspace(0, height - side, max(height // side, 1)).astype(int):
        for left in np.linspace(0, width - side, max(width // side, 1)).astype(int):
            part = slice(top, top + side), slice(left, left + side)
            if beam[part].mean() < BEAM_PART_MAX:
                tiles.append((part, prepare_reference(_cover(images[0], _soften(beam))[part])))
    shift, shifts = np.zeros(2), [np.zeros(2)]
    failures: list[list[Rejection[MatchFailure] | None]] = [[] for _ in tiles]
    spread = np.eye(2) * (0.2 * side) ** 2
    for image in images[1:]:
        covered = _cover(image, _shift_image(_soften(beam), shift))
        found = [
            register(reference, covered[part], guess_px=shift, guess_covariance=spread)
            for part, reference in tiles
        ]
        good = [f.shift_px for f in found if f.accepted]
        if len(good) >= min(TILES_MIN, len(tiles)) and good:
            shift = np.asarray(np.median(np.array(good), axis=0))
        shifts.append(shift.copy())
        for of_region, one in zip(failures, found, strict=True):
            of_region.append(one.rejection or _find_independent_motion(one.shift_px - shift))
    regions = tuple(
        GroundRegion((part[1].start, part[0].start, part[1].stop, part[0].stop), tuple(of_region))
        for (part, _), of_region in zip(tiles, failures, strict=True)
    )
    return np.array(shifts), regions


def _find_independent_motion(against_px: Array) -> Rejection[MatchFailure] | None:
    """Say so where a region moves against the others by more than they are known."""
    away_px = float(np.hypot(*against_px))
    if away_px <= INDEPENDENT_PX:
        return None
    return Rejection(MatchFailure.OUTLIER, f"moves against the others by {away_px:.2g} px")


def _find_texture(weight: Image, drift_px: float) -> Region | None:
    """Find the largest rectangle that shows the static background in all frames; None if there is none.

    What covers the moving areas is smooth and without noise, and would be taken for the images'. Beside a long beam
    only strips are left, so rectangles of several aspect ratios are tried, as squares in images that are squeezed.
    """
    margin = int(np.ceil(drift_px)) + 1
    best: Region | None = None
    area = TEXTURE_SIDE_PX**2 - 1
    still = (weight > STILL_WEIGHT).astype(np.float32)
    for aspect in TEXTURE_ASPECTS:
        squeezed = cv2.resize(still, None, fx=1.0 / aspect, fy=1.0, interpolation=cv2.INTER_AREA)
        whole = np.pad((squeezed > 1.0 - 1e-3).astype(np.uint8), 1)
        distance = cv2.distanceTransform(whole, cv2.DIST_C, 3)[1:-1, 1:-1]
        row, col = np.unravel_index(int(np.argmax(distance)), distance.shape)
        reach = int(distance[row, col]) - 1
        middle, half = int((col + 0.5) * aspect), int((reach + 0.5) * aspect)
        left, right = middle - half + margin, middle + half - margin
        top, bottom = int(row) - reach + margin, int(row) + reach + 1 - margin
        sides = right - left, bottom - top
        if min(sides) >= STRIP_SIDE_PX and sides[0] * sides[1] > area:
            area, best = sides[0] * sides[1], (left, top, right, bottom)
    return best


def _soften(beam: Mask) -> Image:
    """Return a mask that is 1 outside the beam and 0 inside, with a soft rim."""
    return np.asarray(1.0 - cv2.GaussianBlur(beam.astype(np.float32), (0, 0), SOFT_PX), np.float32)


def _shift_image(image: Image, shift: Array) -> Image:
    """Shift an image; its border pixels are repeated."""
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    size = (image.shape[1], image.shape[0])
    moved = cv2.warpAffine(
        image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved, dtype=np.float32)


def _find_changes(images: Sequence[Image], shifts: Array, beam: Mask) -> Mask:
    """Find where the image changes on its own."""
    if len(images) < 2:
        return np.zeros_like(beam)
    cells = []
    for image, shift in zip(images, shifts, strict=True):
        cells.append(_average_cells(_shift_image(image, -shift)))
    stack = np.stack(cells)
    change = stack.max(axis=0) - stack.min(axis=0)
    middle = np.median(stack, axis=0)
    gy, gx = np.gradient(middle)
    slope = np.hypot(gx, gy) / CELL_PX
    # Noise as most cells show it; it grows with the square root of the brightness.
    ground = _average_cells(beam.astype(np.float32)) < 0.5
    level = np.sqrt(np.maximum(middle / max(float(np.median(middle[ground])), 1.0), 0.25))
    usual = float(np.median((change / level)[ground]))
    limit = (1.0 + CELL_LIMIT / np.sqrt(len(stack))) * usual * level + 2.0 * ROUGH_ERROR_PX * slope
    strong = change > limit
    wide = cv2.dilate(strong.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return _enlarge(wide | _find_moving_bodies(middle, strong, ground), beam.shape)


def _find_moving_bodies(middle: Array, strong: Mask, ground: Mask) -> Mask:
    """Mask bright bodies with several changed cells, with the edges along which they slid."""
    grey = np.clip(255.0 * (middle - middle.min()) / max(float(np.ptp(middle)), 1e-9), 0.0, 255.0)
    level, _ = cv2.threshold(grey.astype(np.uint8), 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    # The beam may cut a body in two: its cells lie in between.
    bright = ((grey > level) & ground).astype(np.uint8)
    count, labels = cv2.connectedComponents(bright, connectivity=4)
    near = cv2.dilate(strong.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    moved = np.zeros_like(strong)
    for label in range(1, count):
        body = labels == label
        if int((near & body).sum()) >= max(MOVING_CELLS_MIN, MOVING_PART_MIN * int(body.sum())):
            moved |= body
    return np.asarray(cv2.dilate(moved.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool))


def _enlarge(cells: Mask, shape: tuple[int, ...]) -> Mask:
    """Expand cells to pixels; the last cells extend over the border that no whole cell covers."""
    large = np.repeat(np.repeat(cells, CELL_PX, axis=0), CELL_PX, axis=1)
    rows, cols = shape[0] - large.shape[0], shape[1] - large.shape[1]
    return np.pad(large, ((0, rows), (0, cols)), mode="edge")


def _average_cells(image: Image) -> Array:
    rows, cols = (n // CELL_PX for n in image.shape)
    cut = image[: rows * CELL_PX, : cols * CELL_PX]
    return np.asarray(cut.reshape(rows, CELL_PX, cols, CELL_PX).mean(axis=(1, 3)), dtype=np.float64)


def _cover(image: Image, weight: Image) -> Image:
    """Replace moving areas by the smooth level of the static background around them."""
    known = np.asarray(cv2.GaussianBlur(weight, (0, 0), FILL_PX), dtype=np.float32)
    level = np.asarray(cv2.GaussianBlur(image * weight, (0, 0), FILL_PX), dtype=np.float32)
    mean = float((image * weight).sum() / max(float(weight.sum()), 1.0))
    share = known / (known + np.float32(0.02))
    fill = share * level / np.maximum(known, np.float32(1e-6)) + (1.0 - share) * np.float32(mean)
    return np.asarray(weight * image + (1.0 - weight) * fill, dtype=np.float32)
