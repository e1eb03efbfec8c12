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

"""Checkerboards, and grids of dots, holes and crossed lines, of exactly known geometry, rendered by supersampling."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.corners import LatticeDetection, LatticeStatus, find_lattice
from semcal_ros.core.errors import Rejection
from tests.helpers.made_once import made_once


@dataclass(frozen=True)
class Board:
    """An endless (or bounded) board seen by a tilted, distorted camera.

    ``square_px`` is the spacing without foreshortening; ``distortion`` is the radial coefficient at
    half the width; ``electrons`` is the mean dose of a bright pixel (0: no noise); ``blur_px`` the
    Gaussian blur besides the pixel's area; ``growth_px`` by how much bright squares reach
    over the edges, in the untilted board.
    """

    square_px: float
    tilt_deg: float = 0.0
    axis_deg: float = 0.0
    turn_deg: float = 0.0
    offset: tuple[float, float] = (0.3, 0.2)
    distortion: float = 0.0
    perspective: float = 0.0
    blur_px: float = 0.7
    electrons: float = 0.0
    shading: float = 0.0
    inverted: bool = False
    dark: float = 0.25
    width: int = 512
    height: int = 512
    bounds: tuple[int, int, int, int] | None = None
    growth_px: float = 0.0

    @property
    def homography(self) -> Array:
        """Board (units of a square) to ideal pixels relative to the centre."""
        tilt, axis, turn = np.deg2rad([self.tilt_deg, self.axis_deg, self.turn_deg])

        def rotation(angle: float) -> Array:
            return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

        squeeze = rotation(axis) @ np.diag([1.0, np.cos(tilt)]) @ rotation(-axis)
        matrix = np.eye(3)
        matrix[:2, :2] = self.square_px * squeeze @ rotation(turn)
        matrix[:2, 2] = self.square_px * np.array(self.offset)
        depth = np.array([-np.sin(axis), np.cos(axis)]) @ rotation(turn)
        matrix[2, :2] = self.perspective * self.square_px * np.sin(tilt) * depth / self.width
        return matrix

    @property
    def centre(self) -> Array:
        return np.array([(self.width - 1) / 2.0, (self.height - 1) / 2.0])

    def image_from_board(self, uv: Array) -> Array:
        """(n, 2) pixels of board points (n, 2)."""
        h = np.column_stack([uv, np.ones(len(uv))]) @ self.homography.T
        q = h[:, :2] / h[:, 2:]
        scale = self.distortion / (self.width / 2.0) ** 2
        r2 = (q * q).sum(axis=1, keepdims=True)
        q = q * 2.0 / (1.0 + np.sqrt(np.maximum(1.0 - 4.0 * scale * r2, 1e-6)))
        return q + self.centre

    def board_from_image(self, xy: Array) -> Array:
        """(n, 2) board points of pixels (n, 2); the division model's exact inverse."""
        x, y = (xy[:, k] - self.centre[k] for k in range(2))
        if self.distortion:
            scale = self.distortion / (self.width / 2.0) ** 2
            divisor = 1.0 + scale * (x * x + y * y)
            x, y = x / divisor, y / divisor
        u, v, w = (a * x + b * y + c for a, b, c in np.linalg.inv(self.homography))
        # One column after the other in memory, which is what costs time.
        return np.array([u / w, v / w]).T

    def _beside(self, xy: Array, steps: Array) -> Iterator[Array]:
        """Board points (n, 2) of the places beside pixels (n, 2) at all pairs of steps, px."""
        straight = self.distortion == 0.0 and self.perspective == 0.0
        uv, across = self.board_from_image(xy), np.linalg.inv(self.homography)[:2, :2]
        for dx in steps:
            for dy in steps:
                yield uv + across @ [dx, dy] if straight else self.board_from_image(xy + [dx, dy])

    def corners(self, margin: float = 6.0) -> tuple[NDArray[np.int64], Array]:
        """Indices and pixels of the corners at least ``margin`` px inside the image."""
        frame = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]])
        corner_uv = self.board_from_image(frame.astype(np.float64))
        low, high = np.floor(corner_uv.min(axis=0)) - 2, np.ceil(corner_uv.max(axis=0)) + 2
        if self.bounds is not None:
            low = np.maximum(low, [self.bounds[0] + 1, self.bounds[1] + 1])
            high = np.minimum(high, [self.bounds[2] - 1, self.bounds[3] - 1])
        i, j = np.meshgrid(
            np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1), indexing="ij"
        )
        ij = np.column_stack([i.ravel(), j.ravel()])
        xy = self.image_from_board(ij)
        size = np.array([self.width, self.height])
        back = np.abs(self.board_from_image(xy) - ij).max(axis=1) < 1e-6
        inside = np.all((xy >= margin) & (xy <= size - 1 - margin), axis=1) & back
        return ij[inside].astype(np.int64), xy[inside]

    def _bright(self, uv: Array) -> Array:
        """(n,) 1 where the board is bright at board points (n, 2), else 0."""
        whole = np.floor(uv)
        bright = ((whole[:, 0] + whole[:, 1]).astype(np.int64) & 1 == 0) != self.inverted
        if self.growth_px > 0:
            bright |= np.abs(uv - np.round(uv)).min(axis=1) < self.growth_px / self.square_px
        if self.bounds is not None:
            a, b, c, d = self.bounds
            bright |= ~((uv[:, 0] > a) & (uv[:, 0] < c) & (uv[:, 1] > b) & (uv[:, 1] < d))
        return bright.astype(np.float64)

    def clean(self, samples: int = 8) -> Array:
        """(h, w) noise-free image with values between ``dark`` and 1, before shading.

        Pixels that an edge may cross are averaged over ``samples`` x ``samples`` points.
        """
        margin = 8
        x = np.arange(-margin, self.width + margin, dtype=np.float64)
        y = np.arange(-margin, self.height + margin, dtype=np.float64)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        points = self.board_from_image(grid)
        uv = points.reshape(len(y), len(x), 2)
        step_y, step_x = np.gradient(uv, axis=(0, 1))
        reach = 0.6 * (np.abs(step_x) + np.abs(step_y))
        reach += self.growth_px / self.square_px
        crossed = np.any(np.abs(uv - np.round(uv)) < reach, axis=2).ravel()
        total = self._bright(points)
        # Slightly off the centre, so that no sample lies exactly on an edge in a symmetric
        # position.
        steps = (np.arange(samples) + 0.4837) / samples - 0.5
        fine = np.zeros(int(crossed.sum()))
        for beside in self._beside(grid[crossed], steps):
            fine += self._bright(beside)
        total[crossed] = fine / samples**2
        picture = total.reshape(len(y), len(x))
        if self.blur_px > 0:
            picture = cv2.GaussianBlur(picture, (0, 0), self.blur_px)
        return self.dark + (1.0 - self.dark) * picture[margin:-margin, margin:-margin]

    def render(
        self, rng: np.random.Generator, dtype: type = np.uint8, samples: int = 8
    ) -> NDArray[np.generic]:
        """(h, w) image with shading and shot noise, quantised."""
        picture = self.clean(samples)
        y, x = np.mgrid[0.0 : self.height, 0.0 : self.width]
        ramp = 1.0 + self.shading * ((x / self.width - 0.5) + 0.7 * (y / self.height - 0.5) ** 2)
        picture = picture * ramp
        if self.electrons > 0:
            picture = rng.poisson(picture * self.electrons) / self.electrons
        full = {np.uint8: 255, np.uint16: 65535}.get(dtype)
        if full is None:
            return picture.astype(dtype)
        return np.clip(np.round(picture * 0.55 * full), 0, full).astype(dtype)


def position_bound(board: Board, ij: NDArray[np.int64]) -> Array:
    """(n, 2, 2) Cramer-Rao bound of the corners ``ij`` from the pixels nearest to each, px^2.

    Everything but the position is taken for known. The information is that of Poisson counts, with
    derivatives of the noise-free image from rendering the board twice, a little moved; nothing of
    the finder is used. For boards without distortion and perspective, where all corners move alike.
    """
    assert board.distortion == 0 and board.perspective == 0 and board.electrons > 0
    step = 0.2
    moved = []
    for axis in np.eye(2):
        shift = step * axis / board.square_px
        after, before = (
            replace(board, offset=(board.offset[0] + s * shift[0], board.offset[1] + s * shift[1]))
            for s in (1.0, -1.0)
        )
        moved.append((after.clean(4) - before.clean(4)).ravel() / (2.0 * step))
    gradient = np.array(moved)
    variance = board.clean(4).ravel() / board.electrons
    y, x = np.mgrid[0.0 : board.height, 0.0 : board.width]
    cells = np.rint(board.board_from_image(np.column_stack([x.ravel(), y.ravel()]))).astype(int)
    key = cells[:, 0] * 100_003 + cells[:, 1]
    wanted = ij[:, 0] * 100_003 + ij[:, 1]
    order = np.argsort(wanted)
    place = np.minimum(np.searchsorted(wanted[order], key), len(ij) - 1)
    hit = wanted[order][place] == key
    corner = order[place][hit]
    information = np.empty((len(ij), 2, 2))
    for a in range(2):
        for b in range(2):
            share = (gradient[a] * gradient[b] / variance)[hit]
            information[:, a, b] = np.bincount(corner, share, minlength=len(ij))
    return np.asarray(np.linalg.inv(information))


def detected(image: NDArray[Any], **options: Any) -> LatticeDetection:
    """The lattice of an image that must show one."""
    detection = find_lattice(image, **options)
    assert isinstance(detection, LatticeDetection), detection.reason
    return detection


def rejected(image: NDArray[Any]) -> Rejection[LatticeStatus]:
    """Why an image is refused that must be."""
    detection = find_lattice(image)
    assert isinstance(detection, Rejection)
    return detection


def seen_photograph(path: Path) -> LatticeDetection:
    """The lattice of a photograph of the reference data, found once in a run."""
    return made_once(
        f"photograph-{path.stem}", lambda: detected(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    )


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

    def _bright(self, uv: Array) -> Array:
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
        for beside in self._beside(grid, steps):
            total += self._bright(beside).reshape(shape)
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
