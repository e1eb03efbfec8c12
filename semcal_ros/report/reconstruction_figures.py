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

"""Figures of what was reconstructed: a ball with cloud, mesh and distances from the sphere, or a map of heights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from semcal_ros.applications.reconstruction import Ball, Structure
from semcal_ros.applications.reconstruction.tilt_series import HeightMap
from semcal_ros.core.arrays import Array
from semcal_ros.core.wording import counted
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.files.images.scale_bar import choose_scale_bar
from semcal_ros.report.html.encode import encode_png
from semcal_ros.report.html.style import (
    INK,
    MUTED,
    OURS,
    SECOND,
    add_color_bar,
    add_legend,
    create_figure,
    style_axes,
)

# nm in a metre.
_NM = 1e9
# Resolution: 1056 px across the figure of 9.6 inches.
_BALL_DPI = 110.0
_RELIEF_DPI = 150.0


def render_ball(structure: Structure, ball: Ball) -> bytes:
    """Draw :func:`plot_ball` as a PNG file."""
    return encode_png(plot_ball(structure, ball), _BALL_DPI)


def write_ball_figure(structure: Structure, ball: Ball, file: Path) -> None:
    """Write :func:`render_ball` completely or not at all; OSError if that fails."""
    atomic_write_bytes(file, render_ball(structure, ball))


def plot_ball(structure: Structure, ball: Ball) -> Figure:
    """Plot cloud and mesh, seen obliquely from the gun, and distances from the sphere."""
    figure = create_figure(9.6, 3.4)
    # No layout engine knows how much room the labels of a 3D box take.
    figure.set_layout_engine("none")
    on_ball = ball.sphere.inliers
    centre = ball.sphere.centre_m
    points = _turn_upright(structure.points_m - centre)
    reach = 1.05 * _NM * ball.sphere.radius_m
    # Outside of its box a 3D axes draws points over the numbers of its axes.
    in_box = np.all(np.abs(points) < reach, axis=1)
    cloud: Any = figure.add_axes((0.01, 0.06, 0.32, 0.84), projection="3d")
    cloud.scatter(*points[on_ball].T, s=3, c=OURS, label="on the ball")
    other = in_box & ~on_ball
    if other.any():
        cloud.scatter(*points[other].T, s=3, c=SECOND, label="not on it")
    title = counted(np.count_nonzero(on_ball), "point")
    far = np.count_nonzero(~on_ball & ~in_box)
    if far:
        title += f", {far} outside of the box"
    cloud.set_title(title, fontsize=9, color=INK)
    add_legend(cloud, loc="upper left", bbox_to_anchor=(-0.02, 1.04))
    surface: Any = figure.add_axes((0.35, 0.06, 0.32, 0.84), projection="3d")
    vertices = _turn_upright(ball.mesh.vertices_m - centre)
    triangles = Poly3DCollection(
        vertices[ball.mesh.faces],
        facecolors="#9cc4e4",
        edgecolors=MUTED,
        linewidths=0.25,
        shade=True,
        lightsource=LightSource(azdeg=225, altdeg=50),
    )
    surface.add_collection3d(triangles)
    surface.set_title(
        f"mesh: {len(vertices)} vertices, {len(ball.mesh.faces)} faces", fontsize=9, color=INK
    )
    for axes in (cloud, surface):
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach))
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=48, azim=-70)
        axes.tick_params(labelsize=6, colors=MUTED, pad=-1)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_major_locator(MaxNLocator(3))
            axis.labelpad = -2
        axes.set_xlabel("X (nm)", fontsize=7)
        axes.set_ylabel("-Y (nm)", fontsize=7)
        axes.set_zlabel("-Z, to the gun (nm)", fontsize=7)
    _plot_distances(figure.add_axes((0.77, 0.16, 0.21, 0.68)), ball)
    return figure


def _turn_upright(points_m: Array) -> Array:
    """Convert to nm, with y and z reversed so that the gun is above."""
    return np.asarray(points_m * np.array([1.0, -1.0, -1.0]) * _NM, dtype=np.float64)


def _plot_distances(axes: Axes, ball: Ball) -> None:
    distance = _NM * ball.sphere.residuals_m[ball.sphere.inliers]
    axes.hist(distance, bins=31, color=OURS)
    style_axes(axes, xlabel="distance from the sphere (nm)", ylabel="points")
    low, high = (_NM * value for value in ball.interval_m)
    axes.set_title(
        f"{_NM * ball.diameter_m:.1f} nm across\n95 %: {low:.1f} to {high:.1f} nm",
        fontsize=9,
        color=INK,
    )


def write_relief_figure(heights: HeightMap, file: Path) -> None:
    """Write :func:`plot_relief` as a PNG, completely or not at all."""
    atomic_write_bytes(file, encode_png(plot_relief(heights), _RELIEF_DPI))


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
