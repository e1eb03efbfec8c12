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

"""Gold on carbon: bright particles of all sizes on a dark film, endless, textured at any zoom.

Its texture is periodic tiles, filtered to the size of a pixel and sampled anywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from semcal_ros.core.arrays import Array, Image
from semcal_ros.synthetic.thresholds import (
    GOLD_COVERAGE,
    GOLD_MARGIN,
    GOLD_RADII_TEXELS,
    GOLD_TILE,
    OCTAVE_ROTATION_RAD,
)


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


@dataclass(frozen=True)
class GoldOnCarbon:
    """Particles on a periodic tile, laid over each other at several octaves of size, the small ones
    on top.

    Every octave turns, shifts and shrinks the tile, so that the whole does not repeat within any
    field of view. Octaves that are smaller than a pixel contribute their mean, so a change of
    magnification shows the same specimen.

    Parameters
    ----------
    seed
        Seed of the particles.
    largest_m
        Diameter of the largest particles.
    octaves
        Number of octaves.
    ratio
        Ratio of the sizes of successive octaves.
    carbon
        Reflectivity of the bare film.
    """

    seed: int = 0
    largest_m: float = 40e-6
    octaves: int = 6
    ratio: float = 4.0
    carbon: float = 0.06

    @property
    def supersampling(self) -> int:
        """One: the tiles are filtered to the size of a pixel beforehand."""
        return 1

    def reflectivity(self, x_m: Array, y_m: Array, footprint_m: Array) -> Image:
        """See :class:`~semcal_ros.synthetic.specimens.grid.Specimen`."""
        pixel_m = math.sqrt(abs(float(np.linalg.det(footprint_m))))
        seen = np.full(x_m.shape, self.carbon, dtype=np.float32)
        for octave in range(self.octaves):
            texel_m = self.largest_m / (2.0 * GOLD_RADII_TEXELS[1]) / self.ratio**octave
            cover, light = self._octave(octave, texel_m, pixel_m, x_m, y_m)
            seen *= 1.0 - cover
            seen += light
        return seen

    def _octave(
        self, octave: int, texel_m: float, pixel_m: float, x_m: Array, y_m: Array
    ) -> tuple[Image | np.float32, Image | np.float32]:
        """Return the cover of the particles of one octave, and their light (already times the cover)."""
        pyramid, mean = _make_pyramid(self.seed)
        seen = sample_pyramid(
            pyramid,
            x_m,
            y_m,
            texel_m=texel_m,
            pixel_m=pixel_m,
            angle_rad=OCTAVE_ROTATION_RAD * (octave + 1),
            shift=np.random.default_rng([self.seed, octave]).uniform(0.0, 1.0, 2),
        )
        return (mean[0], mean[1]) if seen is None else (seen[..., 0], seen[..., 1])


@lru_cache(maxsize=4)
def _make_pyramid(seed: int) -> tuple[tuple[Image, ...], Image]:
    """Make levels (n, n, 2) of cover and light, and their means (2,)."""
    tile = _draw_tile(np.random.default_rng([seed, 1]))
    return build_pyramid(tile), tile.mean(axis=(0, 1), dtype=np.float64).astype(np.float32)


def _draw_tile(rng: np.random.Generator) -> Image:
    """Draw one periodic tile (n, n, 2): cover in 0..1, and light = cover times brightness."""
    span = np.arange(-GOLD_MARGIN, GOLD_MARGIN + 1)
    tile = np.zeros((GOLD_TILE, GOLD_TILE, 2), dtype=np.float32)
    covered = 0.0
    while covered < GOLD_COVERAGE * GOLD_TILE * GOLD_TILE:
        # Small particles are more frequent: log-uniform radii.
        radius = float(np.exp(rng.uniform(*np.log(GOLD_RADII_TEXELS))))
        centre = rng.uniform(0.0, GOLD_TILE, 2)
        brightness = rng.uniform(0.25, 0.95)
        covered += math.pi * radius * radius
        first = np.floor(centre).astype(np.intp)
        window = np.ix_((first[0] + span) % GOLD_TILE, (first[1] + span) % GOLD_TILE)
        offset = (first - centre)[:, None] + span
        distance = np.hypot(offset[0][:, None], offset[1][None, :])
        cover, light = _draw_particle(distance, radius, brightness)
        tile[window] *= 1.0 - cover[..., None]
        tile[window] += np.stack([cover, light], axis=-1)
    return tile


def _draw_particle(distance: Array, radius: float, brightness: float) -> tuple[Image, Image]:
    """Draw a ball as secondary electrons show it: brighter at its rim, its edge two texels wide."""
    cover = np.clip((radius - distance) / 2.0 + 0.5, 0.0, 1.0)
    rim = np.minimum(distance / radius, 1.0) ** 4
    light = cover * brightness * (0.72 + 0.28 * rim)
    return cover.astype(np.float32), light.astype(np.float32)
