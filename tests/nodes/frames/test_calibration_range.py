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

"""Leaving the calibrated range is said once, and to those who take the camera."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from semcal_ros.nodes.frames.calibrated_stream import CalibratedStreamNode
from semcal_ros.nodes.frames.calibration_range import RangeWatch
from tests.helpers.node_fakes import fake_reporter, notes
from tests.helpers.node_scenes import RANGE, make_calibration

CALIBRATION = make_calibration()
INSIDE, OUTSIDE = 2000.0, 2.0 * RANGE[1]


def test_the_range_is_left_and_entered_with_one_line_each() -> None:
    reporter, log = fake_reporter()
    watch = RangeWatch(reporter)
    for g in (INSIDE, OUTSIDE, OUTSIDE, 3.0 * RANGE[1], INSIDE, INSIDE):
        watch.check(CALIBRATION, CALIBRATION.at(g), g)
        assert watch.is_outside == (g > RANGE[1])
        assert notes(reporter)["in_calibrated_range"] == str(g <= RANGE[1])
    assert log == [
        "16000x is outside of the calibrated range 500x to 8000x",
        "2000x is inside of the calibrated range 500x to 8000x again",
    ]
    watch.check(None, None, OUTSIDE)
    assert len(log) == 2


@pytest.mark.parametrize(
    ("magnification", "mixed", "choice", "described"),
    [
        (INSIDE, False, "flag", True),
        (OUTSIDE, False, "flag", False),
        (OUTSIDE, False, "extrapolate", True),
        (INSIDE, True, "extrapolate", False),
    ],
)
def test_an_image_has_a_camera_only_where_the_calibration_covers_it(
    magnification: float, mixed: bool, choice: str, described: bool
) -> None:
    published: list[Any] = []
    node: Any = SimpleNamespace(
        calibration=SimpleNamespace(current=CALIBRATION),
        parameters={"uncalibrated": "pass", "out_of_range": choice},
        output=SimpleNamespace(publish=lambda camera, _frame: published.append(camera)),
        _receivers=[],
        _watch=SimpleNamespace(check=lambda: None, differs=False),
    )
    camera, frame = CALIBRATION.at(magnification), SimpleNamespace(mixed=mixed)
    CalibratedStreamNode.publish(node, camera, frame)  # type: ignore[arg-type]
    assert published == [camera if described else None]


@pytest.mark.parametrize(("choice", "count"), [("pass", 2), ("drop", 0)])
def test_images_without_a_calibration_go_out_only_if_they_may(choice: str, count: int) -> None:
    published: list[Any] = []
    reporter, _ = fake_reporter()
    node: Any = SimpleNamespace(
        calibration=SimpleNamespace(current=None),
        parameters={"uncalibrated": choice, "out_of_range": "flag"},
        output=SimpleNamespace(publish=lambda camera, _frame: published.append(camera)),
        _receivers=[],
        reporter=reporter,
        _watch=SimpleNamespace(check=lambda: None, differs=False),
        _dropped=0,
    )
    for _ in range(2):
        CalibratedStreamNode.publish(node, None, SimpleNamespace(mixed=False))  # type: ignore[arg-type]
    assert published == count * [None]
    assert notes(reporter).get("frames_uncalibrated", "0") == str(2 - count)
