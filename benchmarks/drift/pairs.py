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

"""Pairs of noisy images whose shift is exact, with the Cramer-Rao bound of each.

A scene is drawn once on a grid finer than a pixel, far enough beyond the image for every shift.
By definition it is the sum of one Gaussian beam per point of that grid, which is a function of the
position like any other: a shifted view evaluates it at shifted pixels, and its gradient is a sum of
derivatives of the same Gaussians. Nothing is interpolated, so the shift of a view is true to the
rounding of single precision; :meth:`Scene.check` holds it to that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from semcal_ros.core.arrays import Array, Image
from semcal_ros.synthetic import ChessGrid, GoldOnCarbon, Specimen, preset, square_for

Gray = NDArray[np.uint8] | NDArray[np.uint16]
Shift = tuple[float, float]

MAGNIFICATION = 5000.0
BLUR_PX = 1.0
# The beam is 2e-8 of its peak at six sigma.
_KERNEL_PX = 6.0 * BLUR_PX
# Grey levels of 8 bits: what noise may need is kept free above and below the specimen.
_CONTRAST = 36.0
_RANGE = 190.0
_ANGLE_RAD = 0.3
_BLOCK_LINES = 128
KINDS = ("gold", "grid", "texture", "sparse")
# The noise of the least noisy rows: their bound is what the scene must be better than.
LEAST_NOISE_DB = 30.0


class Scene:
    """A specimen at any shift, in grey levels of 8 bits without noise.

    Parameters
    ----------
    kind
        One of :data:`KINDS`.
    size
        Width and height of the views, px.
    reach_px
        Largest shift along either axis.
    """

    def __init__(self, kind: str, size: int, reach_px: float) -> None:
        # From two points per px on, the beam suppresses what the grid cannot carry to 3e-9.
        self._per_px = 4 if size <= 1024 else 2
        self._border = int(np.ceil(reach_px + _KERNEL_PX)) + 1
        self.size = size
        self._canvas = _DRAWN[kind](size, (size + 2 * self._border) * self._per_px, self._per_px)
        self._scale, self._level = 1.0, 0.0
        plain = self.view((0.0, 0.0))
        low, high = np.percentile(plain, (0.05, 99.95))
        self._scale = min(_CONTRAST / float(plain.std()), _RANGE / float(high - low))
        self._level = 127.5 - 0.5 * self._scale * float(low + high)
        self.contrast = self._scale * float(plain.std())

    def view(self, shift: Shift) -> Array:
        """What lay at x is seen at x + shift."""
        seen = self._seen(self._beams(shift[0]), self._beams(shift[1]))
        return self._level + self._scale * seen.astype(np.float64)

    def gradient(self) -> Array:
        """(2, h, w) derivatives of the unshifted view by x and y."""
        plain, slope = self._beams(0.0), self._beams(0.0, slope=True)
        both = [self._seen(slope, plain), self._seen(plain, slope)]
        return self._scale * np.stack(both).astype(np.float64)

    def bound_px(self, gradient: Array, shift: Shift, sigma: float) -> float:
        """Cramer-Rao bound of one coordinate of a shift, RMS over both, where both images have
        white noise of ``sigma``.
        """
        x, y = (round(s) for s in shift)
        rows = slice(max(0, -y), self.size - max(0, y))
        cols = slice(max(0, -x), self.size - max(0, x))
        flat = gradient[:, rows, cols].reshape(2, -1)
        information = flat @ flat.T / (2.0 * sigma**2)
        return float(np.sqrt(np.trace(np.linalg.inv(information)) / 2.0))

    def check(self, seed: int = 0) -> float:
        """Error of the views as a shift, over the smallest bound; asserts that it is small.

        A view is compared with the defining sum, taken in double precision at some pixels. The
        result is what the differences would do if all of them were in step with the gradient,
        which rounding is not.
        """
        rng = np.random.default_rng(seed)
        reach = self._border - _KERNEL_PX - 1.0
        shift = (float(rng.uniform(-1.0, 1.0) * reach), float(rng.uniform(-1.0, 1.0) * reach))
        view = self.view(shift)
        x, y = rng.integers(0, self.size, (2, 300))
        direct = [self._direct(*at) for at in zip(x - shift[0], y - shift[1], strict=True)]
        difference = float(np.sqrt(np.mean((np.array(direct) - view[y, x]) ** 2)))
        # Both are projected on the gradient alike, so that its size drops out of their ratio.
        sigma = self.contrast * 10.0 ** (-LEAST_NOISE_DB / 20.0)
        error = difference * self.size / (np.sqrt(2.0) * sigma)
        assert error < 0.1, f"views are wrong by {error:.2g} of the bound"
        self._check_gradient()
        return error

    def _check_gradient(self) -> None:
        gradient, h = self.gradient(), 0.02
        for axis, step in enumerate(((h, 0.0), (0.0, h))):
            across = (self.view((-step[0], -step[1])) - self.view(step)) / (2.0 * h)
            off = np.linalg.norm(across - gradient[axis]) / np.linalg.norm(gradient[axis])
            assert off < 1e-3, f"the gradient is wrong by {off:.2g} of itself"

    def _direct(self, x: float, y: float) -> float:
        """The scene at one point in pixels, from the definition."""
        around = []
        for at in (x, y):
            first = int(np.floor((at + self._border - 7.0) * self._per_px))
            index = np.arange(max(first, 0), min(first + 14 * self._per_px, len(self._canvas)))
            around.append((index, _beam(index / self._per_px - self._border - at, self._per_px)))
        (cols, across), (rows, down) = around
        part = self._canvas[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1].astype(np.float64)
        return self._level + self._scale * float(down @ part @ across)

    def _beams(self, shift: float, slope: bool = False) -> sparse.csr_matrix:
        """(size, canvas) weights of the points of the grid, along one axis."""
        at = np.arange(self.size) - shift
        first = np.ceil((at + self._border - _KERNEL_PX) * self._per_px).astype(np.int64)
        index = first[:, None] + np.arange(int(2 * _KERNEL_PX * self._per_px))
        distance = index / self._per_px - self._border - at[:, None]
        weights = _beam(distance, self._per_px)
        if slope:
            weights *= distance / BLUR_PX**2
        starts = np.arange(self.size + 1) * index.shape[1]
        return sparse.csr_matrix(
            (weights.ravel().astype(np.float32), index.ravel(), starts),
            shape=(self.size, len(self._canvas)),
        )

    def _seen(self, along: sparse.csr_matrix, down: sparse.csr_matrix) -> Image:
        lines = np.ascontiguousarray((down @ self._canvas).T)
        return np.ascontiguousarray((along @ lines).T)


def _beam(distance: Array, per_px: int) -> Array:
    scale = per_px * BLUR_PX * np.sqrt(2.0 * np.pi)
    return np.asarray(np.exp(-0.5 * (distance / BLUR_PX) ** 2) / scale)


# -- what is drawn on the fine grid: (n, n), of which `per_px` points lie along a pixel ---------------


def _specimen(choose: Callable[[float, int], Specimen]) -> Callable[[int, int, int], Image]:
    def drawn(size: int, n: int, per_px: int) -> Image:
        microscope = preset("ideal").with_image_size(size, size)
        pixel_m = microscope.nominal_pixel_size_m(MAGNIFICATION)
        specimen, step_m = choose(pixel_m, size), pixel_m / per_px
        c, s = np.cos(_ANGLE_RAD) * step_m, np.sin(_ANGLE_RAD) * step_m
        footprint = np.array([[c, s], [-s, c]])
        out = np.empty((n, n), dtype=np.float32)
        # In bands: the coordinates of the whole grid would take a gigabyte.
        for top in range(0, n, _BLOCK_LINES):
            rows = slice(top, min(top + _BLOCK_LINES, n))
            v, u = np.mgrid[rows, :n].astype(np.float64) - 0.5 * n
            out[rows] = specimen.reflectivity(c * u + s * v, c * v - s * u, footprint)
        return out

    return drawn


def _texture(size: int, n: int, per_px: int) -> Image:
    """White on the fine grid: the beam alone decides how fine the texture is."""
    return np.random.default_rng(3).standard_normal((n, n), dtype=np.float32)


def _sparse(size: int, n: int, per_px: int) -> Image:
    """One particle of 3 to 8 px radius on 128 x 128 px."""
    rng = np.random.default_rng(4)
    out = np.zeros((n, n), dtype=np.float32)
    for _ in range(round((n / per_px / 128.0) ** 2)):
        radius = rng.uniform(3.0, 8.0) * per_px
        centre = rng.uniform(radius, n - radius, 2)
        first = np.floor(centre - radius).astype(int)
        window = tuple(slice(k, k + int(2 * radius) + 3) for k in first)
        v, u = np.mgrid[window]
        inside = np.hypot(v - centre[0], u - centre[1]) < radius
        part = out[window]
        part[inside[: part.shape[0], : part.shape[1]]] = rng.uniform(0.5, 1.0)
    return out


_DRAWN: dict[str, Callable[[int, int, int], Image]] = {
    "gold": _specimen(lambda pixel_m, size: GoldOnCarbon(1)),
    "grid": _specimen(lambda pixel_m, size: ChessGrid(square_for(pixel_m, size))),
    "texture": _texture,
    "sparse": _sparse,
}


# -- noise --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pair:
    """Two noisy images, the shift between them, its bound, and what a tracker would expect."""

    reference: Gray
    image: Gray
    shift: Shift
    bound_px: float
    guess_px: Shift


def noisy(picture: Array, sigma: float, bits: int, rng: np.random.Generator) -> Gray:
    """With white noise and rounded; 16 bits are 257 times the grey levels of 8."""
    top = 2**bits - 1
    gray = np.rint((picture + rng.normal(0.0, sigma, picture.shape)) * (top / 255.0))
    return np.clip(gray, 0, top).astype(np.uint8 if bits == 8 else np.uint16)


class Views:
    """Views of a scene at several shifts, of which pairs with any noise are made."""

    def __init__(self, scene: Scene, shifts: list[Shift]) -> None:
        self.scene, self.shifts = scene, shifts
        self._still, self._gradient = scene.view((0.0, 0.0)), scene.gradient()
        self._views = [scene.view(shift).astype(np.float32) for shift in shifts]

    def pairs(
        self, noise_db: float, bits: int, guess_sigma_px: float, seed: tuple[int, ...]
    ) -> list[Pair]:
        """One pair per shift; noise in dB is 20 log10 of contrast over noise (standard deviations)."""
        rng = np.random.default_rng(seed)
        sigma = self.scene.contrast * 10.0 ** (-noise_db / 20.0)
        # Rounding is noise too, and no method can undo it.
        rounding = np.sqrt(1.0 / 12.0) * 255.0 / (2**bits - 1)
        total = float(np.hypot(sigma, rounding))
        out = []
        for shift, view in zip(self.shifts, self._views, strict=True):
            guess = np.asarray(shift) + rng.normal(0.0, guess_sigma_px, 2)
            out.append(
                Pair(
                    noisy(self._still, sigma, bits, rng),
                    noisy(view, sigma, bits, rng),
                    shift,
                    self.scene.bound_px(self._gradient, shift, total),
                    (float(guess[0]), float(guess[1])),
                )
            )
        return out


def small_shifts(count: int, rng: np.random.Generator) -> list[Shift]:
    """Within 4 px."""
    return [(float(x), float(y)) for x, y in rng.uniform(-4.0, 4.0, (count, 2))]


def large_shifts(count: int, size: int, rng: np.random.Generator) -> list[Shift]:
    """From a tenth to a third of the image along both axes."""
    lengths = rng.uniform(0.1 * size, size / 3.0, (count, 2)) * rng.choice([-1, 1], (count, 2))
    return [(float(x), float(y)) for x, y in lengths]


if __name__ == "__main__":
    for name in KINDS:
        for width, reach in ((512, 512 / 3), (1024, 1024 / 3), (2048, 2048 / 3)):
            print(name, width, f"{Scene(name, width, reach).check():.2g} of the bound")
