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

"""Lengths in the pictures: right, and as uncertain as repeated calibrations scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.viewer.measure import measure_distance
from tests.helpers.node_scenes import make_calibration

CAMERA = make_calibration().at(2000.0)
START, END = (10.0, 20.0), (85.0, 70.0)


def test_both_pictures_give_the_length_on_the_specimen() -> None:
    points = np.array([[-2e-6, 3e-6, 0.0], [25e-6, -20e-6, 0.0]])
    length = np.hypot(*(points[1] - points[0])[:2])
    raw = CAMERA.project(points)
    rectified = CAMERA.rectified.project(points)
    # The distortion moves these places by pixels; solving it is exact to far below a picometre.
    assert np.abs(raw - rectified).max() > 0.5
    for picture, ends in (("raw", raw), ("corrected", rectified)):
        found = measure_distance(CAMERA, picture, tuple(ends[0]), tuple(ends[1]))
        assert found.length_m == pytest.approx(length, rel=1e-6)
        assert found.x_m == pytest.approx(27e-6, rel=1e-5)
        assert found.y_m == pytest.approx(-23e-6, rel=1e-5)


@pytest.mark.long
def test_the_sigma_is_the_scatter_of_calibrations_like_this_one() -> None:
    """Cameras are drawn from the covariance; the same two raw pixels are measured with each."""
    covariance = np.diag([0.01 * CAMERA.m, 0.004, 0.003, 2, 2, 5, 0.01, 0.004, 1.5, 1.5]) ** 2
    camera = replace(CAMERA, covariance=covariance)
    rng = np.random.default_rng(5)
    names = ("m", "aspect", "skew", "px", "py", "rho", "xi_r", "xi_t", "ex", "ey")
    draws = rng.multivariate_normal(camera.parameters, covariance, 1500)
    lengths = [
        measure_distance(
            replace(camera, **dict(zip(names, d, strict=True))), "raw", START, END
        ).length_m
        for d in draws
    ]
    sigma_m = measure_distance(camera, "raw", START, END).calibration_sigma_m
    # 1500 draws tell a sigma to 1.8 %; linearisation and sampling together stay within 8 %.
    assert sigma_m == pytest.approx(np.std(lengths), rel=0.08)


def test_the_sigma_of_the_scale_alone_is_a_fraction_of_the_length() -> None:
    covariance = np.zeros((10, 10))
    covariance[0, 0] = (0.002 * CAMERA.m) ** 2
    found = measure_distance(replace(CAMERA, covariance=covariance), "corrected", START, END)
    assert found.calibration_sigma_m == pytest.approx(0.002 * found.length_m, rel=1e-9)
    # Rounding both ends to whole pixels: 1/12 px2 per end, along the ruler.
    pixel_m = CAMERA.rectified.pixel_size_m[0]
    assert found.placing_sigma_m == pytest.approx(pixel_m * np.sqrt(1 / 6))
    assert found.sigma_m == pytest.approx(
        np.hypot(found.calibration_sigma_m or 0, found.placing_sigma_m)
    )


def test_without_a_covariance_no_sigma_is_made_up() -> None:
    found = measure_distance(replace(CAMERA, covariance=None), "raw", START, END)
    assert found.calibration_sigma_m is None
    assert found.sigma_m is None


def test_a_nominal_camera_has_the_three_per_cent_of_an_uncalibrated_microscope() -> None:
    camera = ScanCamera.nominal(2000.0, 96, 96, 0.12)
    found = measure_distance(camera, "corrected", (48.0, 48.0), (68.0, 48.0))
    assert found.length_m == pytest.approx(20 * 0.12 / 2000 / 96)
    # Aspect and skew, 1 % each, and the distortion add to the scale's 3 %.
    assert 0.03 <= (found.calibration_sigma_m or 0) / found.length_m < 0.05


def test_no_way_has_no_length_and_no_place_no_answer() -> None:
    same = measure_distance(CAMERA, "corrected", START, START)
    assert (same.length_m, same.calibration_sigma_m) == (0.0, 0.0)
    for wrong in ((float("nan"), 0.0), (float("inf"), 1.0)):
        with pytest.raises(InvalidValueError):
            measure_distance(CAMERA, "raw", START, wrong)
    with pytest.raises(InvalidValueError):
        measure_distance(CAMERA, "stereo", START, END)
