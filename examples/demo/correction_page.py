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

"""The report of a correction: errors before and after, with pictures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.ticker import NullFormatter, ScalarFormatter
from numpy.typing import NDArray

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.images.scale_bar import choose_scale_bar, draw_scale_bar, format_length
from semcal_ros.report.html.encode import Picture, encode_figure, encode_pictures
from semcal_ros.report.html.page import format_px, remove_control_characters, render, write_page
from semcal_ros.report.html.style import INK, OURS, REFERENCE, add_legend, create_figure, style_axes

__all__ = ["DemoRow", "overlay_change", "write_correction_report"]

# Of both frames, px: small enough to see single squares, and enlarged to so many.
_MIDDLE_PX, _SHOWN_PX = 160, 640
_HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class DemoRow:
    """One stage of the correction.

    Attributes
    ----------
    label
        Such as "with drift correction".
    rms_px
        RMS error measured here, px.
    at
        The same at single magnifications: (magnification, RMS error in px, pixel size in m).
    paper_px
        What the paper reports for this stage, px: a number, a (low, high) pair, or None.
    """

    label: str
    rms_px: float
    paper_px: float | tuple[float, float] | None = None
    at: tuple[tuple[float, float, float], ...] = ()

    @property
    def paper_range_px(self) -> tuple[float, float] | None:
        """``paper_px`` as a pair, or None."""
        if self.paper_px is None:
            return None
        if isinstance(self.paper_px, tuple):
            return self.paper_px
        return (self.paper_px, self.paper_px)

    @property
    def paper_text(self) -> str:
        """``paper_px`` for a reader."""
        pair = self.paper_range_px
        if pair is None:
            return "–"
        return f"{pair[0]:g} px" if pair[0] == pair[1] else f"{pair[0]:g} to {pair[1]:g} px"


def write_correction_report(
    rows: Sequence[DemoRow],
    images: Sequence[tuple[str, NDArray[Any]]],
    path: str | os.PathLike[str],
    *,
    title: str = "Correction of an SEM stream",
    notes: Sequence[str] = (),
) -> Path:
    """Write one self-contained HTML file with the errors of each stage and pictures.

    Parameters
    ----------
    rows
        The stages, worst first.
    images
        (caption, image) pairs in the order in which they are shown, such as before and after.
    path
        The file to write.
    title
        Heading of the page.
    notes
        Sentences below the table.

    Raises
    ------
    InvalidValueError
        If there are no rows, an image has an unsupported shape, or the file cannot be written.
    """
    if not rows:
        raise InvalidValueError("a correction report without rows", expected="at least one DemoRow")
    values = {
        "title": remove_control_characters(title),
        "rows": [
            (
                remove_control_characters(row.label),
                format_px(row.rms_px),
                [f"{format_px(px)}, {_format_nm(px * pixel_m)}" for _, px, pixel_m in row.at],
                row.paper_text,
            )
            for row in rows
        ],
        "magnifications": [f"{g:g}×" for g, _, _ in rows[0].at],
        "papers": any(row.paper_range_px for row in rows),
        "chart": [_plot_errors(rows)],
        "notes": [remove_control_characters(note) for note in notes],
        "images": encode_pictures(images),
    }
    return write_page(path, render("correction.html.j2", values, folder=_HERE))


def overlay_change(
    first: NDArray[Any], last: NDArray[Any], pixel_size_m: float, sigma_m: float | None = None
) -> NDArray[np.uint8]:
    """Lay the middle of two frames over each other, enlarged, with a scale bar.

    Parameters
    ----------
    first, last
        (h, w) grey levels of two frames; the first is shown in red, the last in cyan: grey where they agree.
    pixel_size_m, sigma_m
        Pixel size on the specimen, and its 1-sigma if it is known.

    Returns
    -------
    ndarray
        (640, 640, 3) RGB.
    """
    height, width = first.shape
    side = min(_MIDDLE_PX, height, width)
    middle = (
        slice((height - side) // 2, (height + side) // 2),
        slice((width - side) // 2, (width + side) // 2),
    )
    cut = [image[middle].astype(np.float64) for image in (first, last)]
    low, high = np.percentile(cut, (1.0, 99.0))
    grey = [np.clip(255.0 * (c - low) / max(high - low, 1e-9), 0.0, 255.0) for c in cut]
    factor = _SHOWN_PX / side
    large = [
        cv2.resize(g.astype(np.uint8), (_SHOWN_PX, _SHOWN_PX), interpolation=cv2.INTER_CUBIC)
        for g in grey
    ]
    bar = choose_scale_bar(
        _SHOWN_PX, pixel_size_m / factor, None if sigma_m is None else sigma_m / factor
    )
    channels = []
    for number in (0, 1, 1):
        channel = np.array(large[number], dtype=np.uint8)
        draw_scale_bar(channel, bar)
        channels.append(channel)
    return np.stack(channels, axis=2)


def _format_nm(length_m: float) -> str:
    """Format a length with three digits; a dash where it is not known."""
    return format_length(length_m) if np.isfinite(length_m) else "–"


def _plot_errors(rows: Sequence[DemoRow]) -> Picture:
    """Measured error of each stage as a bar on a logarithmic axis, the paper's as marks if they are given."""
    figure = create_figure(4.2, 1.2 + 0.55 * len(rows))
    axes = figure.add_subplot()
    style_axes(axes, xlabel="RMS error (px, logarithmic)", ylabel="")
    axes.set_xscale("log")
    measured = np.array([row.rms_px for row in rows], dtype=np.float64)
    known = np.isfinite(measured) & (measured > 0.0)
    papers = [row.paper_range_px for row in rows]
    everything = [*measured[known], *(x for pair in papers if pair for x in pair)]
    low = 0.4 * min(everything, default=0.1)
    high = 2.5 * max(everything, default=10.0)
    places = np.arange(len(rows))
    axes.barh(places[known], measured[known] - low, left=low, height=0.5, color=OURS, label="here")
    for place, pair in zip(places, papers, strict=True):
        if pair is not None:
            label = "paper" if pair is next(p for p in papers if p) else None
            axes.plot(
                pair, [place, place], "D-", color=REFERENCE, markersize=6, linewidth=3, label=label
            )
    axes.set_xlim(low, high)
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    # The labels come from outside and may hold anything: in the picture the stages only have
    # numbers.
    axes.set_yticks(places, [f"{k + 1}" for k in places], color=INK)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if any(papers):
        # Above the plot, where no bar or mark can be.
        add_legend(axes, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.0)
    stages = "; ".join(
        f"{row.label}: {format_px(row.rms_px)}"
        + (f", paper {row.paper_text}" if row.paper_range_px else "")
        for row in rows
    )
    return encode_figure(
        figure,
        remove_control_characters(f"RMS error of each stage. {stages}."),
        "The numbers at the left are those of the table's rows.",
    )
