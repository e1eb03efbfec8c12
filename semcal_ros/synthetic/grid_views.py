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

"""Views of a checkerboard with known truth, without images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.scan_camera import ScanCamera


def grid_view(
    camera: ScanCamera,
    rotation: Array,
    translation_m: Array,
    *,
    square_px: float = 40.0,
    noise_px: float = 0.0,
    rng: np.random.Generator | None = None,
    name: str = "",
    project: Callable[[Array], Array] | None = None,
) -> GridView:
    """Return all lattice corners inside the image, with Gaussian noise on their pixels.

    ``project`` takes the place of the camera's own projection of sem-frame points.
    """
    square_m = square_px / camera.m
    i, j = np.meshgrid(np.arange(-40, 41), np.arange(-40, 41))
    board: Array = np.column_stack([i.ravel(), j.ravel()]).astype(float) * square_m
    points = np.column_stack([board, np.zeros(len(board))]) @ rotation.T + translation_m
    xy = (project or camera.project)(points)
    with np.errstate(invalid="ignore"):
        seen = np.all((xy > 5) & (xy < np.array([camera.width, camera.height]) - 6), axis=1)
    xy = xy[seen]
    if noise_px > 0.0:
        assert rng is not None
        xy = xy + rng.normal(scale=noise_px, size=xy.shape)
    sigma = np.full(len(xy), noise_px if noise_px > 0.0 else 0.01)
    return GridView(camera.magnification, board[seen].astype(np.float64), xy, sigma, name)


def grid_views(
    camera_at: Callable[[float], ScanCamera],
    magnifications: Sequence[float],
    *,
    views: int = 4,
    noise_px: float = 0.0,
    height_sigma_m: float = 40e-6,
    square_px: float = 40.0,
    seed: int = 0,
    flat_height_sigma_m: float = 0.0,
    project: Callable[[float, Array], Array] | None = None,
) -> list[GridView]:
    """``views`` random poses per magnification, the first untilted, tilts up to 40 degrees.

    The heights have the sigma ``height_sigma_m``, those of the untilted views ``flat_height_sigma_m``. ``project``
    takes the place of the cameras' projection: of sem-frame points at a magnification, as of a whole microscope.
    """
    rng = np.random.default_rng(seed)
    # A separate generator: the poses of a seed are the same with and without noise.
    noise_rng = np.random.default_rng(seed + 1_000_000)
    out = []
    for g in magnifications:
        camera = camera_at(g)
        for k in range(views):
            tilt = 0.0 if k == 0 else rng.uniform(np.radians(15), np.radians(40))
            axis = rng.uniform(0, 2 * np.pi)
            turn = rotations_from_vectors(np.array([[0.0, 0.0, rng.uniform(-0.6, 0.6)]]))[0]
            tilted = rotations_from_vectors(tilt * np.array([[np.cos(axis), np.sin(axis), 0.0]]))[0]
            centre = rng.uniform(-0.5, 0.5, size=2) * square_px / camera.m
            # Without its own height sigma, the first view draws no number, so that seeds keep their poses.
            sigma = flat_height_sigma_m if k == 0 else height_sigma_m
            translation = np.array([*centre, rng.normal() * sigma if sigma > 0.0 else 0.0])
            out.append(
                grid_view(
                    camera,
                    tilted @ turn,
                    translation,
                    square_px=square_px,
                    noise_px=noise_px,
                    rng=noise_rng,
                    name=f"{g:g}/{k}",
                    project=None if project is None else partial(project, g),
                )
            )
    return out
