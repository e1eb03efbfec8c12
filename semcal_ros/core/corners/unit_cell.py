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

"""The mean unit cell of a periodic pattern, and the position of each cell against it.

A grid repeats one motif: a dot, a hole, two crossing lines. What an electron image shows of it is
not known beforehand: rims shine, one side lies in shadow, square holes have round corners. The mean
of all cells in lattice coordinates is that appearance, with little noise and finer than the pixels
(unit-cell averaging, as in crystallography). A least-squares fit of the mean to each cell is a
matched filter, and gives its position and covariance. Lattice coordinates follow the local map to
second order, so that perspective does not move the centres of dots.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import cg

from semcal_ros.core.arrays import Array, Array32
from semcal_ros.core.corners.corner_fit import (
    NoiseModel,
    PositionFit,
    displaced_sides,
    normal_equations,
    split_statistics,
)
from semcal_ros.core.corners.edge_model import PixelWindows, gather_windows
from semcal_ros.core.corners.local_map import LocalMaps
from semcal_ros.core.corners.thresholds import (
    CELL_BLOCK_PIXELS,
    CELL_PARAMETERS,
    CELL_STEP_MAX,
    CENTRE_ORDERS,
    COARSE_BINS,
    KNOTS_MAX,
    KNOTS_MIN,
    LOOKUP_ROW_PIXELS,
    MEAN_STEPS,
    NOISE_POWERS,
    SAMPLES_PER_KNOT,
)


@dataclass(frozen=True)
class UnitCell:
    """Mean appearance of the cells of an image.

    Attributes
    ----------
    values
        (m, m) grey values over one period: rows along i, columns along j, in steps of 1 / m of a
        cell from the lattice point at [0, 0].
    """

    values: Array

    @property
    def coefficients(self) -> Array:
        """(m, m) complex Fourier coefficients, in the order of ``numpy.fft``."""
        return np.asarray(np.fft.fft2(self.values) / self.values.size)

    def shift(self, u: float, v: float) -> UnitCell:
        """Return the same pattern with its lattice points moved by (u, v) cells."""
        m = len(self.values)
        order = np.fft.fftfreq(m, 1.0 / m)
        phase = np.exp(2j * np.pi * (u * order[:, None] + v * order[None, :]))
        return UnitCell(np.real(np.fft.ifft2(np.fft.fft2(self.values) * phase)))

    def average_along(self) -> UnitCell:
        """Return the cell of parallel lines: the mean over j."""
        mean = self.values.mean(axis=1, keepdims=True)
        return UnitCell(np.broadcast_to(mean, self.values.shape).copy())

    def find_centre(self) -> tuple[float, float]:
        """Return the centre of symmetry near the lattice point, in cells; zero where it is free.

        Half a turn about it takes each Fourier coefficient to its conjugate, so that the phases are
        linear in its position; the strong low orders determine it.
        """
        coefficients, centre = self.coefficients, np.zeros(2)
        for highest in CENTRE_ORDERS:
            orders = np.arange(-highest, highest + 1)
            h, k = (g.ravel() for g in np.meshgrid(orders, orders, indexing="ij"))
            basis = -2.0 * np.pi * np.stack([h, k], axis=1)
            known = coefficients[h % len(coefficients), k % len(coefficients)]
            known = known * np.exp(-1j * basis @ centre)
            # A real factor of either sign is no phase.
            phase = np.angle(known * np.where(known.real < 0.0, -1.0, 1.0))
            weight = np.abs(known) ** 2
            normal = basis.T @ (basis * weight[:, None])
            centre = centre + np.linalg.pinv(normal, hermitian=True) @ (basis.T @ (weight * phase))
        return float(centre[0]), float(centre[1])


@dataclass(frozen=True)
class CellFit(PositionFit):
    """Fitted cells.

    Attributes
    ----------
    levels
        (n, 5) gain, offset, gradients along x and y (per px), and the coefficient of the Laplacian,
        which stands for a change of blur.
    shown
        (n,) part of the squared gradient of the mean cell that lies in the image.
    """

    levels: Array
    shown: Array

    @property
    def gain(self) -> Array:
        """(n,) contrast relative to the mean cell."""
        return self.levels[:, 0]


def gather_cells(image: Array32, maps: LocalMaps) -> PixelWindows:
    """Gather all pixels of the cells with these local maps."""
    return gather_windows(image, maps.xy, maps.axes, maps.bend, np.inf)


def _lattice_coordinates(
    windows: PixelWindows, maps: LocalMaps, moved: Array
) -> tuple[Array, Array]:
    """Return (n, p) coordinates in the cells, if these are moved by (n, 2) px from their maps."""
    inverse = np.linalg.inv(maps.axes.transpose(0, 2, 1))
    x = windows.x.astype(np.float64) - moved[:, :1]
    y = windows.y.astype(np.float64) - moved[:, 1:]
    u = inverse[:, 0, :1] * x + inverse[:, 0, 1:] * y
    v = inverse[:, 1, :1] * x + inverse[:, 1, 1:] * y
    # Inside a cell the second order is small against the first, and two rounds suffice.
    bend = 0.5 * np.einsum("nab,ncb->nca", inverse, maps.bend)
    twist = np.einsum("nab,nb->na", inverse, maps.twist)
    first_u, first_v = u, v
    for _ in range(2):
        uu, vv, uv = u * u, v * v, u * v
        u = first_u - bend[:, 0, :1] * uu - bend[:, 1, :1] * vv - twist[:, :1] * uv
        v = first_v - bend[:, 0, 1:] * uu - bend[:, 1, 1:] * vv - twist[:, 1:] * uv
    return u, v


def bin_cells(windows: PixelWindows, maps: LocalMaps) -> UnitCell | None:
    """Return a coarse mean cell; None if a part of it is not in view.

    Parameters
    ----------
    windows, maps
        Pixels and local maps of the cells.
    """
    u, v = _lattice_coordinates(windows, maps, np.zeros((len(maps.xy), 2)))
    inside = windows.valid > 0
    row = np.floor(u[inside] * COARSE_BINS + 0.5).astype(np.int64) % COARSE_BINS
    column = np.floor(v[inside] * COARSE_BINS + 0.5).astype(np.int64) % COARSE_BINS
    place, value = row * COARSE_BINS + column, windows.value[inside].astype(np.float64)
    count = np.bincount(place, minlength=COARSE_BINS**2).astype(np.float64)
    if count.min() == 0.0:
        return None
    mean = np.bincount(place, value, minlength=COARSE_BINS**2) / count
    return UnitCell(mean.reshape(COARSE_BINS, COARSE_BINS))


def average_cells(windows: PixelWindows, maps: LocalMaps, fit: CellFit | None) -> UnitCell:
    """Return the least-squares mean of cells: a periodic cubic spline through all their pixels.

    Parameters
    ----------
    windows, maps
        Pixels and local maps of the cells.
    fit
        Positions and levels of the same cells; None for those of the maps, and mean levels.
    """
    count = len(maps.xy)
    if fit is None:
        total = np.maximum(windows.valid.sum(axis=1), 1.0)
        moved, gain = np.zeros((count, 2)), np.ones(count)
        base = ((windows.value * windows.valid).sum(axis=1) / total)[:, None]
    else:
        moved, gain = fit.xy - maps.xy, fit.gain
        _, offset, slope_x, slope_y, _ = fit.levels.T[:, :, None]
        base = offset + slope_x * windows.x + slope_y * windows.y
    u, v = _lattice_coordinates(windows, maps, moved)
    inside = windows.valid > 0
    target = (windows.value - base)[inside].astype(np.float64)
    gains = np.broadcast_to(gain[:, None], inside.shape)[inside]
    spacing = float(np.median(np.linalg.norm(maps.axes, axis=2).max(axis=1)))
    knots = int(np.clip(np.ceil(spacing), KNOTS_MIN, KNOTS_MAX))
    design = _spline_design(u[inside], v[inside], knots)
    design = sparse.diags_array(gains) @ design
    normal, right = design.T @ design, design.T @ target
    diagonal = normal.diagonal()
    ridge = 1e-3 * float(diagonal.mean())
    coefficients, _ = cg(
        normal + ridge * sparse.eye_array(knots**2), right, rtol=1e-6, maxiter=MEAN_STEPS
    )
    at = np.arange(knots * SAMPLES_PER_KNOT) / SAMPLES_PER_KNOT
    values = ndimage.map_coordinates(
        coefficients.reshape(knots, knots),
        np.stack(np.meshgrid(at, at, indexing="ij")),
        order=3,
        mode="grid-wrap",
        prefilter=False,
    )
    if fit is None:
        return UnitCell(values - values.mean())
    pixel_variance = float(np.median(fit.variance)) / max(float(np.median(fit.gain)) ** 2, 1e-12)
    return UnitCell(_without_noise(values, pixel_variance / len(target), knots))


def _without_noise(values: Array, variance: float, knots: int) -> Array:
    """Return the values without their mean and without the Fourier coefficients that noise explains.

    The gradients of noise in the mean would pass for information on the position.
    """
    coefficients = np.fft.fft2(values) / values.size
    order = np.fft.fftfreq(len(values), 1.0 / len(values))
    radius = np.hypot(order[:, None], order[None, :])
    keep = (np.abs(coefficients) ** 2 > NOISE_POWERS * variance) & (radius <= 0.5 * knots)
    keep[0, 0] = False
    return np.real(np.fft.ifft2(np.where(keep, coefficients, 0.0))) * values.size


def _spline_design(u: Array, v: Array, knots: int) -> sparse.csr_array:
    """Return the (p, knots^2) values of periodic cubic B-splines at p points."""
    weights, indices = [], []
    for t in (u, v):
        position = t * knots
        whole = np.floor(position)
        f = position - whole
        weights.append(
            np.stack(
                [
                    (1.0 - f) ** 3 / 6.0,
                    2.0 / 3.0 - f * f * (2.0 - f) / 2.0,
                    2.0 / 3.0 - (1.0 - f) ** 2 * (1.0 + f) / 2.0,
                    f**3 / 6.0,
                ],
                axis=1,
            )
        )
        indices.append((whole.astype(np.int64)[:, None] + np.arange(-1, 3)) % knots)
    value = (weights[0][:, :, None] * weights[1][:, None, :]).reshape(len(u), 16)
    column = (indices[0][:, :, None] * knots + indices[1][:, None, :]).reshape(len(u), 16)
    start = 16 * np.arange(len(u) + 1)
    return sparse.csr_array((value.ravel(), column.ravel(), start), shape=(len(u), knots**2))


def fit_cells(
    windows: PixelWindows,
    maps: LocalMaps,
    cell: UnitCell,
    noise: NoiseModel | None,
    *,
    iterations: int,
) -> CellFit:
    """Fit position, gain, offset, gradients and blur of each cell by Gauss-Newton.

    Parameters
    ----------
    windows, maps
        Pixels and local maps of n cells.
    cell
        The mean cell.
    noise
        Noise model for the weights; None for equal weights.
    iterations
        Number of steps.
    """
    tables = _tables(cell, maps)
    block = max(1, CELL_BLOCK_PIXELS // windows.x.shape[1])
    parts = []
    for first in range(0, max(1, len(maps.xy)), block):
        rows = np.zeros(len(maps.xy), dtype=np.bool_)
        rows[first : first + block] = True
        parts.append(_fit_block(windows.select(rows), maps.select(rows), tables, noise, iterations))
    return CellFit.join(parts)


def _tables(cell: UnitCell, maps: LocalMaps) -> Array32:
    """Return (m, m, 4): the mean cell, its derivatives along i and j, and its Laplacian per px^2."""
    values = cell.values
    m = len(values)

    def derive(table: Array, axis: int) -> Array:
        return (np.roll(table, -1, axis) - np.roll(table, 1, axis)) * (0.5 * m)

    along_i, along_j = derive(values, 0), derive(values, 1)
    inverse = np.linalg.inv(np.median(maps.axes, axis=0).T)
    metric = inverse @ inverse.T
    laplacian = (
        metric[0, 0] * derive(along_i, 0)
        + 2.0 * metric[0, 1] * derive(along_i, 1)
        + metric[1, 1] * derive(along_j, 1)
    )
    return np.stack([values, along_i, along_j, laplacian], axis=2).astype(np.float32)


def _look_up(tables: Array32, u: Array, v: Array) -> Array32:
    """Return (4, n, p) values of the tables at cell coordinates, interpolated linearly."""
    m = len(tables)
    # OpenCV wants a picture of less than 2^15 rows and columns. It rounds positions to 1/32 of a
    # sample, which is below a hundredth of a pixel.
    rows = -(-u.size // LOOKUP_ROW_PIXELS)
    where = np.zeros((2, rows * LOOKUP_ROW_PIXELS), dtype=np.float32)
    for axis, t in enumerate((v, u)):
        where[axis, : u.size] = (np.mod(t, 1.0) * m).ravel()
    column, row = where.reshape(2, rows, LOOKUP_ROW_PIXELS)
    found = cv2.remap(tables, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    values = found.reshape(-1, 4)[: u.size].reshape(*u.shape, 4)
    return np.ascontiguousarray(np.moveaxis(values, -1, 0), dtype=np.float32)


def _fit_block(
    windows: PixelWindows,
    maps: LocalMaps,
    tables: Array32,
    noise: NoiseModel | None,
    iterations: int,
) -> CellFit:
    count, pixels = windows.x.shape
    inverse = np.linalg.inv(maps.axes.transpose(0, 2, 1)).astype(np.float32)
    spacing = np.linalg.norm(maps.axes, axis=2).min(axis=1)[:, None]
    limit = CELL_STEP_MAX * spacing
    jacobian = np.empty((count, CELL_PARAMETERS, pixels), dtype=np.float32)
    jacobian[:, 3] = 1.0
    jacobian[:, 4], jacobian[:, 5] = windows.x, windows.y
    moved, levels = np.zeros((count, 2)), np.tile([1.0, 0.0, 0.0, 0.0, 0.0], (count, 1))
    total = np.maximum(windows.valid.sum(axis=1), 1.0)
    levels[:, 1] = (windows.value * windows.valid).sum(axis=1) / total
    for left in range(iterations - 1, -1, -1):
        mean, along_i, along_j, laplacian = _look_up(
            tables, *_lattice_coordinates(windows, maps, moved)
        )
        gain = levels[:, :1].astype(np.float32)
        jacobian[:, 0] = -gain * (inverse[:, 0, :1] * along_i + inverse[:, 1, :1] * along_j)
        jacobian[:, 1] = -gain * (inverse[:, 0, 1:] * along_i + inverse[:, 1, 1:] * along_j)
        jacobian[:, 2], jacobian[:, 6] = mean, laplacian
        model = np.einsum("na,nap->np", levels.astype(np.float32), jacobian[:, 2:])
        weight = windows.valid if noise is None else windows.valid / noise.variance(model)
        residual = windows.value - model
        normal, right = normal_equations(jacobian, residual, weight)
        # A position that nothing tells, as along a line, stays where it is.
        for axis in (0, 1):
            normal[:, axis, axis] += 1.0 / spacing[:, 0] ** 2
            right[:, axis] -= moved[:, axis] / spacing[:, 0] ** 2
        covariance = np.linalg.inv(normal).astype(np.float64, copy=False)
        if not left:
            sides = displaced_sides(windows, moved[:, 0], jacobian, weight)
        step = (covariance @ right[:, :, None])[:, :, 0]
        moved = moved + np.clip(step[:, :2], -limit, limit)
        levels = levels + step[:, 2:]
    freedom = np.maximum(total - CELL_PARAMETERS, 1.0)
    chi2 = np.einsum("np,np,np->n", weight, residual, residual).astype(np.float64)
    # The last step changes chi2 as the normal equations predict.
    chi2 = np.maximum(chi2 - np.einsum("na,na->n", step, right), 0.5 * chi2) / freedom
    level, variance = split_statistics(windows, residual, model, freedom)
    steepness = along_i * along_i + along_j * along_j
    energy = (steepness * windows.valid).sum(axis=1, dtype=np.float64)
    # Of a whole cell: its area in pixels times the mean over the cell.
    whole = np.abs(maps.cell_px2) * float((tables[..., 1:3].astype(np.float64) ** 2).sum(2).mean())
    return CellFit(
        maps.xy + moved,
        covariance[:, :2, :2],
        np.swapaxes(covariance[:, :2] @ sides, 1, 2),
        chi2,
        freedom,
        level,
        variance,
        np.linalg.norm(step[:, :2], axis=1),
        windows.coverage,
        levels,
        energy / whole,
    )
