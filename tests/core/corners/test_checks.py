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

"""The checks of fitted corners, on fits that are written down."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.corners.checks import find_consistent, inflate_variance
from semcal_ros.core.corners.corner_fit import CornerFit
from semcal_ros.core.corners.local_map import fit_local_maps


def fits(chi2: Array, freedom: float) -> CornerFit:
    """Fits of which only the residuals matter."""
    values = {field.name: np.zeros(len(chi2)) for field in fields(CornerFit)}
    return CornerFit(**{**values, "chi2": chi2, "freedom": np.full(len(chi2), freedom)})


def test_covariances_grow_with_the_common_misfit_and_with_a_far_larger_one() -> None:
    # Three standard deviations of chi-square per degree of freedom are 3 sqrt(2 / 50) = 0.6.
    chi2 = np.array([1.9, 2.0, 2.0, 2.1, 3.15, 3.25, 9.0])
    keep = np.array([True, True, True, True, False, False, False])
    factors = inflate_variance(fits(chi2, 50.0), keep)
    assert factors == pytest.approx([2.0, 2.0, 2.0, 2.0, 2.0, 3.25, 9.0])


def test_a_corner_may_miss_its_neighbours_by_what_its_misfit_explains() -> None:
    cells = np.stack(np.meshgrid(np.arange(9), np.arange(9)), axis=-1).reshape(-1, 2)
    xy = 40.0 + 20.0 * cells + 0.02 * np.random.default_rng(0).normal(size=cells.shape)
    noisy, shifted = (
        int(np.flatnonzero(np.all(cells == at, axis=1))[0]) for at in ([3, 3], [6, 6])
    )
    # Both are seven stated sigmas away; one of them has residuals that are three times the usual.
    xy[[noisy, shifted]] = 40.0 + 20.0 * cells[[noisy, shifted]] + [0.14, 0.0]
    chi2 = np.ones(len(cells))
    chi2[noisy] = 9.0
    fit = replace(fits(chi2, 50.0), xy=xy, covariance=np.tile(0.02**2 * np.eye(2), (len(xy), 1, 1)))
    maps = fit_local_maps(cells, cells, xy)
    consistent = find_consistent(cells, maps, fit, np.ones(len(cells), dtype=np.bool_))
    assert consistent[noisy]
    assert not consistent[shifted]
    # Noise alone exceeds the limits once in 900.
    assert consistent.sum() >= len(cells) - 2
