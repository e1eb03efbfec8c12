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

"""Forecasts of the drift from what was known at one frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.drift.camera_uncertainty import scale_covariance
from semcal_ros.core.drift.estimates import DriftPath, DriftPredictor
from semcal_ros.core.drift.operations import Predict
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.state import initial_state
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.registration.failures import MatchFailure
from tests.helpers.drift_scenes import Texture, make_drift_update, noisy, small_camera

SIZE = 192
CAMERA = small_camera(1000.0, SIZE)
TEXTURE = Texture(3, 512)
VELOCITY = np.array([0.10e-6, -0.06e-6])


def feed(tracker: DriftTracker, first: int, last: int) -> None:
    for k in range(first, last):
        shift = CAMERA.m * VELOCITY * k
        picture = noisy(TEXTURE.view((shift[0], shift[1]), SIZE), 5.0, k)
        tracker.update(picture.astype(np.float32), float(k), CAMERA, rectified=True)


def test_a_forecast_holds_the_drift_to_come_within_its_sigma() -> None:
    tracker = DriftTracker()
    feed(tracker, 0, 20)
    predictor = tracker.predictor()
    assert predictor.time_s == 19.0
    sigmas = []
    for ahead_s in (0.0, 0.5, 2.0, 5.0):
        forecast = predictor.at(19.0 + ahead_s)
        sigma = np.sqrt(np.diag(forecast.covariance))
        error = forecast.drift_m - VELOCITY * forecast.time_s
        assert np.all(np.abs(error) < 4.0 * sigma[:2])
        np.testing.assert_array_equal(forecast.raster.position, forecast.drift_m)
        sigmas.append(sigma[0])
    assert sigmas == sorted(sigmas)
    # The drift is so steady that most of it is the noise of the first frame.
    assert sigmas[-1] > 1.1 * sigmas[0]


@pytest.mark.parametrize("ahead_s", [1e-3, 0.3, 20.0])
def test_a_forecast_is_what_the_filter_itself_would_predict(ahead_s: float) -> None:
    """The forecast is worked out in a shorter way than the filter's own step in time."""
    tracker = DriftTracker()
    feed(tracker, 0, 12)
    predictor = tracker.predictor()
    time_s = predictor.time_s + ahead_s
    forecast, state = (
        predictor.at(time_s),
        Predict(time_s)(predictor.state, predictor.process_noise),
    )
    covariance = state.drift_covariance + scale_covariance(
        predictor.camera, state.position, state.velocity
    )
    # Nothing but the order of rounding differs.
    np.testing.assert_allclose(forecast.drift_m, state.position, rtol=1e-12)
    np.testing.assert_allclose(forecast.velocity_m_s, state.velocity, rtol=1e-12)
    np.testing.assert_allclose(forecast.acceleration_m_s2, state.acceleration, rtol=1e-12)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(forecast.covariance / scale, covariance / scale, atol=1e-12)


def test_a_forecast_is_as_uncertain_as_the_scale_of_the_camera() -> None:
    spread = np.zeros((10, 10))
    spread[0, 0] = (0.02 * CAMERA.m) ** 2
    state = initial_state(0.0)
    state.mean[:4] = 3e-6, -4e-6, 0.1e-6, 0.0
    predictor = DriftPredictor(state, ProcessNoise(0.0), replace(CAMERA, covariance=spread))
    forecast = predictor.at(10.0)
    # 2 % of 3 + 10 x 0.1 and of 4 um; nothing else is uncertain here.
    sigma = np.sqrt(np.diag(forecast.covariance))
    np.testing.assert_allclose(sigma, [0.08e-6, 0.08e-6, 0.002e-6, 0.0], rtol=1e-9, atol=1e-20)


def test_what_follows_a_restart_is_not_trusted() -> None:
    lost = Rejection(MatchFailure.NO_PEAK, "lost")
    updates = [make_drift_update() for _ in range(5)]
    updates[1] = replace(updates[1], rejection=lost)
    updates[3] = replace(updates[3], restarted=True)
    assert DriftPath(updates).trusted.tolist() == [True, False, True, False, False]


def test_a_frame_that_is_found_with_one_from_before_a_restart_is_trusted() -> None:
    sigmas_px = (0.0, 0.02, 96.0, 96.0, 95.9, 0.02, 0.02)
    updates = [
        make_drift_update(covariance=sigma**2 * np.eye(6), restarted=k == 2)
        for k, sigma in enumerate(sigmas_px)
    ]
    trusted = [True, True, False, False, False, True, True]
    assert DriftPath(updates).trusted.tolist() == trusted
    # Where the time goes back, the drift begins anew at zero.
    updates[6] = replace(updates[6], restarted=True, covariance=np.zeros((6, 6)))
    assert DriftPath([*updates, updates[5]]).trusted.tolist() == [*trusted[:6], False, False]


def test_an_outlook_stays_as_it_was_while_tracking_goes_on() -> None:
    tracker = DriftTracker()
    feed(tracker, 0, 10)
    predictor = tracker.predictor()
    before = predictor.at(10.5)
    feed(tracker, 10, 14)
    again = predictor.at(10.5)
    np.testing.assert_array_equal(before.drift_m, again.drift_m)
    np.testing.assert_array_equal(before.covariance, again.covariance)
    # At its own time it says what the update said.
    update = tracker.update(
        noisy(TEXTURE.view((0.0, 0.0), SIZE), 5.0, 99).astype(np.float32), 14.0, CAMERA
    )
    now = tracker.predictor().at(14.0)
    np.testing.assert_allclose(now.drift_m, update.drift_m)
    np.testing.assert_allclose(now.velocity_m_s, update.velocity_m_s)


def test_what_cannot_be_foretold_is_refused() -> None:
    tracker = DriftTracker()
    with pytest.raises(InvalidValueError, match="before the first frame"):
        tracker.predictor()
    feed(tracker, 0, 2)
    for time_s in (0.5, float("nan"), float("inf")):
        with pytest.raises(InvalidValueError, match="after"):
            tracker.predictor().at(time_s)
