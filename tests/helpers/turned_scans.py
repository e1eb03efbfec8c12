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

"""Scans with turned rasters, drawn line by line from a formula, without any part of the suite but the camera."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from semcal_ros.core.arrays import AnyImage, Array
from semcal_ros.core.camera.scan_camera import ScanCamera

Surface = Callable[[Array, Array], Array]
Drift = Callable[[Array], Array]
NOISE = 10.0


def surface(seed: int, cell_px: float = 4.0) -> Surface:
    """Waves of all directions, some ``2 pi cell_px`` long, about zero with a standard deviation of one."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(0.0, 1.0 / cell_px, (100, 2)), rng.uniform(0.0, 2.0 * np.pi, 100)

    def height(x: Array, y: Array) -> Array:
        total = np.zeros(np.shape(x))
        for (a, b), phase in zip(waves, phases, strict=True):
            # A cosine in single precision, good to a thousandth of a grey level, is several times as fast.
            total += np.cos((a * x + b * y + phase).astype(np.float32))
        return np.asarray(total / np.sqrt(50.0))

    return height


def still(progress: Array) -> Array:
    return np.zeros((*progress.shape, 2))


def scan(
    shown: Surface,
    drift: Drift,
    size: tuple[int, int],
    turned_deg: float,
    noise: float = NOISE,
    camera: ScanCamera | None = None,
    seed: int = 0,
) -> AnyImage:
    """What a raster that is turned sees: the specimen turns in the image from +x towards +y, as the convention has it.

    ``drift`` gives the displacement (..., 2) px of the specimen, in its own axes, at the part of the scan that is over.
    """
    width, height = size
    rows, cols = np.indices((height, width), dtype=float)
    progress = (rows + cols / width) / height
    if camera is not None:
        flat = camera.rect_from_raw(np.stack([cols.ravel(), rows.ravel()], axis=1))
        cols, rows = (one.reshape(rows.shape) for one in flat.T)
    x, y = cols - 0.5 * (width - 1), rows - 0.5 * (height - 1)
    cos, sin = np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))
    moved = drift(progress)
    grey = shown(cos * x + sin * y - moved[..., 0], -sin * x + cos * y - moved[..., 1])
    noisy = 128.0 + 40.0 * grey + np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
