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

"""The camera of a frame as seen from the plane in which the stage moves, and where its optical axis is in the image.

The origin of the sem frame lies on the axis, and the axis is the one point that stays in place in
the image when the magnification changes. A calibration on tilted grids determines it from the
perspective alone, to some px. A target at rest while the magnification changes determines it to a
fraction of a px: seen through cameras whose principal points are both wrong by d px, the target
lies at ``X + d / m1``, then at ``X + d / m2``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.applications.servoing.thresholds import SAME_MATRIX, SAME_SCALE, SCALE_SIGMA
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera, as_points
from semcal_ros.core.errors import InvalidValueError

# Of the 12 elements of a projection, row by row, those that scale X and Y.
_SCALE = (0, 1, 4, 5)


@dataclass(frozen=True, eq=False)
class PlaneCamera:
    """Homography from the plane at one height of the sem frame to the pixels of ``image_rect``.

    Parameters
    ----------
    matrix
        (3, 3), homogeneous rectified pixel of (X, Y, 1) in m.
    scale_covariance
        (4, 4) covariance of the first two columns of its first two rows, row by row, px^2/m^2: how well the scale is
        known. None where that is not known.

    Raises
    ------
    InvalidValueError
        If the matrix is not finite or has no inverse.
    """

    matrix: Array
    scale_covariance: Array | None = None

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        good = matrix.shape == (3, 3) and bool(np.all(np.isfinite(matrix)))
        if not good or abs(float(np.linalg.det(matrix))) < 1e-12:
            raise InvalidValueError(
                f"a projection of the stage plane {matrix.tolist()}",
                expected="a finite (3, 3) matrix that can be inverted",
                do="calibrate, or wait for the camera of the frame",
            )
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def from_projection(
        cls, projection: ArrayLike, height_m: float = 0.0, covariance: ArrayLike | None = None
    ) -> PlaneCamera:
        """Create from P_g, the (3, 4) projection of points in m, and the height of the plane.

        ``covariance`` is the (12, 12) one of P_g, row by row; the part of the scale is used.
        """
        p = np.asarray(projection, dtype=np.float64)
        if p.shape != (3, 4):
            raise InvalidValueError(f"a projection of shape {p.shape}", expected="(3, 4)")
        matrix = np.column_stack([p[:, 0], p[:, 1], p[:, 2] * height_m + p[:, 3]])
        if covariance is None:
            return cls(matrix)
        full = np.asarray(covariance, dtype=np.float64)
        if full.shape != (12, 12) or not np.all(np.isfinite(full)):
            raise InvalidValueError(
                f"a covariance of a projection of shape {full.shape}", expected="(12, 12), finite"
            )
        return cls(matrix, full[np.ix_(_SCALE, _SCALE)])

    @classmethod
    def from_camera(cls, camera: ScanCamera, height_m: float = 0.0) -> PlaneCamera:
        """Create from a camera, for images that were rectified with it."""
        rectified = camera.rectified
        known = None if rectified.covariance is None else rectified.P_affine_covariance
        return cls.from_projection(rectified.P_affine, height_m, known)

    def project(self, xy_m: ArrayLike) -> Array:
        """Project points (n, 2) of the plane, m, to rectified pixels (n, 2)."""
        points = as_points(xy_m, 2)
        image = np.column_stack([points, np.ones(len(points))]) @ self.matrix.T
        pixels: Array = image[:, :2] / image[:, 2:]
        return pixels

    def plane_from_px(self, xy: ArrayLike) -> Array:
        """Return the points (n, 2) of the plane, m, that are seen at rectified pixels (n, 2)."""
        pixels = as_points(xy, 2)
        rays = np.linalg.solve(self.matrix, np.column_stack([pixels, np.ones(len(pixels))]).T).T
        points: Array = rays[:, :2] / rays[:, 2:]
        return points

    def jacobian(self, xy_m: ArrayLike) -> Array:
        """Compute the derivative (n, 2, 2) of :meth:`project`, px per m."""
        points = as_points(xy_m, 2)
        image = np.column_stack([points, np.ones(len(points))]) @ self.matrix.T
        pixels = image[:, :2] / image[:, 2:]
        linear, last = self.matrix[:2, :2], self.matrix[2, :2]
        slope: Array = linear[None] - pixels[:, :, None] * last[None, None, :]
        return slope / image[:, 2][:, None, None]

    def scale_spread(self, xy_m: ArrayLike) -> Array:
        """Compute the (2, 2) covariance, m^2, of a point (2,) of the plane that is seen at its pixel, by the scale.

        It is zero at the optical axis, and where nothing is known of the scale.
        """
        x, y = np.asarray(xy_m, dtype=np.float64)
        if self.scale_covariance is None:
            return np.zeros((2, 2))
        by = np.linalg.solve(self.matrix[:2, :2], [[x, y, 0.0, 0.0], [0.0, 0.0, x, y]])
        spread: Array = by @ self.scale_covariance @ by.T
        return spread

    def is_same(self, other: PlaneCamera | None) -> bool:
        """Return whether another camera is the same, up to rounding."""
        return other is not None and bool(
            np.allclose(self.matrix, other.matrix, rtol=1e-6, atol=1e-12)
        )


def choose_projection(k: ArrayLike, projections: Iterable[ArrayLike]) -> Array:
    """Choose the P_g (3, 4) of a frame, given its K, among those that may be its own.

    K belongs to the frame, by its stamp, but holds only f = m / rho: without the distance 1 / rho
    of the pivot it has no metric scale. P_g has both, but not always a stamp. For one camera its
    first three columns are rho K, which identifies the P_g of the frame.

    A parallel projection (rho = 0) has no K, and neither has a frame without calibration. The
    latest P_g is then used if it is parallel itself; the size of the target has to confirm that it
    is of the frame's magnification (see
    :attr:`~semcal_ros.applications.servoing.law.ServoSettings.scale_tolerance`).

    Parameters
    ----------
    k
        (3, 3) K of the frame's camera_info, zero if there is none.
    projections
        (3, 4) matrices with the last row ``[0 0 rho 1]``, the oldest first.

    Raises
    ------
    InvalidValueError
        No projection belongs to this frame, or the frame has no camera.
    """
    of_frame = np.asarray(k, dtype=np.float64).reshape(3, 3)
    known = [np.asarray(p, dtype=np.float64).reshape(3, 4) for p in projections]
    if not np.all(np.isfinite(of_frame)):
        raise InvalidValueError("a K that is not finite", expected="finite numbers")
    if not np.any(of_frame):
        if known and known[-1][2, 2] == 0.0 and known[-1][2, 3] != 0.0:
            return known[-1]
        raise InvalidValueError(
            "a frame without a camera",
            expected="a calibrated frame",
            do="calibrate the stream",
        )
    for matrix in reversed(known):
        expected = matrix[2, 2] * of_frame
        if np.allclose(
            matrix[:, :3], expected, rtol=SAME_MATRIX, atol=SAME_MATRIX * abs(matrix[2, 2])
        ):
            return matrix
    raise InvalidValueError(
        f"none of the latest {len(known)} projections has the magnification of this frame",
        expected="one whose first columns are rho times K of the frame",
        do="start parameter_server with the same calibration",
    )


class AxisObserver:
    """Kalman filter of the offset of the axis in the image, common to all magnifications.

    Parameters
    ----------
    sigma_px
        1-sigma of the principal point of the given cameras; 0 disables the correction.
    change_px
        1-sigma by which it moves from one magnification to the next.
    """

    def __init__(self, sigma_px: float, change_px: float) -> None:
        self._start, self._change = sigma_px**2, change_px**2
        self.restart()

    def restart(self) -> None:
        """Reset the estimate."""
        self.offset_px: Array = np.zeros(2)
        self.covariance: Array = self._start * np.eye(2)

    @property
    def sigma_px(self) -> float:
        """1-sigma in the worst direction, px."""
        return float(np.sqrt(max(float(np.linalg.eigvalsh(self.covariance)[-1]), 0.0)))

    def correct(self, camera: PlaneCamera) -> PlaneCamera:
        """Return the camera with its axis moved to the estimated position."""
        if not np.any(self.offset_px):
            return camera
        shift = np.eye(3)
        shift[:2, 2] = self.offset_px
        return PlaneCamera(shift @ camera.matrix, camera.scale_covariance)

    def update(
        self,
        before: PlaneCamera,
        after: PlaneCamera,
        place_m: Array,
        surprise_m: Array,
        covariance_m2: Array,
    ) -> bool:
        """Update the offset with a target seen after a change of camera; True if it was used.

        Parameters
        ----------
        before, after
            Both cameras.
        place_m
            (2,) position of the target.
        surprise_m, covariance_m2
            (2,) position seen through ``after`` minus that expected from ``before``, and its (2, 2)
            covariance.
        """
        if self._start == 0.0:
            return False
        m_from_px = [np.linalg.inv(camera.jacobian(place_m[None])[0]) for camera in (before, after)]
        scale = np.sqrt(abs(np.linalg.det(m_from_px[0]) / np.linalg.det(m_from_px[1])))
        if abs(float(scale) - 1.0) < SAME_SCALE:
            self.restart()
            return False
        slope = m_from_px[1] - m_from_px[0]
        self.covariance = self.covariance + self._change * np.eye(2)
        noise = covariance_m2 + (SCALE_SIGMA * float(np.hypot(*place_m))) ** 2 * np.eye(2)
        spread = slope @ self.covariance @ slope.T + noise
        gain = np.linalg.solve(spread, slope @ self.covariance).T
        self.offset_px = self.offset_px + gain @ surprise_m
        rest = np.eye(2) - gain @ slope
        self.covariance = rest @ self.covariance @ rest.T + gain @ noise @ gain.T
        return True
