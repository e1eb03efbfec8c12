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

"""What a calibration states where the data say little: beyond its range, and without tilted views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import SimulatedStage, stage_views
from tests.helpers.calibrations import BETWEEN, CALIBRATED, calibrated

LOW, HIGH = 200.0, 2000.0


@pytest.fixture(scope="module")
def rising() -> CalibrationModel:
    """A scale that rises by 2 % over a factor of ten, known exactly within it."""
    model = calibrated("jsm820").model
    knots = np.array([LOW, HIGH])
    functions = {
        name: ContinuousFunction("linear_log", np.full(2, f(1000.0)), (LOW, HIGH), knots)
        for name, f in model.functions.items()
    }
    functions["scale"] = ContinuousFunction("linear_log", np.array([1.0, 1.02]), (LOW, HIGH), knots)
    size = sum(f.size for f in functions.values())
    return replace(
        model,
        functions=functions,
        covariance=np.zeros((size, size)),
        magnifications=(LOW, HIGH),
        residual=None,
        scale_sigma=replace(model.scale_sigma, repeatability=0.0, grid=0.0, height_m=0.0),
    )


@pytest.mark.parametrize(("g", "edge"), [(4000.0, HIGH), (100.0, LOW), (20000.0, HIGH)])
def test_beyond_the_range_the_sigma_is_twice_the_change_within_it(
    rising: CalibrationModel, g: float, edge: float
) -> None:
    """In proportion to the distance in log g over the length of the range."""
    distance = abs(np.log(g / edge)) / np.log(HIGH / LOW)
    camera = rising.at(g)
    expected = 2.0 * 0.02 * distance * rising.nominal_px_per_m(g) / camera.m
    assert rising.extrapolation_sigma(g) == pytest.approx(expected, rel=1e-9)
    for sigma, size in zip(camera.pixel_size_sigma_m, camera.pixel_size_m, strict=True):
        # The aspect ratio does not change over the range.
        assert sigma / size == pytest.approx(expected, rel=1e-9)
    assert not camera.in_range


@pytest.mark.parametrize("g", [4000.0, 100.0])
def test_beyond_the_range_covariance_extrapolation_and_repeatability_add_as_variances(
    rising: CalibrationModel, g: float
) -> None:
    """Of a straight line in log g between the ends of the range, whose values there are known to 0.3 and 0.1 %."""
    ends, cross, repeatability = np.array([0.003, 0.001]), 1e-6, 0.002
    covariance = rising.covariance.copy()
    # The coefficients of the scale are the first ones.
    covariance[:2, :2] = np.diag(ends**2) + cross * (1 - np.eye(2))
    model = replace(
        rising,
        covariance=covariance,
        scale_sigma=replace(rising.scale_sigma, repeatability=repeatability),
    )
    t = np.log(g / LOW) / np.log(HIGH / LOW)
    scale = 1.0 + 0.02 * t
    propagated = (
        (1 - t) ** 2 * ends[0] ** 2 + t**2 * ends[1] ** 2 + 2 * t * (1 - t) * cross
    ) / scale**2
    beyond = 2.0 * 0.02 * min(abs(t), abs(t - 1.0)) / scale
    camera = model.at(g)
    expected = np.sqrt(propagated + beyond**2 + repeatability**2)
    # None of them is so small that it would not be missed.
    assert min(propagated, beyond**2, repeatability**2) > 0.01 * expected**2
    for sigma, size in zip(camera.pixel_size_sigma_m, camera.pixel_size_m, strict=True):
        assert sigma / size == pytest.approx(expected, rel=1e-9)


def test_one_magnification_says_nothing_of_others(rising: CalibrationModel) -> None:
    """Taken for a microscope that does not change, it was off by 51 stated sigmas at twice the magnification."""
    constant = {
        name: ContinuousFunction("linear_log", f.coefficients[:1], (LOW, LOW), np.array([LOW]))
        for name, f in rising.functions.items()
    }
    size = sum(f.size for f in constant.values())
    alone = replace(
        rising, functions=constant, magnifications=(LOW,), covariance=np.zeros((size, size))
    )
    assert alone.extrapolation_sigma(LOW) == 0.0
    near, far = (alone.extrapolation_sigma(g) for g in (1.1 * LOW, 2.0 * LOW))
    assert far == pytest.approx(0.02 * np.log(2.0), rel=0.05)
    assert far / near == pytest.approx(np.log(2.0) / np.log(1.1), rel=1e-6)
    # The distortion as well: 2 % of the half width at its end.
    camera = alone.at(np.e * LOW)
    edge = camera.project_sigma(camera.sem_from_ideal(np.array([[camera.width - 1.0, camera.py]])))
    assert np.max(edge) > 0.02 * 0.5 * camera.width


def test_inside_the_range_nothing_is_added(rising: CalibrationModel) -> None:
    for g in (LOW, 700.0, HIGH):
        assert rising.extrapolation_sigma(g) == 0.0
        assert rising.at(g).pixel_size_sigma_m == pytest.approx((0.0, 0.0), abs=1e-30)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("name", ["jsm820", pytest.param("pincushion", marks=pytest.mark.long)])
def test_beyond_the_range_the_truth_is_within_what_is_stated(name: str) -> None:
    """Calibrated over the middle of the range, asked a factor of two and three beyond both ends."""
    middle = tuple(g for g in (*CALIBRATED, *BETWEEN) if 700.0 < g < 4000.0)
    model = calibrated(name, magnifications=tuple(sorted(middle))).model
    microscope = preset(name)
    z = []
    for g in (230.0, 400.0, 7000.0, 10000.0):
        camera, true = model.at(g), microscope.camera_at(g)
        pairs = zip(camera.pixel_size_m, true.pixel_size_m, camera.pixel_size_sigma_m, strict=True)
        z += [(size - own) / sigma for size, own, sigma in pairs]
    # The allowance is generous: the functions may turn beyond the range. It is not without meaning either.
    assert np.abs(z).max() < 2.5
    assert np.abs(z).max() > 0.02


@pytest.mark.long
def test_without_tilts_the_scale_is_as_uncertain_as_the_height() -> None:
    """Without tilt a height is a scale; what is left is how well views keep their height."""
    sem = preset("jsm820")
    visits = (300.0, 1000.0, 3000.0, 1000.0, 300.0)
    stated, errors = {}, {}
    for name, tilts in (("flat", (0.0, 0.0, 0.0)), ("tilted", (0.0, 0.35, 0.7))):
        stage = SimulatedStage(scale_sigma=1e-3, tilts_rad=tilts, tilt_error_rad=0.0)
        views = stage_views(sem.camera_at, visits, stage, seed=3)
        model = calibrate_views(
            views,
            image_size=sem.image_size,
            display_width_m=sem.display_width_m,
            options=CalibrationOptions(residual="off"),
        ).model
        cameras = [model.at(g) for g in (300.0, 1000.0, 3000.0)]
        stated[name] = np.array([c.pixel_size_sigma_m[0] / c.pixel_size_m[0] for c in cameras])
        truth = [sem.camera_at(c.magnification).pixel_size_m[0] for c in cameras]
        errors[name] = np.array(
            [c.pixel_size_m[0] / t - 1.0 for c, t in zip(cameras, truth, strict=True)]
        )
    for name, sigma in stated.items():
        assert np.abs(errors[name] / sigma).max() < 3.0
    # Pivot and height are not told apart: the stated sigma must not be that of the tilted views.
    assert np.all(stated["flat"] > stated["tilted"])
