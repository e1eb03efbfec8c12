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

"""A lattice grown through saddle points that are written down."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.corners.lattice import SaddlePoints, grow_best_lattice

SPACING_PX = 30.0


def test_a_saddle_of_the_wrong_sign_is_passed_over_however_near_it_lies() -> None:
    ij = np.stack(np.meshgrid(np.arange(7), np.arange(7)), axis=-1).reshape(-1, 2)
    xy = 100.0 + SPACING_PX * ij
    sign = np.where(ij.sum(axis=1) % 2 == 0, 1.0, -1.0)
    # One corner is a tenth of a square off, and debris where it is expected has the contrast of its
    # neighbours.
    own = np.flatnonzero(np.all(ij == [5, 4], axis=1))[0]
    expected = xy[own].copy()
    xy[own] += [3.0, 0.0]
    xy, sign = np.vstack([xy, expected]), np.append(sign, -sign[own])
    hessian = sign[:, None, None] * np.array([[0.0, 1.0], [1.0, 0.0]])
    lattice = grow_best_lattice(SaddlePoints(xy, hessian, np.ones(len(xy))), (400, 400))
    assert lattice is not None
    assert len(lattice.xy) == 49
    assert not np.any(np.all(lattice.xy == expected, axis=1))
    assert np.any(np.all(lattice.xy == xy[own], axis=1))
