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

"""Drift and its velocity as geometry_msgs messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.bridge.fields import assign_floats
from semcal_ros.bridge.headers import HeaderMessage, copy_header
from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.estimates import DriftEstimate
from semcal_ros.core.errors import InvalidValueError

__all__ = [
    "UNKNOWN_VARIANCE",
    "fill_drift",
    "fill_drift_velocity",
    "rotation_of",
    "rotation_rate_of",
]

# Standard deviations of 1 km and of 1000 rad.
UNKNOWN_VARIANCE = 1e6
"""Variance of what is not observed (height in m2, rotations in rad2, a drift that was never measured): beyond anything
physical, and finite, since filters that take such messages multiply with it."""

# Relative to the largest entry: above the rounding of single precision (6e-8).
_SYMMETRY_TOLERANCE = 1e-6


def fill_drift(
    message: Any,
    drift_m: ArrayLike,
    covariance: ArrayLike,
    header: HeaderMessage,
    rotation: tuple[float, float] | None = None,
) -> None:
    """Set the drift of the specimen in the sem frame.

    Parameters
    ----------
    message
        The message to fill.
    drift_m
        (2,) displacement in m: what lay at X is seen at X + drift.
    covariance
        (4, 4) covariance of ``[x, y, vx, vy]`` as the tracker gives it, or its (2, 2) position
        block, m2. Infinite variances become :data:`UNKNOWN_VARIANCE`.
    header
        Header of the image, copied verbatim.
    rotation
        Rotation of the image since the first frame, rad from x towards y, and its variance, rad2; None
        where none was found: the orientation becomes the identity.

    Raises
    ------
    InvalidValueError
        A value is not finite (variances may be infinite), or the covariance is not a symmetric matrix of
        that size with positive diagonal.
    """
    x, y = _pair(drift_m, "drift")
    block = _block(covariance, 0)
    copy_header(message.header, header)
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.position.z = x, y, 0.0
    orientation = pose.orientation
    half = 0.0 if rotation is None else 0.5 * rotation[0]
    orientation.x, orientation.y, orientation.z, orientation.w = (
        0.0,
        0.0,
        math.sin(half),
        math.cos(half),
    )
    assign_floats(message.pose, "covariance", _six_by_six(block, rotation))


def fill_drift_velocity(
    message: Any,
    velocity_m_s: ArrayLike,
    covariance: ArrayLike,
    header: HeaderMessage,
    rotation_rate: tuple[float, float] | None = None,
) -> None:
    """Set the velocity of the drift in m/s.

    As :func:`fill_drift`, with the velocity block of a (4, 4) covariance, or a (2, 2) one in m2/s2, and
    the rate of the rotation in rad/s with its variance.
    """
    x, y = _pair(velocity_m_s, "drift velocity")
    block = _block(covariance, 2)
    copy_header(message.header, header)
    twist = message.twist.twist
    _set_vector(twist.linear, x, y)
    _set_vector(twist.angular, 0.0, 0.0, 0.0 if rotation_rate is None else rotation_rate[0])
    assign_floats(message.twist, "covariance", _six_by_six(block, rotation_rate))


def rotation_of(estimate: DriftEstimate) -> tuple[float, float] | None:
    """Rotation of a drift and its variance as :func:`fill_drift` takes them; None where none was found."""
    return _angle_and_variance(estimate, 0)


def rotation_rate_of(estimate: DriftEstimate) -> tuple[float, float] | None:
    """Its rate, for :func:`fill_drift_velocity`."""
    return _angle_and_variance(estimate, 2)


def _angle_and_variance(estimate: DriftEstimate, index: int) -> tuple[float, float] | None:
    if not np.any(estimate.similarity):
        return None
    variance = min(float(estimate.similarity_covariance[index, index]), UNKNOWN_VARIANCE)
    return float(estimate.similarity[index]), variance


def _set_vector(vector: Any, x: float, y: float, z: float = 0.0) -> None:
    vector.x, vector.y, vector.z = x, y, z


def _floats(values: ArrayLike, what: str) -> Array:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidValueError(f"a {what} that is not an array of numbers") from error


def _pair(values: ArrayLike, what: str) -> tuple[float, float]:
    pair = _floats(values, what)
    if pair.shape != (2,) or not np.all(np.isfinite(pair)):
        raise InvalidValueError(f"a {what} of {pair.tolist()}", expected="two finite numbers")
    return float(pair[0]), float(pair[1])


def _block(covariance: ArrayLike, first: int) -> Array:
    matrix = whole = _floats(covariance, "covariance")
    if matrix.shape == (4, 4):
        matrix = matrix[first : first + 2, first : first + 2]
    if matrix.shape == (2, 2) and np.isfinite(matrix[0, 1] + matrix[1, 0]):
        matrix = _bound(matrix)
    if matrix.shape != (2, 2) or not np.all(np.isfinite(matrix)) or np.any(np.diag(matrix) < 0.0):
        raise InvalidValueError(
            f"a covariance of shape {whole.shape}",
            expected="a (4, 4) or (2, 2) matrix of numbers with a diagonal that is not negative",
        )
    scale = float(np.max(np.abs(matrix)))
    if abs(matrix[0, 1] - matrix[1, 0]) > _SYMMETRY_TOLERANCE * scale:
        raise InvalidValueError(f"a covariance {matrix.tolist()}", expected="a symmetric matrix")
    return matrix


def _bound(matrix: Array) -> Array:
    """A (2, 2) covariance with what is infinite in it at :data:`UNKNOWN_VARIANCE`."""
    unknown = np.isposinf(np.diag(matrix))
    bounded = np.where(unknown[:, None] | unknown[None, :], 0.0, matrix)
    bounded[unknown, unknown] = UNKNOWN_VARIANCE
    return bounded


def _six_by_six(block: Array, about_z: tuple[float, float] | None) -> Array:
    full = np.diag(np.full(6, UNKNOWN_VARIANCE))
    full[:2, :2] = block
    if about_z is not None:
        full[5, 5] = about_z[1]
    return full
