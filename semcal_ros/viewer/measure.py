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

"""Lengths between two places in a picture, with the uncertainty that the calibration leaves, and as texts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError

PICTURES = ("raw", "corrected")
"""The pictures in which can be measured."""
_UNITS = ((1e-6, "µm"), (1e-9, "nm"))


@dataclass(frozen=True)
class Distance:
    """The way from one place to another on the specimen, in the reference plane.

    Attributes
    ----------
    x_m, y_m
        Its components in the sem frame.
    calibration_sigma_m
        1-sigma of its length by the covariance of the calibration; None where the scale is nominal, and
        nobody knows how wrong it is.
    placing_sigma_m
        1-sigma of its length by placing two ends on whole pixels of the screen.
    """

    x_m: float
    y_m: float
    calibration_sigma_m: float | None
    placing_sigma_m: float

    @property
    def length_m(self) -> float:
        """The length."""
        return math.hypot(self.x_m, self.y_m)

    @property
    def sigma_m(self) -> float | None:
        """1-sigma of the length of both causes, or None where that of the scale is not known."""
        if self.calibration_sigma_m is None:
            return None
        return math.hypot(self.calibration_sigma_m, self.placing_sigma_m)


def measure_distance(
    camera: ScanCamera,
    picture: str,
    start_px: tuple[float, float],
    end_px: tuple[float, float],
    *,
    placed_to_px: float = 1.0,
) -> Distance:
    """Measure between two pixels of the raw or of the corrected picture.

    Parameters
    ----------
    camera
        The camera of the frame in the size of its image. Without covariance its scale counts as nominal.
    picture
        One of :data:`PICTURES`; the distortion of the raw one is taken into account.
    start_px, end_px
        (x, y) of both ends, px of the image.
    placed_to_px
        Pixels of the image per pixel of the screen: each end is rounded to them, which is an error of 1/sqrt(12) of
        them in either direction.

    Raises
    ------
    InvalidValueError
        A place is not finite, or lies where the distortion has no inverse; or there is no such picture.
    """
    if picture not in PICTURES:
        raise InvalidValueError(f"a picture {picture!r}", expected=" or ".join(PICTURES))
    ends = np.array([start_px, end_px], dtype=np.float64)
    if not (np.all(np.isfinite(ends)) and math.isfinite(placed_to_px) and placed_to_px > 0.0):
        raise InvalidValueError(f"a ruler from {start_px} to {end_px}", expected="finite numbers")
    ideal = camera.undistort(ends) if picture == "raw" else camera.ideal_from_rect(ends)
    points = camera.sem_from_ideal(ideal)
    if not np.all(np.isfinite(points)):
        raise InvalidValueError(
            f"a ruler from {start_px} to {end_px}", expected="places inside the picture"
        )
    way = points[1, :2] - points[0, :2]
    pixel_m = camera.rectified.pixel_size_m[0]
    return Distance(
        float(way[0]),
        float(way[1]),
        _calibration_sigma_m(camera, points, way),
        pixel_m * placed_to_px * math.sqrt(2.0 / 12.0),
    )


def _calibration_sigma_m(camera: ScanCamera, points: Array, way: Array) -> float | None:
    """1-sigma of a length by the covariance of all parameters, its two pixels being given.

    A pixel that stays where it is shows another point if a parameter changes: dX = -(dx/dX)^-1 dx/dtheta, where
    dx/dX of the rectified picture is m times the identity. What both ends have in common, such as the place of the
    optical axis, drops out of their difference.
    """
    rectified = camera.rectified
    covariance = rectified.joint_covariance
    if covariance is None:
        return None
    moved = -rectified.project_jacobian(points) / rectified.m
    length = float(np.hypot(*way))
    if length == 0.0:
        return 0.0
    gradient = (way / length) @ (moved[1] - moved[0])
    variance = float(gradient @ covariance @ gradient)
    return math.sqrt(variance) if math.isfinite(variance) and variance >= 0.0 else None


def digits_of(sigma: float) -> int:
    """Return how many decimals show two digits of a 1-sigma: 0 to 6, and 3 where it is not known."""
    if not (math.isfinite(sigma) and sigma > 0.0):
        return 3
    return min(max(1 - math.floor(math.log10(sigma)), 0), 6)


def format_with_sigma(length_m: float, sigma_m: float | None) -> str:
    """Format a length and its 1-sigma in one unit, µm or nm, with two digits of the 1-sigma.

    Without one, the text says that the scale is nominal; with one that is not finite, that it is not known.
    """
    size, unit = next((u for u in _UNITS if abs(length_m) >= 0.9995 * u[0]), _UNITS[-1])
    if sigma_m is None:
        return f"{length_m / size:.4g} {unit} (nominal)"
    if not math.isfinite(sigma_m):
        return f"{length_m / size:.4g} {unit} (uncertainty not known)"
    digits = digits_of(sigma_m / size)
    return f"{length_m / size:.{digits}f} ± {sigma_m / size:.{digits}f} {unit}"
