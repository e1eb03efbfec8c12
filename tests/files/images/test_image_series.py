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

"""Which images are of one scan, seen by several detectors."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any

import pytest

from semcal_ros.files.images.image_series import group_by_scan
from semcal_ros.files.images.sem_image import VendorSettings

SIZE_PX = (32, 20)
FIRST = VendorSettings(
    maker="thermo_fisher",
    model="Helios",
    detector="ETD",
    pixel_size_m=1e-9,
    pixel_size_y_m=1e-9,
    stage_tilt_rad=0.1,
    frame_time_s=20.0,
    time=datetime(2023, 11, 10, 14, 9, 15),
)


def at(seconds: float, detector: str, **changes: Any) -> VendorSettings:
    assert FIRST.time is not None
    return replace(
        FIRST, time=FIRST.time + timedelta(seconds=seconds), detector=detector, **changes
    )


def groups(*settings: VendorSettings) -> tuple[tuple[int, ...], ...]:
    return group_by_scan([(own, SIZE_PX) for own in settings])


def test_detectors_of_two_scans() -> None:
    assert groups(at(0, "ETD"), at(0, "TLD"), at(20, "ETD"), at(20, "TLD")) == ((0, 1), (2, 3))
    assert groups() == ()


def test_one_detector_is_a_series_even_within_a_second() -> None:
    quick = {"frame_time_s": 0.2}
    assert groups(*(at(0, "ETD", **quick) for _ in range(3))) == ((0,), (1,), (2,))


@pytest.mark.parametrize(
    ("apart_s", "frame_time_s", "together"),
    # Stamps of whole seconds: 19 s apart may be 20 s, a whole frame of 20 s.
    [(0, 0.2, True), (1, 0.2, False), (19, 20.0, True), (20, 20.0, False), (1, None, False)],
)
def test_within_one_pass_of_the_beam(
    apart_s: float, frame_time_s: float | None, together: bool
) -> None:
    times = {"frame_time_s": frame_time_s}
    found = groups(at(0, "ETD", **times), at(apart_s, "TLD", **times))
    assert found == (((0, 1),) if together else ((0,), (1,)))


@pytest.mark.parametrize(
    "change",
    [
        {"pixel_size_m": 2e-9},
        {"stage_tilt_rad": 0.2},
        {"model": "Scios"},
        {"acceleration_voltage_v": 5e3},
        {"time": None},
        {"detector": ""},
    ],
)
def test_another_scan_stands_alone(change: dict[str, Any]) -> None:
    assert groups(at(0, "ETD"), replace(at(0, "TLD"), **change)) == ((0,), (1,))
    other = [(at(0, "ETD"), SIZE_PX), (at(0, "TLD"), (32, 24))]
    assert group_by_scan(other) == ((0,), (1,))
