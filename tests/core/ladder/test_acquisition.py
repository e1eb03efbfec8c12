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

"""Which pictures of a ladder serve, and what they tell of the stage."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.ladder.acquisition import (
    PictureRequest,
    TakenPicture,
    find_offset,
    learn_motion,
    plan_ladder,
    plan_pictures,
    take_picture,
)
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.core.ladder.thresholds import STEP_MAX
from tests.helpers.ladders import SIZE, calibration_of, camera_at, make_scope, take

G = 7000.0
MIDDLE = PictureRequest(0, G, (0.0, 0.0), 0.0)
FIRST_MOVE = PictureRequest(0, G, (0.25, 0.08), 0.0)
SECOND_MOVE = PictureRequest(0, G, (-0.07, 0.26), 0.0)
TURNED = PictureRequest(0, G, (0.0, 0.0), 0.5 * math.pi)


def _picture(
    place: tuple[float, float] = (0.0, 0.0),
    turn_rad: float = 0.0,
    *,
    g: float = G,
    told_rad: float | None = None,
) -> LadderPicture:
    image = take(make_scope(), g, place, turn_rad, seed=round(100.0 * sum(place)) % 97)
    return LadderPicture(np.rint(image).astype(np.uint8), g, "", told_rad)


@pytest.fixture(scope="module")
def middle() -> TakenPicture:
    return take_picture(
        calibration_of(make_scope()), [], MIDDLE, _picture(told_rad=0.0), (0.0, 0.0)
    )


@pytest.mark.parametrize("g", [G, 1.5 * G, G / 1.5])
def test_the_offset_is_where_the_middle_of_the_other_picture_lies(g: float) -> None:
    scope = make_scope()
    found = find_offset(calibration_of(scope), _picture(), _picture((0.2, -0.1), g=g))
    # What was in the middle is the place (0, 0), which lies to the left now, and lower.
    camera = camera_at(scope, g)
    field = scope.display_m / g
    at = camera.project(np.array([[-0.2 * field, 0.1 * field, 0.0]]))[0]
    before = camera_at(scope, G)
    middle = np.full((1, 2), 0.5 * (SIZE - 1.0))
    axis = before.sem_from_ideal(before.undistort(middle))[0, :2]
    # The middle of a picture lies off the axis by some pixels; at another magnification by others.
    at = at + axis / before.pixel_size_m * (g / G)
    assert isinstance(found, np.ndarray)
    np.testing.assert_allclose(found, at - 0.5 * (SIZE - 1.0), atol=1.5)


def test_requests_are_those_of_the_plan() -> None:
    model = calibration_of(make_scope())
    requests = plan_pictures(model, 2e4)
    assert [request.visit for request in requests] == [k // 4 for k in range(len(requests))]
    assert [request.is_middle for request in requests[:4]] == [True, False, False, False]
    assert requests[-1].magnification == 2e4
    assert not any(request.turn_rad for request in plan_pictures(model, 2e4, turned=False))


@pytest.mark.parametrize(
    ("request_", "picture", "said"),
    [
        (MIDDLE, lambda: _picture(g=1.1 * G), "a picture at 7700x; expected 7000x"),
        (MIDDLE, lambda: _picture((0.3, 0.0)), "off the middle by 30 % of the field"),
        (FIRST_MOVE, lambda: _picture((0.04, 0.0)), "moved by 4 % of the field"),
        (TURNED, _picture, "does not match the one in the middle"),
        (TURNED, lambda: _picture(told_rad=0.0), "turned by 0 degrees .* expected 90"),
        (FIRST_MOVE, lambda: _picture((7.0, 3.0)), "does not match"),
    ],
)
def test_pictures_that_do_not_serve_say_why(
    middle: TakenPicture, request_: PictureRequest, picture: Callable[[], LadderPicture], said: str
) -> None:
    with pytest.raises(CalibrationError, match=said):
        take_picture(calibration_of(make_scope()), [middle], request_, picture())


def test_what_shows_nothing_is_refused_at_once() -> None:
    model, rng = calibration_of(make_scope()), np.random.default_rng(0)
    noise = LadderPicture(rng.normal(100.0, 5.0, (SIZE, SIZE)).astype(np.uint8), G)
    with pytest.raises(CalibrationError, match="noise only"):
        take_picture(model, [], MIDDLE, noise)
    white = LadderPicture(np.full((SIZE, SIZE), 255, dtype=np.uint8), G)
    with pytest.raises(CalibrationError, match="100 % of the pixels are white"):
        take_picture(model, [], MIDDLE, white)


def test_another_shape_than_that_of_the_calibration_is_refused_at_once() -> None:
    wide = LadderPicture(np.zeros((SIZE // 2, SIZE), dtype=np.uint8), G)
    with pytest.raises(InvalidValueError, match="256 x 128 px; expected the shape of the"):
        take_picture(calibration_of(make_scope()), [], MIDDLE, wide)


def test_either_sense_of_a_turned_scan_serves(middle: TakenPicture) -> None:
    model = calibration_of(make_scope())
    for turn in (0.5 * math.pi, -0.5 * math.pi):
        taken = take_picture(model, [middle], TURNED, _picture(turn_rad=turn))
        assert taken.offset_px is not None and np.max(np.abs(taken.offset_px)) < 10.0


def test_two_moves_teach_which_way_the_picture_follows_the_stage(middle: TakenPicture) -> None:
    scope, model = make_scope(), calibration_of(make_scope())
    field = scope.display_m / G
    # The stage is mirrored: its x takes the picture to where its y is expected.
    first = take_picture(model, [middle], FIRST_MOVE, _picture((0.25, 0.0)), (0.0, 0.25 * field))
    assert learn_motion(model, [middle, first]) is None
    with pytest.raises(CalibrationError, match="moved as the one before"):
        take_picture(model, [middle, first], SECOND_MOVE, _picture((0.25, 0.03)))
    second = take_picture(
        model, [middle, first], SECOND_MOVE, _picture((0.0, 0.25)), (0.25 * field, 0.0)
    )
    motion = learn_motion(model, [middle, first, second])
    assert motion is not None
    nominal = SIZE / scope.display_m
    # What is moved to the right shows what lay to the left, by a distortion of some per cent.
    np.testing.assert_allclose(motion / nominal, [[0.0, -1.0], [-1.0, 0.0]], atol=0.05)
    still = TakenPicture(SECOND_MOVE, second.picture, (0.25 * field, 0.0), 0.0 * first.offset_px)
    with pytest.raises(CalibrationError, match="does not follow x and y of the stage"):
        learn_motion(model, [middle, first, still])


@pytest.mark.parametrize("last", [100e3, 9000.0, 300.0])
def test_a_ladder_begins_inside_the_range_and_has_no_gap(last: float) -> None:
    model = calibration_of(make_scope())
    steps = plan_ladder(model, last)
    seen = np.array([step.magnification for step in steps])
    low, high = model.magnification_range
    assert seen[-1] == pytest.approx(last, rel=1e-3)
    # Three steps inside, so that no single visit carries the scale.
    assert np.count_nonzero((seen >= 0.999 * low) & (seen <= 1.001 * high)) >= 3
    ratios = np.exp(np.abs(np.diff(np.log(seen))))
    assert np.all(ratios < STEP_MAX)
    for step in steps:
        assert step.field_m == pytest.approx(model.display_width_m / step.magnification)
        for x, y in step.moves_m[1:]:
            assert 0.2 < np.hypot(x, y) / step.field_m < 0.34
    # To either side in turn: what drifts steadily then stretches the turned pictures to either side.
    assert {round(step.turn_rad, 6) for step in steps} == {round(s * np.pi / 2, 6) for s in (1, -1)}


@pytest.mark.parametrize("last", [2000.0, 1e9, 1e-3])
def test_a_magnification_inside_the_range_needs_no_ladder(last: float) -> None:
    with pytest.raises(InvalidValueError, match="beyond"):
        plan_ladder(calibration_of(make_scope()), last)
