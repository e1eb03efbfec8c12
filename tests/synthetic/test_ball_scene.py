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

"""The virtual ball: its rays, its image, its truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic import NOISE_FREE
from semcal_ros.synthetic.drift import Drift
from semcal_ros.synthetic.specimens.ball import (
    TEXTURES,
    BallOnTip,
    Turning,
    ball_microscope,
    ball_plan,
    draw_ball_plan,
)

# The same pixel size as 2048 px at 9000x, in a smaller image.
SMALL = replace(ball_microscope(width=512, height=192), name="small")
G = 36000.0
STILL = Turning(10.0, roll_rad=0.0, yaw_rad=0.0, travel_m=(0, 0, 0), centre_m=(0, 0, 0))


def plan(**given):
    options = {"frames": 4, "magnifications": (G,), "detector": NOISE_FREE} | given
    return ball_plan(SMALL, **options)


def test_rays_meet_the_surface_from_outside():
    body = BallOnTip()
    rng = np.random.default_rng(0)
    origin = np.column_stack([rng.uniform(-1e-6, 3e-6, 2000), rng.uniform(-5e-7, 5e-7, 2000)])
    origin = np.column_stack([origin, np.full(2000, -5e-6)])
    direction = np.tile([0.01, -0.02, 1.0], (2000, 1))
    along, normal = body.meet(origin, direction)
    hit = np.isfinite(along)
    at = origin[hit] + along[hit, None] * direction[hit]
    assert 0.2 < hit.mean() < 0.9
    assert np.abs(body.distance_m(at)).max() < 1e-15
    assert np.all(np.sum(normal[hit] * direction[hit], axis=1) < 0.0)
    assert np.allclose(np.linalg.norm(normal[hit], axis=1), 1.0)
    # Nothing is passed on the way.
    before = origin[hit] + (along[hit, None] - 20e-9) * direction[hit]
    assert body.distance_m(before).min() > 0.0


@pytest.mark.parametrize(
    "body",
    [
        BallOnTip(stretch=(1.0, 1.03, 0.98), tip_length_m=0.0),
        BallOnTip(bump_m=45e-9, bump_towards=(0.0, 0.4, -1.0), tip_length_m=0.0),
    ],
)
def test_rays_meet_a_body_that_is_no_ball(body):
    """The point is on the surface as its equation says, and the normal is that of the surface there."""
    rng = np.random.default_rng(0)
    origin = np.column_stack([rng.uniform(-4e-7, 4e-7, (2000, 2)), np.full(2000, -5e-6)])
    direction = np.tile([0.01, -0.02, 1.0], (2000, 1))
    along, normal = body.meet(origin, direction)
    hit = np.isfinite(along)
    at = origin[hit] + along[hit, None] * direction[hit]
    assert hit.mean() > 0.6
    radius = np.linalg.norm(at / np.array(body.stretch), axis=1)
    towards = np.array(body.bump_towards) / np.linalg.norm(body.bump_towards)
    squared = np.sum((at / np.linalg.norm(at, axis=1)[:, None] - towards) ** 2, axis=1)
    bump = body.bump_m * np.exp(-0.5 * squared * (450e-9 / body.bump_width_m) ** 2)
    # At grazing incidence the search ends early; a pixel is 6.5 nm.
    assert np.percentile(np.abs(radius - 450e-9 - bump), 99) < 1e-11
    # Along the surface the distance does not change to first order.
    side = np.cross(normal[hit], [1.0, 0.0, 0.0])
    side *= 1e-10 / np.linalg.norm(side, axis=1)[:, None]
    change = body.distance_m(at + side) - body.distance_m(at - side)
    assert np.percentile(np.abs(change), 99) < 1e-13


def test_scenes_are_drawn_by_their_seed():
    made = [draw_ball_plan(seed, frames=4) for seed in range(12)]
    assert {p.specimen.texture_name for p in made} == set(TEXTURES)
    assert len({p.specimen.grain_m for p in made}) == 12
    axes = np.array([p.pose_at(np.array([0.0]))[0][0, :, 0] for p in made])
    # Turn axes point to all sides.
    assert np.all(axes[:, :2].min(axis=0) < -0.5)
    assert np.all(axes[:, :2].max(axis=0) > 0.5)
    again = draw_ball_plan(
        2, frames=4, texture_name="speckle", charging=0.2, substrate_contrast=0.4
    )
    image = again.render(1)
    assert np.array_equal(
        image,
        draw_ball_plan(
            2, frames=4, texture_name="speckle", charging=0.2, substrate_contrast=0.4
        ).render(1),
    )
    # The ball is in the frame, and its texture is seen: more contrast than noise alone.
    height, width = image.shape
    middle = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    middle = middle[height // 2 - 25 : height // 2 + 25, width // 2 - 25 : width // 2 + 25]
    assert middle.mean() > 1.5 * np.median(image[:10])
    assert middle.std() > 0.03 * middle.mean()


def test_unknown_textures_are_refused():
    with pytest.raises(InvalidValueError, match="islands"):
        BallOnTip(texture_name="marble")


def test_the_outline_is_where_the_true_camera_sees_it():
    bare = BallOnTip(tip_radius_m=1e-12, tip_slope=0.0, contrast=0.0)
    picture = plan(specimen=bare, motion=STILL).render(0).astype(float)
    ys, xs = np.nonzero(picture > 1.5 * np.median(picture))
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    ring = 450e-9 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(721)])
    outline = SMALL.project(G, ring)
    # Whole pixels: half of one on each side.
    assert xs.min() == pytest.approx(outline[:, 0].min(), abs=0.8)
    assert xs.max() == pytest.approx(outline[:, 0].max(), abs=0.8)
    assert ys.min() == pytest.approx(outline[:, 1].min(), abs=0.8)
    assert ys.max() == pytest.approx(outline[:, 1].max(), abs=0.8)


def test_the_rim_is_bright():
    bare = BallOnTip(tip_radius_m=1e-12, tip_slope=0.0, contrast=0.0)
    picture = plan(specimen=bare, motion=STILL).render(0).astype(float)
    row = picture[int(SMALL.project(G, np.zeros((1, 3)))[0, 1])]
    column = SMALL.project(G, np.array([[0.0, 0, 0], [-360e-9, 0, 0]]))[:, 0].round().astype(int)
    dark = np.median(row[:50])
    # At four fifths of the radius the cosine is 0.6.
    ratio = (row[column[1]] - dark) / (row[column[0]] - dark)
    r, b = bare.reflectivity, bare.background
    assert ratio == pytest.approx((r / 0.6**bare.slope_power - b) / (r - b), rel=0.05)


def test_texture_turns_with_the_ball():
    """Patches of two frames are the same where the truth says so."""
    turning = Turning(1.6, roll_rad=0.2, yaw_rad=0.0, travel_m=(0, 0, 0), centre_m=(0, 0, 0))
    made = plan(motion=turning, specimen=BallOnTip(slope_power=0.0))
    times = np.array([f.start_time_s for f in made.frames]) + SMALL.timing.centre_offset_s
    rotation, place = made.pose_at(times)
    front = np.array([[x, y, -400e-9] for x in (-1e-7, 0, 1e-7) for y in (-1e-7, 0, 1e-7)])
    front *= 450e-9 / np.linalg.norm(front, axis=1)[:, None]
    for first, second in ((0, 1), (1, 3)):
        cut = []
        for k in (first, second):
            raw = SMALL.project(G, front @ rotation[k].T + place[k]).astype(np.float32)
            image = made.render(k).astype(np.float32)
            cut.append([cv2.getRectSubPix(image, (7, 7), tuple(map(float, xy))) for xy in raw])
        likeness = [np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in zip(*cut, strict=True)]
        assert np.median(likeness) > 0.9


def test_drift_shears_the_picture():
    """2 um/s are 0.1 um between the first and the last of the lines that show the ball."""
    bare = BallOnTip(tip_radius_m=1e-12, tip_slope=0.0, contrast=0.0)
    slow = SMALL.with_timing(ScanTiming(0.1, 1, 0.0))
    centres = []
    for speed in (0.0, 2e-6):
        drift = Drift(velocity_m_s=(speed, 0.0))
        made = ball_plan(
            slow, frames=1, magnifications=(G,), detector=NOISE_FREE, specimen=bare,
            motion=STILL, drift=drift,
        )  # fmt: skip
        picture = made.render(0).astype(float)
        weight = (picture > 1.5 * np.median(picture)).astype(float)
        columns = np.arange(picture.shape[1])
        rows = np.flatnonzero(weight.sum(axis=1) > 40)
        middle = (weight[rows] @ columns) / weight[rows].sum(axis=1)
        centres.append(np.polyfit(rows, middle, 1)[0])
    pixel_m = SMALL.camera_at(G).pixel_size_m[0]
    # Up to the true camera's skew, which both images have.
    assert centres[1] - centres[0] == pytest.approx(2e-6 * 0.1 / 192 / pixel_m, rel=0.05)


def test_frames_are_reproducible_and_noise_differs():
    made = ball_plan(SMALL, frames=2, magnifications=(G,), motion=STILL)
    assert np.array_equal(made.render(0), made.render(0))
    assert not np.array_equal(made.render(0), made.render(1))
    assert made.render(0).dtype == np.uint8


def test_the_truth_tells_the_poses():
    made = ball_plan(frames=22)
    truth = made.truth()
    assert [f["magnification"] for f in truth["frames"]][::2] == [9000 + 100 * k for k in range(11)]
    rotations = np.array([f["rotation"] for f in truth["frames"]])
    assert np.allclose(rotations @ np.swapaxes(rotations, 1, 2), np.eye(3))
    # The beam sees the front from directions up to both amplitudes apart.
    tilt = np.degrees(np.arccos(rotations[:, 2, 2]))
    assert 25.0 < tilt.max() < 40.0
    assert truth["ball_diameter_m"] == 900e-9


def test_too_few_frames_are_refused():
    with pytest.raises(InvalidValueError):
        ball_plan(frames=5)
