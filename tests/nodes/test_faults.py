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

"""Whatever arrives, a node counts it, says why, and goes on with the next good frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Vector3Stamped
from rclpy.event_handler import PublisherEventCallbacks
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64, String

from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.core.rectification.rectifier import Rectifier
from tests.helpers.node_scenes import (
    RANGE,
    SIZE,
    image_message,
    magnification_message,
    make_calibration,
    stamp_of,
    texture,
    write_recording,
)
from tests.helpers.ros_process import (
    BEST_EFFORT,
    LATCHED,
    RELIABLE,
    REPOSITORY,
    TIMEOUT_S,
    NodeProcess,
    Peer,
    ended,
    running,
)

CALIBRATION = make_calibration()
NODE = "/sem/rectifier"
PROFILE = str(REPOSITORY / "dds" / "fastdds_large_images.xml")


@dataclass
class Bench:
    """A rectifier with everything that goes in and out."""

    peer: Peer
    node: NodeProcess
    image: Any
    magnification: Any
    images: list[Any]
    infos: list[Any]
    stamp_s: float = 0.0

    def send(self, message: Image) -> None:
        """Publish an image with a stamp of its own."""
        self.stamp_s += 1.0
        message.header.stamp.sec = int(self.stamp_s)
        self.image.publish(message)

    def state(self) -> dict[str, str]:
        return self.peer.state(NODE)

    def wait_rejected(self, count: int, reason: str) -> None:
        def said() -> bool:
            state = self.state()
            return int(state.get("rejected", 0)) >= count and reason in state["last_rejection"]

        self.peer.wait_for(said, f"rejection {count}: {reason}; {self.state()}")


@pytest.fixture
def bench(peer: Peer, calibration_file: Path) -> Iterator[Bench]:
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    images, infos = peer.collect(Image, "image_rect"), peer.collect(CameraInfo, "camera_info")
    with running("rectifier", {"calibration": calibration_file}) as node:
        peer.wait_heard(NODE, "image_rect", "camera_info")
        for publisher in (image, magnification):
            peer.wait_for(lambda p=publisher: p.get_subscription_count() == 1, "the subscription")
        yield Bench(peer, node, image, magnification, images, infos)


def _changed(change: Callable[[Image], None]) -> Image:
    message = image_message(texture())
    change(message)
    return message


def _set(**values: Any) -> Callable[[Image], None]:
    return lambda message: [setattr(message, key, value) for key, value in values.items()] and None


BAD_IMAGES = {
    "encoding": (_set(encoding="bayer_rggb8"), "bayer_rggb8"),
    "truncated": (lambda m: m.data.__delitem__(slice(100, None)), "bytes"),
    "step": (_set(step=7), "step"),
    "empty": (_set(height=0), "0"),
}


def test_bad_messages_are_counted_and_the_next_good_frame_comes_through(bench: Bench) -> None:
    peer = bench.peer
    bench.send(image_message(texture()))
    peer.wait_for(
        lambda: "waiting for magnification" in bench.state().get("message", ""),
        "the complaint about the missing magnification",
    )
    rejected = 0
    for value in (0.0, -5.0, float("nan"), float("inf")):
        rejected += 1
        bench.magnification.publish(magnification_message(value))
        bench.wait_rejected(rejected, "magnification")
    # After a value that cannot be used the old one does not hold on: frames wait.
    bench.send(image_message(texture()))
    peer.wait_for(lambda: bench.state().get("frames_without_magnification") == "2", "waiting")
    bench.magnification.publish(magnification_message(2000.0))
    for change, reason in BAD_IMAGES.values():
        rejected += 1
        bench.send(_changed(change))
        bench.wait_rejected(rejected, reason)
    assert bench.images == []

    picture = texture()
    bench.send(image_message(picture))
    peer.wait_for(lambda: bench.images and bench.infos, "the good frame")
    expected = Rectifier().rectify(picture, CALIBRATION.at(2000.0))
    received = np.frombuffer(bench.images[0].data, np.uint8).reshape(picture.shape)
    np.testing.assert_array_equal(received, expected)
    assert bench.node.process.poll() is None


def test_frames_of_another_size_get_the_scaled_model(bench: Bench) -> None:
    bench.magnification.publish(magnification_message(3000.0))
    small = texture(size=SIZE // 2)
    bench.send(image_message(small))
    bench.peer.wait_for(lambda: bench.images and bench.infos, "the small frame")
    camera = CALIBRATION.at(3000.0).resized(SIZE // 2, SIZE // 2)
    np.testing.assert_allclose(np.reshape(bench.infos[0].k, (3, 3)), camera.rectified.K, rtol=1e-12)
    assert (bench.infos[0].width, bench.infos[0].height) == (SIZE // 2, SIZE // 2)


def test_a_magnification_out_of_the_calibrated_range_is_answered_and_said(bench: Bench) -> None:
    bench.magnification.publish(magnification_message(2.0 * RANGE[1]))
    bench.send(image_message(texture()))
    bench.peer.wait_for(lambda: bench.images, "the frame")
    state = bench.peer.wait_for(
        lambda: (
            "outside the calibrated range" in bench.state().get("message", "") and bench.state()
        ),
        "the warning",
    )
    assert state["in_calibrated_range"] == "False"
    assert int(state["level"]) >= 1
    # Whoever takes the camera sees it too, as image_geometry and others look at K.
    bench.peer.wait_for(lambda: bench.infos, "its camera")
    assert not any(bench.infos[-1].k) and not any(bench.infos[-1].p)


def test_a_corrupt_calibration_on_the_topic_leaves_the_old_one_in_force(bench: Bench) -> None:
    text = bench.peer.node.create_publisher(String, "calibration", LATCHED)
    text.publish(String(data=CALIBRATION.dumps()[:400]))
    bench.wait_rejected(1, "calibration")
    newer = CALIBRATION.dumps().replace("\nversion: 3\n", "\nversion: 999\n")
    assert newer != CALIBRATION.dumps()
    text.publish(String(data=newer))
    bench.wait_rejected(2, "999")
    bench.magnification.publish(magnification_message(1000.0))
    bench.send(image_message(texture()))
    bench.peer.wait_for(lambda: bench.infos, "the frame")
    np.testing.assert_allclose(
        np.reshape(bench.infos[0].k, (3, 3)), CALIBRATION.at(1000.0).rectified.K, rtol=1e-12
    )


def test_colour_and_deep_images_keep_their_kind(bench: Bench) -> None:
    bench.magnification.publish(magnification_message(1000.0))
    grey = texture()
    kinds = {
        "mono16": grey.astype(np.uint16) * 257,
        "32FC1": grey.astype(np.float32) / 255.0,
        "bgr8": np.dstack([grey, grey // 2, grey // 3]),
        "rgb8": np.dstack([grey // 2, grey, grey // 3]),
    }
    for count, (encoding, image) in enumerate(kinds.items(), 1):
        bench.send(image_message(image, encoding=encoding))
        bench.peer.wait_for(lambda n=count: len(bench.images) == n, encoding)
        message = bench.images[-1]
        assert message.encoding == encoding
        expected = Rectifier().rectify(image, CALIBRATION.at(1000.0))
        received = np.frombuffer(message.data, image.dtype).reshape(image.shape)
        np.testing.assert_array_equal(received, expected)


def test_without_a_calibration_images_flow_with_zero_intrinsics(peer: Peer) -> None:
    images, infos = peer.collect(Image, "image_rect"), peer.collect(CameraInfo, "camera_info")
    publisher = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    with running("rectifier"):
        peer.wait_heard(NODE, "image_rect", "camera_info")
        peer.wait_for(lambda: publisher.get_subscription_count() == 1, "the subscription")
        picture = texture()
        publisher.publish(image_message(picture))
        peer.wait_for(lambda: images and infos, "the frame")
        assert stamp_of(images[0]) == stamp_of(infos[0])
        assert bytes(images[0].data) == picture.tobytes()
        assert list(infos[0].k) == [0.0] * 9
        peer.wait_for(lambda: "uncalibrated" in peer.state(NODE).get("message", ""), "the warning")


def test_a_publisher_that_only_offers_best_effort_is_heard(
    peer: Peer, calibration_file: Path
) -> None:
    images = peer.collect(Image, "image_rect")
    # rclpy's own handler of the event warns by a method that it deprecates itself.
    quiet = PublisherEventCallbacks(use_default_callbacks=False)
    publisher = peer.node.create_publisher(Image, "image_raw", BEST_EFFORT, event_callbacks=quiet)
    magnification = peer.node.create_publisher(
        Float64, "magnification", BEST_EFFORT, event_callbacks=quiet
    )
    with running("rectifier", {"calibration": calibration_file}) as node:
        peer.wait_heard(NODE, "image_rect")
        peer.wait_for(lambda: "image_raw without reliability" in peer.state(NODE)["message"], "it")
        assert "does not offer the requested reliability" in node.output
        # Best effort loses messages while the two sides still find each other.
        deadline = time.monotonic() + TIMEOUT_S
        while not images and time.monotonic() < deadline:
            magnification.publish(magnification_message(1500.0))
            publisher.publish(image_message(texture()))
            peer.spin(0.1)
        assert images


def test_a_topic_of_another_type_is_reported(peer: Peer) -> None:
    publisher = peer.node.create_publisher(String, "image_raw", RELIABLE)
    with running("rectifier") as node:
        peer.wait_for(
            lambda: "std_msgs/msg/String on image_raw" in peer.state(NODE).get("message", ""),
            "the diagnostics",
        )
        assert "expected sensor_msgs/msg/Image" in node.output
        publisher.publish(String(data="no image"))
        assert node.process.poll() is None


def test_reports_come_at_the_period_that_was_asked_for(peer: Peer) -> None:
    with running("parameter_server", {"diagnostics_period": 0.3}):
        peer.wait_for(lambda: len(peer.diagnostics) >= 6, "six reports")
    sent_s = [stamp_ns_from_msg(report) * 1e-9 for report in peer.diagnostics[:6]]
    # A busy machine delays single ones; the default is 1 s.
    assert 4.0 * 0.3 < sent_s[-1] - sent_s[0] < 5.0 * 0.9


def test_a_microscope_that_publishes_its_pixel_size_in_another_message(
    peer: Peer, calibration_file: Path
) -> None:
    """Only the configuration differs: quantity, unit, type and field come from msg_configs."""
    images, infos = peer.collect(Image, "image_rect"), peer.collect(CameraInfo, "camera_info")
    publisher = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    pixel_size = peer.node.create_publisher(Vector3Stamped, "pixel_size", LATCHED)
    parameters = {"calibration": calibration_file, "config": "pixel_size_nm"}
    with running("rectifier", parameters):
        peer.wait_heard(NODE, "image_rect", "camera_info")
        peer.wait_for(lambda: publisher.get_subscription_count() == 1, "the subscription")
        for count, size_nm in enumerate((1250.0, 400.0, 200.0), 1):
            message = Vector3Stamped()
            message.header.stamp.sec = count
            message.vector.x, message.vector.y = size_nm, float("nan")
            pixel_size.publish(message)
            # 96 px of that size on a display of 0.12 m; the frame is a little later than the value.
            publisher.publish(image_message(texture(), stamp_s=count + 0.5))
            peer.wait_for(lambda n=count: min(len(images), len(infos)) == n, f"{size_nm} nm")
            camera = CALIBRATION.at(0.12 / (SIZE * size_nm * 1e-9))
            np.testing.assert_allclose(
                np.reshape(infos[-1].k, (3, 3)), camera.rectified.K, rtol=1e-9
            )


@pytest.mark.parametrize(
    ("name", "parameters", "reason"),
    [
        ("rectifier", {"config": "no_such_microscope"}, "no_such_microscope"),
        ("rectifier", {"calibration": "/no/such/file.yaml"}, "/no/such/file.yaml"),
        ("rectifier", {"interpolation": "nearest"}, "one of linear, cubic, lanczos4"),
        ("stream_corrector", {"max_jump": 7.0}, "max_jump"),
        ("parameter_server", {"diagnostics_period": 0.0}, "diagnostics_period"),
        ("bag_player", {}, "the parameter bag"),
        ("bag_player", {"bag": "/no/such/bag"}, "/no/such/bag"),
        ("virtual_sem", {"preset": "toaster"}, "toaster"),
        ("virtual_sem", {"config": "pixel_size_nm"}, "virtual_sem"),
        ("virtual_sem", {"grid_bow_m": 0.001}, "a radius of 1 mm"),
    ],
)
def test_a_node_that_cannot_start_says_why_in_one_line(
    name: str, parameters: dict[str, Any], reason: str
) -> None:
    status, output = ended(name, parameters)
    assert status == 2, output
    lines = [line for line in output.splitlines() if line.strip()]
    assert len(lines) == 1, lines
    assert reason in lines[0]


def test_a_truncated_recording_ends_the_player_with_one_line(tmp_path: Path) -> None:
    write_recording(tmp_path / "bag", [1000.0] * 3)
    (stored,) = (tmp_path / "bag").glob("*.mcap")
    stored.write_bytes(stored.read_bytes()[:600])
    status, output = ended("bag_player", {"bag": tmp_path / "bag"})
    assert status == 2, output
    assert "Traceback" not in output
    assert str(tmp_path) in output


@pytest.mark.parametrize(
    ("variables", "advised"),
    [
        ({}, True),
        (
            {
                "FASTRTPS_DEFAULT_PROFILES_FILE": PROFILE,
                "FASTDDS_DEFAULT_PROFILES_FILE": PROFILE,
                "MALLOC_MMAP_THRESHOLD_": "268435456",
                "MALLOC_TRIM_THRESHOLD_": "536870912",
            },
            False,
        ),
    ],
    ids=["default", "profile"],
)
def test_images_too_large_for_the_transport_are_told(
    peer: Peer, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], advised: bool
) -> None:
    """Only where it matters: a small image says nothing in either environment."""
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    publisher = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    # The allocator reads its variables when a process starts.
    with running("rectifier", cold=True):
        peer.wait_for(lambda: publisher.get_subscription_count() == 1, "the subscription")
        for count, size in enumerate((SIZE, 1100), 1):
            publisher.publish(image_message(np.zeros((size, size), np.uint8)))
            peer.wait_for(lambda n=count: peer.state(NODE).get("published") == str(n), "the frame")
            said = peer.state(NODE)["message"]
            assert ("shared memory" in said and "MALLOC" in said) == (advised and size > SIZE), said
