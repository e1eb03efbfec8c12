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

"""Views of a grid whose images are bent, as by charging or a drift that changes within an image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.views import GridView


def bend(xy: Array, size: tuple[int, int], rng: np.random.Generator) -> Array:
    """Displacements (n, 2) of places in an image by 1 px RMS, in low cosines of both coordinates."""
    u, v = (xy / size).T
    out = np.zeros_like(xy)
    for i in range(5):
        for j in range(5):
            pattern = np.cos(np.pi * i * u) * np.cos(np.pi * j * v)
            out += pattern[:, None] * rng.normal(size=2) * (i + j > 0)
    return np.asarray(out / np.sqrt(np.mean(out**2)))


def bent_view(
    view: GridView, sigma_px: float, size: tuple[int, int], rng: np.random.Generator
) -> GridView:
    """The view with corners that are off together, by ``sigma_px`` RMS."""
    return replace(view, image_xy=view.image_xy + sigma_px * bend(view.image_xy, size, rng))
