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

"""Both families of message classes, and a camera."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.files.bags.messages import blank_message


def _rclpy_message(type_name: str) -> Any:
    package, _, short = type_name.split("/")
    module = pytest.importorskip(f"{package}.msg", reason=f"{package} is not installed")
    return getattr(module, short)()


# Session scope, because Hypothesis runs many examples with one fixture; it only makes messages.
@pytest.fixture(params=["rclpy", "rosbags"], scope="session")
def new(request: pytest.FixtureRequest) -> Callable[[str], Any]:
    """Factory of blank messages by full type name."""
    return _rclpy_message if request.param == "rclpy" else blank_message


@pytest.fixture(scope="session")
def camera() -> ScanCamera:
    """A camera with every effect, and a covariance that moves px by 3 px and py by 4 px only."""
    covariance = np.zeros((10, 10))
    covariance[3, 3], covariance[4, 4] = 9.0, 16.0
    return ScanCamera(
        magnification=5000.0,
        m=2.1e7,
        aspect=1.01,
        skew=0.002,
        px=249.0,
        py=262.0,
        rho=50.0,
        xi_r=0.002,
        xi_t=0.001,
        ex=227.0,
        ey=267.0,
        norm_px=256.0,
        width=512,
        height=512,
        covariance=covariance,
    )


@pytest.fixture(scope="session")
def header() -> Any:
    """A header to be copied."""
    value = blank_message("std_msgs/msg/Header")
    value.stamp.sec, value.stamp.nanosec, value.frame_id = 1_700_000_001, 999_999_999, "sem_optical"
    return value
