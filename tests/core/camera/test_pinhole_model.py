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

"""The raw image as other programs describe it, against their own implementation."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcal_ros.core.camera.pinhole_model import fit_plumb_bob
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic import preset

SIZE = 128


def camera_of(name: str) -> ScanCamera:
    return preset(name).with_image_size(SIZE, SIZE).camera_at(1000.0)


def by_opencv(camera: ScanCamera) -> tuple[np.ndarray, float]:
    """Raw pixel of each rectified pixel by what camera_info says, and the largest error that is stated."""
    fitted = fit_plumb_bob(camera, SIZE, SIZE)
    assert fitted is not None
    maps = cv2.initUndistortRectifyMap(
        fitted.K, fitted.D, fitted.R, fitted.P[:, :3], (SIZE, SIZE), cv2.CV_32FC1
    )
    return np.stack(maps, axis=-1).reshape(-1, 2), fitted.worst_px


@pytest.mark.parametrize("name", ["jsm820", "off_centre", "pincushion"])
def test_opencv_finds_the_raw_pixels_as_well_as_is_said(name: str) -> None:
    camera = camera_of(name)
    pixels = np.stack(np.meshgrid(*2 * [np.arange(SIZE)]), axis=-1).reshape(-1, 2)
    raw = camera.raw_from_rect(pixels)
    seen, worst_px = by_opencv(camera)
    # The grid of the fit does not hit the very worst pixel; OpenCV computes in float32.
    assert np.hypot(*(seen - raw).T).max() < 1.1 * worst_px + 1e-3
    # It is worth having: most of the distortion, of more than a pixel in images of 512, is in it.
    assert worst_px < 0.5 * np.hypot(*(raw - pixels).T).max()


def test_what_the_model_can_describe_is_described_exactly() -> None:
    camera = replace(camera_of("jsm820"), xi_r=0.0, xi_t=0.0, skew=0.0, residual=None)
    # But for the turn of the axis, which foreshortens by the square of its angle: 1e-3 rad and less.
    assert by_opencv(camera)[1] < 1e-4


def test_a_parallel_projection_has_none() -> None:
    assert fit_plumb_bob(replace(camera_of("jsm820"), rho=0.0), SIZE, SIZE) is None


@pytest.mark.parametrize(("width", "height"), [(1, 96), (96, 1), (1, 1)])
def test_an_image_of_one_line_tells_no_model(width: int, height: int) -> None:
    assert fit_plumb_bob(camera_of("jsm820"), width, height) is None


def test_a_distortion_that_folds_all_pixels_away_tells_no_model() -> None:
    lost = replace(camera_of("jsm820"), ey=1e5)
    assert fit_plumb_bob(lost, SIZE, SIZE) is None
