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

"""Whether a body is a ball: smooth departures of its points from the fitted sphere.

Two departures are looked for. An *ellipsoid* leaves a quadric, five spherical harmonics of degree 2. A *bump*
or a dent leaves a mean that is not zero in a window. Each is divided by its own covariance, in which the errors
of the poses matter most: an error of the turns stretches all depths alike, which looks like an
ellipsoid. What the points scatter beyond their own uncertainty is added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.special import chdtrc, ndtr

from semcal_ros.applications.reconstruction.reconstruct import Structure
from semcal_ros.applications.reconstruction.sphere import SphereFit
from semcal_ros.applications.reconstruction.thresholds import (
    BUMP_POINTS_MIN,
    BUMP_RAD,
    FREEDOM_MIN,
    HEIGHT_SIGMAS,
    NECK_RAD,
    OFF_SPHERE,
    ROBUST_ROUNDS,
    ROUNDNESS_FALSE_ALARMS,
)
from semcal_ros.core.arrays import TUKEY_CONSTANT, Array, Mask, mad_sigma


@dataclass(frozen=True, eq=False)
class Roundness:
    """The largest smooth departure from a sphere.

    Attributes
    ----------
    is_ball
        False if noise alone leaves so large a departure less than once in 200 balls.
    probability
        That a true ball shows a departure as significant as this one.
    kind
        ``"ellipsoid"`` or ``"bump"`` (also of a dent), whichever is more significant.
    height_m, height_sigma_m
        Height of the departure where it is largest: over the sphere for a bump, negative for a dent; highest over
        lowest place for an ellipsoid. And its 1-sigma.
    towards
        (3,) unit vector from the centre to its place (of an ellipsoid: to the highest), in the axes of the sem
        frame in the reference view: z is along the beam, away from the gun.
    points
        Number of points examined.
    """

    is_ball: bool
    probability: float
    kind: str
    height_m: float
    height_sigma_m: float
    towards: Array
    points: int


def measure_roundness(structure: Structure, sphere: SphereFit, sharing: float) -> Roundness:
    """Look for the most significant smooth departure of a structure from a sphere.

    Parameters
    ----------
    structure, sphere
        The points and the sphere fitted to them.
    sharing
        Number of points that share the noise of a patch.
    """
    offset = structure.points_m - sphere.centre_m
    length = np.linalg.norm(offset, axis=1)
    outward = offset / length[:, None]
    height = length - sphere.radius_m
    on = _find_body(outward, height / sphere.radius_m)
    fit = _SphereResiduals(structure, outward, height, on, sphere, sharing)
    ellipsoid, bump = fit.find_ellipsoid(), fit.find_bump()
    best = min((ellipsoid, bump), key=lambda found: found[0])
    kind = "ellipsoid" if best is ellipsoid else "bump"
    probability = min(1.0, 2.0 * best[0])
    view = structure.adjustment.rotations[structure.adjustment.reference]
    return Roundness(
        probability > ROUNDNESS_FALSE_ALARMS,
        probability,
        kind,
        best[1],
        best[2],
        view @ best[3],
        int(np.count_nonzero(on)),
    )


def _find_body(outward: Array, height: Array) -> Mask:
    """Find the points of the body without what holds it."""
    far = height > OFF_SPHERE
    on = np.abs(height) <= OFF_SPHERE
    if far.any():
        on &= (outward @ outward[far].T).max(axis=1) < np.cos(NECK_RAD)
    return np.asarray(on, dtype=bool)


class _SphereResiduals:
    """Heights over the sphere and the covariance of linear functions of them."""

    def __init__(
        self,
        structure: Structure,
        outward: Array,
        height: Array,
        on: Mask,
        sphere: SphereFit,
        sharing: float,
    ) -> None:
        self.index = np.flatnonzero(on)
        self.adjustment, self.sharing = structure.adjustment, sharing
        self.total = len(outward)
        self.out, self.height = outward[on], height[on]
        self.inside = sphere.inliers[on]
        self.own = structure.normal_sigma_m[on]
        # (n, 4) the change of a height with the centre and the radius.
        self.frame = np.column_stack([self.out, np.ones(len(self.out))])
        rough = mad_sigma(self.height[self.inside]) ** 2 - float(np.median(self.own**2))
        self.rough = max(rough, 0.0)

    def covariance(self, rows: Array) -> Array:
        """Covariance of (k, n) linear functions of the heights, m^2."""
        gradients = np.zeros((len(rows), self.total, 3))
        gradients[:, self.index] = rows[:, :, None] * self.out
        noise = self.adjustment.propagate_covariance(gradients)
        return np.asarray(self.sharing * (noise + self.rough * rows @ rows.T))

    def fit(self, design: Array) -> tuple[Array, Array]:
        """Fit (n, k) functions to the heights robustly: (k,) solution and the (k, n) rows that give it.

        A point is judged by its distance from the fit without it: at the rim of what is seen, one wrong point bends a
        quadric so far that it leaves little residual itself.
        """
        weight = np.ones(len(self.height))
        for turn in range(2 * ROBUST_ROUNDS):
            if turn > ROBUST_ROUNDS and np.count_nonzero(weight) < 2 * design.shape[1]:
                break
            rows = np.linalg.solve((design * weight[:, None]).T @ design, design.T * weight)
            leverage = np.einsum("nk,kn->n", design, rows)
            error = np.abs(self.height - design @ (rows @ self.height))
            error /= np.maximum(1.0 - leverage, FREEDOM_MIN)
            scale = max(mad_sigma(error), 1e-15)
            if turn < ROBUST_ROUNDS:
                limit = HEIGHT_SIGMAS * scale
                weight = limit / np.maximum(error, limit)
            else:
                # What is far off by then counts for nothing.
                limit = TUKEY_CONSTANT * scale
                weight = np.maximum(1.0 - (error / limit) ** 2, 0.0) ** 2
        solution = np.asarray(rows @ self.height, dtype=np.float64)
        return solution, np.asarray(rows, dtype=np.float64)

    def find_ellipsoid(self) -> tuple[float, float, float, Array]:
        """Probability, height, its 1-sigma and place of a quadric."""
        design = np.column_stack([self.frame, _quadrics(self.out)])
        solution, rows = self.fit(design)
        quadric, rows = solution[4:], rows[4:]
        covariance = self.covariance(rows)
        chi2 = float(quadric @ np.linalg.solve(covariance, quadric))
        # What a sphere leaves of the quadric, over the part of the surface that is seen.
        shape = (
            _quadrics(self.out)
            - self.frame @ np.linalg.lstsq(self.frame, _quadrics(self.out), rcond=None)[0]
        )
        departure = shape @ quadric
        high, low = int(np.argmax(departure)), int(np.argmin(departure))
        span = shape[high] - shape[low]
        sigma = float(np.sqrt(span @ covariance @ span))
        return float(chdtrc(5, chi2)), float(span @ quadric), sigma, self.out[high]

    def find_bump(self) -> tuple[float, float, float, Array]:
        """Probability, height, its 1-sigma and place of the most significant window."""
        centres = _thin(self.out, BUMP_RAD)
        squared = 2.0 - 2.0 * self.out[centres] @ self.out.T
        weight = np.exp(-0.5 * squared / BUMP_RAD**2)
        full = weight.sum(axis=1) >= BUMP_POINTS_MIN
        if not full.any():
            return 1.0, 0.0, 0.0, self.out[0]
        centres, weight = centres[full], weight[full]
        # Single wrong points must not make a bump: each counts by its distance from the others' median.
        clipped = np.array([self._clip(w) for w in weight])
        rows = weight / weight.sum(axis=1, keepdims=True)
        mean = np.sum(rows * clipped, axis=1)
        # The sphere follows the points: what a window leaves is less than what the points are off.
        inside = np.where(self.inside[:, None], self.frame, 0.0)
        hat = np.linalg.solve(inside.T @ self.frame, inside.T)
        rows = rows - rows @ self.frame @ hat
        sigma = np.sqrt(np.diag(self.covariance(rows)))
        z = mean / sigma
        best = int(np.argmax(np.abs(z)))
        # The windows are as many trials.
        probability = min(1.0, 2.0 * len(z) * float(ndtr(-abs(z[best]))))
        return probability, *self._fit_peak(self.out[centres[best]], float(mean[best]))

    def _fit_peak(self, start: Array, mean: float) -> tuple[float, float, Array]:
        """Fit a Gaussian bump beside the sphere: its height, 1-sigma and place."""
        sides = np.linalg.svd(start[None])[2][1:]
        unit = max(mad_sigma(self.height), 1e-15)

        def bump(x: Array) -> tuple[Array, Array]:
            towards = start + x[:2] @ sides
            towards = towards / np.linalg.norm(towards)
            return towards, np.exp(-(1.0 - self.out @ towards) / np.exp(2.0 * x[2]))

        def error(x: Array) -> Array:
            left = self.height / unit - self.frame @ x[4:] - x[3] * bump(x)[1]
            return np.asarray(left, dtype=np.float64)

        # The mean in a window as wide as the bump is half of its height. It lies where the window found it,
        # up to its width, and is no narrower than half of the window and no wider than a radian.
        first = np.array([0.0, 0.0, np.log(BUMP_RAD), 2.0 * mean / unit, 0.0, 0.0, 0.0, 0.0])
        reach = np.array([BUMP_RAD, BUMP_RAD, np.inf, np.inf, np.inf, np.inf, np.inf, np.inf])
        low, high = first - reach, first + reach
        low[2], high[2] = np.log(0.5 * BUMP_RAD), 0.0
        found = least_squares(error, first, bounds=(low, high), loss="soft_l1").x
        towards, form = bump(found)
        design = np.column_stack([self.frame, form])
        rows = np.linalg.lstsq(design, np.eye(len(form)), rcond=None)[0][4:]
        sigma = float(np.sqrt(self.covariance(rows)[0, 0]))
        return float(found[3] * unit), sigma, towards

    def _clip(self, weight: Array) -> Array:
        near = weight > np.exp(-2.0)
        middle = float(np.median(self.height[near]))
        limit = HEIGHT_SIGMAS * max(mad_sigma(self.height[near]), np.sqrt(self.rough), 1e-15)
        return np.asarray(np.clip(self.height, middle - limit, middle + limit))


def _quadrics(out: Array) -> Array:
    """(n, 5) harmonics of degree 2 of unit vectors (n, 3)."""
    x, y, z = out.T
    return np.stack([x * y, y * z, z * x, x * x - y * y, 3.0 * z * z - 1.0], axis=1)


def _thin(out: Array, angle_rad: float) -> Array:
    """Indices of directions that are at least so far apart."""
    left = np.ones(len(out), dtype=bool)
    chosen = []
    for k in range(len(out)):
        if left[k]:
            chosen.append(k)
            left &= out @ out[k] < np.cos(angle_rad)
    return np.array(chosen, dtype=np.intp)
