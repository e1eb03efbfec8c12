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

"""Ladders beyond the grid, against the truth of a generator that shares no code with the method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.calibration_model import ScaleSigma
from semcal_ros.core.camera.uncertainty import budget_of_pixel_size
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.ladder.adjustment import adjust
from semcal_ros.core.ladder.extend import LadderResult, check_fit, extend_calibration
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.core.ladder.residuals import Link, make_link
from semcal_ros.core.ladder.unknowns import LadderState, PicturePlace, make_setup, start_state
from tests.helpers.ladders import (
    SIZE,
    aligned_rms_px,
    calibration_of,
    camera_at,
    ladder_of,
    make_scope,
    place_in,
    take,
)

STEPS = (5000.0, 7400.0, 11000.0, 16000.0)
RELAY = (13000.0, 0.005)


@pytest.fixture(scope="module")
def extended() -> LadderResult:
    scope = make_scope(1, RELAY)
    return extend_calibration(calibration_of(scope), ladder_of(scope, STEPS))


@pytest.mark.long
def test_pixel_sizes_and_distortion_between_the_steps(extended: LadderResult) -> None:
    scope = make_scope(1, RELAY)
    for g in (9000.0, 10500.0, 11500.0, 15000.0):
        camera, truth = extended.model.at(g), camera_at(scope, g)
        assert camera.in_range
        size, wanted = np.array(camera.pixel_size_m), np.array(truth.pixel_size_m)
        assert np.all(np.abs(size - wanted) < 3.0 * np.array(camera.pixel_size_sigma_m))
        # Pictures of 256 px place a block to 0.1 px, some 30 blocks a pair: the shape is known to some hundredths.
        assert aligned_rms_px(extended.model, scope, g) < 0.05
    # Inside the grid nothing is worse than before.
    before, after = calibration_of(scope).at(6000.0), extended.model.at(6000.0)
    assert max(after.pixel_size_sigma_m) <= max(before.pixel_size_sigma_m) * 1.001
    assert extended.variance_factor == pytest.approx(1.0, abs=0.2)


@pytest.mark.long
def test_the_relay_is_found_and_bounded(extended: LadderResult) -> None:
    ladder = extended.model.ladder
    assert ladder is not None
    (relay,) = ladder.relays
    assert (relay.low, relay.high) == (11000.0, 16000.0)
    assert relay.jump == pytest.approx(RELAY[1], abs=1e-3)
    assert any("jumps by +0.5" in text for text in extended.weaknesses)
    # In the middle of the step the side is open.
    middle = math.sqrt(11000.0 * 16000.0)
    assert ladder.relay_sigma(middle) == pytest.approx(abs(relay.jump) * math.sqrt(0.5))
    assert ladder.relay_sigma(16000.0) == ladder.relay_sigma(11000.0) == 0.0


@pytest.mark.long
def test_the_budget_has_the_ladder_as_a_line_of_its_own(extended: LadderResult) -> None:
    budget = budget_of_pixel_size(extended.model, 16000.0)
    parts = {part.source: part.relative for part in budget.parts}
    assert 0.0 < parts["steps of the ladder beyond the grid"] < 0.003
    camera = extended.model.at(16000.0)
    stated = max(camera.rectified.pixel_size_sigma_m) / camera.rectified.pixel_size_m[0]
    # The tilt of what is measured is no part of the camera.
    parts.pop("tilt of the specimen")
    assert math.sqrt(sum(part**2 for part in parts.values())) == pytest.approx(stated, rel=1e-6)
    inside = budget_of_pixel_size(extended.model, 6000.0)
    assert all("ladder" not in part.source for part in inside.parts)


@pytest.mark.long
def test_the_file_gives_back_the_extended_calibration(extended: LadderResult) -> None:
    calibration = Calibration.from_model(extended.model)
    again = Calibration.loads(calibration.dumps())
    assert again == calibration
    assert again.magnification_range == (1000.0, 16000.0)
    assert again.ladder == extended.model.ladder
    np.testing.assert_array_equal(again.at(13000.0).parameters, calibration.at(13000.0).parameters)


def _links_of_truth(
    sigma_px: float,
    seed: int,
    turned: bool = True,
    *,
    steps: Sequence[float] = STEPS,
    slope: tuple[float, float] = (0.0, 0.0),
) -> tuple[LadderState, list[Link]]:
    """Correspondences without pictures: from the truth, with noise; the specimen may slope."""
    scope, rng = make_scope(), np.random.default_rng([seed, 3])
    places, poses = [], []
    for visit, g in enumerate(steps):
        for k, move in enumerate([(0.0, 0.0), (0.25, 0.1), (-0.05, 0.25), (0.0, 0.0)]):
            places.append(PicturePlace(f"{g:g}/{k}", g, visit))
            turn = 0.5 * math.pi * (-1.0) ** visit if turned and k == 3 else 0.0
            poses.append((move, turn + float(rng.normal(0.0, 0.003))))
    model = replace(calibration_of(scope), scale_sigma=ScaleSigma())
    setup = make_setup(model, tuple(places), (SIZE, SIZE))
    cameras = [camera_at(scope, place.magnification) for place in places]
    links = []
    for i in range(len(places)):
        for j in range(i + 1, len(places)):
            if abs(places[i].visit - places[j].visit) > 1:
                continue
            xy = rng.uniform(10.0, SIZE - 11.0, (60, 2))
            here = place_in(scope, places[i].magnification, poses[i][0], poses[i][1], xy)
            height = here @ slope
            both = []
            for k in (i, j):
                field = scope.display_m / places[k].magnification
                c, s = math.cos(poses[k][1]), math.sin(poses[k][1])
                flat = (here - field * np.array(poses[k][0])) @ np.array([[c, s], [-s, c]])
                both.append(cameras[k].project(np.column_stack([flat, height])))
            xy, seen = both
            inside = np.all((seen > 5.0) & (seen < SIZE - 6.0), axis=1)
            first = xy[inside]
            second = seen[inside] + rng.normal(0.0, sigma_px, (len(first), 2))
            covariance = np.broadcast_to(sigma_px**2 * np.eye(2), (len(first), 2, 2))
            times = [(p[:, 1] - 0.5 * SIZE) / SIZE for p in (first, second)]
            links.append(make_link(setup, (i, j), first, second, covariance, times))
    values = start_state(setup).values.copy()
    for k, (move, turn) in enumerate(poses):
        at = setup.bounds[5].start + 5 * k
        c, s = math.cos(turn), math.sin(turn)
        own = -SIZE * (np.array([[c, -s], [s, c]]) @ np.array(move))
        values[at : at + 3] = [turn, *own]
    # The gauge: the first picture has no turn and no shift.
    first_turn = values[setup.bounds[5].start]
    values[setup.bounds[5].start :: 5] -= first_turn
    return LadderState(setup, values), links


@pytest.mark.long
def test_error_over_sigma_of_many_ladders_without_pictures() -> None:
    # The scale, aspect, skew and lens of the end of the ladder over their sigmas: 6 ladders, with one calibration.
    truth = camera_at(make_scope(), STEPS[-1]).parameters
    rows = []
    for seed in range(6):
        state, links = _links_of_truth(0.05, seed)
        fit = adjust(state.setup, state, links)
        assert fit.variance_factor == pytest.approx(1.0, abs=0.1)
        setup, part = state.setup, state.setup.bounds[2].stop
        design = setup.design(STEPS[-1]) @ setup.theta_columns
        spread = np.sqrt(np.diag(design @ fit.covariance[:part, :part] @ design.T))
        found = setup.design(STEPS[-1]) @ fit.state.theta
        # A ladder has room for the terms of the calibration, too.
        size = len(truth)
        rows.append(((found[:size] - truth) / spread[:size])[[0, 1, 2, 6, 7]])
    ratio = float(np.sqrt(np.mean(np.square(rows))))
    # Five parameters of six ladders that share the errors of one calibration: as many as ten alone.
    assert 0.5 < ratio < 1.6


@pytest.mark.long
def test_turned_scans_tell_aspect_and_skew() -> None:
    spreads = []
    for turned in (True, False):
        state, links = _links_of_truth(0.05, 0, turned)
        fit = adjust(state.setup, state, links)
        part = state.setup.bounds[2].stop
        design = state.setup.design(STEPS[-1])[1:3] @ state.setup.theta_columns
        spreads.append(np.sqrt(np.diag(design @ fit.covariance[:part, :part] @ design.T)))
    assert np.all(spreads[0] < 0.7 * spreads[1])


@pytest.mark.long
def test_a_picture_that_contradicts_all_others_is_refused() -> None:
    # As where a specimen repeats itself: each pair has another wrong place.
    steps = STEPS[1:3]
    state, links = _links_of_truth(0.05, 0, steps=steps)
    last = 4 * len(steps) - 1
    rng = np.random.default_rng(5)
    wrong = [
        replace(link, second_xy=link.second_xy + rng.normal(0.0, 9.0, 2))
        if link.second == last
        else link
        for link in links
    ]
    with pytest.raises(CalibrationError, match=f"1 picture of {last + 1} cannot be placed"):
        adjust(state.setup, state, wrong)


@pytest.mark.long
def test_a_tilt_is_seen_by_its_perspective_and_refused() -> None:
    # A tenth of the field higher or lower, under a pivot at 20 mm, is some tenths of a pixel at 360x: the slope is
    # known to 0.01.
    steps, slope = (1500.0, 1050.0, 730.0, 510.0, 360.0), (0.2, -0.1)
    state, links = _links_of_truth(0.05, 0, steps=steps, slope=slope)
    fit = adjust(state.setup, state, links)
    np.testing.assert_allclose(fit.state.slope, slope, atol=0.05)
    with pytest.raises(CalibrationError, match="tilted by 1"):
        check_fit(state.setup, fit, links)
    # The same specimen flat is no reason to refuse; this ladder goes down.
    state, links = _links_of_truth(0.05, 0, steps=steps)
    fit = adjust(state.setup, state, links)
    check_fit(state.setup, fit, links)
    assert np.hypot(*fit.state.slope) < 0.03


# -- refusals -------------------------------------------------------------------------------------


def _blank(g: float) -> LadderPicture:
    return LadderPicture(np.zeros((SIZE, SIZE)), g)


def test_a_gap_is_refused_before_anything_is_measured() -> None:
    model = calibration_of(make_scope())
    with pytest.raises(CalibrationError, match=r"gap .* from 7000x to 14000x.*9899x"):
        extend_calibration(model, [_blank(7000.0), _blank(14000.0)])


def test_a_ladder_without_an_anchor_is_refused() -> None:
    model = calibration_of(make_scope())
    with pytest.raises(CalibrationError, match="without a picture in the calibrated range"):
        extend_calibration(model, [_blank(12000.0), _blank(16000.0)])


def test_other_shapes_and_methods_are_refused() -> None:
    model = calibration_of(make_scope())
    wide = [LadderPicture(np.zeros((100, 300)), g) for g in (7000.0, 10000.0)]
    with pytest.raises(InvalidValueError, match="shape of the calibration"):
        extend_calibration(model, wide)
    with pytest.raises(InvalidValueError, match="joint"):
        extend_calibration(replace(model, method="pda"), [_blank(7000.0), _blank(10000.0)])


def test_pictures_of_another_place_are_refused_by_their_magnification() -> None:
    scope = make_scope()
    pictures = [
        LadderPicture(take(scope, 7000.0), 7000.0, "a", 0.0),
        LadderPicture(take(scope, 7000.0, (0.2, 0.1), seed=1), 7000.0, "b", 0.0),
        LadderPicture(take(scope, 10000.0, (9.0, 4.0), seed=2), 10000.0, "c", 0.0),
    ]
    with pytest.raises(
        CalibrationError, match="at 10000x and those at 7000x that were not matched"
    ):
        extend_calibration(calibration_of(scope), pictures)


def test_a_specimen_that_repeats_is_refused() -> None:
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    rng = np.random.default_rng(0)
    pictures = []
    for g in (7000.0, 10000.0):
        pitch = 12.0 * g / 7000.0
        lattice = 100.0 + 20.0 * (np.cos(2 * np.pi * x / pitch) + np.cos(2 * np.pi * y / pitch))
        pictures += [
            LadderPicture(lattice + rng.normal(0.0, 3.0, lattice.shape), g, "", 0.0)
            for _ in range(2)
        ]
    with pytest.raises(CalibrationError, match="repeats"):
        extend_calibration(calibration_of(make_scope()), pictures)
