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

"""What do shifts, turns and zooms of a ladder tell? Stated 1-sigmas beyond the grid, of ladders that lack one of them.

    python -m benchmarks.calibration.observable [--seed 0] [--last 100000]

One microscope is calibrated by a grid to 10 000x, and extended four times by ladders of as many pictures: all in the
middle; moved; turned; moved and turned. There are no pictures, but correspondences of the truth with 0.1 px of noise,
as blocks of pictures have them. The squares of the grid are known, so that what the ladder adds is seen. The table and
the figure, bench_output/observable.png, have the 1-sigma of nm per pixel, of aspect and skew, and of the distortion
over the picture (RMS, after the best affine map); the table has the errors of the one ladder that was drawn, too.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.calibration.ladder import FIRST, STEP, Case, camera_at, draw_case
from benchmarks.table import show
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.ladder.adjustment import adjust
from semcal_ros.core.ladder.extend import LadderMeasurement, make_model
from semcal_ros.core.ladder.residuals import Link, make_link
from semcal_ros.core.ladder.thresholds import POSE_SIZE
from semcal_ros.core.ladder.unknowns import LadderState, PicturePlace, make_setup, start_state

Array = NDArray[np.float64]
PLOT = Path(__file__).resolve().parents[2] / "bench_output" / "observable.png"
SIZE, NOISE_PX, POINTS = 384, 0.1, 120
MIDDLE = [(0.0, 0.0), (0.02, 0.01), (-0.01, 0.02), (0.03, -0.02)]
MOVED = [(0.0, 0.0), (0.25, 0.08), (-0.07, 0.26), (0.03, -0.02)]
#: Places of four pictures at each magnification in fields, and whether the last one is turned.
LADDERS = {
    "zooms alone": (MIDDLE, False),
    "zooms and turns": (MIDDLE, True),
    "zooms and shifts": (MOVED, False),
    "zooms, shifts and turns": (MOVED, True),
}
TERMS = ("nm per px, %", "aspect, %", "skew, %", "distortion, px")


@dataclass(frozen=True)
class Pose:
    """Where a picture lies on the specimen, m, and its turn."""

    place: Array
    turn: float

    def to_specimen(self, flat: Array) -> Array:
        """Places on the specimen of places in the sem frame."""
        c, s = math.cos(self.turn), math.sin(self.turn)
        return flat @ np.array([[c, -s], [s, c]]) + self.place

    def to_frame(self, places: Array) -> Array:
        """And back."""
        c, s = math.cos(self.turn), math.sin(self.turn)
        return (places - self.place) @ np.array([[c, s], [-s, c]])


def extend(
    case: Case, moves: list[tuple[float, float]], turned: bool, last: float
) -> CalibrationModel:
    """Extend the calibration of a microscope by correspondences of the truth."""
    scope, model, rng = case.scope, case.calibration, np.random.default_rng(1)
    steps = math.ceil(math.log(last / FIRST) / math.log(STEP) - 1e-9)
    places, poses, cameras = [], [], []
    for visit, g in enumerate(FIRST * (last / FIRST) ** (np.arange(steps + 1) / steps)):
        field = scope.display_m / g
        for number, move in enumerate(moves):
            turn = 0.5 * math.pi * (-1.0) ** visit if turned and number == 3 else 0.0
            places.append(PicturePlace(f"{g:.0f}x/{number}", float(g), visit))
            poses.append(Pose(field * np.array(move), turn))
            cameras.append(camera_at(scope, float(g)))
    setup = make_setup(model, tuple(places), (scope.width, scope.height))
    links: list[Link] = []
    for i, first in enumerate(places):
        for j in range(i + 1, len(places)):
            if places[j].visit > first.visit + 1:
                continue
            xy = rng.uniform(10.0, scope.width - 11.0, (POINTS, 2))
            flat = cameras[i].sem_from_ideal(cameras[i].undistort(xy))[:, :2]
            there = poses[j].to_frame(poses[i].to_specimen(flat))
            seen = cameras[j].project(np.column_stack([there, np.zeros(POINTS)]))
            inside = np.all((seen > 10.0) & (seen < scope.width - 11.0), axis=1)
            found = seen[inside] + rng.normal(0.0, NOISE_PX, (np.count_nonzero(inside), 2))
            covariance = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(found), 2, 2))
            times = [(p[:, 1] - 0.5 * scope.height) / scope.height for p in (xy[inside], found)]
            links.append(make_link(setup, (i, j), xy[inside], found, covariance, times))
    values = start_state(setup).values.copy()
    for number, pose in enumerate(poses):
        at = setup.bounds[5].start + POSE_SIZE * number
        shift = pose.to_frame(np.zeros((1, 2)))[0] / setup.pixel_m(places[number].magnification)
        values[at : at + 3] = [pose.turn, *shift]
    fit = adjust(setup, LadderState(setup, values), links)
    numbers = tuple(range(len(places)))
    return make_model(LadderMeasurement(setup, fit, tuple(links), 1.0, (), (), numbers))


def known(camera: ScanCamera, truth: ScanCamera) -> tuple[Array, Array]:
    """1-sigmas (4,) and errors (4,) in the units of the table."""
    covariance = camera.joint_covariance
    assert covariance is not None
    x, y = np.meshgrid(np.linspace(5, camera.width - 6, 9), np.linspace(5, camera.height - 6, 9))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    jacobian = camera.project_jacobian(camera.sem_from_ideal(camera.undistort(xy)))
    own = slice(6, 10)
    columns = jacobian[:, :, own].transpose(1, 0, 2).reshape(2 * len(xy), -1)
    one, zero = np.ones((len(xy), 1)), np.zeros((len(xy), 3))
    affine = np.block([[one, xy, zero], [zero, one, xy]])
    basis = np.linalg.qr(affine)[0]
    left = columns - basis @ (basis.T @ columns)
    variance = np.trace(left @ covariance[own, own] @ left.T) / len(xy)
    size = np.array(camera.pixel_size_m)
    sigma_size = float(np.mean(np.array(camera.pixel_size_sigma_m) / size))
    spread = [
        100.0 * sigma_size,
        *(100.0 * math.sqrt(covariance[k, k]) for k in (1, 2)),
        math.sqrt(variance),
    ]
    seen = camera.undistort(xy) - truth.undistort(xy)
    off = seen.T.ravel()
    off = off - basis @ (basis.T @ off)
    errors = [
        100.0 * float(np.mean(size / truth.pixel_size_m - 1.0)),
        100.0 * (camera.aspect - truth.aspect),
        100.0 * (camera.skew - truth.skew),
        math.sqrt(float(off @ off) / len(xy)),
    ]
    return np.array(spread), np.array(errors)


def plot(places: Array, sigmas: dict[str, Array], edge: float, path: Path) -> None:
    """The 1-sigmas over the magnification."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(8.0, 5.6), layout="constrained", sharex=True)
    for number, (name, axis) in enumerate(zip(TERMS, axes.flat, strict=True)):
        for ladder, style in zip(sigmas, (":", "-.", "--", "-"), strict=True):
            axis.plot(places, sigmas[ladder][:, number], style, label=ladder)
        axis.axvline(edge, color="0.6", linewidth=1.0)
        axis.set(xscale="log", ylabel=f"1-sigma of {name}", ylim=(0.0, None))
    for axis in axes[1]:
        axis.set_xlabel("magnification")
    axes[0, 0].annotate(
        "grid", (0.97 * edge, 0.97), xycoords=("data", "axes fraction"), ha="right", va="top"
    )
    axes[0, 0].legend(frameon=False, fontsize=8, loc="lower right")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=100)
    print(f"plot: {path}")


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--last", type=float, default=1e5)
    given = parser.parse_args()
    case = draw_case(given.seed, SIZE, with_relay=False, squares=1e-5)
    edge = case.calibration.magnification_range[1]
    places = np.geomspace(0.5 * edge, 0.999 * given.last, 40)
    sigmas: dict[str, Array] = {}
    rows = []
    for name, (moves, turned) in LADDERS.items():
        model = extend(case, moves, turned, given.last)
        told = [known(model.at(float(g)), camera_at(case.scope, float(g))) for g in places]
        sigmas[name] = np.array([spread for spread, _ in told])
        for index in (int(np.argmin(np.abs(places - edge))), 24, 39):
            spread, errors = told[index]
            cells = [f"{s:.2g} ({e:+.2g})" for s, e in zip(spread, errors, strict=True)]
            rows.append([name, f"{places[index]:.0f}", *cells])
    show("1-sigma (error) by what a ladder has", ["ladder", "magnification", *TERMS], rows)
    plot(places, sigmas, edge, PLOT)


if __name__ == "__main__":
    main()
