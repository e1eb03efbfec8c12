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

"""Whether the conditions now are those of a calibration."""

from __future__ import annotations

import math
from typing import Any

import pytest

from semcal_ros.core.camera.conditions import compare_conditions, describe_condition

CALIBRATED: dict[str, Any] = {
    "maker": ("zeiss",),
    "model": ("SUPRA 40VP",),
    "serial_number": ("4321",),
    "detector": ("InLens", "SE2"),
    "acceleration_voltage_v": (5000.0, 5000.0),
    "working_distance_m": (9.9e-3, 10.0e-3),
    "dwell_s": (1e-6, 1e-6),
    "scan_rotation_rad": (0.0, 0.0),
}


def texts(seen: dict[str, Any], **options: float) -> list[str]:
    return [d.text for d in compare_conditions(CALIBRATED, seen, **options)]


def test_the_same_conditions_differ_in_nothing() -> None:
    same = {
        "maker": "Zeiss ",
        "serial": "4321",
        "detector": "SE2",
        "accelerating_voltage_v": 5000.0,
        "working_distance_m": 9.95e-3,
        "dwell_s": 1e-6,
        "scan_rotation_rad": 2.0 * math.pi,
    }
    assert texts(same) == []
    assert texts({}) == []
    assert compare_conditions({}, same) == ()


@pytest.mark.parametrize(
    ("name", "inside", "outside", "text"),
    [
        # 1 % of 5 kV is 50 V.
        ("accelerating_voltage_v", 5049.0, 5051.0, "voltage 5.051 kV, calibrated at 5 kV"),
        ("accelerating_voltage_v", -4951.0, -4949.0, "voltage -4.949 kV, calibrated at 5 kV"),
        # 1 % beyond the range of 9.9 to 10 mm.
        (
            "working_distance_m",
            10.09e-3,
            10.11e-3,
            "working distance 10.11 mm, calibrated at 9.9 mm to 10 mm",
        ),
        # 0.5 degrees are 8.7 mrad.
        (
            "scan_rotation_rad",
            2.0 * math.pi - 8e-3,
            -9e-3,
            "scan rotation -0.5157 deg, calibrated at 0 deg",
        ),
        ("serial", "4321", "4322", "serial number 4322, calibrated at 4321"),
        ("model", "supra 40vp", "Sigma", "model Sigma, calibrated at SUPRA 40VP"),
    ],
)
def test_what_may_change_the_scale_is_decisive_beyond_its_tolerance(
    name: str, inside: Any, outside: Any, text: str
) -> None:
    assert texts({name: inside}) == []
    (found,) = compare_conditions(CALIBRATED, {name: outside})
    assert found.decisive
    assert found.text == text


def test_the_working_distance_may_vary_as_the_stated_height_does() -> None:
    assert texts({"working_distance_m": 10.29e-3}, height_sigma_m=3e-4) == []
    assert texts({"working_distance_m": 10.31e-3}, height_sigma_m=3e-4)


@pytest.mark.parametrize(("name", "value"), [("detector", "BSE"), ("dwell_s", 2e-6)])
def test_what_changes_the_picture_alone_is_told_and_not_decisive(name: str, value: Any) -> None:
    (found,) = compare_conditions(CALIBRATED, {name: value})
    assert not found.decisive


def test_decisive_differences_come_first() -> None:
    seen = {"detector": "BSE", "serial": "1", "accelerating_voltage_v": 1e4}
    found = compare_conditions(CALIBRATED, seen)
    assert [d.decisive for d in found] == [True, True, False]


@pytest.mark.parametrize(
    "seen",
    [
        {"accelerating_voltage_v": "5 kV"},
        {"accelerating_voltage_v": math.nan},
        {"working_distance_m": math.inf},
        {"detector": 5.0},
        {"serial": ""},
        {"maker": "imagej"},
        {"unheard_of": 1.0},
    ],
)
def test_what_cannot_be_compared_is_not_known(seen: dict[str, Any]) -> None:
    assert compare_conditions(CALIBRATED, seen) == ()


def test_conditions_are_said_with_a_unit() -> None:
    assert describe_condition("beam_current_a", (1.6e-11, 2e-9)) == (
        "beam current",
        "16 pA to 2 nA",
    )
    assert describe_condition("serial", ("1", "2")) == ("serial number", "1, 2")
    assert describe_condition("of_later", (3.0, 3.0)) == ("of later", "3.0")
