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

"""Calibrations without a grid, against the truth of a generator that shares no code with the method."""

from __future__ import annotations

import math

import numpy as np
import pytest

from semcal_ros.calibration import Calibration
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.ladder.from_specimen import (
    KnownLength,
    ScaleAnchor,
    SpecimenCalibration,
    calibrate_from_specimen,
)
from semcal_ros.core.ladder.matching import LadderPicture
from tests.helpers.ladders import SIZE, aligned_rms_px, camera_at, ladder_of, make_scope

STEPS = (5000.0, 7400.0, 11000.0, 16000.0)
AT, SIGMA = 7400.0, 0.004


@pytest.fixture(scope="module")
def made() -> SpecimenCalibration:
    scope = make_scope()
    known = ScaleAnchor(1.0 / camera_at(scope, AT).m, AT, SIGMA)
    return calibrate_from_specimen(ladder_of(scope, STEPS), known, display_width_m=scope.display_m)


@pytest.mark.long
def test_texture_alone_tells_distortion_and_the_ratios_of_scales(made: SpecimenCalibration) -> None:
    scope, model = make_scope(), made.model
    assert model.magnification_range == (STEPS[0], STEPS[-1])
    for g in (5500.0, 7000.0, 9000.0, 11500.0, 15000.0):
        camera, truth = model.at(g), camera_at(scope, g)
        # Three small pictures a step, 0.1 px a block and some 30 blocks a pair: some hundredths of a pixel.
        assert aligned_rms_px(model, scope, g) < 0.1
        # The known size is exact here; 2 in 10 000 is how well a magnification comes back, and a step or two off.
        assert camera.m / truth.m == pytest.approx(1.0, abs=1.5e-3)
        assert abs(camera.aspect - truth.aspect) < 4.0 * math.sqrt(camera.covariance[1, 1])


@pytest.mark.long
def test_the_scale_is_exactly_as_good_as_what_is_known(made: SpecimenCalibration) -> None:
    camera = made.model.at(AT)
    assert camera.m == pytest.approx(camera_at(make_scope(), AT).m, rel=1e-9)
    own = made.model.scale_sigma.relative(camera.rho)
    stated = math.sqrt(camera.covariance[0, 0]) / camera.m
    assert stated == pytest.approx(math.hypot(SIGMA, own), rel=1e-6)
    for g in STEPS:
        here = made.model.at(g)
        assert math.sqrt(here.covariance[0, 0]) / here.m >= stated * (1.0 - 1e-9)
    assert any(text.startswith("scale: all pixel sizes rest on") for text in made.weaknesses)
    assert Calibration.loads(Calibration.from_model(made.model).dumps()) == Calibration.from_model(
        made.model
    )


@pytest.mark.long
def test_a_known_length_is_a_known_pixel_size(made: SpecimenCalibration) -> None:
    scope = make_scope()
    ends = np.array([[40.0, 60.0], [210.0, 170.0]])
    x, y = scope.metres(AT, *ends.T)
    length = math.hypot(x[1] - x[0], y[1] - y[0])
    known = KnownLength(length, 3, (40.0, 60.0), (210.0, 170.0), SIGMA)
    anchor = known.as_anchor(made.model, AT)
    # A few hundredths of a pixel of 200.
    assert anchor.pixel_size_m == pytest.approx(1.0 / camera_at(scope, AT).m, rel=5e-4)
    assert anchor.sigma == pytest.approx(math.hypot(SIGMA, math.sqrt(0.5) / known.pixels))


def _blank(g: float) -> LadderPicture:
    return LadderPicture(np.zeros((SIZE, SIZE)), g)


def test_what_cannot_be_calibrated_is_refused() -> None:
    known = ScaleAnchor(1e-8, 6000.0, 0.01)
    with pytest.raises(CalibrationError, match="at 2 magnifications"):
        calibrate_from_specimen([_blank(5000.0), _blank(7000.0)], known, display_width_m=0.1)
    with pytest.raises(CalibrationError, match=r"gap in the ladder from 7000x to 14000x"):
        calibrate_from_specimen(
            [_blank(5000.0), _blank(7000.0), _blank(14000.0)], known, display_width_m=0.1
        )
    far = ScaleAnchor(1e-8, 50000.0, 0.01)
    with pytest.raises(InvalidValueError, match="50000x"):
        calibrate_from_specimen(
            [_blank(5000.0), _blank(7000.0), _blank(10000.0)], far, display_width_m=0.1
        )
    ladder = [_blank(5000.0), _blank(7000.0), _blank(10000.0)]
    for pixel_size_m in (1e-13, 1e-2):
        with pytest.raises(InvalidValueError, match=r"that is, a display of .* m; expected"):
            calibrate_from_specimen(
                ladder, ScaleAnchor(pixel_size_m, 5000.0, 0.01), display_width_m=0.1
            )
    for end in ((SIZE - 0.5, 10.0), (10.0, -1.0), (10.0, math.nan)):
        outside = KnownLength(1e-6, 0, (40.0, 60.0), end, 0.01)
        with pytest.raises(InvalidValueError, match="expected two pixels of the picture"):
            calibrate_from_specimen(ladder, outside, display_width_m=0.1)
    with pytest.raises(InvalidValueError, match="length of 5 px"):
        KnownLength(1e-6, 0, (10.0, 10.0), (13.0, 14.0), 0.01)
    with pytest.raises(InvalidValueError, match="sigma"):
        ScaleAnchor(1e-8, 5000.0, 0.5)
