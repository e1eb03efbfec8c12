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

"""Losses that outliers do not rule, by the noise that they are for.

Each gives a residual its weight in a least-squares fit that is repeated until the weights stay as they are. Residuals
are in standard deviations; of several components it is their norm.

- **Huber's** for residuals that are normal but for a few: it is convex, so that a fit has one minimum, and an outlier
  pulls by a constant however far off it is. Corners of grids, and first fits.
- **Cauchy's** for matches of which many are somewhat wrong: an outlier pulls the less the farther off it is, and none
  is lost for good.
- **Tukey's** for what is either right or of something else, as the edge of a beam beside that of a particle: from his
  constant on it counts for nothing.

Huber, Robust Statistics (1981); Holland and Welsch (1977), doi:10.1080/03610927708827533.
"""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array

#: Derived: Tukey's constant for his biweight, in sigmas, for an efficiency of 95 % with normal noise (Holland and
#: Welsch 1977).
TUKEY_CONSTANT = 4.685


def huber_weight(norm: Array, constant: float) -> Array:
    """Return 1 up to ``constant``, and ``constant / norm`` beyond."""
    return np.asarray(constant / np.maximum(norm, constant), dtype=np.float64)


def huber_loss(norm: Array, constant: float) -> Array:
    """Return half the square up to ``constant``, and what grows linearly beyond."""
    return np.where(norm > constant, constant * (norm - 0.5 * constant), 0.5 * norm * norm)


def cauchy_weight(square: Array, constant: float) -> Array:
    """Return the weights of residuals with these squares."""
    return np.asarray(1.0 / (1.0 + square / constant**2), dtype=np.float64)


def cauchy_loss(square: Array, constant: float) -> Array:
    """Return the losses of residuals with these squares: half of these where they are small."""
    return np.asarray(0.5 * constant**2 * np.log1p(square / constant**2), dtype=np.float64)


def tukey_weight(residual: Array, scale: float = 1.0) -> Array:
    """Return the weights of residuals of some scale; 0 from :data:`TUKEY_CONSTANT` scales on."""
    return np.asarray(_within(residual, scale) ** 2, dtype=np.float64)


def tukey_loss(residual: Array, scale: float = 1.0) -> Array:
    """Return the losses in squares of the scale: half the square where it is small, at most c^2 / 6."""
    largest = TUKEY_CONSTANT**2 / 6.0
    return np.asarray(largest * (1.0 - _within(residual, scale) ** 3), dtype=np.float64)


def _within(residual: Array, scale: float) -> Array:
    return np.maximum(1.0 - (residual / (scale * TUKEY_CONSTANT)) ** 2, 0.0)
