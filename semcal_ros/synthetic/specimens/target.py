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

"""The target of visual servoing as a specimen: nested boards of markers, sharp at any magnification."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np

from semcal_ros.applications.servoing.target import CELLS, NestedTarget
from semcal_ros.applications.servoing.thresholds import MARKER_BITS, MARKER_SIDE, RATIO
from semcal_ros.core.arrays import Array, Image
from semcal_ros.synthetic.specimens.cantilever import NO_CHARGING, Charging
from semcal_ros.synthetic.specimens.substrate import SUBSTRATES, Substrate
from semcal_ros.synthetic.thresholds import BIT_TEXELS

_CELL = round(MARKER_BITS * BIT_TEXELS / MARKER_SIDE)


@dataclass(frozen=True)
class TargetSpecimen:
    """A :class:`~semcal_ros.applications.servoing.target.NestedTarget` with its origin at that of the specimen.

    Parameters
    ----------
    target
        The target.
    white, black
        Reflectivity of border and surroundings, and of the markers.
    ground
        What lies under and around the target; None: surroundings as white as its border.
    roughness
        Share of the texture of the ground that shows through the target, a film on it.
    charging
        What charge does to its brightness.
    """

    target: NestedTarget = field(default_factory=NestedTarget)
    white: float = 0.85
    black: float = 0.15
    ground: Substrate | None = None
    roughness: float = 0.0
    charging: Charging = NO_CHARGING

    @property
    def supersampling(self) -> int:
        """Two: edges along the markers are averaged exactly over a sample, others by its second moment."""
        return 2

    def reflectivity(self, x_m: Array, y_m: Array, footprint_m: Array) -> Image:
        """See :class:`~semcal_ros.synthetic.specimens.grid.Specimen`."""
        # As for the checkerboard: a box with the second moment of the sample's parallelogram on each axis of the
        # target.
        box_m = np.hypot(footprint_m[:, 0], footprint_m[:, 1])
        seen = np.ones(x_m.shape, dtype=np.float32)
        first = self._first_level(x_m, y_m)
        for level in range(first, self.target.levels):
            cell_m = self.target.cell_m(level)
            # Where a texel of the board around it is no larger than a sample, that one shows this one as well.
            if level > first and RATIO * cell_m <= _CELL * float(box_m.min()):
                break
            _paint(seen, self.target, level, x_m / cell_m, y_m / cell_m, box_m / cell_m)
        seen *= np.float32(self.white - self.black)
        seen += np.float32(self.black)
        if self.ground is not None:
            ground = self.ground.reflectivity(x_m, y_m, footprint_m)
            half_m = 0.5 * RATIO * self.target.cell_m(0)
            film = (np.abs(x_m) < half_m) & (np.abs(y_m) < half_m)
            rough = seen + np.float32(self.roughness) * (ground - np.float32(self.ground.level))
            seen[...] = np.where(film, rough, ground)
        if self.charging.gradient_per_m != (0.0, 0.0):
            seen *= np.asarray(self.charging.shade(x_m, y_m), dtype=np.float32)
        return np.asarray(np.maximum(seen, 0.0), dtype=np.float32)

    def _first_level(self, x_m: Array, y_m: Array) -> int:
        """The smallest board that covers all samples; those around it are hidden."""
        far_m = max(abs(float(end)) for c in (x_m, y_m) for end in (c.min(), c.max()))
        halves = [0.5 * RATIO * self.target.cell_m(k) for k in range(self.target.levels)]
        return max((k for k, half in enumerate(halves) if far_m < half), default=0)


def random_target(seed: int) -> TargetSpecimen:
    """Draw a target on ground of any kind, as a rough film that charges."""
    rng = np.random.default_rng([seed, 11])
    ground = Substrate(
        kind=SUBSTRATES[int(rng.integers(len(SUBSTRATES)))],  # type: ignore[arg-type]
        level=float(rng.uniform(0.2, 0.7)),
        contrast=float(rng.uniform(0.05, 0.2)),
        # From a tenth of a pixel's worth of grain to half of a marker, at 1000x.
        size_m=float(10.0 ** rng.uniform(-6.3, -5.0)),
        seed=int(rng.integers(2**31)),
    )
    towards = rng.uniform(0.0, 2.0 * math.pi)
    # A field of 240 um at 500x is up to a third darker on one side than on the other.
    slope = rng.uniform(0.0, 1.4e3)
    return TargetSpecimen(
        white=float(rng.uniform(0.6, 0.95)),
        black=float(rng.uniform(0.05, 0.3)),
        ground=ground,
        roughness=float(rng.uniform(0.2, 0.8)),
        charging=Charging((slope * math.cos(towards), slope * math.sin(towards))),
    )


def _paint(seen: Image, target: NestedTarget, level: int, x: Array, y: Array, box: Array) -> None:
    """Draw one board, in cells of its own, over what is there."""
    half = 0.5 * RATIO
    inside = (np.abs(x) < half) & (np.abs(y) < half)
    if not np.any(inside):
        return
    # A selection by a mask takes longer than the drawing.
    whole = bool(np.all(inside))
    if not whole:
        x, y = x[inside], y[inside]
    pyramid = _make_pyramid(target, level)
    texels = max(float(np.max(box)) * _CELL, 1.0)
    step = min(math.ceil(math.log2(texels)), len(pyramid) - 1)
    board = pyramid[step]
    per_cell = len(board) / RATIO
    u = _sharpen((x + half) * per_cell - 0.5, float(box[0]) * per_cell)
    v = _sharpen((y + half) * per_cell - 0.5, float(box[1]) * per_cell)
    if whole:
        seen[...] = _remap_in_rows(board, u.ravel(), v.ravel()).reshape(seen.shape)
    else:
        seen[inside] = _remap_in_rows(board, u, v)


def _remap_in_rows(board: Image, u: Image, v: Image) -> Image:
    """cv2.remap takes no rows beyond 32766 px."""
    width = 16384
    rows = -(-u.size // width)
    x, y = (np.resize(c, rows * width).reshape(rows, width) for c in (u, v))
    drawn = cv2.remap(board, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn, dtype=np.float32).reshape(-1)[: u.size]


def _sharpen(u: Array, width: float) -> Image:
    """Where linear interpolation gives the mean of sharp texels over a box of that width, at most one texel."""
    edge = np.floor(u) + 0.5
    return (edge + np.clip((u - edge) / max(width, 1e-9), -0.5, 0.5)).astype(np.float32)


@lru_cache(maxsize=64)
def _make_pyramid(target: NestedTarget, level: int) -> tuple[Image, ...]:
    """One board with all that lie within, 1 white and 0 black, and the same at half the resolution, and so on."""
    levels = [_draw_board(target, level)]
    while len(levels[-1]) % 2 == 0 and len(levels[-1]) > 8:
        n = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(n, 2, n, 2).mean(axis=(1, 3), dtype=np.float32))
    for board in levels:
        board.setflags(write=False)
    return tuple(levels)


@lru_cache(maxsize=64)
def _draw_board(target: NestedTarget, level: int) -> Image:
    """(3 cells, 3 cells) texels."""
    board = np.ones((RATIO * _CELL, RATIO * _CELL), dtype=np.float32)
    border = (_CELL - MARKER_BITS * BIT_TEXELS) // 2
    for place, (column, row) in enumerate(CELLS):
        bits = target.bits(len(CELLS) * level + place).astype(np.float32)
        marker = np.kron(bits, np.ones((BIT_TEXELS, BIT_TEXELS), dtype=np.float32))
        top, left = ((c + 1) * _CELL + border for c in (row, column))
        board[top : top + len(marker), left : left + len(marker)] = marker
    if level + 1 < target.levels:
        inner = _draw_board(target, level + 1)
        shrunk = inner.reshape(_CELL, RATIO, _CELL, RATIO).mean(axis=(1, 3), dtype=np.float32)
        board[_CELL : 2 * _CELL, _CELL : 2 * _CELL] = shrunk
    board.setflags(write=False)
    return board
