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

"""Upgrade affine to metric structure with calibrated parallel projections.

The tracks are in true scale (see :class:`.Tracks`), so the rows of every camera become orthonormal:
``M_i Q M_i^T = I`` for one symmetric Q = A A^T. That is linear in the six entries of Q and
absolute: scale, aspect and skew are those of the calibration. Two ambiguities remain in
parallel projection, whatever the number of views:

- the *bas-relief* direction is weak when the views differ by small rotations; see
  :attr:`MetricUpgrade.condition`;
- the *mirror image* in depth, with mirrored rotations, explains the tracks exactly as well:
:func:`mirror_structure`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from semcal_ros.applications.reconstruction.factorization import AffineStructure
from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.errors import StructureError
from semcal_ros.core.wording import counted

# Reverses depth.
_MIRROR = np.diag([1.0, 1.0, -1.0])
# Rows and columns of the six different entries of Q.
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class MetricUpgrade:
    """Metric structure in the frame of the specimen.

    Attributes
    ----------
    rotations
        (views, 3, 3) sem_from_specimen; identity where a view was not placed.
    translations_m
        (views, 3), z = 0.
    points_m
        (points, 3) m.
    condition
        Singular value ratio of the six equations: below about 1e-3 the relief is hardly determined.
    orthonormality
        RMS departure of the upgraded camera rows from orthonormal ones, dimensionless.
    positive
        Whether the linear solution was positive definite; if not, it was made so and refined.
    """

    rotations: Array
    translations_m: Array
    points_m: Array
    condition: float
    orthonormality: float
    positive: bool


def upgrade_to_metric(affine: AffineStructure) -> MetricUpgrade:
    """Upgrade an affine structure to a metric one.

    Raises
    ------
    StructureError
        If fewer than three views are placed, or all of them look from one direction.
    """
    placed = affine.views_placed
    cameras = affine.cameras[placed]
    if len(cameras) < 3:
        raise StructureError(
            counted(len(cameras), "view"),
            expected="at least 3, since two leave the relief undetermined",
        )
    # Whiten the points, so that Q is near a multiple of the identity and its condition means
    # something.
    spread = np.linalg.cholesky(np.cov(affine.points[affine.points_placed].T))
    scaled = cameras @ spread
    unit = float(np.sqrt(np.mean(scaled**2)))
    scaled = scaled / unit
    rows, right = _form_equations(scaled, 1.0 / unit**2)
    solution, _, rank, values = np.linalg.lstsq(rows, right, rcond=None)
    condition = float(values[-1] / values[0])
    if rank < 6 or condition < 1e-7:
        raise StructureError(
            f"{counted(len(cameras), 'view')} from nearly one direction",
            expected="views that are rotated about an axis across the beam",
        )
    q = np.zeros((3, 3))
    for value, (i, j) in zip(solution, _PAIRS, strict=True):
        q[i, j] = q[j, i] = value
    smallest = float(np.linalg.eigvalsh(q)[0])
    positive = smallest > 0.0
    root = np.asarray(np.linalg.cholesky(_make_positive(q)), dtype=np.float64)
    root = _refine_root(scaled, root, 1.0 / unit)
    metric = scaled @ root * unit
    points = affine.points @ np.linalg.inv(spread @ root).T
    rotations = np.broadcast_to(np.eye(3), (len(placed), 3, 3)).copy()
    rotations[placed] = _find_nearest_rotations(metric)
    error = metric @ np.swapaxes(metric, 1, 2) - np.eye(2)
    translations = np.zeros((len(placed), 3))
    translations[:, :2] = affine.offsets_m
    return MetricUpgrade(
        *_turn_to_middle_view(rotations, translations, points, placed),
        condition,
        float(np.sqrt(np.mean(error**2))),
        positive,
    )


def mirror_structure(rotations: Array, points_m: Array) -> tuple[Array, Array]:
    """Return the other structure with the same projections: (views, 3, 3) and (points, 3)."""
    return _MIRROR @ rotations @ _MIRROR, points_m @ _MIRROR


def _form_equations(cameras: Array, size: float) -> tuple[Array, Array]:
    """Form rows and right side of ``M Q M^T = size * I`` in the six entries of Q."""
    i, j = cameras[:, 0], cameras[:, 1]

    def row(a: Array, b: Array) -> Array:
        terms = [a[:, p] * b[:, q] + (a[:, q] * b[:, p] if p != q else 0.0) for p, q in _PAIRS]
        return np.stack(terms, axis=1)

    rows = np.concatenate([row(i, i), row(j, j), row(i, j)])
    ones = np.ones(len(cameras))
    return rows, np.concatenate([ones, ones, 0.0 * ones]) * size


def _make_positive(q: Array) -> Array:
    values, vectors = np.linalg.eigh(q)
    values = np.maximum(values, 1e-3 * values[-1])
    return np.asarray((vectors * values) @ vectors.T, dtype=np.float64)


def _refine_root(cameras: Array, root: Array, size: float) -> Array:
    """Refine the root of Q so that the rows are orthonormal in the least-squares sense."""
    lower = np.tril_indices(3)

    def error(values: Array) -> Array:
        a = np.zeros((3, 3))
        a[lower] = values
        rows = cameras @ a
        gram = rows @ np.swapaxes(rows, 1, 2) / size**2 - np.eye(2)
        return np.concatenate([gram[:, 0, 0], gram[:, 1, 1], np.sqrt(2.0) * gram[:, 0, 1]])

    found = least_squares(error, root[lower], method="lm", max_nfev=400)
    out = np.zeros((3, 3))
    out[lower] = found.x
    return out


def _find_nearest_rotations(rows: Array) -> Array:
    """Find the nearest rotations (n, 3, 3) to camera rows (n, 2, 3)."""
    u, _, vt = np.linalg.svd(rows, full_matrices=False)
    two = u @ vt
    return np.concatenate([two, np.cross(two[:, 0], two[:, 1])[:, None]], axis=1)


def _turn_to_middle_view(
    rotations: Array, translations: Array, points: Array, placed: Mask
) -> tuple[Array, Array, Array]:
    """Express the structure in the axes of the middle placed view, so that z is its depth."""
    index = np.flatnonzero(placed)
    first = rotations[index[len(index) // 2]]
    return rotations @ first.T, translations, points @ first.T
