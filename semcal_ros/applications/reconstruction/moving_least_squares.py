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

"""Moving least squares: a smooth surface through a cloud of points.

Alexa et al. (2003), doi:10.1109/TVCG.2003.1175093: around each point, a plane is fitted to its
neighbours with weights that fall off with distance, then a quadric over that plane; the point moves
onto the quadric. Normals and curvature are those of the quadric.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from semcal_ros.applications.reconstruction.thresholds import SURFACE_NEIGHBOURS, SURFACE_POINTS_MIN
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import StructureError
from semcal_ros.core.wording import counted


@dataclass(frozen=True, eq=False)
class LocalSurface:
    """The surface at points.

    Attributes
    ----------
    points_m
        (n, 3) points moved onto the surface.
    normals
        (n, 3) unit normals; their sign is arbitrary until :meth:`orient`.
    curvature_1_m
        (n,) mean curvature, 1/m, positive where the surface bends away from the normal (a ball with
        outward normals).
    sigma_m
        (n,) 1-sigma of the height of the surface, from the scatter of the neighbours, m.
    """

    points_m: Array
    normals: Array
    curvature_1_m: Array
    sigma_m: Array

    def orient(self, directions: Array) -> LocalSurface:
        """Return the surface with its normals oriented along the given directions (n, 3)."""
        sign = np.where(np.sum(self.normals * directions, axis=1) < 0.0, -1.0, 1.0)
        return LocalSurface(
            self.points_m, self.normals * sign[:, None], self.curvature_1_m * sign, self.sigma_m
        )


def compute_spacing_m(points_m: Array) -> float:
    """Compute the median distance of a point from its nearest neighbour, m."""
    return float(np.median(cKDTree(points_m).query(points_m, k=2)[0][:, 1]))


def fit_local_surface(
    cloud_m: Array, at_m: Array, radius_m: float, *, steps: int = 2
) -> LocalSurface:
    """Fit the surface of a cloud at points near it.

    Parameters
    ----------
    cloud_m
        (n, 3) points.
    at_m
        (q, 3) points at which the surface is evaluated.
    radius_m
        Distance at which a neighbour's weight has fallen to 1/e; it grows where fewer than
        eight neighbours are within it.
    steps
        How many times a point is moved onto the surface around it.

    Raises
    ------
    StructureError
        For fewer than eight points.
    """
    if len(cloud_m) < SURFACE_POINTS_MIN:
        raise StructureError(
            f"a cloud of {counted(len(cloud_m), 'point')}",
            expected=f"at least {SURFACE_POINTS_MIN}",
        )
    tree = cKDTree(cloud_m)
    at = np.array(at_m, dtype=np.float64)
    surface = _fit_quadrics(cloud_m, tree, at, radius_m)
    for _ in range(steps - 1):
        surface = _fit_quadrics(cloud_m, tree, surface.points_m, radius_m)
    return surface


def _fit_quadrics(cloud: Array, tree: cKDTree, at: Array, radius: float) -> LocalSurface:
    count = min(SURFACE_NEIGHBOURS, len(cloud))
    distance, index = tree.query(at, k=count)
    wide = np.maximum(radius, distance[:, min(SURFACE_POINTS_MIN, count) - 1])[:, None]
    weight = np.exp(-((distance / wide) ** 2))
    near = cloud[index]
    total = weight.sum(axis=1)
    centre = np.einsum("qk,qki->qi", weight, near) / total[:, None]
    offset = near - centre[:, None]
    spread = np.einsum("qk,qki,qkj->qij", weight, offset, offset)
    axes = np.linalg.eigh(spread)[1]
    local = np.einsum("qki,qij->qkj", near - at[:, None], axes)
    # Columns of eigh ascend: the first is the normal.
    height, u, v = np.moveaxis(local / wide[..., None], 2, 0)
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    normal = np.einsum("qk,qki,qkj->qij", weight, design, design)
    right = np.einsum("qk,qki,qk->qi", weight, design, height)
    # Curvature is damped where the neighbours do not determine it.
    damping = total[:, None, None] * np.diag([0.0, 0.0, 0.0, 1e-4, 1e-4, 1e-4])
    inverse = np.linalg.inv(normal + damping)
    found = np.einsum("qij,qj->qi", inverse, right)
    error = height - np.einsum("qki,qi->qk", design, found)
    freedom = np.maximum(total - 6.0 * total / count, 0.2 * total)
    variance = np.einsum("qk,qk->q", weight, error**2) / freedom
    squared = np.einsum("qk,qki,qkj->qij", weight**2, design, design)
    leverage = np.einsum("qi,qij,qj->q", inverse[:, 0], squared, inverse[:, 0])
    slope = found[:, 1:3]
    steep = np.sqrt(1.0 + np.sum(slope**2, axis=1))
    normals = np.stack([np.ones(len(at)), -slope[:, 0], -slope[:, 1]], axis=1) / steep[:, None]
    bend = (
        -(
            (1.0 + slope[:, 1] ** 2) * found[:, 3]
            - slope[:, 0] * slope[:, 1] * found[:, 4]
            + (1.0 + slope[:, 0] ** 2) * found[:, 5]
        )
        / steep**3
    )
    scale = wide[:, 0]
    return LocalSurface(
        at + (found[:, 0] * scale)[:, None] * axes[:, :, 0],
        np.einsum("qij,qj->qi", axes, normals),
        bend / scale,
        np.sqrt(variance * leverage) * scale,
    )
