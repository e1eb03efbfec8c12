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

"""Time that goes back, jumps or stands still: nothing of before leaks into what comes after."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Vector3Stamped
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool

from tests.helpers.long_tests import long_but
from tests.helpers.node_scenes import SIZE, stamp_of, texture, write_recording
from tests.helpers.ros_process import PATIENT, Peer, running
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
    shifted_texture,
)

TRACKING = (COMPENSATOR, CORRECTOR)
# A day in 2027, and how far the clock is set back.
NOW_S = 1_800_000_000
BACK_S = 3600


def _parameters(kind: Kind, calibration_file: Path, **more: Any) -> dict[str, Any]:
    given: dict[str, Any] = {**PATIENT, **more}
    if kind.rectifies:
        given["calibration"] = calibration_file
    return given


# -- header stamps -----------------------------------------------------------------------------------


@pytest.mark.parametrize("back_s", [BACK_S, 3, NOW_S + 2**31], ids=["hour", "second", "furthest"])
@pytest.mark.parametrize("kind", TRACKING, ids=lambda kind: kind.node)
def test_drift_begins_anew_when_the_stamps_go_back(
    peer: Peer, kind: Kind, calibration_file: Path, back_s: int
) -> None:
    # A busy machine would turn to forecasts, which only know the stamps of some of the frames.
    parameters = _parameters(kind, calibration_file, drift_tracking="every_frame")
    with bench_of(peer, kind, parameters) as bench:
        bench.set_magnification(MAGNIFICATION)
        for index in range(8):
            bench.exchange(noisy(shifted_texture(index // 2), index), NOW_S + index)
        peer.wait_for(lambda: len(bench.drifts) == 8, "the drifts")
        pixel_m = CALIBRATION.at(MAGNIFICATION).pixel_size_m[0]
        assert abs(bench.drifts[-1].pose.pose.position.x) > 1.5 * pixel_m

        picture = noisy(shifted_texture(3), 99)
        message = bench.exchange(picture, max(NOW_S + 7 - back_s, -(2**31)))
        np.testing.assert_array_equal(pixels(message), kind.right(picture, MAGNIFICATION))
        drift = peer.wait_for(lambda: bench.drifts[8:], "the drift")[0].pose
        assert (drift.pose.position.x, drift.pose.position.y) == (0.0, 0.0)
        peer.wait_for(lambda: len(bench.velocities) == 9, "the velocity")
        velocity = bench.velocities[-1].twist.twist.linear
        assert (velocity.x, velocity.y) == (0.0, 0.0)
        # From there on it is tracked as ever: a specimen at rest stays where it is.
        for index in range(1, 4):
            picture = noisy(shifted_texture(3), 100 + index)
            stamp_s = max(NOW_S + 7 - back_s, -(2**31)) + index
            message = bench.exchange(picture, stamp_s)
            right = kind.right(picture, MAGNIFICATION)
            assert difference(pixels(message), right) < 2.0 * NOISE
        bench.wait_counts(received=12, published=12, dropped=0, rejected=0)


@pytest.mark.parametrize("kind", TRACKING, ids=lambda kind: kind.node)
def test_drift_begins_anew_when_asked(peer: Peer, kind: Kind, calibration_file: Path) -> None:
    parameters = _parameters(kind, calibration_file, drift_tracking="every_frame")
    with bench_of(peer, kind, parameters) as bench:
        bench.set_magnification(MAGNIFICATION)
        for index in range(4):
            bench.exchange(noisy(shifted_texture(index), index), NOW_S + index)
        peer.wait_for(lambda: len(bench.drifts) == 4, "the drifts")
        assert bench.drifts[-1].pose.pose.position.x != 0.0
        assert peer.trigger(f"{kind.full_name}/reset").success
        picture = noisy(shifted_texture(3), 99)
        message = bench.exchange(picture, NOW_S + 4)
        np.testing.assert_array_equal(pixels(message), kind.right(picture, MAGNIFICATION))
        drift = peer.wait_for(lambda: bench.drifts[4:], "the drift")[0].pose
        assert (drift.pose.position.x, drift.pose.position.y) == (0.0, 0.0)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.node)
def test_a_leap_of_the_stamps_does_no_harm(peer: Peer, kind: Kind, calibration_file: Path) -> None:
    """From the first second that a stamp can hold to the last, and a stamp that stands still."""
    stamps = [-(2**31), -1, 0, 0, 0, 1, NOW_S, 2**31 - 2, 2**31 - 1, 2**31 - 1]
    with bench_of(peer, kind, _parameters(kind, calibration_file)) as bench:
        bench.set_magnification(MAGNIFICATION)
        for index, stamp_s in enumerate(stamps):
            picture = noisy(texture(), index)
            message = bench.exchange(picture, stamp_s)
            assert message.header.stamp.sec == stamp_s
            right = kind.right(picture, MAGNIFICATION)
            assert difference(pixels(message), right) < 2.0 * NOISE
        count = len(stamps)
        bench.wait_counts(received=count, published=count, dropped=0, rejected=0)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.node)
def test_a_magnification_without_a_stamp_does_not_care_for_those_of_the_frames(
    peer: Peer, kind: Kind, calibration_file: Path
) -> None:
    """The order of publication decides, which does not go back."""
    with bench_of(peer, kind, _parameters(kind, calibration_file)) as bench:
        for index, g in enumerate((1000.0, 2000.0, 3000.0, 4000.0)):
            bench.set_magnification(g)
            # The specimen is another one each time, and each frame older than the one before.
            picture = texture(index)
            message = bench.exchange(picture, NOW_S - index * BACK_S)
            np.testing.assert_array_equal(pixels(message), kind.right(picture, g))
            peer.wait_for(
                lambda n=index: bench.count("published") == n + 1, "the diagnostics of it"
            )
            assert bench.state()["magnification"] == f"{g:g}"


def _pixel_size(g: float, stamp_s: float) -> Vector3Stamped:
    """What the configuration pixel_size_nm carries: the width of a pixel of the display of 0.12 m."""
    message = Vector3Stamped()
    message.header.stamp.sec = int(stamp_s)
    message.vector.x = 0.12 / (SIZE * g) * 1e9
    return message


@pytest.fixture
def stamped(peer: Peer, calibration_file: Path) -> Iterator[Bench]:
    """A rectifier whose magnifications have stamps, and were at 1000x and then at 2000x."""
    parameters = _parameters(RECTIFIER, calibration_file, config="pixel_size_nm")
    with bench_of(
        peer,
        RECTIFIER,
        parameters,
        magnification_type=Vector3Stamped,
        magnification_topic="pixel_size",
    ) as bench:
        for index, g in enumerate((1000.0, 2000.0)):
            bench.magnification.publish(_pixel_size(g, NOW_S + 100 * index))
            picture = texture(index)
            message = bench.exchange(picture, NOW_S + 100 * index + 1)
            _check_rectified(message, picture, g)
        yield bench


def _check_rectified(message: Any, picture: np.ndarray, g: float) -> None:
    # The value goes through nanometres: a rounding error may turn a grey level.
    assert np.abs(pixels(message).astype(int) - RECTIFIER.right(picture, g)).max() <= 1


def test_stamped_magnifications_of_before_a_jump_back_are_forgotten(stamped: Bench) -> None:
    """A clock that was set back passes the same times again, at other magnifications."""
    stamped.magnification.publish(_pixel_size(4000.0, NOW_S - 50))
    for index, stamp_s in enumerate((NOW_S - 49, NOW_S + 1, NOW_S + 101, NOW_S + 500)):
        picture = texture(10 + index)
        _check_rectified(stamped.exchange(picture, stamp_s), picture, 4000.0)
    stamped.wait_counts(received=6, published=6, rejected=0, dropped=0)


def test_a_frame_that_comes_first_after_a_jump_back_gets_no_magnification_of_before(
    stamped: Bench,
) -> None:
    """Its stamp lies where 1000x held once; that is another time. It waits, as the diagnostics tell."""
    stamped.send(texture(10), NOW_S + 50)
    state = stamped.wait_counts(received=3, published=2)
    assert "waiting for magnification" in state["message"]
    assert state["frames_without_magnification"] == "1"
    stamped.magnification.publish(_pixel_size(4000.0, NOW_S + 51))
    picture = texture(11)
    _check_rectified(stamped.exchange(picture, NOW_S + 52), picture, 4000.0)


def test_an_unusable_stamp_of_a_magnification_makes_it_unknown(stamped: Bench) -> None:
    """Whatever the clock of the stamps is: the value of before does not hold on, and the next good one counts."""
    broken = _pixel_size(3000.0, NOW_S + 200)
    broken.header.stamp.nanosec = 2**32 - 1
    stamped.magnification.publish(broken)
    stamped.send(texture(10), NOW_S + 201)
    state = stamped.wait_counts(received=3, published=2, rejected=1)
    assert "waiting for magnification" in state["message"]
    stamped.magnification.publish(_pixel_size(4000.0, NOW_S + 202))
    picture = texture(11)
    _check_rectified(stamped.exchange(picture, NOW_S + 203), picture, 4000.0)


# -- bags that loop ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind",
    long_but(lambda kind: kind.node == "stream_corrector", KINDS),
    ids=lambda kind: kind.node,
)
def test_every_turn_of_a_looping_bag_is_as_the_first(
    peer: Peer, kind: Kind, tmp_path: Path, calibration_file: Path
) -> None:
    magnifications = [float(g) for g in np.geomspace(600.0, 6000.0, 8).round(1)]
    pictures = write_recording(tmp_path / "bag", magnifications, period_s=0.2)
    playing = {
        "bag": tmp_path / "bag",
        "rate": 2.0,
        "loop": True,
        "start_paused": True,
        "clock": True,
        "wait_for_subscribers": 1,
    }
    parameters = _parameters(kind, calibration_file, use_sim_time=True)
    turns, count = 3, len(magnifications)
    with bench_of(peer, kind, parameters) as bench:
        peer.node.destroy_publisher(bench.image)
        peer.node.destroy_publisher(bench.magnification)
        with running("bag_player", playing) as player:
            peer.wait_for(lambda: peer.node.count_publishers("image_raw") == 1, "the player")
            bench.watch.wait_fresh(kind.full_name)
            peer.call(SetBool, "bag_player/pause", SetBool.Request(data=False))
            peer.wait_for(lambda: len(bench.images) >= turns * count, "three turns")
            assert player.process.poll() is None
        images = bench.images[: turns * count]
        state = bench.watch.wait_fresh(kind.full_name)
        # Diagnostics flow on when the player, and the clock with it, has gone.
        assert int(state["received"]) == int(state["published"]) == len(bench.images)
        assert (state["dropped"], state["rejected"]) == ("0", "0")
    stamps = [stamp_of(m) for m in images]
    assert stamps == stamps[:count] * turns
    # One turn lasts 1.4 s, which is more than a late arrival may be old.
    for index, message in enumerate(images):
        picture, g = pictures[index % count], magnifications[index % count]
        if not kind.tracks or index % count == 0:
            # The first frame of each turn has no drift, whatever was found in the turn before.
            np.testing.assert_array_equal(
                pixels(message), kind.right(picture, g), err_msg=f"frame {index}"
            )
    if kind.tracks:
        positions = [m.pose.pose.position for m in bench.drifts[: turns * count]]
        starts = [(p.x, p.y) for p in positions[::count]]
        assert starts == [(0.0, 0.0)] * turns


# -- simulated time ----------------------------------------------------------------------------------


class SimulatedTime:
    """The clock of a simulation, in the hand of the test."""

    def __init__(self, peer: Peer) -> None:
        self._peer = peer
        self._publisher = peer.node.create_publisher(Clock, "/clock", QoSProfile(depth=10))

    def wait_heard(self) -> None:
        self._peer.wait_for(lambda: self._publisher.get_subscription_count() > 0, "a listener")

    def reach(self, seconds: int, watch: Watch) -> None:
        """Set the time until it is that of the nodes: a clock is heard on best effort."""

        def there() -> bool:
            self.set(seconds)
            return bool(watch.arrays) and watch.arrays[-1].header.stamp.sec == seconds

        self._peer.wait_for(there, f"{seconds} s")

    def set(self, seconds: float) -> None:
        message = Clock()
        message.clock.sec = int(seconds)
        message.clock.nanosec = round((seconds - int(seconds)) * 1e9)
        self._publisher.publish(message)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.node)
def test_a_clock_that_stands_still_or_goes_back_stops_neither_frames_nor_diagnostics(
    peer: Peer, kind: Kind, calibration_file: Path
) -> None:
    clock = SimulatedTime(peer)
    parameters = _parameters(kind, calibration_file, use_sim_time=True)
    sent = 0
    with bench_of(peer, kind, parameters) as bench:
        clock.wait_heard()
        bench.set_magnification(MAGNIFICATION)
        # Before there is any time, at a time, for a while at the same, and an hour before that.
        for now_s in (None, NOW_S, NOW_S, NOW_S - BACK_S):
            if now_s is not None:
                clock.reach(now_s, bench.watch)
            for _ in range(3):
                sent += 1
                picture = noisy(texture(), sent)
                message = bench.exchange(picture, (now_s or 0) + 0.01 * sent)
                right = kind.right(picture, MAGNIFICATION)
                assert difference(pixels(message), right) < 2.0 * NOISE
            state = bench.watch.wait_fresh(kind.full_name)
            assert state["level"] == "0", state
            assert int(state["received"]) == int(state["published"]) == sent
            stamp_s = bench.watch.arrays[-1].header.stamp.sec
            assert stamp_s == (now_s or 0)
            # The rate is that of the wall clock: the simulated one says nothing about the work.
            assert float(state["rate_hz"]) > 0.0
        assert (state["dropped"], state["rejected"]) == ("0", "0")


def test_the_parameter_server_does_not_need_a_clock_that_goes_on(
    peer: Peer, calibration_file: Path
) -> None:
    clock = SimulatedTime(peer)
    watch = Watch(peer)
    node = "/sem/parameter_server"
    settings = {"calibration": calibration_file, "use_sim_time": True}
    with running("parameter_server", settings):
        clock.wait_heard()
        for now_s in (NOW_S, NOW_S - BACK_S):
            clock.reach(now_s, watch)
            state = watch.wait_fresh(node)
            assert (state["level"], state["message"]) == ("0", "ready")
            (answer,) = peer.get_parameters(node, "k@1000")
            np.testing.assert_allclose(
                np.reshape(answer.double_array_value, (3, 3)), CALIBRATION.at(1000.0).K, rtol=1e-12
            )


def test_the_virtual_sem_lives_in_simulated_time(peer: Peer) -> None:
    """It scans while the clock goes on, waits while it stands still, and goes on after it was set back."""
    clock = SimulatedTime(peer)
    watch = Watch(peer)
    images = peer.collect(Image, "image_raw")
    node = "/sem/virtual_sem"
    settings = {
        "width": 64,
        "height": 64,
        "rate": 10.0,
        "specimen": "gold",
        "drift": "fast",
        "use_sim_time": True,
    }

    def run_from(start_s: float, frames: int) -> list[Any]:
        images.clear()
        step = 0
        while len(images) < frames:
            step += 1
            assert step < 2000, f"{len(images)} frames; {watch.latest(node)}"
            clock.set(start_s + 0.02 * step)
            peer.spin(0.01)
        return list(images)

    with running("virtual_sem", settings) as process:
        clock.wait_heard()
        peer.wait_for(lambda: watch.states(node), "the diagnostics, without any time yet")
        # From no time at all to today, in one step.
        first = run_from(NOW_S, 6)
        assert all(pixels(m).std() > 5.0 for m in first)
        stamps = [stamp_of(m) for m in first]
        assert stamps == sorted(set(stamps))
        assert all(NOW_S - 5 <= s < NOW_S + 60 for s, _ in stamps[1:])

        images.clear()
        state = watch.wait_fresh(node)
        assert (state["level"], state["message"]) == ("0", "ready")
        assert images == []

        again = run_from(NOW_S - BACK_S, 6)
        assert all(pixels(m).std() > 5.0 for m in again)
        assert all(s < NOW_S - BACK_S + 60 for s, _ in map(stamp_of, again))
        state = watch.wait_fresh(node)
        assert state["rejected"] == "0", state
        assert process.process.poll() is None
