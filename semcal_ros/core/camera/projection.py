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

"""Projection of sem-frame points to raw pixels, with derivatives, for arrays of camera parameters.

The model is that of ``doc/model.md``: equations (9)-(12) of Malti et al. (2012), doi:10.1117/1.JEI.21.3.033020,
rewritten with ``f = m / rho``, ``s = sigma f`` and ``d_0 = 1 / rho`` so that nothing diverges at ``rho = 0``:

    w   = 1 + rho Z
    x_u = px + m (a X + sigma Y) / w
    y_u = py + m (Y / a) / w

followed by the distortion of the lens (:mod:`semcal_ros.core.camera.distortion`) and that of the scan
(:mod:`semcal_ros.core.camera.scan_distortion`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.distortion import LENS_NAMES, distort_jacobians, distort_normalised
from semcal_ros.core.camera.scan_distortion import (
    ALONG_COUNT,
    SCAN_NAMES,
    Raster,
    deflection_stretch,
    linearise_scan,
    raw_from_deflection,
)

PARAMETER_NAMES: tuple[str, ...] = (
    "m",
    "aspect",
    "skew",
    "px",
    "py",
    "rho",
    "xi_r",
    "xi_t",
    "ex",
    "ey",
)
"""The parameters that every camera has."""
_FURTHER_LENS_NAMES = tuple(name for name in LENS_NAMES if name not in PARAMETER_NAMES)
ALL_NAMES: tuple[str, ...] = (*PARAMETER_NAMES, *_FURTHER_LENS_NAMES, *SCAN_NAMES)
"""All parameters: after those of every camera further distortion of the lens, and the distortion of the scan."""
CAMERA_SIZES: tuple[int, ...] = (
    len(PARAMETER_NAMES),
    len(PARAMETER_NAMES) + len(_FURTHER_LENS_NAMES),
    len(ALL_NAMES),
)
"""How many of :data:`ALL_NAMES` a camera may have: the first ones, those of the lens, or all. Fewer are faster."""
_FURTHER_LENS, _SCAN = slice(*CAMERA_SIZES[:2]), slice(*CAMERA_SIZES[1:])


def camera_size(names: Collection[str]) -> int:
    """Return the smallest of :data:`CAMERA_SIZES` whose cameras have parameters of these names."""
    last = max(ALL_NAMES.index(name) for name in names)
    return next(size for size in CAMERA_SIZES if size > last)


@dataclass(frozen=True)
class ProjectionJacobians:
    """Raw pixels and their derivatives.

    Attributes
    ----------
    xy
        (n, 2) raw pixels.
    d_xyz
        (n, 2, 3) derivative with respect to the sem-frame point, px per m.
    d_parameters
        (n, 2, P) derivative with respect to the parameters in the order of
        :data:`ALL_NAMES`; (n, 2, 0) where it was not asked for.
    """

    xy: Array
    d_xyz: Array
    d_parameters: Array


def project_ideal_points(parameters: Array, xyz_m: Array) -> Array:
    """Project points to undistorted pixels (n, 2); NaN at or behind the pivot.

    ``parameters`` has shape (P,) or (n, P), with the first P of :data:`ALL_NAMES`, one of :data:`CAMERA_SIZES`.
    """
    m, a, skew, px, py, rho = np.moveaxis(parameters[..., :6], -1, 0)
    w = 1.0 + rho * xyz_m[:, 2]
    scale = m / np.where(w > 0.0, w, np.nan)
    x = px + scale * (a * xyz_m[:, 0] + skew * xyz_m[:, 1])
    y = py + scale * xyz_m[:, 1] / a
    return np.stack([x, y], axis=1)


def project_points(parameters: Array, xyz_m: Array, raster: Raster) -> Array:
    """Project points to raw (distorted) pixels (n, 2); NaN where the model has no answer."""
    centre, norm_px = parameters[..., 8:10], raster.norm_px
    q = (project_ideal_points(parameters, xyz_m) - centre) / norm_px
    lens, amplitudes = _distortion(parameters)
    deflection = centre + norm_px * distort_normalised(q, *lens)
    if amplitudes is None or not np.any(amplitudes):
        return deflection
    return raw_from_deflection(deflection, amplitudes, raster)


def _distortion(parameters: Array) -> tuple[list[Array], Array | None]:
    """Return the coefficients of the lens, and the amplitudes of the scan where there are any."""
    lens = [parameters[..., 6], parameters[..., 7]]
    count = parameters.shape[-1]
    if count > CAMERA_SIZES[0]:
        lens += list(np.moveaxis(parameters[..., _FURTHER_LENS], -1, 0))
    return lens, parameters[..., _SCAN] if count > CAMERA_SIZES[1] else None


def project_points_with_jacobians(
    parameters: Array, xyz_m: Array, raster: Raster, *, points_only: bool = False
) -> ProjectionJacobians:
    """Project points to raw pixels, with analytic derivatives; with ``points_only`` those by the points alone.

    In memory the points come last, so that each derivative of all points is contiguous.
    """
    n, norm_px = len(xyz_m), raster.norm_px
    count = np.shape(parameters)[-1]
    table = np.broadcast_to(parameters, (n, count))
    m, a, skew, px, py, rho = table[:, :6].T
    centre = table[:, 8:10]
    x, y, z = xyz_m.T
    w = 1.0 + rho * z
    inverse_w = 1.0 / np.where(w > 0.0, w, np.nan)
    scale = m * inverse_w
    u = a * x + skew * y
    v = y / a
    scaled_u, scaled_v = scale * u, scale * v
    ideal = np.stack([px + scaled_u, py + scaled_v], axis=1)

    lens, amplitudes = _distortion(table)
    f, df_dq, df_dxi = distort_jacobians((ideal - centre) / norm_px, *lens, points_only=points_only)
    xy = centre + norm_px * f
    scan, stretch = None, None
    if amplitudes is not None:
        xy = raw_from_deflection(xy, amplitudes, raster)
        if points_only:
            stretch = deflection_stretch(xy, amplitudes, raster).T
        else:
            scan = linearise_scan(xy, amplitudes, raster)
            stretch = scan.stretch
    d_xyz, d_parameters = np.empty((2, 3, n)), np.zeros((2, 0 if points_only else count, n))
    up, tilt = rho * inverse_w, z * inverse_w
    for row in (0, 1):
        per_stretch = 1.0 if stretch is None else 1.0 / stretch[row]
        by_x, by_y = per_stretch * df_dq[:, row, 0], per_stretch * df_dq[:, row, 1]
        along = by_x * scaled_u + by_y * scaled_v
        d_xyz[row, 0] = by_x * scale * a
        d_xyz[row, 1] = scale * (by_x * skew + by_y / a)
        d_xyz[row, 2] = -along * up
        if points_only:
            continue
        by_xi = per_stretch * norm_px * df_dxi[:, row].T
        d_parameters[row, 0] = along / m
        d_parameters[row, 1] = by_x * scale * x - by_y * scaled_v / a
        d_parameters[row, 2] = by_x * scale * y
        d_parameters[row, 3] = by_x
        d_parameters[row, 4] = by_y
        d_parameters[row, 5] = -along * tilt
        d_parameters[row, 6:8] = by_xi[:2]
        d_parameters[row, 8] = -by_x
        d_parameters[row, 9] = -by_y
        d_parameters[row, 8 + row] += per_stretch
        if count > CAMERA_SIZES[0]:
            d_parameters[row, _FURTHER_LENS] = by_xi[2:]
        if scan is not None:
            functions = slice(0, ALONG_COUNT) if row == 0 else slice(ALONG_COUNT, None)
            d_parameters[row, _SCAN][functions] = -per_stretch * scan.basis[functions]
    return ProjectionJacobians(
        xy,
        np.moveaxis(d_xyz, -1, 0),
        np.moveaxis(d_parameters, -1, 0),
    )
