"""The drift of a whole recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.rectification.raw_positions import RasterDrift

__all__ = ["DriftPath", "path_of_updates"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DriftPath:
    """Drift at n frames.

    Attributes
    ----------
    time_s
        (n,) centres of the acquisitions.
    drift_m, velocity_m_s, acceleration_m_s2
        (n, 2) drift since the first frame in the sem frame, its rate, and the rate of that; px,
        px/s and px/s^2 where ``calibrated`` is false.
    covariance
        (n, 4, 4) of ``[x, y, vx, vy]``.
    drift_px
        (n, 2) drift in ideal pixels of each frame.
    sigma_px
        (n, 2) 1-sigma of ``drift_px``.
    residual
        (n,) RMS grey levels that the shift does not explain; NaN where nothing was registered.
    status
        n texts as in :class:`~semcal_ros.core.drift.estimates.DriftUpdate`.
    accepted
        (n,) bool: whether the drift rests on the frame's own picture.
    restarted
        (n,) bool: whether tracking went on from the frame at a drift that was only predicted.
    calibrated
        False where no camera was given.
    """

    time_s: Array
    drift_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    covariance: Array
    drift_px: Array
    sigma_px: Array
    residual: Array
    status: tuple[str, ...]
    accepted: NDArray[np.bool_]
    restarted: NDArray[np.bool_]
    calibrated: bool

    def __len__(self) -> int:
        return len(self.status)

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """(n,) bool: accepted, and tracked all the way back to the first frame."""
        return np.asarray(self.accepted & ~np.logical_or.accumulate(self.restarted))

    @property
    def sigma_m(self) -> Array:
        """(n, 2) 1-sigma of ``drift_m``."""
        return np.asarray(np.sqrt(self.covariance[:, [0, 1], [0, 1]]))

    @property
    def velocity_sigma_m_s(self) -> Array:
        """(n, 2) 1-sigma of ``velocity_m_s``."""
        return np.asarray(np.sqrt(self.covariance[:, [2, 3], [2, 3]]))

    def raster(self, index: int) -> RasterDrift:
        """The drift during one frame, as :class:`~semcal_ros.core.rectification.rectifier.Rectifier` wants it."""
        found = (self.drift_m, self.velocity_m_s, self.acceleration_m_s2)
        return RasterDrift(*(values[index] for values in found))


def path_of_updates(updates: Sequence[DriftUpdate]) -> DriftPath:
    """What was known live, frame by frame."""
    covariance = np.array([u.covariance for u in updates]).reshape(-1, 4, 4)
    px_covariance = [u.px_from_unit @ u.covariance[:2, :2] @ u.px_from_unit.T for u in updates]
    return DriftPath(
        time_s=np.array([u.time_s for u in updates]),
        drift_m=np.array([u.drift_m for u in updates]).reshape(-1, 2),
        velocity_m_s=np.array([u.velocity_m_s for u in updates]).reshape(-1, 2),
        acceleration_m_s2=np.array([u.acceleration_m_s2 for u in updates]).reshape(-1, 2),
        covariance=covariance,
        drift_px=np.array([u.drift_px for u in updates]).reshape(-1, 2),
        sigma_px=np.sqrt([np.diag(c) for c in px_covariance]).reshape(-1, 2),
        residual=np.array([u.residual for u in updates]),
        status=tuple(u.status for u in updates),
        accepted=np.array([u.accepted for u in updates], dtype=bool),
        restarted=np.array([u.restarted for u in updates], dtype=bool),
        calibrated=all(u.calibrated for u in updates),
    )
