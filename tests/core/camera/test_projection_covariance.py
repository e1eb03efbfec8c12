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

"""The covariance of P_g: first order in the parameters, and the same uncertainty of the scale as elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from tests.helpers.node_scenes import make_calibration

CALIBRATION = make_calibration()
NAMES = ("m", "aspect", "skew", "px", "py", "rho")


def with_covariance(camera: ScanCamera) -> ScanCamera:
    """With errors of realistic size that are correlated."""
    sizes = np.array([3e-3 * camera.m, 1e-3, 5e-4, 3.0, 4.0, 0.2, 1e-3, 1e-3, 2.0, 2.0])
    mixed = np.random.default_rng(3).normal(size=(10, 10)) / np.sqrt(10.0) + np.eye(10)
    return replace(camera, covariance=(mixed @ mixed.T) * np.outer(sizes, sizes))


@pytest.mark.parametrize("rectified", [False, True])
def test_it_is_that_of_cameras_with_scattered_parameters(rectified: bool) -> None:
    camera = with_covariance(CALIBRATION.at(2000.0))
    camera = camera.rectified if rectified else camera
    assert camera.covariance is not None
    # Central differences of a function of second order are exact but for rounding.
    columns = []
    for name in NAMES:
        value = getattr(camera, name)
        step = 1e-4 * abs(value) + 1e-6
        ends = [replace(camera, **{name: value + s}).P_affine.reshape(-1) for s in (step, -step)]
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    by = np.column_stack(columns)
    expected = by @ camera.covariance[:6, :6] @ by.T
    own = camera.P_affine_covariance
    # m, aspect and skew, py alone and so on: all but the four constants.
    known = np.flatnonzero(np.diag(expected))
    assert known.tolist() == [0, 1, 2, 3, 5, 6, 7, 10]
    unit = np.sqrt(np.diag(expected)[known])
    found, wanted = (c[np.ix_(known, known)] / np.outer(unit, unit) for c in (own, expected))
    # 1/a alone is no polynomial: its third-order term is 1e-8 of it here.
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_its_scale_is_that_of_the_pixel_size_and_constants_have_none() -> None:
    camera = with_covariance(CALIBRATION.at(2000.0)).rectified
    covariance, p = camera.P_affine_covariance, camera.P_affine
    relative = [np.sqrt(covariance[i, i]) / p.reshape(-1)[i] for i in (0, 5)]
    stated = np.divide(camera.pixel_size_sigma_m, camera.pixel_size_m)
    np.testing.assert_allclose(relative, stated, rtol=1e-12)
    for constant in (4, 8, 9, 11):
        assert not covariance[constant].any()
    np.testing.assert_array_equal(covariance, covariance.T)


def test_without_a_covariance_there_is_none() -> None:
    with pytest.raises(InvalidValueError, match="without covariance"):
        replace(CALIBRATION.at(2000.0), covariance=None).P_affine_covariance  # noqa: B018
