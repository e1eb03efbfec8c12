"""The constant-velocity filter against hand-made answers and its own statistics."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.kalman import DriftState, predict, process_noise, update

START = DriftState(1.0, np.array([1.0, 2.0, 0.5, -1.0]), np.diag([4.0, 4.0, 1.0, 1.0]))


def test_prediction_moves_with_the_velocity_and_widens() -> None:
    later = predict(START, 3.0, 0.3)
    np.testing.assert_allclose(later.mean, [2.0, 0.0, 0.5, -1.0])
    assert later.time_s == 3.0
    # 4 + dt^2 * 1 + q dt^3 / 3, and the velocity's 1 + q dt, with dt = 2.
    assert later.covariance[0, 0] == pytest.approx(8.0 + 0.3 * 8.0 / 3.0)
    assert later.covariance[3, 3] == pytest.approx(1.0 + 0.3 * 2.0)
    assert later.covariance[0, 2] == pytest.approx(2.0 + 0.3 * 2.0)
    assert later.covariance[0, 1] == 0.0


def test_prediction_in_two_steps_equals_one() -> None:
    once, twice = predict(START, 4.0, 0.7), predict(predict(START, 1.9, 0.7), 4.0, 0.7)
    np.testing.assert_allclose(once.covariance, twice.covariance, rtol=1e-12)
    np.testing.assert_allclose(once.mean, twice.mean, rtol=1e-12)


def test_update_weighs_by_variance() -> None:
    # Prior variance 4, measurement variance 4: half way.
    outcome = update(START, [3.0, 2.0], 4.0 * np.eye(2))
    np.testing.assert_allclose(outcome.state.mean, [2.0, 2.0, 0.5, -1.0])
    assert outcome.state.covariance[0, 0] == pytest.approx(2.0)
    np.testing.assert_allclose(outcome.innovation, [2.0, 0.0])
    assert outcome.nis == pytest.approx(4.0 / 8.0)
    # The prior state is untouched: pure functions.
    np.testing.assert_allclose(START.mean, [1.0, 2.0, 0.5, -1.0])


def test_gate_keeps_the_prediction() -> None:
    outcome = update(START, [101.0, 2.0], np.eye(2), gate=25.0)
    assert not outcome.accepted
    assert outcome.state is START
    assert outcome.nis == pytest.approx(2000.0)


def test_innovations_are_consistent_and_velocity_is_found() -> None:
    rng = np.random.default_rng(5)
    psd, sigma, dt = 0.05, 0.3, 0.7
    truth = np.array([0.0, 0.0, 1.5, -0.8])
    state = DriftState(0.0, np.zeros(4), np.diag([1.0, 1.0, 4.0, 4.0]))
    root = np.linalg.cholesky(process_noise(dt, psd))
    nis, nees = [], []
    for k in range(1, 400):
        truth = truth + dt * np.append(truth[2:], [0.0, 0.0]) + root @ rng.standard_normal(4)
        z = truth[:2] + sigma * rng.standard_normal(2)
        outcome = update(predict(state, k * dt, psd), z, sigma**2 * np.eye(2))
        state = outcome.state
        nis.append(outcome.nis)
        away = state.mean - truth
        nees.append(float(away @ np.linalg.solve(state.covariance, away)))
    # Chi-square means 2 and 4 with standard errors 0.1 and about 0.3 (errors in time correlate).
    assert np.mean(nis) == pytest.approx(2.0, abs=0.4)
    assert np.mean(nees) == pytest.approx(4.0, abs=1.0)
    assert np.all(np.linalg.eigvalsh(state.covariance) > 0.0)


def test_bad_input_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="later time"):
        predict(START, 0.5, 1.0)
    with pytest.raises(InvalidValueError, match="density"):
        predict(START, 2.0, -1.0)
    with pytest.raises(InvalidValueError, match="finite"):
        update(START, [np.nan, 0.0], np.eye(2))
    with pytest.raises(InvalidValueError, match="positive definite"):
        update(START, [0.0, 0.0], -10.0 * np.eye(2))
