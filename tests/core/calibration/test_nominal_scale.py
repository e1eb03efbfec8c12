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

"""Views whose units are far off are refused before the fit, with what would fit; so are fits that do not converge."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration import pipeline
from semcal_ros.core.calibration import solve as solve_module
from semcal_ros.core.calibration.estimator.trust_region import DescentStatus
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.start import check_nominal_scale, check_square_sides
from semcal_ros.core.errors import CalibrationError, UnusableCalibrationError
from semcal_ros.synthetic import preset
from tests.helpers.calibrations import seen_views

JSM = preset("jsm820")


def _calibrate(display_width_m, views=None, **options):
    return calibrate_views(
        views or seen_views("jsm820", (1000.0,), views=3),
        image_size=JSM.image_size,
        display_width_m=display_width_m,
        options=CalibrationOptions(**options),
    )


@pytest.mark.parametrize("wrong", [500.0, 1.0 / 100.0, 3.3, 1.0 / 3.3])
@pytest.mark.parametrize("method", ["joint", "discrete"])
def test_a_display_width_far_off_is_refused_before_the_fit(monkeypatch, wrong, method):
    def fit(*_given, **_options):
        raise AssertionError("the fit has begun")

    monkeypatch.setattr(pipeline, "fit_joint", fit)
    monkeypatch.setattr(pipeline, "fit_separately", fit)
    width = wrong * JSM.display_width_m
    with pytest.raises(UnusableCalibrationError, match="give --display-width") as error:
        _calibrate(width, method=method)
    factor = float(re.search(r"show ([\d.e+-]+) times", str(error.value)).group(1))
    # The presets' scale differs from the nominal one by a few per cent.
    assert factor == pytest.approx(wrong, rel=0.1)
    number, unit = re.search(r"--display-width ([\d.]+)([mun]*m)\b", str(error.value)).groups()
    told = float(number) * {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}[unit]
    # With what is told the fit begins.
    with pytest.raises(AssertionError, match="has begun"):
        _calibrate(told, method=method)


def test_the_limit_is_a_factor_of_three():
    for factor in (2.9, 1.0 / 2.9, 1.0):
        check_nominal_scale(factor, display_width_m=0.12, squares_m=[25e-6])
    for factor in (3.1, 1.0 / 3.1):
        with pytest.raises(UnusableCalibrationError):
            check_nominal_scale(factor, display_width_m=0.12, squares_m=[25e-6])


def _told(factor, **units):
    with pytest.raises(UnusableCalibrationError) as error:
        check_nominal_scale(factor, display_width_m=0.12, squares_m=[25e-6, 10e-6, 25e-6], **units)
    return str(error.value)


def test_what_would_fit_is_told_as_options_take_it():
    text = _told(0.1, pixel_size_m=1e-4)
    assert "squares of 25um and 10um predict" in text
    assert "give --display-width 1.2m, or --pixel-size 1mm in place of" in text
    assert "--squares 2.5um,1um (" in text


def test_no_display_width_is_told_that_the_option_refuses():
    assert "give --pixel-size 200nm in place of" in _told(500.0, pixel_size_m=1e-4)
    assert "give magnifications 500 times as large" in _told(500.0)
    for text in (_told(500.0), _told(1e-4)):
        assert "--display-width" not in text


def test_a_factor_of_two_is_a_period_for_a_side():
    for factor in (2.0, 0.5):
        with pytest.raises(CalibrationError, match="not the period"):
            check_square_sides(factor, 0.12)
    for factor in (1.0, 1.7, 2.5, 0.6):
        check_square_sides(factor, 0.12)


def _lose_the_first_corner(result):
    residuals, weight = result.residuals_px.copy(), result.huber_weight.copy()
    residuals[0], weight[0] = np.nan, 0.0
    return replace(result, residuals_px=residuals, huber_weight=weight)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (
            lambda result: replace(
                result, status=DescentStatus.ITERATION_LIMIT, last_decrease=1e-3
            ),
            "did not converge .stopped at the iteration limit",
        ),
        (_lose_the_first_corner, "cannot show corners of"),
    ],
)
def test_a_fit_that_does_not_converge_is_refused(monkeypatch, spoil, told):
    refine = solve_module.refine

    def never(*given, **options):
        return spoil(refine(*given, **options))

    monkeypatch.setattr(solve_module, "refine", never)
    with pytest.raises(UnusableCalibrationError, match=told):
        _calibrate(JSM.display_width_m, residual="off")


def test_a_fit_that_ends_far_from_the_nominal_scale_is_refused(monkeypatch):
    fit = pipeline.describe_fit

    def astray(*given):
        done = fit(*given)
        scale = done.functions["scale"]
        away = replace(scale, coefficients=4.0 * scale.coefficients)
        return replace(done, functions={**done.functions, "scale": away})

    monkeypatch.setattr(pipeline, "describe_fit", astray)
    with pytest.raises(UnusableCalibrationError, match=r"ended at [34]\.\d* times") as refused:
        _calibrate(JSM.display_width_m, residual="off")
    # The fit made this scale up, and not the display.
    assert "display-width" not in str(refused.value)
