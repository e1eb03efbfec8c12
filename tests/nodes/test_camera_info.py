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

"""Which camera goes out where, and that it follows its image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Float64

from semcal_ros.core.camera.pinhole_model import fit_plumb_bob
from tests.helpers.node_scenes import (
    SIZE,
    image_message,
    magnification_message,
    make_calibration,
    texture,
)
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

NODE = "/sem/rectifier"
CAMERA, CAMERA_AFTER = (make_calibration().at(g) for g in (2000.0, 5250.0))
# Asks for all that a latched topic keeps.
KEPT = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_what_belongs_to_an_image_follows_its_remap(peer: Peer, calibration_file: Path) -> None:
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    # Whoever asks for the last one of a latched topic gets it from every publisher.
    topics = {
        "camera_info": "/out/camera_info",
        "image_rect/camera_info": "/out/rect/camera_info",
        "image_raw/camera_info": "image_raw/camera_info",
    }
    infos = {key: peer.collect(CameraInfo, name, LATCHED) for key, name in topics.items()}
    compressed = peer.collect(CompressedImage, "/out/rect/compressed")
    matrices = peer.collect(Image, "/out/projection_stamped")
    remap = ("-r", "image_rect:=/out/rect")
    with running("rectifier", {"calibration": calibration_file}, *remap):
        peer.wait_heard(NODE, *topics, "image_rect/compressed", "projection_stamped")
        peer.wait_for(lambda: image.get_subscription_count() == 1, "the subscription")
        magnification.publish(magnification_message(2000.0))
        image.publish(image_message(texture()))
        peer.wait_for(
            lambda: compressed and matrices and all(infos.values()), "the image and its cameras"
        )
    assert matrices[0].header == infos["camera_info"][0].header
    rect = CAMERA.rectified.K.ravel()
    for key in ("camera_info", "image_rect/camera_info"):
        np.testing.assert_allclose(infos[key][0].k, rect, rtol=1e-12)
    raw, fitted = infos["image_raw/camera_info"][0], fit_plumb_bob(CAMERA, SIZE, SIZE)
    assert fitted is not None
    for got, wanted in zip(
        (raw.k, raw.d, raw.r, raw.p), (fitted.K, fitted.D, fitted.R, fitted.P), strict=True
    ):
        np.testing.assert_allclose(got, np.ravel(wanted), rtol=1e-9)
    assert (raw.header.stamp, raw.height) == (infos["camera_info"][0].header.stamp, SIZE)


def test_a_late_subscriber_gets_the_camera_of_the_newest_frames(
    peer: Peer, calibration_file: Path
) -> None:
    """Also where nobody listened since the magnification changed."""
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    topics = ("camera_info", "image_rect/camera_info", "image_raw/camera_info")
    with running("rectifier", {"calibration": calibration_file}):
        peer.wait_for(lambda: image.get_subscription_count() == 1, "the subscription")

        def send(g: float, count: int) -> None:
            magnification.publish(magnification_message(g))
            before = int(peer.state(NODE).get("published", "0"))
            for k in range(count):
                image.publish(image_message(texture(), stamp_s=g + k))
                peer.wait_for(
                    lambda n=before + k + 1: int(peer.state(NODE).get("published", "0")) >= n,
                    "the frame",
                )

        listener = Peer("listener")
        heard = [listener.collect(CameraInfo, name, KEPT) for name in topics]
        try:
            peer.wait_heard(NODE, *topics)
            send(2000.0, 1)
            listener.wait_for(lambda: all(heard), "the cameras at 2000x")
        finally:
            listener.close()
        peer.wait_for(
            lambda: all(peer.state(NODE).get(f"subscribers.{name}") == "0" for name in topics),
            "the listener to be gone",
        )
        # The topics keep eight messages.
        send(5250.0, 8)
        late = [peer.collect(CameraInfo, name, KEPT) for name in topics]
        peer.wait_for(lambda: all(late), "what the topics keep")
        peer.spin(0.2)
    for name, infos in zip(topics, late, strict=True):
        assert {info.header.stamp.sec for info in infos} <= set(range(5250, 5258)), name
        np.testing.assert_allclose(infos[0].p[0], CAMERA_AFTER.rectified.K[0, 0], rtol=1e-12)


@pytest.mark.long
def test_the_parameter_server_keeps_no_camera_beside_a_node_that_publishes_one_a_frame(
    peer: Peer, calibration_file: Path
) -> None:
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    magnification.publish(magnification_message(2000.0))
    with running("parameter_server", {"calibration": calibration_file}):
        infos = peer.collect(CameraInfo, "camera_info", KEPT)
        peer.wait_for(lambda: infos, "the camera at 2000x")
        rectifier = peer.node.create_publisher(CameraInfo, "camera_info", KEPT)
        peer.wait_for(lambda: peer.node.count_publishers("camera_info") == 1, "it to withdraw")
        magnification.publish(magnification_message(5250.0))
        late = peer.collect(CameraInfo, "camera_info", KEPT)
        peer.spin(1.0)
        assert late == []
        peer.node.destroy_publisher(rectifier)
        peer.wait_for(lambda: late, "the camera once the other is gone")
    np.testing.assert_allclose(late[0].k, CAMERA_AFTER.rectified.K.ravel(), rtol=1e-12)
