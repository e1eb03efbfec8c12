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

"""Distortion by the lens, forwards and backwards.

The map acts on normalised coordinates ``q = (x_u - e) / n``, with the distortion centre ``e`` and
half the image width ``n``:

    f(q) = 2 q / (1 + sqrt(1 - 4 xi_r r2)) + (xi_t + xi_u (1, -1)) * (r2 + 2 q*q)
           + (xi_v + xi_w (1, -1)) 2 q_x q_y + xi_s r2 (-q_y, q_x) + xi_r4 r2^2 q,   r2 = |q|^2

The radial term is the closed form of the division model (Fitzgibbon 2001,
doi:10.1109/CVPR.2001.990465), the tangential one is the consistent reading of equation (2) of Malti
et al. (2012), doi:10.1117/1.JEI.21.3.033020: the printed bracket adds a squared displacement vector
to a scalar. It stands for decentring along one diagonal, and xi_u for decentring along the other. A lens that is
displaced has the products of both coordinates besides (Brown 1966, Decentering distortion of lenses): along the first
diagonal xi_v = xi_t, along the other one xi_w = -xi_u. With the centre and the spiral term, all six quadratic patterns
can be told. The spiral term is the third-order anisotropic distortion of a magnetic lens, which turns what is farther
from its axis more (Hawkes and Kasper, Principles of Electron Optics, ch. 24). The last term is the isotropic distortion
of the fifth order, by which a strong one departs from the closed form: k2 of the polynomial model is
``xi_r4 + 2 xi_r^2``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.camera.thresholds import LENS_STEPS_MAX, LENS_TOLERANCE

LENS_NAMES: tuple[str, ...] = ("xi_r", "xi_t", "xi_s", "xi_u", "xi_v", "xi_w", "xi_r4")
"""The coefficients, in the order in which the functions below take and derive them."""
PRODUCTS: tuple[str, ...] = ("xi_v", "xi_w")
"""Those of the products of both coordinates."""
LATE_TERMS: tuple[str, ...] = (*PRODUCTS, "xi_r4")
"""Those that are much like what others do together: the products, and the fifth order."""


@dataclass(frozen=True)
class Undistortion:
    """Result of inverting the distortion.

    Attributes
    ----------
    q
        (n, 2) normalised ideal coordinates; NaN where ``converged`` is false.
    converged
        (n,) bool. False outside the model's domain, or where Newton's method did not converge.
    iterations
        Number of Newton steps that were taken.
    residual
        (n,) distance of the re-distorted point from the input, in normalised units.
    """

    q: Array
    converged: Mask
    iterations: int
    residual: Array


def _radial(r2: Array, xi_r: Array) -> tuple[Array, Array]:
    """Return root ``s`` and factor ``lambda = 2 / (1 + s)``; NaN where ``4 xi_r r2 >= 1``."""
    inside = 1.0 - 4.0 * xi_r * r2
    root = np.sqrt(np.where(inside > 0.0, inside, np.nan))
    return root, 2.0 / (1.0 + root)


def distort_normalised(
    q: Array,
    xi_r: Array | float,
    xi_t: Array | float,
    xi_s: Array | float = 0.0,
    xi_u: Array | float = 0.0,
    xi_v: Array | float = 0.0,
    xi_w: Array | float = 0.0,
    xi_r4: Array | float = 0.0,
) -> Array:
    """Distort (n, 2) normalised points; NaN rows where ``4 xi_r r2 >= 1``.

    The coefficients are scalars or arrays of shape (n,).
    """
    squares = q * q
    r2 = squares[:, 0] + squares[:, 1]
    _, factor = _radial(r2, np.asarray(xi_r, dtype=np.float64))
    fifth = np.asarray(xi_r4, dtype=np.float64)
    if np.any(fifth):
        factor = factor + fifth * r2 * r2
    tangential = np.asarray(xi_t, dtype=np.float64)[..., None] * (r2[:, None] + 2.0 * squares)
    out = factor[:, None] * q + tangential
    spiral, across = np.asarray(xi_s, dtype=np.float64), np.asarray(xi_u, dtype=np.float64)
    if np.any(spiral):
        out += (spiral * r2)[:, None] * np.stack([-q[:, 1], q[:, 0]], axis=1)
    if np.any(across):
        out += across[..., None] * (r2[:, None] + 2.0 * squares) * [1.0, -1.0]
    crossed, twisted = np.asarray(xi_v, dtype=np.float64), np.asarray(xi_w, dtype=np.float64)
    if np.any(crossed) or np.any(twisted):
        products = 2.0 * q[:, 0] * q[:, 1]
        out += np.stack([(crossed + twisted) * products, (crossed - twisted) * products], axis=1)
    return out


def distort_jacobians(
    q: Array,
    xi_r: Array | float,
    xi_t: Array | float,
    xi_s: Array | float = 0.0,
    xi_u: Array | float = 0.0,
    xi_v: Array | float = 0.0,
    xi_w: Array | float = 0.0,
    xi_r4: Array | float = 0.0,
    *,
    points_only: bool = False,
) -> tuple[Array, Array, Array]:
    """Distort points, with derivatives; with ``points_only`` none by the coefficients, and ``df_dxi`` is empty.

    Returns
    -------
    f, df_dq, df_dxi
        Arrays of shape (n, 2), (n, 2, 2) and (n, 2, 7); the last axis of ``df_dxi`` is in the order of
        :data:`LENS_NAMES`.
    """
    xi_radial = np.asarray(xi_r, dtype=np.float64)
    xi_tangential = np.asarray(xi_t, dtype=np.float64)
    r2 = np.sum(q * q, axis=1)
    root, factor = _radial(r2, xi_radial)
    bracket = r2[:, None] + 2.0 * q * q
    f = factor[:, None] * q + xi_tangential[..., None] * bracket

    growth = factor * factor / root  # d lambda / d(xi_r r2)
    x, y = q.T
    along = 2.0 * growth * xi_radial
    tangential_x, tangential_y = 2.0 * xi_tangential * x, 2.0 * xi_tangential * y
    # In memory the points come last, which is faster; in shape they come first, as elsewhere.
    df_dq = np.empty((2, 2, len(q)))
    df_dq[0, 0] = along * x * x + factor + 3.0 * tangential_x
    df_dq[0, 1] = along * x * y + tangential_y
    df_dq[1, 0] = along * x * y + tangential_x
    df_dq[1, 1] = along * y * y + factor + 3.0 * tangential_y
    fifth = np.asarray(xi_r4, dtype=np.float64)
    if np.any(fifth):
        f = f + (fifth * r2 * r2)[:, None] * q
        df_dq[0, 0] += fifth * r2 * (r2 + 4.0 * x * x)
        df_dq[0, 1] += 4.0 * fifth * r2 * x * y
        df_dq[1, 0] += 4.0 * fifth * r2 * x * y
        df_dq[1, 1] += fifth * r2 * (r2 + 4.0 * y * y)
    spiral, across = np.asarray(xi_s, dtype=np.float64), np.asarray(xi_u, dtype=np.float64)
    if np.any(across):
        f = f + across[..., None] * bracket * [1.0, -1.0]
        df_dq[0, 0] += 6.0 * across * x
        df_dq[0, 1] += 2.0 * across * y
        df_dq[1, 0] -= 2.0 * across * x
        df_dq[1, 1] -= 6.0 * across * y
    if np.any(spiral):
        f = f + spiral[..., None] * np.stack([-r2 * y, r2 * x], axis=1)
        df_dq[0, 0] -= 2.0 * spiral * x * y
        df_dq[0, 1] -= spiral * (x * x + 3.0 * y * y)
        df_dq[1, 0] += spiral * (3.0 * x * x + y * y)
        df_dq[1, 1] += 2.0 * spiral * x * y
    crossed, twisted = np.asarray(xi_v, dtype=np.float64), np.asarray(xi_w, dtype=np.float64)
    if np.any(crossed) or np.any(twisted):
        product = (2.0 * x * y)[:, None]
        f = f + crossed[..., None] * product + twisted[..., None] * product * [1.0, -1.0]
        of_x, of_y = 2.0 * (crossed + twisted), 2.0 * (crossed - twisted)
        df_dq[0, 0] += of_x * y
        df_dq[0, 1] += of_x * x
        df_dq[1, 0] += of_y * y
        df_dq[1, 1] += of_y * x
    df_dxi = np.empty((0 if points_only else len(LENS_NAMES), 2, len(q)))
    if not points_only:
        df_dxi[0] = growth * r2 * q.T
        df_dxi[1] = bracket.T
        df_dxi[2, 0], df_dxi[2, 1] = -r2 * y, r2 * x
        df_dxi[3, 0], df_dxi[3, 1] = bracket[:, 0], -bracket[:, 1]
        df_dxi[4] = 2.0 * x * y
        df_dxi[5, 0], df_dxi[5, 1] = df_dxi[4, 0], -df_dxi[4, 1]
        df_dxi[6] = r2 * r2 * q.T
    return f, np.moveaxis(df_dq, -1, 0), np.moveaxis(df_dxi, (0, 1), (2, 1))


def undistort_normalised(q_d: Array, xi_r: float, *others: float) -> Undistortion:
    """Invert the distortion of (n, 2) normalised points, with coefficients in the order of :data:`LENS_NAMES`.

    The radial part alone has the closed inverse ``q_d / (1 + xi_r |q_d|^2)``, which starts Newton's
    method with the analytic Jacobian. Fails (``converged`` false, NaN) where the point has no ideal
    counterpart on the branch that contains the centre.
    """
    rd2 = np.sum(q_d * q_d, axis=1)
    branch = np.isfinite(rd2) & (1.0 + xi_r * rd2 > 0.0) & (xi_r * rd2 < 1.0)
    start = q_d / np.where(branch, 1.0 + xi_r * rd2, np.nan)[:, None]
    if not any(others):
        return Undistortion(start, branch, 0, np.where(branch, 0.0, np.nan))

    q = np.where(branch[:, None], start, np.nan)
    error = np.full(len(q), np.nan)
    done = np.zeros(len(q), dtype=bool)
    iterations = 0
    active = np.flatnonzero(branch)
    while active.size and iterations < LENS_STEPS_MAX:
        iterations += 1
        f, jacobian, _ = distort_jacobians(q[active], xi_r, *others, points_only=True)
        residual = q_d[active] - f
        determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
        # Past the fold of the map (determinant <= 0) the root would be on the wrong sheet.
        good = np.isfinite(determinant) & (determinant > 0.0)
        step = np.empty_like(residual)
        safe = np.where(good, determinant, np.nan)
        step[:, 0] = (
            jacobian[:, 1, 1] * residual[:, 0] - jacobian[:, 0, 1] * residual[:, 1]
        ) / safe
        step[:, 1] = (
            jacobian[:, 0, 0] * residual[:, 1] - jacobian[:, 1, 0] * residual[:, 0]
        ) / safe
        error[active] = np.hypot(residual[:, 0], residual[:, 1])
        q[active] = q[active] + step
        size = np.hypot(step[:, 0], step[:, 1])
        reached = good & (size <= LENS_TOLERANCE * (1.0 + np.hypot(q[active, 0], q[active, 1])))
        done[active[reached]] = True
        active = active[good & ~reached & np.isfinite(size)]
    # Rounding may keep the last step just above the tolerance; a point that maps back is converged.
    done |= error <= 1e-12
    q[~done] = np.nan
    return Undistortion(q, done, iterations, error)
