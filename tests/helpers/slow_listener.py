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

"""Run as a process: a reliable subscriber of an image topic that takes nothing until it is told to.

It writes ``ready`` when the publisher has been found, then waits for a line on stdin, and then writes the stamps (s) of
what it gets in three seconds.
"""

from __future__ import annotations

import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

DEPTH = 2
TAKING_S = 3.0


def main(topic: str) -> None:
    rclpy.init()
    node = Node("slow_listener", namespace="sem")
    stamps: list[int] = []
    profile = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE)
    node.create_subscription(
        Image, topic, lambda message: stamps.append(message.header.stamp.sec), profile
    )
    while node.count_publishers(topic) == 0:
        time.sleep(0.05)
    print("ready", flush=True)
    sys.stdin.readline()
    deadline = time.monotonic() + TAKING_S
    while time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.05)
    print(*stamps, flush=True)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv[1])
