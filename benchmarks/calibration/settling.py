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

"""How far off are the points of a grid where the beam settles, and what is left of that?

    python -m benchmarks.calibration.settling [--views 12]

Flat grids of 512 px in any direction, by a microscope that does nothing but settle. Points count whose bias is stated
to be over two of their sigmas; the bias is that of the true settling. The limit, beyond which the command fails: error
over sigma of 1.4, with a half of each bias as a part of the sigma, for points up to 45 px apart; and a grid that is not
found. It takes some minutes.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from benchmarks.calibration.fleet.microscope import (
    DISPLAY_WIDTH_M,
    Array,
    Microscope,
    Shot,
    draw_microscope,
    tilted,
)
from benchmarks.calibration.fleet.pictures import draw_picture, ideal_from_raw
from benchmarks.table import show
from semcal_ros.core.calibration.views import GridView, views_from_detections
from semcal_ros.core.calibration.window_bias import find_window_bias, undo_window_bias
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES, Raster
from semcal_ros.core.camera.thresholds import SETTLING_TIMES
from semcal_ros.core.corners import LatticeDetection, find_lattice

SIZE = 512
# Of the settling that a camera knows.
FUNCTIONS = ("settling_2", "settling_3", "settling_4")
SETTLING_PX = 3.0
PATTERNS = ("chess", "crosses", "dots", "lines")
SPACINGS_PX = (20.0, 30.0, 45.0, 60.0)
CLOSE_PX = 45.0
COUNTED_SIGMAS, LARGEST_RATIO, FEWEST = 2.0, 1.4, 8
SETTLED_PX = 200.0


def make_microscope(columns: float, spacing_px: float) -> tuple[Microscope, float]:
    """A microscope that does nothing but settle, and the magnification at which squares of 10 um have this spacing."""
    own = replace(
        draw_microscope(0, 0),
        width=SIZE,
        height=SIZE,
        scale_bias=0.0,
        wave=0.0,
        aspect=1.0,
        skew=0.0,
        principal_px=(0.5 * SIZE, 0.5 * SIZE),
        centre_px=(0.5 * SIZE, 0.5 * SIZE),
        radial=0.0,
        decentring=0.0,
        spiral=0.0,
        coil_px=(0.0, 0.0),
        settling_px=SETTLING_PX,
        settling_columns=columns,
        settles_late=True,
        squares_across=SIZE / spacing_px,
    )
    g = DISPLAY_WIDTH_M / (10e-6 * SIZE / spacing_px)
    return own, float(g)


def errors_along(own: Microscope, spacing_px: float, angle: float, xy: Array) -> Array:
    """(n,) found less true position along the lines, px; where the first column lies is told by the settled points."""
    late = own.settling_px * np.exp(-xy[:, 0] / own.settling_columns)
    ideal = xy - np.stack([late, np.zeros(len(xy))], axis=1) - np.array(own.principal_px)
    c, s = np.cos(angle), np.sin(angle)
    ij = ideal @ np.array([[c, -s], [s, c]]) / spacing_px
    settled = xy[:, 0] > SETTLED_PX
    ij -= ij[settled][0]
    off = ij - np.round(ij)
    off = (off - np.median(off[settled], axis=0)) * spacing_px
    return np.asarray((off @ np.array([c, -s])) / (1.0 + late / own.settling_columns))


def measure(pattern: str, spacing_px: float, name: str, views: int) -> tuple[list[object], float]:
    """A row of the table, and the error over sigma."""
    columns = 0.5 * SIZE * SETTLING_TIMES[int(name[-1]) - 1]
    own, g = make_microscope(columns, spacing_px)
    amplitudes = np.zeros(len(SCAN_NAMES))
    # Its first column is half a pixel from the border, from where the camera counts.
    amplitudes[SCAN_NAMES.index(name)] = -SETTLING_PX * np.exp(0.5 / columns) / (0.5 * SIZE)
    ideal, rng = ideal_from_raw(own, g), np.random.default_rng((5, int(spacing_px)))
    rows: list[Array] = []
    for angle in np.linspace(0.05, 1.5, views):
        shot = Shot(g, tilted(0.0, 0.0, float(angle)), 0.0, 1.0, 0)
        found = find_lattice(draw_picture(own, shot, ideal, pattern, rng), pattern=pattern)
        if not isinstance(found, LatticeDetection):
            continue
        made, _ = views_from_detections(
            [found], [g], display_width_m=DISPLAY_WIDTH_M, squares_m=[10e-6]
        )
        bias = find_window_bias(made[0], amplitudes, Raster.of(SIZE, SIZE))
        stated = sigma_along(undo_window_bias(made[0], bias))
        error = errors_along(own, spacing_px, float(angle), found.xy)
        counts = np.abs(bias[:, 0]) > COUNTED_SIGMAS * sigma_along(made[0])
        rows.append(np.stack([error, bias[:, 0], sigma_along(made[0]), stated])[:, counts])
    label = f"{pattern}, {spacing_px:.0f} px, {columns:.0f} columns"
    if len(rows) < views:
        return [label, 0] + [None] * 4, float("inf")
    error, bias_x, sigma, stated = np.concatenate(rows, axis=1)
    # Too few that are off are no failure: there is little to take out.
    if len(error) < FEWEST:
        return [label, len(error)] + [None] * 4, 0.0
    left = error - bias_x
    part = np.sqrt(max(np.sum(left**2 - sigma**2), 0.0) / np.sum(bias_x**2))
    ratio = float(np.sqrt(np.mean((left / stated) ** 2)))
    before = float(np.sqrt(np.mean((error / sigma) ** 2)))
    return [label, len(error), float(np.max(np.abs(bias_x))), before, ratio, float(part)], ratio


def sigma_along(view: GridView) -> Array:
    """(n,) stated sigma along the lines, px."""
    assert view.covariance_px2 is not None
    return np.sqrt(view.covariance_px2[:, 0, 0])


def main() -> int:
    """Print the table; 1 where the limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--views", type=int, default=12, help="pictures for each row; default 12")
    views = parser.parse_args().views
    rows, beyond = [], []
    for pattern in PATTERNS:
        for spacing_px in SPACINGS_PX:
            for name in FUNCTIONS:
                row, ratio = measure(pattern, spacing_px, name, views)
                rows.append(row)
                print(*row, flush=True)
                if spacing_px <= CLOSE_PX and ratio > LARGEST_RATIO:
                    beyond.append(f"{row[0]}: {ratio:.2f} sigma")
    header = ["points", "count", "largest bias px", "error/sigma before", "after", "part left"]
    show(f"Points where the beam settles by {SETTLING_PX:g} px", header, rows)
    print("\n".join(f"beyond the limit: {text}" for text in beyond) or "within the limit")
    return 1 if beyond else 0


if __name__ == "__main__":
    raise SystemExit(main())
