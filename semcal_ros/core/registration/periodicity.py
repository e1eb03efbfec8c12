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

"""The periods of an image that repeats, from its autocorrelation, and where it repeats."""

from __future__ import annotations

import cv2
import numpy as np
import scipy.fft

from semcal_ros.core.arrays import Array, Image, Mask
from semcal_ros.core.registration.noise_spectrum import smooth
from semcal_ros.core.registration.normalised_correlation import parabola_vertex, remove_shading
from semcal_ros.core.registration.thresholds import (
    COARSE_PERIOD_MIN,
    DIP_MAX,
    PERIOD_PX_MIN,
    PERIOD_SIGMAS,
    PERIODS_SIDE_PX_MAX,
    PERIODS_SINE_MIN,
    REPEATED_MIN,
    REPEATING_PERIODS,
    REPEATING_POWER,
    REPEATING_SIGMAS,
    REPEATING_TYPICAL,
    SOFTENED_PX,
)


def find_periods(image: Image, noise_variance: float) -> Array:
    """(k, 2) periods (x, y) of an image, px, the shortest first; k is 0 where nothing repeats, 1 for lines.

    Parameters
    ----------
    image
        (h, w) grey levels.
    noise_variance
        Variance of its white noise.
    """
    rows, cols = (min(n, PERIODS_SIDE_PX_MAX) for n in image.shape)
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - cols) // 2
    part = remove_shading(np.asarray(image[top : top + rows, left : left + cols]))
    part, left = _soften(part - part.mean())
    # Lags of up to half of it do not meet those from the other end.
    size = tuple(scipy.fft.next_fast_len(n + n // 2, real=True) for n in (rows, cols))
    spectrum = scipy.fft.rfft2(part, size)
    whole = scipy.fft.irfft2(np.abs(spectrum) ** 2, size)
    high, wide = rows // 2, cols // 2
    # Lags of one half plane; the other one is its mirror image.
    lags = np.concatenate([whole[: high + 1, -wide:], whole[: high + 1, : wide + 1]], axis=1)
    y, x = np.arange(high + 1)[:, None], np.arange(-wide, wide + 1)[None, :]
    pairs = (rows - y) * (cols - np.abs(x))
    surface = lags / pairs
    structure = float(surface[0, wide]) - left * noise_variance
    if structure <= 0.0:
        return np.zeros((0, 2))
    # Where it is bright, there is more noise than where that was measured; it shows in one lag only.
    near, far = (float(surface[n, wide] + surface[0, wide + n]) / 2.0 for n in (1, 2))
    structure = float(np.clip((4.0 * near - far) / 3.0, 0.5 * structure, structure))
    surface = surface / structure
    # Where there is little structure, white noise alone makes such peaks.
    chance = PERIOD_SIGMAS * surface[0, wide] / np.sqrt(pairs)
    peaks = _find_repeats(surface, chance, wide)
    if not peaks:
        return np.zeros((0, 2))
    first = peaks[0]
    for second in peaks[1:]:
        across = abs(first[0] * second[1] - first[1] * second[0])
        if across > PERIODS_SINE_MIN * np.hypot(*first) * np.hypot(*second):
            return np.array([first, second])
    return np.array([first])


def is_fine(periods: Array, size: tuple[int, int]) -> bool:
    """Whether a period is so small a part of an image of (width, height) that a drift may be as large in one frame."""
    return float(np.min(np.hypot(*periods.T))) < COARSE_PERIOD_MIN * min(size)


def _soften(image: Image) -> tuple[Image, float]:
    """An image without more contrast anywhere than is typical of it, and what is left of a variance of white noise.

    The edges of a tool over a lattice would be most of the structure.
    """
    side = (SOFTENED_PX, SOFTENED_PX)
    variance = cv2.blur(image**2, side) - cv2.blur(image, side) ** 2
    typical = float(np.median(variance))
    factors = np.sqrt(typical / np.maximum(variance, max(typical, 1e-30)))
    return np.asarray(image * factors), float(np.mean(factors**2))


def _find_repeats(surface: Array, chance: Array, wide: int) -> list[tuple[float, float]]:
    """Lags at which the structure repeats, the shortest first.

    They are peaks beyond ``chance``, also over what is on the way to them.
    """
    least = np.maximum(REPEATED_MIN, chance)
    highest_dip = np.minimum(DIP_MAX * surface, surface - chance)
    inner = surface[1:-1, 1:-1]
    is_peak = inner >= least[1:-1, 1:-1]
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if dy or dx:
                rows, cols = surface.shape
                is_peak &= inner >= surface[1 + dy : rows - 1 + dy, 1 + dx : cols - 1 + dx]
    found = []
    for row, col in zip(*np.nonzero(is_peak), strict=True):
        y, x = float(row + 1), float(col + 1 - wide)
        length = np.hypot(x, y)
        if length < PERIOD_PX_MIN:
            continue
        steps = np.linspace(0.0, 1.0, int(2 * length) + 1)[1:-1]
        way = surface[np.rint(steps * y).astype(int), np.rint(steps * x).astype(int) + wide]
        if float(way.min()) > highest_dip[row + 1, col + 1]:
            continue
        found.append(
            (
                length,
                x + parabola_vertex(*surface[row + 1, col : col + 3]),
                y + parabola_vertex(*surface[row : row + 3, col + 1]),
            )
        )
    # Lags along the first row have their mirror image in it.
    mirrored = surface[0]
    for col in range(wide + int(PERIOD_PX_MIN), len(mirrored) - 1):
        x = float(col - wide)
        if mirrored[col] < max(least[0, col], mirrored[col - 1], mirrored[col + 1]):
            continue
        if mirrored[col] < max(surface[1, col - 1 : col + 2]):
            continue
        if float(mirrored[wide + 1 : col].min()) <= highest_dip[0, col]:
            found.append((x, x + parabola_vertex(*mirrored[col - 1 : col + 2]), 0.0))
    return [(x, y) for _, x, y in sorted(found)]


def find_repeating(image: Image, periods: Array, sigma_px: float, least_px: int) -> Mask:
    """(h, w) where an image repeats: elsewhere it shows something else than its lattice.

    Parameters
    ----------
    image
        (h, w) grey levels.
    periods
        As of :func:`find_periods`, at least one.
    sigma_px
        Width of the smoothing.
    least_px
        Least side of the squares in which it is looked at. What is smaller than one is a defect of the lattice.
    """
    side = max(least_px, round(REPEATING_PERIODS * float(np.max(np.hypot(*periods.T)))))
    smoothed = smooth(np.asarray(image, dtype=np.float32), sigma_px)
    about = smoothed - cv2.blur(smoothed, (side, side))
    # A strong defect has no more weight than the lattice around it.
    most = REPEATING_SIGMAS * float(np.sqrt(np.median(cv2.blur(about**2, (side, side)))))
    about = np.clip(about, -most, most)
    steps = [*periods, *(-periods)]
    if len(periods) == 2:
        steps += [a + b for a in (periods[0], -periods[0]) for b in (periods[1], -periods[1])]
    power, count = np.zeros((2, *about.shape), dtype=np.float32)
    height, width = about.shape
    for x, y in np.rint(steps).astype(int).tolist():
        # What lies at a place and a period farther.
        here = slice(max(0, -y), min(height, height - y)), slice(max(0, -x), min(width, width - x))
        there = slice(max(0, y), min(height, height + y)), slice(max(0, x), min(width, width + x))
        power[here] += cv2.blur(about[here] * about[there], (side, side))
        count[here] += 1.0
    power /= np.maximum(count, 1.0)
    typical = float(np.quantile(power[::4, ::4], REPEATING_TYPICAL))
    differs = (power < REPEATING_POWER * typical).astype(np.uint8)
    # Defects that lie close together hide the lattice in a few squares only.
    half = np.ones((side // 2, side // 2), np.uint8)
    larger = cv2.dilate(cv2.erode(differs, half), half)
    # Something in such a square does not repeat.
    return np.asarray(cv2.dilate(larger, np.ones((side, side), np.uint8)) == 0)
