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

"""Corners that are off together do not make a calibration as certain, or as bent, as independent ones would."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.correlated_errors import estimate_shared_excess_px
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import SimulatedStage, stage_views
from tests.helpers.bent_views import bend, bent_view
from tests.helpers.long_tests import long_but

SIZE = (512, 512)
CORNERS, OWN_PX = 160, 0.05


@dataclass(frozen=True)
class _View:
    sigma_px: Array


@dataclass(frozen=True)
class _Setup:
    views: tuple[_View, ...]
    image_size: tuple[int, int] = SIZE


@dataclass(frozen=True)
class _Problem:
    points_of_views: tuple[slice, ...]
    observed_px: Array
    across: None = None


@dataclass(frozen=True)
class _Result:
    residuals_px: Array


def estimated(rng: np.random.Generator, displaced, *, views: int = 12) -> float:
    """What is found in views of evenly spread corners with own noise; ``displaced`` adds to it, by view and place.

    A pose takes a shift and two slopes of each.
    """
    residuals, places = [], []
    for v in range(views):
        xy = rng.uniform(0.0, SIZE, (CORNERS, 2))
        left = OWN_PX * rng.normal(size=(CORNERS, 2)) + displaced(v, xy)
        taken = np.linalg.qr(np.column_stack([np.ones(CORNERS), xy]))[0]
        residuals.append(left - taken @ (taken.T @ left))
        places.append(xy)
    setup = _Setup(tuple(_View(np.full(CORNERS, OWN_PX)) for _ in range(views)))
    points = tuple(slice(v * CORNERS, (v + 1) * CORNERS) for v in range(views))
    problem = _Problem(points, np.concatenate(places))
    result = _Result(np.concatenate(residuals))
    return estimate_shared_excess_px(setup, problem, result)  # type: ignore[arg-type]


def nothing(v, xy):
    return np.zeros_like(xy)


@pytest.mark.parametrize("views", long_but(lambda views: views < 12, [2, 6, 12]))
def test_independent_corners_stay_as_they_are(views):
    """By chance one recording in a thousand is not; 400 show none or one, and three once in 10 000 times."""
    rng = np.random.default_rng(0)
    assert sum(estimated(rng, nothing, views=views) > 0.0 for _ in range(400)) <= 2


def test_images_that_are_bent_by_little_count_as_if_corners_were_off_by_much():
    """Twenty-four patterns have the variance of 160 corners: each has that of seven independent ones."""
    rng = np.random.default_rng(1)
    found = [estimated(rng, lambda _v, xy: 0.1 * bend(xy, SIZE, rng)) for _ in range(30)]
    assert np.mean(found) == pytest.approx(0.1 * np.sqrt(CORNERS / 24), rel=0.15)


def test_single_corners_that_are_elsewhere_bend_no_image():
    rng = np.random.default_rng(5)

    def displaced(v, xy):
        return 1.5 * rng.normal(size=xy.shape) * (rng.random((len(xy), 1)) < 0.02)

    assert sum(estimated(rng, displaced) > 0.0 for _ in range(100)) <= 1


def wave(xy):
    return 0.2 * np.cos(2.0 * np.pi * xy / SIZE * 1.5)[:, ::-1]


def test_what_all_views_share_is_the_camera_s():
    """A distortion that the model lacks is no error of the corners, however large."""
    rng = np.random.default_rng(2)
    assert sum(estimated(rng, lambda _v, xy: wave(xy)) > 0.0 for _ in range(30)) == 0
    # Where each view has another part of it, it is.
    assert estimated(rng, lambda _v, xy: rng.normal() * wave(xy)) > 2.0 * OWN_PX


def test_lines_that_move_along_x_are_counted_as_lines():
    rng = np.random.default_rng(3)

    def displaced(v, xy):
        jitter = np.convolve(rng.normal(0.0, 0.3, SIZE[1] + 20), np.ones(21) / 21.0, "valid")
        return np.column_stack([jitter[xy[:, 1].astype(int)], np.zeros(len(xy))])

    assert sum(estimated(rng, displaced) > 0.0 for _ in range(30)) == 0


def test_one_view_that_is_wrong_by_a_pixel_hardly_makes_the_others_uncertain():
    """It is in two of the seven pairs, whose median is the largest but one of the others then."""
    rng = np.random.default_rng(4)
    bent = [estimated(rng, lambda v, xy: 5.0 * wave(xy) * (v == 4), views=8) for _ in range(30)]
    assert max(bent) < OWN_PX and np.mean(np.array(bent) > 0.0) < 0.2


MICROSCOPE = preset("jsm820")
VISITS = (100.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0)
BETWEEN = (150.0, 350.0, 700.0, 1500.0, 3000.0)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_images_that_are_bent_otherwise_each_time_make_no_other_camera(seed):
    """A tenth of a pixel: the tilts do not make room for it, nm per pixel and points are within their sigmas."""
    rng = np.random.default_rng(seed)
    stage = SimulatedStage(tilts_rad=(0.0, 0.4, 0.6), axis_rad=None)
    views = stage_views(MICROSCOPE.camera_at, VISITS, stage, seed=seed, most_corners=150)
    result = calibrate_views(
        [bent_view(view, 0.1, MICROSCOPE.image_size, rng) for view in views],
        image_size=MICROSCOPE.image_size,
        display_width_m=MICROSCOPE.display_width_m,
    )
    said = result.model.statistics["fit"]
    # The grid of these views is exact; twice the usual spread would be 0.1 %.
    assert max(said["lattice_sigma"]) < 1e-3
    assert said["excess_sigma_px"] > 0.1
    assert any("neighbouring corners are off alike" in warning for warning in result.warnings)
    for g in BETWEEN:
        camera, truth = result.model.at(g), MICROSCOPE.camera_at(g)
        error = np.array(camera.pixel_size_m) - truth.pixel_size_m
        assert np.all(np.abs(error) < 4.0 * np.array(camera.pixel_size_sigma_m))
        points = truth.sem_from_ideal(truth.undistort(rng.uniform(0.0, 511.0, (40, 2))))
        off = camera.project(points) - truth.distort(truth.project_ideal(points))
        assert np.sqrt(np.mean((off / camera.project_sigma(points)) ** 2)) < 2.5
