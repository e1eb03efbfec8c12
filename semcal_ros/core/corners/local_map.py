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

"""Smooth local maps from lattice indices to the image, fitted to the neighbours of each corner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from semcal_ros.core.arrays import Array, Indices, Mask
from semcal_ros.core.corners.thresholds import (
    CUBIC_BELOW,
    SECOND_ORDER_RIDGE,
    SUPPORT_MIN,
    THIRD_ORDER_RIDGE,
)


@dataclass(frozen=True)
class LocalMaps:
    """Second-order expansion of the map lattice -> image around lattice cells.

    Attributes
    ----------
    xy
        (n, 2) predicted position, px.
    axes
        (n, 2, 2) first derivatives; ``axes[:, 0]`` along i, ``axes[:, 1]`` along j.
    bend
        (n, 2, 2) second derivatives along i (``bend[:, 0]``) and along j (``bend[:, 1]``).
    twist
        (n, 2) mixed second derivatives.
    support
        (n,) number of neighbours used.
    leverage
        (n,) variance of the prediction for unit variance of the neighbours.
    """

    xy: Array
    axes: Array
    bend: Array
    twist: Array
    support: Array
    leverage: Array

    @property
    def cell_px2(self) -> Array:
        """(n,) signed area of a square, px^2."""
        along, across = self.axes[:, 0], self.axes[:, 1]
        return along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]

    @property
    def usable(self) -> Mask:
        """(n,) whether enough neighbours, not all in a row, determine a regular map."""
        norm = np.linalg.norm(self.axes, axis=2)
        skew = self.cell_px2 / np.maximum(norm[:, 0] * norm[:, 1], 1e-9)
        return (self.support >= SUPPORT_MIN) & (norm.min(axis=1) > 1.0) & (skew > 0.2)

    def select(self, keep: Mask) -> LocalMaps:
        """Return the maps of the cells where ``keep`` is true."""
        return LocalMaps(
            self.xy[keep],
            self.axes[keep],
            self.bend[keep],
            self.twist[keep],
            self.support[keep],
            self.leverage[keep],
        )

    @staticmethod
    def join(parts: Sequence[LocalMaps]) -> LocalMaps:
        """Concatenate the maps of several sets."""
        return LocalMaps(
            *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(LocalMaps))
        )


def fit_local_maps(
    cells: Indices, ij: Indices, xy: Array, *, leave_out_self: bool = True
) -> LocalMaps:
    """Fit weighted least-squares polynomials through the known corners near ``cells``.

    Parameters
    ----------
    cells
        (n, 2) lattice cells to predict.
    ij, xy
        (k, 2) indices and (k, 2) positions of the known corners.
    leave_out_self
        Whether to predict a known corner without its own position.
    """
    cubic = len(ij) < CUBIC_BELOW
    reach = 3 if cubic else 2
    span = np.arange(-reach, reach + 1)
    u, v = (g.ravel().astype(np.float64) for g in np.meshgrid(span, span, indexing="ij"))
    columns = [np.ones_like(u), u, v, u * u / 2, u * v, v * v / 2]
    ridge = [0.0, 0.0, 0.0] + 3 * [SECOND_ORDER_RIDGE]
    if cubic:
        columns += [u**3 / 6, u * u * v / 2, u * v * v / 2, v**3 / 6]
        ridge += 4 * [THIRD_ORDER_RIDGE]
    basis = np.stack(columns, axis=1)
    weight = np.exp(-(u * u + v * v) / (2.0 * (0.8 * reach) ** 2))
    if leave_out_self:
        weight = np.where((u == 0) & (v == 0), 0.0, weight)

    lookup, low = _dense(ij, cells, reach)
    side = lookup.shape[1]
    steps = (u * side + v).astype(np.int64)
    member = lookup.ravel()[((cells - low) @ np.array([side, 1]))[:, None] + steps]
    known = member >= 0
    # Most cells have the same neighbours, and the fit is linear in their positions. Sums of powers
    # of two below 2^49 are exact.
    code, which = np.unique(known @ 2.0 ** np.arange(len(u)), return_inverse=True)
    bits = code.astype(np.int64)[:, None] >> np.arange(len(u))
    patterns = (bits & 1).astype(np.float64) * weight
    solver = _solvers(patterns, basis, np.array(ridge))
    solution = _solve(solver, which, xy, member)
    return LocalMaps(
        solution[:, 0],
        solution[:, 1:3],
        solution[:, [3, 5]],
        solution[:, 4],
        (patterns > 0).sum(axis=1).astype(np.float64)[which],
        (solver[:, 0] ** 2).sum(axis=1)[which],
    )


def _solve(solver: Array, which: Indices, xy: Array, member: Indices) -> Array:
    """Return (n, terms, 2) coefficients: ``solver[which]`` times the positions of the neighbours.

    Inside a lattice all cells share one solver, so that one large product replaces many small
    ones.
    """
    common = int(np.argmax(np.bincount(which)))
    solution = np.stack([coordinate[member] @ solver[common].T for coordinate in xy.T], axis=2)
    other = which != common
    solution[other] = solver[which[other]] @ xy[member[other]]
    return solution


def _solvers(patterns: Array, basis: Array, ridge: Array) -> Array:
    """Return (k, terms, m) maps from values to coefficients, one for each row of (k, m) weights."""
    terms = basis.shape[1]
    pairs = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    normal = (patterns @ pairs).reshape(-1, terms, terms)
    normal += np.diag(ridge + 1e-9)
    solver = np.linalg.inv(normal) @ (basis.T * patterns[:, None, :])
    # Taking positions relative to the mean of the neighbours keeps the ridge off the zeroth order.
    mean = patterns / np.maximum(patterns.sum(axis=1, keepdims=True), 1e-12)
    solver -= solver.sum(axis=2, keepdims=True) * mean[:, None]
    solver[:, 0] += mean
    return np.asarray(solver, dtype=np.float64)


def _dense(ij: Indices, cells: Indices, reach: int) -> tuple[Indices, Indices]:
    low = np.minimum(ij.min(axis=0), cells.min(axis=0)) - reach
    high = np.maximum(ij.max(axis=0), cells.max(axis=0)) + reach
    lookup = np.full(tuple(high - low + 1), -1, dtype=np.int64)
    lookup[ij[:, 0] - low[0], ij[:, 1] - low[1]] = np.arange(len(ij))
    return lookup, low
