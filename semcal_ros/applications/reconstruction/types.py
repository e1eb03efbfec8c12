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

"""Types that the steps of a reconstruction exchange."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Indices, Mask
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True, eq=False)
class Tracks:
    """Positions of points in the views, in the plane of the specimen.

    Parameters
    ----------
    xy_m
        (views, points, 2) sem-frame X and Y at height 0 of the line of sight, m
        (:meth:`~semcal_ros.core.camera.scan_camera.ScanCamera.sem_from_ideal` of undistorted
        pixels). The calibrated intrinsics are divided out, so that every view is a parallel
        projection in true scale, up to ``1 / (1 + rho Z)``. Arbitrary where not seen.
    seen
        (views, points) whether each view sees each point.
    """

    xy_m: Array
    seen: Mask

    def __post_init__(self) -> None:
        if self.xy_m.ndim != 3 or self.xy_m.shape != (*self.seen.shape, 2):
            raise InvalidValueError(
                f"tracks of shape {self.xy_m.shape} with a mask of shape {self.seen.shape}",
                expected="(views, points, 2) and (views, points)",
            )
        if not np.all(np.isfinite(self.xy_m[self.seen])):
            raise InvalidValueError("tracks that are not finite", expected="finite metres")


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of points in views as a list, in undistorted pixels, with their weights.

    Parameters
    ----------
    view, point
        (n,) indices.
    xy
        (n, 2) undistorted px.
    root
        (n, 2, 2) root of the information matrix: ``root @ error`` has unit covariance, 1/px.
    """

    view: Indices
    point: Indices
    xy: Array
    root: Array

    def __len__(self) -> int:
        return len(self.view)

    def select(self, keep: Mask | Indices) -> Observations:
        """Select some of the observations."""
        return Observations(self.view[keep], self.point[keep], self.xy[keep], self.root[keep])

    @staticmethod
    def from_tracks(
        tracks: Tracks, cameras: Sequence[ScanCamera], sigma_px: float = 1.0
    ) -> Observations:
        """Convert all that is seen in tracks, with one standard deviation."""
        view, point = np.nonzero(tracks.seen)
        table = tabulate_cameras(cameras)[view]
        x, y = tracks.xy_m[view, point].T
        m, a, skew, px, py = table[:, :5].T
        xy = np.stack([px + m * (a * x + skew * y), py + m * y / a], axis=1)
        root = np.broadcast_to(np.eye(2) / sigma_px, (len(view), 2, 2))
        return Observations(view, point, xy, np.array(root))


def tabulate_cameras(cameras: Sequence[ScanCamera]) -> Array:
    """Tabulate (views, 6) m, aspect, skew, px, py, rho."""
    return np.array([camera.parameters[:6] for camera in cameras]).reshape(-1, 6)
