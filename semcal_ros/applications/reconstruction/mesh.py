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

"""A triangle mesh over the part of a round surface that was seen.

Directions from a point inside are triangulated on the unit sphere: the convex hull of the
directions is their Delaunay triangulation. Triangles much larger than the typical spacing span
areas that no view showed; they are left out, so the mesh has holes where there are no data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.errors import StructureError
from semcal_ros.core.wording import counted


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
