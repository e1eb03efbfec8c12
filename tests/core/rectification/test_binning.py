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

"""Images averaged down, with the camera that belongs to them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.binning import bin_image
from tests.helpers.drift_scenes import small_camera


@given(width=st.integers(3, 90), height=st.integers(3, 90), largest=st.integers(30, 90))
def test_the_small_picture_shows_what_its_camera_says(
    width: int, height: int, largest: int
) -> None:
    """Ramps of grey levels tell which place of the full image a pixel of the small one shows."""
    camera = small_camera(1000.0, 192).resized(width, height)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    ramp_x, small = bin_image(x, camera, largest)
    ramp_y, _ = bin_image(y, camera, largest)
    assert max(ramp_x.shape) <= largest
    assert ramp_x.shape == (small.height, small.width)
    rows, cols = np.indices(ramp_x.shape)
    seen = small.undistort(np.stack([cols.ravel(), rows.ravel()], axis=1))
    shown = camera.undistort(np.stack([ramp_x.ravel(), ramp_y.ravel()], axis=1))
    # The ramps are in single precision: a thousandth of a pixel is beyond their rounding.
    away_m = small.sem_from_ideal(seen) - camera.sem_from_ideal(shown)
    assert np.max(np.abs(away_m)) < 1e-3 * max(camera.pixel_size_m)


def test_pixels_are_means_of_blocks() -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 65536, (64, 97, 3)).astype(np.uint16)
    small, camera = bin_image(image, small_camera(1000.0, 97), 40)
    blocks = image[:63, :96].astype(float).reshape(21, 3, 32, 3, 3).mean(axis=(1, 3))
    assert small.dtype == np.uint16
    assert (camera.width, camera.height) == (32, 21)
    # Rounded to whole grey levels.
    assert np.max(np.abs(small - blocks)) <= 0.5 + 1e-6


def test_a_small_picture_stays_the_same() -> None:
    image = np.zeros((40, 30), np.uint8)
    small, camera = bin_image(image, small_camera(1000.0, 192), 40)
    assert small is image
    assert (camera.width, camera.height) == (30, 40)
    with pytest.raises(InvalidValueError, match="longest side"):
        bin_image(image, camera, 0)
