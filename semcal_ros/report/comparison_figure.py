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

"""Figure of the difference of two calibrations."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from semcal_ros.core.calibration.judgement.compare import CalibrationDifference, DifferenceAt
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.report.html.page import format_length
from semcal_ros.report.html.style import (
    ACCENT,
    INK,
    OURS,
    add_color_bar,
    choose_arrow_factor,
    create_figure,
    set_magnification_axis,
    style_axes,
    style_field_axes,
)

_DPI = 150.0
# Letters of a line of the title: a line of them is nine of the ten inches of the figure wide.
_LINE_LENGTH = 100


def write_difference_figure(
    difference: CalibrationDifference, names: tuple[str, str], size: tuple[int, int], file: Path
) -> None:
    """Write :func:`plot_difference` as PNG, SVG or PDF by the suffix, completely or not at all."""
    drawn = io.BytesIO()
    kind = file.suffix.lower().removeprefix(".")
    plot_difference(difference, names, size).savefig(drawn, format=kind, dpi=_DPI)
    atomic_write_bytes(file, drawn.getvalue())


def plot_difference(
    difference: CalibrationDifference, names: tuple[str, str], size: tuple[int, int]
) -> Figure:
    """Plot nm per px over the magnification, and the field where it differs most.

    Parameters
    ----------
    difference
        What differs.
    names
        Of the first and the second calibration.
    size
        (width, height) of the images of the first, px.
    """
    figure = create_figure(10.0, 4.4)
    shown = textwrap.fill(f"{names[1]} against {names[0]}", _LINE_LENGTH)
    figure.suptitle(shown, fontsize=11, color=INK, parse_math=False)
    scale, field = figure.subplots(1, 2)
    _plot_scale(scale, difference)
    _plot_field(field, max(difference.at, key=lambda one: one.field_sigmas), size)
    return figure


def _plot_scale(axes: Axes, difference: CalibrationDifference) -> None:
    g = np.array([one.magnification for one in difference.at])
    value = 100.0 * np.array([one.scale for one in difference.at])
    sigma = 100.0 * np.array([one.scale_sigma for one in difference.at])
    style_axes(axes, xlabel="magnification", ylabel="difference of nm per px (%)")
    axes.axhline(0.0, color=INK, linewidth=0.8)
    axes.fill_between(g, -2.0 * sigma, 2.0 * sigma, color=ACCENT, alpha=0.25, label="2 joint sigma")
    axes.plot(g, value, "o-", color=OURS, label="difference")
    set_magnification_axis(axes, difference.low, difference.high)
    # Above the data, wherever they are.
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False, fontsize=8)


def _plot_field(axes: Axes, worst: DifferenceAt, size: tuple[int, int]) -> None:
    known = np.all(np.isfinite(worst.difference_px), axis=1)
    xy, moved = worst.xy[known], worst.difference_px[known]
    length = np.linalg.norm(moved, axis=1)
    style_field_axes(axes, *size)
    factor = choose_arrow_factor(float(length.max(initial=0.0)) or 1.0, size[0] / 12.0)
    arrows = axes.quiver(
        xy[:, 0],
        xy[:, 1],
        *(factor * moved.T),
        length,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        cmap="viridis",
        width=0.006,
    )
    add_color_bar(arrows, axes, "difference from the image centre (px)", shrink=0.85)
    largest = format_length(worst.worst_px * worst.pixel_size_m)
    axes.set_title(
        f"at {worst.magnification:.0f}×: up to {worst.worst_px:.2g} px, {largest}, {worst.field_sigmas:.1f} sigma\n"
        f"arrows {factor:g} times as long",
        fontsize=9,
    )
