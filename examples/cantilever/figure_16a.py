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

"""Fig. 16a of Malti et al. (2012): one bending, measured with a continuous calibration and with separate ones.

The continuous calibration was made at other magnifications than those of the bending; the separate calibrations were
made exactly there, each on its own (method "discrete"). Both measure the same frames. The paper could compare them with
each other only; here the truth is known, too.
"""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from semcal_ros.cli.output import echo_table
from semcal_ros.core.arrays import Array
from semcal_ros.files.bags.writer import SIMULATED_START_NS
from semcal_ros.report.html.encode import encode_png
from semcal_ros.report.html.style import (
    ACCENT,
    MUTED,
    OURS,
    SECOND,
    add_legend,
    create_figure,
    style_axes,
)

# Columns of the table of `semcal measure cantilever`.
SCALES = {"calibration": "deflection_m", "length": "deflection_by_length_m"}


@dataclass(frozen=True)
class Comparison:
    """Deflections of the same frames with two calibrations; pose 1 is the reference, where they are zero.

    Attributes
    ----------
    scale
        What the metres come from: ``calibration``, or the known ``length`` of the cantilever.
    magnifications
        (m,) magnifications.
    truth_m
        (m, p) deflection in the mean of the frames of each pose.
    continuous_m, separate_m
        (m, p) means over the frames of each pose; NaN where the scale is not known.
    """

    scale: str
    magnifications: tuple[float, ...]
    truth_m: Array
    continuous_m: Array
    separate_m: Array

    @property
    def difference_m(self) -> Array:
        """(m, p) continuous minus separate."""
        return self.continuous_m - self.separate_m


def read_deflections(table: Path, column: str) -> dict[tuple[float, int], dict[int, float]]:
    """Deflection in m by magnification and pose, and by stamp of the frame."""
    out: dict[tuple[float, int], dict[int, float]] = defaultdict(dict)
    with table.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            key = float(row["magnification"]), int(row["pose"])
            out[key][int(row["stamp_ns"])] = float(row[column])
    return out


def compare_calibrations(
    continuous: Path, separate: Path, truth: Path, *, scale: str = "calibration"
) -> Comparison:
    """Compare two tables of `semcal measure cantilever` of one recording, and its truth.json."""
    frames = json.loads(truth.read_text(encoding="utf-8"))["frames"]
    true = {
        SIMULATED_START_NS + round(frame["start_time_s"] * 1e9): frame["deflection_m"]
        for frame in frames
    }
    ours = read_deflections(continuous, SCALES[scale])
    theirs = read_deflections(separate, SCALES[scale])
    magnifications = tuple(dict.fromkeys(g for g, _ in ours))
    poses = sorted({pose for _, pose in ours})
    shape = len(magnifications), len(poses)
    means = np.full((3, *shape), np.nan)
    for i, g in enumerate(magnifications):
        for j, pose in enumerate(poses):
            own, other = ours[g, pose], theirs[g, pose]
            # A frame that one of the two could not measure counts for neither.
            both = [stamp for stamp in own if np.isfinite(own[stamp]) and np.isfinite(other[stamp])]
            if both:
                means[0, i, j] = np.mean([true[stamp] for stamp in both])
                means[1, i, j] = np.mean([own[stamp] for stamp in both])
                means[2, i, j] = np.mean([other[stamp] for stamp in both])
    return Comparison(scale, magnifications, *means)


def root_mean_square_nm(lengths_m: Array) -> float:
    """RMS in nm of what is known, without the reference pose in the first column."""
    known = lengths_m[:, 1:][np.isfinite(lengths_m[:, 1:])]
    return 1e9 * float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def spread_nm(deflections_m: Array) -> float:
    """Standard deviation among the magnifications, RMS over the poses but the reference, nm."""
    return root_mean_square_nm(np.std(deflections_m, axis=0, ddof=1, keepdims=True))


def show_comparison(comparison: Comparison) -> None:
    """Print the deflections of each pose, and the summary, in nm."""
    c = comparison
    headers = ["pose", "truth"]
    for g in c.magnifications:
        headers += [f"{g:g}x continuous", "separate", "difference"]
    rows = []
    for j in range(c.truth_m.shape[1]):
        cells = [str(j + 1), f"{1e9 * np.nanmean(c.truth_m[:, j]):.2f}"]
        for i in range(len(c.magnifications)):
            cells += [f"{1e9 * c.continuous_m[i, j]:.2f}", f"{1e9 * c.separate_m[i, j]:.2f}"]
            cells += [f"{1e9 * c.difference_m[i, j]:+.2f}"]
        rows.append(cells)
    print(f"\nFig. 16a, deflections in nm, scale from the {c.scale}:")
    echo_table(headers, rows)
    print(
        f"continuous minus separate: {root_mean_square_nm(c.difference_m):.2f} nm RMS, "
        f"{1e9 * np.nanmax(np.abs(c.difference_m)):.2f} nm at most; "
        f"error against the truth: {root_mean_square_nm(c.continuous_m - c.truth_m):.2f} nm continuous, "
        f"{root_mean_square_nm(c.separate_m - c.truth_m):.2f} nm separate; spread between magnifications: "
        f"{spread_nm(c.continuous_m):.2f} and {spread_nm(c.separate_m):.2f} nm (the paper: 10 nm)"
    )


def draw_comparison(comparison: Comparison) -> bytes:
    """Draw the deflection of each pose as in Fig. 16a, and below its error, as PNG."""
    c = comparison
    figure = create_figure(7.2, 5.6)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    style_axes(upper, xlabel="", ylabel="deflection of the end (nm)")
    style_axes(lower, xlabel="pose", ylabel="minus truth (nm)")
    pose = np.arange(1, c.truth_m.shape[1] + 1)
    colors, count = (OURS, SECOND, ACCENT), len(c.magnifications)
    for i, g in enumerate(c.magnifications):
        beside = pose + 0.12 * (i - 0.5 * (count - 1))
        for name, values, filled in (
            ("continuous", c.continuous_m[i], True),
            ("separate", c.separate_m[i], False),
        ):
            look = {"color": colors[i % len(colors)], "linewidth": 0.8}
            # Hollow squares around the dots, so that both can be seen where they agree.
            look |= {"markersize": 4} if filled else {"markersize": 8, "markerfacecolor": "none"}
            mark, line = ("o", "-") if filled else ("s", "--")
            upper.plot(beside, 1e9 * values, mark + line, label=f"{g:g}×, {name}", **look)
            lower.plot(beside, 1e9 * (values - c.truth_m[i]), mark, **look)
    lower.axhline(0.0, color=MUTED, linewidth=0.7)
    lower.xaxis.set_major_locator(MaxNLocator(integer=True))
    add_legend(upper, loc="upper left")
    return encode_png(figure, 90.0, keep_rare_colors=True)
