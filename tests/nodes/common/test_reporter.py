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

"""What a node counts and logs."""

from __future__ import annotations

import pytest
from rclpy.clock import Clock

from semcal_ros.core.errors import MessageError
from tests.helpers.node_fakes import fake_reporter, notes


def test_a_rejected_message_is_counted_each_time_and_logged_once() -> None:
    reporter, log = fake_reporter()
    for _ in range(3):
        reporter.reject(MessageError("no\n  image"))
    assert log == ["no image"]
    assert notes(reporter)["rejected"] == "3"


def test_warnings_whose_numbers_change_do_not_flood_the_log() -> None:
    reporter, log = fake_reporter()
    for number in range(1000):
        reporter.warn_seldom(f"frame {number}")
    assert len(log) == 100


@pytest.mark.parametrize(("age_s", "shown"), [(0.25, True), (4000.0, False), (-4000.0, False)])
def test_a_latency_is_shown_unless_the_stamp_is_from_another_clock(
    age_s: float, shown: bool
) -> None:
    reporter, _ = fake_reporter()
    reporter.count_published(Clock().now().nanoseconds - round(age_s * 1e9))
    assert notes(reporter)["published"] == "1"
    assert any("latency" in key for key in notes(reporter)) == shown


@pytest.mark.parametrize("up", [True, False])
def test_a_fault_of_the_node_is_counted_with_its_place_unless_ros_ends(
    monkeypatch: pytest.MonkeyPatch, up: bool
) -> None:
    monkeypatch.setattr("rclpy.utilities.ok", lambda: up)
    reporter, log = fake_reporter()
    error = ZeroDivisionError("0.0 cannot be raised")
    try:
        raise error
    except ZeroDivisionError:
        pass
    if not up:
        with pytest.raises(ZeroDivisionError):
            reporter.blame_itself(error)
        return
    for _ in range(3):
        reporter.blame_itself(error)
    assert notes(reporter)["rejected"] == "3"
    assert len(log) == 1
    assert "ZeroDivisionError: 0.0 cannot be raised" in log[0]
    assert "nodes/common/test_reporter.py, line" in log[0]


def test_the_name_of_a_file_need_not_be_utf_8() -> None:
    reporter, log = fake_reporter()
    reporter.reject(MessageError("caf\udce9.tif cannot be read"))
    assert log == ["caf\\udce9.tif cannot be read"]
    notes(reporter)["last_rejection"].encode()
