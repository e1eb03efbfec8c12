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

"""The demo's picture: what the live correction does to a drifting, distorted stream."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from semcal_ros import Calibration
from semcal_ros.report.html.style import set_magnification_axis

# Of both images, px: small enough to see single squares.
CROP = slice(150, 406)


def overview(
    path: Path,
    streams: Mapping[str, Mapping[int, np.ndarray]],
    stamps: Sequence[int],
    rms: Mapping[str, Sequence[float]],
    magnifications: Sequence[float],
    cal: Calibration,
) -> None:
    """First and last frame at the last magnification, the errors, and the continuous scale."""
    figure = Figure(figsize=(12.0, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 4, width_ratios=[1, 1, 1.1, 1.1])
    titles = {"image_raw": "image_raw", "image_rect": "image_rect"}
    for axis, (topic, title) in zip(axes[:2], titles.items(), strict=True):
        first, last = (streams[topic][s][CROP, CROP].astype(float) for s in (stamps[0], stamps[-1]))
        # First frame in red, last one in cyan: gray where they agree.
        top = np.percentile([first, last], 99)
        axis.imshow(np.clip(np.stack([first, last, last], axis=2) / top, 0.0, 1.0))
        axis.set_title(
            f"{title} at {magnifications[-1]:g}x\nfirst frame red, last frame cyan", fontsize=9
        )
        axis.set_axis_off()
    _errors(axes[2], rms, magnifications)
    _scale(axes[3], cal, magnifications)
    figure.savefig(path, dpi=110)


def _errors(axis, rms, magnifications) -> None:
    position = np.arange(len(magnifications))
    labels = {
        "image_raw": "raw",
        "image_stabilized": "drift removed",
        "image_rect": "drift and distortion",
    }
    for k, (topic, label) in enumerate(labels.items()):
        axis.bar(position + 0.27 * (k - 1), rms[topic], width=0.25, label=label)
    axis.set_yscale("log")
    axis.set_ylim(0.01, 100)
    axis.set_xticks(position, [f"{g:g}x" for g in magnifications])
    axis.set_title("RMS reprojection error in px\nat magnifications never calibrated", fontsize=9)
    axis.legend(fontsize=7, loc="upper left")


def _scale(axis, cal: Calibration, magnifications) -> None:
    grid = np.geomspace(*cal.magnification_range, 200)
    cameras = [cal.at(float(g)) for g in grid]
    nominal = np.array([cal.nominal_px_per_m(float(g)) for g in grid])
    ratio = nominal / np.array([c.m for c in cameras])
    sigma = ratio * np.array([np.sqrt(c.covariance[0, 0]) / c.m for c in cameras])
    axis.plot(grid, ratio, color="C0")
    axis.fill_between(grid, ratio - 2 * sigma, ratio + 2 * sigma, alpha=0.25, color="C0")
    known = [cal.nominal_px_per_m(g) / cal.at(g).m for g in cal.magnifications]
    axis.plot(cal.magnifications, known, "o", ms=4, color="C0")
    for g in magnifications:
        axis.axvline(g, color="C3", lw=0.8, ls=":")
    set_magnification_axis(axis, float(grid[0]), float(grid[-1]))
    axis.set_xlabel("magnification (dots: recorded, dotted: replayed)", fontsize=8)
    axis.set_title("nm per pixel over its nominal value\nwith its 2-sigma interval", fontsize=9)
