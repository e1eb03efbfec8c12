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

"""Pictures of calibration grids as a scanning electron microscope shows them, with the true places of their points.

Nothing here is shared with the detection. A picture depends on nothing but the seed and its index.

    grid           (u, v) in pitches, points of the lattice at whole numbers; for chess a pitch is the side of a square
    plane          (X, Y) = pitch R(turn) ((u, v) - origin), px about the middle of the picture
    tilt           (x, y, z) = T(axis, tilt) (X, Y, 0),  s = (x, y) / (1 + z / pivot)
    lens           about e, with q = (middle + s - e) / n, n half the width: e + n q (1 + k q*q)
    scan           the pixel of column c in line r shows what is at (c + jitter(r), r)

What is in view is described by signed distances from edges, in pitches, negative in the motif. Divided by their
gradient along pixels, they give the part of a pixel that the motif covers. The beam's blur comes next, then the jitter
of the lines, the shot noise, and the grey values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from benchmarks.calibration.draws import Draws

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

KINDS = ("chess", "dots", "holes", "pads", "lines", "crosses", "mesh")
LEAST_WIDTH, LARGEST_WIDTH = 384, 4096
LEAST_PITCH_PX = 10.0
# The arms of crosses and lines would be thinner than 1.5 px.
LEAST_LINED_PITCH_PX = 20.0
LARGEST_PITCH = 1.0 / 3.0
FEWEST_POINTS = 16
LARGEST_TILT_RAD = np.radians(50.0)
LEAST_BLUR_PX, LARGEST_BLUR_PX, LARGEST_BLUR = 0.5, 4.0, 0.12
# Distance of a whole motif from noise, in sigmas; 5 is what is just seen anywhere.
LEAST_VISIBILITY = 12.0
# The arms of crosses, foreshortened, in sigmas of the blur: with less they look like dots.
LEAST_ARM = 5.0
# Of the amplifier, in electrons.
AMPLIFIER_NOISE = 0.3
# Bright level with gradients and texture, in units of that without.
HEADROOM = 1.25
# A pixel has a width.
_PIXEL_VARIANCE = 1.0 / 12.0
_ROWS_AT_ONCE = 48
_FAR = 9.0
_TRIES = 30


@dataclass(frozen=True)
class Blob:
    """Dust: where it is, px, and how it looks.

    Its edge is at ``radius_px (1 + sum_k wobbles[k] cos((k + 2) angle + phases[k]))``; ``level`` is in units of the
    bright level of the grid if it is bright, else of the dark one.
    """

    x: float
    y: float
    radius_px: float
    is_bright: bool
    level: float
    wobbles: tuple[float, ...]
    phases: tuple[float, ...]

    def reach_px(self, dx: Array, dy: Array) -> Array:
        """Distance of the edge from the middle in the direction (dx, dy)."""
        angle = np.arctan2(dy, dx)
        terms = zip(range(2, 99), self.wobbles, self.phases)  # noqa: B905
        return self.radius_px * (1.0 + sum(a * np.cos(k * angle + phase) for k, a, phase in terms))


@dataclass(frozen=True)
class Look:
    """A grid, where it lies, and how the microscope shows it.

    Lengths in px or in pitches, angles in rad, levels in electrons per pixel or as parts.

    Attributes
    ----------
    size, length
        Diameter of dots, side of pads, width of lines, arms and bars; half the length of crosses; in pitches.
    rounding, growth
        Radius of the corners, and how far the squares of a chess board are too large on each side, in pitches.
    region, region_at, region_extent
        "all", "half" (of the grid, cut along a line of it) or "disc", in grid coordinates.
    contrast
        (bright - dark) / (bright + dark).
    electrons
        Per pixel at the bright level.
    rim, rim_width
        Brightening of edges in units of the difference of the levels, and its sigma in pitches.
    roughness, roughness_length
        RMS displacement of the edges, and its correlation length, in pitches.
    gradient, vignetting
        Change of the brightness from the middle to the rim of the picture.
    """

    seed: int
    index: int
    kind: str
    width: int
    height: int
    pitch_px: float
    origin: tuple[float, float]
    turn_rad: float
    tilt_rad: float
    axis_rad: float
    pivot_px: float
    centre_px: tuple[float, float]
    radial: float
    size: float
    length: float
    rounding: float
    growth: float
    inverted: bool
    region: str
    region_at: tuple[float, float]
    region_extent: float
    missing: float
    blur_px: float
    jitter_px: float
    contrast: float
    electrons: float
    rim: float
    rim_width: float
    roughness: float
    roughness_length: float
    gradient: tuple[float, float]
    vignetting: float
    texture: float
    texture_length_px: float
    dust: tuple[Blob, ...]
    bits: int
    grey_range: float
    black: float

    @property
    def middle(self) -> Array:
        return 0.5 * (np.array([self.width, self.height], dtype=np.float64) - 1.0)

    @property
    def megapixels(self) -> float:
        return 1e-6 * self.width * self.height

    @property
    def is_partial(self) -> bool:
        return self.region != "all"

    @property
    def dark(self) -> float:
        """Electrons per pixel at the dark level."""
        return self.electrons * (1.0 - self.contrast) / (1.0 + self.contrast)

    @property
    def _tilted(self) -> tuple[Array, Array]:
        """(2, 2) from grid coordinates to px without perspective, and (2,) to depth in px."""
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        along = np.array([np.cos(self.axis_rad), np.sin(self.axis_rad)])
        across = np.array([-along[1], along[0]])
        tilt = np.outer(along, along) + np.cos(self.tilt_rad) * np.outer(across, across)
        turn = self.pitch_px * np.array([[c, -s], [s, c]])
        return tilt @ turn, np.sin(self.tilt_rad) * across @ turn

    def project(self, grid: Array) -> Array:
        """(n, 2) px of points (n, 2) of the grid, without the jitter of the lines."""
        linear, depth = self._tilted
        off = grid - np.array(self.origin)
        seen = off @ linear.T / (1.0 + off @ depth / self.pivot_px)[:, None]
        norm, centre = 0.5 * self.width, np.array(self.centre_px)
        q = (self.middle + seen - centre) / norm
        return centre + norm * q * (1.0 + self.radial * np.sum(q * q, axis=1, keepdims=True))

    def find_grid(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Grid coordinates of pixels; ``x`` and ``y`` are broadcast."""
        norm, (ex, ey) = 0.5 * self.width, self.centre_px
        qx, qy = (x - ex) / norm, (y - ey) / norm
        bend = self.radial * (qx * qx + qy * qy)
        factor = np.ones_like(bend)
        for _ in range(3):
            square = bend * factor * factor
            factor = factor - (factor * (1.0 + square) - 1.0) / (1.0 + 3.0 * square)
        sx = ex + norm * qx * factor - self.middle[0]
        sy = ey + norm * qy * factor - self.middle[1]
        linear, depth = self._tilted
        (a, b), (c, d) = np.linalg.inv(linear)
        u, v = a * sx + b * sy, c * sx + d * sy
        nearer = 1.0 - (depth[0] * u + depth[1] * v) / self.pivot_px
        return self.origin[0] + u / nearer, self.origin[1] + v / nearer

    def is_on_grid(self, u: Array, v: Array) -> Flags:
        """Whether places in grid coordinates belong to the part that the grid covers."""
        u, v = np.broadcast_arrays(u, v)
        if self.region == "half":
            along = u if self.region_at[0] != 0.0 else v
            side = self.region_at[0] + self.region_at[1]
            return side * along <= self.region_extent
        if self.region == "disc":
            return np.hypot(u - self.region_at[0], v - self.region_at[1]) <= self.region_extent
        return np.ones(u.shape, dtype=bool)


@dataclass(frozen=True)
class Truth:
    """Points of the lattice that a detection may find.

    Attributes
    ----------
    ij, xy
        (n, 2) indices and positions, px, of the points that can be seen: their cell is in the picture and on the grid,
        and they are neither missing nor under dust. The image of the axes is right-handed.
    other_ij, other_xy
        (k, 2) of those that can be seen in part: at the rim of the picture or of the grid, under dust, or with a
        neighbour missing.
    pitch_px
        Larger singular value of the map from the grid to the middle of the picture, px per pitch.
    """

    ij: Indices
    xy: Array
    other_ij: Indices
    other_xy: Array
    pitch_px: float


@dataclass(frozen=True)
class Picture:
    """(h, w) grey values of 8 or 16 bits, and what is true."""

    image: NDArray[np.uint8] | NDArray[np.uint16]
    truth: Truth


# -- what is there and what is missing -------------------------------------------------------------


@dataclass(frozen=True)
class _Layout:
    """Which elements there are: (m, n) flags by index, the first one at ``low``.

    An element is a white square or an opening between (i, j) and (i + 1, j + 1), or the motif at (i, j). Of lines,
    ``breaks`` (2, m, n) tells whether those along u and v are broken between a crossing and the next one.
    """

    low: tuple[int, int]
    there: Flags
    breaks: Flags

    def has(self, i: Indices, j: Indices) -> Flags:
        return self.there[i - self.low[0], j - self.low[1]]

    def is_broken(self, along: int, i: Indices, j: Indices) -> Flags:
        return self.breaks[along, i - self.low[0], j - self.low[1]]


@lru_cache(maxsize=4)
def _lay_out(look: Look) -> _Layout:
    rng = np.random.default_rng((look.seed, look.index, 2))
    reach = 4.0 * look.blur_px + 16.0
    x = np.linspace(-reach, look.width + reach, 33)
    y = np.linspace(-reach, look.height + reach, 33)[:, None]
    u, v = look.find_grid(x, y)
    low = int(np.floor(u.min())) - 3, int(np.floor(v.min())) - 3
    i = np.arange(low[0], int(np.ceil(u.max())) + 4)[:, None]
    j = np.arange(low[1], int(np.ceil(v.max())) + 4)
    half = 0.5 if look.kind in ("chess", "mesh") else 0.0
    on_grid = look.is_on_grid(i + half, j + half)
    missing = rng.uniform(size=on_grid.shape) < look.missing
    breaks = np.zeros((2, *on_grid.shape), dtype=bool)
    if look.kind == "lines":
        breaks = rng.uniform(size=breaks.shape) < 0.5 * look.missing
        missing = np.zeros_like(on_grid)
    there = on_grid & ~missing
    if look.kind == "chess":
        there &= (i + j) % 2 == 0
    return _Layout(low, there, breaks)


def _judge_points(look: Look, ij: Indices, between: bool) -> tuple[Flags, Flags]:
    """(n,) whether points of the lattice are whole, and whether something of them is there."""
    layout = _lay_out(look)
    i, j = ij.T
    if between and look.kind != "mesh":
        number = np.sum([layout.has(i + a, j + b) for a in (0, 1) for b in (0, 1)], axis=0)
        return number == 4, number >= 2
    if between:
        return layout.has(i, j), layout.has(i, j)
    if look.kind in ("chess", "mesh"):
        around = [layout.has(i - a, j - b) for a in (0, 1) for b in (0, 1)]
        number = np.sum(around, axis=0)
        if look.kind == "mesh":
            return number == 4, number >= 2
        return number == 2, number >= 1
    there = layout.has(i, j)
    if look.kind != "lines":
        return there, there
    broken = layout.is_broken(0, i, j) | layout.is_broken(0, i - 1, j)
    broken |= layout.is_broken(1, i, j) | layout.is_broken(1, i, j - 1)
    around = [layout.has(i + a, j + b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    return there & ~broken & np.all(around, axis=0), there


def find_truth(look: Look, between: bool = False) -> Truth:
    """The points of the lattice that can be seen.

    With ``between``, those half a pitch further along both axes: crossings of the gaps between pads, and middles of the
    openings between lines.
    """
    half = 0.5 if between else 0.0
    layout = _lay_out(look)
    shape = layout.there.shape
    i, j = np.meshgrid(*(np.arange(2, n - 2) for n in shape), indexing="ij")
    ij = np.stack([i.ravel(), j.ravel()], axis=1) + layout.low
    xy = look.project(ij + half)
    size = np.array([look.width, look.height])
    near = np.all((xy > -0.5) & (xy < size - 0.5), axis=1)
    ij, xy = ij[near], xy[near]
    # The corner of squares needs no more than what shows four edges.
    reach = 0.2 if look.kind == "chess" else 0.5
    inside = np.all((xy > 3.0) & (xy < size - 4.0), axis=1)
    for a in (-reach, reach):
        for b in (-reach, reach):
            corner = look.project(ij + half + [a, b])
            inside &= np.all((corner > -0.5) & (corner < size - 0.5), axis=1)
    whole, there = _judge_points(look, ij, between)
    for blob in look.dust:
        off = xy - [blob.x, blob.y]
        edge = blob.reach_px(off[:, 0], off[:, 1]) + 2.0 * look.blur_px
        inside &= np.hypot(off[:, 0], off[:, 1]) > edge
    seen, other = inside & whole, there & ~(inside & whole)
    steps = 1e-3 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    u, v = look.find_grid(look.middle[0], look.middle[1])
    ends = look.project(np.array([u, v]) + steps)
    local = np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=1) / 2e-3
    pitch = float(np.linalg.svd(local, compute_uv=False)[0])
    return Truth(ij[seen], xy[seen], ij[other], xy[other], pitch)


# -- signed distances ------------------------------------------------------------------------------

Distances = tuple[Array, Array, Array]


def _box(u: Array, v: Array, half_u: float, half_v: float, radius: float) -> Distances:
    """Distance from a box about the origin with round corners, and its gradient."""
    a, b = np.abs(u) - (half_u - radius), np.abs(v) - (half_v - radius)
    a_out, b_out = np.maximum(a, 0.0), np.maximum(b, 0.0)
    out = np.hypot(a_out, b_out)
    distance = out + np.minimum(np.maximum(a, b), 0.0) - radius
    is_out, divisor = out > 0.0, np.maximum(out, 1e-12)
    by_a = np.where(is_out, a_out / divisor, a >= b)
    by_b = np.where(is_out, b_out / divisor, a < b)
    return distance, by_a * np.sign(u), by_b * np.sign(v)


def _nearer(one: Distances, other: Distances) -> Distances:
    first = one[0] <= other[0]
    a, b, c = (np.where(first, x, y) for x, y in zip(one, other, strict=True))
    return a, b, c


def _absent(found: Distances, there: Flags) -> Distances:
    return np.where(there, found[0], _FAR), found[1], found[2]


def _whole(values: Array) -> Indices:
    return values.astype(np.int64)


def _chess(look: Look, layout: _Layout, u: Array, v: Array) -> Distances:
    i, j = _whole(np.floor(u)), _whole(np.floor(v))
    a, b = u - i - 0.5, v - j - 0.5
    is_white = (i + j) % 2 == 0
    to_u, to_v = np.where(a < 0.0, -1, 1), np.where(b < 0.0, -1, 1)
    half = 0.5 + look.growth

    def square(step_u: Indices, step_v: Indices) -> Distances:
        found = _box(a - step_u, b - step_v, half, half, look.rounding)
        return _absent(found, layout.has(i + step_u, j + step_v))

    # A white square and that across the nearest corner, or the neighbours of a black one.
    return _nearer(
        square(np.where(is_white, 0, to_u), np.zeros_like(i)),
        square(np.where(is_white, to_u, 0), to_v),
    )


def _centred(layout: _Layout, u: Array, v: Array) -> tuple[Array, Array, Flags]:
    i, j = np.rint(u), np.rint(v)
    return u - i, v - j, layout.has(_whole(i), _whole(j))


def _dots(look: Look, layout: _Layout, u: Array, v: Array) -> Distances:
    a, b, there = _centred(layout, u, v)
    r = np.hypot(a, b)
    divisor = np.maximum(r, 1e-12)
    return _absent((r - 0.5 * look.size, a / divisor, b / divisor), there)


def _pads(look: Look, layout: _Layout, u: Array, v: Array) -> Distances:
    a, b, there = _centred(layout, u, v)
    half = 0.5 * look.size
    return _absent(_box(a, b, half, half, look.rounding), there)


def _crosses(look: Look, layout: _Layout, u: Array, v: Array) -> Distances:
    a, b, there = _centred(layout, u, v)
    half = 0.5 * look.size
    flat = _box(a, b, look.length, half, look.rounding)
    upright = _box(a, b, half, look.length, look.rounding)
    return _absent(_nearer(flat, upright), there)


def _lines(look: Look, layout: _Layout, u: Array, v: Array) -> Distances:
    a, b, there = _centred(layout, u, v)
    half, radius = 0.5 * look.size, look.rounding
    upright, flat = np.abs(a) - half, np.abs(b) - half
    i, j = _whole(np.rint(u)), _whole(np.rint(v))
    broken_u = layout.is_broken(0, _whole(np.floor(u)), j)
    broken_v = layout.is_broken(1, i, _whole(np.floor(v)))
    flat = np.where(broken_u & (upright > 0.03), _FAR, flat)
    upright = np.where(broken_v & (flat > 0.03), _FAR, upright)
    deep_a, deep_b = np.maximum(radius - upright, 0.0), np.maximum(radius - flat, 0.0)
    deep = np.hypot(deep_a, deep_b)
    distance = np.maximum(np.minimum(upright, flat), radius) - deep
    is_deep, divisor = deep > 0.0, np.maximum(deep, 1e-12)
    by_a = np.where(is_deep, deep_a / divisor, upright <= flat)
    by_b = np.where(is_deep, deep_b / divisor, upright > flat)
    return _absent((distance, by_a * np.sign(a), by_b * np.sign(b)), there)


def _mesh(look: Look, layout: _Layout, u: Array, v: Array) -> Distances:
    i, j = _whole(np.floor(u)), _whole(np.floor(v))
    half = 0.5 * (1.0 - look.size)
    found = _box(u - i - 0.5, v - j - 0.5, half, half, look.rounding)
    distance, by_u, by_v = _absent(found, layout.has(i, j))
    return -distance, by_u, by_v


_SHAPES: Mapping[str, Callable[[Look, _Layout, Array, Array], Distances]] = {
    "chess": _chess,
    "dots": _dots,
    "holes": _dots,
    "pads": _pads,
    "lines": _lines,
    "crosses": _crosses,
    "mesh": _mesh,
}


# -- random looks ----------------------------------------------------------------------------------


def draw_look(seed: int, index: int) -> Look:
    """The look of this index in the collection of this seed."""
    rng = np.random.default_rng((seed, index, 0))
    draws = Draws(rng)
    between, ratio, either = draws.between, draws.ratio, draws.either

    kind = str(rng.choice(KINDS))
    width = round(ratio(LEAST_WIDTH, LARGEST_WIDTH) / 4.0) * 4
    height = width if either(0.5) else round(0.75 * width)
    size, length, rounding, growth = _draw_motif(kind, rng)
    inverted = either(0.5)
    look = Look(
        seed=seed,
        index=index,
        kind=kind,
        width=width,
        height=height,
        pitch_px=0.0,
        origin=(between(0.0, 1.0), between(0.0, 1.0)),
        turn_rad=between(-np.pi, np.pi),
        tilt_rad=between(0.0, LARGEST_TILT_RAD),
        axis_rad=between(-np.pi, np.pi),
        pivot_px=ratio(20.0, 200.0) * width,
        centre_px=(
            0.5 * (width - 1) + between(-0.1, 0.1) * width,
            0.5 * (height - 1) + between(-0.1, 0.1) * width,
        ),
        radial=between(-0.01, 0.01),
        size=size,
        length=length,
        rounding=rounding,
        growth=growth,
        inverted=kind == "holes" or (kind != "dots" and inverted),
        region="all",
        region_at=(0.0, 0.0),
        region_extent=0.0,
        missing=0.01 if either(0.5) else 0.0,
        blur_px=0.0,
        jitter_px=between(0.0, 0.3),
        contrast=0.5,
        electrons=1.0,
        rim=between(0.05, 0.4) if either(1.0 / 3.0) else 0.0,
        rim_width=ratio(0.005, 0.03),
        roughness=between(0.0, 0.006),
        roughness_length=ratio(0.05, 0.3),
        gradient=_pair(between(0.0, 0.12) * _direction(between(-np.pi, np.pi))),
        vignetting=between(0.0, 0.08),
        texture=between(0.0, 0.04),
        texture_length_px=ratio(0.06, 0.3) * width,
        dust=(),
        bits=16 if either(1.0 / 3.0) else 8,
        grey_range=between(0.5, 1.0),
        black=between(0.0, 1.0),
    )
    is_lined = kind in ("lines", "crosses")
    least = LEAST_LINED_PITCH_PX if is_lined else LEAST_PITCH_PX
    partial, number = either(0.2), int(rng.integers(0, 16))
    while True:
        pitch = ratio(least, LARGEST_PITCH * min(width, height))
        largest = LARGEST_BLUR * pitch
        if kind == "crosses":
            largest = min(largest, length * pitch * np.cos(look.tilt_rad) / LEAST_ARM)
        blur = ratio(LEAST_BLUR_PX, max(LEAST_BLUR_PX, min(LARGEST_BLUR_PX, largest)))
        look = replace(look, pitch_px=pitch, blur_px=blur)
        look = _draw_region(look, rng) if partial else look
        look = replace(look, dust=tuple(_draw_blob(look, rng) for _ in range(number)))
        if len(find_truth(look).xy) < FEWEST_POINTS:
            continue
        for _ in range(_TRIES):
            look = replace(look, contrast=between(0.15, 0.9), electrons=ratio(6.0, 200.0))
            if visibility(look) >= LEAST_VISIBILITY:
                return look


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _direction(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def _draw_motif(kind: str, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Size, half the length, radius of the corners, and growth, in pitches."""
    part = rng.uniform(size=4)

    def scaled(number: int, low: float, high: float) -> float:
        return float(low + part[number] * (high - low))

    if kind == "chess":
        return 1.0, 0.0, scaled(2, 0.0, 0.03), scaled(3, -0.01, 0.01)
    if kind in ("dots", "holes"):
        return scaled(0, 0.35, 0.7), 0.0, 0.0, 0.0
    if kind == "pads":
        size = scaled(0, 0.35, 0.65)
        return size, 0.0, scaled(2, 0.0, 0.15) * size, 0.0
    if kind == "lines":
        size = scaled(0, 0.08, 0.3)
        return size, 0.0, scaled(2, 0.0, 0.25) * size, 0.0
    if kind == "crosses":
        size = scaled(0, 0.06, 0.15)
        return size, scaled(1, 0.25, 0.45), scaled(2, 0.0, 0.3) * size, 0.0
    size = scaled(0, 0.15, 0.4)
    return size, 0.0, scaled(2, 0.15, 0.5) * 0.5 * (1.0 - size), 0.0


def _draw_region(look: Look, rng: np.random.Generator) -> Look:
    """A part of the picture, 40 to 85 % of it, that the grid covers."""
    x = np.linspace(0.0, look.width - 1.0, 49)
    y = np.linspace(0.0, look.height - 1.0, 49)[:, None]
    u, v = look.find_grid(x, y)
    share = rng.uniform(0.4, 0.85)
    if rng.uniform() < 0.5:
        at = _pair(np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[rng.integers(4)])
        measure = at[0] * u + at[1] * v
        return replace(
            look, region="half", region_at=at, region_extent=float(np.quantile(measure, share))
        )
    column, row = rng.integers(8, 41, 2)
    at = float(u[row, column]), float(v[row, column])
    measure = np.hypot(u - at[0], v - at[1])
    extent = float(np.quantile(measure, share))
    return replace(look, region="disc", region_at=at, region_extent=extent)


def _draw_blob(look: Look, rng: np.random.Generator) -> Blob:
    is_bright = bool(rng.uniform() < 0.5)
    level = rng.uniform(0.95, 1.3) if is_bright else rng.uniform(0.4, 0.9)
    return Blob(
        x=float(rng.uniform(0.0, look.width)),
        y=float(rng.uniform(0.0, look.height)),
        radius_px=0.5 * float(np.exp(rng.uniform(np.log(0.08), np.log(0.6)))) * look.pitch_px,
        is_bright=is_bright,
        level=float(level),
        wobbles=tuple(float(a) for a in rng.uniform(0.0, 0.12, 4) / [1.0, 1.5, 2.0, 2.5]),
        phases=tuple(float(a) for a in rng.uniform(-np.pi, np.pi, 4)),
    )


def visibility(look: Look) -> float:
    """Distance of the blurred motif of a cell from flat grey, in sigmas of the shot noise of the whole cell."""
    period, samples = (2.0 if look.kind == "chess" else 1.0), 96
    line = (np.arange(samples) + 0.5) / samples * period
    u, v = np.meshgrid(line, line)
    layout = _Layout((-4, -4), np.ones((12, 12), dtype=bool), np.zeros((2, 12, 12), dtype=bool))
    if look.kind == "chess":
        layout = replace(layout, there=np.add.outer(np.arange(12), np.arange(12)) % 2 == 0)
    motif = (_SHAPES[look.kind](look, layout, u, v)[0] < 0.0).astype(np.float64)
    area = look.pitch_px**2 * np.cos(look.tilt_rad)
    sigma = look.blur_px / np.sqrt(area) * samples / period
    variance = float(gaussian_filter(motif, sigma, mode="wrap").var())
    part = 1.0 - motif.mean() if look.inverted else motif.mean()
    mean = look.dark + part * (look.electrons - look.dark)
    pixels = area * (2.0 if look.kind == "chess" else 1.0)
    signal = (look.electrons - look.dark) * np.sqrt(pixels * variance)
    return float(signal / np.sqrt(mean + AMPLIFIER_NOISE**2))


# -- pictures --------------------------------------------------------------------------------------


def _field(rng: np.random.Generator, shape: tuple[int, int], length_px: float) -> Single:
    """A random field of this shape with RMS 1 and a Gaussian correlation of this length."""
    sigma = length_px / np.sqrt(2.0)
    step = max(1.0, sigma / 2.0)
    coarse = tuple(int(np.ceil(n / step)) + 8 for n in shape)
    impulse = np.zeros(2 * int(4.0 * sigma / step + 1.0) + 1)
    impulse[len(impulse) // 2] = 1.0
    power = float(np.sum(gaussian_filter1d(impulse, sigma / step) ** 2))
    field = rng.standard_normal(coarse, dtype=np.float32)
    field = gaussian_filter(field, sigma / step, mode="wrap") / np.float32(power)
    if step > 1.0:
        size = tuple(int(np.ceil(n * step)) for n in coarse)
        field = cv2.resize(field, size[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(field[: shape[0], : shape[1]], dtype=np.float32)


def _covered(px: Array, across_x: Array, across_y: Array) -> Array:
    """Part of a pixel's square beyond a straight edge at this distance, with the normal (across_x, across_y)."""
    # A box as wide as one side of the square appears from the edge, and one as wide as the other: a trapezium.
    wide, narrow = np.maximum(across_x, across_y), np.maximum(np.minimum(across_x, across_y), 1e-3)
    outer, inner = 0.5 * (wide + narrow), 0.5 * (wide - narrow)
    near = np.clip(-px, -outer, outer)
    total = (near + outer) ** 2 - np.maximum(near + inner, 0.0) ** 2
    total -= np.maximum(near - inner, 0.0) ** 2
    return total / (2.0 * wide * narrow)


def _draw_rows(
    look: Look, layout: _Layout, x: Array, y: Array, rough: tuple[Single, Single, Single]
) -> Array:
    """(rows, columns) brightness of what is there, 0 dark to 1 bright, without blur but that of a pixel."""
    u, v = look.find_grid(x, y)
    (u_y, u_x), (v_y, v_x) = np.gradient(u), np.gradient(v)
    # Opposite edges move as if there were no other.
    scale = look.roughness / np.sqrt(2.0)
    u, v = u + scale * rough[0], v + scale * rough[1]
    distance, by_u, by_v = _SHAPES[look.kind](look, layout, u, v)
    by_x, by_y = by_u * u_x + by_v * v_x, by_u * u_y + by_v * v_y
    slope = np.maximum(np.hypot(by_x, by_y), 1e-9)
    px = (distance + scale * rough[2]) / slope
    part = _covered(px, np.abs(by_x) / slope, np.abs(by_y) / slope)
    if look.inverted:
        part = 1.0 - part
    if look.rim > 0.0:
        square = (look.rim_width * look.pitch_px) ** 2
        wide = square + _PIXEL_VARIANCE
        part += look.rim * np.sqrt(square / wide) * np.exp(-0.5 * px * px / wide)
    return part


def _draw_dust(look: Look, levels: Single, margin: int) -> None:
    """Lay dust on the levels (h, w), in electrons, in place."""
    for blob in look.dust:
        reach = int(np.ceil(blob.radius_px * (1.0 + sum(blob.wobbles)) + 2.0))
        x0, y0 = round(blob.x) + margin, round(blob.y) + margin
        rows = slice(max(0, y0 - reach), max(0, y0 + reach + 1))
        columns = slice(max(0, x0 - reach), max(0, x0 + reach + 1))
        own = levels[rows, columns]
        dy = (np.arange(own.shape[0]) + rows.start - margin - blob.y)[:, None]
        dx = (np.arange(own.shape[1]) + columns.start - margin - blob.x)[None, :]
        off = blob.reach_px(dx, dy) - np.hypot(dx, dy)
        part = np.clip(0.5 + off, 0.0, 1.0)
        rim = 1.0 + 0.3 * np.exp(-np.maximum(off, 0.0) / (0.1 * blob.radius_px))
        level = blob.level * (look.electrons if blob.is_bright else look.dark)
        own += part * (level * rim - own)


def _shift_lines(levels: Single, shift_px: Array, margin: int) -> Single:
    """Move every line by a part of a pixel, by polynomials through six pixels; the margin on both sides is lost."""
    taps = np.arange(-2, 4)
    weights = np.ones((len(shift_px), len(taps)), dtype=np.float64)
    # The shift is counted from the pixel on the left.
    whole = np.floor(shift_px)
    part = shift_px - whole
    for k, own in enumerate(taps):
        for other in taps[taps != own]:
            weights[:, k] *= (part - other) / (own - other)
    width = levels.shape[1] - 2 * margin
    out = np.zeros((len(levels), width), dtype=np.float32)
    for start in np.unique(whole.astype(int)):
        rows = whole == start
        for k, tap in enumerate(taps):
            first = margin + start + tap
            out[rows] += (
                weights[rows, k : k + 1].astype(np.float32) * levels[rows, first : first + width]
            )
    return out


def draw_levels(look: Look) -> Single:
    """(h, w) electrons per pixel without noise."""
    rng = np.random.default_rng((look.seed, look.index, 1))
    layout = _lay_out(look)
    margin = int(np.ceil(4.0 * look.blur_px)) + 8
    shape = look.height + 2 * margin, look.width + 2 * margin
    x = np.arange(shape[1], dtype=np.float64)[None, :] - margin
    y = np.arange(shape[0], dtype=np.float64)[:, None] - margin
    length = look.roughness_length * look.pitch_px
    rough = [_field(rng, shape, length) for _ in range(3)]
    texture = _field(rng, shape, look.texture_length_px)
    levels = np.empty(shape, dtype=np.float32)
    for start in range(0, shape[0], _ROWS_AT_ONCE):
        # One row more than needed: its derivative takes two.
        rows = slice(start, min(start + _ROWS_AT_ONCE, shape[0]))
        rows = rows if rows.stop - rows.start > 1 else slice(start - 1, rows.stop)
        part = _draw_rows(look, layout, x, y[rows], tuple(field[rows] for field in rough))
        qx, qy = 2.0 * x / look.width - 1.0, 2.0 * y[rows] / look.height - 1.0
        light = 1.0 + look.gradient[0] * qx + look.gradient[1] * qy
        light = light - look.vignetting * 0.5 * (qx * qx + qy * qy) + look.texture * texture[rows]
        levels[rows] = (look.dark + part * (look.electrons - look.dark)) * np.maximum(light, 0.3)
    del rough, texture
    _draw_dust(look, levels, margin)
    sigma = np.sqrt(max(look.blur_px**2 - _PIXEL_VARIANCE, 0.0))
    levels = gaussian_filter(levels, sigma)[margin:-margin]
    return _shift_lines(levels, look.jitter_px * rng.normal(size=look.height), margin)


def render(look: Look) -> Picture:
    """The picture of a look."""
    rng = np.random.default_rng((look.seed, look.index, 3))
    levels = draw_levels(look)
    top = look.electrons * HEADROOM
    top += 2.5 * np.sqrt(top)
    bottom = look.black * max(0.0, 0.7 * look.dark - 2.5 * np.sqrt(look.dark))
    full = 2.0**look.bits - 1.0
    gain = full * look.grey_range / (top - bottom)
    offset = full * 0.5 * (1.0 - look.grey_range)
    image = np.empty(levels.shape, dtype=np.uint8 if look.bits == 8 else np.uint16)
    for start in range(0, look.height, 256):
        rows = slice(start, start + 256)
        counts = rng.poisson(np.maximum(levels[rows], 0.0))
        counts = counts + AMPLIFIER_NOISE * rng.standard_normal(counts.shape)
        image[rows] = np.clip(np.rint(offset + gain * (counts - bottom)), 0.0, full)
    return Picture(image, find_truth(look))
