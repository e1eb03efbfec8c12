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

"""Grains of five octaves, and a scanning microscope that sees them: no code in common with the package.

The specimen is an endless film of grains, Gaussian bumps of five sizes that differ by factors. A pixel with a Gaussian
beam sees each bump wider and lower, which has a closed form, so that every picture is exact at every magnification.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["Grains", "Scope", "draw_scope", "take_picture"]

Array = NDArray[np.float64]
# A bump is drawn out to this many of its (blurred) sigmas at least: exp(-0.5 * 3.2^2) is 0.6 %.
_REACH = 3.2


@dataclass(frozen=True)
class Grains:
    """Bumps of some sizes, of each one about per cell of a square lattice."""

    seed: int
    sigmas_m: tuple[float, ...] = tuple(4e-9 * 3.0**k for k in range(5))
    cell: float = 3.5

    def brightness(self, x: Array, y: Array, beam_m: float) -> Array:
        """Brightness at places (n,) in m under a beam of this sigma, mean 0 and variance about 1 per size."""
        total = np.zeros_like(x)
        for number, sigma in enumerate(self.sigmas_m):
            total += self._one_size(number, sigma, x, y, beam_m)
        return total

    def _one_size(self, number: int, sigma: float, x: Array, y: Array, beam_m: float) -> Array:
        side = self.cell * sigma
        wide = math.hypot(sigma, beam_m)
        # Of bumps that are far smaller than the beam next to nothing is left.
        if sigma**2 / wide**2 < 0.05:
            return np.zeros_like(x)
        reach = math.ceil(_REACH * wide * 1.3 / side)
        column, row = np.floor(x / side).astype(np.int64), np.floor(y / side).astype(np.int64)
        left, top = int(column.min()) - reach, int(row.min()) - reach
        shape = (int(row.max()) + reach - top + 1, int(column.max()) + reach - left + 1)
        places = _hash(
            self.seed * 16 + number,
            np.arange(top, top + shape[0])[:, None],
            np.arange(left, left + shape[1])[None, :],
        )
        px = ((np.arange(left, left + shape[1])[None, :] + places[0]) * side).astype(np.float32)
        py = ((np.arange(top, top + shape[0])[:, None] + places[1]) * side).astype(np.float32)
        own = (sigma * (0.7 + 0.6 * places[2])) ** 2
        variance = own + beam_m**2
        height = ((2.0 * places[3] - 1.0) * own / variance).astype(np.float32)
        falling = (-0.5 / variance).astype(np.float32)
        index = (row - top) * shape[1] + (column - left)
        # Single precision is enough relative to the corner of what is seen.
        x0, y0 = left * side, top * side
        px, py = (px - np.float32(x0)).ravel(), (py - np.float32(y0)).ravel()
        height, falling = height.ravel(), falling.ravel()
        u, v = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
        total = np.zeros(len(x), dtype=np.float32)
        for down in range(-reach, reach + 1):
            for across in range(-reach, reach + 1):
                k = index + (down * shape[1] + across)
                distance = (u - px[k]) ** 2 + (v - py[k]) ** 2
                total += height[k] * np.exp(distance * falling[k])
        return total.astype(np.float64)


def _hash(seed: int, row: NDArray[np.int64], column: NDArray[np.int64]) -> list[Array]:
    """Four numbers from 0 to 1 for every cell of a lattice."""
    with np.errstate(over="ignore"):
        mixed = row.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed = mixed + column.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
        mixed = mixed + np.uint64(seed + 1) * np.uint64(0x165667B19E3779F9)
        numbers = []
        for _ in range(4):
            mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            mixed = mixed ^ (mixed >> np.uint64(31))
            numbers.append((mixed >> np.uint64(11)).astype(np.float64) / 2.0**53)
    return numbers


@dataclass(frozen=True)
class Scope:
    """A microscope: laws of its camera over the magnification.

    ``law`` returns, at a magnification, pixels per m along x and y, a skew (px per m of y along x), radial and
    decentring distortion in half widths, and the centre of the distortion, px.
    """

    width: int
    height: int
    display_m: float
    law: Callable[[float], tuple[float, float, float, float, float, float, float]] = field(
        repr=False
    )
    frame_s: float = 4.0
    electrons: float = 400.0

    def metres(self, g: float, x: Array, y: Array, scale: float = 1.0) -> tuple[Array, Array]:
        """Places (n,) in m, about the middle of the picture, of raw pixels (n,); ``scale`` is that of the visit."""
        mx, my, skew, radial, tangential, ex, ey = self.law(g)
        half = 0.5 * self.width
        # Undistort: the raw pixel is q times 2 / (1 + sqrt(1 - 4 radial q^2)), plus the decentring.
        dx, dy = (x - ex) / half, (y - ey) / half
        qx, qy = dx.copy(), dy.copy()
        for _ in range(60):
            r2 = qx * qx + qy * qy
            factor = 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * radial * r2))
            qx = (dx - tangential * (r2 + 2.0 * qx * qx)) / factor
            qy = (dy - tangential * (r2 + 2.0 * qy * qy)) / factor
        u = ex + half * qx - 0.5 * (self.width - 1)
        v = ey + half * qy - 0.5 * (self.height - 1)
        place_y = v / (my * scale)
        return (u / scale - skew * place_y) / mx, place_y


def draw_scope(
    rng: np.random.Generator,
    size: int = 384,
    relay: tuple[float, float] | None = (31000.0, 0.005),
) -> Scope:
    """Draw a microscope with a relay: the magnification from which its scale differs, and by how much."""
    display = float(rng.uniform(0.1, 0.3))
    end, fall = rng.uniform(-0.02, 0.02), rng.uniform(-0.01, 0.01)
    aspect = 1.0 + rng.uniform(-0.006, 0.006), rng.uniform(-0.006, 0.006)
    skew = rng.uniform(-0.004, 0.004, 2)
    radial = rng.uniform(-0.008, 0.008), rng.uniform(-0.003, 0.003)
    tangential = rng.uniform(-0.001, 0.001, 2)
    middle = 0.5 * (size - 1) + size * rng.uniform(-0.06, 0.06, 2)
    moved = size * rng.uniform(-0.015, 0.015, 2)
    bend = float(np.exp(rng.uniform(np.log(3e3), np.log(2e4))))

    def law(g: float) -> tuple[float, float, float, float, float, float, float]:
        late = g / (g + bend)
        jump = 1.0 if relay is None or g < relay[0] else 1.0 + relay[1]
        m = g * size / display * (1.0 + end + fall * late) * jump
        ratio = aspect[0] + aspect[1] * late**2
        lens = radial[0] + radial[1] * late, tangential[0] + tangential[1] * late
        ex, ey = (middle + moved * late).tolist()
        return m * ratio, m / ratio, m * float(skew[0] + skew[1] * late), *map(float, lens), ex, ey

    return Scope(size, size, display, law)


def take_picture(
    scope: Scope,
    grains: Grains,
    g: float,
    *,
    at_m: tuple[float, float],
    turn_rad: float,
    drift_m: Callable[[Array], Array],
    start_s: float,
    rng: np.random.Generator,
    visit_scale: float = 1.0,
    jitter_px: float = 0.02,
    tilt: tuple[float, float] = (0.0, 0.0),
    pivot_m: float = 0.02,
) -> NDArray[np.uint8]:
    """Take a picture of the specimen around a place, with the scan turned; each pixel is seen at its own time.

    ``drift_m`` returns places (n, 2) of the specimen at times (n,). ``tilt`` is the slope of the specimen, which
    the pivot of the scan turns into a perspective.
    """
    rows, columns = np.mgrid[0 : scope.height, 0 : scope.width].astype(np.float64)
    jitter = rng.normal(0.0, jitter_px, scope.height)
    x, y = scope.metres(g, (columns + jitter[:, None]).ravel(), rows.ravel(), visit_scale)
    times = start_s + (rows + 0.9 * columns / scope.width).ravel() / scope.height * scope.frame_s
    # A turned scan shows the specimen turned the other way about the axis.
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    x, y = cos * x + sin * y, -sin * x + cos * y
    height = tilt[0] * (x + at_m[0]) + tilt[1] * (y + at_m[1])
    x, y = x * (1.0 + height / pivot_m), y * (1.0 + height / pivot_m)
    moved = drift_m(times)
    pixel_m = 1.0 / scope.law(g)[0]
    seen = grains.brightness(x + at_m[0] - moved[:, 0], y + at_m[1] - moved[:, 1], 0.6 * pixel_m)
    level = 0.45 + 0.14 * seen.reshape(scope.height, scope.width)
    counts = rng.poisson(np.clip(level, 0.02, None) * scope.electrons) / scope.electrons
    return np.clip(255.0 * counts, 0, 255).round().astype(np.uint8)
