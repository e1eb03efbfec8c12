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

"""The same views said in another way give the same camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import grid_views
from tests.helpers.made_once import made_once

JSM = preset("jsm820")
MAGNIFICATIONS = (250.0, 500.0, 1000.0, 2000.0, 4000.0)
POINTS = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-0.3, 0.3)])
MIDDLE = 0.5 * (np.array(JSM.image_size) - 1.0)
HALF_TURN, QUARTER_TURN = -np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])
MIRRORED_X, MIRRORED_Y = np.diag([-1.0, 1.0]), np.diag([1.0, -1.0])


@pytest.fixture(scope="module")
def views() -> list[GridView]:
    found = grid_views(JSM.camera_at, MAGNIFICATIONS, noise_px=0.05, views=4, seed=3)
    return [replace(view, name=str(k)) for k, view in enumerate(found)]


def _calibrate(
    views: list[GridView], image_size: tuple[int, int] = JSM.image_size
) -> CalibrationModel:
    return calibrate_views(views, image_size=image_size, display_width_m=JSM.display_width_m).model


@pytest.fixture(scope="module")
def model(views: list[GridView]) -> CalibrationModel:
    return made_once("calibrated-for-symmetries", lambda: _calibrate(views))


def _largest_sigmas(
    model: CalibrationModel, other: CalibrationModel, scale: int = 1, turn: Array | None = None
) -> float:
    """The largest difference of the cameras at places of the field, in sigmas of the first.

    The other one sees the places after ``turn`` (2, 2), and its pixels are turned back.
    """
    largest = 0.0
    back = np.eye(2) if turn is None else turn
    for g in (300.0, 700.0, 1500.0, 3000.0):
        camera = model.at(g)
        points = 200.0 / camera.m * POINTS
        turned = np.column_stack([points[:, :2] @ back.T, points[:, 2]])
        seen = (other.at(g).project(turned) + 0.5) / scale - 0.5
        seen = (seen - MIDDLE) @ back + MIDDLE
        off = np.abs(seen - camera.project(points)) / camera.project_sigma(points)
        largest = max(largest, float(off.max()))
    return largest


@pytest.mark.long
def test_the_order_of_the_views_does_not_matter(
    views: list[GridView], model: CalibrationModel
) -> None:
    order = np.random.default_rng(0).permutation(len(views))
    # Sums in another order differ by rounding.
    assert _largest_sigmas(model, _calibrate([views[k] for k in order])) < 1e-6


@pytest.mark.long
def test_twice_as_many_pixels_see_the_same(views: list[GridView], model: CalibrationModel) -> None:
    finer = [
        replace(v, image_xy=2.0 * (v.image_xy + 0.5) - 0.5, sigma_px=2.0 * v.sigma_px)
        for v in views
    ]
    assert _largest_sigmas(model, _calibrate(finer, (1024, 1024)), scale=2) < 1e-6


@pytest.mark.long
def test_the_numbers_of_the_lattice_do_not_matter(
    views: list[GridView], model: CalibrationModel
) -> None:
    quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
    other = [
        replace(v, board_xy_m=v.board_xy_m @ quarter + 50e-6 * np.array([1.0, -2.0])) for v in views
    ]
    # The height of a view is that of its origin, which is elsewhere now on a tilted grid: its prior, of a tenth of a
    # millimetre, is all that changes.
    assert _largest_sigmas(model, _calibrate(other)) < 0.05


@pytest.mark.parametrize(
    ("turn", "most_sigmas"),
    [
        pytest.param(HALF_TURN, 1e-6, id="half a turn", marks=pytest.mark.long),
        pytest.param(MIRRORED_X, 1e-6, id="mirrored along the lines", marks=pytest.mark.long),
        pytest.param(MIRRORED_Y, 1e-6, id="mirrored across the lines", marks=pytest.mark.long),
        # Drift within an image comes with the time of the lines: it is another one after a quarter turn.
        pytest.param(QUARTER_TURN, 0.01, id="a quarter turn", marks=pytest.mark.long),
    ],
)
def test_turned_and_mirrored_views_give_the_same_camera(
    views: list[GridView], model: CalibrationModel, turn: Array, most_sigmas: float
) -> None:
    """Where nothing settles after the flyback, which tells the left from the right."""
    # A grid that is seen mirrored is mirrored.
    grid = turn if np.linalg.det(turn) < 0.0 else np.eye(2)
    other = [
        replace(
            v,
            image_xy=(v.image_xy - MIDDLE) @ turn.T + MIDDLE,
            board_xy_m=v.board_xy_m @ grid.T,
        )
        for v in views
    ]
    assert _largest_sigmas(model, _calibrate(other), turn=turn) < most_sigmas
