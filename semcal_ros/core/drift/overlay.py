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

"""What is drawn into pictures and never moves: cross-hairs, scale bars and the text of a data bar.

A microscope draws them after the electrons were counted, so that they have no noise: their pixels are the same in two
pictures, where those of a specimen seldom are. They would hold a drift at zero.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import AnyImage, Array, Mask
from semcal_ros.core.drift.thresholds import (
    OVERLAY_CLIPPED_MIN,
    OVERLAY_ENLARGED_PX,
    OVERLAY_EXPECTED_MIN,
    OVERLAY_FILLED_PX,
    OVERLAY_LETTER_PIXELS_MIN,
    OVERLAY_LETTER_PX_MAX,
    OVERLAY_LETTERS_MAX,
    OVERLAY_LINE_PX,
    OVERLAY_NEAR_MIN,
    OVERLAY_NOISE_MIN,
    OVERLAY_PIXELS_MIN,
    OVERLAY_QUIET_MAX,
    OVERLAY_QUIET_SIGMAS,
    OVERLAY_SAME_MAX,
    OVERLAY_SHARP_MAX,
    OVERLAY_SIGMAS,
    OVERLAY_STEADY_MAX,
    OVERLAY_STEP_SIGMAS,
    OVERLAY_TEXT_PX,
    OVERLAY_UNCHANGED_SIGMAS,
)
from semcal_ros.core.registration.fixed_pixels import grow_mask

_WINDOWS = (
    (OVERLAY_TEXT_PX, OVERLAY_TEXT_PX),
    (OVERLAY_LINE_PX, 1),
    (1, OVERLAY_LINE_PX),
)
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_NEARBY = np.ones((2 * OVERLAY_TEXT_PX + 1, 2 * OVERLAY_TEXT_PX + 1), np.uint8)


def find_overlay(before: AnyImage, now: AnyImage) -> Mask | None:
    """(h, w) True where two pictures of one size show an overlay; None where there is none.

    Only pictures of integers tell: floats were computed, and may have lost their noise. It fails on pictures almost
    without noise, and says then that there is none. Of what is drawn in the largest or the least grey level, to which
    a specimen may be clipped, what has straight and sharp edges is found, and shapes whose border noise does not move.
    Letters that change are found beside others of their grey level.
    """
    if before.shape != now.shape or before.dtype.kind not in "iu" or now.dtype.kind not in "iu":
        return None
    if now.ndim == 3:
        before, now = before[..., 1], now[..., 1]
    same = before == now
    if float(same.mean()) > OVERLAY_SAME_MAX:
        return None
    some = now[::3, ::3].astype(np.float32) - before[::3, ::3].astype(np.float32)
    noise = 1.4826 * float(np.median(np.abs(some))) / np.sqrt(2.0)
    if noise < OVERLAY_NOISE_MIN:
        return None
    levels = now.min(), now.max()
    drawn = same & ((now == levels[0]) | (now == levels[1]))
    core = np.zeros_like(same)
    for level in map(int, levels):
        core |= _find_steady_shapes(before, now, level, noise)
        core |= _find_straight_lines(before, now, level, noise)
        core |= _find_straight_lines(before.T, now.T, level, noise).T
    same &= ~drawn
    rate = float(same.mean())
    counted = same.astype(np.uint8)
    for window in _WINDOWS:
        pixels = window[0] * window[1]
        expected = pixels * rate + OVERLAY_SIGMAS * np.sqrt(pixels * rate * (1.0 - rate))
        near = cv2.boxFilter(counted, cv2.CV_16U, window, normalize=False)
        core |= same & (near >= max(expected, OVERLAY_NEAR_MIN))
    if np.count_nonzero(core) < OVERLAY_PIXELS_MIN:
        return None
    return grow_mask(core | _find_changing_letters(before, now, core), OVERLAY_ENLARGED_PX)


def _box_around(mask: Mask, margin_px: int) -> tuple[slice, slice]:
    """The rows and columns of a mask (h, w) with anything in it, and ``margin_px`` more to each side."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return (
        slice(max(rows[0] - margin_px, 0), rows[-1] + 1 + margin_px),
        slice(max(columns[0] - margin_px, 0), columns[-1] + 1 + margin_px),
    )


def _find_steady_shapes(before: AnyImage, now: AnyImage, level: int, noise: float) -> Mask:
    """(h, w) True in shapes of one extreme grey level that no specimen has that is clipped to it.

    Where a specimen is clipped, its border is where a slope crosses the level, which noise shifts from picture to
    picture by the noise over the slope. The edge of a beam falls the faster, in its logarithm, the farther out it is,
    so that what is left of the step beside the border limits the slope. A shape that is drawn has the same pixels, and
    nothing is left of the step beside them; or what is left was mixed with the picture, and has less noise than that.
    This is asked of all shapes together, of those that are near each other, of each, and of all that do not change.
    """
    whole = (before == level) & (now == level)
    if not np.any(whole):
        return whole
    # Most pictures have next to no such pixels.
    cut = _box_around(whole, 2 * OVERLAY_TEXT_PX)
    before, now, in_both = before[cut], now[cut], whole[cut]
    in_any = (before == level) | (now == level)
    count, labels = cv2.connectedComponents(in_both.astype(np.uint8), connectivity=8)
    # Pixels beside a shape have its label; a float32 holds more labels than a picture has pixels for.
    dilated = cv2.dilate(labels.astype(np.float32), _CROSS)
    near, farther = dilated.astype(np.int32), cv2.dilate(dilated, _CROSS).astype(np.int32)
    widened = cv2.dilate(in_any.astype(np.uint8), _CROSS) > 0
    first, second = (near > 0) & ~in_any, (farther > 0) & ~widened
    border = in_both & (cv2.erode(in_any.astype(np.uint8), _CROSS) == 0)
    _, regions = cv2.connectedComponents(cv2.dilate(in_both.astype(np.uint8), _NEARBY))
    groups = np.zeros(count, np.int32)
    groups[labels[in_both]] = regions[in_both]

    def sum_up(which: NDArray[np.int32], values: Array | None = None) -> Array:
        sums: Array = np.bincount(which, values, count).astype(np.float64)
        return sums

    def step_at(place: Mask) -> Array:
        seen = before[place].astype(np.float64), now[place].astype(np.float64)
        return np.abs(0.5 * (seen[0] + seen[1]) - level)

    def change_at(place: Mask) -> Array:
        return np.abs(before[place].astype(np.float64) - now[place].astype(np.float64))

    of_shapes = [
        *(sum_up(near[first], values) for values in (None, step_at(first), change_at(first))),
        *(sum_up(farther[second], values) for values in (None, step_at(second), change_at(second))),
        sum_up(labels[border]),
        sum_up(near[in_any & ~in_both]),
    ]

    def judge(group: NDArray[np.int32]) -> tuple[Mask, Mask, Array]:
        """Of the shapes of each group together: whether they are no noise, whether they are steady, and how many pixels
        of their border noise should change.
        """
        sums = [np.bincount(group[1:], one[1:], count)[group] for one in of_shapes]
        size, farther_size = np.maximum(sums[0], 1.0), np.maximum(sums[3], 1.0)
        is_high = sums[4] > OVERLAY_STEP_SIGMAS * noise * farther_size
        step = np.where(is_high, sums[4] / farther_size, 255.0)
        # What noise alone leaves of the step is no more of an edge.
        left = 1.0 - sums[1] / size / step
        left = np.clip(left, noise / np.sqrt(size) / step, 1.0 - 1e-6)
        # The first pixels are half a pixel from the border on average.
        slope = -step * np.log(left) / 0.5
        # The mean difference of two normal deviates is 2 / sqrt(pi) of their sigma.
        expected: Array = 2.0 / np.sqrt(np.pi) * noise * sums[6] / slope
        is_steady = is_high & (sums[7] <= OVERLAY_STEADY_MAX * expected)
        # The mean size of a normal deviate is known to 0.76 of itself over the root of their number.
        chance = 0.76 * np.sqrt(1.0 / size + 1.0 / farther_size)
        quietest = np.minimum(OVERLAY_QUIET_MAX, 1.0 - OVERLAY_QUIET_SIGMAS * chance)
        is_quiet = sums[2] / size < quietest * sums[5] / farther_size
        return is_high, is_steady & (is_quiet | (left <= OVERLAY_SHARP_MAX)), expected

    alone, steady, expected = judge(np.arange(count, dtype=np.int32))
    steady = steady | judge(np.minimum(groups, 1))[1] | judge(groups)[1]
    # Digits that change beside others must not speak for them: those without any change count together, if more of the
    # border has none than chance leaves.
    expected = np.where(alone, expected, 0.0)
    unchanged = alone & (of_shapes[7] == 0) & (expected >= OVERLAY_EXPECTED_MIN)
    by_chance = np.exp(-expected)
    excess = float(expected[unchanged].sum() - (expected * by_chance).sum())
    variance = float((expected**2 * by_chance * (1.0 - by_chance)).sum())
    if excess > OVERLAY_UNCHANGED_SIGMAS * np.sqrt(variance):
        steady |= unchanged & judge(np.where(unchanged, 1, 0).astype(np.int32))[1]
    steady[0] = False
    found = np.zeros_like(whole)
    found[cut] = steady[labels]
    return found


def _find_straight_lines(before: AnyImage, now: AnyImage, level: int, noise: float) -> Mask:
    """(h, w) True in what is drawn along rows in one extreme grey level: lines, and the ground of a data bar.

    What a specimen has that is clipped to the level may be as large; but its border is not straight, or noise moves it,
    or something is left of its edge one pixel beside it.
    """
    both, either = (before == level) & (now == level), (before == level) | (now == level)
    size, border = (OVERLAY_LINE_PX, 1), cv2.BORDER_CONSTANT

    def count_along(mask: Mask) -> NDArray[np.int32]:
        found = cv2.boxFilter(
            mask.astype(np.uint8), cv2.CV_16U, size, normalize=False, borderType=border
        )
        return np.asarray(found, dtype=np.int32)

    runs = both & (count_along(both) >= OVERLAY_CLIPPED_MIN)
    if not np.any(runs):
        return runs
    beside = count_along(either) <= OVERLAY_LINE_PX - OVERLAY_CLIPPED_MIN
    step = np.abs(0.5 * (before.astype(np.float32) + now.astype(np.float32)) - level)
    step = cv2.boxFilter(step, cv2.CV_32F, size, borderType=cv2.BORDER_REPLICATE)
    allowed = OVERLAY_UNCHANGED_SIGMAS * noise / np.sqrt(OVERLAY_LINE_PX)
    edges = np.zeros_like(runs)
    for turn in (slice(None), slice(None, None, -1)):
        # Of a row, the next two after it.
        first, second = step[turn][1:-1], step[turn][2:]
        is_sharp = first >= (1.0 - OVERLAY_SHARP_MAX) * second - allowed
        edges[turn][:-2] |= runs[turn][:-2] & beside[turn][1:-1] & is_sharp
    _, labels = cv2.connectedComponents(runs.astype(np.uint8), connectivity=8)
    found = runs & np.isin(labels, np.unique(labels[edges]))
    # To the ends of the lines, for which the windows are too long.
    along = np.ones((1, OVERLAY_LINE_PX), np.uint8)
    found |= both & (cv2.dilate(found.astype(np.uint8), along) > 0)
    _, _, boxes, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8), connectivity=8)
    for x, y, width, height, area in boxes[1:].tolist():
        if 2 * area > width * height:
            # The ground of a data bar, with what is written on it, such as digits that change.
            found[y : y + height, x : x + width] = True
    return found


def _find_changing_letters(before: AnyImage, now: AnyImage, core: Mask) -> Mask:
    """(h, w) True in letters that are there in one of two pictures only, or are others in the next ones, such as those
    of a counter: they have the grey level of those that are the same in both, the ``core``, and lie beside them.
    """
    found = np.zeros_like(core)
    levels, counts = np.unique(now[core], return_counts=True)
    for level in levels[counts >= OVERLAY_PIXELS_MIN].tolist():
        either = (before == level) | (now == level)
        if float(np.mean(either & ~core)) > OVERLAY_LETTERS_MAX:
            # The specimen has this level, too.
            continue
        _, labels, boxes, _ = cv2.connectedComponentsWithStats(either.astype(np.uint8))
        sides, areas = (
            boxes[:, cv2.CC_STAT_WIDTH : cv2.CC_STAT_HEIGHT + 1],
            boxes[:, cv2.CC_STAT_AREA],
        )
        is_letter = (sides.max(axis=1) <= OVERLAY_LETTER_PX_MAX) & (
            areas >= OVERLAY_LETTER_PIXELS_MIN
        )
        is_letter[0] = False
        letters = is_letter[labels]
        near = cv2.dilate((letters | (core & either)).astype(np.uint8), _NEARBY)
        _, lines = cv2.connectedComponents(near)
        letters &= np.isin(lines, np.unique(lines[core & either]))
        for k in np.unique(labels[letters]).tolist():
            x, y, width, height = boxes[k, : cv2.CC_STAT_AREA].tolist()
            found[y : y + height, x : x + width] = True
    return found


def remove_overlay(image: AnyImage, overlay: Mask) -> AnyImage:
    """The picture (h, w) or (h, w, 3) with the mean of what lies around in the place of an overlay (h, w)."""
    out = np.array(image)
    if not np.any(overlay):
        return out
    # Nothing else is read: of a data bar, some rows above it.
    cut = _box_around(overlay, OVERLAY_FILLED_PX)
    drawn = overlay[cut]
    places, seen = np.flatnonzero(drawn), (~drawn).view(np.uint8)
    # Sums of integers are the faster ones.
    is_small = out.dtype in (np.uint8, np.uint16)
    kind, depth = (out.dtype, cv2.CV_32S) if is_small else (np.dtype(np.float32), cv2.CV_32F)
    size = (OVERLAY_FILLED_PX, OVERLAY_FILLED_PX)
    count = cv2.boxFilter(seen, cv2.CV_32S, size, normalize=False).take(places)
    is_near = count > 0
    for channel in np.moveaxis(np.atleast_3d(out), 2, 0):
        part = channel[cut].astype(kind, copy=False) * seen.astype(kind, copy=False)
        total = cv2.boxFilter(part, depth, size, normalize=False).take(places)
        filled = total / np.maximum(count, 1).astype(np.float32)
        if not np.all(is_near):
            others = channel[~overlay]
            middle = float(others.mean(dtype=np.float64)) if len(others) else 0.0
            filled = np.where(is_near, filled, middle)
        channel[cut][drawn] = np.rint(filled) if image.dtype.kind in "iu" else filled
    return out
