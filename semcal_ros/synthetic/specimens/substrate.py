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

"""What lies behind a specimen: surfaces of several kinds, endless and textured at any zoom."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Image
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.synthetic.specimens.gold import GoldOnCarbon, build_pyramid, sample_pyramid
from semcal_ros.synthetic.thresholds import (
    FIBRE_ELONGATION,
    FIBRE_LAYERS,
    FINER_RMS,
    FINER_SIZE,
    GOLD_MEAN,
    GOLD_RMS,
    GROUND_SIZE_TEXELS,
    GROUND_TILE,
    REFLECTIVITY_RANGE,
    SCRATCH_LEVELS,
    SCRATCH_SPREAD_RAD,
    SCRATCHES,
)

SubstrateKind = Literal["grains", "islands", "fibres", "scratches", "smooth"]

#: The kinds of substrate.
SUBSTRATES: tuple[str, ...] = get_args(SubstrateKind)


@dataclass(frozen=True)
class Substrate:
    """A surface with a mean brightness and a texture of one kind.

    Parameters
    ----------
    kind
        ``grains``: gold on carbon, particles of all sizes. ``islands``: a film that broke up into
        patches with sharp borders. ``fibres``: paper-like, long bright threads in all directions.
        ``scratches``: a polished surface, flat but for thin bright and dark lines mostly in one
        direction. ``smooth``: slow changes only.
    level
        Mean reflectivity.
    contrast
        RMS of the texture, in reflectivity.
    size_m
        Size of its structures: the diameter of the largest grains, the width of an island, six widths
        of a fibre or a scratch, a fifth of the changes of a smooth one.
    seed
        Of the texture.

    Raises
    ------
    InvalidValueError
        If the kind is unknown, or a number out of range.
    """

    kind: SubstrateKind = "grains"
    level: float = 0.12
    contrast: float = 0.06
    size_m: float = 2e-6
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in SUBSTRATES:
            raise InvalidValueError(
                f"substrate {self.kind!r}",
                expected="one of " + ", ".join(SUBSTRATES),
                do=did_you_mean(self.kind, SUBSTRATES),
            )
        if not (0.0 <= self.level <= 1.0 and 0.0 <= self.contrast <= 0.5 and self.size_m > 0.0):
            raise InvalidValueError(
                f"a substrate of level {self.level}, contrast {self.contrast} and size {self.size_m} m",
                expected="a level of 0 to 1, a contrast of 0 to 0.5 and a finite size above 0",
            )

    @property
    def supersampling(self) -> int:
        """One: the tiles are filtered to the size of a pixel beforehand."""
        return 1

    def reflectivity(self, x_m: Array, y_m: Array, footprint_m: Array) -> Image:
        """See :class:`~semcal_ros.synthetic.specimens.grid.Specimen`."""
        if self.kind == "grains":
            gold = GoldOnCarbon(self.seed, largest_m=self.size_m, octaves=4)
            texture = (gold.reflectivity(x_m, y_m, footprint_m) - GOLD_MEAN) / GOLD_RMS
        else:
            texture = self._sample_tile(x_m, y_m, footprint_m)
        seen = np.float32(self.level) + np.float32(self.contrast) * texture
        return np.asarray(np.clip(seen, *REFLECTIVITY_RANGE), dtype=np.float32)

    def _sample_tile(self, x_m: Array, y_m: Array, footprint_m: Array) -> Image:
        pyramid = _make_pyramid(self.kind, self.seed)
        pixel_m = math.sqrt(abs(float(np.linalg.det(footprint_m))))
        texture = np.zeros(x_m.shape, dtype=np.float32)
        rng = np.random.default_rng([self.seed, 3])
        for factor, rms in ((1.0, 1.0), (FINER_SIZE, FINER_RMS)):
            seen = sample_pyramid(
                pyramid,
                x_m,
                y_m,
                texel_m=factor * self.size_m / GROUND_SIZE_TEXELS,
                pixel_m=pixel_m,
                angle_rad=float(rng.uniform(0.0, 2.0 * math.pi)),
                shift=rng.uniform(0.0, 1.0, 2),
            )
            if seen is not None:
                texture += np.float32(rms) * seen
        return np.asarray(texture / math.hypot(1.0, FINER_RMS), dtype=np.float32)


@lru_cache(maxsize=4)
def _make_pyramid(kind: str, seed: int) -> tuple[Image, ...]:
    """Make the levels (n, n) of a texture of mean 0 and RMS 1."""
    rng = np.random.default_rng([seed, 2, SUBSTRATES.index(kind)])
    draw = {
        "islands": _draw_islands,
        "fibres": _draw_fibres,
        "scratches": _draw_scratches,
        "smooth": _draw_smooth,
    }
    tile = draw[kind](rng)
    tile -= tile.mean(dtype=np.float64)
    tile /= tile.std(dtype=np.float64)
    return build_pyramid(np.ascontiguousarray(tile, dtype=np.float32))


def _draw_spectrum(rng: np.random.Generator) -> NDArray[np.complex64]:
    """Draw the spectrum of white noise on a tile."""
    noise = rng.standard_normal((GROUND_TILE, GROUND_TILE), dtype=np.float32)
    return np.asarray(scipy.fft.rfft2(noise), dtype=np.complex64)


def _filter_noise(
    spectrum: NDArray[np.complex64], along: float, across: float, angle: float = 0.0
) -> Image:
    """Blur noise by two 1-sigmas (texels) along and across a direction; RMS 1."""
    v = np.fft.fftfreq(GROUND_TILE)[:, None].astype(np.float32)
    u = np.fft.rfftfreq(GROUND_TILE)[None, :].astype(np.float32)
    c, s = math.cos(angle), math.sin(angle)
    power = (along * (c * u + s * v)) ** 2 + (across * (c * v - s * u)) ** 2
    filtered = spectrum * np.exp(np.float32(-2.0 * math.pi**2) * power)
    noise = np.asarray(scipy.fft.irfft2(filtered, s=(GROUND_TILE, GROUND_TILE)), dtype=np.float32)
    return noise / noise.std()


def _draw_islands(rng: np.random.Generator) -> Image:
    """Patches with flat tops and borders two texels wide, between bare channels."""
    sigma = 0.4 * GROUND_SIZE_TEXELS  # the patches of thresholded noise are some 2.5 sigma wide
    field = _filter_noise(_draw_spectrum(rng), sigma, sigma)
    # The slope of the noise is 1 / sigma per texel.
    patches = 1.0 / (1.0 + np.exp(-np.clip((field - 0.2) * sigma, -30.0, 30.0)))
    grain = 0.25 * _filter_noise(_draw_spectrum(rng), 1.5 * sigma, 1.5 * sigma)
    return np.asarray(patches * (1.0 + grain), dtype=np.float32)


def _draw_fibres(rng: np.random.Generator) -> Image:
    width = GROUND_SIZE_TEXELS / 6.0
    turns = rng.uniform(0.0, math.pi) + math.pi * np.arange(FIBRE_LAYERS) / FIBRE_LAYERS
    # The filters have little in common, so the layers may come from the same noise.
    spectrum = _draw_spectrum(rng)
    layers = [
        _filter_noise(spectrum, FIBRE_ELONGATION * width, width, float(turn)) for turn in turns
    ]
    return np.asarray(np.max(layers, axis=0), dtype=np.float32)


def _draw_scratches(rng: np.random.Generator) -> Image:
    tile = np.zeros((GROUND_TILE, GROUND_TILE), dtype=np.float32)
    main = rng.uniform(0.0, math.pi)
    corners = np.array(
        [[x, y] for x in (-GROUND_TILE, 0, GROUND_TILE) for y in (-GROUND_TILE, 0, GROUND_TILE)]
    )
    for level in SCRATCH_LEVELS:
        lines = np.zeros_like(tile)
        for _ in range(SCRATCHES // len(SCRATCH_LEVELS)):
            centre, turn = rng.uniform(0.0, GROUND_TILE, 2), rng.normal(main, SCRATCH_SPREAD_RAD)
            half = (
                0.5
                * rng.uniform(0.1, 0.6)
                * GROUND_TILE
                * np.array([math.cos(turn), math.sin(turn)])
            )
            width = int(rng.integers(2, 7))
            for corner in corners:
                ends = np.rint(16.0 * (centre + corner + np.stack([-half, half]))).astype(int)
                cv2.line(lines, ends[0].tolist(), ends[1].tolist(), (1.0,), width, cv2.LINE_8, 4)
        tile += np.float32(level) * lines
    blurred = cv2.GaussianBlur(np.pad(tile, 8, mode="wrap"), (0, 0), 1.2)[8:-8, 8:-8]
    grain = 0.25 * float(blurred.std()) * _filter_noise(_draw_spectrum(rng), 2.0, 2.0)
    return np.asarray(blurred + grain, dtype=np.float32)


def _draw_smooth(rng: np.random.Generator) -> Image:
    sigma = 2.0 * GROUND_SIZE_TEXELS
    return _filter_noise(_draw_spectrum(rng), sigma, sigma)
