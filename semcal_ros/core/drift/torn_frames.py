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

"""Torn frames: the upper or the lower part is new, and the rest is that of the frame before, pixel by pixel.

A frame grabber delivers one where it is read while the next frame comes in. Half of such a picture stands still, and
would hold the drift, although it looks like any other.

Noise never comes twice, so lines that are the same as in the frame before are old. But what is drawn has no noise: a
data bar, a border or a blanked part are the same in all frames, and the digits of a clock in most. So only lines with
noise count, and those that did change before. Lines are compared by sums that are kept of four parts of each, so that
no picture has to be.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import AnyImage, Array, Mask
from semcal_ros.core.drift.thresholds import (
    TORN_CHANGES_MIN,
    TORN_CHECKED_LINES,
    TORN_LINE_PARTS,
    TORN_LINES_MIN,
    TORN_REVERSALS_MIN,
    TORN_SHARE_MIN,
    TORN_STEPS_MIN,
)

_Sums = NDArray[np.uint64]


@dataclass(frozen=True)
class TearTest:
    """The test of frames for old lines, one after the other. Each makes another test.

    Attributes
    ----------
    share
        Part of the lines of the latest frame that are those of the frame before; 0 where it is whole.
    now, before
        (rows, parts) sums of the lines of the latest frame and of the one before it; None where there was none.
    """

    share: float = 0.0
    now: _Sums | None = None
    before: _Sums | None = None

    def look_at(self, image: AnyImage) -> TearTest:
        """The test after one frame more, (h, w) or (h, w, 3), as it came."""
        sums = _sum_lines(image)
        if self.now is None or self.now.shape != sums.shape:
            return TearTest(now=sums)
        is_old = np.all(sums == self.now, axis=1)
        if np.all(is_old):
            # The whole frame came again, which is another matter.
            return TearTest(now=self.now, before=self.before)
        changed = np.ones(sums.shape, dtype=bool)
        if self.before is not None and self.before.shape == sums.shape:
            changed = self.now != self.before
        share = _share_of_old(image, is_old, changed)
        # What the old lines of a torn frame did before does not tell about the next one: where a picture is built up
        # while it is read twice, that one is whole.
        return TearTest(share, sums, sums if share > 0.0 else self.now)


def _share_of_old(image: AnyImage, is_old: Mask, changed: Mask) -> float:
    """Part of the lines that are old, at the top and at the bottom; 0 where that is none, or by chance."""
    whole = ~is_old
    upper, lower = int(np.argmax(whole)), int(np.argmax(whole[::-1]))
    least = max(TORN_LINES_MIN, TORN_SHARE_MIN * is_old.size)
    lines = np.concatenate([np.arange(upper), np.arange(is_old.size - lower, is_old.size)])
    lines = lines[np.any(changed[lines], axis=1)]
    if lines.size < least:
        return 0.0
    some = lines[:: -(-lines.size // TORN_CHECKED_LINES)]
    has_noise = _has_noise(image[some], changed.shape[1])
    noisy = np.count_nonzero(has_noise, axis=1)
    changed_noisy = np.count_nonzero(has_noise & changed[some], axis=1)
    told = (noisy >= 2) & (changed_noisy >= TORN_CHANGES_MIN * noisy)
    count = float(np.mean(told)) * lines.size
    return count / is_old.size if count >= least else 0.0


def _has_noise(lines: AnyImage, parts: int) -> Mask:
    """(rows, parts) whether each part of some lines has noise: its grey levels rise and fall from pixel to pixel.

    Those of a drawn text, of a flat ground or of a slope without noise do not.
    """
    grey = lines[..., 1] if lines.ndim == 3 else lines
    steps = np.sign(np.diff(grey.astype(np.float64), axis=1))
    changes, reverses = steps != 0.0, steps[:, 1:] * steps[:, :-1] < 0.0
    return np.asarray(
        (_mean_of_parts(changes, parts) >= TORN_STEPS_MIN)
        & (_mean_of_parts(reverses, parts) >= TORN_REVERSALS_MIN)
    )


def _mean_of_parts(values: Mask, parts: int) -> Array:
    """(rows, parts) means over the parts of each row."""
    bounds = np.linspace(0, values.shape[1], parts + 1).astype(np.intp)
    sums = np.pad(np.cumsum(values, axis=1), ((0, 0), (1, 0)))[:, bounds]
    return np.asarray(np.diff(sums, axis=1) / np.maximum(np.diff(bounds), 1))


def _sum_lines(image: AnyImage) -> _Sums:
    """(rows, parts) sums of the parts of each line, whose words are weighted: other grey levels have other sums."""
    height = image.shape[0]
    row = np.ascontiguousarray(image).reshape(height, -1).view(np.uint8)
    size = row.shape[1]
    if size % 8:
        row = np.pad(row, ((0, 0), (0, -size % 8)))
    words = row.view(np.uint64)
    weights, starts = _weights(words.shape[1])
    return np.asarray(np.add.reduceat(words * weights, starts, axis=1))


@lru_cache(maxsize=8)
def _weights(count: int) -> tuple[_Sums, NDArray[np.intp]]:
    """Odd weights of the words of a line, and where its parts begin."""
    rng = np.random.default_rng(0)
    weights = rng.integers(0, 2**63, count, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    parts = min(TORN_LINE_PARTS, count)
    return weights, np.linspace(0, count, parts, endpoint=False).astype(np.intp)
