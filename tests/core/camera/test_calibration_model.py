"""A calibration outside of its range."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, CalibrationModel
from semcal_ros.core.camera.continuous_function import ContinuousFunction

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


def test_within_the_range_nothing_is_added() -> None:
    for g in (LOW, 777.0, HIGH):
        camera = _model().at(g)
        assert camera.in_range
        assert not np.any(camera.covariance)
