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

"""Difference of two calibrations: known changes are found with their size, and chance is not called a change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.judgement.compare import compare_calibrations
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.errors import InvalidValueError
from tests.core.calibration.test_check import AXIS, SEM, simulated
from tests.helpers.made_once import made_once

MAGNIFICATIONS = (300.0, 1000.0, 3000.0)


def calibrated(seed: int) -> CalibrationModel:
    views = simulated(SEM.camera_at, MAGNIFICATIONS, seed)
    return calibrate_views(
        views,
        image_size=SEM.image_size,
        display_width_m=SEM.display_width_m,
        options=CalibrationOptions(axis=AXIS),
    ).model


@pytest.fixture(scope="module")
def model() -> CalibrationModel:
    return made_once("calibrated-to-compare", lambda: calibrated(1))


def changed(
    model: CalibrationModel, name: str, factor: float, add: float = 0.0
) -> CalibrationModel:
    function = model.functions[name]
    coefficients = factor * function.coefficients
    coefficients[0] += add
    return replace(
        model, functions={**model.functions, name: replace(function, coefficients=coefficients)}
    )


def test_a_calibration_agrees_with_itself(model: CalibrationModel) -> None:
    found = compare_calibrations(model, model)
    assert found.agree and found.largest_sigmas < 1e-6
    assert max(one.worst_px for one in found.at) < 1e-9


def test_a_change_of_the_scale_has_its_size_and_sign(model: CalibrationModel) -> None:
    found = compare_calibrations(model, changed(model, "scale", 1.01))
    assert not found.agree
    for one in found.at:
        # More px per m are fewer nm per px.
        assert one.scale == pytest.approx(1.0 / 1.01 - 1.0, rel=1e-9)
        corner = 0.5 * np.hypot(SEM.image_size[0] - 1, SEM.image_size[1] - 1)
        assert one.worst_px == pytest.approx(0.01 * corner, rel=0.05)


def test_a_shift_of_the_principal_point_is_no_difference(model: CalibrationModel) -> None:
    """At a height of zero it is a shift of the specimen, which is then distorted as before."""
    moved = changed(model, "px", 1.0, 4.0)
    assert max(one.worst_px for one in compare_calibrations(model, moved).at) < 1e-6


def test_a_distortion_has_its_size(model: CalibrationModel) -> None:
    found = compare_calibrations(model, changed(model, "xi_r", 1.0, 1e-3))
    half, camera = 0.5 * SEM.image_size[0], model.at(found.at[1].magnification)
    corners = np.array([[x, y] for x in (0.0, 2.0 * half) for y in (0.0, 2.0 * half)])
    r = np.linalg.norm(corners - [camera.ex, camera.ey], axis=1).max() / half
    # xi r^3 half widths at the farthest corner, less the shift of the image centre, which is near the axis.
    assert found.at[1].worst_px == pytest.approx(1e-3 * r**3 * half, rel=0.1)
    assert found.at[1].scale == pytest.approx(0.0, abs=1e-12)


def test_an_aspect_is_not_hidden_by_an_uncertain_scale(model: CalibrationModel) -> None:
    found = compare_calibrations(model, changed(model, "aspect", 1.002))
    assert not found.agree
    for one in found.at:
        # Half the difference along each axis: 0.002 of the distance from the centre, but for a scale.
        x, y = (one.xy - one.xy.mean(axis=0)).T
        np.testing.assert_allclose(one.shape_px, 0.002 * np.stack([x, -y], 1), atol=0.03)
    # The scale is known to 0.25 % there, which is more than that.
    worst = max(found.at, key=lambda one: one.field_sigmas)
    hidden = np.linalg.norm(worst.difference_px, axis=1) / worst.sigma_px
    assert worst.field_sigmas > 2.0 * np.nanmax(hidden)


@pytest.mark.slow
@pytest.mark.long
def test_other_views_of_one_microscope_agree(model: CalibrationModel) -> None:
    others = [compare_calibrations(model, calibrated(seed)) for seed in range(2, 6)]
    # The limit is reached by chance in one comparison of a hundred.
    assert all(found.agree for found in others)
    # The joint sigma is not so large that nothing would ever differ.
    scale = [one.scale_sigmas for found in others for one in found.at]
    assert 0.3 < np.sqrt(np.mean(np.square(scale))) < 1.6


def test_other_image_sizes_and_displays_are_the_same_field(model: CalibrationModel) -> None:
    """Magnification 500 on a display of half the width is the field of 1000."""
    functions = {
        name: replace(f, g_range=(0.5 * f.g_range[0], 0.5 * f.g_range[1]), shape=0.5 * f.shape)
        for name, f in model.functions.items()
    }
    half = replace(
        model,
        functions=functions,
        display_width_m=0.5 * model.display_width_m,
        magnifications=tuple(0.5 * g for g in model.magnifications),
    )
    found = compare_calibrations(model, half)
    assert max(abs(one.scale) for one in found.at) < 1e-9


def test_what_cannot_be_compared_is_refused(model: CalibrationModel) -> None:
    with pytest.raises(InvalidValueError, match="expected ranges that overlap"):
        far = replace(model, magnifications=(5000.0, 9000.0))
        compare_calibrations(model, far)
    with pytest.raises(InvalidValueError, match="same proportions"):
        compare_calibrations(model, replace(model, image_height=2 * model.image_height))
    with pytest.raises(InvalidValueError, match="magnification 10000"):
        compare_calibrations(model, model, [10000.0])


def test_the_same_recording_is_told(model: CalibrationModel) -> None:
    known = replace(model, provenance=replace(model.provenance, recording_sha256="ab"))
    assert compare_calibrations(known, known).same_recording is True
    assert compare_calibrations(model, known).same_recording is None
