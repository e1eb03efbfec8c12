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
from functools import cached_property, lru_cache

import numpy as np

from semcal_ros.core.arrays import Array, invert_scaled
from semcal_ros.core.registration.noise_spectrum import shared_pixels
from semcal_ros.core.registration.thresholds import (
    DETERMINANT_MIN,
    GAIN_RCOND,
    GRADIENT_ENERGY_MIN,
    HELD_INFORMATION,
    RAMPS_KEPT,
    USUAL_RAMP,
)
from semcal_ros.core.registration.tiles import PyramidLevel, TileSums, TileWindow


@dataclass(frozen=True)
class TileGeometry:
    """What the fit over a window of n tiles needs and does not depend on the image.

    Attributes
    ----------
    normal_matrices
        (n, 4, 4) normal matrices of the tiles, as in :class:`.tiles.PyramidLevel`, without the noise of the levels.
    ramps
        (n, p) factors of the p terms of gain and offset: a constant and two ramps, or the constant
        alone where the ramps would explain away most of the gradient, as for a lone particle, or the
        noise leaves them uncertain.
    inverse
        (2 p, 2 p) inverse of the normal equations of gain and offset.
    projection
        (2, 2 p) coefficients by which gain and offset explain the gradient.
    gradient_share
        (2,) fraction of the gradient's RMS that they do not explain.
    total
        (4, 4) sum of the normal matrices.
    """

    normal_matrices: Array
    ramps: Array
    inverse: Array
    projection: Array
    gradient_share: Array
    total: Array

    @cached_property
    def explained(self) -> tuple[Array, Array]:
        """(n, 2) parts of the gradient that gain and offset explain, in grey levels and in ones."""
        count = self.ramps.shape[1]
        gain, offset = self.projection[:, :count], self.projection[:, count:]
        return self.ramps @ gain.T, self.ramps @ offset.T

    @cached_property
    def levels_and_ones(self) -> tuple[Array, Array]:
        """(n, 4) columns of the normal matrices that belong to the grey level and to one."""
        level, one = np.ascontiguousarray(self.normal_matrices[:, :, 2:].transpose(2, 0, 1))
        return level, one

    @cached_property
    def gradients(self) -> Array:
        """(n, 2, 2) products of the gradient, without the part that gain and offset explain."""
        share = np.outer(self.gradient_share, self.gradient_share)
        return np.asarray(self.normal_matrices[:, :2, :2] * share)

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


def prepare_geometry(
    level: PyramidLevel, window: TileWindow, weights: Array | None = None
) -> TileGeometry:
    """Geometry of a window, with ``weights`` (rows, cols) of its tiles; that of the latest one without weights is kept,
    because drift is slow.

    The noise of the reference does not lower the gain. It would where there is nothing else, and so tilt the ramp of
    the gain across a structure that lies apart from the middle, which a shift makes up for; so it would at the edge of
    the tiles that count.
    """
    if weights is not None:
        return _compute_geometry(level, window, weights)
    return level.geometries.get_or_compute(window.key, lambda: _compute_geometry(level, window))


def _compute_geometry(
    level: PyramidLevel, window: TileWindow, weights: Array | None = None
) -> TileGeometry:
    shape = len(window.y), len(window.x)
    normal_matrices = level.normal_matrices[window.rows, window.cols].reshape(-1, 4, 4)
    factors = np.ones(1) if weights is None else weights.ravel()
    normal_matrices = normal_matrices * factors[:, None, None]
    normal_matrices[:, 2, 2] -= level.noise_variance * normal_matrices[:, 3, 3]
    ramps, pairs = _make_ramps(shape)
    whole = (normal_matrices.reshape(-1, 16).T @ pairs).reshape(4, 4, 3, 3).transpose(0, 2, 1, 3)
    energy = np.diag(whole[:2, 0, :2, 0])
    with_ramps = _eliminate_gain_and_offset(normal_matrices, ramps, whole)
    constant = _eliminate_gain_and_offset(normal_matrices, ramps[:, :1], whole)
    lost = with_ramps.gradient_share**2 * energy < (
        GRADIENT_ENERGY_MIN * constant.gradient_share**2 * energy
    )
    # Both images have the noise, of which smoothing makes neighbours alike.
    noise = 2.0 * level.noise_variance * shared_pixels(level.sigma_px)
    ramps_of_gain = with_ramps.inverse[1:3, 1:3]
    untold = noise * np.linalg.eigvalsh(ramps_of_gain)[-1] > USUAL_RAMP**2
    return constant if untold or np.any(lost) else with_ramps


@lru_cache(maxsize=RAMPS_KEPT)
def _make_ramps(shape: tuple[int, int]) -> tuple[Array, Array]:
    """(n, 3) one, x and y of the tiles, from -1 to 1, and (n, 9) their products."""
    rows, cols = (np.linspace(-1.0, 1.0, count) for count in shape)
    y, x = np.meshgrid(rows, cols, indexing="ij")
    ramps = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    return ramps, (ramps[:, :, None] * ramps[:, None, :]).reshape(len(ramps), -1)


def _eliminate_gain_and_offset(normal_matrices: Array, ramps: Array, whole: Array) -> TileGeometry:
    """The geometry for the first terms; ``whole`` (4, 3, 4, 3) are the sums for all of them."""
    count = ramps.shape[1]
    normal = whole[2:, :count, 2:, :count].reshape(2 * count, 2 * count)
    mixed = whole[:2, 0, 2:, :count].reshape(2, 2 * count)
    total = whole[:, 0, :, 0]
    plain = np.diag(total)[:2]
    inverse = invert_scaled(normal, rcond=GAIN_RCOND)
    projection = mixed @ inverse
    remaining = plain - np.sum(projection * mixed, axis=1)
    share = np.sqrt(np.maximum(remaining, 0.0) / np.maximum(plain, 1e-30))
    return TileGeometry(normal_matrices, ramps, inverse, projection, share, total)


def well_posed(matrix: Array) -> bool:
    """Whether a (2, 2) information matrix determines both directions.

    Its scaled determinant, one minus the squared correlation of the two, must exceed rounding of
    the single-precision sums that it comes from.
    """
    a, b, c = float(matrix[0, 0]), float(matrix[0, 1]), float(matrix[1, 1])
    return a > 0.0 and c > 0.0 and a * c - b * b > DETERMINANT_MIN * a * c


def invert_symmetric(matrix: Array) -> Array:
    """Inverse of a :func:`well_posed` (2, 2) matrix."""
    a, b, c = float(matrix[0, 0]), float(matrix[0, 1]), float(matrix[1, 1])
    return np.array([[c, -b], [-b, a]]) / (a * c - b * b)


def solve_step(geometry: TileGeometry, sums: TileSums, held: Array | None = None) -> TileFit | None:
    """Gain, offset and step, or None where the gradient leaves a direction undetermined.

    There is no step along the unit vector ``held`` (2,).

    Noise makes the reference's gradient evaluation steeper than it is; the common information does not
    contain it.
    """
    information = sums.hessian * np.outer(geometry.gradient_share, geometry.gradient_share)
    if held is not None:
        information = information + HELD_INFORMATION * np.trace(information) * np.outer(held, held)
    if not well_posed(information):
        return None
    ramps, count = geometry.ramps, geometry.ramps.shape[1]
    cross = sums.cross.reshape(-1, 4)
    terms = geometry.inverse @ (cross[:, 2:].T @ ramps).ravel()
    gain, offset = ramps @ terms[:count], ramps @ terms[count:]
    level, one = geometry.levels_and_ones
    residual = cross - level * gain[:, None] - one * offset[:, None]
    by_gain, by_offset = geometry.explained
    scores = residual[:, :2] - residual[:, 2:3] * by_gain - residual[:, 3:4] * by_offset
    step = -invert_symmetric(information) @ scores.sum(axis=0)
    return TileFit(scores, information, terms[:count], terms[count:], step)


def squared_residuals(geometry: TileGeometry, sums: TileSums, fit: TileFit, noise: float) -> Array:
    """(n,) squares of what gain and offset leave, summed over each tile, with the ``noise`` of the reference per pixel
    in them.
    """
    normal_matrices, cross = geometry.normal_matrices, sums.cross.reshape(-1, 4)
    gain, offset = geometry.ramps @ fit.gain, geometry.ramps @ fit.offset
    levels = normal_matrices[:, 2, 2] + noise * normal_matrices[:, 3, 3]
    model = gain**2 * levels + offset**2 * normal_matrices[:, 3, 3]
    model += 2.0 * gain * offset * normal_matrices[:, 2, 3]
    explained = gain * cross[:, 2] + offset * cross[:, 3]
    return sums.energy.ravel() - 2.0 * explained + model
