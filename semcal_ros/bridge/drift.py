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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.bridge.fields import HeaderMessage, assign_floats, copy_header
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError

if TYPE_CHECKING:  # the filter behind it needs scipy.optimize, which most nodes do not
    from semcal_ros.core.drift.estimates import DriftEstimate


# Standard deviations of 1 km and of 1000 rad.
UNKNOWN_VARIANCE = 1e6
"""Variance of what is not observed (height in m2, rotations in rad2, a drift that was never measured): beyond anything
physical, and finite, since filters that take such messages multiply with it."""

# Relative to the largest entry: above the rounding of single precision (6e-8).
_SYMMETRY_TOLERANCE = 1e-6
# Nothing observed: (6, 6), row by row.
_UNKNOWN = tuple(UNKNOWN_VARIANCE if k % 7 == 0 else 0.0 for k in range(36))


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
    if not estimate.similarity.any():
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
    numbers = pair.tolist()
    if pair.shape != (2,) or not all(map(math.isfinite, numbers)):
        raise InvalidValueError(f"a {what} of {numbers}", expected="two finite numbers")
    return numbers[0], numbers[1]


def _block(covariance: ArrayLike, first: int) -> list[list[float]]:
    whole = _floats(covariance, "covariance")
    matrix = whole[first : first + 2, first : first + 2] if whole.shape == (4, 4) else whole
    # Plain numbers from here on: for four of them, arrays take ten times as long.
    rows = matrix.tolist() if matrix.shape == (2, 2) else []
    if rows and math.isfinite(rows[0][1] + rows[1][0]):
        _bound(rows)
    values = [value for row in rows for value in row]
    if not (values and all(map(math.isfinite, values)) and min(values[0], values[3]) >= 0.0):
        raise InvalidValueError(
            f"a covariance of shape {whole.shape}",
            expected="a (4, 4) or (2, 2) matrix of numbers with a diagonal that is not negative",
        )
    if abs(values[1] - values[2]) > _SYMMETRY_TOLERANCE * max(map(abs, values)):
        raise InvalidValueError(f"a covariance {rows}", expected="a symmetric matrix")
    return rows


def _bound(rows: list[list[float]]) -> None:
    """Set what is infinite in a (2, 2) covariance to :data:`UNKNOWN_VARIANCE`."""
    for k in (0, 1):
        if rows[k][k] == math.inf:
            rows[k][k] = UNKNOWN_VARIANCE
            rows[0][1] = rows[1][0] = 0.0


def _six_by_six(block: list[list[float]], about_z: tuple[float, float] | None) -> list[float]:
    full = list(_UNKNOWN)
    full[0:2], full[6:8] = block
    if about_z is not None:
        full[-1] = about_z[1]
    return full
