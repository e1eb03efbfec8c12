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

"""Style of all figures: readable on a phone, dark on white, no global state."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter, NullLocator

from semcal_ros.core.arrays import Array

INK = "#1b2430"
MUTED = "#5b6674"
OURS = "#0b5fa5"
SECOND = "#b4441a"
ACCENT = "#3a7d34"
REFERENCE = "#7a4f9a"
# From white to a blue on which dark numbers can still be read.
LIGHT_MAP = LinearSegmentedColormap.from_list("light", ["#ffffff", "#d3e4f3", "#8fbfe0"])
_GRID = "#dde2e8"
# Size of the labels, points.
_TEXT_PT = 9.0
# Of the length of a logarithmic axis: "10000×" takes 0.12 of the narrowest axis of a magnification, 3.2 inches.
_LEAST_TICK_GAP = 0.15


def create_figure(width_in: float = 4.2, height_in: float = 3.0) -> Figure:
    """Create an empty figure on the Agg canvas, not registered with any figure manager."""
    figure = Figure(figsize=(width_in, height_in), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def style_axes(axes: Axes, *, xlabel: str, ylabel: str) -> None:
    """Set labels, a thin frame and a light grid."""
    axes.set_facecolor("white")
    axes.set_xlabel(xlabel, fontsize=_TEXT_PT, color=INK)
    axes.set_ylabel(ylabel, fontsize=_TEXT_PT, color=INK)
    axes.tick_params(labelsize=_TEXT_PT - 1.0, colors=INK, which="both")
    axes.grid(True, color=_GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(MUTED)


def add_legend(axes: Axes, **options: Any) -> None:
    """Add a small legend without a frame."""
    axes.legend(
        fontsize=_TEXT_PT - 1.5, framealpha=0.85, edgecolor="none", labelcolor=INK, **options
    )


def add_color_bar(shown: ScalarMappable, axes: Axes, label: str, **options: Any) -> Colorbar:
    """Add a colour bar with the sizes of type of the other axes."""
    bar = axes.figure.colorbar(shown, ax=axes, **options)
    bar.set_label(label, fontsize=_TEXT_PT, color=INK)
    bar.ax.tick_params(labelsize=_TEXT_PT - 1.0, colors=INK)
    return bar


def choose_log_ticks(low: float, high: float) -> list[float]:
    """Choose round numbers from ``low`` to ``high`` whose labels stay apart: at least three, if there are that many."""
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    choices = [
        [s * 10.0**d for d in decades for s in steps] for steps in ((1.0,), (1.0, 3.0), (1, 2, 5))
    ]
    # Within a decade numbers at equal steps are rounder than those at equal ratios.
    choices += [[*MaxNLocator(n, steps=[1, 2, 5, 10]).tick_values(low, high)] for n in (4, 6, 10)]
    least = _LEAST_TICK_GAP * np.log(high / low)
    best: list[float] = []
    for choice in choices:
        ticks: list[float] = []
        for tick in choice:
            inside = low <= tick <= high
            if inside and not (ticks and np.log(tick / ticks[-1]) < least):
                ticks.append(float(tick))
        if len(ticks) >= 3:
            return ticks
        best = max(best, ticks, key=len)
    return best or [float(np.sqrt(low * high))]


def set_magnification_axis(axes: Axes, low: float, high: float) -> None:
    """Set a logarithmic x axis over the calibrated range, with plain numbers."""
    margin = 1.12 if high > low else 1.5
    axes.set_xscale("log")
    axes.set_xlim(low / margin, high * margin)
    axes.xaxis.set_major_locator(FixedLocator(choose_log_ticks(low / margin, high * margin)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda g, _: f"{g:.10g}×"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def set_log_axis_y(axes: Axes, low: float, high: float) -> None:
    """Set a logarithmic y axis from ``low`` to ``high`` with plain numbers."""
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(FixedLocator(choose_log_ticks(low, high)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())


def style_field_axes(axes: Axes, width: int, height: int) -> None:
    """Set axes that show the image field, y down, square pixels."""
    style_axes(axes, xlabel="column (px)", ylabel="row (px)")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)


def choose_arrow_factor(length_px: float, target_px: float) -> float:
    """Choose a factor (1, 2, 5, 10, ...) that scales ``length_px`` to at most ``target_px``."""
    if not (np.isfinite(length_px) and length_px > 0.0):
        return 1.0
    ratio = max(target_px / length_px, 1e-3)
    power = 10.0 ** np.floor(np.log10(ratio))
    return float(power * max(s for s in (1.0, 2.0, 5.0) if s * power <= ratio * (1.0 + 1e-9)))


def draw_contours(
    axes: Axes, x: Array, y: Array, table: Array, top: float, *, lines: int = 6
) -> None:
    """Draw numbered contours at round values up to ``top``; no colour has to be read."""
    known = table[np.isfinite(table)]
    if not known.size or float(np.ptp(known)) <= 1e-12 * max(abs(top), 1.0):
        return
    low, high = float(known.min()), float(known.max())
    levels = [v for v in MaxNLocator(lines).tick_values(0.0, top) if low < v < high and v > 0.0]
    if not levels:
        return
    drawn = axes.contour(
        x, y, np.ma.masked_invalid(table), levels=levels, colors=INK, linewidths=0.8
    )
    axes.clabel(drawn, fontsize=_TEXT_PT - 1.5, fmt="%g", colors=INK)
