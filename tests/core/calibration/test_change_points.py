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

"""Piecewise ranges: scan generators that switch an attenuator, so that the scale jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.calibration import Calibration
from semcal_ros.core.calibration.judgement.outliers import FreeScales, find_change
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import grid_views
from tests.helpers.calibrations import calibrated

pytestmark = pytest.mark.slow

CALIBRATED = [100.0, 300.0, 700.0, 1500.0, 2500.0, 4000.0, 6000.0, 8000.0, 10000.0]
# Visits come back to 0.1 %, and the heights of 40 um of six views add as much.
JUMP = 0.015
MICROSCOPE = preset("jsm820")


def _camera(g):
    camera = MICROSCOPE.camera_at(g)
    jump = JUMP * float(g >= 3000.0)
    return replace(camera, m=camera.m * (1.0 + jump), aspect=camera.aspect * (1.0 + 0.3 * jump))


def _calibrated(magnifications=CALIBRATED, views=4, **options):
    views = grid_views(_camera, magnifications, noise_px=0.05, views=views, seed=2)
    return calibrate_views(
        views,
        image_size=MICROSCOPE.image_size,
        display_width_m=0.12,
        options=CalibrationOptions(residual="off", **options),
    )


@pytest.mark.long
def test_a_jump_is_suspected_and_said_but_not_applied():
    result = _calibrated(views=6)
    (warning,) = [w for w in result.warnings if "jump" in w]
    assert "between magnifications 2500 and 4000" in warning
    assert len(result.model.functions["scale"].breaks) == 0


@pytest.mark.long
def test_a_jump_where_the_squares_change_may_be_a_wrong_size_of_them():
    views = [
        replace(v, square_m=20e-6 if v.magnification < 3000.0 else 5e-6)
        for v in grid_views(_camera, CALIBRATED, noise_px=0.05, views=6, seed=2)
    ]
    result = calibrate_views(
        views,
        image_size=MICROSCOPE.image_size,
        display_width_m=0.12,
        options=CalibrationOptions(residual="off"),
    )
    (warning,) = [w for w in result.warnings if "jump" in w]
    assert "squares are of 20 um below, and of 5 um above" in warning
    assert "a breakpoint would hide it" in warning


def _with_views_that_state_315(wrong):
    """Views, and their calibration, where so many of four at 300x state 315x: it alone departs by 5 %."""
    views = grid_views(MICROSCOPE.camera_at, [300.0, 800.0], noise_px=0.05, views=4, seed=2)
    for k in range(1, 1 + wrong):
        views[k] = replace(views[k], magnification=315.0)
    return views, calibrate_views(
        views,
        image_size=MICROSCOPE.image_size,
        display_width_m=0.12,
        options=CalibrationOptions(residual="off"),
    )


@pytest.mark.long
def test_the_one_view_beside_a_jump_that_has_a_wrong_magnification_is_left_out():
    views, result = _with_views_that_state_315(1)
    assert [o.name for o in result.outliers] == [views[1].name]
    assert "a scale that differs by 4." in result.outliers[0].reason
    # The others calibrate the rest.
    assert result.model.magnifications == (300.0, 800.0)


@pytest.mark.long
def test_the_views_beside_a_jump_may_have_a_wrong_magnification():
    views, result = _with_views_that_state_315(2)
    (told,) = [w for w in result.warnings if "departs by" in w]
    assert told.startswith("the scale at magnification 315 departs by -4.")
    assert f"look whether {views[1].name} and {views[2].name} were taken at 315" in told


@pytest.mark.long
def test_a_smooth_microscope_is_not_suspected():
    smooth = calibrated("jsm820", CalibrationOptions(residual="off"))
    assert not any("jump" in w or "departs by" in w for w in smooth.warnings)


@pytest.mark.long
def test_a_breakpoint_gives_the_scale_on_both_sides():
    model = _calibrated(breakpoints=(3000.0,)).model
    for g in (2900.0, 3000.0, 3100.0):
        camera, truth = model.at(g), _camera(g)
        error = camera.m / truth.m - 1.0
        sigma = np.sqrt(camera.covariance[0, 0]) / truth.m
        # Heights of 40 um between pivot and specimen leave the scale of four views uncertain by 0.1 %.
        assert abs(error) < 3.0 * sigma
        assert sigma < 0.002
    assert model.at(3000.0).m / model.at(2999.999).m - 1.0 == pytest.approx(JUMP, abs=0.004)


@pytest.mark.long
def test_breakpoints_survive_the_file(tmp_path):
    few = (100.0, 1000.0, 2500.0, 4000.0, 6000.0, 8000.0, 10000.0)
    model = _calibrated(few, views=3, breakpoints=(3000.0, 7000.0)).model
    calibration = Calibration.from_model(model)
    calibration.save(tmp_path / "cal.yaml")
    again = Calibration.load(tmp_path / "cal.yaml")
    assert again.functions["scale"].breaks.tolist() == [3000.0, 7000.0]
    for g in (2999.0, 3000.0, 7000.0):
        np.testing.assert_array_equal(again.at(g).parameters, calibration.at(g).parameters)


@pytest.mark.parametrize(
    ("breaks", "method"), [((50.0,), "joint"), ((20000.0,), "joint"), ((3000.0,), "discrete")]
)
def test_meaningless_breakpoints_are_refused(breaks, method):
    with pytest.raises(InvalidValueError, match="breakpoints"):
        _calibrated(breakpoints=breaks, method=method)


def test_a_function_with_a_jump():
    function = ContinuousFunction(
        "chebyshev_log", np.array([1.0, 0.5, 0.25]), (100.0, 10000.0), breaks=np.array([1000.0])
    )
    assert (function.size, function.smooth_size) == (3, 2)
    assert function(999.999) == pytest.approx(1.0, abs=1e-5)
    # The breakpoint belongs to the range above it.
    assert function(1000.0) == pytest.approx(1.25)
    assert function(20000.0) - function(10000.0) == pytest.approx(
        0.5 * np.log(2.0) / np.log(10.0), rel=1e-3
    )


@pytest.mark.slow
@pytest.mark.long
def test_a_scale_that_bends_between_few_magnifications_is_not_suspected():
    def bending(g):
        camera = MICROSCOPE.camera_at(g)
        wave = 0.018 * np.sin(2.0 * np.pi * np.log10(g / 100.0) / 1.6 + 2.0)
        return replace(camera, m=camera.m * (1.0 + wave))

    magnifications = [100.0, 200.0, 400.0, 800.0, 1600.0]
    views = grid_views(bending, magnifications, noise_px=0.02, views=3, seed=4)
    result = calibrate_views(
        views,
        image_size=MICROSCOPE.image_size,
        display_width_m=0.12,
        options=CalibrationOptions(residual="off"),
    )
    assert not any("jump" in w or "departs by" in w for w in result.warnings)


def _further(smooth):
    """The next two Chebyshev polynomials, as far as they leave a degree of freedom."""
    count, order = smooth.shape
    more = np.polynomial.chebyshev.chebvander(np.linspace(-1.0, 1.0, count), order + 1)
    return more[:, order : min(order + 2, count - 1)]


def _draw_scales(rng, scatter, step=0.0, visits=1, order=5):
    """Scales in per cent of a wave over up to 15 magnifications, of visits that scatter as nobody knows."""
    count = int(rng.integers(5, 16))
    decades = np.cumsum(rng.uniform(np.log10(1.25), np.log10(2.1), count))
    wave = 1.2 * np.sin(2.0 * np.pi * decades / rng.uniform(1.2, 2.5) + rng.uniform(0.0, 7.0))
    at = int(rng.integers(2, count - 1))
    seen = scatter * rng.normal(size=(visits, count))
    # A usual visit comes back to 0.1.
    squares = float(np.sum((seen - seen.mean(axis=0)) ** 2)) / 0.1**2
    mean = wave + step * (np.arange(count) >= at) + seen.mean(axis=0)
    half = 0.1 / np.sqrt(visits) * np.eye(count)
    scales = FreeScales(mean, half, squares, float(count * (visits - 1)))
    smooth = np.polynomial.chebyshev.chebvander(
        np.linspace(-1.0, 1.0, count), min(count - 2, order)
    )
    # Of the smooth functions those that are needed, as the wave is known here.
    left = wave - smooth @ np.linalg.lstsq(smooth, wave, rcond=None)[0]
    candidates = [np.arange(count) >= k for k in range(1, count)]
    candidates += [np.arange(count) == k for k in range(1, count - 1)]
    return replace(scales, departure=mean - left), smooth, candidates, at


@pytest.mark.parametrize("scatter", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("visits", [1, pytest.param(2, marks=pytest.mark.long)])
def test_scales_that_do_not_jump_are_rarely_said_to(scatter, visits):
    """However much visits scatter: the chance is 0.01, and 1000 recordings show 10 +- 3."""
    rng = np.random.default_rng(7)
    found = 0
    for _ in range(1000):
        scales, smooth, candidates, _ = _draw_scales(rng, scatter, visits=visits)
        found += find_change(scales, smooth, candidates, _further(smooth)) is not None
    assert found <= 10 + 3 * 3


def test_a_step_is_found_where_it_is_and_its_sigma_is_right():
    rng = np.random.default_rng(8)
    deviations, right, drawn = [], 0, 200
    for _ in range(drawn):
        scales, smooth, candidates, at = _draw_scales(rng, 0.1, step=3.0, visits=2, order=2)
        found = find_change(scales, smooth, candidates, _further(smooth))
        if found is not None and np.array_equal(candidates[found[0]], np.arange(len(smooth)) >= at):
            right += 1
            deviations.append((found[1] - 3.0) / found[2])
    assert right > 0.9 * drawn
    assert 0.8 < np.sqrt(np.mean(np.square(deviations))) < 1.2


def test_a_wave_that_the_chosen_function_does_not_follow_is_no_jump():
    """What is left of a smooth course does not scatter, and a step stands for it as well as further orders do."""
    rng = np.random.default_rng(9)
    told = {False: 0, True: 0}
    for _ in range(300):
        scales, smooth, candidates, _ = _draw_scales(rng, 0.1, visits=2, order=3)
        further = _further(smooth)
        wave = 3.0 * further @ rng.normal(size=further.shape[1])
        bent = replace(scales, departure=scales.departure + wave)
        for knows in told:
            more = further if knows else further[:, :0]
            told[knows] += find_change(bent, smooth, candidates, more) is not None
    assert told[True] <= 0.02 * 300 < 0.2 * 300 < told[False]
