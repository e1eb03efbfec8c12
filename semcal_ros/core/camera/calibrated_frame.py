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

"""A rectified frame with its projection and drift: pixels to metres and back, with covariances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True, eq=False)
class Positions:
    """Points with their uncertainty.

    Attributes
    ----------
    values
        (n, 2): x and y, m or px.
    covariance
        (n, 2, 2) of each, m2 or px2.
    """

    values: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """(n, 2) 1-sigma of x and of y."""
        return np.sqrt(np.maximum(np.einsum("nii->ni", self.covariance), 0.0))


@dataclass(frozen=True, eq=False)
class CalibratedFrame:
    """One frame, free of distortion and drift.

    Attributes
    ----------
    image
        (h, w) or (h, w, 3) grey levels, read-only.
    stamp_ns
        Its stamp, ns.
    magnification
        At which it was taken; None where that is not known.
    P
        (3, 4) projection: the homogeneous pixel of a homogeneous point of the sem frame, m; it means nothing
        where the frame is not :attr:`valid`.
    P_covariance
        (12, 12) covariance of its numbers, row by row; zero where it is not known.
    drift_m, drift_covariance
        (2,) drift that was taken out of the image, m, and its (2, 2) covariance; zero without drift.
    reason
        Why lengths of this frame mean nothing; empty where they do.
    """

    image: NDArray[Any]
    stamp_ns: int
    magnification: float | None
    P: Array
    P_covariance: Array
    drift_m: Array
    drift_covariance: Array
    reason: str = ""

    @property
    def valid(self) -> bool:
        """Whether pixels and metres can be turned into each other."""
        return not self.reason

    @property
    def pixel_size_m(self) -> float:
        """Side of a pixel in the plane z = 0, m; NaN where P is zero."""
        return 1.0 / float(self.P[0, 0]) if self.P[0, 0] > 0.0 else float("nan")

    @property
    def pixel_size_sigma_m(self) -> float:
        """1-sigma of it, m."""
        return float(np.sqrt(max(self.P_covariance[0, 0], 0.0))) * self.pixel_size_m**2

    def metres_from_pixels(
        self, uv: ArrayLike, *, sigma_px: float = 0.0, height_m: float = 0.0
    ) -> Positions:
        """Points of the sem frame, m, that are seen at pixels.

        The covariance holds that of the calibration, of the drift and of the pixels. Most of it is common to all points
        of a frame, since the place of the optical axis is uncertain by many pixels: for lengths within a frame use
        :meth:`displacement`.

        Parameters
        ----------
        uv
            (n, 2) or (2,) pixels (column, row), the middle of the first being (0, 0).
        sigma_px
            1-sigma of each coordinate, px.
        height_m
            Height of the points above the plane of the calibration, m.

        Raises
        ------
        InvalidValueError
            If the frame is not :attr:`valid`, for another shape, or for a height that is not in front of the pivot.
        """
        pixels = self._checked(uv, 2)
        values, by_projection, by_pixel = self._unproject(pixels, height_m)
        covariance = by_projection @ self.P_covariance @ np.swapaxes(by_projection, 1, 2)
        covariance += sigma_px**2 * by_pixel @ by_pixel.T + self.drift_covariance
        return Positions(values, covariance)

    def displacement(
        self,
        start_uv: ArrayLike,
        end_uv: ArrayLike,
        *,
        sigma_px: float = 0.0,
        height_m: float = 0.0,
    ) -> Positions:
        """Displacements in the sem frame, m, between pixels of this frame.

        Both ends share the errors of the optical axis and of the drift, which cancel: what remains are those of the
        scale, and ``sigma_px`` at either end. One of the two may be a single point. Parameters and errors are those of
        :meth:`metres_from_pixels`.
        """
        start, end = self._checked(start_uv, 2), self._checked(end_uv, 2)
        if len(start) != len(end) and 1 not in (len(start), len(end)):
            raise InvalidValueError(
                f"{len(start)} starts and {len(end)} ends", expected="as many, or one of either"
            )
        first, by_first, by_pixel = self._unproject(start, height_m)
        last, by_last, _ = self._unproject(end, height_m)
        by = by_last - by_first
        covariance = by @ self.P_covariance @ np.swapaxes(by, 1, 2)
        covariance += 2.0 * sigma_px**2 * by_pixel @ by_pixel.T
        return Positions(last - first, covariance)

    def pixels_from_metres(self, xyz_m: ArrayLike, *, sigma_m: float = 0.0) -> Positions:
        """Pixels at which points of the sem frame are seen.

        Parameters
        ----------
        xyz_m
            (n, 3) or (3,) points, m, or (n, 2) in the plane z = 0.
        sigma_m
            1-sigma of x and y, m.

        Raises
        ------
        InvalidValueError
            As :meth:`metres_from_pixels`, or if a point is not in front of the pivot.
        """
        points = self._checked(xyz_m, 2, 3)
        if points.shape[1] == 2:
            points = np.column_stack([points, np.zeros(len(points))])
        homogeneous = np.column_stack([points, np.ones(len(points))])
        seen = homogeneous @ self.P.T
        if not np.all(seen[:, 2] > 0.0):
            raise InvalidValueError(
                "points behind the pivot of the beam", expected="heights near the specimen's"
            )
        values = seen[:, :2] / seen[:, 2:]
        by = np.zeros((len(points), 2, 12))
        for k in (0, 1):
            by[:, k, 4 * k : 4 * k + 4] = homogeneous / seen[:, 2:]
            by[:, k, 8:] = -values[:, k : k + 1] * homogeneous / seen[:, 2:]
        covariance = by @ self.P_covariance @ np.swapaxes(by, 1, 2)
        matrix = self.P[:2, :2] / seen[:, 2, None, None]
        in_plane = sigma_m**2 * np.eye(2) + self.drift_covariance
        if not np.all(np.isfinite(in_plane)):
            # A drift that was never measured.
            return Positions(values, np.broadcast_to(np.diag([np.inf, np.inf]), covariance.shape))
        covariance += matrix @ in_plane @ np.swapaxes(matrix, 1, 2)
        return Positions(values, covariance)

    def _unproject(self, uv: Array, height_m: float) -> tuple[Array, Array, Array]:
        """(n, 2) points, and their derivatives by the projection (n, 2, 12) and by the pixel (2, 2)."""
        weight = float(self.P[2, 2]) * height_m + float(self.P[2, 3])
        if not 0.0 < weight < np.inf:
            raise InvalidValueError(
                f"a height of {height_m} m", expected="one in front of the pivot of the beam"
            )
        inverse = np.linalg.inv(self.P[:2, :2])
        xy = (uv * weight - self.P[:2, 2] * height_m - self.P[:2, 3]) @ inverse.T
        ones = np.ones(len(xy))
        row = np.column_stack([xy, height_m * ones, ones])
        by = np.zeros((len(xy), 2, 12))
        for k in (0, 1):
            by[:, k, 4 * k : 4 * k + 4] = -row
            by[:, k, 10] = uv[:, k] * height_m
            by[:, k, 11] = uv[:, k]
        return xy, inverse @ by, np.asarray(inverse * weight, dtype=np.float64)

    def _checked(self, points: ArrayLike, *widths: int) -> Array:
        if not self.valid:
            raise InvalidValueError(
                f"lengths in a frame without them: {self.reason}", expected="a valid frame"
            )
        expected = f"(n, {' or '.join(map(str, widths))}) finite numbers"
        try:
            out = np.atleast_2d(np.asarray(points, dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise InvalidValueError("points that are no numbers", expected=expected) from error
        if out.ndim != 2 or out.shape[1] not in widths or not np.all(np.isfinite(out)):
            raise InvalidValueError(f"points of shape {out.shape}", expected=expected)
        return out


def rectified_projection(camera: ScanCamera | None) -> tuple[Array, Array]:
    """Return the projection (3, 4) of rectified images and the covariance (12, 12) of its numbers.

    Both are zero without a camera, the covariance also where that of the camera is not known.
    """
    if camera is None:
        return np.zeros((3, 4)), np.zeros((12, 12))
    rectified = camera.rectified
    known = rectified.covariance is not None
    return rectified.P_affine, rectified.P_affine_covariance if known else np.zeros((12, 12))


def describe_missing_camera(magnification: float | None, *, mixed: bool = False) -> str:
    """Say why a frame of a live stream has no camera.

    Parameters
    ----------
    magnification
        At which it was taken; None where that is not known.
    mixed
        Whether the magnification changed while it was scanned.
    """
    if mixed:
        return "the magnification changed while it was scanned"
    if magnification is None:
        return "no camera: its magnification is not known"
    return f"no camera at magnification {magnification:g}: no calibration, or outside its range"
