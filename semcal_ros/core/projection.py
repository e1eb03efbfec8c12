"""Projection of sem-frame points to raw pixels, with derivatives, for arrays of camera parameters.

The model is that of design section 4, equations (9)-(12) of Malti et al. (2012), doi:10.1117/1.JEI.21.3.033020,
rewritten with ``f = m / rho``, ``s = sigma f`` and ``d_0 = 1 / rho`` so that nothing diverges at ``rho = 0``:

    w   = 1 + rho Z
    x_u = px + m (a X + sigma Y) / w
    y_u = py + m (Y / a) / w

followed by the distortion of :mod:`semcal_ros.core.distortion`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.distortion import distort_jacobians, distort_normalised

__all__ = [
    "PARAMETER_NAMES",
    "ProjectionJacobians",
    "project_ideal_points",
    "project_points",
    "project_points_with_jacobians",
]

Array = NDArray[np.float64]

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
        (n, 2, 10) derivative with respect to the parameters in the order of :data:`PARAMETER_NAMES`.
    """

    xy: Array
    d_xyz: Array
    d_parameters: Array


def project_ideal_points(parameters: Array, xyz_m: Array) -> Array:
    """Undistorted pixels (n, 2); ``parameters`` has shape (10,) or (n, 10). NaN at or behind the pivot."""
    m, a, skew, px, py, rho = np.moveaxis(parameters[..., :6], -1, 0)
    w = 1.0 + rho * xyz_m[:, 2]
    scale = m / np.where(w > 0.0, w, np.nan)
    x = px + scale * (a * xyz_m[:, 0] + skew * xyz_m[:, 1])
    y = py + scale * xyz_m[:, 1] / a
    return np.stack([x, y], axis=1)


def project_points(parameters: Array, xyz_m: Array, norm_px: float) -> Array:
    """Raw (distorted) pixels (n, 2); NaN where the model has no answer."""
    centre = parameters[..., 8:10]
    q = (project_ideal_points(parameters, xyz_m) - centre) / norm_px
    return centre + norm_px * distort_normalised(q, parameters[..., 6], parameters[..., 7])


def project_points_with_jacobians(
    parameters: Array, xyz_m: Array, norm_px: float
) -> ProjectionJacobians:
    """Raw pixels with analytic derivatives; shapes as in :class:`ProjectionJacobians`."""
    n = len(xyz_m)
    table = np.broadcast_to(parameters, (n, 10))
    m, a, skew, px, py, rho, xi_r, xi_t = np.moveaxis(table[:, :8], -1, 0)
    centre = table[:, 8:10]
    x, y, z = xyz_m.T
    w = 1.0 + rho * z
    inverse_w = 1.0 / np.where(w > 0.0, w, np.nan)
    scale = m * inverse_w
    u = a * x + skew * y
    v = y / a
    ideal = np.stack([px + scale * u, py + scale * v], axis=1)

    f, df_dq, df_dxi = distort_jacobians((ideal - centre) / norm_px, xi_r, xi_t)
    xy = centre + norm_px * f

    ideal_xyz = np.zeros((n, 2, 3))
    ideal_xyz[:, 0, 0] = scale * a
    ideal_xyz[:, 0, 1] = scale * skew
    ideal_xyz[:, 1, 1] = scale / a
    ideal_xyz[:, 0, 2] = -scale * u * rho * inverse_w
    ideal_xyz[:, 1, 2] = -scale * v * rho * inverse_w

    ideal_linear = np.zeros((n, 2, 6))
    ideal_linear[:, 0, 0] = inverse_w * u
    ideal_linear[:, 1, 0] = inverse_w * v
    ideal_linear[:, 0, 1] = scale * x
    ideal_linear[:, 1, 1] = -scale * v / a
    ideal_linear[:, 0, 2] = scale * y
    ideal_linear[:, 0, 3] = 1.0
    ideal_linear[:, 1, 4] = 1.0
    ideal_linear[:, 0, 5] = -scale * u * z * inverse_w
    ideal_linear[:, 1, 5] = -scale * v * z * inverse_w

    d_parameters = np.empty((n, 2, 10))
    d_parameters[:, :, :6] = df_dq @ ideal_linear
    d_parameters[:, :, 6:8] = norm_px * df_dxi
    d_parameters[:, :, 8:10] = np.eye(2) - df_dq
    return ProjectionJacobians(xy, df_dq @ ideal_xyz, d_parameters)
