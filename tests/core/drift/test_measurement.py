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

"""From a registration in pixels to a measurement: units, and what is added to its covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.measurement import make_measurement
from semcal_ros.core.registration.inverse_compositional import unmeasured_alignment
from semcal_ros.core.registration.register import Registration

PICTURE = np.zeros((100, 100), np.uint8)
PASS_S = 2.0
# Interpolation, and the linear step to a shear: 1-sigma, px.
SHIFT_FLOOR, SHEAR_FLOOR = 1e-3, 0.02


def frame(camera: ScanCamera | None = None, pass_s: float = PASS_S) -> ScanFrame:
    return ScanFrame(PICTURE, camera, ScanTiming(pass_s))


def registration(shift: tuple[float, float]) -> Registration:
    """A shift known to 0.1 px and a shear known to 0.2 px."""
    alignment = replace(
        unmeasured_alignment(),
        shift_px=np.array(shift),
        covariance=0.01 * np.eye(2),
        joint_px=np.array([*shift, 0.3, -0.1]),
        joint_covariance=np.diag([0.01, 0.01, 0.04, 0.04]),
    )
    return Registration(alignment, correlation=1.0, rejection=None)


@pytest.mark.parametrize(("averaged", "share"), [(1.0, 0.5), (3.0, 0.75), (np.inf, 1.0)])
def test_the_noise_of_a_keyframe_is_not_that_of_the_measurement(
    averaged: float, share: float
) -> None:
    """Against the mean of n frames, n of n + 1 parts of the noise are those of the frame."""
    measure = make_measurement(5, frame(), frame(), registration((0.0, 0.0)), np.zeros(4), averaged)
    np.testing.assert_allclose(measure.shift, [0.0, 0.0, 0.3 / PASS_S, -0.1 / PASS_S])
    expected = [share * 0.01 + SHIFT_FLOOR**2, (share * 0.04 + SHEAR_FLOOR**2) / PASS_S**2]
    np.testing.assert_allclose(np.diag(measure.covariance), np.repeat(expected, 2))


@pytest.mark.parametrize(("scale_sigma", "part"), [(0.0, 1e-3), (0.03, 0.01)])
def test_a_distortion_that_is_left_shears_in_proportion_to_the_shift(
    scale_sigma: float, part: float
) -> None:
    camera = ScanCamera.nominal(1000.0, 100, 100, 0.1)
    spread = np.zeros((10, 10))
    spread[0, 0] = (scale_sigma * camera.m) ** 2
    now = frame(replace(camera, covariance=spread))
    # 1e6 px per m, and 50 px away.
    measure = make_measurement(5, now, now, registration((30.0, -40.0)), np.zeros(4), np.inf)
    np.testing.assert_allclose(measure.shift[:2], [30e-6, -40e-6])
    shear = (0.04 + SHEAR_FLOOR**2 + (50.0 * part) ** 2) / (PASS_S * 1e6) ** 2
    np.testing.assert_allclose(np.diag(measure.covariance)[2:], shear)


def test_what_was_removed_from_the_frame_is_added_again() -> None:
    removed = np.array([0.5, -0.25, 0.06, 0.12])
    measure = make_measurement(
        5, frame(pass_s=3.0), frame(), registration((1.0, 2.0)), removed, np.inf
    )
    # An acceleration a lies a T^2 / 24 away from the drift at the middle.
    term = PASS_S**2 / 24.0
    expected = [1.0 + 0.06 * term, 2.0 + 0.12 * term, 0.15 + 0.5, -0.05 - 0.25]
    np.testing.assert_allclose(measure.shift, expected)
    assert measure.shear_ratio == pytest.approx(1.5)


def test_a_frame_shows_the_part_of_a_keyframes_shear_that_is_in_its_field() -> None:
    wide, narrow = (frame(ScanCamera.nominal(g, 100, 100, 0.1)) for g in (1000.0, 1250.0))
    measured = registration((0.0, 0.0))
    measure = make_measurement(5, wide, narrow, measured, np.zeros(4), np.inf)
    assert measure.shear_ratio == pytest.approx(0.8)
    # In more pixels it is the same field.
    fine = ScanFrame(
        np.zeros((200, 200), np.uint8),
        ScanCamera.nominal(1000.0, 200, 200, 0.1),
        ScanTiming(PASS_S),
    )
    measure = make_measurement(5, wide, fine, measured, np.zeros(4), np.inf)
    assert measure.shear_ratio == pytest.approx(1.0)
