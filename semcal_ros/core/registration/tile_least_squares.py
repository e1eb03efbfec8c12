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

"""Least squares for shift, gain and offset on the sums over tiles.

Gain and offset are constant over a tile and follow a ramp over the field. They are eliminated: the
gradient is made orthogonal to them, and only a shift explains what remains of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, invert_scaled
from semcal_ros.core.registration.tiles import PyramidLevel, TileSums, TileWindow

__all__ = [
    "TileFit",
    "TileGeometry",
    "prepare_geometry",
    "solve_step",
    "squared_residuals",
    "well_posed",
]


# Ramps of gain and offset that explain away more than half of the energy of the gradient that
# constants leave are not used.
_MIN_GRADIENT_ENERGY = 0.5
# Sums of single-precision pixels are good to 1e-7 and no better: what is below is rounding.
_RCOND = 1e-9
_MIN_DETERMINANT = 1e-6


@dataclass(frozen=True)
class TileGeometry:
    """What the fit over a window of n tiles needs and does not depend on the image.

    Attributes
    ----------
    normal_matrices
        (n, 4, 4) normal matrices of the tiles, as in :class:`.tiles.PyramidLevel`.
    ramps
        (n, p) factors of the p terms of gain and offset: a constant and two ramps, or the constant
        alone where the ramps would explain away most of the gradient, as for a lone particle.
    inverse
        (2 p, 2 p) inverse of the normal equations of gain and offset.
    projection
        (2, 2 p) coefficients by which gain and offset explain the gradient.
    gradient_share
        (2,) fraction of the gradient's RMS that they do not explain.
    """

    normal_matrices: Array
    ramps: Array
    inverse: Array
    projection: Array
    gradient_share: Array

    @property
    def has_constant_gain(self) -> bool:
        """Whether gain and offset are constants over the field."""
        return int(self.ramps.shape[1]) == 1


@dataclass(frozen=True)
class TileFit:
    """Gauss-Newton step at one shift.

    Attributes
    ----------
    scores
        (n, 2) the tiles' products of the orthogonal gradient with what gain and offset leave.
    information
        (2, 2) the part of the common information that only a shift explains.
    gain, offset
        (p,) terms of the gain and of the offset.
    step
        (2,) change of the shift.
    """

    scores: Array
    information: Array
    gain: Array
    offset: Array
    step: Array


def prepare_geometry(level: PyramidLevel, window: TileWindow) -> TileGeometry:
    """Geometry of a window; that of the latest one is kept, because drift is slow."""
    return level.geometries.get_or_compute(window.key, lambda: _compute_geometry(level, window))


def _compute_geometry(level: PyramidLevel, window: TileWindow) -> TileGeometry:
    rows = np.linspace(-1.0, 1.0, window.rows.stop - window.rows.start)
    cols = np.linspace(-1.0, 1.0, window.cols.stop - window.cols.start)
    y, x = np.meshgrid(rows, cols, indexing="ij")
    ramps = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    normal_matrices = level.normal_matrices[window.rows, window.cols].reshape(-1, 4, 4)
    energy = np.diag(normal_matrices[:, :2, :2].sum(axis=0))
    with_ramps = _eliminate_gain_and_offset(normal_matrices, ramps)
    constant = _eliminate_gain_and_offset(normal_matrices, ramps[:, :1])
    lost = with_ramps.gradient_share**2 * energy < (
        _MIN_GRADIENT_ENERGY * constant.gradient_share**2 * energy
    )
    return constant if np.any(lost) else with_ramps


def _eliminate_gain_and_offset(normal_matrices: Array, ramps: Array) -> TileGeometry:
    count = ramps.shape[1]
    pairs = (ramps[:, :, None] * ramps[:, None, :]).reshape(len(ramps), -1)
    whole = (
        (normal_matrices.reshape(-1, 16).T @ pairs)
        .reshape(4, 4, count, count)
        .transpose(0, 2, 1, 3)
    )
    normal = whole[2:, :, 2:, :].reshape(2 * count, 2 * count)
    mixed = whole[:2, 0, 2:, :].reshape(2, 2 * count)
    plain = np.diag(whole[:2, 0, :2, 0])
    inverse = invert_scaled(normal, rcond=_RCOND)
    projection = mixed @ inverse
    remaining = plain - np.sum(projection * mixed, axis=1)
    share = np.sqrt(np.maximum(remaining, 0.0) / np.maximum(plain, 1e-30))
    return TileGeometry(normal_matrices, ramps, inverse, projection, share)


def well_posed(matrix: Array) -> bool:
    """Whether a (2, 2) information matrix determines both directions.

    Its scaled determinant, one minus the squared correlation of the two, must exceed rounding of
    the single-precision sums that it comes from.
    """
    a, b, c = float(matrix[0, 0]), float(matrix[0, 1]), float(matrix[1, 1])
    return a > 0.0 and c > 0.0 and a * c - b * b > _MIN_DETERMINANT * a * c


def solve_step(geometry: TileGeometry, sums: TileSums) -> TileFit | None:
    """Gain, offset and step, or None where the gradient leaves a direction undetermined.

    Noise makes the reference's gradient evaluation steeper than it is; the common information does not
    contain it.
    """
    information = sums.hessian * np.outer(geometry.gradient_share, geometry.gradient_share)
    if not well_posed(information):
        return None
    normal_matrices, ramps = geometry.normal_matrices, geometry.ramps
    count = ramps.shape[1]
    cross = sums.cross.reshape(-1, 4)
    terms = geometry.inverse @ (cross[:, 2:].T @ ramps).ravel()
    gain, offset = ramps @ terms[:count], ramps @ terms[count:]
    residual = cross - normal_matrices[:, :, 2] * gain[:, None]
    residual = residual - normal_matrices[:, :, 3] * offset[:, None]
    scores = residual[:, :2] - (residual[:, 2:3] * ramps) @ geometry.projection[:, :count].T
    scores = scores - (residual[:, 3:4] * ramps) @ geometry.projection[:, count:].T
    step = -np.linalg.solve(information, scores.sum(axis=0))
    return TileFit(scores, information, terms[:count], terms[count:], step)


def squared_residuals(geometry: TileGeometry, sums: TileSums, fit: TileFit) -> Array:
    """(n,) squares of what gain and offset leave, summed over each tile."""
    normal_matrices, cross = geometry.normal_matrices, sums.cross.reshape(-1, 4)
    gain, offset = geometry.ramps @ fit.gain, geometry.ramps @ fit.offset
    model = gain**2 * normal_matrices[:, 2, 2] + offset**2 * normal_matrices[:, 3, 3]
    model += 2.0 * gain * offset * normal_matrices[:, 2, 3]
    explained = gain * cross[:, 2] + offset * cross[:, 3]
    return sums.energy.ravel() - 2.0 * explained + model
