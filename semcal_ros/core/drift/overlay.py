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

from semcal_ros.core.arrays import AnyImage, Array, Mask
from semcal_ros.core.registration.fixed_pixels import grow_mask

# Windows (width, height), px, for text and for lines, in which pixels are counted that are the same in both pictures,
# and by how many standard deviations of a binomial law there must be more than elsewhere: by chance, once in 10^9.
_WINDOWS, _MORE_SIGMAS = ((9, 9), (21, 1), (1, 21)), 6.0
# At least so many of them in a window, and in a picture.
_LEAST_NEAR, _LEAST_PIXELS = 12, 60
# How many of the pixels of a line must be the same where they may be clipped.
_LEAST_LINE = 19
# Less noise leaves pixels the same by chance; grey levels.
_LEAST_NOISE = 1.5
# Part of all pixels that may be the same: more is a picture that came again.
_MOST_SAME = 0.6
# By how much an overlay is enlarged, and the side of the square from which its place is filled, px.
_ENLARGED_PX, _FILLED_PX = 2, 21


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
    if float(same.mean()) > _MOST_SAME:
        return None
    some = now[::3, ::3].astype(np.float32) - before[::3, ::3].astype(np.float32)
    noise = 1.4826 * float(np.median(np.abs(some))) / np.sqrt(2.0)
    if noise < _LEAST_NOISE:
        return None
    # Of the least and the largest grey level, to which parts of a specimen are clipped, only straight lines count.
    drawn = same & ((now == now.min()) | (now == now.max()))
    same &= ~drawn
    rate = float(same.mean())
    core, counted = np.zeros_like(same), same.astype(np.uint8)
    for window in _WINDOWS:
        pixels = window[0] * window[1]
        expected = pixels * rate + _MORE_SIGMAS * np.sqrt(pixels * rate * (1.0 - rate))
        near = cv2.boxFilter(counted, cv2.CV_16U, window, normalize=False)
        core |= same & (near >= max(expected, _LEAST_NEAR))
        if 1 in window and np.any(drawn):
            line = cv2.boxFilter(drawn.astype(np.uint8), cv2.CV_16U, window, normalize=False)
            core |= drawn & (line >= _LEAST_LINE)
    if np.count_nonzero(core) < _LEAST_PIXELS:
        return None
    return grow_mask(core, _ENLARGED_PX)


def remove_overlay(image: AnyImage, overlay: Mask) -> AnyImage:
    """The picture (h, w) or (h, w, 3) with the mean of what lies around in the place of an overlay."""
    channels: list[Array] = []
    seen = (~overlay).astype(np.float32)
    size = (_FILLED_PX, _FILLED_PX)
    share = cv2.boxFilter(seen, cv2.CV_32F, size)
    for channel in np.moveaxis(np.atleast_3d(image), 2, 0):
        level = channel.astype(np.float32)
        around = cv2.boxFilter(level * seen, cv2.CV_32F, size) / np.maximum(share, 1e-6)
        middle = float(level[~overlay].mean()) if np.any(~overlay) else 0.0
        filled = np.where(share > 1e-3, around, middle)
        channels.append(np.where(overlay, filled, level))
    out = np.stack(channels, axis=2).reshape(image.shape)
    if image.dtype.kind in "iu":
        out = np.rint(out)
    return np.asarray(out.astype(image.dtype))
