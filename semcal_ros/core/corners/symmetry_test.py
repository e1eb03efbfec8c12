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

"""Test that opposite squares of a corner have the same grey value, as on a chess board."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array, Array32
from semcal_ros.core.corners.window import PixelWindows

__all__ = ["compare_opposite_squares"]


def compare_opposite_squares(
    windows: PixelWindows,
    nonlinear: Array,
    jacobian: Array32,
    residual: Array32,
    weight: Array32,
    normal: Array,
    step: Array,
) -> tuple[Array, Array]:
    """Apply a score test of two steps that the model lacks: both squares beyond an edge brighter.

    Nothing is fitted again: the residuals are projected on the two new terms, from which the
    parameters of the model are eliminated.

    Parameters
    ----------
    windows, nonlinear
        Pixels of n corners and (n, 7) parameters of :mod:`semcal_ros.core.corners.edge_model`.
    jacobian, residual, weight
        (n, 15, p) derivatives, (n, p) residuals and weights of the pixels before the last step.
    normal, step
        (n, 15, 15) normal matrices and (n, 15) last step.

    Returns
    -------
    statistic
        (n,) chi-square with two degrees of freedom where opposite squares are alike.
    difference
        (n,) the larger of the two steps, half the difference of grey value.
    """

    def column(values: Array) -> Array32:
        return np.asarray(values, dtype=np.float32)[:, None]

    px, py, angle_1, angle_2 = nonlinear.T[:4]
    x, y = windows.x - column(px), windows.y - column(py)
    side_1 = np.copysign(weight, column(np.cos(angle_1)) * y - column(np.sin(angle_1)) * x)
    side_2 = np.copysign(weight, column(np.sin(angle_2)) * x - column(np.cos(angle_2)) * y)
    sides = np.stack([side_1, side_2], axis=1)
    shared = (sides @ jacobian.transpose(0, 2, 1)).astype(np.float64)
    score = (sides @ residual[:, :, None])[:, :, 0] - np.einsum("nka,na->nk", shared, step)
    total = weight.sum(axis=1, dtype=np.float64)
    information = np.empty((len(x), 2, 2))
    # The ridge is for windows that show only one side of an edge.
    information[:, 0, 0] = information[:, 1, 1] = total * (1.0 + 1e-6)
    both = np.einsum("np,np->n", side_1, np.copysign(np.float32(1.0), side_2))
    information[:, 0, 1] = information[:, 1, 0] = both
    information -= shared @ np.linalg.solve(normal, shared.transpose(0, 2, 1))
    size = np.linalg.solve(information, score[:, :, None])[:, :, 0]
    return np.einsum("nk,nk->n", score, size), np.abs(size).max(axis=1)
