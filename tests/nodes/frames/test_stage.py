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

"""What the stage said last before a frame, live."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from sensor_msgs.msg import JointState

from semcal_ros.config.config import MicroscopeConfig, StageConfig, load_config
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.nodes.frames.stage import StageInput
from tests.helpers.node_fakes import FakeEndpoints, fake_context, fake_reporter, notes

S = 1_000_000_000


def joints(stamp_s: int, **positions: float) -> JointState:
    message = JointState(name=list(positions), position=list(positions.values()))
    message.header.stamp.sec = stamp_s
    return message


def config_with(stage: StageConfig | None) -> MicroscopeConfig:
    return replace(load_config("generic"), stage=stage)


class Bench:
    """A stage input, and messages for it that are published at a given time."""

    def __init__(self, source: StageConfig | None = None) -> None:
        self.endpoints: Any = FakeEndpoints()
        self.reporter, self.log = fake_reporter()
        self.input = StageInput(
            fake_context(self.endpoints, config_with(source or StageConfig()), None, self.reporter)
        )

    def publish(self, message: JointState, sent_s: int = 100) -> None:
        info = {"source_timestamp": sent_s * S, "received_timestamp": sent_s * S}
        self.endpoints.subscriptions["stage"].callback(message, info)

    def tilt_at(self, second: float) -> float | None:
        reading = self.input.at(round(second * S))
        return None if reading is None else reading.tilt_rad


def test_a_reading_is_valid_from_its_stamp_on() -> None:
    bench = Bench()
    assert bench.tilt_at(1.0) is None
    assert notes(bench.reporter)["stage_tilt_rad"] == "unknown"
    bench.publish(joints(1, tilt=0.1, rotation=2.0))
    bench.publish(joints(5, tilt=0.2))
    assert [bench.tilt_at(t) for t in (0.9, 1.0, 4.9, 5.0)] == [None, 0.1, 0.1, 0.2]
    assert bench.input.at(S) == StageReading(0.1, 2.0)
    assert notes(bench.reporter)["stage_tilt_rad"] == "0.1"


def test_messages_that_wait_are_taken_first() -> None:
    bench = Bench()
    info = {"source_timestamp": S, "received_timestamp": S}
    bench.endpoints.subscriptions["stage"].waiting.append((joints(1, tilt=0.3), info))
    assert bench.tilt_at(2.0) == 0.3


def test_without_stamps_the_newest_counts() -> None:
    bench = Bench()
    bench.publish(joints(0, tilt=0.1), sent_s=100)
    bench.publish(joints(0, tilt=0.2), sent_s=101)
    assert bench.tilt_at(5.0) == 0.2


def test_of_a_frame_without_a_stamp_the_newest_counts() -> None:
    bench = Bench()
    bench.publish(joints(1, tilt=0.1))
    bench.publish(joints(5, tilt=0.2))
    assert bench.tilt_at(0.0) == 0.2


def test_a_clock_that_goes_back_forgets() -> None:
    bench = Bench()
    bench.publish(joints(50, tilt=0.1))
    bench.publish(joints(10, tilt=0.2))
    assert bench.tilt_at(60.0) == 0.2


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (joints(5, tilt=30.0), "tilt 30 rad; expected radians"),
        (joints(5, tilt=math.nan), "a stage with tilt nan; expected finite angles"),
        (JointState(name=["tilt"]), "0 positions of the joints tilt"),
    ],
)
def test_a_bad_message_makes_the_stage_unknown_and_is_counted(
    message: JointState, reason: str
) -> None:
    bench = Bench()
    message.header.stamp.sec = 5
    bench.publish(joints(1, tilt=0.1))
    bench.publish(message)
    assert bench.tilt_at(6.0) is None
    assert bench.tilt_at(4.0) == 0.1
    assert reason in notes(bench.reporter)["last_rejection"]
    bench.publish(joints(8, tilt=0.2))
    assert bench.tilt_at(9.0) == 0.2


def test_missing_joints_are_a_condition_and_logged_when_that_changes() -> None:
    bench = Bench(StageConfig(tilt="T", rotation="R"))
    for second in range(1, 4):
        bench.publish(joints(second, T=0.1, R=0.2))
        assert bench.input.conditions() == []
    for second in range(4, 8):
        bench.publish(joints(second, tilt=0.1, R=0.2))
    assert bench.input.conditions() == ["no joint T on stage"]
    assert bench.log == ["no joint T on stage; its joints: tilt, R"]
    assert bench.input.at(7 * S) == StageReading(None, 0.2)
    bench.publish(joints(8))
    assert bench.input.conditions() == ["no joint T on stage", "no joint R on stage"]
    bench.publish(joints(9, T=0.1, R=0.2))
    assert bench.input.conditions() == []
    # Rotations by their usual names need not be there.
    plain = Bench()
    plain.publish(joints(1, tilt=0.1))
    assert (plain.input.conditions(), plain.log) == ([], [])


def test_a_jump_of_the_tilt_is_told_and_used() -> None:
    bench = Bench()
    bench.publish(joints(10, tilt=0.1))
    bench.publish(joints(20, tilt=0.7))
    assert bench.log == []
    late = joints(20, tilt=0.1)
    late.header.stamp.nanosec = 10**8
    bench.publish(late)
    assert bench.log == [
        "the tilt on stage jumps by 34.4 degrees within 0.1 s: a wrong reading, or a wrong stamp"
    ]
    assert notes(bench.reporter)["stage_jumps"] == "1"
    assert bench.tilt_at(21.0) == 0.1
    assert bench.input.conditions() == []


def test_degrees_leave_a_doubt_until_it_is_taken_back() -> None:
    bench = Bench()
    bench.publish(joints(1, tilt=1.0))
    assert (bench.input.doubt, bench.input.conditions()) == ("", [])
    bench.publish(joints(2, tilt=30.0))
    bench.publish(joints(3, tilt=0.1))
    bench.publish(joints(4, rotation=90.0, tilt=0.1))
    assert bench.input.doubt == "tilt 30 rad"
    assert bench.input.conditions() == ["tilt 30 rad on stage: degrees?"]
    bench.input.forget_doubt()
    assert (bench.input.doubt, bench.input.conditions()) == ("", [])


def test_without_a_section_nothing_is_subscribed() -> None:
    endpoints: Any = FakeEndpoints()
    stage = StageInput(fake_context(endpoints, config_with(None)))
    assert stage.conditions() == []
    assert stage.at(S) is None
    assert endpoints.subscriptions == {}
