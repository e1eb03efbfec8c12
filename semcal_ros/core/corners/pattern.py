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

"""Tell checkerboards, dots, crosses and crossed lines apart by the Fourier coefficients of their unit cell.

All of them repeat on a square lattice, and a checkerboard is a lattice of squares that touch at their
corners. What differs is the shape of the bright part: a square on its tip (chess), a disc (dots,
holes), a plus sign (crosses), or a square in line with the lattice (the opening between crossed
lines). Its transform is known in closed form; size and blur are fitted for each shape, and the best
fit names the pattern.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from semcal_ros.core.arrays import Array
from semcal_ros.core.corners.thresholds import (
    AMBIGUOUS_RATIO,
    ARM_LENGTHS,
    ARM_WIDTHS,
    CHESS_SIZES,
    COMMONEST,
    COMPARABLE_RATIO,
    HARMONIC_ORDERS,
    LINES_OPENING_MIN,
    MOTIF_BLURS,
    MOTIF_SIZES,
    MOTIF_STEP,
    ODDS_MAX,
    RELIEF_ASIDE_MIN,
    RELIEF_GAIN_MIN,
    RELIEF_MISFIT_MAX,
    RELIEF_SHIFTS,
    RIM_DIMNESS,
    RIM_WIDTHS,
    SHAPE_MISFIT_LEAST,
    SHAPES_FOR_CENTRE,
)
from semcal_ros.core.corners.unit_cell import UnitCell
from semcal_ros.core.errors import InvalidValueError

#: What a grid consists of.
Pattern = Literal["chess", "dots", "crosses", "lines", "grating"]
#: What to search for.
PatternChoice = Literal["auto", "chess", "dots", "crosses", "lines", "grating"]
PATTERNS = ("auto", "chess", "dots", "crosses", "lines", "grating")
#: What they are called.
PATTERN_NAMES = {
    "chess": "a chess board",
    "dots": "dots",
    "crosses": "crosses",
    "lines": "crossed lines",
    "grating": "parallel lines",
}


@dataclass(frozen=True)
class CellShape:
    """The shape of one pattern that describes a unit cell best.

    Attributes
    ----------
    pattern
        Its name.
    centred
        Whether the dot, the opening or the bright square is at the lattice point, rather than at the
        centre of the cell.
    size
        Diameter of the dot, side of the square, or length of the cross, in cells.
    blur
        Standard deviation of the blur, in cells.
    misfit
        Part of the power of the cell that it leaves unexplained.
    """

    pattern: Pattern
    centred: bool
    size: float
    blur: float
    misfit: float


@dataclass(frozen=True)
class CellShapes:
    """The best shape of each pattern.

    Attributes
    ----------
    chess, dots, crosses, lines
        The shapes.
    asymmetry
        Part of the power by which the cell differs from its mirror image. It is small on a square
        lattice; dots on a hexagonal one are ellipses in the coordinates of the lattice.
    power
        Power of the cell in squared grey values, without its odd part where it has no relief. It is small where cells
        of a wrong lattice average to grey.
    """

    chess: CellShape
    dots: CellShape
    crosses: CellShape
    lines: CellShape
    asymmetry: float
    power: float

    @property
    def every(self) -> tuple[CellShape, ...]:
        """All of them."""
        return self.chess, self.dots, self.crosses, self.lines

    def get(self, pattern: Pattern) -> CellShape:
        """Return the best shape of a pattern."""
        return next(shape for shape in self.every if shape.pattern == pattern)

    @property
    def best(self) -> CellShape:
        """The most likely shape."""
        return min(self.every, key=self.rank)

    @property
    def _least(self) -> CellShape:
        return min(self.every, key=lambda shape: shape.misfit)

    def allows(self, pattern: Pattern) -> bool:
        """Whether it may be this pattern: whether no other one is much more likely."""
        return self.get(pattern).misfit <= AMBIGUOUS_RATIO * self._least.misfit

    def rank(self, shape: CellShape) -> tuple[int, float]:
        """Return what sorts shapes by how likely they are; of those that are about as likely, the commoner comes first.

        Any blurred pattern may be a checkerboard, and blurred or stubby crosses may be dots, which have the same
        middle. A checkerboard has other points, by which the scale would be wrong: it is not presumed by as much.
        """
        ratio = COMPARABLE_RATIO if shape.pattern == "chess" else AMBIGUOUS_RATIO
        if shape.misfit > ratio * self._least.misfit:
            return len(COMMONEST), shape.misfit
        return COMMONEST[shape.pattern], shape.misfit

    def odds_against(self, pattern: Pattern) -> float:
        """Return how many times as likely the best pattern is; the harmonics have independent, normal errors."""
        return self._odds(self.get(pattern).misfit, self.best.misfit)

    def odds_of(self, pattern: Pattern) -> float:
        """Return how many times as likely a pattern is as the best other one."""
        others = min(shape.misfit for shape in self.every if shape.pattern != pattern)
        return self._odds(others, self.get(pattern).misfit)

    @staticmethod
    def _odds(misfit: float, other: float) -> float:
        count = len(_harmonics()[0])
        return float(min((misfit / other) ** (0.5 * count), ODDS_MAX))


@dataclass(frozen=True)
class _Transforms:
    """Normalised transforms of shapes, (s, f), and sums (3, s) of products of their derivatives (uu, vv, uv)."""

    values: Array
    slopes: Array

    def project(self, seen: NDArray[np.complex128]) -> tuple[Array, Array, Array]:
        """Project coefficients (f, n): amplitudes (s, n), power (s, n) and amplitudes (2, s, n) of the derivatives."""
        h, k = (order[:, None] for order in _harmonics())
        uu, vv, uv = self.slopes[:, :, None]
        u, v = self.values @ (h * seen.imag), self.values @ (k * seen.imag)
        slopes = np.stack([vv * u - uv * v, uu * v - uv * u]) / np.maximum(uu * vv - uv * uv, 1e-12)
        return self.values @ seen.real, slopes[0] * u + slopes[1] * v, slopes

    def find_centre(
        self, seen: NDArray[np.complex128], centres: list[tuple[float, float]]
    ) -> tuple[float, float]:
        """Return which of these centres explains most of some coefficients, with a relief."""
        moved = np.stack([seen * _move(*centre) for centre in centres], axis=1)
        amplitude, odd, _ = self.project(moved)
        return centres[int(np.argmax(np.max(amplitude**2 + odd, axis=0)))]


@dataclass(frozen=True)
class _Shapes:
    """Shapes with their transforms, and those of a part of them, which is enough to find a centre."""

    names: tuple[Pattern, ...]
    centred: Array
    sizes: Array
    blurs: Array
    transforms: _Transforms
    some: _Transforms


def check_pattern(pattern: str) -> PatternChoice:
    """Return ``pattern``, or raise InvalidValueError if it is none of :data:`PATTERNS`."""
    if pattern not in PATTERNS:
        raise InvalidValueError(f"pattern {pattern!r}", expected=", ".join(PATTERNS))
    return cast("PatternChoice", pattern)


def describe_odds(odds: float) -> str:
    """Put odds into words."""
    if odds >= ODDS_MAX:
        return "more than a million to one"
    return f"{odds:.0f} to one" if odds >= 10.0 else f"{odds:.2g} to one"


@cache
def _harmonics() -> tuple[Array, Array]:
    """Return the orders (h, k) of one of each pair of opposite coefficients."""
    orders = np.arange(-HARMONIC_ORDERS, HARMONIC_ORDERS + 1)
    h, k = (g.ravel() for g in np.meshgrid(orders, orders, indexing="ij"))
    half = ((h > 0) | ((h == 0) & (k > 0))) & (
        h * h + k * k <= HARMONIC_ORDERS * HARMONIC_ORDERS + 1
    )
    return h[half], k[half]


def _list_rims(width: float) -> list[tuple[float, float]]:
    """Return no rim, and the rims that a face of this width can have, each with how much dimmer the face is."""
    rims = [float(rim) for rim in RIM_WIDTHS if 2.0 * rim < width]
    return [(0.0, 0.0), *((rim, float(dimness)) for rim in rims for dimness in RIM_DIMNESS)]


def _disc(size: float, radius: Array) -> Array:
    return np.asarray(j1(np.pi * size * radius) * size / radius)


def _square(size: float, h: Array, k: Array) -> Array:
    return np.asarray(size * size * np.sinc(size * h) * np.sinc(size * k))


def _cross(arm: float, width: float, h: Array, k: Array) -> Array:
    one = np.sinc(arm * h) * np.sinc(width * k) + np.sinc(width * h) * np.sinc(arm * k)
    return np.asarray(arm * width * one - _square(width, h, k))


def _tip(side: float, h: Array, k: Array) -> Array:
    """A square that stands on its tip."""
    return _square(side, (h + k) / np.sqrt(2.0), (h - k) / np.sqrt(2.0))


@cache
def _shapes() -> _Shapes:
    h, k = _harmonics()
    radius = np.hypot(h, k)
    names: list[Pattern] = []
    rows: list[tuple[bool, float, float, Array]] = []

    def add(name: Pattern, size: float, transform: Array) -> None:
        for blur in MOTIF_BLURS:
            soft = transform * np.exp(-2.0 * np.pi**2 * blur**2 * radius**2)
            for centred in (True, False):
                # A shift by half a cell along both axes.
                moved = soft if centred else soft * (1.0 - 2.0 * ((h + k) % 2))
                names.append(name)
                rows.append((centred, size, float(blur), moved / np.linalg.norm(moved)))

    for size in map(float, MOTIF_SIZES):
        # Openings wider than this leave lines between them; narrower ones are square dots.
        squares: Pattern = "lines" if size >= LINES_OPENING_MIN else "dots"
        # With rims, pads and wide bars could not be told apart.
        add(squares, size, _square(size, h, k))
        for rim, dimness in _list_rims(size):
            add("dots", size, _disc(size, radius) - dimness * _disc(size - 2.0 * rim, radius))
    for arm in map(float, 2.0 * ARM_LENGTHS):
        for width in map(float, ARM_WIDTHS[arm > 1.5 * ARM_WIDTHS]):
            for rim, dimness in _list_rims(width):
                face = _cross(arm - 2.0 * rim, width - 2.0 * rim, h, k)
                add("crosses", arm, _cross(arm, width, h, k) - dimness * face)
    for size in map(float, CHESS_SIZES):
        side = size / np.sqrt(2.0)
        for rim, dimness in _list_rims(side):
            add("chess", size, _tip(side, h, k) - dimness * _tip(side - 2.0 * rim, h, k))
    centred, sizes, blurs, values = (np.array(column) for column in zip(*rows, strict=True))
    slopes = np.stack([values**2 @ product for product in (h * h, k * k, h * k)])
    every, some = (_Transforms(values[::n], slopes[:, ::n]) for n in (1, SHAPES_FOR_CENTRE))
    return _Shapes(tuple(names), centred, sizes, blurs, every, some)


def fit_shapes(cell: UnitCell) -> CellShapes:
    """Fit the shapes of all patterns to a unit cell with a symmetric motif at its lattice point.

    A detector on one side sees slopes that face it brighter than those that turn away: besides the shape, the cell
    then shows its derivative towards the detector. This relief is fitted as well, where the cell proves to have one.

    Parameters
    ----------
    cell
        Coarse mean of the cells.
    """
    h, k = _harmonics()
    m = len(cell.values)
    # Bins average over their width.
    window = np.sinc(h / m) * np.sinc(k / m)
    coefficients = cell.coefficients
    centre = cell.find_centre()
    seen = coefficients[h, k] * _move(*centre) / window
    mirrored = coefficients[h, -k] * np.exp(2j * np.pi * (h * centre[0] - k * centre[1])) / window
    shapes = _shapes()
    power = max(float(np.sum(np.abs(seen) ** 2)), 1e-30)
    even = max(float(np.sum(seen.real**2)), 1e-30)
    projected = (shapes.transforms.values @ seen.real) ** 2
    left = 1.0 - projected / even
    slopes = np.zeros(2)
    shaded = _fit_relief(seen)
    least = float(shaded.left.min())
    better = RELIEF_GAIN_MIN * least < 1.0 - float(projected.max()) / power
    if better and least < RELIEF_MISFIT_MAX and _measure_aside(seen) > RELIEF_ASIDE_MIN:
        left, slopes, even = shaded.left, shaded.slopes, power
        seen = seen * _move(*shaded.centre)
        mirrored = mirrored * np.exp(2j * np.pi * (h * shaded.centre[0] - k * shaded.centre[1]))
    asymmetry = _compare_mirrored(seen, mirrored, slopes)
    names = np.array(shapes.names)

    def best(pattern: Pattern) -> CellShape:
        index = int(np.argmin(np.where(names == pattern, left, np.inf)))
        return CellShape(
            pattern,
            bool(shapes.centred[index]),
            float(shapes.sizes[index]),
            float(shapes.blurs[index]),
            # No shape explains more than its own discretisation lets it.
            max(float(left[index]), SHAPE_MISFIT_LEAST),
        )

    return CellShapes(best("chess"), best("dots"), best("crosses"), best("lines"), asymmetry, even)


def find_motif(cell: UnitCell) -> tuple[float, float]:
    """Return where in a cell the motif is that some shape describes best, lit from one side or not; (u, v) in cells."""
    h, k = _harmonics()
    steps = np.arange(0.0, 1.0, MOTIF_STEP)
    return _shapes().some.find_centre(
        cell.coefficients[h, k], [(float(u), float(v)) for u in steps for v in steps]
    )


# Enough for all centres that are tried.
@lru_cache(maxsize=1024)
def _move(u: float, v: float) -> NDArray[np.complex128]:
    """Factors on the coefficients that move the lattice point by (u, v) cells."""
    h, k = _harmonics()
    return np.asarray(np.exp(2j * np.pi * (u * h + v * k)))


def _measure_aside(seen: NDArray[np.complex128]) -> float:
    """Part of the power of coefficients (f,) that is at no multiples of the frequency that has most of it."""
    h, k = _harmonics()
    common = np.gcd(h, k)
    power = np.abs(seen) ** 2
    _, family = np.unique(np.stack([h, k]) // common, axis=1, return_inverse=True)
    return 1.0 - float(np.bincount(family.ravel(), power).max()) / max(float(power.sum()), 1e-30)


def _compare_mirrored(
    seen: NDArray[np.complex128], mirrored: NDArray[np.complex128], slopes: Array
) -> float:
    """Part of the power by which the shape under a relief differs from its mirror image; coefficients (f,) of both."""
    h, k = _harmonics()
    relief = 1.0 + 1j * (slopes[0] * h + slopes[1] * k)
    opposite = 1.0 + 1j * (slopes[0] * h - slopes[1] * k)
    # Each coefficient of the shape, and how well it is known.
    weights = np.stack([np.abs(relief) ** 2, np.abs(opposite) ** 2])
    parts = np.stack([(seen * relief.conj()).real, (mirrored * opposite.conj()).real]) / weights
    common = weights.prod(axis=0) / weights.sum(axis=0)
    power = max(float(np.sum(weights[0] * parts[0] ** 2)), 1e-30)
    return float(np.sum(common * (parts[0] - parts[1]) ** 2)) / (2.0 * power)


@dataclass(frozen=True)
class _Relief:
    """All shapes with a relief: (s,) parts of the power that are left, and the best one's (u, v) centre and slopes.

    Slopes are the weights of the derivatives along both axes, over that of the shape itself.
    """

    left: Array
    centre: tuple[float, float]
    slopes: Array


def _fit_relief(seen: NDArray[np.complex128]) -> _Relief:
    """Fit all shapes and their derivatives to coefficients (f,) about a centre that a relief may have shifted."""
    shapes = _shapes()
    u, v = shapes.some.find_centre(seen, [(u, v) for u in RELIEF_SHIFTS for v in RELIEF_SHIFTS])
    steps = 0.5 * (RELIEF_SHIFTS[1] - RELIEF_SHIFTS[0]) * np.array([-1.0, 0.0, 1.0])
    centre = shapes.some.find_centre(seen, [(u + a, v + b) for a in steps for b in steps])
    moved = (seen * _move(*centre))[:, None]
    even, odd, slopes = shapes.transforms.project(moved)
    left = 1.0 - (even**2 + odd)[:, 0] / max(float(np.sum(np.abs(seen) ** 2)), 1e-30)
    best = int(np.argmin(left))
    return _Relief(left, centre, slopes[:, best, 0] / (even[best, 0] or 1.0))
