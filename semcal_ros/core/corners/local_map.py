"""Smooth local maps from lattice indices to the image, fitted to the neighbours of each corner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["LocalMaps", "fit_local_maps"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# With many corners the squares are small and a quadratic over 5 x 5 corners follows any lens; with
# few, large squares the third order matters.
CUBIC_BELOW = 300
SECOND_ORDER_RIDGE = 1e-2
THIRD_ORDER_RIDGE = 3e-2
SUPPORT_MIN = 3


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
    support
        (n,) number of neighbours used.
    leverage
        (n,) variance of the prediction for unit variance of the neighbours.
    """

    xy: Array
    axes: Array
    bend: Array
    support: Array
    leverage: Array

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Where enough neighbours, not all in a row, determine a regular map."""
        norm = np.linalg.norm(self.axes, axis=2)
        skew = np.linalg.det(self.axes) / np.maximum(norm[:, 0] * norm[:, 1], 1e-9)
        return np.asarray((self.support >= SUPPORT_MIN) & (norm.min(axis=1) > 1.0) & (skew > 0.2))

    def select(self, keep: NDArray[np.bool_]) -> LocalMaps:
        """The maps of the cells where ``keep`` is true."""
        return LocalMaps(
            self.xy[keep],
            self.axes[keep],
            self.bend[keep],
            self.support[keep],
            self.leverage[keep],
        )


def fit_local_maps(
    cells: Indices, ij: Indices, xy: Array, *, leave_out_self: bool = True
) -> LocalMaps:
    """Weighted least-squares polynomials around ``cells`` through the known corners near them.

    Parameters
    ----------
    cells
        (n, 2) lattice cells to predict.
    ij, xy
        (k, 2) indices and (k, 2) positions of the known corners.
    leave_out_self
        Do not use a known corner for its own prediction.
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
    near = cells[:, None, :] - low + np.stack([u, v], axis=1).astype(np.int64)[None]
    member = lookup[near[..., 0], near[..., 1]]
    known = member >= 0
    w = np.where(known, weight[None], 0.0)
    # Positions relative to the neighbours' mean keep the ridge off the zeroth order and the numbers
    # small.
    mean = (w[:, :, None] * xy[member]).sum(axis=1) / np.maximum(w.sum(axis=1), 1e-12)[:, None]
    target = xy[member] - mean[:, None]
    pairs = (basis[:, :, None] * basis[:, None, :]).reshape(len(u), -1)
    terms = basis.shape[1]
    normal = (w @ pairs).reshape(-1, terms, terms)
    normal += np.diag(ridge) + 1e-9 * np.eye(terms)
    right = basis.T @ (w[:, :, None] * target)
    inverse = np.linalg.inv(normal)
    solution = inverse @ right
    spread = ((w * w) @ pairs).reshape(-1, terms, terms)
    leverage = np.einsum("na,nab,nb->n", inverse[:, 0], spread, inverse[:, 0])
    return LocalMaps(
        solution[:, 0] + mean,
        solution[:, 1:3],
        solution[:, [3, 5]],
        known.sum(axis=1).astype(np.float64) - (known[:, len(u) // 2] if leave_out_self else 0.0),
        np.maximum(leverage, 0.0),
    )


def _dense(ij: Indices, cells: Indices, reach: int) -> tuple[Indices, Indices]:
    low = np.minimum(ij.min(axis=0), cells.min(axis=0)) - reach
    high = np.maximum(ij.max(axis=0), cells.max(axis=0)) + reach
    lookup = np.full(tuple(high - low + 1), -1, dtype=np.int64)
    lookup[ij[:, 0] - low[0], ij[:, 1] - low[1]] = np.arange(len(ij))
    return lookup, low
