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

"""Are replicas of cross gratings found, with light from one side and holes in the film? Random pictures of them.

    python -m benchmarks.calibration.replicas [--count 100] [--seed 0]

Raised lines in two directions, 14 to 60 px apart and 0.1 to 0.4 of that wide, on a film with texture, in pictures of
512 to 1024 px at any turn; a shear of 0.012 and an aspect of 1 % (1-sigma). Grey levels are a mixture of height, slope
towards a detector on one side, and steepness, which makes edges bright. Lines wave by up to 0.02 of their distance over
30 px and more, and are as rough over a sixth of it. Up to four holes reach 1.6 distances, and 10 to 150 electrons make
a pixel.

Compared are the places of the points in the cells, apart from what all of them have in common: where in a cell that is
lit from one side its point lies is free. A picture is *wrong* if points are not as dense as the cells within 5 %, or
scatter by more than 0.08 of the distance. The limit, beyond which the command fails: none is wrong, and 95 % are found.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.table import show
from semcal_ros.core.corners import LatticeDetection, find_lattice

Array = NDArray[np.float64]
MOST_OFF, MOST_SCATTER, LEAST_FOUND = 0.05, 0.08, 0.95


@dataclass(frozen=True)
class Replica:
    """A picture, its lattice vectors in rows (px), and the waves (2, h, w) that its lines have, in cells."""

    image: NDArray[np.uint8]
    axes: Array
    waves: Array
    said: str

    def cells_of(self, xy: Array) -> Array:
        """Where positions are, in cells."""
        even = xy @ np.linalg.inv(self.axes)
        return even + np.stack(
            [ndimage.map_coordinates(wave, xy.T[::-1], order=1) for wave in self.waves], axis=1
        )


def _noise(rng: np.random.Generator, side: int, scale: float, sigma: float) -> Array:
    """Noise as smooth as the scale, px, with a standard deviation."""
    smooth = ndimage.gaussian_filter(rng.normal(size=(side, side)), scale)
    return np.asarray(sigma * smooth / smooth.std())


def draw(seed: int, index: int) -> Replica:
    """Draw one."""
    rng = np.random.default_rng((seed, index))
    side = int(rng.choice([512, 768, 1024]))
    pitch, turn = rng.uniform(14.0, 60.0), rng.uniform(-0.5 * np.pi, 0.5 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    bent = np.array([[1.0, 0.0], [rng.normal(0.0, 0.012), 1.0 + rng.normal(0.0, 0.01)]])
    axes = pitch * np.array([[c, s], [-s, c]]) @ bent
    y, x = np.mgrid[0:side, 0:side].astype(np.float64)
    even = np.stack([x, y], axis=-1) @ np.linalg.inv(axes) + rng.uniform(size=2)
    waves = np.stack([_noise(rng, side, 30.0, rng.uniform(0.0, 0.02)) for _ in range(2)])
    rough = [_noise(rng, side, pitch / 6.0, rng.uniform(0.0, 0.02)) for _ in range(2)]
    wide, steep = rng.uniform(0.1, 0.4), rng.uniform(0.03, 0.15)

    def line(at: Array) -> Array:
        return 0.5 - 0.5 * np.tanh((np.abs(at - np.rint(at)) - 0.5 * wide) / steep)

    one, two = (line(even[..., k] + waves[k] + rough[k]) for k in range(2))
    crossing = str(rng.choice(["higher", "as high", "rounded"]))
    height = {
        "higher": one + two,
        "as high": np.maximum(one, two),
        "rounded": one + two - one * two,
    }[crossing]
    height = ndimage.gaussian_filter(height, rng.uniform(0.7, 1.8))
    down, right = np.gradient(height)
    towards = rng.uniform(0.0, 2.0 * np.pi)
    texture = _noise(rng, side, rng.uniform(1.0, 3.0), 1.0)
    slope = 0.15 * pitch * (np.cos(towards) * right + np.sin(towards) * down)
    image = rng.uniform(0.0, 0.6) * height + rng.uniform(0.2, 1.0) * slope
    image += rng.uniform(0.0, 0.8) * 0.15 * pitch * np.hypot(right, down)
    image += rng.uniform(0.02, 0.15) * texture + rng.uniform(-0.4, 0.4) * (x / side - 0.5)
    holes = int(rng.integers(0, 5))
    for _ in range(holes):
        at = rng.uniform(0.0, side, 2)
        inside = np.hypot(x - at[0], y - at[1]) + 2.0 * texture < rng.uniform(0.3, 1.6) * pitch
        image[inside] = rng.uniform(-0.5, 0.0)
    image = (image - image.min()) / np.ptp(image)
    electrons = rng.uniform(10.0, 150.0)
    counts = rng.poisson(electrons * (0.3 + image)) / electrons
    grey = np.clip(np.rint(196.0 * (counts - 0.1)), 0, 255).astype(np.uint8)
    said = f"{side} px, pitch {pitch:.1f} px, lines {wide:.2f} wide, crossings {crossing}, {holes} holes"
    return Replica(grey, axes, waves, said)


@dataclass(frozen=True)
class Outcome:
    """What came of a picture: its answer; scatter in px, also in sigmas, and the time per megapixel, s."""

    answer: str
    pattern: str
    scatter_px: float
    in_sigmas: float
    seconds: float


def judge(seed: int, index: int) -> Outcome:
    """Find one; of those that are refused or wrong a line is printed."""
    replica = draw(seed, index)
    start = time.perf_counter()
    found = find_lattice(replica.image)
    seconds = (time.perf_counter() - start) * 1e6 / replica.image.size
    if not isinstance(found, LatticeDetection):
        print(f"{index:4d} {replica.said}: {found.reason}", flush=True)
        return Outcome("refused", "", np.nan, np.nan, seconds)
    at = replica.cells_of(found.xy)
    common = np.angle(np.exp(2j * np.pi * at).mean(axis=0)) / (2.0 * np.pi)
    off = (at - common - np.rint(at - common)) @ replica.axes
    # Indices count cells by a whole, invertible change of axes.
    design = np.column_stack([found.ij, np.ones(len(found.ij))])
    counted = np.linalg.lstsq(design, at, rcond=None)[0][:2]
    area = abs(float(np.linalg.det(counted)))
    scatter = float(np.sqrt(np.mean(off**2)))
    pitch = float(np.sqrt(abs(np.linalg.det(replica.axes))))
    sigmas = float(np.sqrt(np.mean((off / found.sigma_px[:, None]) ** 2)))
    if abs(area - 1.0) > MOST_OFF or scatter > MOST_SCATTER * pitch:
        print(
            f"{index:4d} {replica.said}: a cell is {area:.3f} cells, scatter {scatter:.2f} px",
            flush=True,
        )
        return Outcome("wrong", found.pattern, scatter, sigmas, seconds)
    return Outcome("found", found.pattern, scatter, sigmas, seconds)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    outcomes = [judge(given.seed, index) for index in range(given.count)]
    rows: list[list[object]] = []
    for answer in ("found", "refused", "wrong"):
        own = [o for o in outcomes if o.answer == answer]
        if own:
            columns = np.array([[o.scatter_px, o.in_sigmas, o.seconds] for o in own])
            called = [
                f"{sum(o.pattern == name for o in own)} {name}"
                for name in ("lines", "dots", "crosses", "chess")
            ]
            rows.append([answer, len(own), *np.median(columns, axis=0), ", ".join(called)])
    show(
        f"replicas of cross gratings (seed {given.seed}); medians",
        ["", "count", "scatter px", "scatter/sigma", "s per Mpx", "called"],
        rows,
    )
    found = sum(o.answer == "found" for o in outcomes)
    wrong = sum(o.answer == "wrong" for o in outcomes)
    return int(wrong > 0 or found < LEAST_FOUND * given.count)


if __name__ == "__main__":
    raise SystemExit(main())
