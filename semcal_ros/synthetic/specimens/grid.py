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

"""The interface of a specimen, and the two simplest: the checkerboard, with its faults, and a uniform one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.thresholds import (
    CURVATURE_MAX,
    FAULT_MAX,
    SQUARE_MAX,
    SQUARES_M,
    SURFACE_STEPS,
    SURFACE_TOLERANCE,
)


class Specimen(Protocol):
    """The interface that the renderer needs of a specimen."""

    @property
    def supersampling(self) -> int:
        """Samples per pixel and direction that the specimen needs."""
        ...

    def reflectivity(self, x_m: Array, y_m: Array, footprint_m: Array) -> NDArray[np.floating]:
        """Reflectivity in 0..1, averaged over the footprint of a sample.

        Parameters
        ----------
        x_m, y_m
            Specimen-plane coordinates, arrays of one shape.
        footprint_m
            (2, 2) derivative of (x, y) by a step of one sample along the columns and along the rows
            of the image.
        """
        ...


@runtime_checkable
class UnevenSpecimen(Protocol):
    """What the renderer needs, besides :class:`Specimen`, of one that is no drawing on a plane."""

    def undeform(self, u_m: Array, v_m: Array, lift: Array) -> tuple[Array, Array]:
        """Return the coordinates on the drawing of what rays show.

        Parameters
        ----------
        u_m, v_m
            Where the rays meet the plane in which the specimen would lie.
        lift
            (2, ...) by how much u and v of a ray change per height above this plane.
        """
        ...


@dataclass(frozen=True)
class GridFaults:
    """How a grid differs from squares in a plane.

    Attributes
    ----------
    stretch, shear
        Relative difference of its axes (x longer), and how far x moves with y.
    curvature
        1/m.
    wave, wave_squares
        Amplitude of a displacement of the rows in parts of a square, and its period in squares.
    squares_sigma
        Spread of the relative error of each size of squares.
    extent_squares
        Squares a side, around the origin, beyond which there is bare substrate; 0 for an endless grid.
    """

    stretch: float = 0.0
    shear: float = 0.0
    curvature: float = 0.0
    wave: float = 0.0
    wave_squares: float = 12.0
    squares_sigma: float = 0.0
    extent_squares: int = 0

    def __post_init__(self) -> None:
        parts = ("stretch", "shear", "wave", "squares_sigma")
        for name in parts:
            value = getattr(self, name)
            if not abs(value) <= FAULT_MAX:
                raise InvalidValueError(
                    f"a grid with {name} {value:g}", expected=f"at most {FAULT_MAX:g}"
                )
        if not abs(self.curvature) <= CURVATURE_MAX:
            radius_m = 1.0 / self.curvature
            raise InvalidValueError(
                f"a grid bowed to a radius of {1e3 * radius_m:g} mm",
                expected=f"at least {1e3 / CURVATURE_MAX:g} mm",
            )
        if self.squares_sigma < 0.0 or not (
            math.isfinite(self.wave_squares) and self.wave_squares >= 2.0
        ):
            raise InvalidValueError(
                f"grid {self}", expected="no negative spread, and waves of two squares or more"
            )

    @property
    def is_flat_and_regular(self) -> bool:
        """Whether no corner is displaced."""
        return not (self.stretch or self.shear or self.curvature or self.wave)

    def applied(self, x: Array, y: Array, square_m: float) -> Array:
        """Return the (n, 3) corners of squares that should lie at x and y, (n,) each, m."""
        return np.stack(
            [
                x * (1.0 + 0.5 * self.stretch) + self.shear * y + self._wave_m(y, square_m),
                y * (1.0 - 0.5 * self.stretch),
                0.5 * self.curvature * (x * x + y * y),
            ],
            axis=1,
        )

    def _wave_m(self, y: Array, square_m: float) -> Array:
        wave: Array = np.sin(2.0 * np.pi * y / (self.wave_squares * square_m))
        return self.wave * square_m * wave

    def removed(self, a: Array, b: Array, square_m: float) -> tuple[Array, Array]:
        """Return the x and y whose corners :meth:`applied` puts at a and b."""
        y = b / (1.0 - 0.5 * self.stretch)
        x = (a - self.shear * y - self._wave_m(y, square_m)) / (1.0 + 0.5 * self.stretch)
        return x, y

    def size_errors(self, seed: int) -> dict[float, float]:
        """Draw the relative error of each size of squares, the same for the same seed."""
        errors = np.random.default_rng((seed, 0x5155)).normal(size=len(SQUARES_M))
        return dict(zip(SQUARES_M, (self.squares_sigma * errors).tolist(), strict=True))


TYPICAL_GRID = GridFaults(stretch=2e-4, shear=1e-4, curvature=1.0, squares_sigma=2e-4)
"""A grid as electron-beam lithography writes it on a chip: its axes are equal and at right angles to 1 part
in 5000 to 10 000, its squares are as good, and the chip is bowed to a radius of a metre."""


@dataclass(frozen=True)
class FlatSpecimen:
    """A specimen with the same reflectivity everywhere."""

    value: float = 0.5

    @property
    def supersampling(self) -> int:
        """One sample per pixel is enough."""
        return 1

    def reflectivity(self, x_m: Array, y_m: Array, footprint_m: Array) -> Array:
        """See :class:`Specimen`."""
        return np.full(x_m.shape, self.value)


@dataclass(frozen=True)
class ChessGrid:
    """An endless checkerboard whose corners should be at the integer multiples of ``square_m``.

    The square between (0, 0) and (1, 1) squares is bright.

    Attributes
    ----------
    square_m
        Nominal size of the squares.
    faults, size_error
        How the grid differs from squares in a plane, and the relative error of this size.
    """

    square_m: float
    faults: GridFaults = GridFaults()
    size_error: float = 0.0

    def __post_init__(self) -> None:
        check_positive(self.square_m, "square of", "m")

    @property
    def supersampling(self) -> int:
        """Two: the filter is exact for edges along either axis, the samples handle the corners."""
        return 2

    def undeform(self, u_m: Array, v_m: Array, lift: Array) -> tuple[Array, Array]:
        """See :class:`UnevenSpecimen`.

        Raises
        ------
        InvalidValueError
            If rays do not meet the surface.
        """
        size = 1.0 + self.size_error
        if self.faults.is_flat_and_regular:
            return (u_m, v_m) if self.size_error == 0.0 else (u_m / size, v_m / size)
        height = np.zeros_like(u_m)
        for _ in range(SURFACE_STEPS):
            a, b = u_m + lift[0] * height, v_m + lift[1] * height
            x, y = self.faults.removed(a / size, b / size, self.square_m)
            before, height = height, 0.5 * size * self.faults.curvature * (x * x + y * y)
            change = np.abs(lift * (height - before)).max()
            if change <= SURFACE_TOLERANCE * self.square_m:
                return x, y
        raise InvalidValueError(
            f"a grid bowed to a radius of {1e3 / self.faults.curvature:g} mm, which rays only graze",
            expected="a surface that every pixel's ray meets",
            do="tilt it less, or bow it less",
        )

    def reflectivity(self, x_m: Array, y_m: Array, footprint_m: Array) -> Array:
        """See :class:`Specimen`."""
        # The box has the second moment of the sample's parallelogram projected on each axis of the
        # board.
        width = np.hypot(footprint_m[:, 0], footprint_m[:, 1]) / self.square_m
        product = _filter_wave(x_m / self.square_m, float(width[0]))
        product *= _filter_wave(y_m / self.square_m, float(width[1]))
        if (extent := self.faults.extent_squares) > 0:
            half_m = 0.5 * extent * self.square_m
            product[(np.abs(x_m) > half_m) | (np.abs(y_m) > half_m)] = 0.0
        product *= 0.5
        product += 0.5
        return product


def _filter_wave(u: Array, width: float) -> Array:
    """Return a square wave of period 2, +1 on (0, 1) and -1 on (1, 2), averaged over a box of this width."""
    if width >= 1.0:
        return (_integrate_wave(u + 0.5 * width) - _integrate_wave(u - 0.5 * width)) / width
    phase = u - 0.5
    phase -= 2.0 * np.floor(0.5 * phase)
    phase -= 1.0
    np.abs(phase, out=phase)
    phase -= 0.5
    # phase is now the signed distance to the nearest edge, positive on the bright side.
    phase *= 2.0 / max(width, 1e-12)
    return np.clip(phase, -1.0, 1.0, out=phase)


def _integrate_wave(u: Array) -> Array:
    phase = u - 2.0 * np.floor(0.5 * u)
    return 1.0 - np.abs(phase - 1.0)


def square_for(pixel_size_m: float, image_width: int = 512) -> float:
    """Return the square size in m that an operator would choose: the largest with six squares in view."""
    limit = SQUARE_MAX * image_width * pixel_size_m
    fitting = [square for square in SQUARES_M if square <= limit]
    return max(fitting, default=min(SQUARES_M))
