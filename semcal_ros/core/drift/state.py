"""Drift and the positions of its keyframes, estimated together.

The state holds the drift p, its velocity v and acceleration a, and for each keyframe j where its
picture lies: the drift m_j at which it seems to have been taken, and the velocity w_j by which it
still is sheared. A frame with noise n that is registered against keyframe j has

    shift = p + a b - m_j - Z e + n,        shear = T v - T_j w_j + n'

with the frame times T, and with b = A^2 / 24 for an acquisition that takes A: so far the mean of an
accelerated drift is from its middle. A zoom is about the principal point, of which the calibration
may have an error e (px) that is the same at all magnifications: with Z = J^-1 - J_j^-1 (m per px)
it looks like a drift when frame and keyframe have different magnifications, and in no other way.
All of this is linear, so one Kalman filter holds it, with every correlation:
the noise of a keyframe is shared by all frames that were registered against it and does not average
out, and coming back to an old keyframe undoes what was lost on the way. A frame that becomes a
keyframe itself seems to lie at ``m_new = m_j + shift`` exactly, noise and all, so that a chain of
keyframes is no more than copies of the state.

What happens to the state is in :mod:`semcal_ros.core.drift.operations`. Any length unit will do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array

__all__ = ["EACH", "MOVING", "OWN", "DriftState", "initial_state"]


#: Numbers of drift, velocity and acceleration; with the error of the principal point; of a keyframe.
MOVING, OWN, EACH = 6, 8, 4


@dataclass(frozen=True)
class DriftState:
    """State at one time.

    Attributes
    ----------
    time_s
        Time of the state, s.
    mean
        (8 + 4 k,) ``[x, y, vx, vy, ax, ay, ex, ey]``, then ``[mx, my, wx, wy]`` of each of the k
        keyframes.
    covariance
        Of ``mean``.
    keys
        Numbers of the keyframes, in the order of the state.
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
    def centre_error_px(self) -> tuple[Array, Array]:
        """(2,) error of the principal point that the zooms so far tell, px, and its covariance."""
        part = slice(MOVING, OWN)
        return self.mean[part], self.covariance[part, part]

    @property
    def own(self) -> Array:
        """(4, 4) covariance of drift and velocity."""
        return self.covariance[:4, :4]

    def of(self, key: int) -> slice:
        """Where a keyframe's four numbers stand."""
        start = OWN + EACH * self.keys.index(key)
        return slice(start, start + EACH)

    def where(self, key: int) -> Array:
        """(4,) ``[mx, my, wx, wy]`` of a keyframe."""
        return self.mean[self.of(key)]

    def shift_from(self, key: int) -> tuple[Array, Array]:
        """Expected shift (2,) of a frame taken now against a keyframe, and its covariance (2, 2)."""
        row = np.zeros((2, self.mean.size))
        at = self.of(key).start
        row[:, :2], row[:, at : at + 2] = np.eye(2), -np.eye(2)
        return row @ self.mean, row @ self.covariance @ row.T

    def without_keyframes(self) -> DriftState:
        """The same drift with nothing to compare pictures with: small, for what needs no more."""
        return DriftState(self.time_s, self.mean[:OWN].copy(), self.covariance[:OWN, :OWN].copy())


def initial_state(time_s: float, centre_covariance: Array | None = None) -> DriftState:
    """The beginning: no drift, by definition, and no velocity known yet.

    ``centre_covariance`` (2, 2) is that of the principal point, px^2; None where it is known.
    """
    covariance = np.zeros((OWN, OWN))
    if centre_covariance is not None:
        covariance[MOVING:, MOVING:] = centre_covariance
    return DriftState(time_s, np.zeros(OWN), covariance)
