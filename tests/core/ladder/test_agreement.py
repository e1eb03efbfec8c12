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

"""Ladders that contradict the calibration, or what is stated of their pictures: said, or refused for that reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.calibration.estimator.trust_region import Descent, DescentStatus
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.ladder.adjustment import DriftSpread, LadderFit
from semcal_ros.core.ladder.agreement import (
    FLIPS,
    Disagreement,
    Misstatement,
    find_misstatement,
    flip_match,
)
from semcal_ros.core.ladder.correspondences import Correspondences, SmoothMap
from semcal_ros.core.ladder.extend import (
    LadderMeasurement,
    LadderResult,
    extend_calibration,
    find_unrest,
)
from semcal_ros.core.ladder.matching import LadderPicture, Match, Turns, check_steps, compare_turns
from semcal_ros.core.ladder.unknowns import (
    LadderSetup,
    LadderState,
    PicturePlace,
    make_setup,
    start_state,
)
from tests.helpers.ladders import SIZE, calibration_of, ladder_of, make_scope

STEPS = (5000.0, 7400.0, 11000.0, 16000.0)


def _extend(pictures: list[LadderPicture]) -> LadderResult:
    return extend_calibration(calibration_of(make_scope()), pictures)


def _restated(
    pictures: list[LadderPicture], turn: Callable[[float], float | None]
) -> list[LadderPicture]:
    return [replace(p, scan_rotation_rad=turn(p.scan_rotation_rad or 0.0)) for p in pictures]


# -- flipped pictures -----------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("flip", "name"),
    [
        (np.fliplr, "mirrored left to right"),
        (lambda image: image[::-1, ::-1], "turned by half a turn"),
    ],
)
def test_flipped_pictures_are_refused_by_how_they_lie(
    flip: Callable[[AnyImage], AnyImage], name: str
) -> None:
    flipped = [replace(p, image=flip(p.image)) for p in ladder_of(make_scope(), STEPS)]
    with pytest.raises(CalibrationError, match=f"pictures that are {name} against those of the"):
        _extend(flipped)


@pytest.mark.long
def test_the_other_sense_of_the_scan_rotation_is_found_and_said() -> None:
    right = _extend(ladder_of(make_scope(), STEPS))
    result = _extend(_restated(ladder_of(make_scope(), STEPS), lambda turn: -turn))
    assert result.unused == ()
    assert [step.turned for step in result.steps] == [step.turned for step in right.steps]
    (note,) = [text for text in result.weaknesses if "turn against what is stated" in text]
    # The distortion of this microscope tells that the pictures are not mirrored.
    assert "mirrored" not in note
    assert not any("turn" in text for text in right.weaknesses)
    # The same matches, but for the order in which their sums are taken.
    np.testing.assert_allclose(
        result.model.at(14000.0).parameters, right.model.at(14000.0).parameters, rtol=1e-9
    )


@pytest.mark.long
def test_a_rotation_that_is_never_updated_is_found_and_said() -> None:
    result = _extend(_restated(ladder_of(make_scope(), STEPS), lambda _: 0.0))
    assert result.unused == ()
    assert all(step.turned == 1 for step in result.steps)
    assert any("turned by another angle than is stated" in text for text in result.weaknesses)


def _match(turn_rad: float, pair: tuple[int, int] = (0, 1)) -> Match:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.0, 255.0, (40, 2))
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    seen = (xy - 127.5) @ np.array([[c, -s], [s, c]]).T + 127.5
    covariance = np.broadcast_to(np.array([[2.0, 0.5], [0.5, 1.0]]), (40, 2, 2))
    found = Correspondences(
        xy, seen, covariance, SmoothMap.fit(xy, seen, (256, 256), 1), 0.9, 1.0, 0
    )
    return Match(*pair, found)


@pytest.mark.parametrize(
    ("stated", "seen", "counts"),
    [
        (0.5, 0.5, Turns(1, 0, 0)),
        (0.5, -0.5, Turns(0, 1, 0)),
        (0.0, 0.5, Turns(0, 0, 1)),
        # Half a turn, and none, say nothing of the sense.
        (1.0, 1.0, Turns(0, 0, 0)),
        (0.0, 0.0, Turns(0, 0, 0)),
        (None, 0.5, Turns(0, 0, 0)),
    ],
)
def test_turned_pairs_are_counted_by_their_sense(
    stated: float | None, seen: float, counts: Turns
) -> None:
    blank = np.zeros((4, 4))
    second = None if stated is None else stated * math.pi
    pictures = [LadderPicture(blank, 1e3, "", 0.0), LadderPicture(blank, 1e3, "", second)]
    assert compare_turns(pictures, [_match(seen * math.pi)]) == counts


def test_a_flipped_match_is_that_of_flipped_pictures() -> None:
    match = _match(0.3)
    for flip in FLIPS:
        flipped = flip_match(match, flip).found
        x, y = flip.signs
        for before, after in (
            (match.found.first_xy, flipped.first_xy),
            (match.found.second_xy, flipped.second_xy),
        ):
            np.testing.assert_allclose(
                after[:, 0], before[:, 0] if x > 0.0 else 255.0 - before[:, 0]
            )
            np.testing.assert_allclose(
                after[:, 1], before[:, 1] if y > 0.0 else 255.0 - before[:, 1]
            )
        # What x and y have in common changes its sign with one of both.
        assert flipped.covariance[0, 0, 1] == 0.5 * x * y
        again = flip_match(flip_match(match, flip), flip).found
        np.testing.assert_allclose(again.second_xy, match.found.second_xy)
    assert [flip.is_mirror for flip in FLIPS] == [True, True, False]


def test_a_calibration_that_holds_disagrees_by_chance_only() -> None:
    # Of 20 000 ladders as many as one in ten thousand, and hardly ever ten.
    drawn = np.random.default_rng(1).chisquare(12, 20_000)
    alarms = sum(not Disagreement(float(value), 12).is_chance for value in drawn)
    assert 0 <= alarms < 10
    assert not Disagreement(60.0, 12).is_chance


# -- magnifications that are stated wrongly -------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("factor", [1.01, 0.99])
def test_a_picture_whose_pixel_size_is_wrong_is_left_out_and_no_relay(factor: float) -> None:
    pictures = ladder_of(make_scope(), STEPS)
    pictures[7] = replace(pictures[7], magnification=factor * 11000.0)
    result = _extend(pictures)
    assert result.unused == ("11000x/1",)
    assert result.model.ladder is not None and not result.model.ladder.relays
    (note,) = [text for text in result.weaknesses if "left out" in text]
    assert f"1 picture at {factor * 11000.0:g}x (11000x/1)" in note
    assert ("smaller" if factor > 1.0 else "larger") in note


@pytest.mark.long
def test_a_magnification_that_is_wrong_and_needed_is_refused_by_its_pictures() -> None:
    pictures = [
        replace(p, magnification=11110.0) if p.magnification == 11000.0 else p
        for p in ladder_of(make_scope(), STEPS)
    ]
    with pytest.raises(CalibrationError, match=r"3 pictures at 11110x .* to be 1.* % smaller"):
        _extend(pictures)


def _fit_of(scales: Iterable[float], jumps: tuple[int, ...], visits: Iterable[float]) -> LadderFit:
    """A fit in which the pictures have these scales relative to those of the calibration."""
    scope = make_scope()
    places = tuple(PicturePlace(f"{g:g}", g, k) for k, g in enumerate((6000.0, 9000.0, *STEPS[2:])))
    setup = make_setup(calibration_of(scope), places, (SIZE, SIZE))
    state = start_state(setup)
    values = state.values.copy()
    values[setup.bounds[3]] = list(visits)
    wanted = LadderState(setup, values)
    # The parameters as they would come out; how they are made up is not asked.
    parameters = wanted.parameters.copy()
    parameters[:, 0] = parameters[0, 0] * np.array([p.magnification for p in places]) / 6000.0
    parameters[:, 0] *= np.array(list(scales))
    wanted.__dict__["parameters"] = parameters
    descent = Descent(wanted, 0.0, 1, DescentStatus.SMALL_DECREASE, 0.0)
    return LadderFit(
        wanted, np.eye(setup.size), 1.0, np.ones(1), DriftSpread(0.1, 0.1), jumps, (0,), descent
    )


@pytest.mark.parametrize(
    ("scales", "jumps", "visits", "expected"),
    [
        ((1.0, 1.0, 1.0, 1.0), (), (0.0,) * 4, None),
        # A relay: the scale stays.
        ((1.0, 1.0, 1.01, 1.01), (0,), (0.0,) * 4, None),
        ((1.0, 1.0, 1.0, 1.01), (1,), (0.0,) * 4, None),
        # Back again, whether one jump was found or both, and on which side.
        ((1.0, 1.0, 1.01, 1.0), (0, 1), (0.0,) * 4, (11000.0, 0.01)),
        ((1.0, 1.0, 1.01, 1.0), (0,), (0.0,) * 4, (11000.0, 0.01)),
        ((1.0, 1.0, 0.99, 1.0), (1,), (0.0,) * 4, (11000.0, -0.01)),
        ((1.0, 1.01, 1.0, 1.0), (0,), (0.0,) * 4, (9000.0, 0.01)),
        # Too small to tell.
        ((1.0, 1.0, 1.002, 1.0), (0,), (0.0,) * 4, None),
        # In the range of the calibration.
        ((1.01, 1.0, 1.0, 1.0), (), (0.01, 0.0, 0.0, 0.0), (6000.0, 0.01)),
    ],
)
def test_which_magnification_is_stated_wrongly(
    scales: tuple[float, ...],
    jumps: tuple[int, ...],
    visits: tuple[float, ...],
    expected: tuple[float, float] | None,
) -> None:
    fit = _fit_of(scales, jumps, visits)
    setup: LadderSetup = fit.state.setup
    found = find_misstatement(setup, fit)
    if expected is None:
        assert found is None
    else:
        assert isinstance(found, Misstatement)
        assert (found.magnification, found.deviation) == pytest.approx(expected, rel=0.03)


# -- what is said ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("spread_px", "count"), [(0.5, 0), (4.0, 1)])
def test_a_large_drift_is_a_note_with_what_it_may_be(spread_px: float, count: int) -> None:
    fit = replace(_fit_of((1.0,) * 4, (), (0.0,) * 4), drift=DriftSpread(spread_px, 0.1))
    measured = LadderMeasurement(fit.state.setup, fit, (), 1.0, (), (), (0, 1, 2, 3))
    notes = [text for text in find_unrest(measured) if "fixed to the scan" in text]
    assert len(notes) == count
    if notes:
        assert "a drift within a frame of 4.0 px (1-sigma) at 16000x" in notes[0]


def test_pictures_of_two_sizes_are_told_as_sizes() -> None:
    sizes = [(320, 256), (256, 256)]
    pictures = [
        LadderPicture(np.zeros(size[::-1]), g) for size, g in zip(sizes, (7e3, 1e4), strict=True)
    ]
    with pytest.raises(InvalidValueError, match="pictures of 256 x 256 and 320 x 256 px; expected"):
        _extend(pictures)


def test_a_gap_inside_the_calibrated_range_does_no_harm() -> None:
    check_steps((1000.0, 4000.0, 6000.0), (1000.0, 6000.0))
    for steps, known in (((1000.0, 4000.0), None), ((4000.0, 8000.0), (1000.0, 6000.0))):
        with pytest.raises(CalibrationError, match="a gap in the ladder from"):
            check_steps(steps, known)
