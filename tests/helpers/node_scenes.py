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

"""A calibration, frames and recordings for the node tests, all with known truth."""

from __future__ import annotations

import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter

SIZE = 96
RANGE = (500.0, 8000.0)
# Two coefficients make a parameter that changes with the magnification.
_COEFFICIENTS = {
    "scale": (1.01, -0.004),
    "aspect": (1.004, 0.003),
    "skew": (0.001,),
    "px": (46.0,),
    "py": (49.0,),
    "rho": (50.0,),
    "xi_r": (0.03, -0.01),
    "xi_t": (0.002,),
    "ex": (45.0, 1.0),
    "ey": (50.0,),
}


def make_calibration() -> Calibration:
    """A calibration for 96 x 96 images, strongly distorted so that rectification shows."""
    functions = {
        name: ContinuousFunction("chebyshev_log", np.array(values), RANGE)
        for name, values in _COEFFICIENTS.items()
    }
    size = sum(len(values) for values in _COEFFICIENTS.values())
    return Calibration(
        functions=functions,
        covariance=np.eye(size) * 1e-8,
        image_width=SIZE,
        image_height=SIZE,
        display_width_m=0.12,
        magnifications=(500.0, 2000.0, 8000.0),
        method="joint",
    )


def texture(seed: int = 0, size: int = SIZE) -> NDArray[np.uint8]:
    """A smooth random image, whose shifts can be measured."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.fft2(rng.normal(size=(size, size)))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    picture = np.fft.ifft2(spectrum * np.exp(-((frequency / 0.08) ** 2))).real
    return np.clip(128.0 + 45.0 * picture / picture.std(), 0, 255).astype(np.uint8)


def image_message(image: NDArray[Any], stamp_s: float = 1.0, encoding: str = "mono8") -> Image:
    """An rclpy image message."""
    message = Image(
        height=image.shape[0],
        width=image.shape[1],
        step=image.shape[1] * image.itemsize * (1 if image.ndim == 2 else image.shape[2]),
        encoding=encoding,
    )
    message.header.frame_id = "camera"
    message.header.stamp.sec = int(stamp_s)
    message.header.stamp.nanosec = round((stamp_s - int(stamp_s)) * 1e9)
    message.data = array.array("B", image.tobytes())
    return message


def magnification_message(magnification: float) -> Float64:
    """An rclpy magnification message."""
    return Float64(data=magnification)


def stamp_of(message: Any) -> tuple[int, int]:
    """(s, ns) of a message with a header."""
    return message.header.stamp.sec, message.header.stamp.nanosec


def write_recording(
    path: Path,
    magnifications: Sequence[float],
    period_s: float = 0.2,
    size: int = SIZE,
    lead_s: float = 0.001,
) -> list[NDArray[np.uint8]]:
    """A bag with one frame per magnification, published ``lead_s`` before; returns the images."""
    images = [texture(seed, size) for seed in range(len(magnifications))]
    with BagWriter(path) as writer:
        for index, (g, image) in enumerate(zip(magnifications, images, strict=True)):
            stamp_ns = 1_700_000_000_000_000_000 + round(index * period_s * 1e9)
            value = blank_message("std_msgs/msg/Float64")
            value.data = float(g)
            writer.write("/sem/magnification", stamp_ns - round(lead_s * 1e9), value)
            frame = blank_message("sensor_msgs/msg/Image")
            frame.header.stamp.sec, frame.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            frame.header.frame_id = "camera"
            frame.height, frame.width, frame.step = size, size, size
            frame.encoding, frame.data = "mono8", image.reshape(-1)
            writer.write("/sem/image_raw", stamp_ns, frame)
    return images
