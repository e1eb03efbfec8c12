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

"""Figures of a bending experiment: deflections by pose and magnification, and annotated frames."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from semcal_ros.applications.cantilever import Deflection, Repeatability, Series, group_frames
from semcal_ros.core.errors import BagError
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.files.images.scale_bar import choose_scale_bar, format_length
from semcal_ros.files.images.write import PixelScale
from semcal_ros.files.video import BLACK_WHITE, open_video, shade
from semcal_ros.report.html.encode import encode_png
from semcal_ros.report.html.style import (
    ACCENT,
    INK,
    MUTED,
    OURS,
    REFERENCE,
    SECOND,
    add_legend,
    create_figure,
    style_axes,
)

# Resolution of figures, dots per inch.
_DPI = 90.0
_COLORS = (OURS, SECOND, ACCENT, REFERENCE, "#8a6d00", MUTED)
_MARKS = "osD^vX"
# Columns of the figure of frames: first, most bent and last pose.
_SHOWN_POSES = 3
# Width of the shown frames: averaging pixels reduces noise and the size of the file.
_SHOWN_PX = 128
# OpenCV draws at sixteenths of a pixel.
_FRACTION_BITS = 4


def write_poses_figure(agreed: Repeatability, file: Path) -> None:
    """Write :func:`plot_poses` completely or not at all; OSError if that fails."""
    _write(plot_poses(agreed), file)


def write_strip_figure(
    images: Sequence[Sequence[NDArray[Any]]],
    series: Sequence[Series],
    scales: Sequence[PixelScale],
    firsts: Sequence[int],
    file: Path,
) -> None:
    """Write :func:`plot_strip` completely or not at all; OSError if that fails."""
    _write(plot_strip(images, series, scales, firsts), file)


def write_bending_video(
    images: Sequence[Sequence[NDArray[Any]]],
    series: Sequence[Series],
    scales: Sequence[PixelScale],
    poses: int | None,
    fps: float,
    file: Path,
) -> None:
    """Write all frames with the line of the beam, its deflection and a scale bar, one series after the other.

    Parameters
    ----------
    images
        (h, w) grey images of the frames of each series.
    series
        What was measured in them.
    scales
        Pixel size of the images of each series.
    poses
        As for :func:`~semcal_ros.applications.cantilever.repeatability.group_frames`.
    fps
        Frames per second.
    file
        ``.mp4`` or ``.avi``.

    Raises
    ------
    BagError
        The images have different sizes, or the video is missing some of its frames.
    InvalidValueError
        There is no encoder for the file.
    """
    shapes = {pictures[0].shape for pictures in images}
    if len(shapes) > 1:
        raise BagError(f"{file} of frames of sizes {sorted(shapes)}", expected="one size")
    height, width = next(iter(shapes))
    some = np.concatenate([pictures[0][::4, ::4].ravel() for pictures in images])
    low, high = (float(v) for v in np.quantile(some, BLACK_WHITE))
    count = sum(len(pictures) for pictures in images)
    with open_video(file, (width, height), count, fps) as film:
        assert film is not None
        for pictures, one, scale in zip(images, series, scales, strict=True):
            bar = choose_scale_bar(width, scale.size_m, scale.sigma_m)
            groups = enumerate(group_frames(len(pictures), poses), 1)
            pose_of = {k: number for number, group in groups for k in group}
            for k, frame in enumerate(one.frames):
                nm, sigma = 1e9 * frame.deflection_m, 1e9 * frame.sigma_m
                film.write(
                    shade(draw_deflection(pictures[k], frame, (low, high)), (low, high)),
                    f"{one.magnification:g}x  pose {pose_of[k]}  {nm:.1f} +- {sigma:.1f} nm",
                    bar,
                )


def _write(figure: Figure, file: Path) -> None:
    kind = file.suffix.lower().removeprefix(".")
    if kind == "png":
        atomic_write_bytes(file, encode_png(figure, _DPI, keep_rare_colors=True))
        return
    encoded = io.BytesIO()
    figure.savefig(encoded, format=kind, dpi=_DPI)
    atomic_write_bytes(file, encoded.getvalue())


def plot_poses(agreed: Repeatability) -> Figure:
    """Plot the deflection of each pose and magnification with 95 % bars; also minus the mean."""
    figure = create_figure(7.2, 5.6)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    pose = np.arange(1, agreed.deflection_m.shape[1] + 1)
    style_axes(upper, xlabel="", ylabel="deflection of the end (nm)")
    style_axes(lower, xlabel="pose", ylabel="from the mean (nm)")
    mean = np.nanmean(agreed.deflection_m, axis=0)
    count = len(agreed.magnifications)
    for row, g in enumerate(agreed.magnifications):
        color, mark = _COLORS[row % len(_COLORS)], _MARKS[row % len(_MARKS)]
        position = pose + 0.12 * (row - 0.5 * (count - 1))
        for axes, values in (
            (upper, agreed.deflection_m[row]),
            (lower, agreed.deflection_m[row] - mean),
        ):
            axes.errorbar(
                position,
                1e9 * values,
                yerr=1.96e9 * agreed.sigma_m[row],
                fmt=mark,
                color=color,
                markersize=4,
                linewidth=1.0,
                capsize=2,
                label=f"{g:g}×",
            )
    if count > 1:
        text = f"spread {1e9 * agreed.rms_spread_m:.2f} nm (RMS over poses 2 to {len(pose)})"
        lower.set_title(text, fontsize=9, color=INK, loc="left")
    lower.xaxis.set_major_locator(MaxNLocator(integer=True))
    lower.axhline(0.0, color=MUTED, linewidth=0.7)
    # Above the plot: a beam may bend to either side.
    add_legend(upper, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, borderaxespad=0.0)
    return figure


def plot_strip(
    images: Sequence[Sequence[NDArray[Any]]],
    series: Sequence[Series],
    scales: Sequence[PixelScale],
    firsts: Sequence[int],
) -> Figure:
    """Plot the first, most bent and last pose at each magnification, with the centre line and a scale bar.

    Parameters
    ----------
    images
        Frames of each series.
    series
        What was measured.
    scales
        Pixel size of the images of each series.
    firsts
        First frame of each pose.
    """
    deflections_m = [abs(series[0].frames[k].deflection_m) for k in firsts]
    most = int(np.nanargmax(deflections_m)) if np.isfinite(deflections_m).any() else 0
    poses = sorted({0, most, len(firsts) - 1})[:_SHOWN_POSES]
    figure = create_figure(2.1 * len(poses), 2.2 * len(series))
    grid = figure.subplots(len(series), len(poses), squeeze=False)
    for row, (pictures, one, scale) in enumerate(zip(images, series, scales, strict=True)):
        for column, pose in enumerate(poses):
            axes = grid[row, column]
            _draw_frame(axes, pictures[firsts[pose]], one, firsts[pose], pose)
            _draw_bar(axes, pictures[firsts[pose]].shape, scale)
    return figure


def _draw_bar(axes: Axes, shape: tuple[int, ...], scale: PixelScale) -> None:
    """Draw a scale bar into the lower right corner, white with a black edge."""
    height, width = shape[:2]
    bar = choose_scale_bar(width, scale.size_m)
    x, y = 0.96 * width, 0.95 * height
    edge = [Stroke(linewidth=2.4, foreground="black"), Normal()]
    axes.plot(
        [x - bar.length_px, x],
        [y, y],
        color="white",
        linewidth=2.0,
        path_effects=edge,
        solid_capstyle="butt",
    )
    text = format_length(bar.length_m)
    axes.text(
        x,
        y - 0.03 * height,
        text,
        ha="right",
        va="bottom",
        fontsize=6,
        color="white",
        path_effects=edge,
    )


def _draw_frame(axes: Axes, image: NDArray[Any], one: Series, frame: int, pose: int) -> None:
    found = one.frames[frame]
    step = max(1, round(image.shape[1] / _SHOWN_PX))
    rows, cols = (n // step * step for n in image.shape)
    cut = image[:rows, :cols].reshape(rows // step, step, cols // step, step)
    low, high = np.quantile(image[::4, ::4], (0.005, 0.995))
    axes.imshow(
        cut.mean(axis=(1, 3)),
        cmap="gray",
        vmin=low,
        vmax=max(high, low + 1),
        extent=(-0.5, cols - 0.5, rows - 0.5, -0.5),
    )
    axes.plot(*found.line_px.T, color="#ff9000", linewidth=1.2)
    inside = (0 <= found.tip_px[0] < cols) and (0 <= found.tip_px[1] < rows)
    if inside:
        axes.plot(*found.tip_px, "o", markersize=6, markerfacecolor="none", color="#ff3010")
    axes.set_xlim(-0.5, cols - 0.5)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.set_xticks([])
    axes.set_yticks([])
    nm, sigma = 1e9 * found.deflection_m, 1e9 * found.sigma_m
    title = f"{one.magnification:g}×, pose {pose + 1}: {nm:.1f} ± {sigma:.1f} nm"
    axes.set_title(title, fontsize=7, color=INK)


def draw_deflection(
    image: NDArray[Any], frame: Deflection, grey: tuple[float, float]
) -> NDArray[np.float32]:
    """Draw the centre line and the end of the beam into an image, in black and white.

    Parameters
    ----------
    image
        (h, w) raw grey image.
    frame
        What was measured in it.
    grey
        Grey levels of black and white.
    """
    out = np.array(image, dtype=np.float32)
    scale = max(1, round(max(image.shape) / 512))
    points = frame.line_px[np.isfinite(frame.line_px).all(axis=1)]
    fixed = np.round(points * 2**_FRACTION_BITS).astype(np.int32)
    for level, width in ((grey[0], 3 * scale), (grey[1], scale)):
        cv2.polylines(out, [fixed[:, None]], False, float(level), width, cv2.LINE_8, _FRACTION_BITS)
        tip = frame.tip_px
        if np.isfinite(tip).all() and np.all(np.abs(tip) < 1e5):
            at = round(float(tip[0])), round(float(tip[1]))
            cv2.circle(out, at, 5 * scale, float(level), width)
    return out
