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

"""Residual field: the distortion that the terms of lens and scan cannot describe.

What they leave is a smooth displacement of the image. It is held by a
tensor-product B-spline over the raw pixel and log g (``doc/model.md``, "Residual field"): a raw pixel x would lie at

    x + n G((x - c) / n, g)

if there were only the parametric distortion, with ``c`` the middle of the image and ``n`` half its
width. Being defined on the raw pixel, the field corrects observations by a fixed linear map of its
coefficients.

The knots are denser at the start of the lines, where the beam settles. The field excludes what the
rest of the model describes: shifts, linear maps, and the patterns of all terms of lens and scan.
Otherwise two descriptions of the same displacement would leave the pixel size undefined.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from semcal_ros.core.arrays import Array, Array32, Indices
from semcal_ros.core.camera.distortion import LENS_NAMES, PRODUCTS, distort_jacobians
from semcal_ros.core.camera.scan_distortion import scan_functions
from semcal_ros.core.camera.thresholds import (
    FIELD_BREAKS_X,
    FIELD_BREAKS_Y,
    FIELD_DEGREE,
    FIELD_STEPS_MAX,
    FIELD_TOLERANCE,
)
from semcal_ros.core.errors import InvalidValueError

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


def _clamped(breaks: Array, degree: int) -> Array:
    return np.concatenate([np.repeat(breaks[0], degree), breaks, np.repeat(breaks[-1], degree)])


@lru_cache(maxsize=16)
def _basis_functions(knots: bytes, degree: int) -> BSpline:
    """Return all basis functions on knots at once; faster than a sparse matrix where these are few."""
    # Imported here so that programs without a residual field start without scipy.
    from scipy.interpolate import BSpline

    at = np.frombuffer(knots)
    return BSpline(at, np.eye(len(at) - degree - 1), degree)


def _spline_rows(values: Array, knots: Array, degree: int) -> Array:
    """Return (n, size) values of the basis functions, constant beyond the outermost knots."""
    inside = np.clip(values, knots[0], knots[-1])
    return np.asarray(_basis_functions(knots.tobytes(), degree)(inside), dtype=np.float64)


@lru_cache(maxsize=8)
def _lattice_rows(values: bytes, knots: bytes, *, straight: bool = False) -> Array32:
    """Return :func:`_spline_rows` of the axis of a lattice, which is the same for frame after frame.

    Beyond the outermost knots the spline is constant, or straight.
    """
    at, ends = np.frombuffer(values), np.frombuffer(knots)[[0, -1]]
    rows = _spline_rows(at, np.frombuffer(knots), FIELD_DEGREE)
    if straight:
        inside = np.clip(at, *ends)
        rows += (at - inside)[:, None] * _basis_functions(knots, FIELD_DEGREE)(inside, nu=1)
    return rows.astype(np.float32)


def _spline_slopes(values: Array, knots: Array) -> Array:
    """Return (n, size) derivatives of the basis functions, zero beyond the outermost knots."""
    inside = (values > knots[0]) & (values < knots[-1])
    at = np.clip(values, knots[0], knots[-1])
    slopes = _basis_functions(knots.tobytes(), FIELD_DEGREE)(at, nu=1)
    return np.where(inside[:, None], slopes, 0.0)


@dataclass(frozen=True)
class FieldSlice:
    """The residual field at one magnification.

    Attributes
    ----------
    knots_x, knots_y
        Knots of the cubic splines in half image widths from the middle of the image, ends repeated.
    coefficients
        (ny, nx, 2), in half image widths.
    cross_covariance
        (P, 2 ny nx) of the parameters of the camera with the coefficients, or None where it is not known.
    weights, whole_covariance
        (ng,) weights of the coefficients of the whole field in these, and their covariance
        (2 ng ny nx, 2 ng ny nx), or None.
    largest_slope
        A bound of the slopes of either component along x and y together.
    """

    knots_x: Array
    knots_y: Array
    coefficients: Array
    cross_covariance: Array | None = None
    weights: Array | None = None
    whole_covariance: Array | None = None
    largest_slope: float = float("inf")

    @cached_property
    def covariance(self) -> Array | None:
        """(2 ny nx, 2 ny nx) of the coefficients, or None where it is not known.

        Computed when it is first asked for: a stream that zooms has a slice for every frame.
        """
        if self.weights is None or self.whole_covariance is None:
            return None
        count, size = len(self.weights), self.coefficients.size
        blocks = self.whole_covariance.reshape(count, size, count, size)
        return np.einsum("k,kalb,l->ab", self.weights, blocks, self.weights, optimize=True)

    def basis(self, q: Array) -> Array:
        """Return (n, ny nx) products of the basis functions at normalised raw positions (n, 2)."""
        x = _spline_rows(q[:, 0], self.knots_x, FIELD_DEGREE)
        y = _spline_rows(q[:, 1], self.knots_y, FIELD_DEGREE)
        return (y[:, :, None] * x[:, None, :]).reshape(len(q), -1)

    def basis_down(self, y: Array) -> Array:
        """Return (n, ny) basis functions down the image at normalised raw coordinates (n,)."""
        return _spline_rows(y, self.knots_y, FIELD_DEGREE)

    def displacement(self, q: Array) -> Array:
        """Return (n, 2) displacements at normalised raw positions (n, 2); NaN at NaN positions."""
        known = np.isfinite(q).all(axis=1)
        if not known.all():
            out = np.full_like(q, np.nan)
            out[known] = self.displacement(q[known])
            return out
        ny, nx, _ = self.coefficients.shape
        x = _spline_rows(q[:, 0], self.knots_x, FIELD_DEGREE)
        y = _spline_rows(q[:, 1], self.knots_y, FIELD_DEGREE)
        along = (y @ self.coefficients.reshape(ny, -1)).reshape(-1, nx, 2)
        return np.einsum("na,nac->nc", x, along)

    def on_lattice(self, x: Array, y: Array, picked: Indices | None = None) -> Array32:
        """Return (len(y), len(x), 2) displacements at all pairs of normalised raw coordinates, or (len(picked),
        len(x), 2) at some of the rows.

        Above and below the outermost knots the field goes on in a straight line: no pixel comes from
        there, and a sudden change of its slope is nothing that can be interpolated.
        """
        columns = _lattice_rows(x.tobytes(), self.knots_x.tobytes())
        rows = _lattice_rows(y.tobytes(), self.knots_y.tobytes(), straight=True)
        if picked is not None:
            rows = rows[picked]
        along = columns @ self.coefficients.astype(np.float32)
        out: Array32 = (rows @ along.reshape(len(along), -1)).reshape(len(rows), len(columns), 2)
        return out

    def gradient(self, q: Array) -> Array:
        """Return (n, 2, 2) derivatives of the displacement by position; finite positions only."""
        ny, nx, _ = self.coefficients.shape
        (x, dx), (y, dy) = (
            (_spline_rows(v, knots, FIELD_DEGREE), _spline_slopes(v, knots))
            for v, knots in ((q[:, 0], self.knots_x), (q[:, 1], self.knots_y))
        )
        flat = self.coefficients.reshape(ny, -1)
        along, across = (y @ flat).reshape(-1, nx, 2), (dy @ flat).reshape(-1, nx, 2)
        by_x, by_y = np.einsum("na,nac->nc", dx, along), np.einsum("na,nac->nc", x, across)
        return np.stack([by_x, by_y], axis=2)

    def inverse(self, target: Array) -> Array:
        """Return raw positions (n, 2) that the field moves to ``target`` (n, 2); NaN without one.

        Newton's method starts from the displacement at the target.
        """
        q = target - self.displacement(target)
        active = np.flatnonzero(np.all(np.isfinite(q), axis=1))
        for _ in range(FIELD_STEPS_MAX):
            if not active.size:
                return q
            here = q[active]
            residual = here + self.displacement(here) - target[active]
            step = np.linalg.solve(np.eye(2) + self.gradient(here), residual[:, :, None])[:, :, 0]
            q[active] = here - step
            active = active[np.max(np.abs(step), axis=1) > FIELD_TOLERANCE]
        q[active] = np.nan
        return q


@dataclass(frozen=True)
class ResidualField:
    """Residual field as a function of the magnification.

    Attributes
    ----------
    knots_x, knots_y
        As in :class:`FieldSlice`.
    g_range
        (lowest, highest) magnification of the views; beyond, the field of the nearer end holds.
    coefficients
        (ng, ny, nx, 2): a spline without inner knots in log g, that is a polynomial of degree
        ng - 1 in Bernstein form.
    """

    knots_x: Array
    knots_y: Array
    g_range: tuple[float, float]
    coefficients: Array

    def __post_init__(self) -> None:
        low, high = self.g_range
        if not (0.0 < low <= high and np.isfinite(high)):
            raise InvalidValueError(
                f"magnification range {self.g_range} of a residual field",
                expected="0 < lowest <= highest",
            )
        for knots in (self.knots_x, self.knots_y):
            rising = knots.ndim == 1 and np.all(np.isfinite(knots)) and np.all(np.diff(knots) >= 0)
            if not (rising and len(knots) >= 2 * (FIELD_DEGREE + 1) and knots[0] < knots[-1]):
                raise InvalidValueError(
                    f"knots {knots.tolist()} of a residual field", expected="a rising sequence"
                )
        nx, ny = len(self.knots_x) - FIELD_DEGREE - 1, len(self.knots_y) - FIELD_DEGREE - 1
        shape = self.coefficients.shape
        if len(shape) != 4 or shape[0] < 1 or shape[1:] != (ny, nx, 2):
            raise InvalidValueError(
                f"coefficients of shape {shape} of a residual field", expected=f"(k, {ny}, {nx}, 2)"
            )
        if not np.all(np.isfinite(self.coefficients)):
            raise InvalidValueError("a residual field with gaps", expected="finite coefficients")

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return int(self.coefficients.size)

    @property
    def slice_size(self) -> int:
        """Number of coefficients at one magnification."""
        return self.size // len(self.coefficients)

    def weights(self, g: float) -> Array:
        """Return (ng,) weights of the coefficients at a magnification, none negative, of sum 1."""
        count = len(self.coefficients)
        low, high = np.log(self.g_range)
        if count == 1 or low == high:
            return np.eye(count)[0]
        at = (np.log(g) - low) / (high - low)
        rows = _spline_rows(np.array([at]), _clamped(np.array([0.0, 1.0]), count - 1), count - 1)
        return rows[0]

    def at(
        self, g: float, covariance: Array | None = None, cross: Array | None = None
    ) -> FieldSlice:
        """Return the field at a magnification.

        ``covariance`` (size, size) of all coefficients and ``cross`` (P, size) with the camera at
        ``g`` are optional.
        """
        weights = self.weights(g)
        between = None
        if covariance is not None and cross is not None:
            between = np.einsum(
                "pka,k->pa", cross.reshape(-1, len(weights), self.slice_size), weights
            )
        return FieldSlice(
            self.knots_x,
            self.knots_y,
            np.tensordot(weights, self.coefficients, axes=1),
            between,
            weights,
            None if between is None else covariance,
            self._largest_slope,
        )

    @cached_property
    def _largest_slope(self) -> float:
        """That of all slices: they lie between the coefficients.

        The slope of a spline is one of lower degree, and lies between coefficients of its own.
        """
        total = np.zeros(2)
        for axis, knots in ((1, self.knots_y), (2, self.knots_x)):
            apart = (
                np.maximum(knots[FIELD_DEGREE + 1 : -1] - knots[1 : -FIELD_DEGREE - 1], 1e-9)
                / FIELD_DEGREE
            )
            slopes = np.diff(self.coefficients, axis=axis).swapaxes(axis, 2)
            total += np.max(np.abs(slopes / apart[:, None]), axis=(0, 1, 2))
        return float(np.max(total))

    def overlaps(self) -> Array:
        """Return (k, slice_size) inner products with the k patterns of the rest of the model.

        These are the shifts, the linear maps, the patterns of the distortion of the lens about the middle of the
        picture, but for the products of both coordinates, and those of the distortion of the scan, each with a mean
        square of 1 over the domain. A field whose coefficients they annul leaves all of that to the camera and to the
        poses. A camera with a field has no products.
        """
        q, weight = _quadrature(self.knots_x, self.knots_y)
        x, y = q.T
        zero, one = np.zeros_like(x), np.ones_like(x)
        patterns = [(one, zero), (zero, one), (x, zero), (y, zero), (zero, x), (zero, y)]
        # A term of the lens that is small is its derivative.
        of_lens = np.moveaxis(distort_jacobians(q, 0.0, 0.0)[2], (2, 1), (0, 1))
        names = zip(LENS_NAMES, of_lens, strict=True)
        patterns += [pattern for name, pattern in names if name not in PRODUCTS]
        patterns += [(along, zero) for along in scan_functions(x, 0)]
        patterns += [(zero, across) for across in scan_functions(y / np.max(np.abs(y)), 1)]
        basis = self.at(self.g_range[0]).basis(q) * weight[:, None]
        rows = []
        for pattern in patterns:
            vectors = np.stack(pattern, axis=1)
            size = np.sqrt(weight @ np.sum(vectors**2, axis=1))
            rows.append((basis.T @ vectors / size).ravel())
        return np.stack(rows)


def _quadrature(knots_x: Array, knots_y: Array) -> tuple[Array, Array]:
    """Return Gauss nodes (n, 2) over the cells of the knots and weights (n,) of sum 1.

    Six nodes are exact for a cubic spline times a pattern of third degree.
    """
    nodes, weights = np.polynomial.legendre.leggauss(6)
    axes = []
    for knots in (knots_x, knots_y):
        breaks = np.unique(knots)
        half = 0.5 * np.diff(breaks)[:, None]
        at = breaks[:-1, None] + half * (nodes + 1.0)
        axes.append((at.ravel(), (half * weights).ravel() / (knots[-1] - knots[0])))
    (x, along), (y, down) = axes
    points = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=1)
    return points, np.asarray(np.outer(down, along).ravel(), dtype=np.float64)


def zero_field(
    image_size: tuple[int, int], g_range: tuple[float, float], count: int
) -> ResidualField:
    """Make a field without displacement, with ``count`` coefficients in log g."""
    aspect = image_size[1] / image_size[0]
    knots_x = _clamped(np.array(FIELD_BREAKS_X), FIELD_DEGREE)
    knots_y = _clamped(aspect * np.array(FIELD_BREAKS_Y), FIELD_DEGREE)
    shape = (count, len(knots_y) - FIELD_DEGREE - 1, len(knots_x) - FIELD_DEGREE - 1, 2)
    return ResidualField(knots_x, knots_y, g_range, np.zeros(shape))
