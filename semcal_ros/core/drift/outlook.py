"""The drift at times after the last frame that was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.camera_uncertainty import scale_covariance
from semcal_ros.core.drift.process_noise import Restlessness
from semcal_ros.core.drift.state import MOVING, DriftMap
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.raw_positions import RasterDrift

__all__ = ["DriftForecast", "DriftOutlook"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DriftForecast:
    """Drift at another time, from what is known now.

    Attributes
    ----------
    time_s
        Time of the forecast.
    drift_m, velocity_m_s, acceleration_m_s2
        (2,) as in :class:`~semcal_ros.core.drift.estimates.DriftUpdate`.
    covariance
        (4, 4) of ``[x, y, vx, vy]``.
    """

    time_s: float
    drift_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    covariance: Array

    @property
    def raster(self) -> RasterDrift:
        """The drift during a frame at that time, for a rectifier."""
        return RasterDrift(self.drift_m, self.velocity_m_s, self.acceleration_m_s2)


@dataclass(frozen=True)
class DriftOutlook:
    """All that a forecast needs; it never changes, so that another thread may hold it.

    Attributes
    ----------
    state
        The drift at the last frame.
    restlessness
        How much it is expected to change.
    camera
        Camera of the last frame, or None for drift in px.
    """

    state: DriftMap
    restlessness: Restlessness
    camera: ScanCamera | None

    @property
    def time_s(self) -> float:
        """Centre of the acquisition of the last frame."""
        return self.state.time_s

    def at(self, time_s: float) -> DriftForecast:
        """Drift at a time.

        Raises
        ------
        InvalidValueError
            If it is before that of the last frame, or not finite.
        """
        if not self.time_s <= time_s < np.inf:
            raise InvalidValueError(
                f"a forecast for {time_s} s", expected=f"a time after {self.time_s} s"
            )
        move, noise = self.restlessness.over(time_s - self.time_s)
        # As Move does it, without what only a tracker needs: this is worked out for every frame.
        motion = move @ self.state.mean[:MOVING].reshape(3, 2)
        both = np.zeros((4, MOVING))
        both[0::2, 0::2] = both[1::2, 1::2] = move[:2]
        covariance = both @ self.state.covariance[:MOVING, :MOVING] @ both.T
        covariance[0::2, 0::2] += noise[:2, :2]
        covariance[1::2, 1::2] += noise[:2, :2]
        covariance += scale_covariance(self.camera, motion[0], motion[1])
        return DriftForecast(time_s, motion[0], motion[1], motion[2], covariance)
