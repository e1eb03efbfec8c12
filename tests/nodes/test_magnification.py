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

"""Frames that were being scanned while the magnification changed are recognised."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Vector3Stamped
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64

from tests.helpers.node_scenes import (
    image_message,
    magnification_message,
    make_calibration,
    stamp_of,
    texture,
)
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

CALIBRATION = make_calibration()
CONFIG = """
name: slow scan
display_width_m: 0.12
magnification: {quantity: magnification, type: %s, field: %s}
scan: {frame_time_s: 2.0}
"""
PLAIN = CONFIG % ("std_msgs/msg/Float64", "data")
STAMPED = CONFIG % ("geometry_msgs/msg/Vector3Stamped", "vector.x")
NODES = ("stream_corrector", "rectifier")


@pytest.fixture
def files(tmp_path: Path) -> Path:
    CALIBRATION.save(tmp_path / "cal.yaml")
    (tmp_path / "plain.yaml").write_text(PLAIN)
    (tmp_path / "stamped.yaml").write_text(STAMPED)
    return tmp_path


def now_s(peer: Peer) -> float:
    return peer.node.get_clock().now().nanoseconds * 1e-9


def k_of(info: CameraInfo) -> np.ndarray:
    return np.reshape(info.k, (3, 3))


@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("policy", ["drop", "flag"])
def test_a_magnification_that_changes_during_a_scan(
    peer: Peer, files: Path, node: str, policy: str
) -> None:
    """Without stamps of its own: by when the magnification and the frame were published."""
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    images, infos = peer.collect(Image, "image_rect"), peer.collect(CameraInfo, "camera_info")
    parameters = {"config": files / "plain.yaml", "calibration": files / "cal.yaml"}
    picture = texture()
    with running(node, {**parameters, "mixed_frames": policy}):
        peer.wait_heard(f"/sem/{node}", "image_rect", "camera_info")
        for publisher in (image, magnification):
            peer.wait_for(lambda p=publisher: p.get_subscription_count() == 1, "the subscription")

        def send(start_s: float) -> tuple[int, int]:
            message = image_message(picture, start_s)
            image.publish(message)
            return stamp_of(message)

        magnification.publish(magnification_message(2000.0))
        peer.spin(0.2)
        start_s = now_s(peer)
        peer.spin(0.2)
        before = send(start_s)
        peer.wait_for(lambda: len(infos) == 1 and images, "the frame before")
        magnification.publish(magnification_message(4000.0))
        peer.spin(0.2)
        spoilt = send(start_s)
        if policy == "flag":
            peer.wait_for(lambda: len(infos) == 2 and len(images) == 2, "the flagged frame")
        start_s = now_s(peer)
        peer.spin(0.2)
        after = send(start_s)
        peer.wait_for(
            lambda: images and stamp_of(images[-1]) == stamp_of(infos[-1]) == after,
            "the frame after",
        )
        peer.wait_for(
            lambda: peer.state(f"/sem/{node}").get("frames_mixed") == "1",
            f"the count: {peer.state(f'/sem/{node}')}",
        )
    by_stamp: dict[Any, list[np.ndarray]] = {}
    for info in infos:
        by_stamp.setdefault(stamp_of(info), []).append(k_of(info))
    assert before == spoilt
    expected = [CALIBRATION.at(2000.0).rectified.K] + [np.zeros((3, 3))] * (policy == "flag")
    np.testing.assert_allclose(by_stamp[before], expected, rtol=1e-12)
    # The first frame after the change is the new magnification's.
    np.testing.assert_allclose(by_stamp[after], [CALIBRATION.at(4000.0).rectified.K], rtol=1e-12)
    assert len(images) == len(infos)


def test_stamps_decide_where_there_are_any(peer: Peer, files: Path) -> None:
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Vector3Stamped, "magnification", LATCHED)
    infos = peer.collect(CameraInfo, "camera_info")
    parameters = {"config": files / "stamped.yaml", "calibration": files / "cal.yaml"}
    with running("rectifier", parameters):
        peer.wait_heard("/sem/rectifier", "camera_info")
        for publisher in (image, magnification):
            peer.wait_for(lambda p=publisher: p.get_subscription_count() == 1, "the subscription")
        for stamp_s, g in ((0, 1000.0), (11, 2000.0), (13, 2000.0), (20, 4000.0)):
            message = Vector3Stamped()
            message.header.stamp.sec, message.vector.x = stamp_s, g
            magnification.publish(message)
        # A frame takes 2 s: the one at 10 s is spoilt, 12 s saw the same value again, and 18 s was
        # complete when the last one began.
        for count, (stamp_s, g) in enumerate(
            [(8, 1000.0), (10, None), (12, 2000.0), (18, 2000.0), (19, None), (20, 4000.0)]
        ):
            image.publish(image_message(texture(), stamp_s))
            if g is None:
                peer.wait_for(
                    lambda n=count: int(peer.state("/sem/rectifier")["received"]) == n + 1,
                    "the spoilt frame",
                )
                continue
            peer.wait_for(lambda s=stamp_s: infos and stamp_of(infos[-1]) == (s, 0), "a frame")
            np.testing.assert_allclose(k_of(infos[-1]), CALIBRATION.at(g).rectified.K, rtol=1e-12)
        assert [stamp_of(info)[0] for info in infos] == [8, 12, 18, 20]
        peer.wait_for(lambda: peer.state("/sem/rectifier")["frames_mixed"] == "2", "the count")


def test_an_unusable_value_of_a_publisher_that_leaves_is_forgotten(peer: Peer, files: Path) -> None:
    """The value of the one that stays is asked for again: it keeps it for late subscribers."""
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    magnification.publish(magnification_message(2000.0))
    infos = peer.collect(CameraInfo, "camera_info")
    with running("rectifier", {"calibration": files / "cal.yaml"}) as node:
        peer.wait_heard("/sem/rectifier", "camera_info")
        peer.wait_for(lambda: image.get_subscription_count() == 1, "the subscription")
        intruder = Peer("intruder")
        try:
            wrong = intruder.node.create_publisher(Float64, "magnification", RELIABLE)
            intruder.wait_for(lambda: wrong.get_subscription_count() == 1, "the subscription")

            def is_left_out() -> bool:
                # Again and again: the node asks for the other value within a second, and then has it again.
                wrong.publish(magnification_message(float("nan")))
                peer.spin(0.05)
                image.publish(image_message(texture(), 1.0))
                peer.spin(0.1)
                return int(peer.state("/sem/rectifier").get("frames_without_magnification", 0)) > 0

            peer.wait_for(is_left_out, "a frame that is left out")
            assert int(peer.state("/sem/rectifier")["rejected"]) > 0
        finally:
            intruder.close()

        def arrives() -> bool:
            image.publish(image_message(texture(), 2.0))
            peer.spin(0.1)
            return bool(infos) and stamp_of(infos[-1]) == (2, 0)

        peer.wait_for(arrives, "a frame at the value of the one that stays")
        log = node.output
    np.testing.assert_allclose(k_of(infos[-1]), CALIBRATION.at(2000.0).rectified.K, rtol=1e-12)
    assert "the magnification is unknown until the next usable message" in log
