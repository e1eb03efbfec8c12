"""The interface of a specimen, and the two simplest: the chess grid and a uniform one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError

__all__ = ["SQUARES_M", "ChessGrid", "FlatSpecimen", "Specimen", "square_for"]


SQUARES_M: tuple[float, ...] = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)
"""Square sizes of the multi-scale grid."""

_LARGEST_SQUARE = 0.155  # of the image width: at least six squares are in view


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
    """An endless chess board whose corners are at the integer multiples of ``square_m``.

    The square between (0, 0) and (1, 1) squares is bright.
    """

    square_m: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.square_m) and self.square_m > 0):
            raise InvalidValueError(f"square of {self.square_m} m", expected="a positive size")

    @property
    def supersampling(self) -> int:
        """Two: the filter is exact for edges along either axis, the samples handle the corners."""
        return 2

    def reflectivity(self, x_m: Array, y_m: Array, footprint_m: Array) -> Array:
        """See :class:`Specimen`."""
        # The box has the second moment of the sample's parallelogram projected on each axis of the
        # board.
        width = np.hypot(footprint_m[:, 0], footprint_m[:, 1]) / self.square_m
        product = _filter_wave(x_m / self.square_m, float(width[0]))
        product *= _filter_wave(y_m / self.square_m, float(width[1]))
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
    limit = _LARGEST_SQUARE * image_width * pixel_size_m
    fitting = [square for square in SQUARES_M if square <= limit]
    return max(fitting, default=min(SQUARES_M))
