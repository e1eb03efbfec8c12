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

"""From rendered images to points: tracking, patches, both mirror images, movement during a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.applications.reconstruction import (
    SequenceTracker,
    TrackerSettings,
    measure_ball,
    reconstruct,
)
from semcal_ros.applications.reconstruction.adjustment import adjust, tabulate_cameras
from semcal_ros.applications.reconstruction.ball import jackknife_sigma, split_neighbours
from semcal_ros.core.errors import InvalidValueError, StructureError
from semcal_ros.synthetic import Detector
from semcal_ros.synthetic.specimens.ball import Turning, ball_microscope, ball_plan, draw_ball_plan
from tests.helpers.made_once import made_once

# The same pixel size as 2048 px at 9000x, in a smaller image.
SMALL = replace(ball_microscope(width=512, height=192), name="small")
CENTRE_M = (-2e-7, 0.0, 0.0)


def followed(plan, settings=None):
    tracker = SequenceTracker(settings)
    for index, frame in enumerate(plan.frames):
        camera = plan.microscope.camera_at(frame.magnification)
        tracker.add(plan.render(index), camera, frame.start_time_s)
    return tracker.finish()


@pytest.fixture(scope="module")
def plan():
    motion = Turning(
        60.0, rolls=1.0, yaws=1.0, roll_rad=0.5, travel_m=(1e-7, 5e-8, 0.0), centre_m=CENTRE_M
    )
    magnifications = (36000.0, 36400.0, 36800.0)
    return ball_plan(
        SMALL,
        frames=24,
        interval_s=2.5,
        magnifications=magnifications,
        motion=motion,
        detector=Detector(electrons=400.0),
    )


@pytest.fixture(scope="module")
def structure(plan):
    def make():
        keyframes = followed(plan, TrackerSettings(spacing_px=8.0))
        return reconstruct(keyframes, plan.microscope.timing)

    return made_once("structure-of-a-ball", make)


@pytest.mark.slow
def test_points_lie_on_the_true_surface(plan, structure):
    ball = measure_ball(structure)
    assert np.count_nonzero(ball.sphere.inliers) > 60
    # A pixel is 6.5 nm.
    assert ball.sphere.rms_m < 4e-9
    assert ball.diameter_m == pytest.approx(900e-9, rel=0.02)
    low, high = ball.interval_m
    assert low < 900e-9 < high
    assert high - low < 60e-9
    assert ball.sigma_m > max(ball.patch_bias_sigma_m, ball.noise_sigma_m)


@pytest.mark.slow
def test_errors_that_neighbours_share_widen_the_interval(structure):
    """A side of the ball 1 % too far out in all views: no residual shows it, and leaving out views does not."""
    ball = measure_ball(structure)
    seen, done = structure.observations, structure.adjustment
    outward = structure.points_m - ball.sphere.centre_m
    out = 0.01 * outward * (outward[:, :1] > 0.3 * ball.sphere.radius_m)
    across = np.einsum("nij,nj->ni", done.rotations[seen.view], out[seen.point])[:, :2]
    px_per_m = tabulate_cameras(structure.cameras)[seen.view, :1]
    shifted = replace(seen, xy=seen.xy + px_per_m * across)
    again = adjust(
        shifted,
        structure.cameras,
        done.rotations,
        done.translations_m,
        done.points_m + out,
        reference=done.reference,
    )
    other = measure_ball(
        replace(structure, observations=shifted, adjustment=again, points_m=again.points_m)
    )
    # The poses take a part of it. Between none of the side and all of it the diameter changes by 1 %.
    shown = np.hypot(other.shape_sigma_m, other.patch_bias_sigma_m)
    assert 0.001 < shown / ball.diameter_m < 0.01
    assert shown > 1.5 * np.hypot(ball.shape_sigma_m, ball.patch_bias_sigma_m)
    assert other.noise_sigma_m < 1.5 * ball.noise_sigma_m


def test_neighbours_are_left_out_together():
    """Groups of a row of places are its pieces, and their spread is that of the mean of the groups."""
    places = np.column_stack([np.random.default_rng(1).permutation(64), np.zeros((64, 2))])
    groups = split_neighbours(places, 16)
    assert sorted(len(group) for group in groups) == [4] * 16
    assert all(np.ptp(places[group, 0]) == 3 for group in groups)
    values = np.random.default_rng(2).normal(size=16)
    without = [float(np.delete(values, k).mean()) for k in range(16)]
    assert jackknife_sigma(without) == pytest.approx(values.std(ddof=1) / 4.0, rel=1e-12)


@pytest.mark.slow
@pytest.mark.long
def test_the_outline_of_a_tip_does_not_bend_the_poses():
    """Points on the outline move over the surface as it turns: they are told by their residuals."""
    made = draw_ball_plan(3, frames=60, pixel_m=8e-9)
    assert made.specimen.tip_length_m > 0.0
    found = reconstruct(followed(made), made.microscope.timing)
    ball = measure_ball(found)
    off = np.abs(np.linalg.norm(found.points_m - ball.sphere.centre_m, axis=1) - 450e-9)
    # Off the ball by more than 2 px: 22 points while those of the outline were kept.
    assert np.count_nonzero(off > 16e-9) < 15
    # Those kept it from converging in 10 passes, with a diameter 0.4 % too small.
    assert found.converged
    assert ball.diameter_m == pytest.approx(900e-9, rel=0.003)


@pytest.mark.slow
def test_the_ball_bulges_towards_the_gun(structure):
    ball = measure_ball(structure, groups=0)
    reference = structure.adjustment.reference
    depth = (structure.points_m - ball.sphere.centre_m) @ structure.adjustment.rotations[reference][
        2
    ]
    on = ball.sphere.inliers
    assert structure.convexity > 0.8
    assert np.median(depth[on]) < -0.5 * ball.sphere.radius_m
    outward = np.sum((structure.points_m - ball.sphere.centre_m) * structure.normals, axis=1)
    assert np.mean(outward[on] > 0.0) > 0.95


@pytest.mark.slow
def test_views_are_turned_as_the_truth_says(plan, structure):
    times = np.array([plan.frames[k].start_time_s for k in structure.frames])
    turned, _ = plan.pose_at(times + plan.microscope.timing.centre_offset_s)
    found, r = structure.adjustment.rotations, structure.adjustment.reference
    error = (found @ found[r].T) @ np.swapaxes(turned @ turned[r].T, 1, 2)
    angle = np.arccos(np.clip((np.trace(error, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))
    # Turns of up to 60 degrees between views; a mirror image would be wrong by twice as much.
    assert np.degrees(np.median(angle)) < 3.0


def test_a_still_specimen_gives_one_keyframe_and_is_refused():
    still = Turning(10.0, roll_rad=0.0, yaw_rad=0.0, travel_m=(0, 0, 0), centre_m=CENTRE_M)
    made = ball_plan(SMALL, frames=4, magnifications=(36000.0,), motion=still)
    keyframes = followed(made)
    assert len(keyframes) == 1
    with pytest.raises(StructureError, match="hardly turns"):
        reconstruct(keyframes)


@pytest.mark.parametrize(
    ("seed", "frames", "pixel_m", "said"),
    [
        # A view that no point faces.
        (3, 32, 10e-9, "that agree"),
        # A first structure that is as deep as the pivot is far away, or that no view shows: rounding decides.
        (4, 20, 12e-9, "relief the cameras cannot show|that agree"),
    ],
)
def test_a_recording_that_tells_too_little_is_refused(seed, frames, pixel_m, said):
    made = draw_ball_plan(seed, frames=frames, pixel_m=pixel_m)
    keyframes = followed(made, TrackerSettings(spacing_px=8.0))
    with pytest.raises(StructureError, match=said):
        reconstruct(keyframes, made.microscope.timing)


def test_a_shift_is_not_parallax():
    """Drift moves everything alike; it brings nothing new."""
    moved = Turning(40.0, roll_rad=0.0, yaw_rad=0.0, travel_m=(2e-7, 5e-8, 0.0), centre_m=CENTRE_M)
    made = ball_plan(SMALL, frames=5, magnifications=(36000.0,), motion=moved, interval_s=1.0)
    keyframes = followed(made)
    assert len(keyframes) == 1
    # The image moves as the specimen does: within 10 % of a speed of some 30 nm/s.
    _, place = made.pose_at(np.array([0.05, 1.05]))
    true = (place[1] - place[0])[:2]
    frame = keyframes[0]
    seen = frame.velocity @ np.append(CENTRE_M[:2], 1.0)
    assert np.linalg.norm(seen - true) < 0.1 * np.linalg.norm(true)


def test_frames_out_of_order_or_of_another_size_are_refused(plan):
    tracker = SequenceTracker()
    camera = plan.microscope.camera_at(36000.0)
    image = plan.render(0)
    tracker.add(image, camera, 1.0)
    with pytest.raises(InvalidValueError, match="order"):
        tracker.add(image, camera, 1.0)
    with pytest.raises(InvalidValueError, match="shape"):
        tracker.add(image[:100], camera, 2.0)
