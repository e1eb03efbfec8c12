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

"""Figure of a height map with a colour bar and a scale bar."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from semcal_ros.applications.reconstruction.tilt_series import HeightMap
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.files.images.scale_bar import choose_scale_bar
from semcal_ros.report.html.encode import encode_png
from semcal_ros.report.html.style import add_color_bar, create_figure

__all__ = ["plot_relief", "write_relief_figure"]

_DPI = 150.0


def write_relief_figure(heights: HeightMap, file: Path) -> None:
    """Write :func:`plot_relief` as a PNG, completely or not at all."""
    atomic_write_bytes(file, encode_png(plot_relief(heights), _DPI))


def plot_relief(heights: HeightMap) -> Figure:
    """Plot heights and their 1-sigma; grey where they are not known."""
    figure = create_figure(10.0, 4.6)
    rows, columns = heights.height_m.shape
    bar = choose_scale_bar(columns, heights.pixel_size_m)
    parts = (
        ("height", heights.height_m, "viridis"),
        ("1-sigma of the height", heights.sigma_m, "magma"),
    )
    for index, (name, values, colours) in enumerate(parts):
        axes = figure.add_subplot(1, 2, index + 1)
        axes.set_facecolor("0.8")
        low, high = np.nanpercentile(values, (0.5, 99.5))
        unit, factor = ("µm", 1e6) if max(abs(low), abs(high)) >= 1e-6 else ("nm", 1e9)
        low, high = factor * low, factor * high
        shown = axes.imshow(factor * values, cmap=colours, vmin=low, vmax=high)
        add_color_bar(shown, axes, f"{name} ({unit})", shrink=0.85)
        left, y = 0.04 * columns, 0.95 * rows
        axes.plot([left, left + bar.length_px], [y, y], color="black", linewidth=5)
        axes.plot([left, left + bar.length_px], [y, y], color="white", linewidth=3)
        axes.text(
            left,
            y - 0.02 * rows,
            bar.label,
            color="white",
            fontsize=8,
            bbox={"facecolor": "black", "alpha": 0.5, "linewidth": 0},
        )
        axes.set_xticks([])
        axes.set_yticks([])
    return figure
