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

"""Figures of the coverage of the field by corners, and of the tilts of the grid."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.findings import (
    assign_cells,
    compute_reached_shares,
    compute_tilts_deg,
    concatenate_corners,
)
from semcal_ros.core.wording import counted
from semcal_ros.report.html.encode import Picture, encode_figure
from semcal_ros.report.html.style import (
    ACCENT,
    INK,
    MUTED,
    OURS,
    choose_arrow_factor,
    choose_log_ticks,
    create_figure,
    set_magnification_axis,
    style_axes,
    style_field_axes,
)

# Cells across the field in the map of coverage: some 430 of them in a 4:3 image.
_CELLS = 24


def plot_coverage(result: CalibrationResult) -> Picture:
    """Plot how many corners of all views lie in each cell of the field."""
    xy, _ = concatenate_corners(result)
    cells = assign_cells(result, xy, _CELLS)
    counts = cells.counts
    grid = counts.reshape(cells.rows, cells.columns).astype(np.float64)
    empty = int(np.sum(counts == 0))
    width, height = result.model.image_size
    figure = create_figure(4.2, 0.6 + 2.8 * min(height / width, 1.6))
    axes = figure.add_subplot()
    shown = axes.imshow(
        np.where(grid > 0.0, grid, np.nan),
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        cmap="viridis",
        vmin=0.0,
        interpolation="nearest",
    )
    style_field_axes(axes, width, height)
    axes.grid(False)
    holes = cells.centres[counts == 0]
    axes.plot(holes[:, 0], holes[:, 1], "x", color=MUTED, markersize=4, markeredgewidth=0.8)
    _add_color_bar(axes, shown, "corners per cell")
    share = f"{empty} of {counts.size} cells have no corner"
    return encode_figure(
        figure,
        f"Map of the image field with the number of corners per cell; {share}.",
        f"Corners of {counted(len(result.views), 'view')}; {share} (crosses). "
        "Where there are none, the distortion is extrapolated.",
    )


def plot_tilt_directions(result: CalibrationResult) -> Picture:
    """Plot the tilt of the grid and its direction in every view."""
    tilt, azimuth = compute_tilts_deg(result)
    figure = create_figure(4.6, 3.2)
    axes = figure.add_subplot()
    limit = max(5.0, 1.1 * float(tilt.max()))
    circle = np.linspace(0.0, 2.0 * np.pi, 121)
    step = choose_arrow_factor(1.0, limit / 2.0)
    for radius in np.arange(step, limit * 1.001, step):
        axes.plot(radius * np.cos(circle), radius * np.sin(circle), color="#c8ced6", linewidth=0.8)
        # Towards a corner: most views are tilted along one of the axes.
        at = (radius * np.sqrt(0.5), -radius * np.sqrt(0.5))
        axes.annotate(f"{radius:g}°", at, fontsize=8, color=MUTED, ha="left", va="bottom")
    low, high = result.model.magnification_range
    angle = np.radians(azimuth)
    dots = axes.scatter(
        tilt * np.cos(angle),
        tilt * np.sin(angle),
        c=result.fit.magnifications,
        cmap="viridis",
        norm=LogNorm(low, high) if high > low else None,
        s=22,
        edgecolors="white",
        linewidths=0.4,
        zorder=3,
    )
    style_axes(
        axes, xlabel="tilt towards the right of the image (°)", ylabel="tilt towards the bottom (°)"
    )
    axes.grid(False)
    axes.set_xlim(-limit, limit)
    axes.set_ylim(limit, -limit)
    axes.set_aspect("equal")
    if high > low:
        bar = _add_color_bar(axes, dots, "magnification")
        bar.ax.yaxis.set_major_locator(FixedLocator(choose_log_ticks(low, high)))
        bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda g, _: f"{g:g}×"))
        bar.ax.yaxis.set_minor_locator(NullLocator())
    span = f"from {tilt.min():.1f} to {tilt.max():.1f} degrees"
    return encode_figure(
        figure,
        f"Tilt and tilt direction of the grid in each view, {span}.",
        f"Tilts of the grid, {span}. Tilts in different directions separate scale, height and "
        "perspective.",
    )


def plot_reached_shares(result: CalibrationResult) -> Picture:
    """Plot how much of the field the corners of each magnification reach."""
    shares = compute_reached_shares(result)
    g = np.array(list(shares))
    percent = 100.0 * np.array(list(shares.values()))
    figure = create_figure(4.6, 3.0)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="magnification", ylabel="cells with a corner (%)")
    axes.vlines(g, 0.0, percent, color=ACCENT, linewidth=1.4)
    axes.plot(g, percent, "o", color=ACCENT, markersize=4.5)
    set_magnification_axis(axes, g[0], g[-1])
    axes.set_ylim(0.0, 108.0)
    least = int(np.argmin(percent))
    text = f"least: {percent[least]:.0f} % at {g[least]:g}×"
    return encode_figure(
        figure,
        f"Share of the field that the corners reach at each magnification; {text}.",
        f"Share of the field (in 6 cells across) that the corners of each magnification reach; "
        f"{text}.",
    )


def plot_tilts(result: CalibrationResult) -> Picture:
    """Plot the tilt of every view against its magnification, with its direction as an arrow."""
    tilt, azimuth = compute_tilts_deg(result)
    g = result.fit.magnifications
    low, high = result.model.magnification_range
    figure = create_figure(4.6, 3.0)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="magnification", ylabel="tilt of the grid (°)")
    angle = np.radians(azimuth)
    # Lines of a fixed length on the page: directions can be read without knowing the axes' scales.
    axes.quiver(
        g,
        tilt,
        np.cos(angle),
        -np.sin(angle),
        angles="uv",
        scale_units="inches",
        scale=9.0,
        color=OURS,
        width=0.004,
        headwidth=3.0,
        headlength=3.5,
        headaxislength=3.2,
    )
    axes.plot(g, tilt, "o", color=INK, markersize=2.2)
    set_magnification_axis(axes, low, high)
    axes.set_ylim(-4.0, 1.25 * max(float(tilt.max()), 5.0))
    steep = {x: int(np.sum((g == x) & (tilt > 10.0))) for x in np.unique(g)}
    least = min(steep, key=lambda x: steep[x])
    text = f"views tilted by more than 10°: at least {steep[least]} at every magnification"
    return encode_figure(
        figure,
        f"Tilt of the grid in each view against magnification; {text}.",
        f"Tilt of each view (dot) and its direction in the image (arrow); {text}.",
    )


def _add_color_bar(axes: Axes, shown: ScalarMappable, label: str) -> Colorbar:
    """Add a colour bar to the right of the axes, as high as they are."""
    figure = axes.figure
    bar = figure.colorbar(shown, cax=axes.inset_axes((1.04, 0.0, 0.05, 1.0)))
    bar.set_label(label, fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8, colors=INK)
    return bar
