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

"""Which unexpected shifts are used, and how far the filter opens for them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.gating import (
    OutlierTest,
    inflate_after_pause,
    inflate_if_contradicted,
    inflate_when_lost,
)
from semcal_ros.core.drift.operations import Inflate
from semcal_ros.core.drift.state import BASE_SIZE, DriftState
from semcal_ros.core.drift.thresholds import (
    INNOVATION_CHI2_MAX,
)

# Drift gets 2 units along x and 4 along y between two frames.
REACH = np.diag([2.0, 4.0])


def at(
    time_s: float, position: tuple[float, float], velocity: tuple[float, float] = (0.0, 0.0)
) -> DriftState:
    mean = np.zeros(BASE_SIZE + 4)
    mean[:4] = *position, *velocity
    covariance = np.zeros((mean.size, mean.size))
    # Drift and keyframe 3 together: a shift is known to 0.5 units along x and 1.0 along y.
    covariance[:2, :2] = np.diag([0.16, 0.64])
    covariance[BASE_SIZE : BASE_SIZE + 2, BASE_SIZE : BASE_SIZE + 2] = np.diag([0.09, 0.36])
    return DriftState(time_s, mean, covariance, (3,))


def opened(inflation: Inflate | None) -> tuple[Array, Array]:
    """What is added to the variances of drift and velocity."""
    assert inflation is not None
    return np.diag(inflation.covariance)[:2], np.diag(inflation.covariance)[2:4]


def test_the_gate_is_passed_once_in_a_million_frames() -> None:
    assert stats.chi2.sf(INNOVATION_CHI2_MAX, 2) == pytest.approx(1e-6, rel=0.02)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_prediction_is_contradicted_beyond_the_gate_and_not_before(axis: int) -> None:
    state = at(5.0, (10.0, -3.0))
    direction = np.array([[0.5, 0.0], [0.0, 1.0]])[axis]
    # The root of 27.6 is 5.25 sigmas.
    assert inflate_if_contradicted(state, 3, [10.0, -3.0] + 5.2 * direction, 2.0) is None
    miss = -5.3 * direction
    position, velocity = opened(inflate_if_contradicted(state, 3, [10.0, -3.0] + miss, 2.0))
    # As far as the shift that was seen, in any direction, and as fast as that in the 2 s.
    np.testing.assert_allclose(position, miss @ miss)
    np.testing.assert_allclose(velocity, miss @ miss / 4.0)


@pytest.mark.parametrize(
    ("key", "nearest"), [(4, (90.0, 0.0)), (None, (90.0, 0.0)), (3, (np.nan, 0.0))]
)
def test_without_a_known_keyframe_and_a_shift_nothing_is_contradicted(
    key: int | None, nearest: tuple[float, float]
) -> None:
    assert inflate_if_contradicted(at(5.0, (0.0, 0.0)), key, np.array(nearest), 1.0) is None


@pytest.mark.parametrize(
    ("miss", "used"),
    [((1.9, 0.0), True), ((2.1, 0.0), False), ((0.0, 3.9), True), ((0.0, 4.1), False)],
)
def test_a_shift_is_used_at_once_as_far_as_drift_gets_between_two_frames(
    miss: tuple[float, float], used: bool
) -> None:
    _, inflation = OutlierTest().explain(at(5.0, (7.0, 8.0)), np.add((7.0, 8.0), miss), REACH, 4.5)
    assert (inflation is not None) == used
    if used:
        position, velocity = opened(inflation)
        np.testing.assert_allclose(position, np.dot(miss, miss))
        np.testing.assert_allclose(velocity, np.dot(miss, miss) / 0.5**2)


@pytest.mark.parametrize(("second", "used"), [(31.0, True), (29.0, True), (33.0, False)])
def test_farther_away_it_must_be_seen_twice(second: float, used: bool) -> None:
    test = OutlierTest.after(at(4.0, (0.0, 0.0)))
    test, first = test.explain(at(5.0, (0.0, 0.0)), np.array([30.0, 0.0]), REACH, 4.0)
    assert first is None
    _, inflation = test.explain(at(6.0, (0.0, 0.0)), np.array([second, 0.0]), REACH, 4.0)
    assert (inflation is not None) == used
    if used:
        np.testing.assert_allclose(opened(inflation)[0], second**2)


@pytest.mark.parametrize(("third", "used"), [(61.5, True), (57.5, False)])
def test_a_new_pace_is_believed_when_three_positions_show_it(third: float, used: bool) -> None:
    test = OutlierTest()
    for time_s, x in ((5.0, 20.0), (6.0, 40.0)):
        test, none = test.explain(at(time_s, (0.0, 0.0)), np.array([x, 0.0]), REACH, 4.0)
        assert none is None
    _, inflation = test.explain(at(7.0, (0.0, 0.0)), np.array([third, 0.0]), REACH, 4.0)
    assert (inflation is not None) == used
    if used:
        # The pace of 20 per s, which the filter did not expect, and what drift may add to it.
        np.testing.assert_allclose(opened(inflation)[1], 20.0**2 + np.diag(REACH) ** 2)


def test_the_same_frame_against_another_keyframe_does_not_confirm_itself() -> None:
    test = OutlierTest()
    for _ in range(2):
        test, inflation = test.explain(at(5.0, (0.0, 0.0)), np.array([30.0, 0.0]), REACH, 4.0)
        assert inflation is None


def test_an_expected_frame_makes_the_unexpected_ones_before_it_forgotten() -> None:
    test = OutlierTest()
    test, _ = test.explain(at(5.0, (0.0, 0.0)), np.array([30.0, 0.0]), REACH, 4.0)
    # What would have confirmed the next one.
    assert test.explain(at(7.0, (0.0, 0.0)), np.array([30.0, 0.0]), REACH, 6.0)[1] is not None
    test = OutlierTest.after(at(6.0, (0.0, 0.0)))
    assert test.explain(at(7.0, (0.0, 0.0)), np.array([30.0, 0.0]), REACH, 6.0)[1] is None


def test_after_a_pause_drift_may_have_stopped_or_doubled_its_speed() -> None:
    position, velocity = opened(inflate_after_pause(0.3, 60.0))
    np.testing.assert_allclose(position, 18.0**2)
    np.testing.assert_allclose(velocity, 0.3**2)


def test_when_lost_the_reach_in_px_is_converted_to_the_unit_of_the_drift() -> None:
    # 4 px per unit along x, 2 px along y.
    position, velocity = opened(inflate_when_lost(np.diag([4.0, 2.0]), 100.0, 8.0))
    np.testing.assert_allclose(position, [25.0**2, 50.0**2])
    np.testing.assert_allclose(velocity, [2.0**2, 4.0**2])
