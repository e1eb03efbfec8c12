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

"""kill -9 of the sources and of what stands beside the stream, and what can never start."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64

from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.config.config import load_config
from semcal_ros.synthetic import Detector, calibration_plan, preset
from tests.helpers.node_scenes import (
    SIZE,
    image_message,
    magnification_message,
    stamp_of,
    texture,
    write_recording,
)
from tests.helpers.ros_process import LATCHED, PATIENT, RELIABLE, NodeProcess, Peer, running
from tests.helpers.stream_bench import (
    CALIBRATION,
    COMPENSATOR,
    MAGNIFICATION,
    NOISE,
    RECTIFIER,
    Stream,
    Watch,
    bench_of,
    difference,
    pixels,
    restartable,
)

# -- the sources -------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_killed_microscope_comes_back_and_nothing_of_it_is_mixed_up(
    peer: Peer, calibration_file: Path
) -> None:
    """The knob of a virtual SEM is back at its start; frames of both processes are rectified at their own value."""
    settings = {"magnification": 4000.0, "width": SIZE, "height": SIZE, "rate": 10.0}
    scan = load_config("virtual_sem").scan
    assert scan is not None
    scan_s = scan.acquisition_time_s
    knob = peer.node.create_publisher(Float64, "virtual_sem/set_magnification", RELIABLE)
    infos = peer.collect(CameraInfo, "camera_info")
    values = peer.collect(Float64, "magnification", LATCHED)
    watch = Watch(peer)
    rectifier = {"calibration": calibration_file, **PATIENT}
    with running("rectifier", rectifier), restartable("virtual_sem", settings) as sem:
        watch.wait_heard(RECTIFIER.full_name, "camera_info")
        peer.wait_for(lambda: knob.get_subscription_count() == 1, "the knob")
        knob.publish(Float64(data=1000.0))

        def shown() -> float:
            return float(infos[-1].k[0]) if infos else 0.0

        at = {g: CALIBRATION.at(g).rectified.K[0, 0] for g in (1000.0, 4000.0)}
        peer.wait_for(lambda: np.isclose(shown(), at[1000.0], rtol=1e-12), "frames at 1000x")
        sem.kill()
        # Published by then at the latest; a frame is stamped when its scan begins.
        killed_ns = time.time_ns() - round(scan_s * 1e9)
        values.clear()
        sem.start_again()

        def of_the_new_process() -> list[CameraInfo]:
            return [m for m in infos if stamp_ns_from_msg(m) > killed_ns]

        peer.wait_for(lambda: len(of_the_new_process()) >= 5, "frames of the new process")
        peer.wait_for(lambda: values, "the magnification of the new process")
        assert [v.data for v in values] == [4000.0]
        for message in of_the_new_process():
            assert message.k[0] == pytest.approx(at[4000.0], rel=1e-12), stamp_of(message)
        state = watch.wait_fresh(RECTIFIER.full_name)
        # The numbers of the new publisher begin at one: that is no loss.
        assert (state["dropped"], state["rejected"]) == ("0", "0")
        # Before the magnification was heard; during whose scan the knob was turned.
        waiting = int(state.get("frames_without_magnification", 0))
        waiting += int(state.get("frames_mixed", 0))
        assert int(state["received"]) == int(state["published"]) + waiting, state


def test_a_publisher_that_restarts_is_counted_from_its_first_frame(
    peer: Peer, calibration_file: Path
) -> None:
    with bench_of(peer, RECTIFIER, {"calibration": calibration_file, **PATIENT}) as bench:
        bench.set_magnification(MAGNIFICATION)
        for start in range(3):
            for seed in range(4):
                message = bench.exchange(texture(seed))
                right = RECTIFIER.right(texture(seed), MAGNIFICATION)
                np.testing.assert_array_equal(pixels(message), right)
            peer.node.destroy_publisher(bench.image)
            bench.image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
            peer.wait_for(lambda: bench.image.get_subscription_count() == 1, "the subscription")
            bench.wait_counts(received=4 * (start + 1), dropped=0)
            # A microscope that starts anew says what it is at; without, frames would wait for it for seconds.
            bench.set_magnification(MAGNIFICATION)
        bench.wait_counts(published=12, rejected=0)


@pytest.mark.long
def test_a_killed_bag_player_begins_anew_and_so_does_what_depends_on_stamps(
    peer: Peer, tmp_path: Path, calibration_file: Path
) -> None:
    """Stamps go back: each frame of the second run is rectified at its own magnification all the same."""
    magnifications = [float(g) for g in np.geomspace(600.0, 6000.0, 20).round(1)]
    pictures = write_recording(tmp_path / "bag", magnifications, period_s=0.1)
    images = peer.collect(Image, "image_rect")
    watch = Watch(peer)
    rectifier = {"calibration": calibration_file, **PATIENT}
    playing = {"bag": tmp_path / "bag", "wait_for_subscribers": 1}
    with running("rectifier", rectifier) as node:
        watch.wait_heard(RECTIFIER.full_name, "image_rect")
        player = NodeProcess("bag_player", playing)
        try:
            peer.wait_for(lambda: len(images) >= 8, "the first run")
        finally:
            player.stop(signal.SIGKILL)
            player.close()
        peer.spin(0.5)
        first_run = len(images)
        assert first_run < len(magnifications)
        with running("bag_player", playing) as player:
            peer.wait_for(lambda: len(images) >= first_run + len(magnifications), "the second run")
            assert player.wait() == 0
        assert node.process.poll() is None
        state = watch.wait_fresh(RECTIFIER.full_name)
    assert int(state["published"]) == len(images) == first_run + len(magnifications)
    assert (state["dropped"], state["rejected"]) == ("0", "0")
    order = [*range(first_run), *range(len(magnifications))]
    for message, index in zip(images, order, strict=True):
        right = RECTIFIER.right(pictures[index], magnifications[index])
        np.testing.assert_array_equal(pixels(message), right)


# -- further nodes -----------------------------------------------------------------------------------


@pytest.mark.long
def test_a_killed_compensator_does_not_confuse_the_rectifier_behind_it(
    peer: Peer, calibration_file: Path
) -> None:
    rectifier = {
        "calibration": calibration_file,
        "input": "stabilized",
        "qos_overrides./sem/image_stabilized.subscription.depth": 50,
    }
    images = peer.collect(Image, "image_rect")
    with running("rectifier", rectifier), bench_of(peer, COMPENSATOR, PATIENT) as bench:
        bench.watch.wait_heard(RECTIFIER.full_name, "image_rect")
        bench.set_magnification(1000.0)
        stream = Stream(bench)
        stream.until(lambda: len(images) >= 3, "frames")
        killed_at_s = stream.send()
        bench.kill()
        # Changed while nothing comes through: the frames after must not have the old value.
        bench.set_magnification(MAGNIFICATION)
        stream.picture = texture(7)
        bench.node.start_again()
        stream.until(lambda: len(stream.since(images, killed_at_s)) >= 4, "frames again")
        assert stream.since(bench.infos, killed_at_s)
    first, *others = stream.since(images, killed_at_s)
    right = RECTIFIER.right(stream.sent[first.header.stamp.sec], MAGNIFICATION)
    # Maps may be interpolated between nodes of a lattice, which may turn a grey level.
    assert np.abs(pixels(first) - right.astype(int)).max() <= 1
    for message in others:
        right = RECTIFIER.right(stream.sent[message.header.stamp.sec], MAGNIFICATION)
        assert difference(pixels(message), right) < 2.0 * NOISE
    expected = CALIBRATION.at(MAGNIFICATION).rectified.K
    for message in stream.since(bench.infos, killed_at_s):
        np.testing.assert_allclose(np.reshape(message.k, (3, 3)), expected, rtol=1e-12)


@pytest.mark.long
def test_a_killed_calibration_server_starts_with_nothing_and_works(peer: Peer) -> None:
    """Views live in the process only; it says so, and takes new ones at the latched magnification."""
    node = "/sem/calibration_server"
    size = 256
    plan = calibration_plan(
        preset("jsm820").with_image_size(size, size),
        magnifications=(1000.0,),
        views=2,
        detector=Detector(),
        seed=5,
    )
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    value = peer.node.create_publisher(Float64, "magnification", LATCHED)
    progress = peer.collect(DiagnosticStatus, f"{node}/progress", LATCHED)
    watch = Watch(peer)
    value.publish(magnification_message(1000.0))

    def add(index: int) -> None:
        peer.wait_for(lambda: image.get_subscription_count() >= 1, "the subscription")

        def seen() -> bool:
            image.publish(image_message(plan.render(index), stamp_s=float(index + 1)))
            peer.spin(0.3)
            return watch.latest(node).get("magnification") == "1000"

        peer.wait_for(seen, "a frame with its magnification")
        answer = peer.trigger(f"{node}/add_view")
        assert answer.success, answer.message
        assert answer.message.startswith("view 1 at 1000x")

    with restartable("calibration_server", {"config": "virtual_sem"}) as server:
        peer.wait_for(lambda: progress, "the progress")
        add(0)
        server.kill()
        watch.forget()
        progress.clear()
        server.start_again()
        peer.wait_for(lambda: progress, "the progress of the new process")
        assert progress[0].message == "no views yet"
        add(1)


# -- what is started again in vain -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--params-file", "{folder}/malformed.yaml"), "malformed.yaml"),
        (("--params-file", "{folder}/missing.yaml"), "missing.yaml"),
        (("--log-level", "loud"), "loud"),
        (("-p", "qos_overrides./sem/image_raw.subscription.depth:=-4"), "depth"),
        (("-p", "qos_overrides./sem/image_raw.subscription.reliability:=some"), "reliability"),
    ],
    ids=lambda value: value[-1].rpartition("/")[2] if isinstance(value, tuple) else "",
)
def test_what_can_never_start_ends_with_status_2(
    tmp_path: Path, arguments: tuple[str, ...], reason: str
) -> None:
    """By that status a supervisor knows that another try is of no use."""
    (tmp_path / "malformed.yaml").write_text("rectifier: [\n")
    given = tuple(argument.format(folder=tmp_path) for argument in arguments)
    process = NodeProcess("rectifier", {}, given)
    try:
        status, output = process.wait(), process.output
    finally:
        process.stop(signal.SIGKILL)
        process.close()
    assert status == 2, output
    assert "Traceback" not in output
    assert reason in output.splitlines()[-1]
