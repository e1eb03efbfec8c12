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

"""Grow a lattice through saddle points: seeds by symmetry, then steps by local prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from semcal_ros.core.arrays import Array, Indices, Mask
from semcal_ros.core.corners.saddle import SaddlePoints
from semcal_ros.core.corners.thresholds import (
    CELLS_TO_RIM_MAX,
    SADDLE_DIRECTION_MAX_DEG,
    SEARCH_RADIUS,
    SEED_ASYMMETRY_MAX,
    SEED_NEIGHBOURS,
    SEED_POINTS,
    SEEDS_TRIED,
)

COSINE_MIN = float(np.cos(np.deg2rad(SADDLE_DIRECTION_MAX_DEG)))
# From a cell to its four neighbours.
STEPS: Indices = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])


@dataclass(frozen=True)
class Lattice:
    """Points with lattice indices.

    Attributes
    ----------
    ij
        (n, 2) indices; the image of the axes is right-handed (positive determinant, x right, y
        down).
    xy
        (n, 2) positions, px.
    axes
        (n, 2, 2) local lattice vectors, px per index: ``axes[:, 0]`` along i, ``axes[:, 1]`` along
        j.
    """

    ij: Indices
    xy: Array
    axes: Array

    def select(self, keep: Mask) -> Lattice:
        """Return the points where ``keep`` is true."""
        return Lattice(self.ij[keep], self.xy[keep], self.axes[keep])

    def reduced(self, factor: float) -> Lattice:
        """Return the lattice in an image whose pixels are so many times as large."""
        return Lattice(self.ij, enlarged(self.xy, 1.0 / factor), self.axes / factor)


def enlarged(xy: Array, factor: float) -> Array:
    """Return positions in the whole image of those in one whose pixels are so many times as large.

    Pixel centres of the reduced image lie in the middle of the pixels that they replace.
    """
    return factor * (xy + 0.5) - 0.5


@dataclass(frozen=True)
class _Seeds:
    points: Indices
    axes: Array


def grow_best_lattice(saddles: SaddlePoints, image_size: tuple[int, int]) -> Lattice | None:
    """Return the largest lattice grown from one of several seeds, or None without a seed.

    Parameters
    ----------
    saddles
        Candidates at one scale.
    image_size
        (width, height), px.
    """
    if len(saddles.xy) < 5:
        return None
    tree = cKDTree(saddles.xy)
    seeds = _find_seeds(saddles, tree)
    best: Lattice | None = None
    used = np.zeros(len(saddles.xy), dtype=bool)
    tried = 0
    for point, axes in zip(seeds.points, seeds.axes, strict=True):
        if used[point]:
            continue
        lattice, members = _Growth(saddles, tree, image_size, axes).run(int(point), axes)
        used[members] = True
        if best is None or len(lattice.ij) > len(best.ij):
            best = lattice
        tried += 1
        if tried >= SEEDS_TRIED or len(members) > 0.6 * len(used):
            break
    return best


def _asymptotic_directions(hessian: Array) -> Array:
    """Return (n, 2, 2) unit vectors of zero second derivative: the edges of a chess corner."""
    values, vectors = np.linalg.eigh(hessian)
    low, high = np.maximum(-values[:, 0], 0.0), np.maximum(values[:, 1], 0.0)
    total = np.maximum(low + high, np.finfo(float).tiny)
    along_high = np.sqrt(low / total)[:, None] * vectors[:, :, 1]
    along_low = np.sqrt(high / total)[:, None] * vectors[:, :, 0]
    return np.stack([along_high + along_low, along_high - along_low], axis=1)


def _find_seeds(saddles: SaddlePoints, tree: cKDTree) -> _Seeds:
    """Find points with four symmetric neighbours of opposite contrast along the edges."""
    n = min(len(saddles.xy), SEED_POINTS)
    xy, hessian = saddles.xy[:n], saddles.hessian[:n]
    queried = tree.query(xy, k=min(SEED_NEIGHBOURS + 1, len(saddles.xy)))
    distance, neighbour = np.asarray(queried[0])[:, 1:], np.asarray(queried[1])[:, 1:]
    offset = saddles.xy[neighbour] - xy[:, None]
    unit = offset / np.maximum(distance, 1e-9)[:, :, None]
    opposite = np.einsum("nab,nkab->nk", hessian, saddles.hessian[neighbour]) < 0
    directions = _asymptotic_directions(hessian)
    arms = np.empty((n, 2, 2, 2))
    found = np.ones(n, dtype=bool)
    for axis in range(2):
        for side, sign in enumerate((1.0, -1.0)):
            cosine = sign * np.einsum("nkc,nc->nk", unit, directions[:, axis])
            usable = np.where(opposite & (cosine > COSINE_MIN), distance, np.inf)
            nearest = np.argmin(usable, axis=1)
            found &= np.isfinite(usable[np.arange(n), nearest])
            arms[:, axis, side] = offset[np.arange(n), nearest]
    axes = (arms[:, :, 0] - arms[:, :, 1]) / 2.0
    length = np.linalg.norm(axes, axis=2)
    asymmetry = np.linalg.norm(arms.sum(axis=2), axis=2) / np.maximum(2.0 * length, 1e-9)
    worst = asymmetry.max(axis=1)
    left_handed = np.linalg.det(axes) < 0
    axes[left_handed, 1] *= -1.0
    candidates = np.nonzero(found & (worst < SEED_ASYMMETRY_MAX))[0]
    order = candidates[np.argsort(worst[candidates], kind="stable")]
    return _Seeds(order, axes[order])


class _Growth:
    """Growth of a wavefront: each round predicts and looks up free neighbours of the last front."""

    def __init__(
        self,
        saddles: SaddlePoints,
        tree: cKDTree,
        image_size: tuple[int, int],
        axes: Array,
    ) -> None:
        self._saddles = saddles
        self._tree = tree
        self._size = np.array(image_size, dtype=np.float64)
        shortest = max(2.0, float(np.linalg.norm(axes, axis=1).min()))
        # No more cells lie in a row than would have saddle points, nor than memory allows.
        across = min(1.5 * np.hypot(*image_size) / shortest, len(saddles.xy))
        self._half = min(CELLS_TO_RIM_MAX, 8 + int(across))
        side = 2 * self._half + 1
        self._member = np.full((side, side), -1, dtype=np.int32)
        self._axes = np.zeros((side, side, 2, 2), dtype=np.float32)
        self._tried = np.zeros((side, side), dtype=np.int8)

    def run(self, seed: int, axes: Array) -> tuple[Lattice, Indices]:
        centre = np.array([[self._half, self._half]])
        self._used = np.zeros(len(self._saddles.xy), dtype=bool)
        self._sign = float(np.sign(axes[0] @ self._saddles.hessian[seed] @ axes[1]))
        self._place(centre, np.array([seed]), axes[None])
        frontier = centre
        while len(frontier):
            frontier = self._advance(frontier)
        ij = np.argwhere(self._member >= 0)
        members = self._member[ij[:, 0], ij[:, 1]].astype(np.intp)
        axes_of = self._axes[ij[:, 0], ij[:, 1]].astype(np.float64)
        return (
            Lattice(ij - self._half, self._saddles.xy[members], axes_of),
            members,
        )

    def _place(self, cells: Indices, members: Indices, axes: Array) -> None:
        self._member[cells[:, 0], cells[:, 1]] = members
        self._axes[cells[:, 0], cells[:, 1]] = axes
        self._used[members] = True

    def _advance(self, frontier: Indices) -> Indices:
        side = self._member.shape[0]
        near = (frontier[:, None] + STEPS[None]).reshape(-1, 2)
        keys = np.unique(near[:, 0] * side + near[:, 1])
        cells: Indices = np.stack([keys // side, keys % side], axis=1)
        inside = np.all((cells >= 1) & (cells < side - 1), axis=1)
        cells = cells[inside]
        # A second attempt, with more neighbours known, finds what the first prediction missed.
        free = (self._member[cells[:, 0], cells[:, 1]] < 0) & (
            self._tried[cells[:, 0], cells[:, 1]] < 3
        )
        cells = cells[free]
        if not len(cells):
            return cells
        self._tried[cells[:, 0], cells[:, 1]] += 1
        predicted, axes = self._predict(cells)
        members = self._look_up(cells, predicted, axes)
        hit = members >= 0
        cells, members, axes = cells[hit], members[hit], axes[hit]
        self._place(cells, members, axes)
        self._update_axes(cells)
        return cells

    def _predict(self, cells: Indices) -> tuple[Array, Array]:
        total = np.zeros((len(cells), 2))
        axes = np.zeros((len(cells), 2, 2))
        count = np.zeros(len(cells))
        for step in STEPS:
            near = cells - step
            member = self._member[near[:, 0], near[:, 1]]
            known = member >= 0
            near_axes = self._axes[near[known, 0], near[known, 1]]
            axis, sign = (0, step[0]) if step[0] else (1, step[1])
            total[known] += self._saddles.xy[member[known]] + sign * near_axes[:, axis]
            axes[known] += near_axes
            count[known] += 1.0
        return total / count[:, None], axes / count[:, None, None]

    def _look_up(self, cells: Indices, predicted: Array, axes: Array) -> Indices:
        """Return the index of the saddle of the right sign at each prediction, or -1."""
        radius = SEARCH_RADIUS * np.linalg.norm(axes, axis=2).min(axis=1)
        k = min(2, len(self._saddles.xy))
        queried = self._tree.query(predicted, k=k)
        distance = np.asarray(queried[0]).reshape(-1, k)
        index = np.asarray(queried[1]).reshape(-1, k)
        # Every fitted corner must pass the same test; here it chooses between neighbouring saddles:
        # without it, 4 of 105 reference frames grow another lattice.
        parity = np.where((cells.sum(axis=1) % 2) == 0, self._sign, -self._sign)
        hessian = self._saddles.hessian[index]
        sign = np.sign(np.einsum("na,nkab,nb->nk", axes[:, 0], hessian, axes[:, 1]))
        usable = (distance < radius[:, None]) & (sign == parity[:, None]) & ~self._used[index]
        choice = np.argmin(np.where(usable, distance, np.inf), axis=1)
        row = np.arange(len(cells))
        members = np.where(usable[row, choice], index[row, choice], -1)
        # Where two cells claim the same saddle, the nearer prediction gets it.
        order = np.argsort(distance[row, choice], kind="stable")
        _, first = np.unique(members[order], return_index=True)
        keep = np.zeros(len(cells), dtype=bool)
        keep[order[first]] = True
        return np.where(keep, members, -1)

    def _update_axes(self, cells: Indices) -> None:
        """Set axes of new cells: differences to neighbours, averaged with the inherited axes."""
        here = self._saddles.xy[self._member[cells[:, 0], cells[:, 1]]]
        axes = self._axes[cells[:, 0], cells[:, 1]]
        for axis in range(2):
            total, weight = axes[:, axis].copy(), np.ones(len(cells))
            for sign in (1, -1):
                step = sign * STEPS[2 * axis]
                near = cells + step
                member = self._member[near[:, 0], near[:, 1]]
                known = member >= 0
                total[known] += sign * (self._saddles.xy[member[known]] - here[known])
                weight[known] += 1.0
            self._axes[cells[:, 0], cells[:, 1], axis] = total / weight[:, None]
