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

"""Map every pixel of a raw frame to the specimen plane, and describe the cantilever's axis there.

Edges are measured in the raw pixels, whose noise is independent; their positions are corrected for
distortion and drift afterwards. So no grey level is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from semcal_ros.applications.cantilever.thresholds import NODE_DEGREE, NODE_SPACING_PX
from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.raw_positions import RasterDrift


@dataclass(frozen=True)
class Axis:
    """The cantilever at rest, in the sem frame.

    Attributes
    ----------
    origin_m
        (2,) point of the centre line from which arc lengths are measured: the base, if it is in
        view.
    direction
        (2,) unit vector towards the free end.
    half_width_m
        Half the width of the beam.
    visible_m
        First and last arc length that is in view.
    base_seen, end_seen
        Whether base and free end are in view.
    """

    origin_m: Array
    direction: Array
    half_width_m: float
    visible_m: tuple[float, float]
    base_seen: bool
    end_seen: bool

    @property
    def normal(self) -> Array:
        """(2,) unit vector of positive deflections: to the right as seen from the base."""
        return np.array([-self.direction[1], self.direction[0]])

    def coordinates(self, x_m: Array, y_m: Array) -> tuple[Array, Array]:
        """Convert points in the sem frame to coordinates along and across the axis, m."""
        x, y = x_m - self.origin_m[0], y_m - self.origin_m[1]
        along = x * self.direction[0] + y * self.direction[1]
        across = y * self.direction[0] - x * self.direction[1]
        return along, across

    def point(self, along_m: Array, across_m: Array) -> Array:
        """Convert coordinates to (n, 2) points in the sem frame; inverse of :meth:`coordinates`."""
        along, across = np.asarray(along_m), np.asarray(across_m)
        return np.asarray(
            self.origin_m + along[:, None] * self.direction + across[:, None] * self.normal
        )


class PlaneMap:
    """Sem-frame coordinates of the raw pixels of a frame, and when each is scanned.

    Parameters
    ----------
    camera
        Camera at the size of the frames.
    timing
        Raster timing; None treats each frame as an instant.

    Raises
    ------
    InvalidValueError
        If the camera's distortion has no inverse somewhere in the frame.
    """

    def __init__(self, camera: ScanCamera, timing: ScanTiming | None) -> None:
        self.camera, self.timing = camera, timing
        width, height = camera.width, camera.height
        cols, rows = _place_nodes(width), _place_nodes(height)
        xy = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2)
        ideal = camera.undistort(xy)
        if not np.all(np.isfinite(ideal)):
            raise InvalidValueError(
                f"a distortion at magnification {camera.magnification:g} without an inverse",
                expected="a calibration that holds over the whole field",
                do="calibrate again",
            )
        sem = camera.sem_from_ideal(ideal).reshape(len(rows), len(cols), 3)
        self.x_m, self.y_m = (_upsample(rows, cols, sem[..., k], (height, width)) for k in (0, 1))
        self.since_s, self.square_s2 = _compute_times(width, height, timing)

    @property
    def pixel_m(self) -> float:
        """Mean size of an ideal pixel."""
        x, y = self.camera.pixel_size_m
        return float(np.sqrt(x * y))

    def sem_of(self, xy_px: Array) -> Array:
        """Convert raw pixels (n, 2) to sem-frame points (n, 2), without drift."""
        return self.camera.sem_from_ideal(self.camera.undistort(xy_px))[:, :2]

    def raw_of(self, xy_m: Array) -> Array:
        """Convert sem-frame points (n, 2) to raw pixels (n, 2), without drift."""
        return self.camera.project(np.column_stack([xy_m, np.zeros(len(xy_m))]))

    def specimen(self, pixels: Indices, drift: RasterDrift) -> tuple[Array, Array]:
        """Return the specimen coordinates of pixels (flat indices), with the drift removed."""
        since = self.since_s.ravel()[pixels]
        square = self.square_s2.ravel()[pixels]
        x_moved, y_moved = evaluate_drift(drift, since, square)
        return self.x_m.ravel()[pixels] - x_moved, self.y_m.ravel()[pixels] - y_moved


def evaluate_drift(drift: RasterDrift, since_s: Array, square_s2: Array) -> tuple[Array, Array]:
    """Evaluate the drift along x and y at times after the centre of the acquisition, whose mean
    squares over the passes are ``square_s2``.
    """
    position, velocity, turn = drift.position, drift.velocity, drift.acceleration
    return (
        position[0] + velocity[0] * since_s + 0.5 * turn[0] * square_s2,
        position[1] + velocity[1] * since_s + 0.5 * turn[1] * square_s2,
    )


def _compute_times(width: int, height: int, timing: ScanTiming | None) -> tuple[Array, Array]:
    """Compute times after the centre of the acquisition and their mean squares, (h, w) each."""
    if timing is None:
        return np.zeros((height, width)), np.zeros((height, width))
    rows, cols = np.arange(height)[:, None], np.arange(width)[None, :]
    since = timing.pixel_offset_s(rows, cols, height, width) - timing.centre_offset_s
    return since, since**2 + timing.pass_variance_s2


def _place_nodes(pixels: int) -> Array:
    return np.linspace(0.0, pixels - 1.0, max(2 * NODE_DEGREE, round(pixels / NODE_SPACING_PX) + 1))


def _upsample(rows: Array, cols: Array, values: Array, shape: tuple[int, int]) -> Array:
    spline = RectBivariateSpline(rows, cols, values, kx=NODE_DEGREE, ky=NODE_DEGREE)
    return np.asarray(spline(np.arange(shape[0]), np.arange(shape[1])), dtype=np.float64)
