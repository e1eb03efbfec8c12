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

"""What the player takes from a recording, and how it is steered, over real DDS."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from semcal_ros.cli import main
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from tests.helpers.project import ROOT
from tests.helpers.ros_process import LATCHED, Peer, ended, running

START_S = 1_700_000_000
PERIOD_S = 0.5
# Of the frames, one after the other; the recording holds only its changes, as a microscope's driver sends them.
MAGNIFICATIONS = [1000.0, 1000.0, 2000.0, 2000.0, 2000.0, 500.0]
PLAYER = "/sem/bag_player"


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of all topics while the suite was running: inputs, and two of its outputs."""
    path = tmp_path_factory.mktemp("session") / "bag"
    last = None
    with BagWriter(path) as writer:
        for index, magnification in enumerate(MAGNIFICATIONS):
            stamp_ns = round((START_S + index * PERIOD_S) * 1e9)
            if magnification != last:
                value = blank_message("std_msgs/msg/Float64")
                value.data = last = magnification
                # The first message starts the recording.
                writer.write("/sem/magnification", stamp_ns - (index > 0) * 1_000_000, value)
            for topic in ("/sem/image_raw", "/sem/image_rect"):
                frame = blank_message("sensor_msgs/msg/Image")
                frame.header.stamp.sec, frame.header.stamp.nanosec = divmod(stamp_ns, 10**9)
                frame.height, frame.width, frame.step, frame.encoding = 1, 1, 1, "mono8"
                frame.data = np.array([index], np.uint8)
                writer.write(topic, stamp_ns, frame)
        text = blank_message("std_msgs/msg/String")
        text.data = "an old calibration"
        writer.write("/sem/calibration", stamp_ns, text)
    return path


PLAYED = [
    ({}, {"image_raw", "magnification"}),
    ({"topics": "all"}, {"image_raw", "magnification", "image_rect", "calibration"}),
    ({"topics": "image_raw,/sem/calibration"}, {"image_raw", "calibration"}),
    ({"topics": "all", "exclude": "calibration image_rect"}, {"image_raw", "magnification"}),
]


@pytest.mark.parametrize(("given", "wanted"), PLAYED)
def test_the_topics_that_are_asked_for_are_played(
    peer: Peer, session: Path, given: dict[str, str], wanted: set[str]
) -> None:
    every = ("image_raw", "magnification", "image_rect", "calibration")
    with running("bag_player", {"bag": session, "start_paused": True, **given}) as player:
        peer.wait_for(
            lambda: {t for t in every if peer.node.count_publishers(t)} == wanted, "the topics"
        )
        # It reports once its constructor is done.
        peer.wait_for(lambda: peer.state(PLAYER), "its diagnostics")
        line = next(text for text in player.output.splitlines() if str(session) in text)
        # Topics, counts, duration and rate; and a warning of what the suite publishes as well.
        assert "2.5 s at rate 1, paused" in line
        assert "/sem/image_raw (6)" in line
        assert ("not played" in line) is (len(wanted) < 4)
        warns = "nodes of the suite publish" in player.output
        assert warns is ("calibration" in wanted)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"topics": "image_row"}, "no topic image_row"),
        ({"topics": "calibration", "exclude": "calibration"}, "topics and exclude"),
        ({"wait_for": "magnification"}, "magnification:2"),
        # It names other topics, and would be replayed to nobody.
        ({"config": "other"}, "topics to all"),
    ],
)
def test_what_cannot_be_played_is_refused(
    session: Path, given: dict[str, str], reason: str
) -> None:
    if given.get("config"):
        other = session.parent / "other.yaml"
        text = (ROOT / "msg_configs" / "generic.yaml").read_text(encoding="utf-8")
        other.write_text(text.replace("topic: image_raw", "topic: camera/picture"))
        given = {**given, "config": str(other)}
    status, output = ended("bag_player", {"bag": session, **given})
    assert status == 2
    assert reason in output
    assert "Traceback" not in output


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ([], {"topics": "inputs", "exclude": "", "config": "generic", "clock": True, "rate": 1.0}),
        (
            ["--topics", "2024", "--exclude", "a,b", "--config", "jsm820", "--rate", "2"],
            {"topics": "2024", "exclude": "a,b", "config": "jsm820", "rate": 2.0},
        ),
    ],
)
def test_the_command_hands_its_options_to_the_node(
    session: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], wanted: dict[str, Any]
) -> None:
    """As ROS reads them, each with the type of its parameter, whatever the recording is called."""
    handed: list[str] = []
    monkeypatch.setattr("semcal_ros.nodes.bag_player.main", handed.extend)
    recording = session.with_name('2024: a "b" #1')
    if not recording.exists():
        shutil.copytree(session, recording)
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["play", str(recording), *options])
    read = dict(text.split(":=", 1) for text in handed[2::2])
    values = {name: yaml.safe_load(text) for name, text in read.items()}
    for name, value in {"bag": str(recording), **wanted}.items():
        assert values[name] == value
        assert type(values[name]) is type(value)


def test_a_paused_replay_is_stepped_and_sought(peer: Peer, session: Path) -> None:
    images = peer.collect(Image, "image_raw")
    magnifications = peer.collect(Float64, "magnification", LATCHED)
    seek = peer.node.create_publisher(Float64, f"{PLAYER}/seek", 1)
    given = {"bag": session, "start_paused": True, "wait_for": "image:1"}

    def shown() -> list[int]:
        return [message.data[0] for message in images]

    def step(expected: list[int]) -> None:
        answer = peer.trigger(f"{PLAYER}/play_next")
        assert answer.success, answer.message
        peer.wait_for(lambda: len(images) >= len(expected), "a frame")
        assert shown() == expected

    with running("bag_player", given) as player:
        peer.wait_for(seek.get_subscription_count, "the player")
        peer.wait_for(lambda: peer.node.count_publishers("image_raw"), "its images")
        peer.wait_for(lambda: peer.trigger(f"{PLAYER}/play_next").success, "the first step")
        peer.wait_for(lambda: images, "the first frame")
        assert shown() == [0]
        # Messages between two images come with the second.
        step([0, 1])
        assert [m.data for m in magnifications] == [1000.0]
        step([0, 1, 2])
        peer.wait_for(lambda: len(magnifications) == 2, "the new magnification")
        seek.publish(Float64(data=0.5))
        # The magnification that was in force there comes again.
        peer.wait_for(lambda: len(magnifications) == 3, "the old magnification")
        assert magnifications[-1].data == 1000.0
        step([0, 1, 2, 1])
        for wrong in (-1.0, 2.6, float("nan")):
            seek.publish(Float64(data=wrong))
            peer.wait_for(lambda w=wrong: f"seek to {w:g} s" in player.output, "a refusal")
        answer = peer.call(SetBool, f"{PLAYER}/pause", SetBool.Request(data=False))
        assert answer.success
        assert not peer.trigger(f"{PLAYER}/play_next").success, "it is not paused"
        assert player.wait() == 0
        assert "played 8 frames" in player.output
    peer.wait_for(lambda: len(images) == 8, "all frames")
    assert shown() == [0, 1, 2, 1, 2, 3, 4, 5]


def test_a_replay_is_paused_resumed_and_given_another_rate(peer: Peer, session: Path) -> None:
    images = peer.collect(Image, "image_raw")
    knob = peer.node.create_publisher(Float64, f"{PLAYER}/set_rate", 1)
    with running("bag_player", {"bag": session, "rate": 0.001, "loop": True}):
        peer.wait_for(knob.get_subscription_count, "the player")
        for state in ("paused", "playing"):
            assert peer.trigger(f"{PLAYER}/toggle_paused").message == state
        assert peer.call(SetBool, f"{PLAYER}/pause", SetBool.Request(data=True)).success
        assert peer.trigger(f"{PLAYER}/resume").message == "playing"
        for asked, rate in ((0.0, 0.001), (1000.0, 1000.0)):
            knob.publish(Float64(data=asked))
            peer.wait_for(
                lambda r=rate: peer.get_parameters(PLAYER, "rate")[0].double_value == r, "the rate"
            )
        # At the first rate, this would take longer than the test may.
        peer.wait_for(lambda: len(images) > 2, "frames")


@pytest.mark.long
def test_a_replay_begins_when_every_topic_has_its_subscribers(peer: Peer, session: Path) -> None:
    """Also a topic of another node, which alone knows who receives what it publishes."""
    diagnostics = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    images = peer.collect(Image, "image_raw")
    peer.collect(Float64, "magnification", LATCHED)

    def report(node: str, count: int) -> None:
        values = [KeyValue(key="subscribers.image_stabilized", value=str(count))]
        status = DiagnosticStatus(name=f"{node}: stream", values=values)
        diagnostics.publish(DiagnosticArray(status=[status]))
        peer.spin(0.3)

    given = {"bag": session, "rate": 100, "wait_for": "image:1 magnification:2 image_stabilized:1"}
    with running("bag_player", given) as player:
        peer.wait_for(lambda: diagnostics.get_subscription_count() >= 2, "the player")
        report("/sem/drift_compensator", 1)
        assert not images, "one subscriber of the magnification is missing"
        report("/sem/drift_compensator", 0)
        peer.collect(Float64, "magnification", LATCHED)
        report("/other/drift_compensator", 1)
        assert not images, "the rectifier has not been found"
        report("/sem/drift_compensator", 1)
        assert player.wait() == 0
    peer.wait_for(lambda: len(images) == len(MAGNIFICATIONS), "all frames, the first included")


def test_nothing_is_expected_of_a_topic_that_is_not_in_the_recording(session: Path) -> None:
    """The suite may listen to a stage that no recording has."""
    given = {"bag": session, "rate": 1000, "wait_for": "stage:1"}
    status, output = ended("bag_player", given)
    assert status == 0
    assert "played 6 frames" in output
