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

"""What the page says: magnification and drift in words, and in bars how much of a good calibration the views cover."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.viewer.measure import format_with_sigma
from semcal_ros.viewer.source import AcquisitionPanel, Bar, DriftPanel, Magnification

# Points of the trace that the page draws: as many as it has pixels across.
_DRAWN = 300
# About a day at ten frames per second would be a million; a smooth way needs far fewer.
_KEPT = 20_000
# What doc/calibration.md asks for: five views at each magnification, tilts that differ by 20 to 40 degrees, and nine
# magnifications.
_VIEWS, _TILT_DEG, _MAGNIFICATIONS = 5, 30.0, 9


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


def _number(values: Mapping[str, str], key: str) -> float | None:
    try:
        number = float(values[key])
    except (KeyError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _views(values: Mapping[str, str]) -> dict[float, int]:
    found = {}
    for key, value in values.items():
        if (match := re.fullmatch(r"views at (\S+)x", key)) and value.isdigit():
            found[float(match[1])] = int(value)
    return dict(sorted(found.items()))


def describe_coverage(values: Mapping[str, str]) -> tuple[Bar, ...]:
    """Describe what the views cover.

    Parameters
    ----------
    values
        The key-value pairs of ``calibration_server/progress``.
    """
    views = _views(values)
    most, least = max(views.values(), default=0), min(views.values(), default=0)
    each = f"{least}" if least == most else f"{least} to {most}"
    field = _number(values, "field_share") or 0.0
    least_deg, most_deg = _number(values, "least_tilt_deg"), _number(values, "largest_tilt_deg")
    if least_deg is None or most_deg is None:
        spread_deg, tilts = 0.0, f"none; spread over {_TILT_DEG:.0f}° is good"
    else:
        spread_deg = most_deg - least_deg
        tilts = f"{least_deg:.0f}° to {most_deg:.0f}°; spread over {_TILT_DEG:.0f}° is good"
    covered = "none"
    if views:
        low, high = min(views), max(views)
        reach = f"at {low:g}×" if low == high else f"from {low:g}× to {high:g}×"
        covered = f"{len(views)} {reach}"
    return (
        Bar("Field with corners", field, f"{field:.0%}"),
        Bar("Tilts", min(spread_deg / _TILT_DEG, 1.0), tilts),
        Bar(
            "Magnifications",
            min(len(views) / _MAGNIFICATIONS, 1.0),
            f"{covered}; {_MAGNIFICATIONS} or more are good",
        ),
        Bar(
            "Views of each",
            min(least / _VIEWS, 1.0),
            f"{each}; {_VIEWS} are good" if views else f"none; {_VIEWS} are good",
        ),
    )


def describe_run(values: Mapping[str, str]) -> Bar | None:
    """Describe a calibration that is running; None without one."""
    fraction = _number(values, "fraction")
    if fraction is None or "stage" not in values or values["stage"] == "done":
        return None
    return Bar("Calibrating", min(max(fraction, 0.0), 1.0), values["stage"])


def describe_acquisition(values: Mapping[str, str]) -> AcquisitionPanel | None:
    """Describe a calibration that records itself; None from a server that does not tell of it."""
    microscope = values.get("microscope")
    if microscope is None:
        return None
    low, high = _number(values, "lowest_magnification"), _number(values, "highest_magnification")
    target, sigma = _number(values, "target"), _number(values, "largest_sigma")
    taken, planned = _number(values, "taken"), _number(values, "planned")
    bars: tuple[Bar, ...] = ()
    if taken is not None and planned:
        left_out = _number(values, "left_out") or 0.0
        text = f"{taken:.0f} of {planned:.0f} so far" + f", {left_out:.0f} left out" * bool(
            left_out
        )
        bars = (Bar("Views of the plan", min(taken / planned, 1.0), text),)
    if target and bars:
        known = "not known yet" if sigma is None else f"{100.0 * sigma:.2g} %"
        share = 0.0 if not sigma else min(target / sigma, 1.0)
        bars += (Bar("Certainty of nm per px", share, f"{known}; {100.0 * target:.2g} % wanted"),)
    return AcquisitionPanel(
        values.get("acquisition", "ready"),
        f"{microscope} moves by itself" if microscope else "you set each view, step by step",
        values.get("request", ""),
        bars,
        (low, high) if low and high else None,
        target,
    )
