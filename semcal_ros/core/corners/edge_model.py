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

"""Grey values around a chess corner: two blurred, curved edges that cross; and the pixels that determine it.

    I(x) = b0 + b . x + (a0 + a . x) S(d1) S(d2) + g1 B(d1) + g2 B(d2)
    S(d) = sum_k (-1)^k erf((d - k h) / (sqrt(2) w)),  k = -1, 0, 1
    B(d) = sum_k n(d - k h)

with ``d1`` and ``d2`` the distances from the edges along i and j, ``h`` the distance to the next
parallel edge, ``w`` the blur and ``n`` the derivative of the blurred step. The edges bend as the
local lattice map does, except for a small correction that large squares can determine; a plane and
a gradient of the contrast describe shading. ``g / a0`` is the distance by which the edges lie
outside the bright squares, because of a slope of the specimen or the bright rim that an electron
microscope shows at every step. It moves the two halves of an edge to opposite sides and matters
where only one half is in view.

The pixels lie within half a square of the corner and near its two edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Array32, Mask
from semcal_ros.core.corners.thresholds import (
    ERF_C,
    ERF_P,
    NEIGHBOUR_BLURS,
    WINDOW_BLOCK_PIXELS,
    WINDOW_HALF_WIDTH,
)

# The parameters of a corner in their order: position, directions of the two edges, logarithm of the blur, extra
# sagittas over half a square; then those that act linearly, as above.
_NONLINEAR = ("x", "y", "angle_1", "angle_2", "log_blur", "sagitta_1", "sagitta_2")
_LINEAR = ("b0", "bx", "by", "a0", "ax", "ay", "g1", "g2")
_NAMES = _NONLINEAR + _LINEAR


@dataclass(frozen=True)
class PixelWindows:
    """Pixels of n windows, padded to the same number p.

    Attributes
    ----------
    x, y
        (n, p) pixel positions relative to ``origin``.
    value
        (n, p) grey values.
    valid
        (n, p) 1 for pixels in the window and in the image, 0 for padding.
    origin
        (n, 2) positions on which the windows are centred.
    coverage
        (n,) part of the window that lies in the image.
    """

    x: Array32
    y: Array32
    value: Array32
    valid: Array32
    origin: Array
    coverage: Array

    def select(self, keep: Mask | slice) -> PixelWindows:
        """Return the windows where ``keep`` is true, or a slice of them without a copy."""
        return PixelWindows(*(getattr(self, f.name)[keep] for f in fields(self)))

    @staticmethod
    def join(parts: Sequence[PixelWindows]) -> PixelWindows:
        """Concatenate the windows of several sets, padded to the same number of pixels."""
        pixels = max(part.x.shape[1] for part in parts)

        def padded(name: str) -> Array32:
            out = np.zeros((sum(len(part.x) for part in parts), pixels), dtype=np.float32)
            first = 0
            for part in parts:
                values = getattr(part, name)
                out[first : first + len(values), : values.shape[1]] = values
                first += len(values)
            return out

        return PixelWindows(
            padded("x"),
            padded("y"),
            padded("value"),
            padded("valid"),
            np.concatenate([part.origin for part in parts]),
            np.concatenate([part.coverage for part in parts]),
        )


def gather_windows(
    image: Array32, origin: Array, axes: Array, bend: Array, band_px: float
) -> PixelWindows:
    """Gather the pixels within half a square of each origin and ``band_px`` of one of its edges.

    Parameters
    ----------
    image
        (h, w) float32.
    origin
        (n, 2) expected corner positions, px.
    axes, bend
        (n, 2, 2) first and second derivatives of the local lattice map.
    band_px
        Half-width of the bands along the edges. Pixels farther from both edges carry no
        information on the position of the corner.
    """
    reach = int(np.ceil(WINDOW_HALF_WIDTH * np.abs(axes).sum(axis=1).max(initial=0.0))) + 1
    block = max(1, int(WINDOW_BLOCK_PIXELS / (2 * reach + 1) ** 2))
    parts = []
    for first in range(0, max(1, len(origin)), block):
        rows = slice(first, first + block)
        parts.append(_gather_block(image, origin[rows], axes[rows], bend[rows], band_px, reach))
    return PixelWindows.join(parts)


def _gather_block(
    image: Array32, origin: Array, axes: Array, bend: Array, band_px: float, reach: int
) -> PixelWindows:
    height, width = image.shape
    start = np.floor(origin + 0.5).astype(np.int64)
    shift = (start - origin).astype(np.float32)
    inverse = np.linalg.inv(axes.transpose(0, 2, 1)).astype(np.float32)
    span = np.arange(-reach, reach + 1)
    along = span.astype(np.float32)
    x, y = along[None, None, :] + shift[:, :1, None], along[None, :, None] + shift[:, 1:, None]
    u = np.abs(inverse[:, 0, 0, None, None] * x + inverse[:, 0, 1, None, None] * y)
    v = np.abs(inverse[:, 1, 0, None, None] * x + inverse[:, 1, 1, None, None] * y)
    inside = np.maximum(u, v) <= np.float32(WINDOW_HALF_WIDTH)
    area = np.maximum(np.count_nonzero(inside, axis=(1, 2)), 1)
    columns, rows = start[:, :1] + span, start[:, 1:] + span
    inside &= ((columns >= 0) & (columns < width))[:, None, :]
    inside &= ((rows >= 0) & (rows < height))[:, :, None]
    coverage = np.count_nonzero(inside, axis=(1, 2)) / area
    cell = np.abs(np.linalg.det(axes))
    # u = 0 is the edge along j; a step of 1 in u moves cell / |axis j| px away from it.
    band = band_px + 0.13 * np.linalg.norm(bend, axis=2).max(axis=1)
    limit_u = (band * np.linalg.norm(axes[:, 1], axis=1) / cell).astype(np.float32)
    limit_v = (band * np.linalg.norm(axes[:, 0], axis=1) / cell).astype(np.float32)
    inside &= (u <= limit_u[:, None, None]) | (v <= limit_v[:, None, None])
    return _pack(image, inside, start, shift, origin, coverage)


def _pack(
    image: Array32,
    inside: Mask,
    start: NDArray[np.int64],
    shift: Array32,
    origin: Array,
    coverage: Array,
) -> PixelWindows:
    """Return the pixels marked in boxes (n, s, s) around ``start``, side by side."""
    side = inside.shape[1]
    count = np.count_nonzero(inside, axis=(1, 2))
    pixels = max(1, int(count.max(initial=1)))
    corner, place = np.divmod(np.flatnonzero(inside), side * side)
    row, column = np.divmod(place, side)
    row -= side // 2
    column -= side // 2
    first = np.cumsum(count) - count
    slot = np.arange(len(corner)) + (corner * pixels - first[corner])

    def spread(values: Array32) -> Array32:
        out = np.zeros(len(origin) * pixels, dtype=np.float32)
        out[slot] = values
        return out.reshape(-1, pixels)

    flat = (start[corner, 1] + row) * image.shape[1] + start[corner, 0] + column
    return PixelWindows(
        spread(column.astype(np.float32) + shift[corner, 0]),
        spread(row.astype(np.float32) + shift[corner, 1]),
        spread(image.ravel()[flat]),
        spread(np.ones(len(corner), dtype=np.float32)),
        origin,
        coverage,
    )


def _span(first: str, last: str) -> slice:
    return slice(_NAMES.index(first), _NAMES.index(last) + 1)


NONLINEAR, LINEAR = len(_NONLINEAR), len(_LINEAR)

ANGLES, SAGITTAS = _span("angle_1", "angle_2"), _span("sagitta_1", "sagitta_2")

LOG_BLUR, BRIGHTNESS, CONTRAST = (_NAMES.index(name) for name in ("log_blur", "b0", "a0"))

# Of the brightness and of the contrast.
GRADIENTS = (_span("bx", "by"), _span("ax", "ay"))

# Of the bright squares at the two edges.
GROWTH = _span("g1", "g2")


@dataclass(frozen=True)
class EdgeGeometry:
    """Geometry of each corner from the lattice, which the fit does not change.

    Attributes
    ----------
    spacing_1, spacing_2
        (n,) distance to the next edge parallel to the edge along i and to that along j, px.
    curvature_1, curvature_2
        (n,) signed curvature of the edges, 1/px.
    length
        (n,) typical arm length, px, which scales the derivatives to similar magnitudes.
    """

    spacing_1: Array
    spacing_2: Array
    curvature_1: Array
    curvature_2: Array
    length: Array

    def select(self, rows: slice) -> EdgeGeometry:
        """Return a slice of the corners."""
        return EdgeGeometry(*(getattr(self, f.name)[rows] for f in fields(self)))

    @classmethod
    def from_map(cls, axes: Array, bend: Array) -> EdgeGeometry:
        """Make it from first and second derivatives of the local lattice map, both (n, 2, 2)."""
        norm = np.linalg.norm(axes, axis=2)
        cell = np.linalg.det(axes)
        tangent = axes / norm[:, :, None]
        normal_1 = np.stack([-tangent[:, 0, 1], tangent[:, 0, 0]], axis=1)
        normal_2 = np.stack([tangent[:, 1, 1], -tangent[:, 1, 0]], axis=1)
        return cls(
            cell / norm[:, 0],
            cell / norm[:, 1],
            np.einsum("nc,nc->n", normal_1, bend[:, 0]) / norm[:, 0] ** 2,
            np.einsum("nc,nc->n", normal_2, bend[:, 1]) / norm[:, 1] ** 2,
            0.25 * norm.sum(axis=1),
        )


# It shares the exponential with the derivative.
_P, _C = np.float32(ERF_P), tuple(np.float32(c) for c in ERF_C)


def _erf_and_bell(z: Array32) -> tuple[Array32, Array32]:
    """Return erf(z / sqrt 2) and exp(-z^2 / 2)."""
    bell = np.exp(np.float32(-0.5) * z * z)
    t = np.float32(1.0) / (np.float32(1.0) + (_P * np.float32(np.sqrt(0.5))) * np.abs(z))
    tail = t * _C[4]
    for coefficient in _C[3::-1]:
        tail += coefficient
        tail *= t
    tail *= bell
    return np.copysign(np.float32(1.0) - tail, z), bell


def _profile(
    distance: Array32, spacing: Array32, blur: Array32
) -> tuple[Array32, Array32, Array32, Array32]:
    """Return S, dS/dd, dS/dlog(w) and B."""
    scale = np.float32(np.sqrt(2.0 / np.pi)) / blur
    value, slope = _erf_and_bell(distance / blur)
    slope *= scale
    by_blur = -distance * slope
    if float((spacing / blur).min()) >= NEIGHBOUR_BLURS:
        return value, slope, by_blur, slope
    bump = slope.copy()
    for side in (spacing, -spacing):
        other = distance - side
        step, bell = _erf_and_bell(other / blur)
        bell *= scale
        value -= step
        slope -= bell
        bump += bell
        other *= bell
        by_blur += other
    return value, slope, by_blur, bump


def evaluate(
    windows: PixelWindows, geometry: EdgeGeometry, nonlinear: Array, linear: Array | None
) -> tuple[Array32, Array32]:
    """Evaluate the model at the pixels, with its derivatives.

    Returns
    -------
    jacobian
        (n, 15, p) derivatives; with ``linear`` None only the (n, 8, p) linear ones.
    model
        (n, p) grey values; zeros where ``linear`` is None.
    """

    def column(values: Array) -> Array32:
        return np.asarray(values, dtype=np.float32)[:, None]

    px, py, angle_1, angle_2, log_blur, sag_1, sag_2 = nonlinear.T
    blur = column(np.exp(log_blur))
    x, y = windows.x - column(px), windows.y - column(py)
    cos_1, sin_1 = column(np.cos(angle_1)), column(np.sin(angle_1))
    cos_2, sin_2 = column(np.cos(angle_2)), column(np.sin(angle_2))
    per_sag = 2.0 / geometry.length**2
    bend_1 = column(geometry.curvature_1 + sag_1 * per_sag)
    bend_2 = column(geometry.curvature_2 + sag_2 * per_sag)
    along_1, off_1 = cos_1 * x + sin_1 * y, cos_1 * y - sin_1 * x
    along_2, off_2 = cos_2 * x + sin_2 * y, sin_2 * x - cos_2 * y
    half = np.float32(0.5)
    edge_1, slope_1, blur_1, bump_1 = _profile(
        off_1 - half * bend_1 * along_1 * along_1, column(geometry.spacing_1), blur
    )
    edge_2, slope_2, blur_2, bump_2 = _profile(
        off_2 - half * bend_2 * along_2 * along_2, column(geometry.spacing_2), blur
    )
    length = column(geometry.length)
    u, v = windows.x / length, windows.y / length
    n, pixels = windows.x.shape
    free = NONLINEAR if linear is not None else 0
    jacobian = np.empty((n, free + LINEAR, pixels), dtype=np.float32)
    j = jacobian.transpose(1, 0, 2)
    j[free], j[free + 1], j[free + 2] = 1.0, u, v
    product = np.multiply(edge_1, edge_2, out=j[free + 3])
    np.multiply(u, product, out=j[free + 4])
    np.multiply(v, product, out=j[free + 5])
    j[free + 6], j[free + 7] = bump_1, bump_2
    if linear is None:
        return jacobian, np.zeros_like(windows.x)
    model = (linear.astype(np.float32)[:, None, :] @ jacobian[:, free:])[:, 0]
    a0, ax, ay = (column(c) for c in linear.T[3:6])
    contrast = ax * u
    contrast += ay * v
    contrast += a0
    by_1, by_2 = slope_1 * edge_2, slope_2 * edge_1
    by_1 *= contrast
    by_2 *= contrast
    np.multiply(by_1, along_1, out=j[2])
    np.multiply(by_2, along_2, out=j[3])
    np.add(by_1 * sin_1, bend_1 * cos_1 * j[2], out=j[0])
    j[0] += bend_2 * cos_2 * j[3]
    j[0] -= by_2 * sin_2
    np.subtract(by_2 * cos_2, by_1 * cos_1, out=j[1])
    j[1] += bend_1 * sin_1 * j[2]
    j[1] += bend_2 * sin_2 * j[3]
    arm = np.float32(-1.0) / (length * length)
    np.multiply(j[2], along_1 * arm, out=j[5])
    np.multiply(j[3], along_2 * arm, out=j[6])
    j[2] *= np.float32(-1.0) - bend_1 * off_1
    j[3] *= np.float32(1.0) + bend_2 * off_2
    blur_1 *= edge_2
    blur_2 *= edge_1
    blur_1 += blur_2
    np.multiply(contrast, blur_1, out=j[4])
    return jacobian, model
