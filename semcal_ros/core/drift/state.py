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

"""State of the Kalman filter: the drift, and the positions of its keyframes.

The keyframes are landmarks, as in simultaneous localisation and mapping (Smith, Self and Cheeseman
1990, doi:10.1007/978-1-4613-8997-2_14). The state holds the drift p, its velocity v and its
acceleration a, and for each keyframe j the drift m_j at which it seems to have been taken and the
velocity w_j by which it still is sheared. A frame that is registered against keyframe j has

    shift = p + a b - m_j - Z e + n,        shear = T v - (H / H_j) T_j w_j + n'

with noises n and n', the frame times T, the heights H of the fields, of which a zoom shows a part,
and b = A^2 / 24 for an acquisition that takes A: the mean of an accelerated drift over the frame is
a b away from the drift at its middle. A zoom is about the principal point, of which the calibration
may have an error e (in half widths w of the raster) that is the same at all magnifications. With
Z = J^-1 w - J_j^-1 w_j (m) it looks like a drift when frame and keyframe have different
magnifications, and in no other case.

All of this is linear, so that one Kalman filter holds it, with every correlation. The noise of a
keyframe is shared by all frames that were registered against it and does not average out; coming
back to an old keyframe undoes what was lost on the way. A frame that becomes a keyframe itself
seems to lie at ``m_new = m_j + shift`` exactly, noise and all, so that a chain of keyframes is no
more than copies of the state.

What happens to the state is in :mod:`semcal_ros.core.drift.operations`. The unit of length is
arbitrary: m with a camera, px without.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array

#: Numbers in the state: drift, velocity and acceleration; these with the error of the principal
#: point; those of each keyframe.
MOTION_SIZE, BASE_SIZE, KEYFRAME_SIZE = 6, 8, 4


@dataclass(frozen=True)
class DriftState:
    """State of the filter at one time.

    Attributes
    ----------
    time_s
        Time of the state, s.
    mean
        (8 + 4 k,) ``[x, y, vx, vy, ax, ay, ex, ey]``, then ``[mx, my, wx, wy]`` of each of the k
        keyframes.
    covariance
        Covariance of ``mean``.
    keys
        Numbers that name the keyframes, in the order of the state.
    """

    time_s: float
    mean: Array
    covariance: Array
    keys: tuple[int, ...] = ()

    @property
    def position(self) -> Array:
        """(2,) drift."""
        return self.mean[:2]

    @property
    def velocity(self) -> Array:
        """(2,) drift velocity, per s."""
        return self.mean[2:4]

    @property
    def acceleration(self) -> Array:
        """(2,) drift acceleration, per s^2."""
        return self.mean[4:6]

    @property
    def motion(self) -> Array:
        """(4,) velocity and acceleration."""
        return self.mean[2:6]

    @property
    def drift_covariance(self) -> Array:
        """(4, 4) covariance of drift and velocity."""
        return self.covariance[:4, :4]

    def keyframe_slice(self, key: int) -> slice:
        """Where the four numbers of a keyframe are in ``mean``."""
        start = BASE_SIZE + KEYFRAME_SIZE * self.keys.index(key)
        return slice(start, start + KEYFRAME_SIZE)

    def keyframe_state(self, key: int) -> Array:
        """(4,) ``[mx, my, wx, wy]`` of a keyframe."""
        return self.mean[self.keyframe_slice(key)]

    def predict_shift(self, key: int) -> tuple[Array, Array]:
        """Expected shift (2,) of a frame taken now against a keyframe, and its covariance (2, 2)."""
        jacobian = np.zeros((2, self.mean.size))
        start = self.keyframe_slice(key).start
        jacobian[:, :2], jacobian[:, start : start + 2] = np.eye(2), -np.eye(2)
        return jacobian @ self.mean, jacobian @ self.covariance @ jacobian.T

    def without_keyframes(self) -> DriftState:
        """The drift alone, which is all that a prediction needs."""
        return DriftState(
            self.time_s,
            self.mean[:BASE_SIZE].copy(),
            self.covariance[:BASE_SIZE, :BASE_SIZE].copy(),
        )


def initial_state(time_s: float, centre_covariance: Array | None = None) -> DriftState:
    """State at the first frame: zero drift, by definition, and no velocity yet.

    ``centre_covariance`` (2, 2) is that of the principal point, in half widths of the raster; None where that is exact.
    """
    covariance = np.zeros((BASE_SIZE, BASE_SIZE))
    if centre_covariance is not None:
        covariance[MOTION_SIZE:, MOTION_SIZE:] = centre_covariance
    return DriftState(time_s, np.zeros(BASE_SIZE), covariance)
