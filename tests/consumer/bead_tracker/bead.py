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

import cv2
import rclpy
from semcal_ros.client import CalibratedFrame, CalibratedStream


def on_frame(frame: CalibratedFrame) -> None:
    if not frame.valid:
        return print("no lengths:", frame.reason, flush=True)
    _, _, _, place = cv2.minMaxLoc(cv2.GaussianBlur(frame.image, (0, 0), 2.0))
    height, width = frame.image.shape
    away = frame.displacement(((width - 1) / 2, (height - 1) / 2), place, sigma_px=0.5)
    (x, y), (sx, sy) = 1e9 * away.values[0], 1e9 * away.sigma[0]
    print(f"{frame.magnification:g}x {x:.1f} +- {sx:.1f}, {y:.1f} +- {sy:.1f} nm", flush=True)


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("bead", namespace="sem")
    stream = CalibratedStream(node, on_frame, config="virtual_sem")
    rclpy.spin(node)
