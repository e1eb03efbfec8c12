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

"""Saddle points of a smoothed image at one scale, and lattices that grow through them: seeds by symmetry, then steps.

A step goes to where its neighbours predict the next point.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from semcal_ros.core.arrays import Array, Image, Indices, Mask, check_image
from semcal_ros.core.corners.thresholds import (
    CELLS_TO_RIM_MAX,
    IMAGE_SIDE_MIN_PX,
    SADDLE_AREA,
    SADDLE_DIRECTION_MAX_DEG,
    SADDLE_THRESHOLD,
    SADDLES_MIN,
    SATURATED_MAX,
    SEARCH_RADIUS,
    SEED_ASYMMETRY_MAX,
    SEED_NEIGHBOURS,
    SEED_POINTS,
    SEEDS_TRIED,
    STRONG_RANK,
)
from semcal_ros.core.errors import InvalidValueError, Rejection

COSINE_MIN = float(np.cos(np.deg2rad(SADDLE_DIRECTION_MAX_DEG)))
# From a cell to its four neighbours.
STEPS: Indices = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])


class LatticeStatus(Enum):
    """Why an image gives no lattice."""

    NOT_FINITE = "values that are not finite"
    BLANK = "blank"
    SATURATED = "saturated"
    NO_LATTICE = "no grid"
    TWO_BOARDS = "two boards"
    TOO_FEW_CORNERS = "too few corners"
    OTHER_PATTERN = "another pattern"


@dataclass(frozen=True)
class SaddlePoints:
    """Saddle points, strongest first.

    Attributes
    ----------
    xy
        (n, 2) positions, px, accurate to a few tenths.
    hessian
        (n, 2, 2) Hessian of the smoothed image at the points.
    response
        (n,) minus the determinant of the Hessian, normalised by the scale.
    """

    xy: Array
    hessian: Array
    response: Array


def find_saddles(image: Image, scale_px: float) -> SaddlePoints:
    """Find local maxima of ``-det(Hessian)`` of the image smoothed by a Gaussian.

    Parameters
    ----------
    image
        (h, w) float32.
    scale_px
        Standard deviation of the Gaussian, px; a quarter of the spacing of the corners is a good
        choice.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), scale_px, borderType=cv2.BORDER_REFLECT_101)
    kernel_2 = np.array([1.0, -2.0, 1.0], dtype=np.float32)
    kernel_1 = np.array([-0.5, 0.0, 0.5], dtype=np.float32)
    kernel_0 = np.ones(1, dtype=np.float32)

    def derive(kernel_x: Image, kernel_y: Image) -> NDArray[np.float32]:
        return cv2.sepFilter2D(
            smooth, cv2.CV_32F, kernel_x, kernel_y, borderType=cv2.BORDER_REPLICATE
        ).astype(np.float32, copy=False)

    xx, yy, xy = derive(kernel_2, kernel_0), derive(kernel_0, kernel_2), derive(kernel_1, kernel_1)
    response = (xy * xy - xx * yy) * np.float32(scale_px**4)
    most = max(SADDLES_MIN, int(image.size / (SADDLE_AREA * scale_px**2)))
    rows, columns = _strong_maxima(response, scale_px, most)
    hessian = np.empty((len(rows), 2, 2))
    hessian[:, 0, 0] = xx[rows, columns]
    hessian[:, 1, 1] = yy[rows, columns]
    hessian[:, 0, 1] = hessian[:, 1, 0] = xy[rows, columns]
    gradient = np.stack(
        [derive(kernel_1, kernel_0)[rows, columns], derive(kernel_0, kernel_1)[rows, columns]],
        axis=1,
    ).astype(np.float64)
    # One Newton step to where the gradient vanishes; it is small at a true saddle.
    across = np.stack(
        [
            hessian[:, 1, 1] * gradient[:, 0] - hessian[:, 0, 1] * gradient[:, 1],
            hessian[:, 0, 0] * gradient[:, 1] - hessian[:, 0, 1] * gradient[:, 0],
        ],
        axis=1,
    )
    determinant = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    step = -across / determinant[:, None]
    step *= np.minimum(1.0, 1.0 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12))
    points = np.stack([columns, rows], axis=1) + step
    return SaddlePoints(points, hessian, response[rows, columns].astype(np.float64))


def _strong_maxima(
    response: Image, scale_px: float, most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    radius = max(1, round(1.2 * scale_px))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    peaks = (response >= cv2.dilate(response, kernel)) & (response > 0)
    # The second derivative is undefined on the rim of the frame.
    peaks[[0, -1], :] = False
    peaks[:, [0, -1]] = False
    rows, columns = np.nonzero(peaks)
    strength = response[rows, columns]
    order = np.argsort(-strength, kind="stable")
    if len(order):
        strong = strength[order[min(STRONG_RANK, len(order)) - 1]]
        order = order[strength[order] > SADDLE_THRESHOLD * strong][:most]
    return rows[order].astype(np.int64), columns[order].astype(np.int64)


def prepare_image(image: ArrayLike, databar_rows: int) -> NDArray[np.float32]:
    """Return the image as (h, w) float32 without its databar.

    Raises
    ------
    InvalidValueError
        If it is not a two-dimensional image of numbers, or is too small.
    """
    values = check_image(image, channels=(1,), do="convert colour images to grey first")
    if (
        not 0 <= databar_rows <= values.shape[0] - IMAGE_SIDE_MIN_PX
        or values.shape[1] < IMAGE_SIDE_MIN_PX
    ):
        raise InvalidValueError(
            f"an image of {values.shape[1]} x {values.shape[0]} px"
            f" with {databar_rows} databar rows",
            expected=f"at least {IMAGE_SIDE_MIN_PX} x {IMAGE_SIDE_MIN_PX} px without the databar",
        )
    rows = values.shape[0] - databar_rows
    return np.ascontiguousarray(values[:rows], dtype=np.float32)


def screen_image(image: Image) -> Image | Rejection[LatticeStatus]:
    """Scale the image to a contrast of about 1, or reject it as blank or saturated."""
    sample = image[::2, ::2]
    if not np.all(np.isfinite(image)):
        return Rejection(LatticeStatus.NOT_FINITE, "the image has values that are not finite")
    low, high = (float(v) for v in np.percentile(sample, [1.0, 99.0]))
    top, bottom = float(image.max()), float(image.min())
    if top - bottom <= 0.0:
        return Rejection(LatticeStatus.BLANK, "the image is blank: every pixel has the same value")
    at_limit = max(float(np.mean(sample >= top)), float(np.mean(sample <= bottom)))
    if high <= low or at_limit > 0.9:
        return Rejection(
            LatticeStatus.BLANK,
            "the image is blank or saturated: nearly all pixels have the same value",
        )
    if float(np.mean((sample >= top) | (sample <= bottom))) > SATURATED_MAX and _two_levels(sample):
        return (image - np.float32(low)) / np.float32(high - low)
    if at_limit > SATURATED_MAX:
        part = round(100.0 * at_limit)
        return Rejection(
            LatticeStatus.SATURATED,
            f"the image is saturated: {part} % of the pixels are at a limit",
        )
    return (image - np.float32(low)) / np.float32(high - low)


def _two_levels(sample: NDArray[np.float32]) -> bool:
    """Return whether both limits are common: a clean two-level board is not saturated."""
    top = float(np.mean(sample >= sample.max()))
    bottom = float(np.mean(sample <= sample.min()))
    return min(top, bottom) > 0.2


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
