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

"""kill -9 of every node in mid-stream: the others go on, and what is started again finds its way back."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Float64, Float64MultiArray, String

from semcal_ros.calibration import Calibration
from tests.helpers.long_tests import long_but
from tests.helpers.node_scenes import magnification_message, stamp_of, texture
from tests.helpers.ros_process import LATCHED, PATIENT, Peer, running
from tests.helpers.stream_bench import (
    CALIBRATION,
    KINDS,
    MAGNIFICATION,
    NOISE,
    RECTIFIER,
    Bench,
    Kind,
    Stream,
    Watch,
    bench_of,
    difference,
    pixels,
    restartable,
    shifted_texture,
)

SERVER = "/sem/parameter_server"


def _other_calibration() -> Calibration:
    """One that is 10 % off: no image and no camera of it can be mixed up with the first."""
    scale = CALIBRATION.functions["scale"]
    larger = dataclasses.replace(scale, coefficients=scale.coefficients * 1.1)
    return dataclasses.replace(CALIBRATION, functions={**CALIBRATION.functions, "scale": larger})


OTHER = _other_calibration()


def _check_after_restart(bench: Bench, stream: Stream, killed_at_s: int, waiting: int) -> None:
    """Every frame that a restarted node gave out is right, and none is missing between them.

    But for those that came when the calibration was there and the magnification was not: ``waiting``
    frames at most, before the first calibrated one.
    """
    images = stream.since(bench.images, killed_at_s)
    infos = {stamp_of(m): m for m in stream.since(bench.infos, killed_at_s)}
    calibrated_from = 0
    if bench.kind.rectifies:
        # The new process may find the subscriber of the images before that of the cameras.
        images = [m for m in images if stamp_of(m) in infos]
        calibrated_from = next(i for i, m in enumerate(images) if any(infos[stamp_of(m)].k))
    stamps = [m.header.stamp.sec for m in images]
    before, after = stamps[:calibrated_from], stamps[calibrated_from:]
    assert after == list(range(after[0], after[-1] + 1))
    assert before == list(range(stamps[0], stamps[0] + len(before)))
    assert after[0] - stamps[0] - len(before) <= waiting
    calibrated = 0
    for message in images:
        raw = stream.sent[message.header.stamp.sec]
        if bench.kind.rectifies and not any(infos[stamp_of(message)].k):
            # It flows before the calibration has come, but says so; drift has nothing to be found in.
            assert calibrated == 0
            assert difference(pixels(message), raw) < 2.0 * NOISE
            continue
        right = bench.kind.right(raw, MAGNIFICATION)
        calibrated += 1
        if calibrated == 1 or not bench.kind.tracks:
            np.testing.assert_array_equal(pixels(message), right)
        else:
            # The drift of a specimen at rest is found to a few hundredths of a px.
            assert difference(pixels(message), right) < 2.0 * NOISE
        if bench.kind.rectifies:
            camera = CALIBRATION.at(MAGNIFICATION)
            received = np.reshape(infos[stamp_of(message)].k, (3, 3))
            np.testing.assert_allclose(received, camera.rectified.K, rtol=1e-12)
    assert calibrated >= 3


@pytest.mark.parametrize(
    "kind", long_but(lambda kind: kind.node == "rectifier", KINDS), ids=lambda kind: kind.node
)
@pytest.mark.long
def test_a_killed_stream_node_finds_its_way_back(
    peer: Peer, kind: Kind, calibration_file: Path
) -> None:
    """Calibration and magnification come from the latched topics alone; the drift begins at zero again."""
    with (
        running("parameter_server", {"calibration": calibration_file}),
        bench_of(peer, kind, PATIENT) as bench,
    ):
        bench.set_magnification(MAGNIFICATION)
        stream = Stream(bench)
        settled = (lambda: "calibration" in bench.state()) if kind.rectifies else (lambda: True)
        stream.until(lambda: settled() and len(bench.images) >= 5, "frames")
        if kind.tracks:
            # The calibration has begun the drift anew; the specimen is at rest in the first frames of it.
            before = len(bench.drifts)
            stream.until(lambda: len(bench.drifts) >= before + 5, "drifts of a specimen at rest")
            # Some drift, so that what starts again does not happen to be right.
            stream.picture = shifted_texture(4)
            pixel_m = CALIBRATION.at(MAGNIFICATION).pixel_size_m[0]

            def moved() -> bool:
                return abs(bench.drifts[-1].pose.pose.position.x) > 2.0 * pixel_m

            stream.until(lambda: bench.drifts and moved(), "the drift")
        killed_at_s = stream.send()
        bench.kill()
        stream.until(lambda: stream.send() > killed_at_s + 3, "frames that nobody takes")
        bench.node.start_again()

        def back() -> bool:
            images = stream.since(bench.images, killed_at_s)
            if kind.rectifies:
                usable = sum(any(m.k) for m in stream.since(bench.infos, killed_at_s))
                return usable >= 5 and len(images) >= 5
            return len(images) >= 5

        stream.until(back, "frames from the new process")
        last_s = bench.sent
        peer.wait_for(lambda: bench.images[-1].header.stamp.sec == last_s, "the last frame")
        count = len(stream.since(bench.images, killed_at_s))
        waiting = int(bench.watch.wait_fresh(kind.full_name).get("frames_without_magnification", 0))
        bench.wait_counts(received=count + waiting, published=count, dropped=0, rejected=0)

        def described() -> bool:
            infos = [m.header.stamp.sec for m in stream.since(bench.infos, killed_at_s)]
            # parameter_server describes the magnification on this topic, too, stamped with its clock;
            # whether that is heard depends on who was discovered first.
            infos = [stamp for stamp in infos if stamp <= last_s]
            images = [m.header.stamp.sec for m in stream.since(bench.images, killed_at_s)]
            # The new process finds the subscriber of the one topic before that of the other.
            first = max(infos[0], images[0])
            return [s for s in infos if s >= first] == [s for s in images if s >= first]

        peer.wait_for(
            lambda: not kind.rectifies or described(),
            "the camera_info of each",
        )
        _check_after_restart(bench, stream, killed_at_s, waiting)
        if kind.tracks:
            peer.wait_for(
                lambda: len(stream.since(bench.drifts, killed_at_s)) == count, "the drifts"
            )
            first = stream.since(bench.drifts, killed_at_s)[0].pose
            assert (first.pose.position.x, first.pose.position.y) == (0.0, 0.0)
            # Known to far less than a pixel: it is zero by definition there.
            assert 0.0 <= first.covariance[0] ** 0.5 < CALIBRATION.at(MAGNIFICATION).pixel_size_m[0]


@pytest.mark.long
def test_a_stream_node_that_is_killed_again_and_again_comes_back(
    peer: Peer, calibration_file: Path
) -> None:
    """What dead processes leave behind in the middleware does not add up to anything."""
    parameters = {"calibration": calibration_file, **PATIENT}
    with bench_of(peer, RECTIFIER, parameters) as bench:
        bench.set_magnification(MAGNIFICATION)
        stream = Stream(bench)
        for _ in range(3):
            stream.until(lambda: bench.images, "a frame")
            bench.kill()
            bench.images.clear()
            bench.node.start_again()
        stream.until(lambda: len(bench.images) >= 3, "frames of the last process")
        for message in bench.images:
            right = RECTIFIER.right(stream.sent[message.header.stamp.sec], MAGNIFICATION)
            np.testing.assert_array_equal(pixels(message), right)


# -- parameter_server --------------------------------------------------------------------------------


@pytest.mark.long
def test_a_killed_parameter_server_comes_back_with_camera_and_parameters(
    peer: Peer, calibration_file: Path
) -> None:
    watch = Watch(peer)
    value = peer.node.create_publisher(Float64, "magnification", LATCHED)
    texts = peer.collect(String, "calibration", LATCHED)
    infos = peer.collect(CameraInfo, "camera_info", LATCHED)
    projections = peer.collect(Float64MultiArray, "projection", LATCHED)
    received = (texts, infos, projections)
    with restartable("parameter_server", {"calibration": calibration_file}) as server:
        value.publish(magnification_message(MAGNIFICATION))
        peer.wait_for(lambda: all(received), "calibration, camera_info and projection")
        server.kill()
        for messages in received:
            messages.clear()
        watch.forget()
        server.start_again()
        peer.wait_for(lambda: all(received), "all of them again")
        assert Calibration.loads(texts[-1].data).dumps() == CALIBRATION.dumps()
        camera = CALIBRATION.at(MAGNIFICATION)
        np.testing.assert_allclose(np.reshape(infos[-1].k, (3, 3)), camera.rectified.K, rtol=1e-12)
        np.testing.assert_allclose(
            np.reshape(projections[-1].data, (3, 4)), camera.rectified.P_affine, rtol=1e-12
        )
        (answer,) = peer.get_parameters(SERVER, f"p@{MAGNIFICATION:g}")
        np.testing.assert_allclose(answer.double_array_value, camera.P.ravel(), rtol=1e-12)
        state = watch.wait_fresh(SERVER)
        assert (state["level"], state["message"], state["published"]) == ("0", "ready", "1")
        # Kept for those who come later, by the new process too.
        late = peer.collect(Float64MultiArray, "projection", LATCHED)
        peer.wait_for(lambda: late, "the latched projection")


@pytest.mark.long
def test_the_stream_goes_on_while_the_parameter_server_is_dead(
    peer: Peer, calibration_file: Path
) -> None:
    with (
        restartable("parameter_server", {"calibration": calibration_file}) as server,
        bench_of(peer, RECTIFIER, PATIENT) as bench,
    ):
        bench.set_magnification(MAGNIFICATION)
        peer.wait_for(lambda: bench.state().get("calibration") == "topic", "the calibration")
        bench.exchange(texture())
        server.kill()
        for seed in (1, 2, 3):
            message = bench.exchange(texture(seed))
            right = RECTIFIER.right(texture(seed), MAGNIFICATION)
            np.testing.assert_array_equal(pixels(message), right)
        server.start_again()
        peer.wait_for(lambda: "calibration from" in server.output, "the server")
        message = bench.exchange(texture(4))
        right = RECTIFIER.right(texture(4), MAGNIFICATION)
        np.testing.assert_array_equal(pixels(message), right)
        bench.wait_counts(received=5, published=5, dropped=0, rejected=0)


@pytest.mark.long
def test_a_newer_calibration_outlives_the_parameter_server(
    peer: Peer, calibration_file: Path
) -> None:
    """The server is started with an old file, then calibration_server publishes; a restart must not bring back the
    file, neither for good nor for a single frame.
    """
    newer = peer.node.create_publisher(String, "calibration", LATCHED)
    with (
        restartable("parameter_server", {"calibration": calibration_file}) as server,
        bench_of(peer, RECTIFIER, {"calibration": calibration_file, **PATIENT}) as bench,
    ):
        bench.set_magnification(MAGNIFICATION)
        stream = Stream(bench)
        stream.until(lambda: bench.infos, "a frame")
        newer.publish(String(data=OTHER.dumps()))
        expected = OTHER.at(MAGNIFICATION).rectified.K

        def is_newer(message: Any) -> bool:
            return bool(np.allclose(np.reshape(message.k, (3, 3)), expected, rtol=1e-12))

        def server_has_it() -> bool:
            (k,) = peer.get_parameters(SERVER, f"k@{MAGNIFICATION:g}")
            own = OTHER.at(MAGNIFICATION).K  # of the undistorted picture
            return bool(np.allclose(k.double_array_value, own.ravel(), rtol=1e-12))

        stream.until(lambda: is_newer(bench.infos[-1]), "the newer calibration")
        peer.wait_for(server_has_it, "the server to take it over")
        server.kill()
        bench.infos.clear()
        server.start_again()
        stream.until(lambda: "calibration from topic" in server.output, "the server's way back")
        peer.wait_for(server_has_it, "the newer calibration in the server")
        count = len(bench.infos)
        stream.until(lambda: len(bench.infos) >= count + 5, "more frames")
        older = [m.header.frame_id for m in bench.infos if not is_newer(m)]
        assert not older, (older, server.output, bench.node.output)


def test_a_calibration_outlives_the_node_that_made_it(peer: Peer) -> None:
    """parameter_server hands on what calibration_server has published, also when that is gone."""
    maker = Peer("maker")
    text = maker.node.create_publisher(String, "calibration", LATCHED)
    with (
        running("parameter_server") as server,
        bench_of(peer, RECTIFIER, PATIENT) as bench,
    ):
        bench.set_magnification(MAGNIFICATION)
        text.publish(String(data=OTHER.dumps()))
        peer.wait_for(lambda: "calibration from topic" in server.output, "the server")
        maker.close()
        bench.kill()
        bench.infos.clear()
        bench.node.start_again()
        stream = Stream(bench)
        stream.until(lambda: bench.infos and any(bench.infos[-1].k), "a calibrated frame")
        received = np.reshape(bench.infos[-1].k, (3, 3))
        np.testing.assert_allclose(received, OTHER.at(MAGNIFICATION).rectified.K, rtol=1e-12)


@pytest.mark.long
def test_a_broken_calibration_that_somebody_keeps_does_not_hide_the_good_one(
    peer: Peer, calibration_file: Path
) -> None:
    """A node that comes later gets the last word of both publishers, in any order and at the same moment."""
    broken = peer.node.create_publisher(String, "calibration", LATCHED)
    with (
        running("parameter_server", {"calibration": calibration_file}) as server,
        bench_of(peer, RECTIFIER, PATIENT) as bench,
    ):
        bench.set_magnification(MAGNIFICATION)
        peer.wait_for(lambda: bench.state().get("calibration") == "topic", "the calibration")
        broken.publish(String(data=CALIBRATION.dumps()[:400]))
        peer.wait_for(lambda: bench.count("rejected") == 1, "the refusal")
        for _ in range(2):
            bench.kill()
            bench.node.start_again()
            peer.wait_for(lambda: bench.state().get("calibration") == "topic", "the calibration")
        assert server.process.poll() is None
        peer.wait_for(lambda: bench.image.get_subscription_count() >= 1, "the subscription")
        stream = Stream(bench)
        stream.until(lambda: bench.infos, "a frame")
        received = np.reshape(bench.infos[-1].k, (3, 3))
        np.testing.assert_allclose(received, CALIBRATION.at(MAGNIFICATION).rectified.K, rtol=1e-12)
