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

"""One frame of the virtual SEM, and the point of the specimen that every sample of it shows.

Undistortion is smooth, so it is computed at the nodes of a coarse lattice and interpolated to every line
of samples by a quintic spline. The specimen plane and the drift are met exactly at every line, at
the nodes along it; a second spline gives the samples in between, at the cost of one matrix product
per coordinate. The splines are wrong by less than 1e-8 px where the camera model is the whole
truth, and by 0.002 px where a preset lets the beam settle within 20 px.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from semcal_ros.core.arrays import Array, Image
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import NO_DRIFT, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.pose import Pose
from semcal_ros.synthetic.specimens.grid import Specimen, UnevenSpecimen
from semcal_ros.synthetic.thresholds import (
    BLOCK_ROWS,
    INTERVALS_MAX,
    NODE_DEGREE,
    NODE_SPACING_PX,
    PASS_SAMPLES,
    PASS_SPACING_PX,
)

_DEFAULT_DETECTOR = Detector()


@dataclass(frozen=True, eq=False)
class RayLattice:
    """Rays of the samples of a frame at one magnification.

    Attributes
    ----------
    camera
        True camera.
    supersampling, pad
        Samples per pixel and direction; border in px that is rendered beyond the frame.
    lines
        (n_rows * supersampling,) row coordinate of every line of samples, px.
    nodes
        (n_nodes,) column coordinate of the nodes, px.
    x_m, y_m
        (lines, nodes) where the ray meets the reference plane Z = 0, m.
    basis
        (nodes, n_cols * supersampling) values at the nodes -> values at the samples.
    """

    camera: ScanCamera
    supersampling: int
    pad: int
    lines: Array
    nodes: Array
    x_m: Array
    y_m: Array
    basis: Array

    def meet(self, pose: Pose) -> PlaneLattice:
        """Intersect the rays with the specimen plane.

        With w = 1 + rho Z, a ray is X = x w, Y = y w; the plane is X = R s + t.

        Raises
        ------
        InvalidValueError
            If some ray does not meet the plane in front of the scan pivot.
        """
        rho, r, t = self.camera.rho, pose.R, pose.t_m
        a = r[0, 0] - self.x_m * (rho * r[2, 0])
        b = r[0, 1] - self.x_m * (rho * r[2, 1])
        c = r[1, 0] - self.y_m * (rho * r[2, 0])
        d = r[1, 1] - self.y_m * (rho * r[2, 1])
        determinant = a * d - b * c
        w_origin = 1.0 + rho * t[2]
        right_x, right_y = self.x_m * w_origin - t[0], self.y_m * w_origin - t[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.stack([d, -b, -c, a]) / determinant
            u = inverse[0] * right_x + inverse[1] * right_y
            v = inverse[2] * right_x + inverse[3] * right_y
            w = w_origin + rho * (r[2, 0] * u + r[2, 1] * v)
            visible = bool(np.all(w > 0.0))
        if not visible or float(np.abs(determinant).min()) < 1e-3:
            raise InvalidValueError(
                f"specimen plane tilted by {np.degrees(pose.tilt_rad):.1f} degrees",
                expected="a plane that every pixel's ray meets in front of the scan pivot",
                do="tilt it less",
            )
        over_x = r[0, 2] - self.x_m * (rho * r[2, 2])
        over_y = r[1, 2] - self.y_m * (rho * r[2, 2])
        lift = -np.stack(
            [inverse[0] * over_x + inverse[1] * over_y, inverse[2] * over_x + inverse[3] * over_y]
        )
        return PlaneLattice(self, u, v, inverse, lift)


@dataclass(frozen=True, eq=False)
class PlaneLattice:
    """Specimen coordinates at the nodes.

    Attributes
    ----------
    rays
        The rays.
    u_m, v_m
        (lines, nodes) specimen coordinates without drift, m.
    inverse
        (4, lines, nodes) by how much a displacement (X, Y) of the specimen lowers them:
        -[du/dX, du/dY, dv/dX, dv/dY].
    lift
        (2, lines, nodes) by how much (u, v) of a ray change per height above the plane, along its normal.
    """

    rays: RayLattice
    u_m: Array
    v_m: Array
    inverse: Array
    lift: Array

    def footprint_m(self) -> Array:
        """(2, 2) derivative of specimen (x, y) by one sample along columns and rows, mid-frame."""
        rays = self.rays
        line, node = len(rays.lines) // 2, len(rays.nodes) // 2
        per_sample = (rays.nodes[1] - rays.nodes[0]) * rays.supersampling
        grid = (self.u_m, self.v_m)
        return np.array(
            [
                [
                    (g[line, node + 1] - g[line, node]) / per_sample,
                    g[line + 1, node] - g[line, node],
                ]
                for g in grid
            ]
        )

    def displaced(self, left_m: Array, right_m: Array) -> tuple[Array, Array]:
        """Return the specimen coordinates at the nodes of a specimen displaced during its scan.

        Parameters
        ----------
        left_m, right_m
            (lines, 2) displacement when the beam is at the first and at the last node of each line;
            linear in between.
        """
        span = self.rays.nodes[-1] - self.rays.nodes[0]
        along = (self.rays.nodes - self.rays.nodes[0]) / span
        drift = left_m[:, None, :] + (right_m - left_m)[:, None, :] * along[None, :, None]
        u = self.u_m - self.inverse[0] * drift[..., 0] - self.inverse[1] * drift[..., 1]
        v = self.v_m - self.inverse[2] * drift[..., 0] - self.inverse[3] * drift[..., 1]
        return u, v

    def line_times_s(self, timing: ScanTiming) -> tuple[Array, Array]:
        """Mean times over the passes, after the stamp, at both ends of every line of samples."""
        rays = self.rays
        # All samples of one pixel row belong to the same scan line.
        rows = np.rint(rays.lines)
        size = (rays.camera.height, rays.camera.width)
        left = timing.pixel_offset_s(rows, rays.nodes[0], *size)
        right = timing.pixel_offset_s(rows, rays.nodes[-1], *size)
        return left, right

    def blocks(self, u_m: Array, v_m: Array, rows: int) -> Iterator[tuple[slice, Array, Array]]:
        """Specimen coordinates of all samples, a few pixel rows at a time for the CPU's cache."""
        step = rows * self.rays.supersampling
        for start in range(0, len(self.rays.lines), step):
            part = slice(start, min(start + step, len(self.rays.lines)))
            yield part, u_m[part] @ self.rays.basis, v_m[part] @ self.rays.basis


@lru_cache(maxsize=4)
def trace_ray_lattice(
    microscope: VirtualMicroscope, magnification: float, supersampling: int, pad: int
) -> RayLattice:
    """Trace the rays of a frame; cached for the last few magnifications.

    Raises
    ------
    InvalidValueError
        If the distortion has no inverse somewhere in the frame.
    """
    camera = microscope.camera_at(magnification)
    lines = _place_samples(microscope.height, supersampling, pad)
    cols = _place_samples(microscope.width, supersampling, pad)
    nodes = _place_nodes(microscope.width, pad)
    line_nodes = _place_nodes(microscope.height, pad)
    raw = np.stack(np.meshgrid(nodes, line_nodes), axis=-1).reshape(-1, 2)
    ideal = microscope.undistort(magnification, raw)
    if not np.all(np.isfinite(ideal)):
        raise InvalidValueError(
            f"distortion of microscope '{microscope.name}' at magnification {magnification}",
            expected="a distortion with an inverse everywhere in the frame",
            do="use a weaker xi_r or xi_t",
        )
    sem = camera.sem_from_ideal(ideal).reshape(len(line_nodes), len(nodes), 3)
    down = _make_spline_basis(line_nodes, lines).T
    return RayLattice(
        camera,
        supersampling,
        pad,
        lines,
        nodes,
        down @ sem[..., 0],
        down @ sem[..., 1],
        _make_spline_basis(nodes, cols),
    )


def _place_nodes(pixels: int, pad: int) -> Array:
    """Place nodes over an image side, pad included."""
    first, last = -0.5 - pad, pixels - 0.5 + pad
    spacing = max(NODE_SPACING_PX, pixels / INTERVALS_MAX)
    return np.linspace(first, last, max(2 * NODE_DEGREE, round((last - first) / spacing) + 1))


def _make_spline_basis(nodes: Array, samples: Array) -> Array:
    """Return the (nodes, samples) matrix from values at the nodes to a spline's values at the samples."""
    spline = make_interp_spline(nodes, np.eye(len(nodes)), k=NODE_DEGREE)
    return np.ascontiguousarray(spline(samples).T)


def _place_samples(pixels: int, supersampling: int, pad: int) -> Array:
    index = np.arange((pixels + 2 * pad) * supersampling)
    samples: Array = (index + 0.5) / supersampling - 0.5 - pad
    return samples


def render_frame(
    microscope: VirtualMicroscope,
    specimen: Specimen,
    pose: Pose,
    magnification: float,
    *,
    start_time_s: float = 0.0,
    drift: DriftFunction = NO_DRIFT,
    seed: int | tuple[int, ...] = 0,
    detector: Detector = _DEFAULT_DETECTOR,
    supersampling: int | None = None,
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Render an image of a specimen, each pixel taken at its own time.

    Parameters
    ----------
    microscope
        Camera, image size and scan timing.
    specimen
        Reflectivity over its plane.
    pose
        The plane in the sem frame, without drift.
    magnification
        Magnification g.
    start_time_s
        Time of the first pixel of the first pass: the stamp of the frame.
    drift
        Displacement of the specimen (n, 2) in m at times (n,) in s.
    seed
        Seed of the noise.
    detector
        Image formation.
    supersampling
        Samples per pixel and direction; None takes the specimen's own.

    Returns
    -------
    (height + databar_rows, width) uint8 or uint16.

    Raises
    ------
    InvalidValueError
        If the magnification is not positive, or a ray does not meet the specimen plane.
    """
    reflectivity = render_reflectivity(
        microscope,
        specimen,
        pose,
        magnification,
        start_time_s=start_time_s,
        drift=drift,
        pad=detector.pad_px,
        supersampling=supersampling,
    )
    return detector.expose(reflectivity, np.random.default_rng(seed))


def render_reflectivity(
    microscope: VirtualMicroscope,
    specimen: Specimen,
    pose: Pose,
    magnification: float,
    *,
    start_time_s: float = 0.0,
    drift: DriftFunction = NO_DRIFT,
    pad: int = 0,
    supersampling: int | None = None,
) -> Image:
    """Reflectivity (height + 2 pad, width + 2 pad) averaged over each pixel and over the passes."""
    samples = specimen.supersampling if supersampling is None else supersampling
    lattice = trace_ray_lattice(microscope, float(magnification), samples, pad).meet(pose)
    groups = _pass_groups(microscope, magnification, start_time_s, drift)
    left_s, right_s = lattice.line_times_s(microscope.timing)
    total = np.zeros((microscope.height + 2 * pad, microscope.width + 2 * pad), dtype=np.float32)
    for offset_s, weight in groups:
        time_s = start_time_s + offset_s
        left_m, right_m = _at_lines(drift, time_s + left_s), _at_lines(drift, time_s + right_s)
        u, v = lattice.displaced(left_m, right_m)
        if isinstance(specimen, UnevenSpecimen):
            u, v = specimen.undeform(u, v, lattice.lift)
        _add_pass(total, weight, lattice, specimen, u, v)
    return total


def _at_lines(drift: DriftFunction, time_s: Array) -> Array:
    """Return the drift at every line of samples, evaluated once per distinct time."""
    distinct, where = np.unique(time_s, return_inverse=True)
    return np.asarray(drift(distinct), dtype=np.float64)[where.ravel()]


def _add_pass(
    total: Image, weight: float, lattice: PlaneLattice, specimen: Specimen, u: Array, v: Array
) -> None:
    samples = lattice.rays.supersampling
    footprint = lattice.footprint_m()
    for part, x, y in lattice.blocks(u, v, BLOCK_ROWS):
        fine = np.asarray(specimen.reflectivity(x, y, footprint), dtype=np.float32)
        rows = slice(part.start // samples, part.stop // samples)
        if samples == 1:
            total[rows] += weight * fine
            continue
        summed = fine[0::samples].copy()
        for line in range(1, samples):
            summed += fine[line::samples]
        pixels = summed[:, 0::samples].copy()
        for column in range(1, samples):
            pixels += summed[:, column::samples]
        total[rows] += (weight / samples**2) * pixels


def _pass_groups(
    microscope: VirtualMicroscope, magnification: float, start_time_s: float, drift: DriftFunction
) -> list[tuple[float, float]]:
    """(seconds from the mean of all passes, weight) of the groups of passes drawn as one."""
    timing: ScanTiming = microscope.timing
    passes = np.arange(timing.averages)
    # Several samples per pass: a vibration in step with the passes must not go unnoticed.
    samples = np.linspace(0.0, timing.averages, PASS_SAMPLES * timing.averages + 1)
    path_m = np.diff(np.asarray(drift(start_time_s + samples * timing.frame_time_s)), axis=0)
    m = microscope.camera_at(magnification).m
    path_px = m * float(np.hypot(path_m[:, 0], path_m[:, 1]).sum())
    count = min(timing.averages, 1 + math.floor(path_px / PASS_SPACING_PX))
    mean = 0.5 * (timing.averages - 1)
    return [
        (float(group.mean() - mean) * timing.frame_time_s, len(group) / timing.averages)
        for group in np.array_split(passes, count)
    ]
