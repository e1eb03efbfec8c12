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

"""Figures of the errors, measured and predicted, against the magnification and over the field; and of distortion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.evaluate import rms_by_magnification
from semcal_ros.core.calibration.judgement.findings import (
    assign_cells,
    concatenate_corners,
    normalise_residuals,
)
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.uncertainty import (
    make_field_lattice,
    predict_aligned_sigma_px,
    predict_shape_sigma_px,
)
from semcal_ros.core.wording import counted
from semcal_ros.report.calibration.curves import (
    mark_magnifications,
    read_curve,
    sample_cameras,
    sample_cameras_around,
)
from semcal_ros.report.calibration.numbers import (
    PAPER_RMS_PX,
    compute_displacements,
    remove_residual_field,
)
from semcal_ros.report.html.encode import Picture, Readings, encode_figure
from semcal_ros.report.html.page import format_length, format_magnification, format_px
from semcal_ros.report.html.style import (
    ACCENT,
    INK,
    LIGHT_MAP,
    MUTED,
    OURS,
    REFERENCE,
    SECOND,
    add_legend,
    choose_arrow_factor,
    create_figure,
    draw_contours,
    set_log_axis_y,
    set_magnification_axis,
    style_axes,
    style_field_axes,
)

# Ends of the histogram, in sigma; what lies beyond is counted in the last bins.
_HISTOGRAM_LIMIT = 5.0
# Cells across the field for mean residuals: large enough to hold many corners each.
_RESIDUAL_CELLS = 12
# More arrows overlap in a figure of this size.
_MAX_ARROWS = 700
# Least number of corners in a cell: the mean of fewer residuals says little.
_MIN_IN_CELL = 5

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


def plot_rms(
    result: CalibrationResult, straight: Mapping[float, float], *, paper: bool = False
) -> Picture:
    """Plot RMS and held-out RMS at each magnification, on request beside the values of the paper.

    ``straight`` is the error without correction of the distortion.
    """
    rms = rms_by_magnification(result.fit)
    g = np.array(list(rms))
    values = np.array(list(rms.values()))
    held = np.array([result.held_out_rms_px.get(float(x), np.nan) for x in g])
    uncorrected = np.array([straight.get(float(x), np.nan) for x in g])
    noise = _predict_rms(result, g)
    pixel_nm = np.array([1e9 * np.mean(result.model.at(float(x)).pixel_size_m) for x in g])
    figure = create_figure(4.6, 5.4)
    axes, lengths = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    style_axes(axes, xlabel="", ylabel="RMS error (px)")
    style_axes(lengths, xlabel="magnification", ylabel="RMS error (nm)")
    of_paper = PAPER_RMS_PX if paper else ()
    for value, style in zip(of_paper, ("--", "-."), strict=False):
        axes.axhline(
            value, color=REFERENCE, linestyle=style, linewidth=1.2, label=f"paper: {value:g} px"
        )
    axes.plot(
        g, uncorrected, "^:", color=MUTED, markersize=4, linewidth=1.0, label="distortion left in"
    )
    axes.plot(g, values, "o-", color=OURS, markersize=4, linewidth=1.2, label="all views fitted")
    axes.plot(g, noise, "_", color=ACCENT, markersize=9, markeredgewidth=1.6, label="corner noise")
    _plot_held_out(axes, g, held)
    lengths.plot(g, values * pixel_nm, "o-", color=OURS, markersize=4, linewidth=1.2)
    _plot_held_out(lengths, g, held * pixel_nm)
    set_magnification_axis(lengths, g[0], g[-1])
    in_nm = np.concatenate([values, held]) * np.concatenate([pixel_nm, pixel_nm])
    in_nm = in_nm[np.isfinite(in_nm) & (in_nm > 0.0)]
    set_log_axis_y(lengths, 0.6 * float(in_nm.min()), 1.7 * float(in_nm.max()))
    shown = np.concatenate([values, held, uncorrected, noise, of_paper])
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    set_log_axis_y(axes, 0.6 * float(shown.min()), 1.7 * float(shown.max()))
    add_legend(axes, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.0)
    figure.align_ylabels([axes, lengths])
    return encode_figure(
        figure,
        f"RMS error against magnification, {values.min():.3f} to {values.max():.3f} px"
        + (f", beside the paper's {of_paper[0]:g} and {of_paper[1]:g} px." if of_paper else "."),
        "Held out: the images of this magnification, judged by a "
        "calibration from all other magnifications. Hollow: the lowest and highest one, which are "
        "extrapolated in this test. Corner noise: what the uncertainty of the corners alone "
        "explains.",
        Readings(
            [axes, lengths],
            g,
            [
                f"{format_magnification(x)}: fitted {_format_error(fitted, nm)}; "
                f"held out {_format_error(left_out, nm)}; distortion left in {_format_error(left_in, nm)}"
                for x, nm, fitted, left_out, left_in in zip(
                    g, pixel_nm, values, held, uncorrected, strict=True
                )
            ],
        ),
    )


def _format_error(px: float, pixel_nm: float) -> str:
    """An error in px and as a length; a dash where it is not known."""
    if not np.isfinite(px):
        return format_px(px)
    return f"{format_px(px)}, {format_length(1e-9 * px * pixel_nm)}"


def _predict_rms(result: CalibrationResult, g: Array) -> Array:
    """Predict the (G,) RMS error from the 1-sigma of the corners alone, px."""
    variances: dict[float, list[Array]] = {float(x): [] for x in g}
    for view in result.views:
        variances[float(view.magnification)].append(view.dimensions * view.sigma_px**2)
    return np.array([np.sqrt(np.mean(np.concatenate(v))) for v in variances.values()])


def _plot_held_out(axes: Axes, g: Array, held: Array) -> None:
    if len(g) < 2 or not np.any(np.isfinite(held)):
        return
    inner = np.isfinite(held)
    inner[[0, -1]] = False
    ends = np.isfinite(held) & ~inner
    axes.plot(g[inner], held[inner], "s", color=SECOND, markersize=4.5, label="held out")
    axes.plot(
        g[ends],
        held[ends],
        "s",
        color=SECOND,
        markersize=5,
        markerfacecolor="none",
        label="held out, extrapolated",
    )


def plot_residual_histogram(result: CalibrationResult) -> Picture:
    """Plot a histogram of residuals over their 1-sigma, beside the normal distribution."""
    values = normalise_residuals(result).ravel()
    beyond = float(np.mean(np.abs(values) > 3.0))
    spread = float(np.sqrt(np.mean(values**2)))
    limit = _HISTOGRAM_LIMIT
    figure = create_figure(4.6, 3.2)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="residual over its predicted 1-sigma", ylabel="share per unit")
    edges = np.linspace(-limit, limit, 51)
    density = np.histogram(np.clip(values, -limit, limit), edges)[0] / (
        len(values) * np.diff(edges)
    )
    axes.stairs(density, edges, fill=True, color=OURS, alpha=0.45, label="residuals")
    x = np.linspace(-limit, limit, 201)
    axes.plot(
        x,
        np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi),
        "--",
        color=INK,
        linewidth=1.3,
        label="normal distribution",
    )
    axes.set_xlim(-limit, limit)
    add_legend(axes, loc="upper left")
    text = f"spread {spread:.2f}; {100.0 * beyond:.1f} % beyond 3 (normal: 0.3 %)"
    return encode_figure(
        figure,
        f"Histogram of residuals over their predicted 1-sigma: {text}.",
        f"Residuals over the predicted uncertainty of their corners: {text}. Wider than the dashed "
        "line: the corners are worse than they claim, or the model misses something.",
    )


def plot_mean_residuals(result: CalibrationResult) -> Picture:
    """Plot the mean residual vector in each cell: systematic errors, with noise averaged out."""
    xy, residuals = concatenate_corners(result)
    cells = assign_cells(result, xy, _RESIDUAL_CELLS)
    size = cells.columns * cells.rows
    counts = cells.counts
    sums = np.stack([np.bincount(cells.index, residuals[:, k], size) for k in (0, 1)], axis=1)
    enough = counts >= _MIN_IN_CELL
    means = sums[enough] / counts[enough, None]
    lengths = np.hypot(means[:, 0], means[:, 1])
    width, height = result.model.image_size
    figure = create_figure(4.2, 0.6 + 3.6 * min(height / width, 1.6))
    axes = figure.add_subplot()
    style_field_axes(axes, width, height)
    if not len(means):
        return encode_figure(
            figure,
            "No cell of the field has enough corners for a mean residual.",
            f"No cell of the field has {_MIN_IN_CELL} corners.",
        )
    factor = choose_arrow_factor(float(lengths.max()), width / _RESIDUAL_CELLS)
    _draw_arrows(axes, cells.centres[enough], means, factor, OURS)
    text = f"largest {lengths.max():.3f} px, RMS of the means {np.sqrt(np.mean(lengths**2)):.3f} px"
    return encode_figure(
        figure,
        f"Mean residual vectors in {len(means)} cells of the field, drawn {factor:g} times as "
        f"long; {text}.",
        f"Mean residual in each cell, arrows {factor:g} times as long as the error; {text}. "
        "A pattern here is a distortion that the model does not describe.",
    )


def plot_residuals(result: CalibrationResult) -> Picture:
    """Plot residual vectors of single corners; if there are too many, a fixed random sample."""
    xy, residuals = concatenate_corners(result)
    chosen = np.arange(len(xy))
    if len(xy) > _MAX_ARROWS:
        chosen = np.random.default_rng(0).choice(len(xy), _MAX_ARROWS, replace=False)
    lengths = np.hypot(residuals[:, 0], residuals[:, 1])
    width, height = result.model.image_size
    factor = choose_arrow_factor(float(np.quantile(lengths, 0.95)), width / 12)
    figure = create_figure(4.2, 0.6 + 3.6 * min(height / width, 1.6))
    axes = figure.add_subplot()
    style_field_axes(axes, width, height)
    _draw_arrows(axes, xy[chosen], residuals[chosen], factor, SECOND)
    part = f"{len(chosen)} of {counted(len(xy), 'corner')}"
    return encode_figure(
        figure,
        f"Residual vectors of {part} over the field, drawn {factor:g} times as long.",
        f"Residuals (found minus predicted) of {part}, arrows {factor:g} times as long as the "
        f"error; half of all are below {np.median(lengths):.3f} px, the longest is "
        f"{lengths.max():.3f} px.",
    )


def _draw_arrows(axes: Axes, xy: Array, vectors: Array, factor: float, color: str) -> None:
    # angles="xy" follows the downward y axis; scale 1 in data units makes the stated factor true.
    axes.quiver(
        xy[:, 0],
        xy[:, 1],
        factor * vectors[:, 0],
        factor * vectors[:, 1],
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=color,
        width=0.0035,
        headwidth=3.5,
        headlength=4.0,
        headaxislength=3.6,
    )


def plot_distortion(camera: ScanCamera) -> Picture:
    """Plot the displacement of pixels by the distortion at one magnification."""
    xy, moved = compute_displacements(camera)
    g = format_magnification(camera.magnification)
    figure, factor, largest = _draw_displacements(camera, xy, moved)
    largest_nm = _format_length(camera, largest)
    figure.axes[0].plot(
        [camera.ex], [camera.ey], "+", color=SECOND, markersize=12, markeredgewidth=2
    )
    return encode_figure(
        figure,
        f"Displacement of pixels by the distortion at {g}, at most {largest:.3g} px, arrows "
        f"{factor:g} times as long.",
        f"{g}: at most {largest:.3g} px, {largest_nm} (numbers on the lines: px); arrows {factor:g} times as "
        "long, + is the centre of the distortion.",
    )


def plot_residual_field(model: CalibrationModel, cameras: Sequence[ScanCamera]) -> list[Picture]:
    """Plot what a residual field adds to the distortion; empty without such a field."""
    if model.residual is None:
        return []
    pictures = []
    for camera in cameras:
        xy, moved = compute_displacements(camera)
        parametric = compute_displacements(remove_residual_field(camera))[1]
        figure, factor, largest = _draw_displacements(camera, xy, moved - parametric)
        g = format_magnification(camera.magnification)
        pictures.append(
            encode_figure(
                figure,
                f"Displacement of pixels by the residual field at {g}, at most {largest:.3g} px, "
                f"arrows {factor:g} times as long.",
                f"{g}: at most {largest:.3g} px, {_format_length(camera, largest)} (numbers on the lines: px); "
                f"arrows {factor:g} "
                "times as long.",
            )
        )
    return pictures


def _format_length(camera: ScanCamera, px: float) -> str:
    """A displacement as a length on the specimen."""
    return format_length(px * float(np.mean(camera.pixel_size_m)))


def _add_length_axis(axes: Axes, camera: ScanCamera) -> None:
    """Add an axis at the top that has the columns as lengths on the specimen."""
    pixel_m = camera.pixel_size_m[0]
    width_m = pixel_m * camera.width
    unit, size_m = ("µm", 1e-6) if width_m >= 1e-6 else ("nm", 1e-9)
    if width_m >= 1e-2:
        unit, size_m = "mm", 1e-3
    factor = pixel_m / size_m
    top = axes.secondary_xaxis(
        "top", functions=(partial(np.multiply, factor), partial(np.multiply, 1.0 / factor))
    )
    top.set_xlabel(f"column ({unit})", fontsize=9, color=INK)
    top.tick_params(labelsize=8, colors=INK)


def _draw_displacements(camera: ScanCamera, xy: Array, moved: Array) -> tuple[Figure, float, float]:
    """Draw arrows and contours of length; also return arrow factor and largest length, px."""
    known = np.all(np.isfinite(moved), axis=1)
    lengths = np.hypot(moved[:, 0], moved[:, 1])
    largest = float(lengths[known].max()) if np.any(known) else 0.0
    factor = choose_arrow_factor(largest, camera.width / 7)
    figure = create_figure(4.2, 0.6 + 3.6 * min(camera.height / camera.width, 1.6))
    axes = figure.add_subplot()
    style_field_axes(axes, camera.width, camera.height)
    axes.grid(False)
    _add_length_axis(axes, camera)
    across = int(np.sum(xy[:, 1] == xy[0, 1]))
    draw_contours(
        axes, xy[:across, 0], xy[::across, 1], lengths.reshape(-1, across), largest, lines=4
    )
    _draw_arrows(axes, xy[known], moved[known], factor, OURS)
    return figure, factor, largest


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
