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

"""A calibration outside its range, and what camera and residual field have in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, CalibrationModel
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.residual_field import zero_field

LOW, HIGH = 100.0, 10000.0


def _model() -> CalibrationModel:
    values = {
        "scale": [1.0, 0.1],
        "aspect": [1.0],
        "px": [255.5, 3.0],
        "py": [255.5],
        "rho": [50.0],
    }
    functions = {
        name: ContinuousFunction("chebyshev_log", np.array(values.get(name, [0.0])), (LOW, HIGH))
        for name in FUNCTION_NAMES
    }
    size = sum(f.size for f in functions.values())
    return CalibrationModel(
        functions, np.zeros((size, size)), 512, 512, 0.12, (LOW, 1000.0, HIGH), "joint"
    )


@pytest.mark.parametrize("g", [20000.0, 50.0])
def test_out_of_range_a_parameter_may_leave_its_tangent_by_twice_its_variation(g: float) -> None:
    model = _model()
    camera = model.at(g)
    # Per calibrated range in log g: a factor of two is 0.15 of two decades.
    distance = np.log(2.0) / np.log(HIGH / LOW)
    sigma = np.sqrt(np.diag(camera.covariance))
    assert sigma[0] == pytest.approx(2.0 * 0.2 * distance * model.nominal_px_per_m(g), rel=1e-6)
    assert sigma[3] == pytest.approx(2.0 * 6.0 * distance, rel=1e-6)
    # What does not change with the magnification goes on as it is.
    assert sigma[1] == sigma[5] == 0.0


def test_a_range_shorter_than_a_factor_of_e_counts_as_one_of_that_length() -> None:
    functions = {
        name: ContinuousFunction(
            "chebyshev_log",
            np.array([1.0, 0.01] if name == "scale" else [float(name == "aspect")]),
            (900.0, 1100.0),
        )
        for name in FUNCTION_NAMES
    }
    model = CalibrationModel(
        functions, np.zeros((11, 11)), 512, 512, 0.12, (900.0, 1000.0, 1100.0), "joint"
    )
    camera = model.at(1100.0 * np.exp(0.5))
    sigma = np.sqrt(camera.covariance[0, 0]) / model.nominal_px_per_m(camera.magnification)
    # Half of a factor of e away, with a variation of 0.02; and of four fifths of this factor nothing was seen, where
    # 2 % are usual.
    unseen = 0.02 * (1.0 - np.log(1100.0 / 900.0))
    assert sigma == pytest.approx(0.5 * np.hypot(2.0 * 0.02, unseen))


def test_within_the_range_nothing_is_added() -> None:
    for g in (LOW, 777.0, HIGH):
        camera = _model().at(g)
        assert camera.in_range
        assert not np.any(camera.covariance)


@pytest.mark.parametrize("g", [LOW, 777.0, HIGH])
def test_a_shift_that_the_field_takes_back_leaves_no_uncertainty(g: float) -> None:
    model = _model()
    field = zero_field((512, 512), (LOW, HIGH), 3)
    # The principal point and the whole field are uncertain by 0.8 px along x, always together: the
    # one moves a projection forth, the other moves it back.
    camera_part = np.zeros(len(model.covariance))
    before_px = FUNCTION_NAMES.index("px")
    camera_part[sum(model.functions[name].size for name in FUNCTION_NAMES[:before_px])] = 0.8
    field_part = np.zeros_like(field.coefficients)
    field_part[..., 0] = 0.8 / model.norm_px
    both = np.concatenate([camera_part, field_part.ravel()])
    points = np.array([[0.0, 0.0, 0.0], [2e-3 / g, -1e-3 / g, 0.0]])
    together = replace(model, residual=field, covariance=np.outer(both, both)).at(g)
    # Rounding: the root of 1e-16 of the variance.
    np.testing.assert_allclose(together.project_sigma(points), 0.0, atol=1e-7)
    both[: len(camera_part)] *= -1.0
    apart = replace(model, residual=field, covariance=np.outer(both, both)).at(g)
    np.testing.assert_allclose(apart.project_sigma(points), [[1.6, 0.0]] * 2, atol=1e-7)
