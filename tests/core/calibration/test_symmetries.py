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

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.grid_views import grid_views

JSM = preset("jsm820")
MAGNIFICATIONS = (250.0, 500.0, 1000.0, 2000.0, 4000.0)
POINTS = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-0.3, 0.3)])

Change = Callable[[GridView], GridView]


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
    return _calibrate(views)


def _largest_sigmas(model: CalibrationModel, other: CalibrationModel, scale: int = 1) -> float:
    """The largest difference of the cameras at places of the field, in sigmas of the first."""
    largest = 0.0
    for g in (300.0, 700.0, 1500.0, 3000.0):
        camera = model.at(g)
        points = 200.0 / camera.m * POINTS
        seen = (other.at(g).project(points) + 0.5) / scale - 0.5
        off = np.abs(seen - camera.project(points)) / camera.project_sigma(points)
        largest = max(largest, float(off.max()))
    return largest


def test_the_order_of_the_views_does_not_matter(
    views: list[GridView], model: CalibrationModel
) -> None:
    order = np.random.default_rng(0).permutation(len(views))
    # Sums in another order differ by rounding.
    assert _largest_sigmas(model, _calibrate([views[k] for k in order])) < 1e-6


def test_twice_as_many_pixels_see_the_same(views: list[GridView], model: CalibrationModel) -> None:
    finer = [
        replace(v, image_xy=2.0 * (v.image_xy + 0.5) - 0.5, sigma_px=2.0 * v.sigma_px)
        for v in views
    ]
    assert _largest_sigmas(model, _calibrate(finer, (1024, 1024)), scale=2) < 1e-6


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
