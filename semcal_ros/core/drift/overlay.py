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

from semcal_ros.core.arrays import AnyImage, Mask
from semcal_ros.core.drift.thresholds import (
    OVERLAY_CLIPPED_MIN,
    OVERLAY_ENLARGED_PX,
    OVERLAY_FILLED_PX,
    OVERLAY_LINE_PX,
    OVERLAY_NEAR_MIN,
    OVERLAY_NOISE_MIN,
    OVERLAY_PIXELS_MIN,
    OVERLAY_SAME_MAX,
    OVERLAY_SIGMAS,
    OVERLAY_TEXT_PX,
)
from semcal_ros.core.registration.fixed_pixels import grow_mask

_WINDOWS = (
    (OVERLAY_TEXT_PX, OVERLAY_TEXT_PX),
    (OVERLAY_LINE_PX, 1),
    (1, OVERLAY_LINE_PX),
)


def find_overlay(before: AnyImage, now: AnyImage) -> Mask | None:
    """(h, w) True where two pictures of one size show an overlay; None where there is none.

    Only pictures of integers tell: floats were computed, and may have lost their noise. It fails on pictures almost
    without noise, and says then that there is none; letters in the largest or the least grey level are not found.
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
    # Of the least and the largest grey level, to which parts of a specimen are clipped, only straight lines count.
    drawn = same & ((now == now.min()) | (now == now.max()))
    same &= ~drawn
    rate = float(same.mean())
    core, counted = np.zeros_like(same), same.astype(np.uint8)
    for window in _WINDOWS:
        pixels = window[0] * window[1]
        expected = pixels * rate + OVERLAY_SIGMAS * np.sqrt(pixels * rate * (1.0 - rate))
        near = cv2.boxFilter(counted, cv2.CV_16U, window, normalize=False)
        core |= same & (near >= max(expected, OVERLAY_NEAR_MIN))
        if 1 in window and np.any(drawn):
            line = cv2.boxFilter(drawn.astype(np.uint8), cv2.CV_16U, window, normalize=False)
            core |= drawn & (line >= OVERLAY_CLIPPED_MIN)
    if np.count_nonzero(core) < OVERLAY_PIXELS_MIN:
        return None
    return grow_mask(core, OVERLAY_ENLARGED_PX)


def remove_overlay(image: AnyImage, overlay: Mask) -> AnyImage:
    """The picture (h, w) or (h, w, 3) with the mean of what lies around in the place of an overlay (h, w)."""
    out = np.array(image)
    spans = [np.flatnonzero(overlay.any(axis=axis)) for axis in (1, 0)]
    if not len(spans[0]):
        return out
    # Nothing else is read: of a data bar, some rows above it.
    cut = tuple(
        slice(max(n[0] - OVERLAY_FILLED_PX, 0), n[-1] + 1 + OVERLAY_FILLED_PX) for n in spans
    )
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
