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

"""What is checked before anything moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import pytest

from semcal_ros.core.errors import MicroscopeError
from semcal_ros.drivers.limits import MotionLimits, describe_target

LIMITS = MotionLimits(
    {"tilt": (-0.1, 0.5), "x": (-1e-3, 1e-3), "z": (0.0, 0.0)},
    {"tilt": 0.2, "x": 1e-4, "z": 1e-4},
    (10.0, 1e5),
)


@pytest.mark.parametrize(("tilt", "taken"), [(0.5, True), (-0.1, True), (0.5001, False)])
def test_positions_within_the_soft_limits_are_taken_ends_included(tilt: float, taken: bool) -> None:
    assert _passes(LIMITS.check_target, {"tilt": tilt, "x": -1e-3}) == taken


def _passes(check: Callable[..., None], *arguments: Mapping[str, float]) -> bool:
    try:
        check(*arguments)
    except MicroscopeError:
        return False
    return True


def _may_go(target: Mapping[str, float], position: Mapping[str, float]) -> bool:
    return _passes(LIMITS.check_way, target, position, {})


def test_steps_are_taken_up_to_their_limit() -> None:
    assert _may_go({"tilt": 0.5, "x": -1e-3}, {"tilt": 0.3, "x": -9e-4})
    assert not _may_go({"tilt": 0.5, "x": -1e-3}, {"tilt": 0.29, "x": -9e-4})


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ({}, "no joint"),
        ({"lid": 0.1}, "the joint lid"),
        ({"tilt": math.nan}, "finite"),
        ({"tilt": -math.inf}, "finite"),
        ({"tilt": 0.51}, "min_tilt and max_tilt"),
        # Degrees in the place of radians.
        ({"tilt": 30.0}, "-0.1 to 0.5 rad"),
        ({"z": 0.0}, "locked"),
        # A joint without limits is not moved.
        ({"rotation": 0.0}, "locked"),
        ({"x": 0.0, "tilt": 1.0}, "tilt to 1 rad"),
    ],
)
def test_other_positions_are_refused_wherever_the_stage_is(
    target: dict[str, float], reason: str
) -> None:
    with pytest.raises(MicroscopeError, match=reason):
        LIMITS.check_target(target)


@pytest.mark.parametrize(
    ("position", "own", "reason"),
    [
        ({"tilt": 0.09}, {}, "step_tilt"),
        ({}, {}, "does not say"),
        ({"tilt": math.nan}, {}, "does not say"),
        ({"tilt": 0.2}, {"tilt": (0.0, 0.25)}, "limits of the microscope"),
    ],
)
def test_ways_that_are_refused(
    position: dict[str, float], own: dict[str, tuple[float, float]], reason: str
) -> None:
    with pytest.raises(MicroscopeError, match=reason):
        LIMITS.check_way({"tilt": 0.3}, position, own)


def test_a_stage_outside_of_its_limits_may_come_back_in_steps() -> None:
    assert _may_go({"tilt": 0.5}, {"tilt": 0.65})
    assert not _may_go({"tilt": 0.5}, {"tilt": 0.75})


def test_magnifications() -> None:
    LIMITS.check_magnification(10.0)
    for wrong in (9.0, 2e5, math.nan, math.inf, -100.0):
        with pytest.raises(MicroscopeError, match="10 to 100000"):
            LIMITS.check_magnification(wrong)


def test_a_target_in_words() -> None:
    assert describe_target({"tilt": 0.1, "x": 2e-6}) == "tilt 0.1 rad, x 2e-06 m"
