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

"""Does a calibration end at the same place from wherever it starts? Random first states of the reference recordings.

    python -m benchmarks.calibration.starts [--starts 20] [--recordings grid_calibration,grid_spiral,...]

Of each recording the corners are found once. The first state of the fit is then replaced by random ones: every view is
tilted to the other side or not, turned by 5 degrees and shifted by 2 % of the field (1-sigma); the scale is off by up
to 5 %, the aspect ratio by 3 %, principal point and centre of distortion by 8 and 15 % of the width, and lens and pivot
are any (see `draw_start`). Terms, coefficients and the adjustment follow from there as always.

*cost* is half the chi-square of the last adjustment with one for each coefficient, which is what the choice of
coefficients minimises: choices that differ by less than 2 are equally good to it. *sigmas* is the largest difference of
the projections between the calibrated magnifications from those of the ordinary start, in stated sigmas. The limit,
beyond which the command fails: no start ends 2 above the best, or a whole sigma from the ordinary one.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.calibration.cases import CONFIG, found_in, reference_folder
from benchmarks.table import show
from semcal_ros.core.calibration.estimator.blocks import State
from semcal_ros.core.calibration.estimator.problem import (
    Setup,
    constant_functions,
    initial_components,
)
from semcal_ros.core.calibration.method_fit import make_model
from semcal_ros.core.calibration.pipeline import prepare
from semcal_ros.core.calibration.select import select
from semcal_ros.core.calibration.solve import solve
from semcal_ros.core.calibration.start import Start, start
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel, stack_coefficients
from semcal_ros.core.camera.plane_geometry import mirrored_tilt, rotations_from_vectors

RECORDINGS = ("grid_calibration", "grid_spiral", "grid_real_look", "grid_real_stage")
MOST_ABOVE, MOST_SIGMAS = 2.0, 1.0
# Of every view, 1-sigma: rad, and part of the field.
TURN_RAD, SHIFT = np.radians(5.0), 0.02


@dataclass(frozen=True)
class End:
    """Where a fit ended: half the chi-square, the number of coefficients, and the calibration."""

    half_chi2: float
    coefficients: int
    model: CalibrationModel

    @property
    def cost(self) -> float:
        return self.half_chi2 + self.coefficients


def draw_start(started: Start, rng: np.random.Generator) -> Start:
    """A random first state, far from the ordinary one, from which the tilts and the camera have to be found again."""
    setup, state = started.setup, started.state
    count, width = len(setup.views), setup.image_size[0]
    other = rng.uniform(size=count) < 0.5
    tilted = np.where(other[:, None, None], mirrored_tilt(state.rotations), state.rotations)
    rotations = rotations_from_vectors(rng.normal(0.0, TURN_RAD, (count, 3))) @ tilted
    middle = np.stack([np.append(view.board_xy_m.mean(axis=0), 0.0) for view in setup.views])
    field_m = width / setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    moved = np.einsum("vij,vj->vi", state.rotations - rotations, middle)
    moved += field_m[:, None] * rng.normal(0.0, SHIFT, (count, 3))

    def beside(value: float, most: float) -> float:
        return float(value + rng.uniform(-most, most))

    cx, cy = setup.centre_px
    scale = started.functions["scale"](float(setup.magnifications[0]))
    drawn = constant_functions(
        setup,
        {
            "scale": scale * beside(1.0, 0.05),
            "aspect": beside(1.0, 0.03),
            "skew": beside(0.0, 0.01),
            "px": beside(cx, 0.08 * width),
            "py": beside(cy, 0.08 * width),
            "rho": float(rng.uniform(0.0, 200.0)),
            "xi_r": beside(0.0, 0.05),
            "xi_t": beside(0.0, 0.01),
            "ex": beside(cx, 0.15 * width),
            "ey": beside(cy, 0.15 * width),
        },
    )
    theta = np.concatenate([stack_coefficients(drawn), setup.shared_start()])
    return replace(
        started,
        functions=drawn,
        state=State(theta, rotations, state.translations_m + moved),
        spread=initial_components(setup),
    )


def end_of(setup: Setup, started: Start) -> End:
    """Where the fit ends from a first state; without a residual field."""
    fit = solve(select(started, "off"), lambda _name, _fraction: None)
    own = fit.adjustment
    size = sum(function.size for function in own.functions.values())
    return End(
        own.result.cost, size, make_model(setup, fit.padded.functions, fit.covariance, "joint")
    )


def largest_sigmas(model: CalibrationModel, other: CalibrationModel) -> float:
    """The largest difference of projections between the calibrated magnifications, in sigmas of the first."""
    g = np.array(model.magnifications)
    largest = 0.0
    cube = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-0.3, 0.3)])
    for between in np.sqrt(g[1:] * g[:-1]):
        camera = model.at(float(between))
        points = 0.4 * camera.width / camera.m * cube
        off = np.abs(other.at(float(between)).project(points) - camera.project(points))
        largest = max(largest, float(np.max(off / camera.project_sigma(points))))
    return largest


def ends_of(
    views: Sequence[GridView], image_size: tuple[int, int], display_width_m: float, count: int
) -> list[End]:
    """Where the fits of these views end: from the ordinary start, then from so many random ones."""
    setup = prepare(views, image_size=image_size, display_width_m=display_width_m)
    first = start(setup)
    random = [draw_start(first, np.random.default_rng(k)) for k in range(count)]
    return [end_of(setup, one) for one in (first, *random)]


def main() -> int:
    """Run the command line; 1 where the limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=20, help="random starts of each; default 20")
    parser.add_argument("--recordings", default=",".join(RECORDINGS), help="names, with commas")
    given = parser.parse_args()
    rows: list[list[object]] = []
    missed = False
    for name in given.recordings.split(","):
        found = found_in(reference_folder() / name, lambda _k, _g: True)
        ends = ends_of(found.views, found.image_size, CONFIG.display_width_m, given.starts)
        above = np.array([end.cost for end in ends]) - min(end.cost for end in ends)
        sigmas = [largest_sigmas(ends[0].model, end.model) for end in ends[1:]]
        rows.append([name, len(found.views), f"{ends[0].cost:.2f}", float(above[0])])
        rows[-1] += [float(above.max()), float(np.median(sigmas)), float(np.max(sigmas))]
        missed = missed or above.max() > MOST_ABOVE or max(sigmas) > MOST_SIGMAS
        print(name, *(f"{a:.3f}" for a in above), flush=True)
    header = ["recording", "views", "cost", "above the best", "of all starts", "sigmas", "largest"]
    show(f"{given.starts} random starts of each reference recording", header, rows)
    return int(missed)


if __name__ == "__main__":
    raise SystemExit(main())
