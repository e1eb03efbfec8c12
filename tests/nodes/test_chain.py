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

"""drift_compensator, then rectifier: each frame keeps the magnification at which it was taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import SetBool

from tests.helpers.node_scenes import make_calibration, stamp_of, write_recording
from tests.helpers.ros_process import PATIENT, Peer, running

CALIBRATION = make_calibration()
# The magnification changes while the frame before is still on its way through the compensator.
MAGNIFICATIONS = [float(g) for g in np.geomspace(700.0, 5000.0, 8).round(1)]


def test_a_stabilized_frame_is_rectified_at_its_own_magnification(tmp_path: Path) -> None:
    # A quarter of a second of margin per frame, of which the next magnification comes 1 ms after the frame.
    write_recording(tmp_path / "bag", MAGNIFICATIONS, period_s=0.25, lead_s=0.249)
    CALIBRATION.save(tmp_path / "cal.yaml")
    peer = Peer()
    infos = peer.collect(CameraInfo, "camera_info")
    images = peer.collect(Image, "image_rect")
    settings = {
        "calibration": tmp_path / "cal.yaml",
        "input": "stabilized",
        "qos_overrides./sem/image_stabilized.subscription.depth": 50,
    }
    playing = {"bag": tmp_path / "bag", "start_paused": True, "wait_for_subscribers": 2}
    with (
        running("drift_compensator", PATIENT),
        running("rectifier", settings) as rectifier,
        running("bag_player", playing),
    ):
        peer.wait_heard("/sem/rectifier", "camera_info", "image_rect")
        peer.wait_heard("/sem/drift_compensator", "image_stabilized")
        peer.call(SetBool, "bag_player/pause", SetBool.Request(data=False))
        peer.wait_for(lambda: min(len(infos), len(images)) >= len(MAGNIFICATIONS), "all frames")
        assert rectifier.process.poll() is None
    peer.close()
    assert [stamp_of(m) for m in infos] == [stamp_of(m) for m in images]
    for info, g in zip(infos, MAGNIFICATIONS, strict=True):
        np.testing.assert_allclose(
            np.reshape(info.k, (3, 3)), CALIBRATION.at(g).rectified.K, rtol=1e-12
        )
