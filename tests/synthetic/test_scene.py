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

"""Microscopes, poses, drift, plans, truth and the live scene."""

from __future__ import annotations

import json
import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic import (
    DRIFTS,
    NOISE_FREE,
    PRESETS,
    ChessGrid,
    Drift,
    LiveScene,
    Pose,
    VirtualStage,
    calibration_plan,
    drift_plan,
    drift_preset,
    ladder_plan,
    preset,
    random_poses,
    render_frame,
    truth_of,
    zoom_plan,
)

# -- microscopes ----------------------------------------------------------------------------------


def test_jsm820_has_the_shape_of_the_published_instrument() -> None:
    low, high = preset("jsm820").camera_at(100.0), preset("jsm820").camera_at(10000.0)
    assert (low.ex, low.ey) == pytest.approx((230, 270), abs=0.2)
    assert (high.ex, high.ey) == pytest.approx((225, 265), abs=0.5)
    assert (low.xi_r, high.xi_r) == pytest.approx((0.007, 0.001), abs=2e-4)
    assert 1e-4 < low.xi_t < high.xi_t
    assert 1.0 / low.rho == pytest.approx(0.020)
    assert np.hypot(low.px - 255.5, low.py - 255.5) > 5.0
    # The scale is nearly, not exactly, proportional to g.
    assert high.m / low.m == pytest.approx(100.0, rel=0.02)
    assert high.m / low.m != pytest.approx(100.0, rel=0.002)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_parameters_are_no_low_order_polynomial_of_log_g(name: str) -> None:
    g = np.geomspace(100.0, 10000.0, 60)
    cameras = [PRESETS[name].camera_at(float(value)) for value in g]
    values = np.stack([camera.parameters for camera in cameras])
    values[:, 0] /= g
    u = 2 * (np.log(g) - np.log(100)) / np.log(100) - 1
    varying = np.flatnonzero(np.ptp(values, axis=0) > 1e-9 * np.abs(values).max(axis=0))
    for column in varying:
        curve = values[:, column] / np.ptp(values[:, column])
        fit = np.polynomial.legendre.legfit(u, curve, 3)
        assert np.abs(np.polynomial.legendre.legval(u, fit) - curve).max() > 1e-4


def test_parallel_preset_does_not_see_the_height() -> None:
    camera = preset("parallel").camera_at(300.0)
    points = np.array([[1e-4, 2e-5, 0.0], [1e-4, 2e-5, 1e-3]])
    xy = camera.project(points)
    assert np.array_equal(xy[0], xy[1])


# -- poses ----------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 8))
def test_random_poses_are_rotations_within_the_asked_limits(seed: int, count: int) -> None:
    poses = random_poses(seed, count, field_width_m=1e-4)
    assert len(poses) == count
    assert poses[0].tilt_rad < 1e-7
    for pose in poses[1:]:
        assert np.allclose(pose.R.T @ pose.R, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose.R) == pytest.approx(1.0)
        assert math.radians(15) - 1e-9 <= pose.tilt_rad <= math.radians(40) + 1e-9
    again = random_poses(seed, count, field_width_m=1e-4)
    assert all(np.array_equal(a.R, b.R) for a, b in zip(poses, again, strict=True))


def test_heights_have_the_stated_spread() -> None:
    poses = random_poses(0, 400, field_width_m=1e-4, first_flat=False)
    heights = np.array([pose.t_m[2] for pose in poses])
    assert heights.std() == pytest.approx(40e-6, rel=0.12)  # standard error 3.5 %


def test_a_matrix_that_is_no_rotation_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="rotation"):
        Pose(np.diag([1.0, 1.0, 1.1]), np.zeros(3))


# -- drift ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(DRIFTS))
def test_drift_begins_at_zero_and_is_smooth(name: str) -> None:
    drift = drift_preset(name)
    assert np.allclose(drift(0.0), 0.0, atol=1e-18)
    time_s = np.linspace(0.0, 120.0, 24001)
    path = drift(time_s)
    assert np.array_equal(path, drift(time_s))
    # No jumps: halving the step halves the largest increment.
    fine, coarse = np.abs(np.diff(path, axis=0)).max(), np.abs(np.diff(path[::2], axis=0)).max()
    assert fine <= 0.51 * coarse + 1e-20


def test_drift_parts_are_what_they_say() -> None:
    assert Drift(velocity_m_s=(2e-9, -1e-9))(10.0)[0] == pytest.approx([20e-9, -10e-9])
    settling = Drift(settling_m=(1e-7, 0.0), settling_time_s=20.0)
    assert settling(20.0)[0, 0] == pytest.approx(1e-7 * (1 - math.exp(-1)))
    assert settling(1e4)[0, 0] == pytest.approx(1e-7)
    wander = np.concatenate(
        [Drift(wander_m=1e-8, seed=seed)(np.arange(0.0, 4000.0, 0.5)) for seed in range(6)]
    )
    # The start is moved to zero, which adds a constant: compare the spread, not the RMS.
    spread = np.mean([part.std(axis=0) for part in np.split(wander, 6)])
    assert spread == pytest.approx(1e-8, rel=0.05)
    with pytest.raises(InvalidValueError, match="one of none"):
        drift_preset("sideways")


# -- plans and truth ------------------------------------------------------------------------------


def test_calibration_plan_is_laid_out_as_asked() -> None:
    plan = calibration_plan(preset("jsm820"), magnifications=[100.0, 1000.0, 8000.0], views=4)
    assert len(plan) == 12
    assert [frame.magnification for frame in plan.frames[::4]] == [100.0, 1000.0, 8000.0]
    assert [frame.square_m for frame in plan.frames[::4]] == [25e-6, 10e-6, 2e-6]
    times = [frame.start_time_s for frame in plan.frames]
    assert np.diff(times).min() >= plan.microscope.timing.acquisition_time_s
    # Poses differ between magnifications as well as within one.
    assert len({frame.pose.t_m.tobytes() for frame in plan.frames}) == 12
    assert len(calibration_plan(preset("jsm820"))) == 105


def test_truth_survives_json_and_reprojects_the_recording() -> None:
    microscope = preset("strong_perspective")
    plan = calibration_plan(
        microscope, magnifications=[3000.0], views=2, detector=NOISE_FREE, seed=5
    )
    truth = json.loads(json.dumps(truth_of(plan)))
    frame, p = truth["frames"][1], truth["parameters"][0]
    camera = ScanCamera(
        frame["magnification"],
        p["m_px_per_m"],
        p["aspect"],
        p["skew"],
        *p["principal_point_px"],
        p["rho_per_m"],
        p["xi_r"],
        p["xi_t"],
        *p["centre_px"],
        truth["norm_px"],
        truth["image_width_px"],
        truth["image_height_px"],
    )
    image = plan.render(1).astype(np.float32)
    centres = np.stack(np.meshgrid(np.arange(-20, 20), np.arange(-20, 20)), -1).reshape(-1, 2) + 0.5
    board = centres * frame["square_m"]
    sem = board @ np.array(frame["rotation"])[:, :2].T + frame["translation_m"]
    xy = camera.project(sem)
    seen = np.all((xy > 8) & (xy < 503), axis=1)
    assert seen.sum() > 40
    grey = image[np.rint(xy[seen, 1]).astype(int), np.rint(xy[seen, 0]).astype(int)]
    bright = np.mod(np.floor(centres[seen]).sum(axis=1), 2) == 0
    # Noise-free: every centre of a square has its own colour.
    assert grey[bright].min() > grey[~bright].max()
    assert frame["pixel_size_m"] == pytest.approx(camera.pixel_size_m)


def test_drift_plan_truth_is_the_drift_at_the_centre_of_each_frame() -> None:
    drift = Drift(velocity_m_s=(3e-9, -2e-9))
    microscope = preset("jsm820").with_timing(ScanTiming(0.5, 4, 0.1))
    truth = truth_of(drift_plan(microscope, frames=3, drift=drift))
    assert [frame["start_time_s"] for frame in truth["frames"]] == [0.0, 2.0, 4.0]
    assert truth["frames"][2]["drift_m"] == pytest.approx([15e-9, -10e-9])
    assert truth["frames"][2]["square_m"] is None
    assert truth["scan"] == {"frame_time_s": 0.5, "averages": 4, "flyback_fraction": 0.1}


def test_drift_recording_moves_as_its_truth_says() -> None:
    microscope = preset("ideal").with_image_size(256, 256)
    drift = Drift(velocity_m_s=(60e-9, -35e-9))
    plan = drift_plan(microscope, frames=8, drift=drift)
    images = [plan.render(index).astype(np.float32) for index in (0, 7)]
    window = cv2.createHanningWindow((256, 256), cv2.CV_32F)
    (dx, dy), _ = cv2.phaseCorrelate(images[0], images[1], window)
    moved_m = plan.drift_at_centre_m(7) - plan.drift_at_centre_m(0)
    expected = microscope.camera_at(5000.0).ideal_from_sem_jacobian @ moved_m
    assert np.hypot(*expected) > 1.5
    # Phase correlation of noisy frames is good to about 0.05 px.
    assert (dx, dy) == pytest.approx(tuple(expected), abs=0.15)


def test_ladder_plan_moves_turns_and_steps() -> None:
    scope = preset("jsm820")
    plan = ladder_plan(scope, first_magnification=8000.0, last_magnification=20000.0, views=4)
    seen = sorted({frame.magnification for frame in plan.frames})
    assert (seen[0], seen[-1], len(plan)) == (8000.0, 20000.0, 4 * len(seen))
    assert max(b / a for a, b in pairwise(seen)) <= 1.5 + 1e-4
    for frame in plan.frames:
        turn = math.atan2(frame.pose.R[1, 0], frame.pose.R[0, 0])
        assert frame.joints is not None
        # The scan turns by what is set, to a tenth of a degree (1-sigma).
        assert turn == pytest.approx(frame.joints["scan_rotation"], abs=math.radians(0.5))
        # What lies at the position of the stage is seen in the middle.
        at = np.array([[frame.joints["x"], frame.joints["y"]]])
        np.testing.assert_allclose(frame.pose.sem_from_specimen(at)[0, :2], 0.0, atol=1e-15)
    assert sum(
        abs(frame.joints["scan_rotation"]) > 1.0 for frame in plan.frames if frame.joints
    ) == len(seen)


def test_zoom_plan_keeps_the_pose_and_one_region() -> None:
    plan = zoom_plan(preset("jsm820"), frames=5)
    g = [frame.magnification for frame in plan.frames]
    assert (g[0], g[-1]) == (600.0, 6000.0)
    assert sorted(g) == g
    assert len({frame.square_m for frame in plan.frames}) == 1
    assert len({id(frame.pose) for frame in plan.frames}) == 1
    with pytest.raises(InvalidValueError, match="at least 1"):
        zoom_plan(preset("jsm820"), frames=0)
    with pytest.raises(InvalidValueError, match="'wood'"):
        drift_plan(preset("jsm820"), kind="wood")


def test_plan_frames_do_not_depend_on_the_order_of_rendering() -> None:
    plan = drift_plan(preset("jsm820").with_image_size(128, 128), frames=3)
    forwards = [plan.render(index) for index in range(3)]
    assert np.array_equal(plan.render(0), forwards[0])
    assert np.array_equal(plan.render(2), forwards[2])


# -- live scene -----------------------------------------------------------------------------------


def test_stage_integrates_its_commands() -> None:
    stage = VirtualStage().commanded(2.0, (1e-6, 0.0)).commanded(5.0, (0.0, -2e-6), 0.1)
    stage = stage.commanded(6.0, (0.0, 0.0))
    assert stage.position_at([6.0, 50.0]) == pytest.approx(np.array([[3e-6, -2e-6]] * 2))
    assert stage.rotation_at(50.0) == pytest.approx(0.1)
    # Rows scanned before a command moved as was commanded then.
    earlier = stage.position_at([0.0, 2.0, 3.0, 5.5])
    assert earlier == pytest.approx(np.array([[0.0, 0.0], [0.0, 0.0], [1e-6, 0.0], [3e-6, -1e-6]]))
    assert stage.rotation_at(5.5) == pytest.approx(0.05)
    with pytest.raises(InvalidValueError, match="not before"):
        stage.commanded(5.9, (0.0, 0.0))
    with pytest.raises(InvalidValueError, match="finite"):
        stage.commanded(7.0, (math.nan, 0.0))


def test_a_stage_that_is_put_to_a_place() -> None:
    there = VirtualStage().commanded(1.0, (1e-6, 0.0)).placed(2.0, (5e-6, 0.0))
    # Where it was before holds for the rows that were scanned before.
    assert there.position_at([1.5, 2.0, 3.0])[:, 0] == pytest.approx([0.5e-6, 5e-6, 6e-6])
    with pytest.raises(InvalidValueError, match="stage position"):
        there.placed(3.0, (np.nan, 0.0))


def test_a_stage_that_is_commanded_for_hours_keeps_no_more_than_it_needs() -> None:
    stage = VirtualStage()
    for second in range(2000):
        stage = stage.commanded(float(second), (1e-9, 0.0))
    kept = 0
    while stage.before is not None:
        kept, stage = kept + 1, stage.before
    assert 4 < kept < 100


def test_a_frame_after_a_move_is_the_frame_of_the_moved_specimen() -> None:
    microscope = preset("jsm820").with_image_size(256, 256)
    scene = LiveScene(microscope, "grid", magnification=4000.0, detector=NOISE_FREE)
    scene.set_twist(0.0, (1e-6, 0.5e-6), 0.2)
    scene.set_twist(2.0, (0.0, 0.0))
    frame = scene.frame(10.0)
    assert frame.square_m is not None
    expected = render_frame(
        microscope,
        ChessGrid(frame.square_m),
        Pose.flat((2e-6, 1e-6, 0.0), rotation_rad=0.4),
        4000.0,
        detector=NOISE_FREE,
    )
    assert np.abs(frame.image.astype(int) - expected).max() <= 1  # rounding
    assert frame.pose.t_m == pytest.approx([2e-6, 1e-6, 0.0])


def test_a_moving_stage_shears_the_frame_like_drift() -> None:
    microscope = preset("jsm820").with_image_size(256, 256)
    velocity = (0.4e-6, -0.2e-6)
    scene = LiveScene(microscope, "grid", magnification=4000.0, detector=NOISE_FREE)
    scene.set_twist(0.0, velocity)
    frame = scene.frame(1.0)
    assert frame.square_m is not None
    expected = render_frame(
        microscope,
        ChessGrid(frame.square_m),
        Pose.flat(),
        4000.0,
        start_time_s=1.0,
        drift=Drift(velocity_m_s=velocity),
        detector=NOISE_FREE,
    )
    assert np.abs(frame.image.astype(int) - expected).max() <= 2  # rounding


def test_magnification_and_image_settings_change_while_running() -> None:
    scene = LiveScene(preset("jsm820").with_image_size(128, 128), "gold", magnification=1000.0)
    first = scene.frame(0.0)
    scene.set_magnification(5000.0)
    scene.set_detector(bits=16)
    second = scene.frame(1.0)
    assert (first.magnification, second.magnification) == (1000.0, 5000.0)
    assert (first.image.dtype, second.image.dtype) == (np.uint8, np.uint16)
    for wrong in (0.0, -5.0, math.nan):
        with pytest.raises(InvalidValueError):
            scene.set_magnification(wrong)
    assert scene.magnification == 5000.0
    with pytest.raises(InvalidValueError, match="'wood'"):
        LiveScene(preset("jsm820"), "wood")


def test_a_frame_during_a_change_of_magnification_shows_both() -> None:
    microscope = preset("jsm820").with_image_size(128, 128).with_timing(ScanTiming(1.0, 2))
    scenes = [
        LiveScene(microscope, "grid", magnification=g, detector=NOISE_FREE)
        for g in (2000.0, 4000.0)
    ]
    before, after = (scene.frame(0.0).image.astype(int) for scene in scenes)
    scene = scenes[0]
    # In the second of two passes, at row 64: the rows above saw the old one twice.
    scene.set_magnification(4000.0, 1.5)
    mixed = scene.frame(0.0)
    assert (mixed.mixed, mixed.magnification) == (True, 4000.0)
    np.testing.assert_allclose(mixed.image[:64], before[:64], atol=1)
    np.testing.assert_allclose(mixed.image[65:], 0.5 * (before + after)[65:], atol=1)
    assert np.abs(before - after)[65:].max() > 50
    # Before and after it, frames are whole.
    assert not scene.frame(-1.0).mixed
    assert scene.frame(-1.0).magnification == 2000.0
    whole = scene.frame(1.5)
    assert (whole.mixed, whole.magnification) == (False, 4000.0)
    np.testing.assert_array_equal(whole.image, after)
    with pytest.raises(InvalidValueError, match="before"):
        scene.set_magnification(3000.0, 1.0)
