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

"""More than a node can do, and consumers that do less than they should: newest wins, and nobody waits for the slow."""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import ParameterType, ParameterValue
from rclpy._rclpy_pybind11 import RCLError
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import SetBool

from tests.helpers.long_tests import long_but
from tests.helpers.node_scenes import (
    SIZE,
    image_message,
    magnification_message,
    texture,
    write_recording,
)
from tests.helpers.ros_process import LATCHED, PATIENT, RELIABLE, TIMEOUT_S, Peer, running
from tests.helpers.stream_bench import (
    CALIBRATION,
    COMPENSATOR,
    CORRECTOR,
    KINDS,
    MAGNIFICATION,
    NOISE,
    RECTIFIER,
    Bench,
    Kind,
    Watch,
    bench_of,
    difference,
    noisy,
    pixels,
    resident_kib,
    round_trip_s,
)

BURST_S = 2.0
OVERLOAD = 10.0
# px. Work enough for the node that sending ten times as much is still easy.
BURST_SIZE = 384
LISTENER = Path(__file__).resolve().parents[1] / "helpers" / "slow_listener.py"
LISTENER_DEPTH = 2


def test_a_few_frames_at_once_are_not_too_many(peer: Peer) -> None:
    """A hiccup of sender, node or machine; on a busy one not every time goes as well as the best."""
    with bench_of(peer, RECTIFIER) as bench:
        bench.set_magnification(MAGNIFICATION)
        bench.exchange(texture())
        for attempt in range(10):
            count = len(bench.images)
            for _ in range(5):
                bench.send(texture(attempt))
            with suppress(AssertionError):
                peer.wait_for(lambda n=count: len(bench.images) == n + 5, "all five", timeout_s=2.0)
                break
        else:
            pytest.fail("of five frames at once, some were lost every time")
        stamps = [message.header.stamp.sec for message in bench.images]
        assert stamps == sorted(stamps)
        bench.wait_counts(received=len(stamps), dropped=bench.sent - len(stamps))


@dataclass
class Burst:
    """Frames sent at a fixed rate, and when they came out again, s, by stamp."""

    bench: Bench
    frames: list[bytearray]
    sent_at: dict[int, float] = field(default_factory=dict)
    came_at: dict[int, float] = field(default_factory=dict)

    def send(self) -> None:
        """The next frame, serialized already: what is to be measured is the node, not this side."""
        self.bench.sent += 1
        frame = self.frames[self.bench.sent % len(self.frames)]
        # The stamp comes first in an image, after four bytes of encapsulation.
        struct.pack_into("<i", frame, 4, self.bench.sent)
        self.sent_at[self.bench.sent] = time.monotonic()
        self.bench.image.publish(bytes(frame))

    def note(self) -> None:
        for message in self.bench.images[len(self.came_at) :]:
            self.came_at[message.header.stamp.sec] = time.monotonic()

    def run(self, period_s: float, duration_s: float) -> None:
        """Send for a while, and receive meanwhile."""
        start = time.monotonic()
        due = 0
        while (elapsed := time.monotonic() - start) < duration_s:
            if due * period_s <= elapsed:
                self.send()
                due += 1
            # Half the time until the next frame is due, or one message.
            self.bench.peer.spin(max(due * period_s - (time.monotonic() - start), 1e-4) / 2.0)
            self.note()

    @property
    def latencies_s(self) -> list[float]:
        return [came - self.sent_at[stamp] for stamp, came in self.came_at.items()]


@pytest.mark.parametrize(
    "kind", long_but(lambda kind: kind.node == "rectifier", KINDS), ids=lambda kind: kind.node
)
def test_ten_times_too_many_frames(peer: Peer, kind: Kind, calibration_file: Path) -> None:
    parameters: dict[str, Any] = {"interpolation": "lanczos4"}
    if kind.rectifies:
        parameters["calibration"] = calibration_file
    picture = texture(size=BURST_SIZE)
    frames = [noisy(picture, seed) for seed in range(7)]
    with bench_of(peer, kind, parameters) as bench:
        bench.set_magnification(MAGNIFICATION)
        round_trip_s(bench, frames)
        alone_s = round_trip_s(bench, frames * 2)
        before = len(bench.images)
        before_kib = bench.resident_kib()
        bench.images.clear()
        burst = Burst(bench, [bytearray(serialize_message(image_message(f))) for f in frames])
        first = bench.sent + 1
        burst.run(alone_s / OVERLOAD, BURST_S)
        last = bench.sent
        # Newest wins: whatever was lost, the last frame was not.
        peer.wait_for(
            lambda: bench.images and bench.images[-1].header.stamp.sec == last, "the last frame"
        )
        burst.note()
        published = before + len(bench.images)
        state = bench.wait_counts(received=published, published=published, rejected=0)
        assert int(state["received"]) + int(state["dropped"]) == bench.sent
        # It was a burst indeed, and yet the node did not starve of it.
        came = len(bench.images)
        assert int(state["dropped"]) > 3 * came
        assert came > 0.1 * BURST_S / alone_s
        stamps = [m.header.stamp.sec for m in bench.images]
        assert stamps == sorted(set(stamps))
        assert first <= stamps[0]
        # A frame waits for the one before it, and then takes its own time. A queue of ten would show here.
        each_s = BURST_S / came
        assert np.median(burst.latencies_s) < 4.0 * each_s
        assert np.percentile(burst.latencies_s, 95) < 8.0 * each_s
        # 256 kB a frame, thousands of them: a tenth of a per cent would show.
        assert bench.resident_kib() - before_kib < 16 * 1024
        right = kind.right(frames[last % len(frames)], MAGNIFICATION, "lanczos4")
        assert difference(pixels(bench.images[-1]), right) < 3.0 * NOISE
        warned = [s for s in bench.watch.states(kind.full_name) if "dropped" in s["message"]]
        assert warned
        assert {s["level"] for s in warned} == {"1"}
        # And all is well again at once.
        message = bench.exchange(frames[0])
        right = kind.right(frames[0], MAGNIFICATION, "lanczos4")
        assert difference(pixels(message), right) < 3.0 * NOISE
        assert bench.watch.wait_fresh(kind.full_name)["level"] in ("0", "1")


def publish_patiently(publisher: Any, message: bytes) -> None:
    """Publish, and again where the middleware refuses for lack of room within its 100 ms.

    Kilted does so now and then when nothing is left between the messages. It is the receiver that is tested here.
    """
    for _ in range(100):
        with suppress(RCLError):
            publisher.publish(message)
            return
        time.sleep(0.01)
    raise AssertionError("the middleware takes no message")


def test_ten_times_too_many_frames_for_the_calibration_server(peer: Peer) -> None:
    """It only keeps the newest one."""
    node = "/sem/calibration_server"
    watch = Watch(peer)
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    value = peer.node.create_publisher(Float64, "magnification", LATCHED)
    with running("calibration_server", {"config": "virtual_sem"}) as process:
        peer.wait_for(lambda: image.get_subscription_count() == 1, "the subscription")
        value.publish(magnification_message(MAGNIFICATION))
        frame = serialize_message(image_message(texture(size=BURST_SIZE)))
        image.publish(frame)
        peer.wait_for(lambda: watch.count(node, "received") == 1, "a frame")
        before_kib = resident_kib(process.process.pid)
        for _ in range(3000):
            publish_patiently(image, frame)
        peer.wait_for(
            lambda: watch.count(node, "received") + watch.count(node, "dropped") == 3001,
            "all frames to be counted",
        )
        assert watch.count(node, "rejected") == 0
        assert watch.latest(node)["magnification"] == f"{MAGNIFICATION:g}"
        assert resident_kib(process.process.pid) - before_kib < 16 * 1024
        assert "no grid found" in peer.trigger(f"{node}/add_view").message
        assert process.process.poll() is None


@pytest.mark.long
def test_ten_times_too_many_magnifications(peer: Peer, calibration_file: Path) -> None:
    """The last one counts, for the server and for the frame after it."""
    watch = Watch(peer)
    projections = peer.collect(Float64MultiArray, "projection", LATCHED)
    server = "/sem/parameter_server"
    with (
        running("parameter_server", {"calibration": calibration_file}) as process,
        bench_of(peer, RECTIFIER, {"calibration": calibration_file, **PATIENT}) as bench,
    ):
        watch.wait_heard(server, "projection")
        peer.wait_for(lambda: bench.magnification.get_subscription_count() == 2, "both")
        bench.set_magnification(600.0)
        bench.exchange(texture())
        peer.wait_for(lambda: projections, "the projection")
        before_kib = bench.resident_kib(), resident_kib(process.process.pid)
        # A hundred wait in the queue at most: the rest is lost, the last one never.
        for value in np.linspace(700.0, 7000.0, 3000):
            bench.magnification.publish(magnification_message(float(value)))
        bench.set_magnification(MAGNIFICATION)
        message = bench.exchange(texture(1))
        np.testing.assert_array_equal(pixels(message), RECTIFIER.right(texture(1), MAGNIFICATION))
        final = CALIBRATION.at(MAGNIFICATION).rectified.P_affine.ravel()
        peer.wait_for(lambda: np.allclose(projections[-1].data, final, rtol=1e-12), "the last one")
        assert bench.resident_kib() - before_kib[0] < 8 * 1024
        assert resident_kib(process.process.pid) - before_kib[1] < 8 * 1024
        assert watch.count(server, "rejected") == 0


@pytest.mark.long
def test_memory_does_not_grow_with_the_magnifications_that_were_seen(
    peer: Peer, calibration_file: Path
) -> None:
    """Maps are kept for some magnifications, not for all that ever were."""
    picture = texture(size=256)
    with bench_of(peer, RECTIFIER, {"calibration": calibration_file, **PATIENT}) as bench:

        def sweep(count: int, high: float) -> int:
            for value in np.geomspace(600.0, high, count):
                bench.set_magnification(float(value))
                bench.exchange(picture)
            return bench.resident_kib()

        first = sweep(120, 7000.0)
        # 240 more pairs of maps would be 120 MB.
        assert sweep(240, 7100.0) - first < 16 * 1024
        # Maps may be interpolated between nodes of a lattice, which may turn a grey level.
        right = RECTIFIER.right(picture, 7100.0).astype(int)
        assert np.abs(pixels(bench.images[-1]) - right).max() <= 1


@pytest.mark.long
def test_a_recording_that_is_played_too_fast(
    peer: Peer, tmp_path: Path, calibration_file: Path
) -> None:
    """What the node could not follow is counted, and the last frame of the recording comes out."""
    # All the same: a magnification that was lost on the way is sent again later than its frame.
    magnifications = [2000.0] * 150
    # Large enough for the node to be busy when the next one comes.
    pictures = write_recording(tmp_path / "bag", magnifications, size=512)
    images = peer.collect(Image, "image_rect")
    watch = Watch(peer)
    node = RECTIFIER.full_name
    settings = {"calibration": calibration_file, "interpolation": "lanczos4"}
    with running("rectifier", settings):
        watch.wait_heard(node, "image_rect")
        # The first frame for itself: what comes before the first one that the node gets, it cannot count.
        playing = {
            "bag": tmp_path / "bag",
            "rate": 0.01,
            "start_paused": True,
            "wait_for_subscribers": 1,
        }
        with running("bag_player", playing) as player:
            peer.wait_for(lambda: peer.node.count_publishers("image_raw") == 1, "the player")
            peer.call(SetBool, "bag_player/pause", SetBool.Request(data=False))
            peer.wait_for(lambda: images, "the first frame")
            fast = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=100.0)
            assert peer.set_parameter("bag_player", "rate", fast).successful
            assert player.wait() == 0
        # A busy computer comes to the last of them some time after the player has ended.
        for _ in range(10):
            state = watch.wait_fresh(node)
            if int(state["received"]) + int(state["dropped"]) == len(magnifications):
                break
        assert int(state["received"]) + int(state["dropped"]) == len(magnifications), state
        assert int(state["dropped"]) > 0
        assert state["rejected"] == "0"
        peer.wait_for(lambda: len(images) == int(state["published"]), "what was published")
    right = RECTIFIER.right(pictures[-1], magnifications[-1], "lanczos4")
    # The degree of a map's polynomials depends on those before: hundredths of a grey level, rounded.
    assert np.abs(pixels(images[-1]) - right).max() <= 1


@pytest.mark.long
def test_a_player_that_waits_for_subscribers_loses_none_of_its_frames(
    peer: Peer, tmp_path: Path, calibration_file: Path
) -> None:
    """Not the first one either: who is subscribed must have found the player as well."""
    magnifications = [float(g) for g in np.geomspace(600.0, 7000.0, 12).round(1)]
    write_recording(tmp_path / "bag", magnifications, period_s=0.02)
    images = peer.collect(Image, "image_rect")
    watch = Watch(peer)
    playing = {"bag": tmp_path / "bag", "wait_for_subscribers": 1}
    with running("rectifier", {"calibration": calibration_file, **PATIENT}):
        watch.wait_heard(RECTIFIER.full_name, "image_rect")
        for played in (1, 2):
            with running("bag_player", playing) as player:
                assert player.wait() == 0
            state = watch.wait_fresh(RECTIFIER.full_name)
            assert int(state["received"]) == played * len(magnifications), state
            assert len(images) == played * len(magnifications)


# -- slow consumers ----------------------------------------------------------------------------------


@contextmanager
def _slow_listener(bench: Bench) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, str(LISTENER), bench.kind.image]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        key = f"subscribers.{bench.kind.image}"
        bench.peer.wait_for(lambda: int(bench.state().get(key, 0)) >= 2, "both consumers")
        yield process
    finally:
        process.kill()
        process.communicate(timeout=TIMEOUT_S)


# What the rectifier publishes, the corrector publishes by the same code.
@pytest.mark.parametrize("kind", [COMPENSATOR, CORRECTOR], ids=lambda kind: kind.node)
@pytest.mark.long
def test_a_consumer_that_takes_nothing_holds_up_nobody(
    peer: Peer, kind: Kind, calibration_file: Path
) -> None:
    """Reliable and keep-last on both sides: the newest frames replace those that were not fetched.

    A process that sleeps acknowledges all the same, for the middleware has threads of its own.
    """
    parameters: dict[str, Any] = dict(PATIENT)
    if kind.rectifies:
        parameters["calibration"] = calibration_file
    pictures = [noisy(texture(size=2 * SIZE), seed) for seed in range(10)]
    with bench_of(peer, kind, parameters) as bench:
        bench.set_magnification(MAGNIFICATION)
        round_trip_s(bench, pictures)
        before_s = round_trip_s(bench, pictures * 3)
        with _slow_listener(bench) as listener:
            before_kib = bench.resident_kib()
            during_s = round_trip_s(bench, pictures * 10)
            # Every frame came to the quick consumer. A publisher that waited for the slow one would
            # take the 100 ms after which the middleware gives up, each time.
            assert during_s < 5.0 * before_s
            bench.wait_counts(received=bench.sent, published=bench.sent, dropped=0, rejected=0)
            assert bench.resident_kib() - before_kib < 8 * 1024
            answer, _ = listener.communicate("\n", timeout=TIMEOUT_S)
        # What it gets at last is the newest that its own queue holds.
        newest = [bench.sent - LISTENER_DEPTH + 1 + i for i in range(LISTENER_DEPTH)]
        assert [int(text) for text in answer.split()] == newest
        assert [m.header.stamp.sec for m in bench.images] == list(range(1, bench.sent + 1))


@pytest.mark.long
def test_a_consumer_that_is_stopped_or_killed_does_not_stop_the_node(
    peer: Peer, calibration_file: Path
) -> None:
    """A stopped process acknowledges nothing, and does not give back the memory that the middleware shares with it.

    What other consumers on the machine get meanwhile is up to the middleware; the node must go on whatever that is.
    """
    with bench_of(peer, RECTIFIER, {"calibration": calibration_file, **PATIENT}) as bench:
        bench.set_magnification(MAGNIFICATION)
        picture = texture(size=2 * SIZE)
        before_s = round_trip_s(bench, [picture] * 30)
        before_kib = bench.resident_kib()
        for _ in range(2):
            with _slow_listener(bench) as listener:
                listener.send_signal(signal.SIGSTOP)
                start = time.monotonic()
                for _ in range(100):
                    bench.send(picture)
                    peer.spin(before_s)
                bench.wait_counts(received=bench.sent, published=bench.sent, dropped=0, rejected=0)
                # Reports come once a second. Blocked for 100 ms a frame it would have taken ten.
                assert time.monotonic() - start < 100 * 5.0 * before_s + 3.0
                listener.send_signal(signal.SIGKILL)
        assert bench.resident_kib() - before_kib < 8 * 1024
        assert bench.watch.wait_fresh(RECTIFIER.full_name)["level"] == "0"
