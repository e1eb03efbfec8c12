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

"""One frame of the virtual SEM."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Image
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import NO_DRIFT, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.pose import Pose
from semcal_ros.synthetic.specimens.grid import Specimen, UnevenSpecimen
from semcal_ros.synthetic.specimens.ray_lattice import PlaneLattice, trace_ray_lattice
from semcal_ros.synthetic.thresholds import BLOCK_ROWS, PASS_SAMPLES, PASS_SPACING_PX

_DEFAULT_DETECTOR = Detector()


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
