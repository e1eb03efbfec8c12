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

"""Which of several calibrations is in force, whatever the order in which they arrive."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from std_msgs.msg import String

from semcal_ros.nodes.frames.calibrated_stream import CalibratedStreamNode
from semcal_ros.nodes.frames.calibration_input import (
    CalibrationInput,
    RangeWatch,
    calibration_digest,
)
from tests.helpers.node_fakes import (
    FakeEndpoints,
    FakeParameters,
    fake_context,
    fake_reporter,
    notes,
)
from tests.helpers.node_scenes import RANGE, make_calibration

TIMEOUT_S = 30.0

CALIBRATION = make_calibration()
INSIDE, OUTSIDE = 2000.0, 2.0 * RANGE[1]


def text_of(width_m: float) -> str:
    """A calibration that is told from others by its display width."""
    return replace(make_calibration(), display_width_m=width_m).dumps()


class Bench:
    """A calibration input that gets messages with a time of publication."""

    def __init__(self, path: str = "") -> None:
        self.endpoints: Any = FakeEndpoints()
        self.parameters: Any = FakeParameters(
            {"calibration": path, "replayed_calibration": "ignore"}
        )
        self.changes: list[float] = []
        self.reporter, self.log = fake_reporter()
        self.input = CalibrationInput(
            fake_context(self.endpoints, parameters=self.parameters, reporter=self.reporter),
            on_change=lambda: self.changes.append(self.width_m),
        )

    @property
    def width_m(self) -> float:
        assert self.input.current is not None
        return self.input.current.display_width_m

    def receive(self, width_m: float, sent_ns: int) -> None:
        info = {"source_timestamp": sent_ns, "received_timestamp": sent_ns}
        self.endpoints.subscriptions["calibration"].callback(String(data=text_of(width_m)), info)

    def wait_for(self, width_m: float) -> None:
        self.wait_until(lambda: self.input.current is not None and self.width_m == width_m)

    def wait_until(self, done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + TIMEOUT_S
        while not done():
            assert time.monotonic() < deadline
            self.endpoints.hand_over()
            time.sleep(0.001)


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "cal.yaml"
    path.write_text(text_of(0.05), encoding="utf-8")
    return str(path)


def test_an_older_message_never_replaces_a_newer_one() -> None:
    bench = Bench()
    bench.receive(0.10, sent_ns=2_000)
    bench.wait_for(0.10)
    bench.receive(0.11, sent_ns=1_999)
    # Parsed after everything before it.
    bench.receive(0.12, sent_ns=2_001)
    bench.wait_for(0.12)
    assert bench.changes == [0.10, 0.12]


def test_an_older_message_that_is_parsed_last_does_not_replace_a_newer_file(file: str) -> None:
    bench = Bench()
    bench.receive(0.10, sent_ns=time.time_ns())
    # In force before the message is parsed, or at least before it is handed over.
    bench.parameters.set("calibration", file)
    bench.receive(0.11, sent_ns=time.time_ns() + 10**12)
    bench.wait_for(0.11)
    assert bench.changes == [0.05, 0.11]


def test_the_file_given_at_start_is_older_than_any_message(file: str) -> None:
    bench = Bench(file)
    assert bench.width_m == 0.05
    assert bench.changes == []
    bench.receive(0.10, sent_ns=1)
    bench.wait_for(0.10)


def test_the_same_text_again_counts_from_then_on_and_changes_nothing() -> None:
    bench = Bench()
    bench.receive(0.10, sent_ns=1_000)
    bench.wait_for(0.10)
    bench.receive(0.10, sent_ns=3_000)
    bench.receive(0.11, sent_ns=2_000)
    bench.receive(0.12, sent_ns=4_000)
    bench.wait_for(0.12)
    assert bench.changes == [0.10, 0.12]


def test_the_same_text_from_an_earlier_time_does_not_make_way_for_an_older_one() -> None:
    bench = Bench()
    bench.receive(0.10, sent_ns=3_000)
    bench.wait_for(0.10)
    bench.receive(0.10, sent_ns=1_000)
    bench.receive(0.11, sent_ns=2_000)
    bench.receive(0.12, sent_ns=4_000)
    bench.wait_for(0.12)
    assert bench.changes == [0.10, 0.12]


def test_what_this_node_has_published_does_not_come_back_as_news(file: str) -> None:
    bench = Bench(file)
    published_ns: list[int] = []

    class Publisher:
        def publish(self, _message: Any) -> None:
            published_ns.append(time.time_ns())

    bench.input.publish(Publisher())
    assert bench.input.has_published
    bench.receive(0.10, sent_ns=1)
    bench.wait_for(0.10)
    bench.receive(0.05, sent_ns=published_ns[0])
    bench.receive(0.11, sent_ns=time.time_ns() + 10**12)
    bench.wait_for(0.11)
    assert bench.changes == [0.10, 0.11]


@pytest.mark.parametrize("player", ["/sem/bag_player", "/rosbag2_player"])
def test_a_calibration_that_may_be_of_a_recording_does_not_displace_another(
    file: str, player: str
) -> None:
    bench = Bench(file)
    topic = bench.endpoints.subscriptions["calibration"]
    topic.names = ["/sem/parameter_server", player]
    bench.receive(0.10, sent_ns=time.time_ns())
    bench.wait_until(lambda: len(bench.log) > 1)
    assert bench.width_m == 0.05
    assert f"{player} plays a recording there, and {file} is in force" in bench.log[-1]
    digest = calibration_digest(text_of(0.10))
    assert bench.input.conditions() == [f"calibration {digest} not used while {player} plays"]
    bench.parameters.set("replayed_calibration", "take")
    bench.receive(0.11, sent_ns=time.time_ns())
    bench.wait_for(0.11)
    # What came from a recording may give way to the next one.
    bench.parameters.set("replayed_calibration", "ignore")
    bench.receive(0.12, sent_ns=time.time_ns())
    bench.wait_for(0.12)
    # One made live is worth more again.
    topic.names = ["/sem/calibration_server"]
    bench.receive(0.13, sent_ns=time.time_ns())
    bench.wait_for(0.13)
    topic.names = [player]
    bench.receive(0.14, sent_ns=time.time_ns())
    bench.wait_until(lambda: bool(bench.input.conditions()))
    assert bench.width_m == 0.13


def test_a_calibration_of_a_recording_fills_in_where_there_is_none() -> None:
    bench = Bench()
    bench.endpoints.subscriptions["calibration"].names = ["/sem/bag_player"]
    assert bench.input.current is None
    bench.receive(0.10, sent_ns=1)
    bench.wait_for(0.10)
    assert bench.width_m == 0.10


def test_a_file_that_is_displaced_is_named_in_a_warning(file: str) -> None:
    bench = Bench(file)
    bench.receive(0.10, sent_ns=1)
    bench.wait_for(0.10)
    assert bench.log[-1].endswith(f"; it displaces {file}")


def test_a_file_that_is_set_again_unchanged_is_no_change(file: str) -> None:
    bench = Bench(file)
    bench.parameters.set("calibration", file)
    assert bench.changes == []
    # But it counts from now on.
    bench.receive(0.10, sent_ns=1)
    bench.receive(0.11, sent_ns=time.time_ns() + 10**12)
    bench.wait_for(0.11)
    assert bench.changes == [0.11]
    bench.parameters.set("calibration", file)
    assert bench.changes == [0.11, 0.05]


def test_a_bad_text_is_refused_and_the_old_calibration_stays() -> None:
    bench = Bench()
    bench.receive(0.10, sent_ns=1)
    bench.wait_for(0.10)
    info = {"source_timestamp": 2, "received_timestamp": 2}
    callback = bench.endpoints.subscriptions["calibration"].callback
    callback(String(data="no calibration"), info)
    bench.receive(0.11, sent_ns=3)
    bench.wait_for(0.11)
    callback(String(data=""), info)
    assert bench.width_m == 0.11
    assert any("calibration message with 0 bytes" in line for line in bench.log)


def test_doubts_about_the_scale_are_logged_once_and_last_as_long_as_their_calibration(
    tmp_path: Path,
) -> None:
    doubted = replace(
        make_calibration(),
        display_width_m=0.05,
        statistics={"warnings": ["scale: the grid is worn", "few views", "scale: the tilt is off"]},
    )
    doubted.save(tmp_path / "cal.yaml")
    bench = Bench(str(tmp_path / "cal.yaml"))
    summary = "scale of the calibration: 2 warnings, the first: the grid is worn"
    for _ in range(3):
        assert bench.input.conditions() == [summary]
    assert [line for line in bench.log if "grid is worn" in line] == [summary]
    assert notes(bench.reporter)["calibration_warnings"] == "the grid is worn | the tilt is off"
    bench.receive(0.10, sent_ns=1)
    bench.wait_for(0.10)
    assert bench.input.conditions() == []
    assert "calibration_warnings" not in notes(bench.reporter)


def test_without_a_calibration_that_is_the_condition() -> None:
    assert Bench().input.conditions() == ["uncalibrated"]


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
