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

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.update import CalibrationUpdate, update_calibration
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.projection import ALL_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from tests.core.calibration.test_check import (
    AXIS,
    CHECKED,
    SEM,
    VISITS,
    Camera,
    calibrated,
    changed,
    simulated,
)
from tests.helpers.long_tests import long_but

__all__ = ["calibrated"]  # the fixture

EVERYWHERE = (250.0, 700.0, 2000.0, 5500.0)


def update(
    calibrated: CalibrationResult, camera: Camera, seed: int, **options: float
) -> CalibrationUpdate:
    views = simulated(camera, CHECKED, seed)
    return update_calibration(
        calibrated.model, views, image_size=SEM.image_size, axis=AXIS, **options
    )


def deviations(model: CalibrationModel, camera: Camera) -> np.ndarray:
    """Errors of nm per pixel over their 1-sigma, at all magnifications and along both axes."""
    out = []
    for g in EVERYWHERE:
        ours, true = model.at(g), camera(g)
        error = np.subtract(ours.pixel_size_m, true.pixel_size_m)
        out.append(error / ours.pixel_size_sigma_m)
    return np.array(out)


@pytest.mark.parametrize(
    "by", long_but(lambda by: "m" in by, [{"m": 0.005}, {"aspect": 0.002}, {"ex": 15.0}])
)
def test_a_few_views_are_enough_for_what_all_magnifications_share(
    calibrated: CalibrationResult, by: dict[str, float]
) -> None:
    camera = changed(**by)
    done = update(calibrated, camera, 60)
    assert np.max(np.abs(deviations(done.model, camera))) < 3.0
    # Nine views at three visits: the repeatability of the visits, and nothing else, is what limits them.
    sigmas = [max(done.model.at(g).pixel_size_sigma_m) * camera(g).m for g in EVERYWHERE]
    assert max(sigmas) < 2.5e-3
    if "ex" in by:
        before, after, true = (m(2000.0) for m in (calibrated.model.at, done.model.at, camera))
        assert abs(before.ex - true.ex) > 10.0
        assert abs(after.ex - true.ex) < 3.0
    log = done.model.statistics["updates"]
    assert [entry["views"] for entry in log] == [9]


def with_distortion_times(factor: float) -> Camera:
    def camera(g: float) -> ScanCamera:
        own = SEM.camera_at(g)
        return replace(own, xi_r=factor * own.xi_r, xi_t=factor * own.xi_t)

    return camera


DISTORTIONS: dict[str, Camera] = {
    "doubled": with_distortion_times(2.0),
    "halved": with_distortion_times(0.5),
    "more by the same everywhere": changed(xi_r=0.004),
    "decentred along the other diagonal": changed(xi_u=0.002),
}


@pytest.mark.parametrize(
    "case",
    long_but(
        lambda case: case in (("doubled", CHECKED), ("more by the same everywhere", (300.0,))),
        itertools.product(DISTORTIONS, ((300.0,), (2000.0,), CHECKED)),
    ),
)
def test_a_distortion_may_have_changed_in_proportion_or_by_the_same_everywhere(
    calibrated: CalibrationResult, case: tuple[str, tuple[float, ...]]
) -> None:
    """It is a third as large at 5000x as at 200x: views at one magnification do not tell what became of it at another.

    Where that was taken for an equal change, xi_r was off by up to 67 stated sigmas.
    """
    camera, magnifications = DISTORTIONS[case[0]], case[1]
    done = update_calibration(
        calibrated.model,
        simulated(camera, magnifications, 70),
        image_size=SEM.image_size,
        axis=AXIS,
    )
    assert [change.name for change in done.check.changes] == ["distortion"]
    for g in (200.0, *EVERYWHERE):
        ours, true = done.model.at(g), camera(g)
        names = ("xi_r", "xi_t", "xi_u")
        error = np.array([getattr(ours, name) - getattr(true, name) for name in names])
        rows = [ALL_NAMES.index(name) for name in names]
        # Of some 180 that are not independent, one is beyond 3.5 by chance in ten.
        assert np.all(np.abs(error) < 3.5 * np.sqrt(np.diag(ours.covariance)[rows]))
    # Where the views are, it is as certain as they make it.
    seen = done.model.at(magnifications[0])
    assert np.sqrt(seen.covariance[6, 6]) < 0.1 * camera(magnifications[0]).xi_r


@pytest.mark.long
def test_the_stated_uncertainty_after_an_update_is_honest(calibrated: CalibrationResult) -> None:
    camera = changed(m=-0.004)
    z = np.concatenate(
        [deviations(update(calibrated, camera, 80 + k).model, camera) for k in range(4)]
    )
    # The calibration's own error of 6000x is common to all four.
    assert 0.3 < np.sqrt(np.mean(z**2)) < 1.6


def test_without_ageing_only_what_has_changed_moves(calibrated: CalibrationResult) -> None:
    done = update(calibrated, changed(aspect=0.002), 90, ageing=0.0)
    assert [change.name for change in done.check.changes] == ["aspect"]
    (aspect,) = done.check.changes[0].values
    assert aspect == pytest.approx(0.002, abs=3.0 * done.check.changes[0].sigmas[0])
    for g in EVERYWHERE:
        before, after = calibrated.model.at(g), done.model.at(g)
        sigma = np.sqrt(np.diag(before.covariance))
        moved = np.abs(np.subtract(after.parameters, before.parameters))
        # A term that the camera does not have has neither a value nor a sigma.
        assert np.all(np.delete(moved <= 3.0 * sigma, 1))
        error = after.aspect - changed(aspect=0.002)(g).aspect
        assert abs(error) < 3.0 * np.sqrt(after.covariance[1, 1])
        # New views make nothing less certain.
        assert np.all(
            np.diag(after.covariance)[[0, 2, 6, 7, 8, 9]] <= 1.01 * sigma[[0, 2, 6, 7, 8, 9]] ** 2
        )


@pytest.mark.long
def test_a_second_update_continues_from_the_first(calibrated: CalibrationResult) -> None:
    camera = changed(m=0.005)
    first = update(calibrated, camera, 60)
    second = update_calibration(
        first.model,
        simulated(camera, CHECKED, 61),
        image_size=SEM.image_size,
        axis=AXIS,
        ageing=0.0,
    )
    for g in EVERYWHERE:
        assert (
            second.model.at(g).pixel_size_sigma_m[0]
            < 1.001 * first.model.at(g).pixel_size_sigma_m[0]
        )
    assert np.max(np.abs(deviations(second.model, camera))) < 3.0
    assert len(second.model.statistics["updates"]) == 2
    # What was added to the first is not changed by the second.
    assert len(first.model.statistics["updates"]) == 1


@pytest.mark.parametrize("noise_px", long_but(lambda noise_px: noise_px == 0.3, [0.0, 0.3]))
def test_residuals_that_nothing_explains_are_warned_of_until_the_next_update(
    calibrated: CalibrationResult, noise_px: float
) -> None:
    rng = np.random.default_rng(5)
    views = [
        replace(v, image_xy=v.image_xy + rng.normal(0.0, noise_px, v.image_xy.shape))
        for v in simulated(SEM.camera_at, CHECKED, 66)
    ]
    done = update_calibration(calibrated.model, views, image_size=SEM.image_size, axis=AXIS)
    old = list(calibrated.model.statistics["warnings"])
    warnings = list(done.model.statistics["warnings"])
    assert warnings[: len(old)] == old
    new = [text for text in warnings if text.startswith("scale: residuals of the update are")]
    assert len(new) == (noise_px > 0.0)
    views = simulated(SEM.camera_at, CHECKED, 67)
    after = update_calibration(done.model, views, image_size=SEM.image_size, axis=AXIS)
    assert list(after.model.statistics["warnings"]) == old


def test_what_a_few_views_do_not_renew_is_refused_by_its_name(
    calibrated: CalibrationResult,
) -> None:
    """Taken for a change of the distortion, a settling of 48 columns was renewed to a camera that is 1.3 px off."""
    with pytest.raises(CalibrationError, match=r"a change of settling.*; calibrate anew"):
        update(calibrated, changed(settling_5=3.0 / 256.0), 60)


def test_contradictions_and_impossible_ageing_are_refused(calibrated: CalibrationResult) -> None:
    with pytest.raises(CalibrationError, match=r"scale is \+2\d\.\d % off .*--squares"):
        update(calibrated, changed(m=0.25), 62)
    with pytest.raises(InvalidValueError, match=r"an ageing of 0\.5; expected 0 to 0\.1"):
        update(calibrated, SEM.camera_at, 62, ageing=0.5)


@pytest.mark.long
def test_the_residual_field_keeps_its_values_and_its_uncertainty() -> None:
    """It is taken out of the views as it is, so that they say nothing of it."""
    before = calibrate_views(
        simulated(SEM.camera_at, VISITS, 1),
        image_size=SEM.image_size,
        display_width_m=SEM.display_width_m,
        options=CalibrationOptions(axis=AXIS, residual="on"),
    ).model
    assert before.residual is not None
    done = update_calibration(
        before, simulated(SEM.camera_at, CHECKED, 60), image_size=SEM.image_size, axis=AXIS
    ).model
    field = before.residual.size
    old, new = before.covariance[-field:, -field:], done.covariance[-field:, -field:]
    assert np.allclose(new, old, rtol=1e-9, atol=1e-9 * np.max(np.abs(old)))
    assert np.array_equal(done.residual.coefficients, before.residual.coefficients)
    # With that of the functions it is still a covariance: no correlation exceeds 1.
    sigma = np.sqrt(np.diag(done.covariance))
    known = sigma > 0.0
    correlation = (done.covariance / np.outer(sigma + ~known, sigma + ~known))[np.ix_(known, known)]
    assert np.linalg.eigvalsh(correlation).min() > -1e-6
