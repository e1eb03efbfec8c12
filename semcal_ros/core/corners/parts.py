"""Parts of a lattice that do not hang together: is it one board, or are there two?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semcal_ros.core.corners.checks import Fitted
from semcal_ros.core.corners.local_map import fit_local_maps

__all__ = ["one_board"]

Mask = NDArray[np.bool_]

# Parts of another board are off by up to 0.3 squares, how far lattices reach for a corner; local
# maps predict the next corners across a gap to a few hundredths of a square.
CONTINUED = 0.05
# Predictions with a larger variance than this reach too far across the gap.
LEVERAGE_MAX = 25.0
# Fewer corners were predicted from those across the gap already; that they agree is known.
PART_MIN = 4


def one_board(fitted: Fitted, keep: Mask) -> Mask:
    """The largest part of the lattice, and the others that continue it; (n,) true for these.

    Where two boards meet, growing a lattice goes on from one to the other, but no corner in between
    agrees with its neighbours. Debris parts a board as well, but then the maps of one part predict
    the other.
    """
    cells = fitted.cells
    low = cells[keep].min(axis=0)
    grid = np.zeros(cells[keep].max(axis=0) - low + 1, dtype=np.bool_)
    grid[tuple((cells[keep] - low).T)] = True
    labels, count = ndimage.label(grid)
    if count == 1:
        return keep
    part = np.zeros(len(keep), dtype=np.int64)
    part[keep] = labels[tuple((cells[keep] - low).T)]
    order = np.argsort(-np.bincount(part[keep], minlength=count + 1), kind="stable")[:count]
    size = np.bincount(part, minlength=count + 1)
    joined = keep & ((part == order[0]) | (size[part] < PART_MIN))
    waiting = [p for p in order[1:] if size[p] >= PART_MIN]
    # A part may continue the lattice only across another one.
    while True:
        continuing = [p for p in waiting if _continues(fitted, joined, part == p)]
        if not continuing:
            return np.asarray(joined, dtype=np.bool_)
        joined |= np.isin(part, continuing)
        waiting = [p for p in waiting if p not in continuing]


def _continues(fitted: Fitted, joined: Mask, other: Mask) -> bool:
    """Whether the corners around a part are where the joined ones predict them."""
    cells, xy = fitted.cells, fitted.fit.xy
    maps = fit_local_maps(cells[other], cells[joined], xy[joined])
    near = maps.usable & (maps.leverage < LEVERAGE_MAX)
    if not np.any(near):
        return False
    spacing = np.linalg.norm(fitted.maps.axes[other][near], axis=2).min(axis=1)
    variance = 0.5 * np.trace(fitted.fit.covariance[other][near], axis1=1, axis2=2)
    miss = np.linalg.norm(xy[other][near] - maps.xy[near], axis=1)
    allowed = CONTINUED * spacing + 3.0 * np.sqrt(variance * (1.0 + maps.leverage[near]))
    return bool(np.median(miss / allowed) < 1.0)
