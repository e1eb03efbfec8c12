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

"""Continuous functions of the magnification.

Every kind is linear in its coefficients, ``f(g) = basis(g) @ coefficients``, so that one covariance
matrix of all coefficients propagates exactly to any magnification. Outside the range in which it
was determined a function continues along its tangent in log g; the caller flags that and widens the
uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import legendre

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError

KINDS = ("chebyshev_log", "chebyshev", "legendre", "linear_log", "ode")


def _unit_interval(value: float, low: float, high: float) -> float:
    return 2.0 * (value - low) / (high - low) - 1.0 if high > low else 0.0


def _hat_row(value: float, knots: Array) -> Array:
    row = np.zeros(len(knots))
    if len(knots) == 1:
        row[0] = 1.0
        return row
    i = int(np.clip(np.searchsorted(knots, value) - 1, 0, len(knots) - 2))
    weight = (value - knots[i]) / (knots[i + 1] - knots[i])
    row[i], row[i + 1] = 1.0 - weight, weight
    return row


def _ode_row(value: float, weights: Array) -> Array:
    """Return the first row of the transition matrix of a differential equation over ``value``.

    The equation is D^k x = -w_0 x - ... - w_(k-1) D^(k-1) x.
    """
    order = len(weights)
    # Imported here so that programs that use another kind of function start without scipy.
    from scipy.linalg import expm

    companion = np.diag(np.ones(order - 1), 1)
    companion[-1] = -weights
    return expm(companion * value)[0]


def _chebyshev_row(value: float, size: int) -> Array:
    """Return Chebyshev polynomials by their recurrence; at one value numpy is slower."""
    row = [1.0, value]
    while len(row) < size:
        row.append(2.0 * value * row[-1] - row[-2])
    return np.array(row[:size])


def _extension_row(x: float, knots: Array) -> Array:
    """Return twofold integrals over log g of hat functions, one on each knot but the last, from the first knot on.

    ``x`` and the ``knots`` are logarithms; the knots ascend, and nothing is added below the first one.
    """
    steps = np.diff(knots)
    beyond = np.maximum(x - knots, 0.0)
    cubes = beyond**3 / 6.0
    # A ramp up, a ramp down, and none after that: the second derivative is a hat.
    row = np.zeros(len(steps))
    row[0] = 0.5 * beyond[0] ** 2 - (cubes[0] - cubes[1]) / steps[0]
    row[1:] = (cubes[:-2] - cubes[1:-1]) / steps[:-1] - (cubes[1:-1] - cubes[2:]) / steps[1:]
    return row


def basis_row(kind: str, size: int, g: float, g_range: tuple[float, float], shape: Array) -> Array:
    """Return (size,) values of the basis functions at a magnification inside ``g_range``."""
    low, high = g_range
    if kind == "chebyshev_log":
        u = _unit_interval(np.log(g), np.log(low), np.log(high))
        return _chebyshev_row(float(u), size)
    if kind == "chebyshev":
        return _chebyshev_row(float(_unit_interval(g, low, high)), size)
    if kind == "legendre":
        u = _unit_interval(g, low, high)
        return np.asarray(legendre.legvander(u, size - 1), dtype=np.float64).reshape(size)
    if kind == "linear_log":
        return _hat_row(float(np.log(g)), np.log(shape))
    return _ode_row((g - low) / (high - low) if high > low else 0.0, shape)


@dataclass(frozen=True)
class ContinuousFunction:
    """One camera parameter as a function of the magnification g.

    Parameters
    ----------
    kind
        One of :data:`KINDS`: Chebyshev polynomial in log g or in g, Legendre polynomial in g,
        linear interpolation in log g between knots, or the solution of a linear ordinary
        differential equation with constant coefficients (principal differential analysis, appendix
        A of the paper).
    coefficients
        (k,) coefficients. For ``"ode"`` they are the value and its derivatives at the lower end of
        the range, with the range scaled to [0, 1].
    g_range
        (lowest, highest) magnification for which the function was determined.
    shape
        Knots (magnifications) of ``"linear_log"``, weights w_0 ... w_(k-1) of ``"ode"``, empty
        otherwise.
    breaks
        Magnifications at which a polynomial jumps, because the microscope switches its scan range
        there; each belongs to the range above it. The last coefficients are the sizes of the jumps.
    extension
        Magnifications beyond one end of ``g_range``, from that end on outwards, between which the second derivative by
        log g is linear: the tangent is bent there, and goes on straight after the last one. The coefficients before
        those of the jumps are the second derivatives at all but the last. Empty where nothing is known beyond.
    """

    kind: str
    coefficients: Array
    g_range: tuple[float, float]
    shape: Array = field(default_factory=lambda: np.empty(0))
    breaks: Array = field(default_factory=lambda: np.empty(0))
    extension: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InvalidValueError(f"function kind {self.kind!r}", expected=", ".join(KINDS))
        low, high = self.g_range
        if not (0.0 < low <= high and np.isfinite(high)):
            raise InvalidValueError(
                f"magnification range {self.g_range}", expected="0 < lowest <= highest"
            )
        if self.coefficients.ndim != 1 or not np.all(np.isfinite(self.coefficients)):
            raise InvalidValueError(
                f"coefficients {self.coefficients!r}", expected="a vector of finite numbers"
            )
        self._check_extension()
        self._check_breaks()
        shaped = self.kind in ("linear_log", "ode")
        if self.size < 1 or (shaped and len(self.shape) != self.smooth_size):
            raise InvalidValueError(
                f"{self.size} coefficients with a shape of {len(self.shape)}",
                expected="at least one coefficient, and a shape of equal length where the kind has one",
            )
        if self.kind == "linear_log" and not (
            np.all(self.shape > 0) and np.all(np.diff(self.shape) > 0)
        ):
            raise InvalidValueError("knots out of order", expected="increasing magnifications")

    def _check_extension(self) -> None:
        if len(self.extension) == 0:
            return
        low, high = self.g_range
        upwards, downwards = (
            bool(np.isclose(self.extension[0], end, rtol=1e-9)) for end in (high, low)
        )
        steps = np.diff(self.extension)
        fits = np.all(np.isfinite(self.extension)) and np.all(self.extension > 0.0)
        fits &= len(steps) > 0 and (
            (upwards and np.all(steps > 0)) or (downwards and np.all(steps < 0))
        )
        if not fits or self.smooth_size < 1:
            raise InvalidValueError(
                f"an extension over {self.extension.tolist()} with {self.size} coefficients",
                expected=f"magnifications from {low:g} downwards or from {high:g} upwards, and one coefficient less",
            )

    @property
    def full_range(self) -> tuple[float, float]:
        """(lowest, highest) magnification with the extension."""
        ends = [*self.g_range, *self.extension.tolist()]
        return min(ends), max(ends)

    def _check_breaks(self) -> None:
        low, high = self.full_range
        inside = np.all((self.breaks > low) & (self.breaks <= high))
        if not (inside and np.all(np.diff(self.breaks) > 0)):
            raise InvalidValueError(
                f"breakpoints {self.breaks.tolist()}",
                expected=f"increasing magnifications between {low:g} and {high:g}",
            )
        if len(self.breaks) and (self.kind in ("linear_log", "ode") or self.smooth_size < 1):
            raise InvalidValueError(
                f"breakpoints in a function of kind {self.kind} with {self.size} coefficients",
                expected="a polynomial with a coefficient of its own",
            )

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.coefficients)

    @property
    def smooth_size(self) -> int:
        """Number of coefficients without the jumps and the extension."""
        return len(self.coefficients) - len(self.breaks) - max(len(self.extension) - 1, 0)

    @property
    def basis_key(self) -> tuple[object, ...]:
        """What :meth:`basis` depends on besides the magnification: equal for functions that share it."""
        shape = () if len(self.shape) == 0 else tuple(self.shape.tolist())
        breaks = () if len(self.breaks) == 0 else tuple(self.breaks.tolist())
        beyond = () if len(self.extension) == 0 else tuple(self.extension.tolist())
        return self.kind, self.size, self.g_range, shape, breaks, beyond

    def basis(self, g: float) -> Array:
        """Return the (size,) row with ``value = basis(g) @ coefficients``; tangent out of range."""
        low, high = self.g_range
        edge = min(max(g, low), high)
        row = basis_row(self.kind, self.smooth_size, edge, self.g_range, self.shape)
        if edge != g and high > low:
            step = 1e-4 * np.log(high / low) * (1.0 if g < low else -1.0)
            inside = edge * float(np.exp(step))
            inner = basis_row(self.kind, self.smooth_size, inside, self.g_range, self.shape)
            row = row + (inner - row) / step * np.log(g / edge)
        if len(self.extension):
            # Downwards, everything is mirrored.
            sign = 1.0 if self.extension[-1] > self.extension[0] else -1.0
            extension = _extension_row(sign * float(np.log(g)), sign * np.log(self.extension))
            row = np.concatenate([row, extension])
        if len(self.breaks) == 0:
            return row
        return np.concatenate([row, (g >= self.breaks).astype(np.float64)])

    def __call__(self, g: float) -> float:
        """Return the value at the magnification ``g``."""
        return float(self.basis(g) @ self.coefficients)
