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

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.judgement.plan import ViewPlan, judge_calibration, plan_views
from semcal_ros.core.calibration.judgement.update import update_calibration
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.errors import InvalidValueError
from tests.core.calibration.test_check import AXIS, SEM, simulated
from tests.helpers.made_once import made_once

SQUARES_M = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)


@pytest.fixture(scope="module")
def poor() -> CalibrationModel:
    """Calibrated at the ends and in the middle only."""
    return made_once(
        "calibrated-poorly",
        lambda: (
            calibrate_views(
                simulated(SEM.camera_at, (100.0, 1000.0, 10000.0), 1),
                image_size=SEM.image_size,
                display_width_m=SEM.display_width_m,
                options=CalibrationOptions(axis=AXIS),
            ).model
        ),
    )


def plan(model: CalibrationModel, target: float, most_visits: int) -> ViewPlan:
    return plan_views(model, target, squares_m=SQUARES_M, most_visits=most_visits)


def worst(model: CalibrationModel) -> float:
    """Largest relative 1-sigma of nm per pixel in the range."""
    cameras = [model.at(float(g)) for g in np.geomspace(*model.magnification_range, 25)]
    return max(float(np.max(np.divide(c.pixel_size_sigma_m, c.pixel_size_m))) for c in cameras)


def followed(model: CalibrationModel, visits: tuple[float, ...], seed: int) -> CalibrationModel:
    views = simulated(SEM.camera_at, visits, seed)
    size = SEM.image_size
    return update_calibration(model, views, image_size=size, axis=AXIS, ageing=0.0).model


@pytest.mark.long
def test_the_plan_predicts_what_its_views_bring(poor: CalibrationModel) -> None:
    planned = plan(poor, 1e-6, 4)
    assert planned.largest == pytest.approx(worst(poor), rel=1e-6)
    assert not planned.reached
    sigmas = [visit.largest for visit in planned.visits]
    assert sigmas == sorted(sigmas, reverse=True)
    after = followed(poor, tuple(visit.magnification for visit in planned.visits), 77)
    # Other tilts and corners than those of the plan, but as many.
    assert worst(after) == pytest.approx(planned.visits[-1].largest, rel=0.15)
    # Without a plan: visits where the calibration is as poor, at random. None of three is as good.
    rng = np.random.default_rng(3)
    random = np.exp(rng.uniform(np.log(100.0), np.log(10000.0), (3, 4)))
    others = [worst(followed(poor, tuple(own), 100 + k)) for k, own in enumerate(random)]
    assert worst(after) < 0.95 * min(others)


@pytest.mark.slow
@pytest.mark.long
def test_the_plan_allows_for_what_may_change_until_then(poor: CalibrationModel) -> None:
    """As `semcal update` does, whose prior of the ageing is the same."""
    ageing = 5e-3
    planned = plan_views(poor, 1e-6, squares_m=SQUARES_M, most_visits=4, ageing=ageing)
    # Until it is used, the calibration is what it is.
    assert planned.largest == pytest.approx(worst(poor), rel=1e-6)
    visits = tuple(visit.magnification for visit in planned.visits)
    for count in (1, 4):
        views = simulated(SEM.camera_at, visits[:count], 77)
        size = SEM.image_size
        after = update_calibration(poor, views, image_size=size, axis=AXIS, ageing=ageing).model
        assert worst(after) == pytest.approx(planned.visits[count - 1].largest, rel=0.15)
    # One visit tells less if the scale may have changed.
    assert planned.visits[0].largest > plan(poor, 1e-6, 1).visits[0].largest


def test_a_target_that_is_met_needs_nothing(poor: CalibrationModel) -> None:
    planned = plan(poor, 0.05, 4)
    assert planned.reached and planned.visits == ()
    # The usual repeatability of 0.1 %, and 10 um over a pivot 20 mm away.
    assert planned.floor == pytest.approx(np.hypot(1e-3, 10e-6 / 20e-3), rel=0.02)


def test_it_stops_at_the_target(poor: CalibrationModel) -> None:
    one, two, three = (visit.largest for visit in plan(poor, 1e-6, 3).visits)
    target = float(np.sqrt(two * three))
    assert three < target < two < one
    planned = plan(poor, target, 10)
    assert planned.reached
    assert [visit.largest for visit in planned.visits] == pytest.approx([one, two, three])


def test_squares_fit_the_field(poor: CalibrationModel) -> None:
    for visit in plan(poor, 1e-6, 6).visits:
        field_m = SEM.image_size[0] * poor.at(visit.magnification).pixel_size_m[0]
        assert visit.square_m in SQUARES_M
        assert field_m / visit.square_m >= 8.0
        larger = [size for size in SQUARES_M if size > visit.square_m]
        assert all(field_m / size < 8.0 for size in larger)


def test_what_cannot_be_planned_is_refused(poor: CalibrationModel) -> None:
    with pytest.raises(InvalidValueError, match="target = 0"):
        plan(poor, 0.0, 4)
    with pytest.raises(InvalidValueError, match="31 visits"):
        plan(poor, 0.01, 31)
    with pytest.raises(InvalidValueError, match="positive sizes"):
        plan_views(poor, 0.01, squares_m=())


def test_squares_larger_than_every_field_are_refused(poor: CalibrationModel) -> None:
    with pytest.raises(InvalidValueError, match="squares of 5mm, of which no magnification"):
        plan_views(poor, 1e-3, squares_m=(5e-3,))
    # At the lowest magnification a few corners show, at the others none.
    some = plan_views(poor, 1e-4, squares_m=(2.5e-4,), most_visits=2)
    assert all(visit.magnification < 300.0 for visit in some.visits)


def test_the_verdict_names_the_weakest_place_and_the_next_visit(poor: CalibrationModel) -> None:
    known = replace(poor, record=replace(poor.record, squares_m=SQUARES_M))
    verdict = judge_calibration(known)
    assert verdict.largest == pytest.approx(worst(poor), rel=1e-6)
    at = known.at(verdict.at)
    assert verdict.pixel_size_m == pytest.approx(np.mean(at.pixel_size_m))
    first = plan(poor, 1e-6, 1).visits[0]
    assert verdict.next_visit == first
    assert f"at {first.magnification:.0f}x" in verdict.advise()
    # The sentence's own numbers: the sigma in nm is the stated part of the size in nm.
    size, sigma = map(float, re.findall(r"([\d.]+) \+- ([\d.]+) nm", verdict.describe())[0])
    assert sigma == pytest.approx(verdict.largest * size, rel=0.06)
    assert verdict.describe().endswith(" nm (conditions not recorded)")
    made = Provenance(
        recorded=("2026-03-01 22:00:00", "2026-03-02 01:00:00"),
        conditions={"acceleration_voltage_v": (5e3, 5e3), "working_distance_m": (0.01, 0.0101)},
    )
    told = judge_calibration(replace(known, provenance=made)).describe()
    under = "voltage 5 kV, working distance 10 mm to 10.1 mm, date 2026-03-01 to 2026-03-02"
    assert told == verdict.describe().replace("conditions not recorded", under)
    # What nothing told is said, too.
    undated = judge_calibration(replace(known, provenance=replace(made, recorded=())))
    assert undated.describe().endswith("10.1 mm, date not recorded)")


def test_no_visit_is_proposed_where_none_would_help(poor: CalibrationModel) -> None:
    """Squares that are known to 3 % only set the scale's sigma, whatever is recorded."""
    rough = replace(
        poor,
        record=replace(poor.record, squares_m=SQUARES_M),
        scale_sigma=replace(poor.scale_sigma, grid=0.03),
    )
    verdict = judge_calibration(rough)
    assert verdict.next_visit is None
    assert "hardly improve" in verdict.advise()
    assert verdict.floor == pytest.approx(0.03, rel=0.05)
    # Nothing is known of the grid.
    assert judge_calibration(replace(poor, record=None)).advise() == ""
