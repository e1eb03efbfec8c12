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
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Float64

from semcal_ros.core.camera.plumb_bob import fit_plumb_bob
from tests.helpers.node_scenes import (
    SIZE,
    image_message,
    magnification_message,
    make_calibration,
    texture,
)
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

NODE = "/sem/rectifier"
CAMERA = make_calibration().at(2000.0)


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
