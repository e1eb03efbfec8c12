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

"""Every rectified image comes with its projection, which has its header."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64, Float64MultiArray

from semcal_ros.bridge.projection import (
    projection_covariance_from_message,
    stamped_projection_covariance_from_message,
    stamped_projection_from_message,
)
from tests.helpers.node_scenes import (
    SIZE,
    image_message,
    magnification_message,
    make_calibration,
    texture,
)
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

CALIBRATION = make_calibration()


@pytest.mark.parametrize("node", ["stream_corrector", "rectifier"])
def test_each_image_has_the_projection_of_its_own_magnification(
    peer: Peer, tmp_path: Path, node: str
) -> None:
    CALIBRATION.save(tmp_path / "cal.yaml")
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    images, infos = peer.collect(Image, "image_rect"), peer.collect(CameraInfo, "camera_info")
    matrices = peer.collect(Image, "projection_stamped")
    steps = ((1000.0, SIZE), (1000.0, SIZE), (5250.0, SIZE), (5250.0, 2 * SIZE), (700.0, SIZE))
    with running(node, {"calibration": tmp_path / "cal.yaml"}):
        peer.wait_heard(f"/sem/{node}", "image_rect", "camera_info", "projection_stamped")
        for publisher in (image, magnification):
            peer.wait_for(lambda p=publisher: p.get_subscription_count() == 1, "the subscription")
        for count, (g, size) in enumerate(steps, 1):
            magnification.publish(magnification_message(g))
            peer.spin(0.1)
            message = image_message(texture(size=size), stamp_s=count + 0.25)
            message.header.frame_id = f"frame {count}"
            image.publish(message)
            peer.wait_for(
                lambda n=count: min(len(images), len(infos), len(matrices)) == n, f"frame {count}"
            )
    for shown, info, matrix, (g, size) in zip(images, infos, matrices, steps, strict=True):
        assert matrix.header == shown.header == info.header
        camera = CALIBRATION.at(g).resized(size, size).rectified
        p_g = stamped_projection_from_message(matrix)
        np.testing.assert_allclose(p_g, camera.P_affine, rtol=1e-12)
        # No search by K: it is the same camera.
        k = np.reshape(info.k, (3, 3))
        np.testing.assert_allclose(p_g[:, :3], camera.rho * k, rtol=1e-12)
        assert k[0, 0] == k[1, 1]
        assert k[0, 1] == 0.0


def test_without_a_calibration_the_projection_is_zero(peer: Peer) -> None:
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    images, matrices = peer.collect(Image, "image_rect"), peer.collect(Image, "projection_stamped")
    with running("rectifier", {}):
        peer.wait_heard("/sem/rectifier", "image_rect", "projection_stamped")
        peer.wait_for(lambda: image.get_subscription_count() == 1, "the subscription")
        image.publish(image_message(texture(), stamp_s=3.0))
        peer.wait_for(lambda: images and matrices, "the frame")
    assert matrices[0].header == images[0].header
    assert not stamped_projection_from_message(matrices[0]).any()


def test_its_covariance_goes_beside_it(peer: Peer, tmp_path: Path) -> None:
    CALIBRATION.save(tmp_path / "cal.yaml")
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    magnification.publish(magnification_message(2000.0))
    images = peer.collect(Image, "image_rect")
    matrices = peer.collect(Image, "projection_covariance_stamped")
    latched = peer.collect(Float64MultiArray, "projection_covariance", LATCHED)
    given = {"calibration": tmp_path / "cal.yaml"}
    with running("rectifier", given), running("parameter_server", given):
        peer.wait_heard("/sem/rectifier", "image_rect", "projection_covariance_stamped")
        peer.wait_for(lambda: image.get_subscription_count() == 1, "the subscription")

        def came() -> bool:
            image.publish(image_message(texture(size=2 * SIZE), stamp_s=7.0))
            peer.spin(0.1)
            return bool(images and matrices)

        peer.wait_for(came, "a frame")
        peer.wait_for(lambda: latched, "the one of the magnification")
        (value,) = peer.get_parameters("/sem/parameter_server", "p_affine_covariance@2000")
    assert matrices[0].header == images[0].header
    camera = CALIBRATION.at(2000.0)
    np.testing.assert_allclose(
        stamped_projection_covariance_from_message(matrices[0]),
        camera.resized(2 * SIZE, 2 * SIZE).rectified.P_affine_covariance,
        rtol=1e-9,
    )
    np.testing.assert_allclose(
        projection_covariance_from_message(latched[-1]),
        camera.rectified.P_affine_covariance,
        rtol=1e-9,
    )
    np.testing.assert_allclose(
        np.reshape(value.double_array_value, (12, 12)), camera.P_affine_covariance, rtol=1e-9
    )
