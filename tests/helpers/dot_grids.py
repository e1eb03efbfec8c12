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

"""Grids of dots, holes and crossed lines of exactly known geometry, rendered by supersampling."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from tests.helpers.corner_boards import Board


@dataclass(frozen=True)
class PatternBoard(Board):
    """A grid of dots or lines, or a grating, with spacing ``square_px``, seen by a tilted, distorted camera.

    ``size`` is the diameter of the dots, or the width of the lines, in spacings; ``contrast`` is the
    difference between dots and background, and ``noise`` the 1-sigma at the mean level, both in
    grey levels; the variance of the noise grows with the level, as that of counts. Dots whose
    indices are in ``missing`` are not there.
    """

    pattern: str = "dots"
    size: float = 0.5
    contrast: float = 100.0
    noise: float = 0.0
    missing: tuple[tuple[int, int], ...] = ()
    width: int = 240
    height: int = 200

    def _bright(self, xy: Array) -> Array:
        uv = self.board_from_image(xy)
        nearest = np.rint(uv)
        off = np.abs(uv - nearest)
        if self.pattern == "dots":
            marked = np.hypot(off[:, 0], off[:, 1]) < self.size / 2.0
        elif self.pattern == "grating":
            marked = off[:, 0] < self.size / 2.0
        else:
            marked = off.min(axis=1) < self.size / 2.0
        for i, j in self.missing:
            marked &= (nearest[:, 0] != i) | (nearest[:, 1] != j)
        return (marked != self.inverted).astype(np.float64)

    def clean(self, samples: int = 6) -> Array:
        """(h, w) part of each pixel that is bright, blurred; averaged over samples x samples."""
        margin = 8
        shape = (self.height + 2 * margin, self.width + 2 * margin)
        total = np.zeros(shape)
        steps = (np.arange(samples) + 0.5) / samples - 0.5
        y, x = np.mgrid[0.0 : shape[0], 0.0 : shape[1]] - margin
        grid = np.stack([x.ravel(), y.ravel()], axis=1)
        for dx in steps:
            for dy in steps:
                total += self._bright(grid + [dx, dy]).reshape(shape)
        blurred = cv2.GaussianBlur(total / samples**2, (0, 0), self.blur_px)
        return np.asarray(blurred[margin:-margin, margin:-margin], dtype=np.float64)

    def picture(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        """(h, w) image of 8 bits with shading and noise."""
        level = 60.0 + self.contrast * self.clean()
        x = np.arange(self.width) / self.width - 0.5
        level = level * (1.0 + self.shading * x)
        sigma = self.noise * np.sqrt(level / level.mean())
        return np.clip(np.rint(level + sigma * rng.normal(size=level.shape)), 0, 255).astype(
            np.uint8
        )
