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

"""Curves against the magnification: sampling, intervals, marks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.report.html.encode import Readings
from semcal_ros.report.html.page import format_magnification
from semcal_ros.report.html.style import INK, SECOND

# Points of a curve: closer together than a line of the figure bends.
_SAMPLES = 81


def sample_cameras(model: CalibrationModel) -> list[ScanCamera]:
    """Sample cameras over the calibrated range, evenly in log g; one for a single value."""
    low, high = model.magnification_range
    count = _SAMPLES if high > low else 1
    return [model.at(float(g)) for g in np.clip(np.geomspace(low, high, count), low, high)]


def sample_cameras_around(model: CalibrationModel, beyond: float, count: int) -> list[ScanCamera]:
    """Sample cameras from a factor ``beyond`` below the calibrated range to as much above it.

    Magnifications at which the calibration has no camera are left out.
    """
    low, high = model.magnification_range
    tried = (
        _find_camera(model, float(g)) for g in np.geomspace(low / beyond, high * beyond, count)
    )
    return [camera for camera in tried if camera is not None]


def _find_camera(model: CalibrationModel, g: float) -> ScanCamera | None:
    try:
        return model.at(g)
    except InvalidValueError:
        return None


def parts_by_specimen(model: CalibrationModel) -> list[tuple[float, float]]:
    """The parts of the calibrated range that a specimen tells, not a grid: (lowest, highest) of each."""
    low, high = model.magnification_range
    if model.ladder is None:
        return []
    if model.method == "specimen":
        return [(low, high)]
    first, last = model.ladder.anchored
    return [(start, end) for start, end in ((low, first), (last, high)) if start < end]


def mark_magnifications(axes: Axes, model: CalibrationModel) -> None:
    """Mark the magnifications of the images on the x axis, and shade where a specimen tells them, not a grid."""
    for start, end in parts_by_specimen(model):
        axes.axvspan(start, end, facecolor=SECOND, alpha=0.08, linewidth=0.0, zorder=0)
        axes.text(
            float(np.sqrt(start * end)),
            0.03,
            "specimen",
            transform=axes.get_xaxis_transform(),
            ha="center",
            fontsize=7,
            color=INK,
        )
    g = np.array(model.magnifications)
    axes.plot(
        g,
        np.zeros(len(g)),
        "|",
        color=SECOND,
        markersize=7,
        markeredgewidth=1.2,
        transform=axes.get_xaxis_transform(),
        clip_on=False,
        zorder=5,
    )


def draw_curve(
    axes: Axes,
    g: Array,
    values: Array,
    half_widths: Array,
    color: str,
    label: str = "",
    style: str = "-",
) -> None:
    """Draw a line with its interval, or a point with a bar for a single magnification."""
    if len(g) == 1:
        axes.errorbar(
            g, values, yerr=half_widths, fmt="o", color=color, capsize=4, label=label or None
        )
        return
    low, high = values - half_widths, values + half_widths
    axes.fill_between(g, low, high, color=color, alpha=0.25, linewidth=0)
    axes.plot(g, values, style, color=color, linewidth=1.4, label=label or None)


def read_curve(axes: Axes, g: Array, texts: Sequence[str]) -> Readings:
    """Tell what curves say at every second sample, behind the magnification."""
    step = 2 if len(g) > _SAMPLES // 2 else 1
    readings = [
        f"{format_magnification(float(x))}: {text}" for x, text in zip(g, texts, strict=True)
    ]
    return Readings([axes], g[::step], readings[::step])


def set_limits_with_room(axes: Axes, values: Array, half_widths: Array) -> None:
    """Set limits with room around the curve, also for a constant without uncertainty."""
    low, high = float(np.min(values - half_widths)), float(np.max(values + half_widths))
    room = max(0.12 * (high - low), 1e-4 * max(abs(low), abs(high)), 1e-6)
    axes.set_ylim(low - room, high + room)
