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

"""The stage of the virtual SEM: an axis that misses, scales of visits, faults of the grid, jitter of the lines."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.synthetic import (
    NOISE_FREE,
    STAGES,
    TYPICAL_GRID,
    ChessGrid,
    Detector,
    GridFaults,
    LiveScene,
    Pose,
    SimulatedStage,
    calibration_plan,
    drift_plan,
    make_stage,
    pose_on_stage,
    preset,
    render_frame,
    steps_plan,
    truth_of,
)
from semcal_ros.synthetic.detector import _shift_lines
from semcal_ros.synthetic.render import trace_ray_lattice
from semcal_ros.synthetic.stage import ActuatorFaults, StageActuator, visit_scales

ONE_AXIS, TWO_AXIS = STAGES["one-axis"], STAGES["two-axis"]
SCOPE = preset("jsm820")
# Each of them several times what is usual.
WORN = GridFaults(stretch=4e-3, shear=-2e-3, curvature=50.0, wave=2e-2)


def height_on_beam(pose: Pose) -> float:
    """Where the specimen's plane crosses the beam."""
    normal = pose.R[:, 2]
    return float(normal @ pose.t_m / normal[2])


# -- the stage ------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis_deg", [0.0, 37.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, -35.0, 60.0])
def test_an_axis_that_misses_changes_the_height_by_the_tilt(axis_deg: float, tilt_deg: float):
    """A plane that turns about a line ``d`` beside and ``e`` below the beam's foot crosses the beam at
    e (1 - 1 / cos t) - d tan t.
    """
    d, e, t = 1e-4, 7e-5, math.radians(tilt_deg)
    stage = SimulatedStage(axis_rad=math.radians(axis_deg), miss_m=(d, e))
    expected = e * (1.0 - 1.0 / math.cos(t)) - d * math.tan(t)
    for offset in ((0.0, 0.0), (30e-6, -20e-6)):
        pose, position = pose_on_stage(stage, t, 0.8, offset_m=offset)
        assert height_on_beam(pose) == pytest.approx(expected, abs=1e-15)
        assert pose.t_m[:2] == pytest.approx(offset, abs=1e-15)
        assert pose.tilt_rad == pytest.approx(abs(t), abs=1e-7)
        assert (position.tilt_rad, position.rotation_rad) == (t, 0.8)
    raised, _ = pose_on_stage(stage, t, 0.8, height_m=5e-6)
    assert height_on_beam(raised) == pytest.approx(expected + 5e-6, abs=1e-15)


def test_tilt_and_rotation_have_the_signs_of_the_contract():
    """A positive tilt lowers what lies at +90 degrees from the axis; a positive rotation turns +x towards +y."""
    axis = math.radians(25.0)
    tilted, _ = pose_on_stage(SimulatedStage(axis_rad=axis), 0.3, 0.0)
    side = np.array([math.cos(axis + 0.5 * math.pi), math.sin(axis + 0.5 * math.pi), 0.0])
    assert (tilted.R @ side)[2] == pytest.approx(math.sin(0.3))
    turned, _ = pose_on_stage(SimulatedStage(axis_rad=axis), 0.0, 0.2)
    assert turned.R[:, 0] == pytest.approx([math.cos(0.2), math.sin(0.2), 0.0])
    # First the rotation: the normal does not depend on it.
    both, _ = pose_on_stage(SimulatedStage(axis_rad=axis), 0.3, 0.2)
    assert both.R[:, 2] == pytest.approx(tilted.R[:, 2])


def test_x_and_y_move_the_specimen_on_the_tilted_stage():
    """On a stage that is tilted by 60 degrees about x, 10 um across in the image are 20 um of travel."""
    stage = SimulatedStage(axis_rad=0.0)
    tilt = math.radians(60.0)
    _, home = pose_on_stage(stage, tilt, 0.0)
    _, moved = pose_on_stage(stage, tilt, 0.0, offset_m=(5e-6, 10e-6))
    assert (moved.x_m - home.x_m, moved.y_m - home.y_m) == pytest.approx((5e-6, 20e-6))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"name": "three-axis"}, "stage 'three-axis'; expected one of one-axis, two-axis"),
        ({"eucentric_error_m": 0.02}, "misses the specimen by 20000 and 0 um"),
        ({"repeatability": 0.2}, "a repeatability of 20 %; expected 0 to 5 %"),
        ({"repeatability": -0.001}, "a repeatability of -0.1 %"),
        ({"name": "two-axis", "eucentric_error_m": 1e-5}, "10 um of a two-axis stage"),
    ],
)
def test_stages_that_do_not_exist_are_refused(change, reason):
    with pytest.raises(InvalidValueError) as refusal:
        make_stage(**change)
    assert reason in str(refusal.value)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"stretch": 0.2}, "a grid with stretch 0.2"),
        ({"wave": math.nan}, "a grid with wave nan"),
        ({"curvature": 1e3}, "a radius of 1 mm; expected at least 5 mm"),
        ({"squares_sigma": -1e-3}, "no negative spread"),
        ({"wave_squares": 0.0}, "waves of two squares or more"),
    ],
)
def test_grids_that_do_not_exist_are_refused(change, reason):
    with pytest.raises(InvalidValueError) as refusal:
        GridFaults(**change)
    assert reason in str(refusal.value)


def test_visits_come_back_with_the_stated_spread():
    scales = np.array(list(islice(visit_scales(ONE_AXIS, 3), 4000)))
    assert scales.std() == pytest.approx(ONE_AXIS.scale_sigma, rel=0.05)  # 4.5 standard errors
    assert abs(scales.mean() - 1.0) < 5.0 * ONE_AXIS.scale_sigma / math.sqrt(4000)
    assert list(islice(visit_scales(None, 3), 3)) == [1.0, 1.0, 1.0]


# -- what the images show -------------------------------------------------------------------------


def worn_view() -> tuple[ChessGrid, Pose, float]:
    """A grid, a pose and the scale of a visit with faults that can be seen."""
    board = ChessGrid(25e-6, WORN, size_error=3e-3)
    pose, _ = pose_on_stage(
        make_stage(eucentric_error_m=3e-4), math.radians(40.0), 0.6, offset_m=(2e-5, -1e-5)
    )
    return board, pose, 1.004


def pixels_of(board: ChessGrid, pose: Pose, g: float, scale: float, x, y) -> np.ndarray:
    """Where points of the board are seen: rigid body, true camera, and the scale about the image's centre."""
    body = (1.0 + board.size_error) * board.faults.applied(x, y, board.square_m)
    camera = SCOPE.camera_at(g)
    middle = 0.5 * (np.array(SCOPE.image_size) - 1.0)
    ideal = camera.project_ideal(body @ pose.R.T + pose.t_m)
    return camera.distort(middle + scale * (ideal - middle))


@pytest.mark.parametrize("g", [100.0, 1000.0])
def test_every_pixel_shows_the_point_that_projects_to_it(g: float):
    board, pose, scale = worn_view()
    rays = trace_ray_lattice(SCOPE.during_visit(scale), g, 1, 0)
    lattice = rays.meet(pose)
    x, y = board.undeform(lattice.u_m, lattice.v_m, lattice.lift)
    rows = slice(0, None, 37)
    shown_x, shown_y = x[rows] @ rays.basis, y[rows] @ rays.basis
    xy = pixels_of(board, pose, g, scale, shown_x.ravel(), shown_y.ravel())
    columns, lines = np.meshgrid(np.arange(512.0), rays.lines[rows])
    expected = np.stack([columns.ravel(), lines.ravel()], axis=1)
    # The quintic splines between the nodes, over a wave of 130 px (at 100x), leave 2e-5 px.
    np.testing.assert_allclose(xy, expected, atol=1e-4)
    # The faults are no small matter: without any one of them, the points are elsewhere.
    for name in ("stretch", "shear", "curvature", "wave"):
        other = replace(board, faults=replace(WORN, **{name: 0.0}))
        moved = pixels_of(other, pose, g, scale, shown_x.ravel(), shown_y.ravel())
        assert np.abs(moved - expected).max() > 0.04, name


def test_corners_of_the_image_are_where_the_points_project():
    """Found in the picture: the grid's faults, the pose and the scale of the visit together."""
    board, pose, scale = worn_view()
    g = 700.0
    detector = replace(NOISE_FREE, blur_px=0.8)
    image = render_frame(SCOPE.during_visit(scale), board, pose, g, detector=detector)
    found = find_lattice(image)
    assert not isinstance(found, Rejection), found.reason
    i, j = (
        v.ravel() * board.square_m for v in np.meshgrid(np.arange(-60.0, 61), np.arange(-60.0, 61))
    )
    xy = pixels_of(board, pose, g, scale, i, j)
    xy = xy[np.all(np.isfinite(xy), axis=1)]
    distance = np.linalg.norm(found.xy[:, None] - xy[None], axis=2).min(axis=1)
    assert len(distance) > 50
    # What the detector of corners itself leaves on a sharp board without noise.
    assert np.sqrt(np.mean(distance**2)) < 0.02


def test_a_perfect_grid_is_left_alone():
    u, v = np.linspace(-1e-4, 1e-4, 7), np.linspace(2e-4, 0.0, 7)
    lift = np.ones((2, 7))
    same = ChessGrid(5e-6).undeform(u, v, lift)
    assert same[0] is u
    assert same[1] is v
    smaller = ChessGrid(5e-6, size_error=-0.01).undeform(u, v, lift)
    np.testing.assert_allclose(smaller, (u / 0.99, v / 0.99))


def test_lines_are_shifted_by_what_was_drawn():
    columns = np.arange(200.0)
    shifts = np.array([0.0, 0.3, -0.3, 1.0, -2.6, 0.5])
    waves = np.sin(2.0 * np.pi * columns / 8.0).astype(np.float32)
    shifted = _shift_lines(np.tile(waves, (len(shifts), 1)), shifts)
    expected = np.sin(2.0 * np.pi * (columns - shifts[:, None]) / 8.0)
    # Eight samples of a wave of eight: 1e-3 of its amplitude, 1e-3 px. The ends are continued as they are.
    np.testing.assert_allclose(shifted[:, 8:-8], expected[:, 8:-8], atol=2e-3)
    np.testing.assert_array_equal(shifted[0], waves)


def test_line_jitter_has_the_stated_spread_and_leaves_the_rest_alone():
    board, pose = ChessGrid(5e-6), Pose.flat(rotation_rad=0.4)
    steady = replace(NOISE_FREE, blur_px=0.8)
    still, jittered = (
        render_frame(SCOPE, board, pose, 2000.0, detector=d, seed=8).astype(np.float64)
        for d in (steady, replace(steady, line_jitter_px=0.2))
    )
    slope = np.gradient(still, axis=1)[:, 4:-4]
    difference = (jittered - still)[:, 4:-4]
    shift = -np.sum(difference * slope, axis=1) / np.sum(slope**2, axis=1)
    # 512 lines: 3 % standard error; and the second order of a shift by 0.2 px of edges 0.8 px wide: 2 %.
    assert shift.std() == pytest.approx(0.2, rel=0.15)
    assert abs(np.corrcoef(shift[1:], shift[:-1])[0, 1]) < 0.2
    with pytest.raises(InvalidValueError, match="a line jitter of -1 px"):
        Detector(line_jitter_px=-1.0)


# -- recordings -----------------------------------------------------------------------------------


def test_magnifications_are_visited_on_the_way_up_and_down():
    g = [100.0, 1000.0, 8000.0]
    plan = calibration_plan(SCOPE, magnifications=g, views=5, stage=ONE_AXIS, grid=TYPICAL_GRID)
    assert len(plan) == 15
    visits = list(dict.fromkeys((f.visit, f.magnification) for f in plan.frames))
    assert visits == [(0, 100.0), (1, 1000.0), (2, 8000.0), (3, 1000.0), (4, 100.0)]
    assert Counter(f.visit for f in plan.frames) == {0: 3, 1: 3, 2: 5, 3: 2, 4: 2}
    # One scale for each visit, and no two alike.
    assert len({(f.visit, f.visit_scale) for f in plan.frames}) == 5
    assert len({f.visit_scale for f in plan.frames}) == 5
    # Every visit begins untilted; the others take the stage's tilts in turn.
    tilts = [math.degrees(f.position.tilt_rad) for f in plan.frames if f.position is not None]
    assert [t for t in tilts if t] == pytest.approx([20, 30, 40, 20, 30, 40, 20, 30, 40, 20])
    starts = [k for k, f in enumerate(plan.frames) if k == 0 or plan.frames[k - 1].visit != f.visit]
    assert [tilts[k] for k in starts] == [0.0] * 5
    # The lines jitter as the stage says.
    assert plan.detector.line_jitter_px == ONE_AXIS.line_jitter_px
    assert len(calibration_plan(SCOPE, stage=ONE_AXIS)) == len(calibration_plan(SCOPE))


def test_heights_of_a_recording_follow_the_tilts():
    stage = replace(ONE_AXIS, height_sigma_m=0.0, miss_m=(2e-4, 0.0))
    plan = calibration_plan(SCOPE, magnifications=[100.0, 3000.0], views=6, stage=stage)
    for frame in plan.frames:
        assert frame.position is not None
        expected = -2e-4 * math.tan(frame.position.tilt_rad)
        assert height_on_beam(frame.pose) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("views", [1, 2, 3])
def test_few_views_are_shared_between_the_visits(views: int):
    plan = calibration_plan(SCOPE, magnifications=[100.0, 1000.0], views=views, stage=ONE_AXIS)
    assert len(plan) == 2 * views
    assert len(calibration_plan(SCOPE, magnifications=[5.0], views=views, stage=ONE_AXIS)) == views
    # A stage that tilts in every direction is visited alike, and says nothing.
    other = calibration_plan(SCOPE, magnifications=[100.0, 1000.0], views=views, stage=TWO_AXIS)
    assert [f.magnification for f in other.frames] == [f.magnification for f in plan.frames]
    assert all(f.joints is None for f in other.frames)


def test_a_recording_is_the_same_for_the_same_seed():
    def recorded(seed: int):
        g = [100.0, 1000.0]
        return calibration_plan(
            SCOPE, magnifications=g, views=4, stage=ONE_AXIS, grid=TYPICAL_GRID, seed=seed
        )

    assert truth_of(recorded(4)) == truth_of(recorded(4))
    first, other = truth_of(recorded(4)), truth_of(recorded(5))
    for key in ("rotation", "visit_scale", "stage_read"):
        assert first["frames"][0][key] != other["frames"][0][key]
    assert first["grid"]["square_errors"] != other["grid"]["square_errors"]
    small = [
        calibration_plan(
            SCOPE.with_image_size(64, 64), magnifications=[2000.0], views=1, stage=ONE_AXIS
        ).render(0)
        for _ in range(2)
    ]
    assert np.array_equal(*small)


def test_readings_are_the_truth_with_a_constant_error_and_scatter():
    plan = calibration_plan(SCOPE, magnifications=[100.0 * k for k in range(1, 81)], stage=ONE_AXIS)
    errors = np.array(
        [
            [
                f.position_read.tilt_rad - f.position.tilt_rad,
                f.position_read.rotation_rad - f.position.rotation_rad,
            ]
            for f in plan.frames
            if f.position is not None and f.position_read is not None
        ]
    )
    assert len(errors) == 400
    constant = (ONE_AXIS.tilt_error_rad, ONE_AXIS.rotation_error_rad)
    scatter = (ONE_AXIS.reading_sigma_rad, ONE_AXIS.rotation_sigma_rad)
    assert errors.std(axis=0) == pytest.approx(scatter, rel=0.15)  # four standard errors
    np.testing.assert_allclose(errors.mean(axis=0), constant, atol=0.2 * max(scatter))
    # Less than configurations say, 0.2 and 0.5 degrees.
    assert scatter[0] < 0.0035
    assert scatter[1] < 0.0087


def test_truth_tells_the_stage_the_grid_and_the_visits():
    plan = calibration_plan(
        SCOPE, magnifications=[500.0, 5000.0], views=2, stage=ONE_AXIS, grid=TYPICAL_GRID
    )
    truth = json.loads(json.dumps(truth_of(plan)))
    assert truth["stage"]["tilt_axis_rad"] == ONE_AXIS.axis_rad
    assert truth["stage"]["miss_m"] == [1e-4, 0.0]
    assert truth["stage"]["repeatability"] == 1.5e-3
    assert truth["grid"]["stretch"] == 2e-4
    assert truth["grid"]["square_errors"][0]["square_m"] == 25e-6
    for row, frame in zip(truth["frames"], plan.frames, strict=True):
        camera = SCOPE.camera_at(frame.magnification)
        scaled = np.array(camera.pixel_size_m) / frame.visit_scale
        assert row["pixel_size_m"] == pytest.approx(scaled)
        assert row["stage"]["tilt"] == frame.position.tilt_rad
        assert row["stage_read"]["tilt"] == frame.position_read.tilt_rad
        assert row["visit_scale"] == frame.visit_scale
    perfect = truth_of(calibration_plan(SCOPE, magnifications=[500.0], views=1))
    assert perfect["stage"] is None
    assert perfect["grid"] is None
    assert perfect["frames"][0]["stage_read"] is None


def test_frames_show_the_scale_of_their_visit_and_the_faults_of_the_grid():
    scope = SCOPE.with_image_size(128, 128)
    stage = replace(make_stage(repeatability=0.02), line_jitter_px=0.0)
    plan = calibration_plan(
        scope, magnifications=[2000.0], views=1, stage=stage, grid=WORN, detector=NOISE_FREE
    )
    (frame,) = plan.frames
    scene = LiveScene(
        scope,
        magnification=2000.0,
        pose=frame.pose,
        detector=NOISE_FREE,
        faults=stage,
        grid=WORN,
    )
    live = scene.frame(0.0)
    assert live.visit_scale == frame.visit_scale != 1.0
    board = ChessGrid(frame.square_m, WORN, WORN.size_errors(0)[frame.square_m])
    moved = scope.during_visit(frame.visit_scale)
    expected = render_frame(moved, board, frame.pose, 2000.0, detector=NOISE_FREE)
    for image in (plan.render(0), live.image):
        np.testing.assert_array_equal(image, expected)
    for other in (
        render_frame(scope, board, frame.pose, 2000.0, detector=NOISE_FREE),
        render_frame(moved, ChessGrid(board.square_m), frame.pose, 2000.0, detector=NOISE_FREE),
    ):
        assert np.abs(other.astype(float) - expected).max() > 1000.0  # of 65535


def test_a_stage_that_stands_still_is_seen_at_every_step():
    plan = steps_plan(SCOPE, frames=2, stage=ONE_AXIS, grid=TYPICAL_GRID)
    assert [f.visit for f in plan.frames] == [0, 0, 1, 1, 2, 2]
    assert len({f.visit_scale for f in plan.frames}) == 3
    expected = -1e-4 * math.tan(math.radians(8.0))
    assert height_on_beam(plan.frames[0].pose) == pytest.approx(expected, abs=1e-12)
    assert len({str(f.joints) for f in plan.frames}) == 1
    still = drift_plan(SCOPE, frames=2, stage=ONE_AXIS)
    assert still.frames[0].pose.tilt_rad < 1e-7
    assert [f.visit for f in still.frames] == [0, 0]


# -- live -----------------------------------------------------------------------------------------


def test_a_magnification_that_is_set_again_comes_back_with_another_scale():
    scope = SCOPE.with_image_size(96, 96)
    scene = LiveScene(scope, "flat", magnification=1000.0, faults=ONE_AXIS, grid=TYPICAL_GRID)
    scales = [scene.frame(0.0).visit_scale]
    for time_s, g in ((1.0, 1000.0), (2.0, 2000.0), (3.0, 1000.0)):
        scene.set_magnification(g, time_s)
        scales.append(scene.frame(time_s).visit_scale)
    # What is not changed does not change.
    assert scales[0] == scales[1]
    assert len(set(scales)) == 3
    assert scene.detector.line_jitter_px == ONE_AXIS.line_jitter_px


def test_a_frame_that_is_being_scanned_shows_the_specimen_before_it_is_tilted():
    scope = preset("ideal").with_image_size(96, 96)
    scene = LiveScene(scope, "grid", magnification=4000.0, detector=NOISE_FREE)
    flat, steep = Pose.flat(), Pose.tilted(0.5, 0.0, 0.0)
    scene.set_pose(steep, 10.0)
    assert scene.frame(9.9).pose.tilt_rad == pytest.approx(flat.tilt_rad)
    assert scene.frame(10.0).pose.tilt_rad == pytest.approx(0.5)
    # The clock of a simulation may begin anew.
    scene.set_pose(flat, 2.0)
    assert scene.frame(12.0).pose.tilt_rad < 1e-7


def travel(pieces: list[tuple[float, tuple[float, float]]], end_s: float) -> np.ndarray:
    ends = [*(t for t, _ in pieces[1:]), end_s]
    steps = zip(pieces, ends, strict=True)
    return np.sum([(end - begin) * np.array(v) for (begin, v), end in steps], axis=0)


def test_a_perfect_stage_does_what_it_is_told() -> None:
    assert StageActuator().obey((1e-6, -2e-6), 3.0, 4.0) == [(3.0, (1e-6, -2e-6))]


def test_gain_and_direction() -> None:
    stage = StageActuator(ActuatorFaults(gain=(1.1, 0.9), turned_rad=math.radians(90.0)))
    ((_, velocity),) = stage.obey((1.0, 1.0), 0.0, 1.0)
    assert velocity == pytest.approx((-0.9, 1.1))


def test_play_is_lost_at_every_reversal_and_only_there() -> None:
    stage = StageActuator(ActuatorFaults(backlash_m=(2.0, 0.0)))
    assert travel(stage.obey((1.0, 0.0), 0.0, 5.0), 5.0)[0] == pytest.approx(5.0)
    # Half of the play, and a stop, which changes nothing; then the other half.
    assert travel(stage.obey((-1.0, 1.0), 5.0, 6.0), 6.0) == pytest.approx([0.0, 1.0])
    assert travel(stage.obey((0.0, 0.0), 6.0, 9.0), 9.0) == pytest.approx([0.0, 0.0])
    assert stage.obey((-1.0, 0.0), 9.0, 12.0) == [(9.0, (0.0, 0.0)), (10.0, (-1.0, 0.0))]
    assert travel(stage.obey((-1.0, 0.0), 12.0, 13.0), 13.0)[0] == pytest.approx(-1.0)
    assert travel(stage.obey((1.0, 0.0), 13.0, 16.0), 16.0)[0] == pytest.approx(1.0)


@pytest.mark.parametrize("faults", [{"gain": (0.0, 1.0)}, {"backlash_m": (-1.0, 0.0)}])
def test_absurd_faults_are_refused(faults: dict[str, tuple[float, float]]) -> None:
    with pytest.raises(InvalidValueError):
        ActuatorFaults(**faults)
