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

"""Patches move as the specimen does, whatever brightness stays with the slope."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.applications.reconstruction.appearance import compute_log_grey, fit_shading
from semcal_ros.applications.reconstruction.feature_tracks import TrackKeyframe
from semcal_ros.applications.reconstruction.patches import (
    PatchSettings,
    PosedSurface,
    measure_patches,
)
from semcal_ros.synthetic import Detector
from semcal_ros.synthetic.specimens.ball import BallOnTip, Turning, ball_microscope, ball_plan

# 6.5 nm per px.
SMALL = replace(ball_microscope(width=256, height=192), name="small")
RADIUS_M = 450e-9


def draw_directions(count: int, within_rad: float, seed: int = 0) -> np.ndarray:
    """(n, 3) directions towards the gun, at most so far from the beam."""
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=(20 * count, 3))
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    return towards[towards[:, 2] < -np.cos(within_rad)][:count]


def test_shading_is_told_from_texture():
    rng = np.random.default_rng(1)
    point = np.repeat(np.arange(60), 8)
    texture = rng.normal(0.0, 0.3, (60, 9))
    normals = draw_directions(480, 1.0)[:, None, :2] + rng.uniform(-0.05, 0.05, (480, 9, 2))

    def bright(xy):
        # A limb, and a detector on one side.
        return -0.45 * np.log(1.0 - np.sum(xy**2, axis=-1)) + np.log(1.0 + 0.3 * xy[..., 0])

    offset = rng.normal(0.0, 1.0, (480, 1))
    grey = texture[point] + bright(normals) + offset + rng.normal(0.0, 0.05, (480, 9))
    # A patch that shows the edge of something else.
    grey[7] += np.linspace(-3.0, 3.0, 9)
    shading = fit_shading(normals, grey, point)
    # Patches have brightnesses of their own: only the change within them counts.
    true = bright(normals) - bright(normals).mean(axis=1, keepdims=True)
    found = shading.evaluate(normals)
    error = found - found.mean(axis=1, keepdims=True) - true
    # 4320 values with a noise of 0.05 for 18 coefficients: 0.003.
    assert np.sqrt(np.mean(error**2)) < 0.006 < 0.2 * np.sqrt(np.mean(true**2))


@pytest.mark.slow
def test_patches_move_as_far_as_the_specimen():
    body = BallOnTip(
        texture_name="spots", grain_m=50e-9, tip_length_m=0.0, slope_power=1.1,
        detector_side=(0.2, 0.1), contrast=0.12, seed=3,
    )  # fmt: skip
    motion = Turning(
        12.0, rolls=0.5, yaws=0.5, roll_rad=0.7, travel_m=(0.0, 0.0, 0.0), centre_m=(0.0, 0.0, 0.0)
    )
    plan = ball_plan(
        SMALL, frames=12, interval_s=1.0, magnifications=(72000.0,), specimen=body, motion=motion,
        detector=Detector(electrons=2000.0),
    )  # fmt: skip
    camera = SMALL.camera_at(72000.0)
    times = np.array([f.start_time_s for f in plan.frames])
    rotations, places = plan.pose_at(times + SMALL.timing.centre_offset_s)
    images = [plan.render(k) for k in range(len(plan))]
    none = (np.empty(0, dtype=np.intp), np.empty((0, 2)), np.zeros((2, 3)))
    frames = [TrackKeyframe(k, t, images[k], camera, *none) for k, t in enumerate(times)]
    out = draw_directions(150, 1.0) @ rotations[6]
    posed = PosedSurface(
        rotations, places, RADIUS_M * out, out, np.full(len(out), 1.0 / RADIUS_M)
    )  # fmt: skip
    log_greys = [compute_log_grey(image) for image in images]
    seen = measure_patches(frames, log_greys, SMALL.timing, posed, PatchSettings())
    sem = RADIUS_M * out @ np.swapaxes(rotations, 1, 2) + places[:, None]
    true = camera.project_ideal(sem.reshape(-1, 3)).reshape(len(times), -1, 2)
    moved, error = true[seen.view, seen.point], seen.xy - true[seen.view, seen.point]
    # Against the mean of the point, as only movement counts.
    for values in (moved, error):
        for point in np.unique(seen.point):
            values[seen.point == point] -= values[seen.point == point].mean(axis=0)
    share = np.sum(moved * error) / np.sum(moved**2)
    # Without the shading taken out it is -0.4 %, which makes the ball as much too small.
    assert abs(share) < 0.0015
