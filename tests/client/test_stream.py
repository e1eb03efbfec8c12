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

"""A node of one's own: parts are paired by their stamps, late or missing ones never with another frame's."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from semcal_ros.bridge.drift import fill_drift
from semcal_ros.bridge.projection import fill_stamped_projection, fill_stamped_projection_covariance
from semcal_ros.client import CalibratedFrame, CalibratedStream
from semcal_ros.client.stream import _explain
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from tests.helpers.node_scenes import (
    image_message,
    magnification_message,
    make_calibration,
    texture,
)
from tests.helpers.ros_process import Peer

CAMERA = make_calibration().at(2000.0)


class Bench:
    """A publisher of all outputs of the suite, and a stream that listens to them."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        node = peer.node
        self.images = node.create_publisher(Image, "image_rect", 10)
        self.raw = node.create_publisher(Image, "image_raw", 10)
        self.projections = node.create_publisher(Image, "projection_stamped", 10)
        self.covariances = node.create_publisher(Image, "projection_covariance_stamped", 10)
        self.drifts = node.create_publisher(PoseWithCovarianceStamped, "drift", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.magnifications = node.create_publisher(Float64, "magnification", latched)
        # Before anyone listens: a late joiner gets it.
        self.magnifications.publish(magnification_message(2000.0))
        self.frames: list[CalibratedFrame] = []
        self.stream = CalibratedStream(node, self.frames.append)
        publishers = (self.images, self.projections, self.covariances, self.drifts)
        peer.wait_for(lambda: all(p.get_subscription_count() for p in publishers), "subscriptions")
        peer.spin(0.3)

    def send(
        self,
        stamp_s: float,
        *,
        camera: ScanCamera | None = CAMERA,
        without: str = "",
        only: str = "",
        drift_m: float | None = None,
    ) -> None:
        image = image_message(texture(int(stamp_s * 10) % 7), stamp_s)
        drift = PoseWithCovarianceStamped()
        moved_m = 1e-9 * stamp_s if drift_m is None else drift_m
        fill_drift(drift, (moved_m, 2e-9), np.eye(2) * 1e-18, image.header)
        parts: dict[str, tuple[Any, Any]] = {"drift": (self.drifts, drift)}
        for name, publisher, fill in (
            ("projection", self.projections, fill_stamped_projection),
            ("covariance", self.covariances, fill_stamped_projection_covariance),
        ):
            message = Image()
            fill(message, camera, image.header, image.width, image.height)
            parts[name] = publisher, message
        parts["image"] = self.images, image
        for name, (publisher, message) in parts.items():
            if name != without and only in ("", name):
                publisher.publish(message)

    def wait(self, count: int) -> None:
        self.peer.wait_for(lambda: len(self.frames) >= count, f"{count} frames")

    @property
    def stamps_s(self) -> list[float]:
        return [frame.stamp_ns * 1e-9 for frame in self.frames]


@pytest.fixture
def bench() -> Iterator[Bench]:
    peer = Peer()
    yield Bench(peer)
    peer.close()


def test_a_frame_has_all_of_its_stamp(bench: Bench) -> None:
    for stamp_s in (1.0, 1.5):
        bench.send(stamp_s)
    bench.wait(2)
    for frame in bench.frames:
        stamp_s = frame.stamp_ns * 1e-9
        assert frame.valid
        assert frame.magnification == 2000.0
        assert np.array_equal(frame.image, texture(int(stamp_s * 10) % 7))
        assert frame.drift_m == pytest.approx((1e-9 * stamp_s, 2e-9))
        assert np.sqrt(np.diag(frame.drift_covariance)) == pytest.approx((1e-9, 1e-9))
        size = CAMERA.resized(*frame.image.shape[::-1]).rectified.pixel_size_m[0]
        assert frame.pixel_size_m == pytest.approx(size)
        assert frame.pixel_size_sigma_m > 0.0
    assert bench.stream.missed == 0


@pytest.mark.parametrize("part", ["image", "projection", "covariance", "drift"])
def test_a_frame_without_one_of_its_parts_is_passed_over(bench: Bench, part: str) -> None:
    bench.send(1.0)
    bench.send(2.0, without=part)
    bench.send(3.0)
    bench.wait(2)
    assert bench.stamps_s == [1.0, 3.0]
    # Of a frame whose picture was lost, nobody can tell more than that.
    assert bench.stream.missed == (part != "image")


def test_a_frame_without_a_camera_says_so(bench: Bench) -> None:
    bench.send(1.0, camera=None)
    bench.wait(1)
    assert "no calibration, or outside its range" in bench.frames[0].reason


def test_a_damaged_part_is_no_end(bench: Bench) -> None:
    bench.projections.publish(image_message(texture(1), 1.0))
    bench.send(2.0)
    bench.wait(1)
    assert bench.stamps_s == [2.0]


@pytest.mark.parametrize("last", ["image", "drift"])
def test_what_a_callback_raises_ends_the_executor_whichever_part_comes_last(
    bench: Bench, last: str
) -> None:
    def fails(_frame: CalibratedFrame) -> None:
        raise InvalidValueError("a length", expected="none")

    bench.stream._on_frame = fails
    bench.send(1.0, without=last)
    bench.peer.spin(0.3)
    bench.send(1.0, only=last)
    with pytest.raises(RuntimeError, match="on_frame raised: a length"):
        bench.peer.spin(2.0)


def test_parts_of_the_loop_before_do_not_meet_the_pictures_of_this_one(bench: Bench) -> None:
    stamps_s = (1.0, 2.0, 3.0)
    for loop in range(3):
        for stamp_s in stamps_s:
            # A picture was lost in the first loop.
            lost = "image" if (loop, stamp_s) == (0, 2.0) else ""
            bench.send(stamp_s, without=lost, drift_m=1e-9 * loop)
        bench.wait(3 * loop + 2)
    drifts = [round(frame.drift_m[0] * 1e9) for frame in bench.frames]
    assert drifts == [0, 0, 1, 1, 1, 2, 2, 2]


def test_a_frame_whose_magnification_is_not_known_yet_is_not_valid() -> None:
    frame: Any = SimpleNamespace(mixed=False, magnification=None)
    assert "its magnification is not known" in _explain(frame, np.eye(3, 4))
    frame.magnification = 2000.0
    assert _explain(frame, np.eye(3, 4)) == ""
