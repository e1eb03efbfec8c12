"""Drift trajectory of a whole recording, with hindsight.

The constant-velocity Kalman filter run forwards, then the Rauch-Tung-Striebel recursion backwards
(Rauch, Tung and Striebel 1965, doi:10.2514/3.3166). With white-noise acceleration the result is the
cubic smoothing spline through the measurements (Wahba 1978,
doi:10.1111/j.2517-6161.1978.tb01050.x), weighted by their covariances; its stiffness is the
maximum-likelihood one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.kalman import (
    DriftState,
    predict,
    process_noise,
    transition,
    update,
)

__all__ = ["DriftTrajectory", "smooth_trajectory"]

Array = NDArray[np.float64]

_OUTLIER_NIS = 25.0
_MAX_PASSES = 12
_NEIGHBOURS = 4
_MAX_FOR_LIKELIHOOD = 600
_LOG_RANGE = 18.0


@dataclass(frozen=True)
class DriftTrajectory:
    """Smoothed drift.

    Attributes
    ----------
    time_s
        (n,) times of the measurements.
    mean
        (n, 4) ``[x, y, vx, vy]``.
    covariance
        (n, 4, 4).
    used
        (n,) bool; false where a measurement was left out as an outlier.
    acceleration_psd
        Power spectral density of the acceleration, length^2 / s^3.
    """

    time_s: Array
    mean: Array
    covariance: Array
    used: NDArray[np.bool_]
    acceleration_psd: float
    filtered: tuple[DriftState, ...]

    def at(self, time_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Position (n, 2), velocity (n, 2) and covariance (n, 4, 4) of ``[x, y, vx, vy]`` at any
        times (n,).

        After the last measurement this is the forecast, before the first one the backcast, with
        growing covariance.
        """
        times = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        states = [self._at(float(t)) for t in times]
        mean = np.array([s.mean for s in states]).reshape(-1, 4)
        covariance = np.array([s.covariance for s in states]).reshape(-1, 4, 4)
        return mean[:, :2], mean[:, 2:], covariance

    def _at(self, time_s: float) -> DriftState:
        index = int(np.searchsorted(self.time_s, time_s, side="right")) - 1
        if index < 0:
            move = transition(time_s - float(self.time_s[0]))
            spread = move @ self.covariance[0] @ move.T
            # Backwards in time the noise has the same size, position and velocity correlate with
            # the other sign.
            noise = process_noise(float(self.time_s[0]) - time_s, self.acceleration_psd)
            sign = np.array([1.0, 1.0, -1.0, -1.0])
            return DriftState(time_s, move @ self.mean[0], spread + noise * np.outer(sign, sign))
        if time_s == float(self.time_s[index]):
            return DriftState(time_s, self.mean[index], self.covariance[index])
        here = predict(self.filtered[index], time_s, self.acceleration_psd)
        if index == len(self.time_s) - 1:
            return here
        after = DriftState(
            float(self.time_s[index + 1]), self.mean[index + 1], self.covariance[index + 1]
        )
        return _step_back(here, after, self.acceleration_psd)


def smooth_trajectory(
    time_s: ArrayLike,
    positions: ArrayLike,
    covariances: ArrayLike,
    *,
    acceleration_psd: float | None = None,
) -> DriftTrajectory:
    """Smooth measured drifts.

    Parameters
    ----------
    time_s
        (n,) strictly increasing times, at least 2.
    positions
        (n, 2) measured drift; rows with NaN (rejected registrations) count as not measured.
    covariances
        (n, 2, 2) of the positions.
    acceleration_psd
        Stiffness, length^2 / s^3; None estimates it by maximum likelihood.

    Raises
    ------
    InvalidValueError
        If shapes do not fit, times do not increase, or fewer than 2 positions were measured.
    """
    times, measured, noise = _checked(time_s, positions, covariances)
    used = np.all(np.isfinite(measured), axis=1) & np.all(np.isfinite(noise), axis=(1, 2))
    if np.count_nonzero(used) < 2:
        raise InvalidValueError(f"{np.count_nonzero(used)} measured drifts", expected="at least 2")
    psd = 0.0
    for _ in range(_MAX_PASSES):
        psd = (
            _likely_psd(times, measured, noise, used)
            if acceleration_psd is None
            else acceleration_psd
        )
        filtered, _ = _forwards(times, measured, noise, used, psd)
        smooth = _backwards(filtered, psd)
        outliers = used & _outlying(smooth, measured, noise, used)
        if not np.any(outliers) or np.count_nonzero(used & ~outliers) < 2:
            break
        used = used & ~outliers
    return DriftTrajectory(
        time_s=times,
        mean=np.array([s.mean for s in smooth]),
        covariance=np.array([s.covariance for s in smooth]),
        used=used,
        acceleration_psd=psd,
        filtered=tuple(filtered),
    )


def _checked(
    time_s: ArrayLike, positions: ArrayLike, covariances: ArrayLike
) -> tuple[Array, Array, Array]:
    times = np.asarray(time_s, dtype=np.float64)
    measured = np.asarray(positions, dtype=np.float64)
    noise = np.asarray(covariances, dtype=np.float64)
    n = times.size
    if times.shape != (n,) or measured.shape != (n, 2) or noise.shape != (n, 2, 2):
        raise InvalidValueError(
            f"times {times.shape}, positions {measured.shape}, covariances {noise.shape}",
            expected="(n,), (n, 2) and (n, 2, 2)",
        )
    if not np.all(np.diff(times) > 0.0):
        raise InvalidValueError(
            "times that do not increase", expected="strictly increasing times", do="sort them"
        )
    return times, measured, noise


def _start(times: Array, measured: Array, noise: Array, used: NDArray[np.bool_]) -> DriftState:
    """A prior that is wide against everything that was measured."""
    seen = measured[used]
    span = float(times[used][-1] - times[used][0])
    extent = float(np.max(np.ptp(seen, axis=0))) + float(np.sqrt(np.max(noise[used])))
    steps = np.abs(np.diff(seen, axis=0)) / np.diff(times[used])[:, None]
    speed = float(np.max(steps)) + extent / span
    variance = np.array([extent, extent, speed, speed]) ** 2 * 100.0
    return DriftState(float(times[0]), np.append(seen[0], [0.0, 0.0]), np.diag(variance))


def _forwards(
    times: Array,
    measured: Array,
    noise: Array,
    used: NDArray[np.bool_],
    psd: float,
    gate: float | None = None,
) -> tuple[list[DriftState], float]:
    """Filtered states, and minus twice the log likelihood of the measurements after the first
    two.
    """
    state = _start(times, measured, noise, used)
    filtered, cost, count = [], 0.0, 0
    for k, time in enumerate(times):
        state = predict(state, float(time), psd)
        if used[k]:
            outcome = update(state, measured[k], noise[k], gate)
            state = outcome.state
            count += 1
            if count > 2:
                size = float(np.linalg.det(outcome.innovation_covariance))
                cost += min(outcome.nis, _OUTLIER_NIS) + float(np.log(size))
        filtered.append(state)
    return filtered, cost


def _step_back(filtered: DriftState, after: DriftState, psd: float) -> DriftState:
    """Rauch-Tung-Striebel step from the smoothed later state to the earlier one."""
    dt = after.time_s - filtered.time_s
    move = transition(dt)
    predicted = move @ filtered.covariance @ move.T + process_noise(dt, psd)
    # Scaled to unit variances: metres and metres per second differ by orders of magnitude.
    scale = np.sqrt(np.diag(predicted))
    scaled = predicted / np.outer(scale, scale)
    gain = (
        np.linalg.lstsq(scaled, (move @ filtered.covariance) / scale[:, None], rcond=1e-14)[0].T
        / scale
    )
    mean = filtered.mean + gain @ (after.mean - move @ filtered.mean)
    covariance = filtered.covariance + gain @ (after.covariance - predicted) @ gain.T
    return DriftState(filtered.time_s, mean, 0.5 * (covariance + covariance.T))


def _backwards(filtered: list[DriftState], psd: float) -> list[DriftState]:
    smooth = [filtered[-1]]
    for state in reversed(filtered[:-1]):
        smooth.append(_step_back(state, smooth[-1], psd))
    return smooth[::-1]


def _outlying(
    smooth: list[DriftState], measured: Array, noise: Array, used: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Measurements that miss the trajectory they helped to make by five deviations of what is left
    to judge them by, and by more than their neighbours.
    """
    excess = np.zeros(len(smooth))
    for k in np.flatnonzero(used):
        miss = measured[k] - smooth[k].position
        left = noise[k] - smooth[k].covariance[:2, :2]
        # A measurement that alone determines its smoothed value cannot be judged by it.
        if np.min(np.linalg.eigvalsh(left)) <= 0.05 * float(np.min(np.diag(noise[k]))):
            continue
        excess[k] = float(miss @ np.linalg.solve(left, miss))
    # An outlier bends the path away from its neighbours, which are not to blame.
    reach = range(-_NEIGHBOURS, _NEIGHBOURS + 1)
    padded = np.pad(excess, _NEIGHBOURS)
    count = len(excess)
    highest = np.max([padded[_NEIGHBOURS + r : _NEIGHBOURS + r + count] for r in reach], axis=0)
    return np.asarray((excess > _OUTLIER_NIS) & (excess >= highest))


def _likely_psd(times: Array, measured: Array, noise: Array, used: NDArray[np.bool_]) -> float:
    """Maximum-likelihood stiffness, by golden-section search over its logarithm."""
    count = min(len(times), _MAX_FOR_LIKELIHOOD)
    part = slice(0, count)
    if np.count_nonzero(used[part]) < 4:
        part = slice(0, len(times))
    interval = float(np.median(np.diff(times)))
    speed = np.diff(measured[used], axis=0) / np.diff(times[used])[:, None]
    scale = float(np.mean(speed**2)) / interval + 1e-300
    middle = float(np.log(scale))

    def cost(log_psd: float) -> float:
        # The gate keeps a few outliers from making the path look restless.
        given = times[part], measured[part], noise[part], used[part]
        return _forwards(*given, float(np.exp(log_psd)), _OUTLIER_NIS)[1]

    grid = middle + np.linspace(-_LOG_RANGE, 0.3 * _LOG_RANGE, 10)
    costs = [cost(float(v)) for v in grid]
    best = int(np.argmin(costs))
    low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)])
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    cost_a, cost_b = cost(a), cost(b)
    for _ in range(8):
        if cost_a < cost_b:
            high, b, cost_b = b, a, cost_a
            a = high - ratio * (high - low)
            cost_a = cost(a)
        else:
            low, a, cost_a = a, b, cost_b
            b = low + ratio * (high - low)
            cost_b = cost(b)
    return float(np.exp(0.5 * (low + high)))
