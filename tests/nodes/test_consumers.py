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

"""Functions of others in the process of the suite: they get every frame, and what they raise stays with them."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.signals import SignalHandlerOptions

from semcal_ros.core.camera.calibrated_frame import CalibratedFrame
from semcal_ros.core.errors import ConfigError, InvalidValueError
from semcal_ros.nodes.suite import CONSUMERS, Consumer, choose_consumers

SEEN: list[int] = []


def see(frame: CalibratedFrame) -> None:
    SEEN.append(frame.stamp_ns)


def stumble(frame: CalibratedFrame) -> None:
    see(frame)
    if frame.stamp_ns % 2:
        raise ZeroDivisionError(f"frame {frame.stamp_ns}")


def leave(frame: CalibratedFrame) -> None:
    see(frame)
    sys.exit("no more")


def interrupt(frame: CalibratedFrame) -> None:
    see(frame)
    raise KeyboardInterrupt("not by a user")


class WithNode:
    def __init__(self, node: Any) -> None:
        self.name = node.get_fully_qualified_name()

    def __call__(self, frame: CalibratedFrame) -> None:
        see(frame)


class Broken:
    def __init__(self, node: Any) -> None:
        raise OSError("no stage")


NUMBER = 3


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> str:
    """This file, by a name that an entry point can have."""
    made = ModuleType("consumers_under_test")
    vars(made).update({n: v for n, v in globals().items() if not n.startswith("__")})
    monkeypatch.setitem(sys.modules, made.__name__, made)
    SEEN.clear()
    return made.__name__


@pytest.fixture
def ros() -> Iterator[None]:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    yield
    rclpy.shutdown()


def entry(module: str, what: str, name: str = "bead") -> EntryPoint:
    return EntryPoint(name, f"{module}:{what}", CONSUMERS)


def frame(stamp_ns: int) -> CalibratedFrame:
    zeros = np.zeros((2, 2))
    return CalibratedFrame(
        zeros, stamp_ns, 1.0, np.zeros((3, 4)), np.zeros((12, 12)), np.zeros(2), zeros
    )


def run(consumer: Consumer, count: int) -> None:
    consumer.part.start(lambda: None)
    end_s = time.monotonic() + 10.0
    while consumer.frames + consumer.missed < count and time.monotonic() < end_s:
        time.sleep(0.01)
    assert consumer.part.stop()


@pytest.mark.parametrize(
    ("what", "failed", "trouble"),
    [
        ("see", 0, ""),
        ("WithNode", 0, ""),
        ("stumble", 3, "ZeroDivisionError: frame 5"),
        ("leave", 6, "SystemExit: no more"),
        ("interrupt", 6, "KeyboardInterrupt: not by a user"),
    ],
)
def test_every_frame_comes_whatever_is_raised(
    module: str, what: str, failed: int, trouble: str, ros: None
) -> None:
    consumer = Consumer(entry(module, what), depth=20)
    for stamp_ns in range(6):
        consumer.receive(frame(stamp_ns))
    run(consumer, 6)
    assert list(range(6)) == SEEN
    assert (consumer.frames, consumer.missed, consumer.failed) == (6, 0, failed)
    assert consumer.trouble == trouble
    consumer.node.destroy_node()


def test_it_is_said_which_callback_raised(
    module: str, ros: None, capfd: pytest.CaptureFixture[str]
) -> None:
    consumer = Consumer(entry(module, "leave"), depth=20)

    def beat() -> None:
        raise OSError("no pulse")

    consumer.part.post(beat)
    consumer.receive(frame(0))
    run(consumer, 1)
    said = capfd.readouterr().err
    for where, what in (
        ("a callback of its node", "no pulse"),
        ("the call with a frame", "no more"),
    ):
        assert 0 <= said.find(f"{where} raised") < said.find(what)
    consumer.node.destroy_node()


def test_the_oldest_frames_make_room_and_late_ones_are_skipped(module: str, ros: None) -> None:
    consumer = Consumer(entry(module, "see"), depth=4)
    for stamp_ns in range(6):
        consumer.receive(frame(stamp_ns))
    # Longer than a waiting frame is worth.
    time.sleep(0.1)
    run(consumer, 6)
    assert SEEN == [5]
    assert (consumer.frames, consumer.missed, consumer.waiting) == (1, 5, 0)
    consumer.node.destroy_node()


@pytest.mark.parametrize(
    ("what", "why"),
    [
        ("Broken", "bead .*OSError: no stage"),
        ("NUMBER", "bead .*which cannot be called"),
        ("nothing", "bead .*AttributeError"),
    ],
)
def test_what_cannot_be_called_is_refused_at_the_start(
    module: str, what: str, why: str, ros: None
) -> None:
    with pytest.raises(ConfigError, match=why):
        Consumer(entry(module, what))


def test_consumers_are_chosen_by_name() -> None:
    bead, wire = entry("x", "see"), entry("x", "see", "wire")
    assert choose_consumers("all", [wire, bead]) == [bead, wire]
    assert choose_consumers("none", [bead]) == []
    assert choose_consumers("wire, bead", [bead, wire]) == [wire, bead]
    with pytest.raises(InvalidValueError, match=r"consumer beat, .* expected bead, perhaps"):
        choose_consumers("beat", [bead])
    with pytest.raises(InvalidValueError, match="two installed packages"):
        choose_consumers("bead", [bead, entry("y", "see")])
