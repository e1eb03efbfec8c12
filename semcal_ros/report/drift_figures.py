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

"""The drift of a recording as a figure: path, drift, rate and residual of every frame."""

from __future__ import annotations

import io
import textwrap
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from semcal_ros.core.arrays import Array, Indices, Mask
from semcal_ros.core.drift.estimates import DriftPath, DriftStatus
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import counted, omit_numbers
from semcal_ros.files.atomic import atomic_write_bytes
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

# Resolution: 1600 px across the figure of 10 inches.
_DPI = 160.0
# Half the width of an interval that holds 95 % of a normal distribution.
_BAND = 1.96
# Letters in a line of the legend.
_LINE_LENGTH = 64
# Colours and marks of the reasons; further reasons are grouped together.
_MARKS = ((SECOND, "X"), (REFERENCE, "D"), (ACCENT, "^"), ("#8a6d00", "v"))
# Part of the height of a plot that is kept free below the curves for the marks of rejected frames.
_TICK_ROOM = 0.09


@dataclass(frozen=True)
class _Unit:
    """A unit with a prefix, and how many of it are in the unit of the path."""

    name: str
    factor: float


@dataclass(frozen=True)
class _Kind:
    """Frames that have one thing in common, and how they are marked."""

    text: str
    frames: Indices
    color: str
    mark: str


def write_drift_figure(path: DriftPath, file: Path, recording: str = "") -> None:
    """Write :func:`plot_drift` completely or not at all.

    Parameters
    ----------
    path
        Drift of at least one frame.
    file
        Name that ends in ``.png``, ``.svg`` or ``.pdf``.
    recording
        Name of the recording, for the title, which also says how large a pixel is.

    Raises
    ------
    InvalidValueError
        The path is empty.
    OSError
        The file cannot be written.
    """
    drawn = io.BytesIO()
    title = ", ".join(part for part in (recording, _describe_pixels(path)) if part)
    plot_drift(path, title).savefig(drawn, format=file.suffix.lower().removeprefix("."), dpi=_DPI)
    atomic_write_bytes(file, drawn.getvalue())


def _describe_pixels(path: DriftPath) -> str:
    """Size of the rectified pixels of the first and of the last frame; empty where it is not known."""
    if not path.calibrated or len(path) == 0:
        return ""
    sizes = [f"{1e9 / path[k].px_from_unit[0, 0]:.4g}" for k in (0, -1)]
    return " to ".join(dict.fromkeys(sizes)) + " nm per px"


def plot_drift(path: DriftPath, title: str = "") -> Figure:
    """Plot the path in the plane, and drift, rate and residual against time with 95 % bands.

    Frames whose image was not used are marked in each plot, by the kind of reason, and counted
    in the legend.

    Parameters
    ----------
    path
        Drift of at least one frame.
    title
        Above the figure; may be empty.

    Raises
    ------
    InvalidValueError
        The path is empty.
    """
    if len(path) == 0:
        raise InvalidValueError("a drift path without frames", expected="at least one frame")
    figure = create_figure(10.0, 6.6)
    if title:
        figure.suptitle(title, fontsize=10, color=INK, parse_math=False)
    kinds = _group_rejections(path)
    time, time_unit = _choose_time_unit(path)
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.0, 1.2), wspace=0.03)
    left, right = halves
    plane, key = left.subplots(2, 1, height_ratios=(3.9, 1.0))
    _draw_path(left, plane, path, kinds, time, time_unit)
    _draw_key(key, path, kinds)
    drift, rate, residual = right.subplots(3, 1, sharex=True, height_ratios=(1.25, 1.1, 0.7))
    _draw_drift(drift, path, kinds, time)
    _draw_rate(rate, path, kinds, time)
    _draw_residual(residual, path, kinds, time)
    residual.set_xlabel(f"time since the first frame ({time_unit})")
    right.align_ylabels([drift, rate, residual])
    return figure


# -- what is shown --------------------------------------------------------------------------------


def _group_rejections(path: DriftPath) -> list[_Kind]:
    """Group unused frames by reason, without its numbers; the most frequent reason first."""
    texts = [omit_numbers(update.reason) for update in path.updates]
    counts = Counter(t for t in texts if t).most_common()
    last = len(_MARKS) - 1
    groups = [(text, {text}) for text, _ in counts]
    if len(groups) > len(_MARKS):
        groups = [*groups[:last], ("other reasons", {text for text, _ in counts[last:]})]
    return [
        _Kind(text, np.flatnonzero([t in members for t in texts]), color, mark)
        for (text, members), (color, mark) in zip(groups, _MARKS, strict=False)
    ]


def _choose_time_unit(path: DriftPath) -> tuple[Array, str]:
    """Return times since the first frame and their unit."""
    seconds = path.time_s - path.time_s[0]
    longest = float(np.max(np.abs(seconds)))
    for name, size in (("h", 3600.0), ("min", 60.0)):
        if longest >= 3.0 * size:
            return seconds / size, name
    return seconds, "s"


def _choose_unit(path: DriftPath, values: Array, suffix: str = "") -> _Unit:
    """Choose the unit in which the largest value is a short number."""
    if not path.calibrated:
        return _Unit("px" + suffix, 1.0)
    known = values[np.isfinite(values)]
    largest = float(np.max(np.abs(known))) if known.size else 0.0
    for name, size in (("mm", 1e-3), ("µm", 1e-6)):
        if largest >= size:
            return _Unit(name + suffix, 1.0 / size)
    return _Unit("nm" + suffix, 1e9)


# -- path in the plane ----------------------------------------------------------------------------


def _draw_path(
    figure: SubFigure, axes: Axes, path: DriftPath, kinds: list[_Kind], time: Array, time_unit: str
) -> None:
    unit = _choose_unit(path, path.drift_m)
    x, y = unit.factor * path.drift_m.T
    style_axes(axes, xlabel=f"drift along x ({unit.name})", ylabel=f"drift along y ({unit.name})")
    axes.plot(x, y, color=MUTED, linewidth=0.8, alpha=0.6, zorder=1)
    good = path.accepted
    dots = axes.scatter(
        x[good], y[good], c=time[good], cmap="viridis", s=_choose_dot_area(len(path)), zorder=3
    )
    for kind in kinds:
        axes.scatter(
            x[kind.frames],
            y[kind.frames],
            marker=kind.mark,
            s=34,
            facecolors="none",
            edgecolors=kind.color,
            linewidths=1.0,
            zorder=4,
        )
    _set_equal_axes(axes, x, y)
    for at, text in ((0, "start"), (-1, "end"))[: min(len(path), 2)]:
        _mark_end(axes, (float(x[at]), float(y[at])), text, _find_free_direction(x, y, at))
    if len(path) > 1:
        bar = figure.colorbar(dots, ax=axes, location="top", shrink=0.7, pad=0.02, aspect=35)
        bar.set_label(f"time since the first frame ({time_unit})", fontsize=9, color=INK)
        bar.ax.tick_params(labelsize=8, colors=INK)
        bar.outline.set_visible(False)


def _set_equal_axes(axes: Axes, x: Array, y: Array) -> None:
    """Give both axes one scale, y down as in the image, with room for texts at the ends."""
    half = 0.67 * max(float(np.ptp(x)), float(np.ptp(y))) or 1.0
    middle_x, middle_y = 0.5 * float(x.min() + x.max()), 0.5 * float(y.min() + y.max())
    axes.set_xlim(middle_x - half, middle_x + half)
    axes.set_ylim(middle_y + half, middle_y - half)
    axes.set_aspect("equal")


def _choose_dot_area(frames: int) -> float:
    """Choose smaller dots if there are many."""
    return float(np.clip(900.0 / frames, 3.0, 18.0))


def _find_free_direction(x: Array, y: Array, at: int) -> tuple[float, float]:
    """Find the direction on the page from the neighbours of an end to it: away from the path."""
    near = slice(0, max(2, len(x) // 8)) if at == 0 else slice(-max(2, len(x) // 8), None)
    dx, dy = float(x[at] - x[near].mean()), float(y[at] - y[near].mean())
    length = float(np.hypot(dx, dy))
    return (dx / length, -dy / length) if length > 0.0 else (0.7, 0.7)


def _mark_end(
    axes: Axes, xy: tuple[float, float], text: str, direction: tuple[float, float]
) -> None:
    axes.plot(*xy, "o", markersize=9, markerfacecolor="none", markeredgecolor=INK, zorder=5)
    axes.annotate(
        text,
        xy,
        xytext=(19.0 * direction[0], 15.0 * direction[1]),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=9,
        color=INK,
        zorder=6,
    )


def _draw_key(axes: Axes, path: DriftPath, kinds: list[_Kind]) -> None:
    """Explain the marks, with the number of frames of each kind."""
    axes.set_axis_off()
    keyframes = sum(u.status is DriftStatus.KEYFRAME for u in path.updates)
    used = int(path.accepted.sum())
    tracked = f"{used} of {counted(len(path), 'frame')} tracked, {keyframes} of them as key frame"
    entries = [("o", "#2a788e", tracked)]
    entries += [(k.mark, k.color, _shorten(f"{len(k.frames)} not used: {k.text}")) for k in kinds]
    handles = [
        Line2D(
            [],
            [],
            linestyle="",
            marker=mark,
            color=color,
            markersize=5,
            markerfacecolor=color if mark == "o" else "none",
            label=text,
        )
        for mark, color, text in entries
    ]
    drawn = axes.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(-0.09, 1.0),
        fontsize=8.5,
        frameon=False,
        labelcolor=INK,
        handletextpad=0.3,
        labelspacing=0.4,
        borderaxespad=0.0,
    )
    # A long reason must not shrink the plot above it.
    drawn.set_in_layout(False)
    for text in drawn.get_texts():
        text.set_parse_math(False)


def _shorten(text: str) -> str:
    """Wrap a text to two lines at most."""
    lines = textwrap.wrap(text, _LINE_LENGTH, max_lines=2, placeholder=" …")
    return "\n".join(lines)


# -- against time ---------------------------------------------------------------------------------


def _draw_drift(axes: Axes, path: DriftPath, kinds: list[_Kind], time: Array) -> None:
    unit = _choose_unit(path, path.drift_m)
    style_axes(axes, xlabel="", ylabel=f"drift ({unit.name})")
    _draw_bands(axes, time, unit.factor * path.drift_m, unit.factor * path.sigma_m, path.accepted)
    axes.fill_between([], [], [], color=MUTED, alpha=0.3, linewidth=0, label="95 % band")
    _mark_rejected(axes, kinds, time)
    # Above the plot, where no curve can be.
    add_legend(axes, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.0)


def _draw_rate(axes: Axes, path: DriftPath, kinds: list[_Kind], time: Array) -> None:
    # Before a frame was matched there is no rate: its uncertainty is infinite; one of zero is none either.
    known = np.isfinite(path.velocity_sigma_m_s) & (path.velocity_sigma_m_s > 0.0)
    rate = np.where(known, path.velocity_m_s, np.nan)
    unit = _choose_unit(path, rate, "/s")
    style_axes(axes, xlabel="", ylabel=f"drift rate ({unit.name})")
    _draw_bands(
        axes, time, unit.factor * rate, unit.factor * path.velocity_sigma_m_s, path.accepted
    )
    axes.axhline(0.0, color=MUTED, linewidth=0.7, zorder=1)
    _mark_rejected(axes, kinds, time)


def _draw_residual(axes: Axes, path: DriftPath, kinds: list[_Kind], time: Array) -> None:
    style_axes(axes, xlabel="", ylabel="residual RMS\n(grey levels)")
    known = np.isfinite(path.residual)
    good = known & path.accepted
    style = "." if len(path) < 200 else ","
    axes.plot(time[good], path.residual[good], style, color=INK, markersize=5)
    for kind in kinds:
        seen = kind.frames[known[kind.frames]]
        axes.plot(
            time[seen],
            path.residual[seen],
            kind.mark,
            color=kind.color,
            markersize=5,
            markerfacecolor="none",
        )
    if known.any():
        axes.set_ylim(0.0, 1.15 * float(np.max(path.residual[known])))
    else:
        axes.set_ylim(0.0, 1.0)
    _mark_rejected(axes, kinds, time)


def _draw_bands(axes: Axes, time: Array, values: Array, sigma: Array, good: Mask) -> None:
    """Draw both axes with bands; a few very uncertain frames do not set the limits."""
    for k, (name, color, line) in enumerate((("x", OURS, "-"), ("y", SECOND, "--"))):
        known = np.isfinite(values[:, k]) & np.isfinite(sigma[:, k])
        half = np.where(known, _BAND * sigma[:, k], np.nan)
        axes.fill_between(
            time,
            values[:, k] - half,
            values[:, k] + half,
            color=color,
            alpha=0.22,
            linewidth=0,
            zorder=2,
        )
        mark = "" if len(time) > 80 else "."
        axes.plot(
            time,
            values[:, k],
            mark + line,
            color=color,
            linewidth=1.2,
            markersize=4,
            label=name,
            zorder=3,
        )
    shown = values[np.isfinite(values)]
    if not shown.size:
        return
    usual = good[:, None] & np.isfinite(values) & np.isfinite(sigma)
    half_width = float(np.quantile(_BAND * sigma[usual], 0.9)) if usual.any() else 0.0
    low, high = float(shown.min()) - half_width, float(shown.max()) + half_width
    room = 0.06 * (high - low) if high > low else 1.0
    axes.set_ylim(low - room, high + room)


def _mark_rejected(axes: Axes, kinds: list[_Kind], time: Array) -> None:
    """Draw a line at each unused frame, with its mark at the lower edge of the plot."""
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    if not kinds:
        return
    low, high = axes.get_ylim()
    axes.set_ylim(low - _TICK_ROOM * (high - low), high)
    for kind in kinds:
        at = time[kind.frames]
        across = axes.get_xaxis_transform()
        axes.vlines(at, 0.0, 1.0, transform=across, color=kind.color, linewidth=0.8, alpha=0.3)
        axes.plot(
            at,
            np.full(len(at), 0.04),
            kind.mark,
            transform=across,
            color=kind.color,
            markerfacecolor="white",
            markersize=5,
            zorder=6,
        )
