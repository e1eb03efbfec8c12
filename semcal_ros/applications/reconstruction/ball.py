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

"""Diameter of a ball with a reliable interval, and its mesh.

Four errors add up. *Noise*: the fit to the adjusted points, with the errors of the poses.
Neighbouring patches share pixels, so the variance is multiplied by the number of points that share
one. It is also measured by leaving out groups of views in turn (jackknife), which counts where it is
larger than chance allows. *Shape*: what the points scatter about the sphere beyond their own
uncertainty. *Scale*: nm per pixel of the calibration, and the height of the ball above or below the
reference plane, which parallel projection does not show. *Patches*: what shading, blur and foreshortening
leave in their positions belongs to the look of the ball and is the same in all views, so that neither
residuals nor leaving out views show it. It differs from place to place, so that leaving out groups of
neighbouring patches in turn, with the poses adjusted again, does; what that shows beyond the shape is theirs.
An error that all patches of a ball share is not in the interval: it has been looked for on simulated balls only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri, stdtrit

from semcal_ros.applications.reconstruction.adjustment import adjust
from semcal_ros.applications.reconstruction.mesh import SurfaceMesh, triangulate_cloud
from semcal_ros.applications.reconstruction.moving_least_squares import (
    compute_spacing_m,
    fit_local_surface,
)
from semcal_ros.applications.reconstruction.reconstruct import Structure
from semcal_ros.applications.reconstruction.roundness import Roundness, measure_roundness
from semcal_ros.applications.reconstruction.sphere import SphereFit, fit_sphere
from semcal_ros.applications.reconstruction.thresholds import JACKKNIFE_FALSE_ALARMS, PATCH_GROUPS
from semcal_ros.applications.reconstruction.types import Observations
from semcal_ros.core.arrays import Array, Indices


@dataclass(frozen=True, eq=False)
class Ball:
    """A sphere in a structure.

    Attributes
    ----------
    sphere
        The fit to the points.
    mesh
        Triangles over its moving-least-squares surface, where the ball was seen.
    diameter_m
        Diameter, m.
    noise_sigma_m, shape_sigma_m, scale_sigma_m, patch_bias_sigma_m
        Parts of the 1-sigma of the diameter, see the module, m.
    interval_m
        95 % interval of the diameter, m.
    groups
        Number of groups of views in the jackknife.
    coverage
        Fraction of the sphere that the mesh covers.
    roundness
        Whether the body is a ball, and where it departs from one.
    """

    sphere: SphereFit
    mesh: SurfaceMesh
    diameter_m: float
    noise_sigma_m: float
    shape_sigma_m: float
    scale_sigma_m: float
    patch_bias_sigma_m: float
    interval_m: tuple[float, float]
    groups: int
    coverage: float
    roundness: Roundness

    @property
    def sigma_m(self) -> float:
        """1-sigma of the diameter, m."""
        parts = (
            self.noise_sigma_m,
            self.shape_sigma_m,
            self.scale_sigma_m,
            self.patch_bias_sigma_m,
        )
        return float(np.hypot.reduce(parts))


def measure_ball(
    structure: Structure,
    *,
    height_sigma_m: float = 10e-6,
    groups: int = 8,
    confidence: float = 0.95,
) -> Ball:
    """Fit a sphere to the largest round part of a structure, and mesh it.

    Parameters
    ----------
    structure
        The points; those that are not on the sphere (a tip that holds it) are left out.
    height_sigma_m
        1-sigma of the height of the ball about the reference plane of the calibration, m.
    groups
        Number of groups of views in the jackknife.
    confidence
        Confidence level of the interval.

    Raises
    ------
    StructureError
        If there is no sphere in the structure.
    """
    sphere = fit_sphere(structure.points_m, structure.normal_sigma_m)
    variance = structure.adjustment.propagate_variance(sphere.radius_gradient)
    sharing = _count_sharing(structure)
    noise = 2.0 * np.sqrt(variance * sharing)
    groups = min(groups, len(structure.cameras) // 4)
    freedom = np.inf
    if groups >= 3:
        measured = _leave_out_views(structure, sphere, groups)
        limit = float(chdtri(groups - 1, JACKKNIFE_FALSE_ALARMS)) / (groups - 1)
        if (measured / noise) ** 2 > limit:
            noise, freedom = measured, groups - 1.0
    shape = 2.0 * sphere.radius_sigma_m * np.sqrt(sharing * _compute_excess(structure, sphere))
    among, patch_groups = _leave_out_patches(structure, sphere)
    patches = float(np.sqrt(max(among**2 - shape**2, 0.0)))
    diameter = 2.0 * sphere.radius_m
    scale = diameter * _compute_scale_sigma(structure, height_sigma_m)
    total = float(np.hypot.reduce((noise, shape, scale, patches)))
    # Welch and Satterthwaite: only what is measured by leaving out has few degrees of freedom.
    unsure = noise**4 / freedom + (shape**2 + patches**2) ** 2 / (patch_groups - 1.0)
    degrees = min(total**4 / unsure, 1e6) if unsure > 0.0 else 1e6
    reach = float(stdtrit(degrees, 0.5 + 0.5 * confidence)) * total
    mesh = _mesh_ball(structure, sphere)
    return Ball(
        sphere=sphere,
        mesh=mesh,
        diameter_m=diameter,
        noise_sigma_m=float(noise),
        shape_sigma_m=float(shape),
        scale_sigma_m=scale,
        patch_bias_sigma_m=patches,
        interval_m=(diameter - reach, diameter + reach),
        groups=groups,
        coverage=_compute_coverage(mesh, sphere),
        roundness=measure_roundness(structure, sphere, sharing),
    )


def _compute_excess(structure: Structure, sphere: SphereFit) -> float:
    """Compute the part of the squared residuals that the points' own uncertainty does not explain."""
    expected = np.mean(structure.normal_sigma_m[sphere.inliers] ** 2)
    return float(np.clip(1.0 - expected / sphere.rms_m**2, 0.0, 1.0))


def _count_sharing(structure: Structure) -> float:
    """Count the points that share the noise of a patch; windows correlate as Gaussians do."""
    wide = 2.0 * structure.patch_sigma_m
    tree = cKDTree(structure.points_m)
    pairs = tree.sparse_distance_matrix(tree, 3.0 * wide, output_type="ndarray")
    return float(np.sum(np.exp(-((pairs["v"] / wide) ** 2))) / len(structure.points_m))


def _leave_out_views(structure: Structure, sphere: SphereFit, groups: int) -> float:
    """Estimate the 1-sigma of the diameter by leaving out each group of views once."""
    done, seen = structure.adjustment, structure.observations
    # Neighbouring views share little but their noise is independent: interleave.
    group = np.arange(len(structure.cameras)) % groups
    group[done.reference] = -1
    everything = np.arange(len(done.points_m))
    diameters = [
        _diameter_of(structure, sphere, seen.select(group[seen.view] != left_out), everything)
        for left_out in range(groups)
    ]
    return jackknife_sigma(diameters)


def _leave_out_patches(structure: Structure, sphere: SphereFit) -> tuple[float, int]:
    """Estimate the 1-sigma of the diameter by leaving out each group of neighbouring patches once; and their number."""
    inliers = np.flatnonzero(sphere.inliers)
    groups = int(np.clip(len(inliers) // 4, 2, PATCH_GROUPS))
    seen = structure.observations
    diameters = []
    for left_out in split_neighbours(structure.points_m[inliers], groups):
        keep = np.ones(len(structure.points_m), dtype=bool)
        keep[inliers[left_out]] = False
        part = seen.select(keep[seen.point])
        part = replace(part, point=(np.cumsum(keep) - 1)[part.point])
        diameters.append(_diameter_of(structure, sphere, part, np.flatnonzero(keep)))
    return jackknife_sigma(diameters), len(diameters)


def split_neighbours(points_m: Array, groups: int) -> list[Indices]:
    """Divide points into groups of neighbours: the largest group in half along its longest side, again and again."""
    parts = [np.arange(len(points_m))]
    while len(parts) < groups:
        part = parts.pop(int(np.argmax([len(one) for one in parts])))
        axis = int(np.argmax(np.ptp(points_m[part], axis=0)))
        part = part[np.argsort(points_m[part, axis], kind="stable")]
        parts += [part[: len(part) // 2], part[len(part) // 2 :]]
    return parts


def _diameter_of(
    structure: Structure, sphere: SphereFit, part: Observations, points: Indices
) -> float:
    """Return the diameter from some of the observations, of these points of the structure."""
    done = structure.adjustment
    fewer = adjust(
        part,
        structure.cameras,
        done.rotations,
        done.translations_m,
        done.points_m[points],
        reference=done.reference,
        max_iterations=4,
        tolerance=1e-5,
    )
    seen = np.bincount(part.point, minlength=len(points))
    use = np.flatnonzero(sphere.inliers[points] & (seen >= 3))
    sigma_m = structure.normal_sigma_m[points]
    return 2.0 * fit_sphere(fewer.points_m[use], sigma_m[use]).radius_m


def jackknife_sigma(values: list[float]) -> float:
    """Return the 1-sigma of an estimate from its values without one group each (Efron and Stein 1981)."""
    spread = np.array(values) - np.mean(values)
    return float(np.sqrt((len(values) - 1.0) / len(values) * np.sum(spread**2)))


def _compute_scale_sigma(structure: Structure, height_sigma_m: float) -> float:
    """Compute the relative 1-sigma of lengths, from pixel size and height."""
    camera = structure.cameras[structure.adjustment.reference]
    height = camera.rho * height_sigma_m
    if camera.covariance is None:
        return abs(height)
    sizes = zip(camera.pixel_size_sigma_m, camera.pixel_size_m, strict=True)
    return float(np.hypot(max(sigma / size for sigma, size in sizes), height))


def _mesh_ball(structure: Structure, sphere: SphereFit) -> SurfaceMesh:
    points = structure.points_m[sphere.inliers]
    radius = max(2.0 * compute_spacing_m(points), 0.12 * sphere.radius_m)
    surface = fit_local_surface(points, points, radius).orient(points - sphere.centre_m)
    return triangulate_cloud(surface.points_m, sphere.centre_m, surface.normals, surface.sigma_m)


def _compute_coverage(mesh: SurfaceMesh, sphere: SphereFit) -> float:
    """Compute the covered fraction of the full solid angle (van Oosterom and Strackee 1983)."""
    unit = mesh.vertices_m - sphere.centre_m
    unit = unit / np.linalg.norm(unit, axis=1)[:, None]
    a, b, c = (unit[mesh.faces[:, k]] for k in range(3))
    volume = np.abs(np.einsum("fi,fi->f", a, np.cross(b, c)))
    dots = (np.sum(p * q, axis=1) for p, q in ((a, b), (b, c), (c, a)))
    return float(np.sum(2.0 * np.arctan2(volume, 1.0 + sum(dots))) / (4.0 * np.pi))
