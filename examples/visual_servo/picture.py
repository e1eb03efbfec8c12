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

"""The picture of the servoing example: what is seen, and the error of the three cases."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from examples.visual_servo.loop import Run

COLOURS = {"uncalibrated": "C3", "interpolated": "C1", "continuous": "C0"}


def picture(path: Path, runs: Sequence[Run]) -> None:
    """Two frames of the last run, then the true error in px and in nm."""
    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 4, width_ratios=[0.75, 0.75, 1.25, 1.25])
    shown = list(runs[-1].images)
    for axis, g in zip(axes[:2], (shown[0], shown[-1]), strict=True):
        # Noise fills a PNG.
        seen = cv2.resize(runs[-1].images[g], (160, 160), interpolation=cv2.INTER_AREA)
        axis.imshow(seen, cmap="gray")
        axis.set_title(f"{g:g}x, last frame", fontsize=9)
        axis.set_axis_off()
    for run in runs:
        for axis, values in ((axes[2], run.true_px), (axes[3], 1e9 * run.true_m())):
            axis.plot(np.maximum(values, 1e-3), color=COLOURS[run.name], label=run.name, lw=1.2)
    magnification = np.array(runs[-1].magnification)
    turns = np.flatnonzero(np.diff(magnification)) + 1
    for axis, unit in ((axes[2], "px"), (axes[3], "nm")):
        axis.set_yscale("log")
        axis.set_xlabel("frame", fontsize=8)
        axis.set_title(f"true distance from the goal, {unit}", fontsize=9)
        for turn in turns:
            axis.axvline(turn, color="0.8", lw=0.8, zorder=0)
            axis.annotate(
                f"{magnification[turn]:g}x",
                (turn, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(2, -2),
                textcoords="offset points",
                fontsize=7,
                rotation=90,
                va="top",
            )
    # Below: errors over five decades leave no place within.
    figure.legend(
        *axes[2].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=3
    )
    figure.savefig(path, dpi=88)
