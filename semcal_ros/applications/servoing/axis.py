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

"""Estimate where the optical axis is in the image, from changes of magnification.

The origin of the sem frame lies on the axis, and the axis is the one point that stays in place in
the image when the magnification changes. A calibration on tilted grids determines it from the
perspective alone, to some px. A target at rest while the magnification changes determines it to a
fraction of a px: seen through cameras whose principal points are both wrong by d px, the target
lies at ``X + d / m1``, then at ``X + d / m2``.
"""

from __future__ import annotations

import numpy as np

from semcal_ros.applications.servoing.plane_camera import PlaneCamera
from semcal_ros.applications.servoing.thresholds import SAME_SCALE, SCALE_SIGMA
from semcal_ros.core.arrays import Array


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
