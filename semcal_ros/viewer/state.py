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

"""What the page says of magnification and drift, in words."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.viewer.measure import format_with_sigma
from semcal_ros.viewer.source import DriftPanel, Magnification

__all__ = ["DriftTrace", "describe_magnification", "drift_in_pixels"]

# Points of the trace that the page draws: as many as it has pixels across.
_DRAWN = 300
# About a day at ten frames per second would be a million; a smooth way needs far fewer.
_KEPT = 20_000


def describe_magnification(
    magnification: float | None, calibration: CalibrationModel | None
) -> Magnification:
    """Describe a magnification, and whether a calibration covers it.

    Parameters
    ----------
    magnification
        None while it is not known.
    calibration
        The calibration, or None. One that a specimen extended beyond its grid says where the grid ends.
    """
    if magnification is None:
        return Magnification("unknown", "unknown", "no magnification is published")
    text = f"{magnification:.6g}×"
    if calibration is None:
        return Magnification(text, "unknown", "not calibrated")
    calibrated = _span(calibration.magnification_range)
    origin = calibration.origin_of(magnification)
    if origin == "extrapolated":
        return Magnification(text, "outside", f"outside the calibration, {calibrated}")
    if calibration.ladder is None:
        return Magnification(text, "ok", f"calibrated, {calibrated}")
    if calibration.method == "specimen":
        return Magnification(text, "ok", f"calibrated by a specimen, {calibrated}")
    grid = _span(calibration.ladder.anchored)
    if origin == "grid":
        return Magnification(
            text, "ok", f"calibrated by a grid, {grid}; by a specimen, {calibrated}"
        )
    return Magnification(text, "ok", f"calibrated by a specimen, {calibrated}; by a grid, {grid}")


def _span(ends: tuple[float, float]) -> str:
    return f"{_round(ends[0])}× to {_round(ends[1])}×"


def _round(magnification: float) -> str:
    return f"{float(f'{magnification:.4g}'):.10g}"


def drift_in_pixels(camera: ScanCamera, drift_m: ArrayLike) -> tuple[float, float]:
    """Return a drift in the sem frame as a way in the raw picture, (x, y) px."""
    x, y = camera.ideal_from_sem_jacobian @ np.asarray(drift_m, dtype=np.float64)
    return float(x), float(y)


class DriftTrace:
    """The way of the drift so far."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        self._last: tuple[int, float, float, float] | None = None
        self._speed: tuple[float, float] | None = None

    def clear(self) -> None:
        """Forget everything."""
        self._points.clear()
        self._last = self._speed = None

    def add(
        self,
        stamp_ns: int,
        x_m: float,
        y_m: float,
        sigma_m: float,
        speed: tuple[float, float] | None = None,
    ) -> None:
        """Add the drift of a frame; one that is exactly zero, or older than the last, begins anew.

        ``speed`` is its amount and 1-sigma, m/s, where they are known.
        """
        if (x_m == 0.0 and y_m == 0.0) or (self._last and stamp_ns < self._last[0]):
            self.clear()
        self._points.append((1e9 * x_m, 1e9 * y_m))
        self._last = stamp_ns, x_m, y_m, sigma_m
        self._speed = speed

    @property
    def last(self) -> tuple[int, float, float, float] | None:
        """Stamp, x, y and 1-sigma (ns, m) of the newest, or None."""
        return self._last

    def panel(self, missing: str = "no drift is published") -> DriftPanel:
        """Describe the drift for the page; ``missing`` is said where there is none."""
        if self._last is None:
            return DriftPanel(missing)
        _, x_m, y_m, sigma_m = self._last
        text = f"{format_with_sigma(math.hypot(x_m, y_m), sigma_m)} since the start"
        if self._speed is not None:
            speed_m_s, speed_sigma_m_s = self._speed
            text += f", {format_with_sigma(60.0 * speed_m_s, 60.0 * speed_sigma_m_s)} per minute"
        points = list(self._points)
        step = max(1, math.ceil(len(points) / _DRAWN))
        drawn = points[::step]
        if drawn[-1] != points[-1]:
            drawn.append(points[-1])
        rounded = tuple((round(x, 3), round(y, 3)) for x, y in drawn)
        sigma_nm = 1e9 * sigma_m if math.isfinite(sigma_m) else 0.0
        return DriftPanel(text, rounded, points[-1], sigma_nm)
