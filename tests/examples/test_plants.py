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

"""Stages and pictures that the servo does not expect: one run of two of them, and what counts as moving unseen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from examples.visual_servo.live import without_residual
from examples.visual_servo.loop import Case, Run
from examples.visual_servo.plants import KNOWN_M, PLANTS, judge, run_plant
from semcal_ros.applications.servoing import PlaneCamera, TargetView
from semcal_ros.synthetic import preset

SCOPE = preset("jsm820").with_image_size(256, 256)
NAMED = {plant.name: plant for plant in PLANTS}


@pytest.fixture(scope="module")
def case() -> Case:
    """A calibration that is 0.3 % off in its scale, whose axis is 4 px off."""

    def camera_at(g: float):
        camera = SCOPE.camera_at(g)
        return replace(camera, m=1.003 * camera.m, px=camera.px + 4.0)

    return Case("estimated", camera_at, corrected=True)


@pytest.mark.long
def test_a_skewed_stage_comes_to_where_an_estimated_calibration_has_the_goal(case: Case) -> None:
    plant = NAMED["10 % off, axes turned by 3 degrees"]
    outcome = run_plant(plant, case, SCOPE, seed=52, known_m=2.0 * KNOWN_M, frames=9)
    assert outcome.blind == 0
    assert outcome.reasons == ()
    # From 11 px away; nothing tells at one magnification that the axis of the calibration is off.
    assert 2.0 < outcome.final_px < 8.0


def test_a_picture_that_cannot_be_read_moves_nothing_and_says_why(case: Case) -> None:
    outcome = run_plant(NAMED["contrast reversed"], case, SCOPE, seed=1, frames=3)
    assert not outcome.converged
    assert outcome.blind == 0
    assert outcome.reasons == ("no marker of the target in view",) * 3


@pytest.mark.parametrize(
    ("twist", "own_m", "blind"), [(1e-6, 1e-6, 0), (1e-6, 9e-6, 2), (0.0, 9e-6, 0)]
)
def test_what_counts_as_moving_unseen(twist: float, own_m: float, blind: int) -> None:
    """Frames without a marker: it counts where the stage moved and the servo did not know where the target is."""
    run = Run("made up")
    for _ in range(2):
        run.raw.append(np.full((64, 64), 90, np.uint8))
        run.twist.append(np.array([twist, 0.0, 0.0]))
        run.true_error.append(np.array([1.5e-6, 0.0, 0.0]))
        run.own_m.append(own_m)
        run.true_px.append(3.0)
        run.converged.append(False)
        run.reason.append("")
    assert judge(run).blind == blind


def test_the_referee_of_the_live_run_knows_the_residual() -> None:
    """At 5000x the residual of this microscope moves the goal by 0.2 px: a referee without it blames the servo."""
    scope, g = preset("scan_nonlinear"), 5000.0
    camera = scope.camera_at(g)
    corners = 2e-6 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + np.array([3e-6, -2e-6])
    raw = scope.project(g, np.column_stack([corners, np.zeros(4)]))
    plane = PlaneCamera.from_camera(camera)
    seen = plane.project(camera.sem_from_ideal(camera.undistort(raw))[:, :2])
    view = TargetView(np.array([0]), corners[None], seen[None], np.eye(8)[None])
    truth = plane.project(corners)
    assert np.abs(seen - truth).max() > 0.1
    np.testing.assert_allclose(without_residual(view, scope, g).xy[0], truth, atol=1e-6)
