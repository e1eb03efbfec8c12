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

"""Point clouds and triangle meshes as PLY and STL files.

Lengths in these files are in a unit that the caller chooses, by default nm: mesh viewers do not show a mesh that is
1e-7 wide. A PLY states its unit in a comment; an STL cannot.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl

from semcal_ros.applications.reconstruction import SurfaceMesh
from semcal_ros.core.arrays import Array32
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_bytes

MESH_SUFFIXES = (".ply", ".stl")
UNITS_PER_M: Mapping[str, float] = {"m": 1.0, "um": 1e6, "nm": 1e9}


def save_mesh(path: str | Path, mesh: SurfaceMesh, *, unit: str = "nm") -> None:
    """Write a mesh completely or not at all.

    Parameters
    ----------
    path
        ``.ply`` (binary, with normals and the 1-sigma of every vertex) or ``.stl`` (binary).
    mesh
        The triangles.
    unit
        ``m``, ``um`` or ``nm``.

    Raises
    ------
    InvalidValueError
        The suffix or the unit is not one of these.
    OSError
        As :func:`~semcal_ros.files.atomic.atomic_write_bytes`.
    """
    target = Path(path)
    atomic_write_bytes(target, encode_mesh(mesh, target.suffix, unit=unit))


def encode_mesh(mesh: SurfaceMesh, suffix: str, *, unit: str = "nm") -> bytes:
    """Encode the file of :func:`save_mesh`."""
    scale = _scale(unit)
    if suffix.lower() not in MESH_SUFFIXES:
        raise InvalidValueError(f"a mesh as '{suffix}'", expected=" or ".join(MESH_SUFFIXES))
    made = trimesh.Trimesh(
        vertices=mesh.vertices_m * scale,
        faces=mesh.faces,
        vertex_normals=mesh.normals,
        process=False,
    )
    if suffix.lower() == ".stl":
        return bytes(export_stl(made))
    made.vertex_attributes["sigma"] = (mesh.sigma_m * scale).astype(np.float32)
    return _add_unit(export_ply(made, vertex_normal=True), unit)


def save_cloud(
    path: str | Path,
    points_m: ArrayLike,
    columns: Mapping[str, ArrayLike] | None = None,
    *,
    unit: str = "nm",
) -> None:
    """Write points as a binary PLY, completely or not at all.

    Parameters
    ----------
    path
        ``.ply``.
    points_m
        (n, 3) m.
    columns
        (n,) further properties of the points by name, written as they are.
    unit
        ``m``, ``um`` or ``nm``, of the points.

    Raises
    ------
    InvalidValueError
        The suffix or the unit is not one of these, or a column has the wrong length.
    """
    target, scale = Path(path), _scale(unit)
    if target.suffix.lower() != ".ply":
        raise InvalidValueError(f"a cloud of points as '{target.suffix}'", expected=".ply")
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3) * scale
    table: dict[str, Array32] = {}
    for name, values in (columns or {}).items():
        table[name] = np.asarray(values, dtype=np.float32)
        if table[name].shape != (len(points),):
            raise InvalidValueError(
                f"{name} of shape {table[name].shape}", expected=f"({len(points)},)"
            )
    cloud: Any = trimesh.PointCloud(points)
    # The exporter writes these, though a cloud, unlike a mesh, does not have them by itself.
    cloud.vertex_attributes = table
    atomic_write_bytes(target, _add_unit(export_ply(cloud, vertex_normal=False), unit))


def _add_unit(data: bytes, unit: str) -> bytes:
    """Add the unit as a comment to the header of a PLY; trimesh writes no comments of a caller."""
    first, _, rest = data.partition(b"\nelement ")
    return first + f"\ncomment unit {unit}\nelement ".encode("ascii") + rest


def _scale(unit: str) -> float:
    if unit not in UNITS_PER_M:
        raise InvalidValueError(f"unit '{unit}'", expected=", ".join(UNITS_PER_M))
    return UNITS_PER_M[unit]
