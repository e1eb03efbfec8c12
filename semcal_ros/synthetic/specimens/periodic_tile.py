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

"""Periodic tiles of texture, filtered to the size of a pixel and sampled anywhere."""

from __future__ import annotations

import math

import cv2
import numpy as np

from semcal_ros.core.arrays import Array, Image


def build_pyramid(tile: Image) -> tuple[Image, ...]:
    """Build levels (n, n) or (n, n, channels) of a periodic tile, each half the size of the last.

    A pixel covers two to four texels of its level: the blur keeps what is finer than a pixel out of
    the samples.
    """
    levels = [tile]
    while len(levels[-1]) > 8:
        half, rest = len(levels[-1]) // 2, levels[-1].shape[2:]
        pairs = levels[-1].reshape(half, 2, half, 2, *rest)
        levels.append(pairs.mean(axis=(1, 3), dtype=np.float32))
    filtered = [tile] + [_blur_periodic(level, 1.1) for level in levels[1:]]
    for level in filtered:
        level.setflags(write=False)
    return tuple(filtered)


def sample_pyramid(
    pyramid: tuple[Image, ...],
    x_m: Array,
    y_m: Array,
    *,
    texel_m: float,
    pixel_m: float,
    angle_rad: float,
    shift: Array,
) -> Image | None:
    """Sample the tile, turned by an angle and shifted by fractions of its size.

    Returns None where a pixel is so large that nothing but the mean is left.
    """
    level = max(0, math.floor(math.log2(max(0.5 * pixel_m / texel_m, 1.0))))
    if level >= len(pyramid):
        return None
    tile = pyramid[level]
    size = float(len(tile))
    step = texel_m * 2.0**level
    c, s = math.cos(angle_rad) / step, math.sin(angle_rad) / step
    u = _wrap(c * x_m - s * y_m, shift[0], size)
    v = _wrap(s * x_m + c * y_m, shift[1], size)
    seen = cv2.remap(tile, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(seen, dtype=np.float32)


def _wrap(u: Array, shift: float, size: float) -> Image:
    """Reduce coordinates to one tile before they are rounded to single precision."""
    # Texel centres are at integers, so the border of the tile, where all levels agree, is at -0.5.
    u += shift * size - 0.5
    u -= size * np.floor(u / size)
    return u.astype(np.float32)


def _blur_periodic(tile: Image, sigma: float) -> Image:
    border = ((4, 4), (4, 4), (0, 0))[: tile.ndim]
    padded = np.pad(tile, border, mode="wrap")
    blurred = cv2.GaussianBlur(padded, (9, 9), sigma)[4:-4, 4:-4]
    return np.ascontiguousarray(blurred, dtype=np.float32)
