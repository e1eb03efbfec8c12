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

"""Figures of the pixel size against the magnification."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.report.calibration.curves import (
    draw_curve,
    mark_magnifications,
    read_curve,
    sample_cameras,
    set_limits_with_room,
)
from semcal_ros.report.html.encode import Picture, encode_figure
from semcal_ros.report.html.style import (
    OURS,
    SECOND,
    add_legend,
    create_figure,
    set_log_axis_y,
    set_magnification_axis,
    style_axes,
)
from semcal_ros.report.html.text import format_length, format_with_sigma

__all__ = ["plot_pixel_sizes"]


def plot_pixel_sizes(model: CalibrationModel) -> list[Picture]:
    """Plot the size of a pixel against the magnification, and its uncertainty."""
    cameras = sample_cameras(model)
    g = np.array([c.magnification for c in cameras])
    sizes = np.array([c.pixel_size_m for c in cameras])
    sigmas = np.array([_get_size_sigma(c) for c in cameras])
    nominal = np.array([1.0 / model.nominal_px_per_m(float(x)) for x in g])
    return [
        _plot_size(model, g, sizes, sigmas),
        _plot_size_interval(model, g, sizes / nominal[:, None], sigmas / nominal[:, None]),
    ]


_DIRECTIONS = (("x (horizontal)", OURS, "-"), ("y (vertical)", SECOND, "--"))


def _plot_size(model: CalibrationModel, g: Array, sizes: Array, sigmas: Array) -> Picture:
    figure = create_figure(4.6, 3.2)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="magnification", ylabel="nm per pixel")
    for k, (label, color, style) in enumerate(_DIRECTIONS):
        shape = "o" if len(g) == 1 else style
        axes.plot(g, 1e9 * sizes[:, k], shape, color=color, linewidth=2.6 - 1.2 * k, label=label)
    set_magnification_axis(axes, g[0], g[-1])
    set_log_axis_y(axes, 0.8e9 * float(sizes.min()), 1.25e9 * float(sizes.max()))
    mark_magnifications(axes, model)
    add_legend(axes, loc="upper right")
    ends = [f"{format_length(sizes[k, 0])} at {g[k]:g}×" for k in (0, -1)]
    span = f"from {ends[0]} to {ends[1]}" if len(g) > 1 else ends[0]
    return encode_figure(
        figure,
        f"Pixel size against magnification, in x {span}.",
        f"Size of a pixel; in x {span}.",
        read_curve(
            axes,
            g,
            [
                f"x {format_length(x, s)}, y {format_length(y, t)}"
                for (x, y), (s, t) in zip(sizes, sigmas, strict=True)
            ],
        ),
    )


def _plot_size_interval(model: CalibrationModel, g: Array, ratio: Array, sigma: Array) -> Picture:
    figure = create_figure(4.6, 3.2)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="magnification", ylabel="pixel size relative to nominal (%)")
    percent, half = 100.0 * (ratio - 1.0), 196.0 * sigma
    for k, (label, color, style) in enumerate(_DIRECTIONS):
        draw_curve(axes, g, percent[:, k], half[:, k], color, label, style)
    set_magnification_axis(axes, g[0], g[-1])
    set_limits_with_room(axes, percent, half)
    mark_magnifications(axes, model)
    add_legend(axes, loc="best")
    worst = float(np.max(half / ratio))
    return encode_figure(
        figure,
        f"Deviation of the pixel size from nominal with its 95 % interval, at most {worst:.2g} % "
        "to either side.",
        "Deviation from the nominal size, with the 95 % interval, which is at most "
        f"±{worst:.2g} %. Errors of the grid itself are not included.",
        read_curve(
            axes,
            g,
            [
                f"x {format_with_sigma(x, s)} %, y {format_with_sigma(y, t)} % (± is 1-sigma)"
                for (x, y), (s, t) in zip(percent, 100.0 * sigma, strict=True)
            ],
        ),
    )


def _get_size_sigma(camera: ScanCamera) -> tuple[float, float]:
    return (0.0, 0.0) if camera.covariance is None else camera.pixel_size_sigma_m
