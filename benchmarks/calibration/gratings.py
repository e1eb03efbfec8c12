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

"""Does a grating of parallel lines calibrate? Random microscopes that see one, turned and not tilted.

    python -m benchmarks.calibration.gratings [--count 40] [--seed 0]

Pictures of 384 to 1024 px, one to three magnifications, three to five directions of the lines; pitch 10 to 100 px,
duty 0.3 to 0.7, blur 0.8 to 2 px, counting noise, edges that are rough along the lines; radial distortion up to 1.2 %,
aspect 2 %, skew 4e-3, and heights of 10 um (1-sigma) under a pivot at 4 to 60 mm.

A microscope is *raised* if anything is, and *wrong* if the error after the best shift, turn and scale is beyond both
0.1 px and 4 stated sigmas at one of its magnifications, or nm per pixel of an axis beyond 4. The limit, beyond which
the command fails: none raises and none is wrong.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import traceback
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import erf

from benchmarks.table import show
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.camera.uncertainty import predict_aligned_sigma_px
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.workflows.calibrate import calibrate_found

Array = NDArray[np.float64]
DISPLAY_WIDTH_M = 0.1
FAR_PX, FAR_SIGMAS = 0.1, 4.0


@dataclass(frozen=True)
class Microscope:
    """Pixel sizes (x, y) over the nominal one, skew of the same kind, radial distortion, and 1 / pivot distance."""

    width: int
    height: int
    sizes: tuple[float, float]
    skew: float
    radial: float
    rho: float

    def ideal(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Undistort raw pixels from the middle: those are ideal ones times 1 - radial r^2."""
        u, v = x.copy(), y.copy()
        for _ in range(40):
            factor = 1.0 - self.radial * (u * u + v * v) / (0.5 * self.width) ** 2
            u, v = x / factor, y / factor
        return u, v

    def metres(self, x: Array, y: Array, pixel_m: float) -> tuple[Array, Array]:
        """Where raw pixels, from the middle, lie on the specimen."""
        u, v = self.ideal(x, y)
        return pixel_m * (self.sizes[0] * u + self.skew * v), pixel_m * self.sizes[1] * v

    def raster(self, step: int = 1) -> tuple[Array, Array]:
        """Raw pixels from the middle."""
        y, x = np.mgrid[0 : self.height : step, 0 : self.width : step].astype(np.float64)
        return x - 0.5 * (self.width - 1), y - 0.5 * (self.height - 1)


def draw_microscope(rng: np.random.Generator) -> Microscope:
    """Draw one."""
    width = int(rng.choice([384, 512, 768, 1024]))
    height = int(width * rng.choice([0.75, 1.0]))
    size = 1.0 + rng.uniform(-0.06, 0.06)
    sizes = (size, size * (1.0 + rng.uniform(-0.02, 0.02)))
    skew, radial = rng.uniform(-4e-3, 4e-3), rng.uniform(-0.012, 0.012)
    return Microscope(width, height, sizes, skew, radial, 1.0 / rng.uniform(4e-3, 60e-3))


def draw_picture(
    scope: Microscope, pixel_m: float, pitch_m: float, turn: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Draw lines across the direction ``turn``, with profiles that were blurred before they are sampled."""
    x, y = scope.metres(*scope.raster(), pixel_m)
    across, along = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    place = across / pitch_m + rng.random()
    pitch_px = pitch_m / pixel_m
    # Edges are rough along the lines, over half a pitch or so, and each on its own.
    rough = rng.uniform(0.0, 0.01)
    field = ndimage.gaussian_filter1d(rng.normal(size=(256, 1024)), 3.0, axis=1)
    field *= rough / field.std()
    line = np.rint(place).astype(int)
    column = along / (0.2 * pitch_m) + 512.0

    def edge(number: NDArray[np.int64]) -> Array:
        at = [number % 256, np.mod(column, 1023.0)]
        return np.asarray(ndimage.map_coordinates(field, at, order=1))

    off = place - line
    half, blur = 0.5 * rng.uniform(0.3, 0.7), rng.uniform(0.8, 2.0) / pitch_px
    left, right = off + half + edge(2 * line), off - half + edge(2 * line + 1)
    shape = 0.5 * (erf(left / (np.sqrt(2.0) * blur)) - erf(right / (np.sqrt(2.0) * blur)))
    electrons = rng.uniform(8.0, 200.0)
    counts = rng.poisson(electrons * (0.5 + shape))
    return np.clip(np.rint(110.0 / electrons * counts), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Outcome:
    """Worst of the magnifications: error in px and in sigmas, nm per px in sigmas, and its relative sigma."""

    views: int
    error_px: float
    error_sigmas: float
    size_sigmas: float
    size_sigma: float


def judge(seed: int, index: int) -> Outcome | None:
    """Calibrate one microscope; None if it shows no grating three times."""
    rng = np.random.default_rng([seed, index])
    scope = draw_microscope(rng)
    lowest = rng.uniform(1000.0, 4000.0)
    magnifications = lowest * rng.uniform(1.3, 2.0) ** np.arange(rng.integers(1, 4))
    pitch_m = rng.uniform(10.0, 30.0) * DISPLAY_WIDTH_M / (lowest * scope.width)
    count = int(rng.integers(3, 6))
    turns = np.pi * np.arange(count) / count + rng.uniform(0.0, np.pi)
    found = []
    for g in magnifications:
        for k, turn in enumerate(turns):
            height = rng.normal(0.0, 1e-5)
            pixel_m = DISPLAY_WIDTH_M / (g * scope.width)
            seen_m = pixel_m * (1.0 + scope.rho * height)
            picture = draw_picture(scope, seen_m, pitch_m, turn + rng.normal(0.0, 0.03), rng)
            lines = find_lattice(picture, pattern="grating")
            if isinstance(lines, LatticeDetection):
                found.append(FoundView(f"{g:.0f}x {k}", float(g), None, lines))
            else:
                print(f"{index}: {lines.reason} (a pitch of {pitch_m / pixel_m:.0f} px)")
    if len(found) < 3:
        return None
    done = calibrate_found(found, [], display_width_m=DISPLAY_WIDTH_M, squares_m=[pitch_m])
    worst = []
    for g in sorted({view.magnification for view in found}):
        camera = done.calibration.at(g)
        pixel_m = DISPLAY_WIDTH_M / (g * scope.width)
        x, y = (values.ravel() for values in scope.raster(16))
        raw = np.stack([x, y], axis=1) + 0.5 * np.array([scope.width - 1, scope.height - 1])
        ours = camera.undistort(raw) @ np.linalg.inv(camera.ideal_from_sem_jacobian).T
        truth = np.stack(scope.metres(x, y, pixel_m), axis=1)
        ours, truth = ours - ours.mean(axis=0), truth - truth.mean(axis=0)
        u, values, vt = np.linalg.svd(ours.T @ truth)
        left = (ours @ (u @ vt) * values.sum() / np.sum(ours**2) - truth) / pixel_m
        error = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
        stated = float(np.sqrt(np.mean(predict_aligned_sigma_px(camera, raw) ** 2)))
        sizes, sigmas = np.array(camera.pixel_size_m), np.array(camera.pixel_size_sigma_m)
        off = float(np.max(np.abs((sizes - pixel_m * np.array(scope.sizes)) / sigmas)))
        worst.append((error, error / stated, off, float(np.max(sigmas / sizes))))
    return Outcome(len(found), *np.max(worst, axis=0).tolist())


def main() -> int:
    """Print the table; 1 if one raises or is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    outcomes, raised, few = [], 0, 0
    for index in range(options.count):
        try:
            outcome = judge(options.seed, index)
        except Exception:
            raised += 1
            print(f"{index}: raised\n{traceback.format_exc()}")
            continue
        if outcome is None:
            few += 1
        else:
            outcomes.append(outcome)
    px, sigmas, sizes, size = np.array(
        [(o.error_px, o.error_sigmas, o.size_sigmas, o.size_sigma) for o in outcomes]
    ).T
    wrong = int(np.sum(((px > FAR_PX) & (sigmas > FAR_SIGMAS)) | (sizes > FAR_SIGMAS)))
    show(
        f"microscopes calibrated from a grating (seed {options.seed})",
        [
            "count",
            "too few views",
            "raised",
            "wrong",
            "px median",
            "95 %",
            "err/sigma",
            "nm err/sigma",
            "nm sigma %",
        ],
        [
            [
                str(options.count),
                few,
                raised,
                wrong,
                float(np.median(px)),
                float(np.quantile(px, 0.95)),
                float(np.sqrt(np.mean(sigmas**2))),
                float(np.sqrt(np.mean(sizes**2))),
                100.0 * float(np.median(size)),
            ]
        ],
        "the worst of the magnifications of each; err/sigma is RMS over the microscopes",
    )
    return int(bool(raised or wrong))


if __name__ == "__main__":
    raise SystemExit(main())
