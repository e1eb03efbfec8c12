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

"""Magnifications are those of the frames, whatever single stamps say.

Conditions that are not those of the calibration are said once per change; bad messages are not known conditions.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3Stamped
from rclpy.time import Time

from semcal_ros.config.config import load_config
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.nodes.frames.calibrated_stream import CalibratedStreamNode
from semcal_ros.nodes.frames.held_values import ConditionsWatch, MagnificationInput
from tests.helpers.node_fakes import FakeEndpoints, fake_context, fake_reporter, notes
from tests.helpers.node_scenes import make_calibration

MADE_AT = Provenance(
    conditions={
        "acceleration_voltage_v": (5000.0, 5000.0),
        "detector": ("SE2",),
        "working_distance_m": (0.01, 0.01),
    }
)
CALIBRATION = replace(make_calibration(), provenance=MADE_AT)
SAME = {"accelerating_voltage_v": "5000.0", "detector": "SE2", "working_distance_m": "0.01"}


STAMPED = """name: sem
display_width_m: 0.12
magnification: {quantity: magnification, type: geometry_msgs/msg/Vector3Stamped, field: vector.x}
"""
S = 1_000_000_000


class StampedMagnification:
    """The input of stamped magnifications, and frames that ask it."""

    def __init__(self, tmp_path: Path) -> None:
        path = tmp_path / "sem.yaml"
        path.write_text(STAMPED)
        self.config = load_config(str(path))
        endpoints: Any = FakeEndpoints()
        self.input = MagnificationInput(fake_context(endpoints, self.config))
        self.subscription = endpoints.subscriptions["magnification"]

    def tell(self, stamp_s: float, value: float) -> None:
        message = Vector3Stamped()
        message.header.stamp = Time(nanoseconds=round(stamp_s * S)).to_msg()
        message.vector.x = value
        self.subscription.callback(message, {"source_timestamp": 0, "received_timestamp": 0})

    def at(self, stamp_s: float) -> float | None:
        return self.input.at(round(stamp_s * S), 0, 512, self.config)

    def is_mixed(self, stamp_s: float) -> bool:
        return self.input.changed_during(round(stamp_s * S), 0)


@pytest.mark.parametrize("bad_s", [0.0, 1000.0])
def test_one_bad_stamp_does_not_make_the_magnification_unknown_for_good(
    tmp_path: Path, bad_s: float
) -> None:
    stream = StampedMagnification(tmp_path)
    stream.tell(5000.0, 800.0)
    assert stream.at(5001.0) == 800.0
    assert stream.at(bad_s) is None
    # Publishers are asked for their latest value, should the clock have gone back.
    assert stream.subscription.asked_again == 1
    assert stream.at(5002.0) == 800.0


def test_after_the_clock_went_back_only_new_values_count(tmp_path: Path) -> None:
    stream = StampedMagnification(tmp_path)
    stream.tell(5000.0, 800.0)
    assert stream.at(5001.0) == 800.0
    assert stream.at(100.0) is None
    stream.tell(99.0, 300.0)
    assert [stream.at(101.0), stream.at(5002.0)] == [300.0, 300.0]


def test_what_only_trembles_is_no_change(tmp_path: Path) -> None:
    stream = StampedMagnification(tmp_path)
    stream.input._config = replace(stream.config, scan=ScanTiming(1.0))
    for k in range(20):
        stream.tell(10.0 + 0.1 * k, 800.0 * (1.0 + 1e-9 * k))
    assert not stream.is_mixed(10.5)
    stream.tell(12.0, 801.0)
    assert stream.is_mixed(11.5)


def test_a_frame_of_which_nothing_is_known_is_not_mixed(tmp_path: Path) -> None:
    stream = StampedMagnification(tmp_path)
    stream.input._config = replace(stream.config, scan=ScanTiming(1.0))
    for stamp_s in (10.0, 10.5):
        stream.tell(stamp_s, -1.0)
    assert stream.at(10.2) is None
    assert not stream.is_mixed(10.2)
    # It becomes known in the middle of the scan.
    stream.tell(11.5, 800.0)
    assert stream.is_mixed(11.2)


class Bench:
    """A watch, and messages for it."""

    def __init__(self) -> None:
        self.endpoints: Any = FakeEndpoints()
        self.reporter, self.log = fake_reporter()
        self.current: Any = CALIBRATION
        self.watch = ConditionsWatch(
            fake_context(self.endpoints, reporter=self.reporter), lambda: self.current
        )

    def tell(self, **values: str) -> None:
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        self.endpoints.subscriptions["conditions"].callback(DiagnosticStatus(values=pairs), {})


def test_each_change_is_said_once() -> None:
    bench = Bench()
    assert bench.watch.conditions() == []
    assert notes(bench.reporter)["conditions"] == "unknown"
    for voltage in ("5000", "10000", "10000", "20000", "5000"):
        for _ in range(2):
            bench.tell(**{**SAME, "accelerating_voltage_v": voltage})
            assert bench.watch.differs == (voltage != "5000")
    assert [line.partition(";")[0] for line in bench.log] == [
        "other conditions than those of the calibration: voltage 10 kV, calibrated at 5 kV",
        "other conditions than those of the calibration: voltage 20 kV, calibrated at 5 kV",
        "the conditions are those of the calibration again",
    ]
    assert notes(bench.reporter)["conditions"] == "those of the calibration"


def test_the_condition_says_what_differs_as_long_as_it_does() -> None:
    bench = Bench()
    bench.tell(accelerating_voltage_v="10000", working_distance_m="0.02")
    assert bench.watch.conditions() == [
        "other conditions: voltage 10 kV, calibrated at 5 kV, working distance 20 mm, calibrated at 10 mm"
    ]
    # Another calibration, of unknown conditions, comes into force.
    bench.current = make_calibration()
    assert bench.watch.conditions() == []
    assert notes(bench.reporter)["conditions"] == "not recorded in the calibration"
    bench.current = None
    assert bench.watch.conditions() == []
    assert "conditions" not in notes(bench.reporter)


def test_another_detector_is_said_and_no_condition() -> None:
    bench = Bench()
    bench.tell(**{**SAME, "detector": "BSE"})
    bench.tell(**{**SAME, "detector": "BSE", "dwell_s": "1e-6"})
    assert bench.log == ["different from the calibration: detector BSE, calibrated at SE2"]
    assert not bench.watch.differs
    assert bench.watch.conditions() == []


@pytest.mark.parametrize("value", ["ten kilovolts", "nan", "inf", "", " ", "1e400", "\x00"])
def test_what_is_no_number_is_not_known(value: str) -> None:
    bench = Bench()
    bench.tell(accelerating_voltage_v=value)
    assert not bench.watch.differs
    assert bench.log == []


def test_a_message_of_another_type_makes_them_unknown() -> None:
    bench = Bench()
    bench.tell(accelerating_voltage_v="10000")
    assert bench.watch.differs
    bench.endpoints.subscriptions["conditions"].callback(SimpleNamespace(), {})
    assert not bench.watch.differs
    assert "without values" in notes(bench.reporter)["last_rejection"]


@pytest.mark.parametrize(("choice", "count"), [("warn", 2), ("refuse", 0)])
def test_images_under_other_conditions_go_out_only_if_they_may(choice: str, count: int) -> None:
    published: list[Any] = []
    bench = Bench()
    bench.tell(accelerating_voltage_v="10000")
    node: Any = SimpleNamespace(
        calibration=SimpleNamespace(current=CALIBRATION),
        parameters={"uncalibrated": "pass", "out_of_range": "flag", "on_mismatch": choice},
        output=SimpleNamespace(publish=lambda camera, _frame: published.append(camera)),
        _receivers=[],
        reporter=bench.reporter,
        _watch=bench.watch,
        _refused=0,
    )
    for _ in range(2):
        CalibratedStreamNode.publish(node, CALIBRATION.at(1000.0), SimpleNamespace(mixed=False))  # type: ignore[arg-type]
    assert len(published) == count
    assert notes(bench.reporter).get("frames_refused") == (None if count else "2")
