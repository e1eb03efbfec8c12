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

"""Figures of the predicted error over field and magnification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.uncertainty import (
    make_field_lattice,
    predict_aligned_sigma_px,
    predict_shape_sigma_px,
)
from semcal_ros.report.calibration.curves import (
    mark_magnifications,
    read_curve,
    sample_cameras,
    sample_cameras_around,
)
from semcal_ros.report.html.encode import Picture, encode_figure
from semcal_ros.report.html.style import (
    ACCENT,
    INK,
    LIGHT_MAP,
    OURS,
    SECOND,
    add_legend,
    create_figure,
    draw_contours,
    set_log_axis_y,
    set_magnification_axis,
    style_axes,
    style_field_axes,
)
from semcal_ros.report.html.text import format_length, format_magnification

# The map extends by this factor beyond the calibrated range, to show what extrapolation costs.
_BEYOND = 1.5
# Magnifications across the map.
_COLUMNS = 61
# Circles around the image centre in the map.
_RINGS = 24
# Directions on each circle, every 11 degrees; the corners of the field are added.
_DIRECTIONS = 32
# Points across the field in the maps over it.
_ACROSS = 17


def plot_predicted_errors(model: CalibrationModel) -> list[Picture]:
    """Plot a map over distance and magnification, maps over the field, and curves; of one magnification only its field.

    The list is empty for a calibration without uncertainty.
    """
    cameras = sample_cameras(model)
    if any(c.covariance is None for c in cameras):
        return []
    lattice = make_field_lattice(*model.image_size, 9)
    shape = np.stack([predict_shape_sigma_px(c, lattice) for c in cameras])
    worst = (
        cameras[int(np.nanargmax(np.nanmax(shape, axis=1)))] if _has_finite(shape) else cameras[0]
    )
    fields = _plot_fields(model, worst)
    if len(cameras) == 1:
        return [fields]
    return [_plot_map(model), fields, _plot_curves(model, cameras, lattice, shape)]


def _has_finite(values: Array) -> bool:
    return bool(np.any(np.isfinite(values)))


# -- map ------------------------------------------------------------------------------------------


def _plot_map(model: CalibrationModel) -> Picture:
    """Plot the largest predicted error over magnification and distance from the centre."""
    cameras = sample_cameras_around(model, _BEYOND, _COLUMNS)
    g = np.array([c.magnification for c in cameras])
    radii, points, ring = _sample_rings(model)
    table = np.full((len(radii), len(cameras)), np.nan)
    for column, camera in enumerate(cameras):
        sigma = np.nan_to_num(predict_shape_sigma_px(camera, points), nan=np.inf)
        largest = np.zeros(len(radii))
        np.maximum.at(largest, ring, sigma)
        table[:, column] = np.where(np.isfinite(largest), largest, np.nan)
    low, high = model.magnification_range
    inside = table[:, (g >= low) & (g <= high)]
    top = float(np.nanmax(inside)) if _has_finite(inside) else 1.0
    figure = create_figure(4.6, 3.6)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="magnification", ylabel="distance from the image centre (px)")
    axes.grid(False)
    axes.pcolormesh(
        g,
        radii,
        table,
        cmap=LIGHT_MAP,
        vmin=0.0,
        vmax=1.3 * top,
        shading="gouraud",
        rasterized=True,
    )
    set_magnification_axis(axes, g[0], g[-1])
    axes.set_ylim(0.0, float(radii[-1]))
    draw_contours(axes, g, radii, table, 1.2 * top, lines=8)
    for edge in (low, high):
        axes.axvline(edge, color=INK, linewidth=1.2, linestyle="--")
    for start, end in ((g[0], low), (high, g[-1])):
        axes.axvspan(start, end, facecolor="none", edgecolor=INK, hatch="///", alpha=0.18)
    mark_magnifications(axes, model)
    ends = [_get_largest_at(table, g, x) for x in (low / _BEYOND, high * _BEYOND)]
    return encode_figure(
        figure,
        "Map of the predicted error over magnification and distance from the image centre: at "
        f"most {top:.2g} px in the calibrated range.",
        "Predicted 1-sigma error (px, numbers on the lines) of positions relative to the image "
        f"centre, the worst direction at each distance: at most {top:.2g} px in the calibrated "
        f"range. Hatched: extrapolated, up to {max(ends):.2g} px.",
    )


def _get_largest_at(table: Array, g: Array, x: float) -> float:
    column = table[:, int(np.argmin(np.abs(np.log(g / x))))]
    return float(np.nanmax(column)) if _has_finite(column) else float("inf")


def _sample_rings(model: CalibrationModel) -> tuple[Array, Array, Indices]:
    """Sample radii (px), points of the field on these circles, and the circle of each point."""
    width, height = model.image_size
    centre = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    radii = np.linspace(0.0, float(np.hypot(*centre)), _RINGS)
    # The corners of the field are among the directions, so that the last circle is not empty.
    angles = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    diagonal = float(np.arctan2(centre[1], centre[0]))
    angles = np.unique([*angles, diagonal, np.pi - diagonal, np.pi + diagonal, -diagonal])
    offsets = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ring = np.repeat(np.arange(len(radii)), len(angles))
    flat = offsets.reshape(-1, 2)
    inside = np.all(np.abs(flat) <= centre * (1.0 + 1e-9), axis=1)
    return radii, flat[inside] + centre, ring[inside]


# -- fields ---------------------------------------------------------------------------------------


def _plot_fields(model: CalibrationModel, worst: ScanCamera) -> Picture:
    """Plot the predicted error over the field at the ends, in the middle, and at the worst."""
    low, high = model.magnification_range
    chosen = {c.magnification: c for c in (model.at(low), worst, model.at(high))}
    if high > low:
        middle = model.at(float(np.sqrt(low * high)))
        chosen[middle.magnification] = middle
    cameras = [chosen[g] for g in sorted(chosen)]
    width, height = model.image_size
    lattice = make_field_lattice(width, height, _ACROSS)
    down = len(lattice) // _ACROSS
    tables = [predict_shape_sigma_px(c, lattice).reshape(down, _ACROSS) for c in cameras]
    top = max((float(np.nanmax(t)) for t in tables if _has_finite(t)), default=1.0)
    columns = 1 if len(cameras) == 1 else 2
    rows = -(-len(cameras) // columns)
    figure = create_figure(4.6, 0.4 + rows * (0.45 + 3.9 / columns * min(height / width, 1.6)))
    x, y = lattice[:_ACROSS, 0], lattice[::_ACROSS, 1]
    for k, (camera, table) in enumerate(zip(cameras, tables, strict=True)):
        axes = figure.add_subplot(rows, columns, k + 1)
        _draw_field(axes, x, y, table, top)
        axes.set_title(format_magnification(camera.magnification), fontsize=9, color=INK)
        if k % columns:
            axes.set_ylabel("")
        if k < len(cameras) - columns:
            axes.set_xlabel("")
    peaks = ", ".join(
        f"{np.nanmax(t):.2g} px ({format_length(float(np.nanmax(t) * np.mean(c.pixel_size_m)))}) at "
        f"{format_magnification(c.magnification)}"
        for c, t in zip(cameras, tables, strict=True)
        if _has_finite(t)
    )
    return encode_figure(
        figure,
        f"Maps of the predicted error over the field at {len(cameras)} magnifications; "
        f"largest: {peaks}.",
        f"Predicted 1-sigma error (px) relative to the image centre over the field. Largest: {peaks}.",
    )


def _draw_field(axes: Axes, x: Array, y: Array, table: Array, top: float) -> None:
    style_field_axes(axes, round(float(x[-1])) + 1, round(float(y[-1])) + 1)
    axes.grid(False)
    axes.pcolormesh(
        x, y, table, cmap=LIGHT_MAP, vmin=0.0, vmax=1.3 * top, shading="gouraud", rasterized=True
    )
    draw_contours(
        axes, x, y, table, float(np.nanmax(table)) if _has_finite(table) else top, lines=4
    )


# -- curves ---------------------------------------------------------------------------------------


def _plot_curves(
    model: CalibrationModel, cameras: list[ScanCamera], lattice: Array, shape: Array
) -> Picture:
    """Plot the predicted error against the magnification, with and without a fitted pose."""
    g = np.array([c.magnification for c in cameras])
    aligned = np.stack([predict_aligned_sigma_px(c, lattice) for c in cameras])
    total = max(float(np.nanmax(c.project_sigma(c.sem_from_ideal(lattice)))) for c in cameras)
    pixel_nm = np.array([1e9 * np.mean(c.pixel_size_m) for c in cameras])
    figure = create_figure(4.6, 5.0)
    axes, lengths = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    style_axes(axes, xlabel="", ylabel="predicted 1-sigma (px)")
    style_axes(lengths, xlabel="magnification", ylabel="predicted 1-sigma (nm)")
    mark = "o" if len(g) == 1 else ""
    shown = []
    for values, color, line, label in (
        (np.nanmax(shape, axis=1), SECOND, "-", "relative to the centre, worst point"),
        (np.sqrt(np.nanmean(shape**2, axis=1)), ACCENT, "--", "relative to the centre, RMS"),
        (np.nanmax(aligned, axis=1), OURS, "-.", "pose fitted, worst point"),
        (np.sqrt(np.nanmean(aligned**2, axis=1)), INK, ":", "pose fitted, RMS"),
    ):
        axes.plot(g, values, mark + line, color=color, linewidth=1.5, label=label)
        lengths.plot(g, values * pixel_nm, mark + line, color=color, linewidth=1.5)
        shown.append(values)
    positive = np.concatenate(shown)
    positive = positive[np.isfinite(positive) & (positive > 0.0)]
    set_magnification_axis(lengths, g[0], g[-1])
    if positive.size:
        set_log_axis_y(axes, 0.6 * float(positive.min()), 1.7 * float(positive.max()))
        in_nm = np.concatenate([values * pixel_nm for values in shown])
        in_nm = in_nm[np.isfinite(in_nm) & (in_nm > 0.0)]
        set_log_axis_y(lengths, 0.6 * float(in_nm.min()), 1.7 * float(in_nm.max()))
    mark_magnifications(lengths, model)
    # Above: over several decades no place within is free of curves.
    add_legend(axes, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=1, borderaxespad=0.0)
    figure.align_ylabels([axes, lengths])
    worst, left = float(np.nanmax(shape)), float(np.nanmax(aligned))
    return encode_figure(
        figure,
        f"Predicted error of positions relative to the image centre, at most {worst:.2g} px over "
        f"field and range; {left:.2g} px after the pose is fitted.",
        f"At most {worst:.2g} px relative to the image centre: this contains the scale, which "
        "errors of the fit do not show, because a wrong scale and a wrong height of the grid look "
        f"alike. With shift, turn and scale fitted, {left:.2g} px are left. A shift that is common "
        f"to the whole image brings the error of an absolute position to {total:.2g} px.",
        replace(
            read_curve(
                axes,
                g,
                [
                    f"relative to the centre at most {a:.2g} px, {format_length(1e-9 * a * nm)}; pose fitted at most "
                    f"{b:.2g} px, {format_length(1e-9 * b * nm)}"
                    for a, b, nm in zip(shown[0], shown[2], pixel_nm, strict=True)
                ],
            ),
            axes=[axes, lengths],
        ),
    )
