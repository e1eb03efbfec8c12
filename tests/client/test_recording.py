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

"""The frames of a recording, without ROS."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from semcal_ros.client import open_frames
from tests.helpers.node_scenes import make_calibration, texture


def test_frames_come_free_of_drift_with_their_projection() -> None:
    whole, calibration = texture(3, 160), make_calibration()
    # The specimen moves by 2 px to the right and 1 px down a frame.
    pictures = [whole[16 - k : 144 - k, 16 - 2 * k : 144 - 2 * k] for k in range(4)]
    frames = list(open_frames([(p, 2000.0) for p in pictures], calibration=calibration))
    size = calibration.at(2000.0).resized(128, 128).rectified.pixel_size_m[0]
    for k, frame in enumerate(frames):
        assert frame.valid
        assert frame.magnification == 2000.0
        assert frame.pixel_size_m == pytest.approx(size)
        moved_px = frame.drift_m / size
        # Pictures that move as a whole: the distortion of the camera makes a few per cent of it.
        assert moved_px == pytest.approx((2.0 * k, 1.0 * k), rel=0.05, abs=0.05)
        if k:
            sigma_px = np.sqrt(np.diag(frame.drift_covariance)) / size
            assert np.all((sigma_px > 1e-3) & (sigma_px < 0.3))
        # Free of drift: the picture of the first frame.
        inner = np.s_[20:-20, 20:-20]
        assert np.abs(frame.image[inner].astype(float) - frames[0].image[inner]).mean() < 4.0
    with pytest.raises(ValueError, match="read-only"):
        frames[0].image[0, 0] = 0


def test_frames_outside_the_range_and_without_a_calibration_are_not_valid() -> None:
    pictures = [(texture(1, 128), 2000.0), (texture(1, 128), 1e5)]
    inside, outside = open_frames(pictures, calibration=make_calibration(), drift=False)
    assert inside.valid
    assert "outside the calibrated range" in outside.reason
    (plain,) = open_frames(pictures[:1], drift=False)
    assert plain.reason == "no calibration"
    assert not np.any(plain.drift_m)


def test_it_needs_no_ros() -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None\n"
        "from semcal_ros.client import CalibratedFrame, open_frames\n"
        "import semcal_ros.client as client\n"
        "try:\n    client.CalibratedStream\nexcept ImportError:\n    print('no stream')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "no stream\n"
