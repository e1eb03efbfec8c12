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

"""The surface of a cloud of points: moving least squares, and a triangle mesh over the part that was seen.

Moving least squares (Alexa et al. 2003, doi:10.1109/TVCG.2003.1175093): around each point, a plane is fitted to its
neighbours with weights that fall off with distance, then a quadric over that plane; the point moves
onto the quadric. Normals and curvature are those of the quadric.

For the mesh of a round surface, directions from a point inside are triangulated on the unit sphere: the convex hull of
the directions is their Delaunay triangulation. Triangles much larger than the typical spacing span
areas that no view showed; they are left out, so the mesh has holes where there are no data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from semcal_ros.applications.reconstruction.thresholds import SURFACE_NEIGHBOURS, SURFACE_POINTS_MIN
from semcal_ros.core.arrays import Array, Indices
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


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles, counter-clockwise as seen from outside.

    Attributes
    ----------
    vertices_m
        (n, 3) m.
    faces
        (f, 3) vertices of each triangle.
    normals
        (n, 3) outward unit normals.
    sigma_m
        (n,) 1-sigma of the vertices along the normal, m.
    boundary_edges
        Number of edges with only one triangle: 0 for a watertight mesh.
    """

    vertices_m: Array
    faces: Indices
    normals: Array
    sigma_m: Array
    boundary_edges: int

    @property
    def watertight(self) -> bool:
        """Whether every edge has two triangles."""
        return self.boundary_edges == 0


def triangulate_cloud(
    points_m: Array,
    centre_m: Array,
    normals: Array,
    sigma_m: Array,
    *,
    largest_gap: float = 3.5,
) -> SurfaceMesh:
    """Triangulate points that surround a centre.

    Parameters
    ----------
    points_m, centre_m, normals, sigma_m
        (n, 3), (3,), (n, 3), (n,).
    largest_gap
        Triangles whose circumcircle is wider than this many typical distances between neighbours
        are left out.

    Raises
    ------
    StructureError
        For fewer than four points or points in one plane.
    """
    if len(points_m) < 4:
        raise StructureError(f"a mesh of {counted(len(points_m), 'point')}", expected="at least 4")
    offset = points_m - centre_m
    directions = offset / np.linalg.norm(offset, axis=1)[:, None]
    try:
        faces = np.asarray(ConvexHull(directions).simplices, dtype=np.intp)
    except QhullError as error:
        raise StructureError("points that span no surface", expected="a round cloud") from error
    a, b, c = (directions[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    inward = np.sum(cross * (a + b + c), axis=1) < 0.0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    spacing = float(np.median(cKDTree(directions).query(directions, k=2)[0][:, 1]))
    keep = _compute_circumradius(a, b, c) < 0.5 * largest_gap * spacing
    faces = _keep_largest_part(faces[keep], len(points_m))
    if not len(faces):
        raise StructureError("points that span no surface", expected="a denser cloud")
    used = np.unique(faces)
    renumbered = np.full(len(points_m), -1)
    renumbered[used] = np.arange(len(used))
    outward = np.where(np.sum(normals * offset, axis=1) < 0.0, -1.0, 1.0)[:, None] * normals
    return SurfaceMesh(
        points_m[used],
        renumbered[faces],
        outward[used],
        sigma_m[used],
        _count_open_edges(faces),
    )


def _compute_circumradius(a: Array, b: Array, c: Array) -> Array:
    sides = [np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))]
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.asarray(sides[0] * sides[1] * sides[2] / (4.0 * np.maximum(area, 1e-300)))


def _list_edges(faces: Indices) -> Indices:
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.sort(pairs, axis=1)


def _count_open_edges(faces: Indices) -> int:
    _, counts = np.unique(_list_edges(faces), axis=0, return_counts=True)
    return int(np.count_nonzero(counts == 1))


def _keep_largest_part(faces: Indices, points: int) -> Indices:
    """Keep the largest set of triangles connected by edges."""

    edges = _list_edges(faces)
    order = np.lexsort(edges.T[::-1])
    same = np.all(edges[order][1:] == edges[order][:-1], axis=1)
    owner = np.tile(np.arange(len(faces)), 3)[order]
    first, second = owner[:-1][same], owner[1:][same]
    size = len(faces)
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    if not size:
        return faces
    return np.asarray(faces[label == np.argmax(np.bincount(label))], dtype=np.intp)
