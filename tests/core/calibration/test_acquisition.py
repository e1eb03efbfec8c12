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

"""Which views a calibration that records itself takes, and which pictures it refuses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.acquisition import (
    AcquisitionGoal,
    ViewRequest,
    find_picture_fault,
    is_magnification_of,
    plan_survey,
    propose_visits,
    request_of_picture,
)
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.stage import stage_views
from tests.core.calibration.test_check import AXIS, SEM, STAGE

SQUARES_M = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)
GOAL = AcquisitionGoal((500.0, 10000.0), SQUARES_M, SEM.display_width_m, target=1.2e-3)


def calibrated(taken: tuple[ViewRequest, ...], seed: int) -> CalibrationModel:
    """As from views of these requests, on a stage with its usual faults."""
    visits = list({request.visit: request.magnification for request in taken}.values())
    views = stage_views(SEM.camera_at, visits, STAGE, seed=seed, readings=True, most_corners=150)
    return calibrate_views(
        views,
        image_size=SEM.image_size,
        display_width_m=SEM.display_width_m,
        options=CalibrationOptions(axis=AXIS, residual="off"),
    ).model


def largest_error(model: CalibrationModel) -> float:
    """Largest relative error of nm per pixel in the range."""
    errors = [
        np.divide(model.at(g).pixel_size_m, SEM.camera_at(g).pixel_size_m) - 1.0
        for g in np.geomspace(*GOAL.magnification_range, 30)
    ]
    return float(np.max(np.abs(errors)))


def test_a_recorded_picture_gets_the_request_that_it_must_have_answered() -> None:
    stage = StageReading(tilt_rad=0.35, scan_rotation_rad=-1.2)
    request = request_of_picture(GOAL, 7, 1234.0, stage)
    assert request == ViewRequest(7, 1234.0, 0.35, -1.2, 10e-6)
    assert request_of_picture(GOAL, 7, 10_100.0, None) is not None
    for outside in (480.0, 10_300.0):
        assert request_of_picture(GOAL, 7, outside, stage) is None
    # A display rounds.
    assert is_magnification_of(request, 1250.0) and not is_magnification_of(request, 1265.0)


def test_the_survey_covers_the_range_with_all_tilts_differently_turned() -> None:
    requests = plan_survey(GOAL)
    visits = [request.magnification for request in requests[::3]]
    assert (visits[0], visits[-1]) == GOAL.magnification_range
    ratios = np.divide(visits[1:], visits[:-1])
    assert ratios == pytest.approx(ratios[0]) and ratios[0] <= 1.7
    for number, request in enumerate(requests):
        assert request.visit == number // 3
        assert request.tilt_rad == GOAL.tilts_rad[number % 3]
        assert abs(request.turn_rad) <= math.pi
        # Eight squares or more across the field of 0.12 m over the magnification.
        field_m = GOAL.display_width_m / request.magnification
        assert field_m / request.square_m >= 8.0
    # No two of them lie the same way modulo the quarter turns that a lattice cannot tell.
    turns = np.sort([math.fmod(r.turn_rad + 2.0 * math.pi, 0.5 * math.pi) for r in requests])
    assert np.diff(turns).min() > math.radians(0.2)


def test_one_magnification_is_visited_several_times() -> None:
    goal = replace(GOAL, magnification_range=(2000.0, 2000.0))
    requests = plan_survey(goal)
    assert len({request.visit for request in requests}) == 4
    assert {request.magnification for request in requests} == {2000.0}


@pytest.mark.long
def test_it_goes_on_until_the_target_is_met_and_is_right_then() -> None:
    taken = plan_survey(GOAL)
    first = None
    for _ in range(6):
        model = calibrated(taken, 5)
        proposal = propose_visits(GOAL, model, taken)
        first = first or proposal
        if proposal.reason:
            break
        assert proposal.requests and not proposal.reached
        assert proposal.requests[0].visit == taken[-1].visit + 1
        taken = (*taken, *proposal.requests)
    assert first is not None and not first.reached
    assert proposal.reached and proposal.reason == "the target is met"
    assert proposal.largest <= GOAL.target < first.largest
    # 3 sigma, and what a magnification of this stage repeats to, over the visits, is in sigma.
    assert largest_error(model) < 3.0 * proposal.largest


@pytest.mark.long
def test_it_ends_when_no_more_views_are_allowed() -> None:
    goal = replace(GOAL, target=1e-5, most_views=24)
    taken = plan_survey(goal)
    model = calibrated(taken, 5)
    proposal = propose_visits(goal, model, taken)
    assert len(proposal.requests) == 3  # one visit is left
    proposal = propose_visits(goal, model, (*taken, *proposal.requests))
    assert proposal.requests == () and not proposal.reached
    assert "24 views" in proposal.reason


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"magnification_range": (2000.0, 500.0)}, "lower one first"),
        ({"magnification_range": (0.0, 500.0)}, "magnification"),
        ({"squares_m": ()}, "squares"),
        ({"tilts_rad": (0.0, 0.05)}, "6 degrees apart"),
        ({"tilts_rad": (0.0, 1.4)}, "80 degrees"),
        ({"target": 0.0}, "target"),
        ({"most_views": 12}, "at least 21 for this range"),
    ],
)
def test_goals_that_cannot_be_reached_are_refused(changed: dict[str, object], said: str) -> None:
    with pytest.raises(InvalidValueError, match=said):
        replace(GOAL, **changed)  # type: ignore[arg-type]  # wrong on purpose


# -- pictures ------------------------------------------------------------------------------------------

REQUEST = ViewRequest(0, 1000.0, 0.35, 0.2, 10e-6)
READING = StageReading(tilt_rad=0.36)


@pytest.fixture(scope="module")
def chess() -> np.ndarray:
    """Squares of 24 px, blurred by about 1 px, from 40 to 210."""
    y, x = np.mgrid[0:256, 0:256]
    wave = np.sin(np.pi * (x + 0.3 * y) / 24.0) * np.sin(np.pi * (y - 0.3 * x) / 24.0)
    noise = np.random.default_rng(0).normal(0.0, 2.0, wave.shape)
    return np.clip(125.0 + 85.0 * np.tanh(8.0 * wave) + noise, 1, 254).astype(np.uint8)


def found(image: np.ndarray) -> LatticeDetection:
    detection = find_lattice(image)
    assert isinstance(detection, LatticeDetection)
    return detection


def test_a_good_picture_has_no_fault(chess: np.ndarray) -> None:
    assert find_picture_fault(chess, found(chess), REQUEST, READING) == ""
    assert find_picture_fault(chess, found(chess), REQUEST, None) == ""


def test_another_tilt_than_asked_is_a_fault(chess: np.ndarray) -> None:
    fault = find_picture_fault(chess, found(chess), REQUEST, StageReading(tilt_rad=0.0))
    assert fault == "the stage is tilted by 0.0 degrees instead of 20.1"


def test_cut_off_grey_levels_are_a_fault(chess: np.ndarray) -> None:
    detection = found(chess)
    bright = np.clip(chess.astype(int) + 60, 0, 255).astype(np.uint8)
    assert "% of the pixels are white" in find_picture_fault(bright, detection, REQUEST, READING)
    deep = 257 * np.clip(chess.astype(np.uint16), 0, 255) * (chess > 60)
    assert "% of the pixels are black" in find_picture_fault(
        deep.astype(np.uint16), detection, REQUEST, READING
    )


def test_blur_and_a_grid_at_the_border_are_faults(chess: np.ndarray) -> None:
    detection = found(chess)
    blurred = replace(detection, blur_px=0.3 * detection.spacing_px)
    assert "out of focus" in find_picture_fault(chess, blurred, REQUEST, READING)
    left = detection.xy[:, 0] < 100.0
    part = replace(detection, xy=detection.xy[left])
    assert "move it to the middle" in find_picture_fault(chess, part, REQUEST, READING)
