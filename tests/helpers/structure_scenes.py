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

"""Tracks of points on a ball whose truth is known, without images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.reconstruction import Tracks
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic import preset

RADIUS_M = 450e-9


@dataclass(frozen=True, eq=False)
class Scene:
    """Truth and what was seen of it."""

    cameras: list[ScanCamera]
    rotations: NDArray[np.float64]
    translations_m: NDArray[np.float64]
    points_m: NDArray[np.float64]
    tracks: Tracks
    wrong: NDArray[np.bool_]


def ball_scene(
    *,
    views: int = 40,
    points: int = 300,
    sigma_px: float = 0.2,
    wrong: float = 0.0,
    roll_deg: float = 35.0,
    yaw_deg: float = 15.0,
    steepest_deg: float = 60.0,
    heights_m: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    seed: int = 0,
) -> Scene:
    """A ball that rolls and yaws; a point is seen where its normal is near enough to the beam.

    ``heights_m`` are those of directions (n, 3) over the sphere.
    """
    rng = np.random.default_rng(seed)
    microscope = preset("jsm820").with_image_size(2048, 320)
    steps = np.linspace(0.0, 1.0, views)
    cameras = [microscope.camera_at(9000.0 + 100.0 * round(10.0 * s)) for s in steps]
    angles = np.zeros((views, 3))
    angles[:, 0] = np.radians(roll_deg) * np.sin(2 * np.pi * steps)
    angles[:, 1] = np.radians(yaw_deg) * np.sin(6 * np.pi * steps + 0.7)
    rotations = rotations_from_vectors(angles)
    translations = rng.normal(0.0, 1.0, (views, 3)) * np.array([150e-9, 80e-9, 300e-9])
    # All around the ball, and more of them than asked for: those behind are never seen.
    directions = rng.normal(size=(6 * points, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    towards_gun = -np.einsum("vj,pj->vp", rotations[:, 2], directions)
    seen = towards_gun > np.cos(np.radians(steepest_deg))
    seen &= rng.random(seen.shape) < 0.85
    # What few views see has a depth that is hardly determined.
    kept = np.flatnonzero(seen.sum(axis=0) >= max(6, views // 4))[:points]
    directions, seen = directions[kept], seen[:, kept]
    world = RADIUS_M * directions
    if heights_m is not None:
        world += heights_m(directions)[:, None] * directions
    xy = np.zeros((*seen.shape, 2))
    false = seen & (rng.random(seen.shape) < wrong)
    for view, camera in enumerate(cameras):
        ideal = camera.project_ideal(world @ rotations[view].T + translations[view])
        ideal += rng.normal(0.0, sigma_px, ideal.shape)
        ideal[false[view]] += rng.uniform(-15.0, 15.0, (int(false[view].sum()), 2))
        xy[view] = camera.sem_from_ideal(ideal)[:, :2]
    return Scene(cameras, rotations, translations, world, Tracks(xy, seen), false)


def aligned_rms_m(points_m: NDArray[np.float64], truth_m: NDArray[np.float64]) -> float:
    """RMS distance after the best rotation and shift; the scale is not touched."""
    a, b = points_m - points_m.mean(axis=0), truth_m - truth_m.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float(np.sqrt(np.mean(np.sum((a @ turn.T - b) ** 2, axis=1))))
