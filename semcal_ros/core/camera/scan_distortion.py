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

"""Distortion along the axes of the raster: what coils, amplifiers and the flyback do to the position of the beam.

Each axis has a smooth function of its own. Where the beam should be at ``p``, in px, it is at the raw pixel x with

    p = x + n s(u),    u = (x - c) / n

with the middle ``c`` of the picture along this axis, and half its width ``n``. Along the lines

    s(u) = sum_k a_k P_k(u) + sum_k b_k E_k(u)

has Legendre polynomials P2 to P7, for coils and amplifiers that are not linear, and decays
E_k = exp(-(1 + u) / T_k) with the time since the line began, for the settling of the beam after the flyback. A few time
constants a factor of two apart stand for any decay. Across the lines there are the polynomials alone, of (y - c) over
half the height.

What shift, scale and rotation describe is no part of any of these functions: a straight line is taken out of each
decay, and the polynomials have none. So the pixel size stays that of the whole picture, as with the residual field.

Scanning microscopes: Sutton et al. (2007), doi:10.1007/s11340-007-9042-z, find distortion of this kind, constant in
time, and remove it; they do not model its cause.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.thresholds import (
    LEGENDRE_POWERS,
    SCAN_END,
    SCAN_LAST_STEP,
    SCAN_SLOPE_MAX,
    SCAN_STEPS_MAX,
    SETTLING_TIMES,
)

SCAN_NAMES: tuple[str, ...] = (
    "coil_x2",
    "coil_x3",
    "coil_x4",
    "coil_x5",
    "coil_x6",
    "coil_x7",
    "settling_1",
    "settling_2",
    "settling_3",
    "settling_4",
    "settling_5",
    "coil_y2",
    "coil_y3",
    "coil_y4",
    "coil_y5",
    "coil_y6",
    "coil_y7",
)
"""Amplitudes in half image widths: of the functions along the lines, then of those across them."""
SETTLING = slice(SCAN_NAMES.index("settling_1"), SCAN_NAMES.index("coil_y2"))
"""Which of these are the settling."""
ALONG_COUNT: int = SETTLING.stop
"""How many of them are along the lines."""


@dataclass(frozen=True)
class Raster:
    """Where a raster lies in its picture.

    Attributes
    ----------
    middle_px
        Middle (x, y) of the picture, px.
    norm_px
        Half the width of the picture, px.
    ratio
        Height over width of the picture that was calibrated; another one may be a part of it.
    """

    middle_px: tuple[float, float]
    norm_px: float
    ratio: float

    @classmethod
    def of(cls, width: int, height: int) -> Raster:
        """Return the raster of a whole picture."""
        return cls((0.5 * (width - 1.0), 0.5 * (height - 1.0)), 0.5 * width, height / width)


@dataclass(frozen=True)
class ScanDerivatives:
    """Derivatives of the deflection.

    Attributes
    ----------
    stretch
        (2, n) derivative of the deflection by the raw pixel along each axis.
    basis
        (k, n) derivative of the deflection by the k amplitudes in the order of :data:`SCAN_NAMES`, px.
    """

    stretch: Array
    basis: Array


def _line_of_decay(time: float) -> tuple[float, float]:
    """Return the constant and the slope of the straight line that is nearest to a decay over the picture."""
    end = np.exp(-2.0 / time)
    mean = 0.5 * time * (1.0 - end)
    # The mean of u times the decay, three times over, since that of u squared is a third.
    first = 0.5 * time * (time * (1.0 - end) - (1.0 + end))
    return mean, 3.0 * first


_LINES = np.array([_line_of_decay(time) for time in SETTLING_TIMES])
_RATES = -1.0 / np.array(SETTLING_TIMES)
_DEGREE = LEGENDRE_POWERS.shape[1] - 1


def _whole_decays(u: Array) -> Array:
    """Return the decays with their straight lines, (k, n)."""
    return np.asarray(np.exp(_RATES[:, None] * (1.0 + u)))


def _decays(u: Array) -> tuple[Array, Array]:
    """Return the decays without their straight lines, (k, n), and their slopes."""
    values = _whole_decays(u)
    slopes = _RATES[:, None] * values
    return (
        values - _LINES[:, :1] - _LINES[:, 1:] * u,
        slopes - _LINES[:, 1:],
    )


def _functions(u: Array, axis: int) -> tuple[Array, Array]:
    """Return the functions of an axis, (k, n), and their slopes; straight lines beyond the picture."""
    inside = np.clip(u, -SCAN_END, SCAN_END)
    powers = np.stack([np.ones_like(inside), *np.cumprod(np.stack([inside] * _DEGREE), axis=0)])
    values, slopes = (
        LEGENDRE_POWERS @ powers,
        (LEGENDRE_POWERS[:, 1:] * np.arange(1.0, _DEGREE + 1.0)) @ powers[:-1],
    )
    if axis == 0:
        decays, decay_slopes = _decays(inside)
        values, slopes = np.concatenate([values, decays]), np.concatenate([slopes, decay_slopes])
    return values + slopes * (u - inside), slopes


def scan_functions(u: Array, axis: int) -> Array:
    """Return the functions along the lines (``axis`` 0) or across them at ``u`` in half pictures, (k, n)."""
    return _functions(u, axis)[0]


def _scale(raster: Raster, axis: int) -> float:
    return raster.norm_px * (1.0 if axis == 0 else raster.ratio)


def _amplitudes(amplitudes: Array, axis: int) -> Array:
    """Return those of an axis, (k, 1) or (k, n)."""
    of_axis = amplitudes[..., :ALONG_COUNT] if axis == 0 else amplitudes[..., ALONG_COUNT:]
    return np.moveaxis(np.atleast_2d(of_axis), -1, 0)


def deflection_shift(xy: Array, amplitudes: Array, raster: Raster) -> Array:
    """Return deflection minus raw pixel, (n, 2) px, at raw pixels (n, 2); ``amplitudes`` are (k,) or (n, k)."""
    out = np.zeros_like(xy)
    for axis in (0, 1):
        of_axis = _amplitudes(amplitudes, axis)
        if np.any(of_axis):
            u = (xy[:, axis] - raster.middle_px[axis]) / _scale(raster, axis)
            out[:, axis] = raster.norm_px * _make_curve(of_axis).value(u)[0]
    return out


def deflection_stretch(xy: Array, amplitudes: Array, raster: Raster) -> Array:
    """Return the (n, 2) derivative of the deflection along each axis by the raw pixel, at raw pixels (n, 2)."""
    out = np.ones_like(xy)
    for axis in (0, 1):
        of_axis = _amplitudes(amplitudes, axis)
        if np.any(of_axis):
            scale = _scale(raster, axis)
            u = (xy[:, axis] - raster.middle_px[axis]) / scale
            out[:, axis] += raster.norm_px / scale * _make_curve(of_axis).value(u)[1]
    return out


def settling_decay(x: Array, amplitudes: Array, raster: Raster) -> Array:
    """Return the sum of the decays (n,), with nothing taken out, at raw columns ``x`` (n,), in half image widths."""
    u = np.clip((x - raster.middle_px[0]) / raster.norm_px, -SCAN_END, SCAN_END)
    return np.asarray(amplitudes[SETTLING] @ _whole_decays(u))


def raw_from_deflection(deflection: Array, amplitudes: Array, raster: Raster) -> Array:
    """Return the raw pixels (n, 2) at which the beam is deflected to ``deflection`` (n, 2), px.

    Newton's method along each axis on its own. A point without a raw pixel, where the beam would stand still or go
    back, is NaN. ``amplitudes`` are (k,) or (n, k), in the order of :data:`SCAN_NAMES`.
    """
    raw = deflection.copy()
    for axis in (0, 1):
        of_axis = _amplitudes(amplitudes, axis)
        if np.any(of_axis):
            raw[:, axis] = _invert(deflection[:, axis], of_axis, raster, axis)
    return raw


def _invert(target: Array, of_axis: Array, raster: Raster, axis: int) -> Array:
    scale = _scale(raster, axis)
    curve = _make_curve(of_axis)
    # In half pictures of this axis.
    goal, part = (target - raster.middle_px[axis]) / scale, raster.norm_px / scale
    u = goal - part * curve.value(goal)[0]
    for _ in range(SCAN_STEPS_MAX):
        value, slope = curve.value(u)
        stretch = 1.0 + part * slope
        change = (u + part * value - goal) / np.where(
            stretch > 1.0 - SCAN_SLOPE_MAX, stretch, np.nan
        )
        u = u - change
        late = np.abs(change) > SCAN_LAST_STEP
        if not np.any(late):
            return raster.middle_px[axis] + scale * u
    return np.where(late, np.nan, raster.middle_px[axis] + scale * u)


@dataclass(frozen=True)
class _Curve:
    """The sum of the functions of an axis, prepared for many values.

    Attributes
    ----------
    powers
        (p, ...) coefficients of the powers of u, the constant first.
    decays
        Amplitude and rate of each decay.
    """

    powers: Array
    decays: tuple[tuple[Array, float], ...]

    def value(self, u: Array) -> tuple[Array, Array]:
        """Return the value and the slope at ``u`` (n,); a straight line beyond the picture."""
        inside = np.clip(u, -SCAN_END, SCAN_END)
        value, slope = self.powers[-1] * np.ones_like(u), np.zeros_like(u)
        for power in self.powers[-2::-1]:
            slope *= inside
            slope += value
            value *= inside
            value += power
        for amplitude, rate in self.decays:
            decay = amplitude * np.exp(rate * (1.0 + inside))
            value += decay
            slope += rate * decay
        return value + slope * (u - inside), slope


def _make_curve(of_axis: Array) -> _Curve:
    """Return the sum of the functions of an axis with amplitudes (k, 1), or with some for each point, (k, n)."""
    return _kept_curve(of_axis.tobytes()) if of_axis.shape[1] == 1 else _sum_functions(of_axis)


@lru_cache(maxsize=64)
def _kept_curve(of_axis: bytes) -> _Curve:
    # A live camera asks for the same ones several times a frame.
    return _sum_functions(np.frombuffer(of_axis)[:, None])


def _sum_functions(of_axis: Array) -> _Curve:
    polynomials = len(LEGENDRE_POWERS)
    powers = np.tensordot(LEGENDRE_POWERS, of_axis[:polynomials], axes=(0, 0))
    # Most cameras have no high ones, which every frame would pay for.
    highest = int(np.max(np.flatnonzero(np.any(powers, axis=1)), initial=1))
    powers = powers[: highest + 1]
    decays = []
    for amplitude, line, rate in zip(of_axis[polynomials:], _LINES, _RATES, strict=False):
        if np.any(amplitude):
            powers[0] -= amplitude * line[0]
            powers[1] -= amplitude * line[1]
            decays.append((amplitude, float(rate)))
    return _Curve(powers, tuple(decays))


def linearise_scan(raw: Array, amplitudes: Array, raster: Raster) -> ScanDerivatives:
    """Return the derivatives of the deflection at raw pixels (n, 2)."""
    stretch, basis = np.ones((2, len(raw))), np.empty((len(SCAN_NAMES), len(raw)))
    for axis, rows in ((0, slice(0, ALONG_COUNT)), (1, slice(ALONG_COUNT, None))):
        scale = _scale(raster, axis)
        values, slopes = _functions((raw[:, axis] - raster.middle_px[axis]) / scale, axis)
        basis[rows] = raster.norm_px * values
        stretch[axis] += (
            raster.norm_px / scale * np.sum(_amplitudes(amplitudes, axis) * slopes, axis=0)
        )
    return ScanDerivatives(stretch, basis)
