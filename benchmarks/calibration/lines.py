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

"""Are the lines of a grating found, and with the right period? Random pictures of parallel lines.

    python -m benchmarks.calibration.lines [--count 150] [--seed 0]

Pictures of 384 to 1024 px with a period from 8 px to the height over 3.7, in any direction, bent by a radial distortion
of 1.2 % (1-sigma). A third has wide lines, a third narrow ones (0.04 to 0.15 of the period), and a third faces with
bright edges, which may be at nearly even distances. Half of them have shading, half a disc of up to 0.3 of the width
that is darker or brighter than anything else.

A picture is *wrong* if the period found is off by more than 3 %. The limit, beyond which the command fails: none is
wrong, and 95 % are found.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.table import show
from semcal_ros.core.corners import LatticeDetection, find_lattice

Array = NDArray[np.float64]
KINDS = ("wide lines", "narrow lines", "bright edges")
MOST_OFF, LEAST_FOUND = 0.03, 0.95


def draw(seed: int, index: int) -> tuple[NDArray[np.uint8], str, float, Array]:
    """A picture, its kind, its period in px, and the unit vector across the lines."""
    rng = np.random.default_rng((seed, index))
    width = int(rng.choice([384, 512, 1024]))
    height = int(width * rng.choice([0.75, 1.0]))
    period = float(np.exp(rng.uniform(np.log(8.0), np.log(height / 3.7))))
    turn = rng.uniform(0.0, np.pi)
    across = np.array([np.cos(turn), np.sin(turn)])
    y, x = np.mgrid[0:height, 0:width].astype(float)
    u, v = x - 0.5 * width, y - 0.5 * height
    bent = 1.0 + rng.normal(0.0, 0.012) * (u * u + v * v) / (0.5 * width) ** 2
    at = bent * (across[0] * u + across[1] * v) / period + rng.uniform()
    off = np.abs(at - np.rint(at)) * period
    kind = KINDS[index % 3]
    duty = rng.uniform(0.04, 0.15) if kind == "narrow lines" else rng.uniform(0.25, 0.75)
    half = max(0.5 * duty * period, 1.2)
    level = 1.0 / (1.0 + np.exp((off - half) / max(0.6, 0.02 * period)))
    if kind == "bright edges":
        level = 0.3 * level + np.exp(-0.5 * ((off - half) / max(1.2, 0.04 * period)) ** 2)
    image = 70.0 + 80.0 * rng.choice([1.0, -0.7]) * level
    if rng.uniform() < 0.5:
        image += rng.uniform(-40.0, 40.0) * u / width + rng.uniform(-30.0, 30.0) * v / height
    if rng.uniform() < 0.5:
        cx, cy = rng.uniform(0.2, 0.8) * width, rng.uniform(0.2, 0.8) * height
        image[np.hypot(x - cx, y - cy) < rng.uniform(0.05, 0.15) * width] = rng.choice([10, 240])
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.7, 1.5))
    noisy = np.clip(np.rint(rng.normal(image, rng.uniform(3.0, 15.0))), 0, 255).astype(np.uint8)
    return noisy, kind, period, across


def judge(seed: int, index: int) -> tuple[str, str]:
    """The kind of a picture, and *found*, *refused* or *wrong*; of the latter two a line is printed."""
    image, kind, period, across = draw(seed, index)
    found = find_lattice(image, pattern="grating")
    said = f"{index:4d} {kind}, {image.shape[1]} x {image.shape[0]} px, period {period:.1f} px"
    if not isinstance(found, LatticeDetection):
        print(f"{said}: {found.reason}", flush=True)
        return kind, "refused"
    number = np.stack([found.ij[:, 0].astype(float), np.ones(len(found.ij))], axis=1)
    seen = abs(float(np.linalg.lstsq(number, found.xy @ across, rcond=None)[0][0]))
    if abs(seen / period - 1.0) > MOST_OFF:
        print(f"{said}: found with {seen:.1f} px", flush=True)
        return kind, "wrong"
    return kind, "found"


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    counts = Counter(judge(given.seed, index) for index in range(given.count))
    answers = ("found", "refused", "wrong")
    rows: list[list[object]] = [
        [kind, *(counts[kind, answer] for answer in answers)] for kind in KINDS
    ]
    show(f"pictures of gratings (seed {given.seed})", ["", *answers], rows)
    found, _, wrong = (sum(counts[kind, answer] for kind in KINDS) for answer in answers)
    return int(wrong > 0 or found < LEAST_FOUND * given.count)


if __name__ == "__main__":
    raise SystemExit(main())
