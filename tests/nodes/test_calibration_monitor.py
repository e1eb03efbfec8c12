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

"""parameter_server looks at frames of the grid, and says whether its calibration still holds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from tests.helpers.calibration_session import PLAN, SIZE
from tests.helpers.node_scenes import image_message, magnification_message
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

SERVER = "/sem/parameter_server"
FRAME = PLAN.frames[0]


def calibration(scale_error: float) -> Calibration:
    """That of the simulated microscope at the magnification of the frame, with a wrong scale."""
    camera, g = PLAN.microscope.camera_at(FRAME.magnification), FRAME.magnification
    nominal = g * SIZE / PLAN.microscope.display_width_m
    values = {name: getattr(camera, name) for name in ("aspect", "skew", "px", "py", "rho")}
    values |= {name: getattr(camera, name) for name in ("xi_r", "xi_t", "ex", "ey")}
    values = {"scale": (1.0 + scale_error) * camera.m / nominal, **values}
    # As well as a calibration of many views knows them.
    sigmas = np.array([5e-4, 2e-4, 2e-4, 5.0, 5.0, 0.2, 1e-4, 1e-4, 3.0, 3.0])
    span = (0.5 * g, 2.0 * g)
    return Calibration(
        functions={
            name: ContinuousFunction("chebyshev_log", np.array([value]), span)
            for name, value in values.items()
        },
        covariance=np.diag(sigmas**2),
        image_width=SIZE,
        image_height=SIZE,
        display_width_m=PLAN.microscope.display_width_m,
        magnifications=span,
        method="joint",
    )


@pytest.fixture
def peer() -> Iterator[Peer]:
    made = Peer("microscope")
    yield made
    made.close()


@pytest.mark.long
def test_a_calibration_that_holds_and_one_that_does_not(peer: Peer, tmp_path: Path) -> None:
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
    magnification.publish(magnification_message(FRAME.magnification))
    picture, flat = PLAN.render(0), np.full((SIZE, SIZE), 100, np.uint8)
    stamp_s = 0.0

    def says(text: str, key: str, shown: np.ndarray) -> None:
        def said() -> bool:
            nonlocal stamp_s
            stamp_s += 1.0
            image.publish(image_message(shown, stamp_s))
            peer.spin(0.05)
            return text in peer.state(SERVER).get(key, "")

        peer.wait_for(said, f"{key} with {text}")

    for scale_error, verdict in ((0.0, "valid"), (0.03, "degraded")):
        calibration(scale_error).save(tmp_path / "cal.yaml")
        given = {
            "calibration": tmp_path / "cal.yaml",
            "monitor_period": 0.2,
            "config": "virtual_sem",
        }
        with running("parameter_server", given) as server:
            says("no grid", "monitor", flat)
            says(verdict, "monitor", picture)
            if verdict == "degraded":
                says("calibration degraded (scale", "message", picture)
                # Another specimen does not make it valid.
                says("no grid", "monitor", flat)
                assert "calibration degraded (scale" in peer.state(SERVER)["message"]
                assert server.output.count("the calibration may not hold any more") == 1
            else:
                assert "degraded" not in peer.state(SERVER)["message"]
