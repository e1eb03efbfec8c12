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

"""The residual field as it is estimated: it finds what is there, and nothing where there is nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from semcal_ros.core.calibration import select
from semcal_ros.core.calibration.estimator import residual_field_fit
from semcal_ros.core.calibration.estimator.normal_equations import eliminate_views
from semcal_ros.core.calibration.judgement.evaluate import fit_poses, rms_by_magnification
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.errors import InvalidValueError, UnusableCalibrationError
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.microscope import Exponential, Residual
from semcal_ros.synthetic.stage import grid_views
from tests.helpers.calibrations import BETWEEN, CALIBRATED, NOISE_PX, calibrated
from tests.helpers.long_tests import long_but
from tests.helpers.made_once import made_once

pytestmark = pytest.mark.slow

JSM = preset("jsm820")


@dataclass(frozen=True)
class Wavy:
    """A microscope whose scan has waves across both axes, which no function of one axis describes."""

    size_px: float = 0.8
    camera_at = staticmethod(JSM.camera_at)
    image_size = JSM.image_size
    display_width_m = JSM.display_width_m

    def project(self, g, points):
        raw = JSM.project(g, points)
        x, y = ((raw - 255.5) / 256.0).T
        waves = [np.sin(np.pi * y) * np.cos(2.0 * x), np.cos(2.0 * y) * np.sin(np.pi * x)]
        return raw + self.size_px * np.stack(waves, axis=1)


WAVY = Wavy()
FADING = replace(preset("spiral"), residual_growth=Exponential(1.0, 0.2, 3000.0))


def _views(microscope, magnifications, noise_px=0.0, seed=0, views=4):
    return grid_views(
        microscope.camera_at,
        magnifications,
        noise_px=noise_px,
        views=views,
        seed=seed,
        project=microscope.project,
    )


def _calibrate(microscope, residual, magnifications=CALIBRATED, **changes):
    return calibrate_views(
        _views(microscope, magnifications, NOISE_PX, **changes),
        image_size=microscope.image_size,
        display_width_m=microscope.display_width_m,
        options=CalibrationOptions(residual=residual),
    )


def _model_error(result, microscope, magnifications=BETWEEN):
    """RMS px over noise-free views that took no part, poses fitted."""
    clean = _views(microscope, magnifications, seed=99, views=3)
    errors = rms_by_magnification(fit_poses(clean, result.model.at, height_sigma_m=4e-5))
    return float(np.sqrt(np.mean(np.square(list(errors.values())))))


@pytest.fixture(scope="module")
def with_field():
    return made_once("wavy-with-field", lambda: _calibrate(WAVY, "auto"))


@pytest.mark.parametrize(
    ("microscope", "terms"),
    [
        pytest.param(preset("scan_nonlinear"), "settling", id="coils and settling"),
        pytest.param(FADING, "xi_s", id="a spiral that fades"),
    ],
)
@pytest.mark.long
def test_terms_describe_coils_settling_and_spiral_without_a_field(microscope, terms):
    result = _calibrate(microscope, "auto")
    assert result.model.residual is None
    assert any(name.startswith(terms) for name in result.model.functions)
    # 28 views with 0.05 px of noise leave about 0.01 px in the parametric case (test_calibrate).
    assert _model_error(result, microscope) < 0.03


@pytest.mark.long
def test_auto_finds_what_no_term_describes(with_field):
    # What is missing is missing at every magnification.
    without = _calibrate(WAVY, "off", CALIBRATED[::2])
    assert without.model.residual is None
    about = with_field.model.statistics["fit"]["residual_field"]
    assert about["worthwhile"] and about["converged"]
    # Some hundred coefficients more, determined by 7000 observations, add about half of the noise's
    # 0.05 sqrt(200 / 7000) = 0.01.
    assert _model_error(with_field, WAVY) < 0.03
    assert _model_error(without, WAVY) > 5.0 * _model_error(with_field, WAVY)


@pytest.mark.long
def test_what_is_left_is_the_noise(with_field):
    expected = NOISE_PX * np.sqrt(2.0)
    assert with_field.model.statistics["rms_px"] == pytest.approx(expected, rel=0.07)
    assert with_field.model.statistics["held_out_rms_px"] == pytest.approx(expected, rel=0.25)
    assert with_field.model.statistics["fit"]["variance_factor"] == pytest.approx(1.0, rel=0.12)
    assert not any("converge" in w or "residuals are" in w for w in with_field.warnings)


@pytest.mark.long
def test_the_field_leaves_the_rest_of_the_model_alone(with_field):
    field = with_field.model.residual
    for coefficients in field.coefficients:
        overlap = field.overlaps() @ coefficients.ravel() * with_field.model.norm_px
        # Held to 1e-4 px by the prior; the data pull with some thousand times the weight of one observation.
        assert np.abs(overlap).max() < 0.02


@pytest.mark.long
def test_a_microscope_without_such_distortion_is_not_made_worse():
    ordinary = preset("jsm820")
    auto, on = calibrated("jsm820"), calibrated("jsm820", CalibrationOptions(residual="on"))
    assert auto.model.residual is None
    assert on.model.residual is not None
    # The promise of the project.
    assert _model_error(on, ordinary) < _model_error(auto, ordinary) + 0.005


@pytest.mark.long
def test_a_field_that_is_not_worthwhile_leaves_no_trace():
    auto, off = calibrated("jsm820"), calibrated("jsm820", CalibrationOptions(residual="off"))
    for name, function in off.model.functions.items():
        np.testing.assert_array_equal(
            auto.model.functions[name].coefficients, function.coefficients
        )
    np.testing.assert_array_equal(auto.model.covariance, off.model.covariance)


@pytest.mark.long
def test_held_out_agrees_with_a_new_calibration(with_field):
    """One Gauss-Newton step leaves a magnification out as well as a calibration that never saw it."""
    result, g = with_field, CALIBRATED[3]
    others = tuple(other for other in CALIBRATED if other != g)
    views = [v for v in result.views if v.magnification != g]
    fresh = calibrate_views(
        views,
        image_size=WAVY.image_size,
        display_width_m=WAVY.display_width_m,
        options=CalibrationOptions(residual="on"),
    )
    assert fresh.model.magnifications == others
    own = [v for v in result.views if v.magnification == g]
    expected = fit_poses(own, fresh.model.at, height_sigma_m=4e-5).rms_px()
    # Both have some thousandths of px of model error, on top of the noise.
    assert result.held_out_rms_px[g] == pytest.approx(expected, rel=0.05)


@pytest.mark.long
def test_one_magnification_is_enough():
    spiral = preset("spiral")
    result = calibrated("spiral", magnifications=(1000.0,), views=8)
    assert "xi_s" in result.model.functions
    # 8 views of 0.05 px determine some ten coefficients worse than 28 do.
    assert _model_error(result, spiral, [1000.0]) < 0.03


@pytest.mark.long
def test_predicted_errors_are_as_large_as_the_errors():
    """Differences of projected points, which no gauge changes, against their stated sigma."""
    scores = []
    strong = replace(preset("jsm820"), residual=Residual(spiral=0.003, sine=0.001))
    for seed in range(3):
        # From every other magnification: a field of that many is as certain as it says, too.
        result = _calibrate(strong, "on", CALIBRATED[::2], seed=seed)
        assert result.outliers == ()
        for g in BETWEEN:
            camera, truth = result.model.at(g), strong.camera_at(g)
            half = 100.0 / truth.m
            corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0]])
            error = camera.project(corners) - strong.project(g, corners)
            jacobian = camera.project_jacobian(corners)
            # Bending of the image: the middle against the mean of the corners, free of shift, turn and scale.
            bend = error[4] - error[:4].mean(axis=0)
            row = jacobian[4] - jacobian[:4].mean(axis=0)
            sigma = np.sqrt(np.einsum("ip,pq,iq->i", row, camera.joint_covariance, row))
            scores.extend(bend / sigma)
    # The scores along each axis of a calibration are nearly one: a chi-square with 6 degrees of freedom, 99 % of it.
    assert 0.33 < np.sqrt(np.mean(np.square(scores))) < 1.76


@pytest.mark.parametrize("once", long_but(lambda once: once, [True, False]))
def test_views_that_rounding_makes_unsolvable_have_no_field(once, monkeypatch):
    calls = []

    def rounded(*arguments):
        calls.append(arguments)
        if once and len(calls) > 1:
            return eliminate_views(*arguments)
        raise np.linalg.LinAlgError

    monkeypatch.setattr(residual_field_fit, "eliminate_views", rounded)
    if once:
        assert _calibrate(WAVY, "on", views=3, magnifications=(1000.0,)).model.residual is not None
        # A little damping makes up for it.
        assert calls[0][-1] == 0.0 < calls[1][-1]
        return
    assert _calibrate(WAVY, "auto", views=3, magnifications=(1000.0,)).model.residual is None
    with pytest.raises(UnusableCalibrationError, match="rounding has made unsolvable"):
        _calibrate(WAVY, "on", views=3, magnifications=(1000.0,))


def test_modes_and_methods_are_checked():
    with pytest.raises(InvalidValueError, match="residual"):
        CalibrationOptions(residual="maybe")
    with pytest.raises(InvalidValueError, match='method "joint"'):
        CalibrationOptions(method="discrete", residual="on")


@pytest.mark.parametrize("instead", ["unsolvable", "lost corners", "found"])
def test_products_stay_where_a_field_cannot_take_their_place(instead, monkeypatch):
    """By what the parts of a selection return: no microscope of the fleet has come to this."""
    with_products = SimpleNamespace(functions={"xi_v": None})

    def add_field(setup, adjustment, *, always):
        if not always:
            return with_products, "a field", None
        if instead == "unsolvable":
            raise UnusableCalibrationError("equations of the residual field")
        return "plain", "a field" if instead == "found" else None, None

    monkeypatch.setattr(select, "select_and_adjust", lambda *_: "plain")
    monkeypatch.setattr(select, "_anneal", lambda _setup, noisy, adjustment: (noisy, adjustment))
    monkeypatch.setattr(select, "add_late_terms", lambda *_: with_products)
    monkeypatch.setattr(select, "_add_terms", lambda *_: "plain")
    monkeypatch.setattr(select, "_add_field", add_field)
    monkeypatch.setattr(select, "excess_px", lambda *_: 0.0)
    started = SimpleNamespace(setup=None, tempered=None, functions=None, state=None, spread=None)
    found = select.select(started, "auto")
    assert found.adjustment == ("plain" if instead == "found" else with_products)
    assert found.field == "a field"
