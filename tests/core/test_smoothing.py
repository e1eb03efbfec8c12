"""The offline smoother against known trajectories."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.smoothing import smooth_trajectory

UNIT = 1e-9


def _recording(n: int, sigma: float, seed: int) -> tuple[np.ndarray, ...]:
    """Times, noisy positions, covariances and a truth function, in metres."""
    times = np.cumsum(np.random.default_rng(seed).uniform(0.4, 0.6, n))

    def truth(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        position = np.stack([3.0 * t + 20.0 * np.sin(t / 5.0), -2.0 * t], axis=1) * UNIT
        velocity = np.stack([3.0 + 4.0 * np.cos(t / 5.0), np.full_like(t, -2.0)], axis=1) * UNIT
        return position, velocity

    noise = sigma * UNIT * np.random.default_rng(seed + 1).standard_normal((n, 2))
    covariances = np.broadcast_to((sigma * UNIT) ** 2 * np.eye(2), (n, 2, 2)).copy()
    return times, truth(times)[0] + noise, covariances, truth


def test_position_and_velocity_between_the_measurements() -> None:
    times, measured, covariances, truth = _recording(120, 1.0, 0)
    path = smooth_trajectory(times, measured, covariances)
    between = np.linspace(times[3], times[-4], 301)
    position, velocity, covariance = path.at(between)
    error = position - truth(between)[0]
    # Smoothing over several frames beats the noise of one.
    assert np.sqrt(np.mean(error**2)) < 0.6 * UNIT
    assert np.sqrt(np.mean((velocity - truth(between)[1]) ** 2)) < 0.7 * UNIT
    stated = np.sqrt(np.stack([covariance[:, 0, 0], covariance[:, 1, 1]], axis=1))
    # Neighbours correlate, so that the share is known to about 10 %; one stiffness serves both
    # axes, which overstates the straight one.
    assert 0.5 < np.mean(np.abs(error) < stated) < 0.99
    assert np.mean(np.abs(error) < 3.0 * stated) > 0.97


def test_agrees_with_a_straight_line_fit_for_a_stiff_path() -> None:
    rng = np.random.default_rng(2)
    times = np.arange(40.0)
    measured = np.stack([2.0 * times + 1.0, 5.0 - times], axis=1) + rng.standard_normal((40, 2))
    path = smooth_trajectory(
        times, measured, np.tile(np.eye(2), (40, 1, 1)), acceleration_psd=1e-12
    )
    for axis in (0, 1):
        line = np.polyval(np.polyfit(times, measured[:, axis], 1), times)
        np.testing.assert_allclose(path.mean[:, axis], line, atol=2e-3)
    # Variance of a straight line's end: (4 n - 2) / (n (n + 1)).
    assert path.covariance[-1, 0, 0] == pytest.approx(158.0 / 1640.0, rel=1e-2)


def test_outliers_and_gaps_do_not_bend_the_path() -> None:
    times, measured, covariances, truth = _recording(100, 1.0, 3)
    measured[40] += 60.0 * UNIT
    measured[60:64] = np.nan
    path = smooth_trajectory(times, measured, covariances)
    assert not path.used[40]
    assert not np.any(path.used[60:64])
    assert np.count_nonzero(~path.used) <= 6
    error = path.mean[:, :2] - truth(times)[0]
    assert np.max(np.abs(error)) < 3.5 * UNIT
    assert path.covariance[62, 0, 0] > 1.5 * path.covariance[50, 0, 0]


def test_forecast_and_backcast_grow_uncertain() -> None:
    times, measured, covariances, truth = _recording(80, 1.0, 4)
    path = smooth_trajectory(times, measured, covariances)
    ahead = times[-1] + np.array([0.0, 1.0, 3.0])
    behind = times[0] - np.array([0.0, 1.0, 3.0])
    for at in (ahead, behind):
        position, _, covariance = path.at(at)
        assert np.all(np.diff(covariance[:, 0, 0]) > 0.0)
        sigma = np.sqrt(np.stack([covariance[:, 0, 0], covariance[:, 1, 1]], axis=1))
        assert np.all(np.abs(position - truth(at)[0]) < 4.0 * sigma)


def test_bad_input_is_refused() -> None:
    times, measured, covariances, _ = _recording(5, 1.0, 0)
    with pytest.raises(InvalidValueError, match="increase"):
        smooth_trajectory(times[::-1], measured, covariances)
    with pytest.raises(InvalidValueError, match=r"\(n, 2\)"):
        smooth_trajectory(times, measured[:, :1], covariances)
    with pytest.raises(InvalidValueError, match="at least 2"):
        smooth_trajectory(times, measured * np.nan, covariances)
