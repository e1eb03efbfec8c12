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

"""Where the specimen plane lies in the sem frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import as_points
from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid transform from specimen coordinates to the sem frame, ``X = R x + t_m``.

    Parameters
    ----------
    R
        (3, 3) rotation.
    t_m
        (3,) translation, m.
    """

    R: Array
    t_m: Array

    def __post_init__(self) -> None:
        rotation = np.array(self.R, dtype=np.float64)
        translation = np.array(self.t_m, dtype=np.float64)
        if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9):
            raise InvalidValueError(f"rotation {rotation.tolist()}", expected="a (3, 3) rotation")
        if translation.shape != (3,) or not np.all(np.isfinite(translation)):
            raise InvalidValueError(f"translation {translation.tolist()}", expected="three numbers")
        rotation.setflags(write=False)
        translation.setflags(write=False)
        object.__setattr__(self, "R", rotation)
        object.__setattr__(self, "t_m", translation)

    @staticmethod
    def flat(t_m: ArrayLike = (0.0, 0.0, 0.0), rotation_rad: float = 0.0) -> Pose:
        """Return an untilted plane, rotated about the beam."""
        return Pose(rotation_about_beam(rotation_rad), np.asarray(t_m, dtype=np.float64))

    @staticmethod
    def tilted(
        tilt_rad: float,
        azimuth_rad: float,
        rotation_rad: float,
        t_m: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Pose:
        """Return a plane rotated about the beam by ``rotation_rad``, then tilted.

        ``azimuth_rad`` is the direction of the tilt axis in the image plane, from x towards y.
        """
        c, s = math.cos(tilt_rad), math.sin(tilt_rad)
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        turn = rotation_about_beam(azimuth_rad)
        return Pose(
            turn @ about_x @ turn.T @ rotation_about_beam(rotation_rad),
            np.asarray(t_m, dtype=np.float64),
        )

    @property
    def tilt_rad(self) -> float:
        """Angle between the plane's normal and the beam, rad."""
        return math.acos(min(1.0, max(-1.0, float(self.R[2, 2]))))

    def sem_from_specimen(self, xy_m: ArrayLike) -> Array:
        """Map specimen-plane points (n, 2) to sem-frame points (n, 3), m."""
        return as_points(xy_m, 2) @ self.R[:, :2].T + self.t_m


def rotation_about_beam(angle_rad: float) -> Array:
    """Return the (3, 3) rotation about z, from x towards y."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def random_poses(
    seed: int,
    count: int,
    *,
    field_width_m: float,
    max_tilt_rad: float = math.radians(40.0),
    min_tilt_rad: float = math.radians(15.0),
    max_rotation_rad: float = math.pi,
    height_sigma_m: float = 40e-6,
    offset_fraction: float = 0.02,
    first_flat: bool = True,
) -> tuple[Pose, ...]:
    """Draw poses of the board for a calibration at one magnification, the same for the same seed.

    Parameters
    ----------
    seed
        Seed of the draw.
    count
        Number of poses.
    field_width_m
        Width of the field; the lateral offset has the 1-sigma ``offset_fraction`` of it.
    max_tilt_rad, min_tilt_rad
        Range of the tilts.
    max_rotation_rad
        Turns about the beam are uniform in plus or minus this angle.
    height_sigma_m
        1-sigma of the heights along the beam.
    offset_fraction
        See ``field_width_m``.
    first_flat
        The first pose is untilted at the reference plane, as an operator would begin.
    """
    rng = np.random.default_rng(seed)
    # Evenly spread: views that are all tilted about one axis leave directions unobserved.
    first_azimuth = rng.uniform(0.0, 2.0 * math.pi)
    poses = []
    for index in range(count):
        offset = rng.normal(0.0, offset_fraction * field_width_m, 2)
        height = rng.normal(0.0, height_sigma_m)
        tilt = rng.uniform(min_tilt_rad, max_tilt_rad)
        rotation = rng.uniform(-max_rotation_rad, max_rotation_rad)
        azimuth = first_azimuth + 2.0 * math.pi * index / count + rng.uniform(-0.3, 0.3)
        if first_flat and index == 0:
            tilt, height = 0.0, 0.0
        poses.append(Pose.tilted(tilt, azimuth, rotation, (offset[0], offset[1], height)))
    return tuple(poses)
