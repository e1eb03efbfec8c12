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

"""Analytic derivatives against numerical ones."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.camera.projection import (
    ALL_NAMES,
    project_points,
    project_points_with_jacobians,
)
from semcal_ros.core.camera.scan_distortion import Raster

RASTER = Raster.of(512, 448)
BASIC = np.array([4.3e5, 1.01, 0.003, 245.0, 262.0, 50.0, 0.06, -0.012, 231.0, 274.0])
LENS = [-0.008, 0.003, -0.004, 0.005, 0.006]
ALONG = [0.004, -0.006, 0.001, 0.002, -0.001, 0.001, 0.001, 0.002, 0.01, -0.003, 0.002]
ACROSS = [0.003, 0.005, -0.001, 0.002, 0.001, -0.002]
TERMS = np.array([*LENS, *ALONG, *ACROSS])
PARAMETERS = np.concatenate([BASIC, TERMS])
assert len(PARAMETERS) == len(ALL_NAMES), f"each of {ALL_NAMES} needs a value here"
POINTS = np.random.default_rng(3).uniform(-5e-4, 5e-4, (60, 3))


def _central(function, x, step):
    return (function(x + step) - function(x - step)) / 2.0


@pytest.mark.parametrize("index", range(len(ALL_NAMES)), ids=ALL_NAMES)
@pytest.mark.parametrize("rho", [50.0, 0.0])
def test_parameter_derivatives(index, rho):
    parameters = PARAMETERS.copy()
    parameters[5] = rho
    step = max(abs(parameters[index]) * 1e-5, 1e-6)
    delta = np.zeros(len(ALL_NAMES))
    delta[index] = step
    numeric = _central(lambda p: project_points(p, POINTS, RASTER), parameters, delta) / step
    analytic = project_points_with_jacobians(parameters, POINTS, RASTER).d_parameters[:, :, index]
    # Central differences with a relative step of 1e-5 are good to 1e-7 or so of the largest value.
    np.testing.assert_allclose(analytic, numeric, atol=2e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("points_only", [False, True])
@pytest.mark.parametrize("axis", range(3))
def test_point_derivatives(axis, points_only):
    step = 1e-8
    delta = np.zeros(3)
    delta[axis] = step
    numeric = _central(lambda x: project_points(PARAMETERS, x, RASTER), POINTS, delta) / step
    found = project_points_with_jacobians(PARAMETERS, POINTS, RASTER, points_only=points_only)
    analytic = found.d_xyz[:, :, axis]
    assert found.d_parameters.shape[2] == (0 if points_only else len(ALL_NAMES))
    np.testing.assert_allclose(analytic, numeric, atol=2e-6 * np.abs(numeric).max())


def test_one_camera_per_point_equals_one_camera():
    table = np.tile(PARAMETERS, (len(POINTS), 1))
    np.testing.assert_array_equal(
        project_points(table, POINTS, RASTER), project_points(PARAMETERS, POINTS, RASTER)
    )


def test_a_camera_without_terms_is_that_with_terms_of_zero():
    whole = np.concatenate([BASIC, np.zeros(len(TERMS))])
    np.testing.assert_array_equal(
        project_points(BASIC, POINTS, RASTER), project_points(whole, POINTS, RASTER)
    )
    few, many = (project_points_with_jacobians(p, POINTS, RASTER) for p in (BASIC, whole))
    np.testing.assert_array_equal(few.d_parameters, many.d_parameters[:, :, :10])
    np.testing.assert_array_equal(few.d_xyz, many.d_xyz)
