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

"""Start the suite's nodes as processes of their own, replay a recording to them, collect what they publish."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64MultiArray

from examples.live_nodes import LiveNodes
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.bridge.images import image_from_message

NODES = ("parameter_server", "drift_compensator", "stream_corrector")
IMAGES = ("image_raw", "image_stabilized", "image_rect")
TIMEOUT_S = 60.0
# Nothing new for so long after the end of the replay: what is missing was overtaken by newer frames.
SILENCE_S = 3.0


@dataclass
class Received:
    """Messages by topic; images by header stamp in ns."""

    images: dict[str, dict[int, np.ndarray]] = field(
        default_factory=lambda: {t: {} for t in IMAGES}
    )
    camera_infos: dict[int, CameraInfo] = field(default_factory=dict)
    projections: list[Float64MultiArray] = field(default_factory=list)

    def is_complete(self, frames: int) -> bool:
        """Whether all of so many frames came through on every topic."""
        counts = self.counts()
        return all(counts[topic] >= frames for topic in (*IMAGES, "camera_info"))

    def counts(self) -> dict[str, int]:
        """Number of messages per topic."""
        return {
            **{topic: len(images) for topic, images in self.images.items()},
            "camera_info": len(self.camera_infos),
            "projection": len(self.projections),
        }


class LiveSuite:
    """Context manager around the node processes and this process's own subscriber."""

    def __init__(self, logs: Path, *, config: str, calibration: Path) -> None:
        self._nodes = LiveNodes(logs)
        self._parameters = {
            "config": config,
            "calibration": str(calibration.absolute()),
        }

    def __enter__(self) -> LiveSuite:
        for name in NODES:
            parameters = dict(self._parameters)
            if name == "drift_compensator":
                del parameters["calibration"]
            if name != "parameter_server":
                # Live, the newest frame wins; here all frames are to be measured, however busy the machine is.
                parameters["drift_tracking"] = "every_frame"
                parameters["qos_overrides./sem/image_raw.subscription.depth"] = "50"
            self._nodes.start(name, parameters)
        rclpy.init()
        self._node = rclpy.create_node("demo", namespace="/sem")
        return self

    def __exit__(self, *exception: object) -> None:
        self._nodes.end()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def replay(self, bag: Path, *, frames: int, rate: float) -> Received:
        """Replay a recording; returns what arrived when every frame has come through, or nothing comes any more."""
        received = Received()
        self._subscribe(received)
        player = self._nodes.start(
            "bag_player",
            {
                "bag": str(bag.absolute()),
                "rate": str(rate),
                # drift_compensator, stream_corrector and this process
                "wait_for_subscribers": "3",
            },
        )
        self._spin_while(player, received, frames)
        return received

    def _subscribe(self, received: Received) -> None:
        reliable = QoSProfile(depth=50)

        def keep(topic: str) -> Callable[[Image], None]:
            def store(message: Image) -> None:
                received.images[topic][stamp_ns_from_msg(message)] = image_from_message(
                    message
                ).copy()

            return store

        def keep_info(message: CameraInfo) -> None:
            received.camera_infos[stamp_ns_from_msg(message)] = message

        for topic in IMAGES:
            self._node.create_subscription(Image, topic, keep(topic), reliable)
        self._node.create_subscription(CameraInfo, "camera_info", keep_info, reliable)
        self._node.create_subscription(
            Float64MultiArray, "projection", received.projections.append, reliable
        )

    def _spin_while(self, player: subprocess.Popen[bytes], received: Received, frames: int) -> None:
        seen, last_s = 0, time.monotonic()
        while not received.is_complete(frames):
            rclpy.spin_once(self._node, timeout_sec=0.1)
            self._nodes.check()
            total = sum(received.counts().values())
            if total > seen or player.poll() is None:
                seen, last_s = total, time.monotonic()
            elif time.monotonic() - last_s > SILENCE_S:
                print(
                    "  this machine was too busy: some frames were lost; they are replayed slower"
                )
                return

    def parameter(self, name: str) -> list[float]:
        """Value of a continuous parameter of the parameter server."""
        client = self._node.create_client(GetParameters, "parameter_server/get_parameters")
        if not client.wait_for_service(timeout_sec=TIMEOUT_S):
            raise RuntimeError("the parameter server does not answer")
        future = client.call_async(GetParameters.Request(names=[name]))
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=TIMEOUT_S)
        return list(future.result().values[0].double_array_value)
