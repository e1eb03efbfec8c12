"""Constant-velocity Kalman filter of a drift in two dimensions.

The state is ``[x, y, vx, vy]`` in any length unit (metres with a calibration, pixels without) and
seconds. The drift's acceleration is white noise of power spectral density ``q`` (length^2 / s^3),
so over an interval dt

    F = [[1, dt], [0, 1]],    Q = q [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]]

per axis (Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2, doi:10.1002/0471221279). All functions
are pure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.errors import InvalidValueError

__all__ = ["DriftState", "KalmanUpdate", "predict", "process_noise", "transition", "update"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DriftState:
    """Drift and velocity at one time.

    Attributes
    ----------
    time_s
        Time of the state, s.
    mean
        (4,) ``[x, y, vx, vy]``.
    covariance
        (4, 4) of ``mean``.
    """

    time_s: float
    mean: Array
    covariance: Array

    @property
    def position(self) -> Array:
        """(2,) drift."""
        return self.mean[:2]

    @property
    def velocity(self) -> Array:
        """(2,) drift velocity, per s."""
        return self.mean[2:]


@dataclass(frozen=True)
class KalmanUpdate:
    """Outcome of :func:`update`.

    Attributes
    ----------
    state
        The updated state, or the unchanged one where the gate refused the measurement.
    innovation
        (2,) measurement minus prediction.
    innovation_covariance
        (2, 2) what the prediction and the measurement noise lead one to expect.
    nis
        Normalised innovation squared; chi-square with 2 degrees of freedom when all is well.
    accepted
        Whether the measurement was used.
    """

    state: DriftState
    innovation: Array
    innovation_covariance: Array
    nis: float
    accepted: bool


def transition(dt_s: float) -> Array:
    """(4, 4) matrix that carries a state over ``dt_s`` seconds."""
    matrix = np.eye(4)
    matrix[0, 2] = matrix[1, 3] = dt_s
    return matrix


def process_noise(dt_s: float, acceleration_psd: float) -> Array:
    """(4, 4) covariance that the white acceleration adds over ``dt_s`` seconds."""
    one = np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    return np.kron(one, np.eye(2)) * acceleration_psd


def predict(state: DriftState, time_s: float, acceleration_psd: float) -> DriftState:
    """The state at a later time.

    Raises
    ------
    InvalidValueError
        If ``time_s`` is earlier than the state, or the noise density is negative.
    """
    dt = time_s - state.time_s
    if not dt >= 0.0:
        raise InvalidValueError(
            f"a prediction from {state.time_s} s to {time_s} s", expected="a later time"
        )
    if not acceleration_psd >= 0.0:
        raise InvalidValueError(
            f"acceleration noise density {acceleration_psd}", expected="a number >= 0"
        )
    move = transition(dt)
    covariance = move @ state.covariance @ move.T + process_noise(dt, acceleration_psd)
    return DriftState(time_s, move @ state.mean, covariance)


def update(
    state: DriftState, z: ArrayLike, R: ArrayLike, gate: float | None = None
) -> KalmanUpdate:
    """Use a position measurement, unless it is too far from the prediction.

    Parameters
    ----------
    state
        Predicted state at the time of the measurement.
    z, R
        (2,) measured position and its (2, 2) covariance.
    gate
        Largest normalised innovation squared that is accepted; None accepts all.

    Raises
    ------
    InvalidValueError
        If the measurement is not finite or the covariance is not positive definite.
    """
    measured, noise = np.asarray(z, dtype=np.float64), np.asarray(R, dtype=np.float64)
    if measured.shape != (2,) or noise.shape != (2, 2) or not np.all(np.isfinite(measured)):
        raise InvalidValueError(
            f"measurement {measured.tolist()} with covariance of shape {noise.shape}",
            expected="a finite (2,) position and a (2, 2) covariance",
        )
    innovation = measured - state.mean[:2]
    expected = state.covariance[:2, :2] + noise
    determinant = float(expected[0, 0] * expected[1, 1] - expected[0, 1] * expected[1, 0])
    if not (determinant > 0.0 and expected[0, 0] > 0.0):
        raise InvalidValueError(
            f"innovation covariance {expected.tolist()}", expected="a positive definite matrix"
        )
    inverse = np.array([[expected[1, 1], -expected[0, 1]], [-expected[1, 0], expected[0, 0]]])
    inverse /= determinant
    nis = float(innovation @ inverse @ innovation)
    if gate is not None and nis > gate:
        return KalmanUpdate(state, innovation, expected, nis, False)
    gain = state.covariance[:, :2] @ inverse
    # Joseph's form stays symmetric and positive when the measurement is much sharper than the
    # prediction.
    keep = np.eye(4)
    keep[:, :2] -= gain
    covariance = keep @ state.covariance @ keep.T + gain @ noise @ gain.T
    new = DriftState(
        state.time_s, state.mean + gain @ innovation, 0.5 * (covariance + covariance.T)
    )
    return KalmanUpdate(new, innovation, expected, nis, True)
