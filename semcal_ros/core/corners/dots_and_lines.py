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

"""Find grids of dots or holes, and gratings of crossed lines, at sub-pixel accuracy.

Between the dots of a square lattice the grey value has saddle points, and so it has between the
crossings of lines: smoothed to the spacing, all these patterns are the checkerboard that their
strongest harmonics make, turned by 45 degrees. So the lattice is grown as that of a checkerboard, and
its squares are the cells of the pattern.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Array32, Image, Indices, Mask
from semcal_ros.core.corners.checks import find_consistent, inflate_variance, select_connected
from semcal_ros.core.corners.corner_fit import NoiseModel, fit_noise
from semcal_ros.core.corners.edge_model import PixelWindows
from semcal_ros.core.corners.lattice import (
    STEPS,
    Lattice,
    SaddlePoints,
    enlarged,
    find_saddles,
    grow_best_lattice,
)
from semcal_ros.core.corners.lattice_refinement import RefinedCorners
from semcal_ros.core.corners.local_map import LocalMaps, fit_local_maps
from semcal_ros.core.corners.pattern import CellShape, CellShapes, find_motif, fit_shapes
from semcal_ros.core.corners.thresholds import (
    CELL_SAMPLE,
    CELL_SAMPLE_MIN,
    CELL_SAMPLE_PIXELS,
    CELL_SINE_MIN,
    CHI2_EXCESS,
    CHI2_SIGMAS,
    COARSE_SAMPLE,
    COARSE_SAMPLE_PIXELS,
    CONTRAST_MIN,
    CORNERS_COMPARED_MIN,
    FULL_RESOLUTION_PX,
    LAST_ROUNDS,
    LAST_STEP_MAX_PX,
    MEAN_ROUNDS,
    MISFIT_VISIBLE,
    MIXTURE_MIN,
    MIXTURE_ROUNDS,
    OUTLINE_SHOWN_MIN,
)
from semcal_ros.core.corners.unit_cell import (
    CellFit,
    UnitCell,
    average_cells,
    bin_cells,
    fit_cells,
    gather_cells,
)


def grow_at_scale(
    small: Image, scale_px: float, octave: int, size: tuple[int, int]
) -> Lattice | None:
    """Grow a lattice through the saddle points at one scale.

    Parameters
    ----------
    small
        (h, w) float32, reduced by two to the power of ``octave``.
    scale_px
        Standard deviation of the smoothing in pixels of the whole image.
    octave
        See ``small``.
    size
        (width, height) of the whole image, px.
    """
    factor = 2.0**octave
    saddles = find_saddles(small, scale_px / factor)
    moved = SaddlePoints(enlarged(saddles.xy, factor), saddles.hessian, saddles.response)
    lattice = grow_best_lattice(moved, size)
    if lattice is None:
        return None
    # In noise the axes of a cell may fall onto each other: it is none.
    length = np.linalg.norm(lattice.axes, axis=2).prod(axis=1)
    return lattice.select(np.abs(np.linalg.det(lattice.axes)) > CELL_SINE_MIN * length)


def count_regular_area(cells: Lattice) -> float:
    """Return the area, px^2, of the cells that lie where their neighbours predict them."""
    maps = fit_local_maps(cells.ij, cells.ij, cells.xy)
    residual = np.linalg.norm(maps.xy - cells.xy, axis=1)
    spacing = np.linalg.norm(cells.axes, axis=2).min(axis=1)
    # In units of area: a lattice through noise has many small cells.
    area = np.abs(np.linalg.det(cells.axes))
    return float(area[(residual < 0.1 * spacing) & maps.usable].sum())


def bright_cells(image: Image, lattice: Lattice) -> Lattice | None:
    """Return the bright squares of a chess lattice, as a lattice of their own; None without any.

    Parameters
    ----------
    image
        (h, w) float32.
    lattice
        Corners of squares that alternate between bright and dark.
    """
    sets = [_squares(lattice, parity) for parity in (0, 1)]
    levels = [_median_at(image, cells.xy) if len(cells.ij) else -np.inf for cells in sets]
    brighter = sets[int(np.argmax(levels))]
    return brighter if len(brighter.ij) else None


def _squares(lattice: Lattice, parity: int) -> Lattice:
    """Return the squares whose first corner has this parity of i + j, at their centres."""
    low = lattice.ij.min(axis=0)
    size = lattice.ij.max(axis=0) - low + 2
    member = np.full(size, -1, dtype=np.intp)
    member[tuple((lattice.ij - low).T)] = np.arange(len(lattice.ij))
    i, j = (lattice.ij - low).T
    corners = np.stack([member[i, j], member[i + 1, j], member[i, j + 1], member[i + 1, j + 1]])
    keep = np.all(corners >= 0, axis=0) & (lattice.ij.sum(axis=1) % 2 == parity)
    xy = lattice.xy[corners[:, keep]].mean(axis=0)
    return _along_diagonals(Lattice(lattice.ij[keep], xy, lattice.axes[keep]), parity)


def _along_diagonals(cells: Lattice, parity: int) -> Lattice:
    """Return cells whose i + j all have this parity, as a lattice of their own."""
    i, j = (cells.ij - np.array([parity, 0])).T
    ij = np.stack([(i + j) // 2, (j - i) // 2], axis=1).astype(np.intp)
    # A step along the new i is one along both old axes; along the new j, back along i and on along j.
    axes = np.stack([cells.axes.sum(axis=1), cells.axes[:, 1] - cells.axes[:, 0]], axis=1)
    return Lattice(ij, cells.xy, axes)


def _median_at(image: Image, xy: Array) -> float:
    column, row = np.rint(xy).astype(np.intp).T
    height, width = image.shape
    return float(np.median(image[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]))


def split_mixture(level: Callable[[int], Array32], cells: Lattice) -> Lattice:
    """Return the cells, or every other one of them, if cells with odd and with even sums of indices are not alike.

    Between square dots half a distance wide, saddle points also make a lattice of dots and gaps.
    """
    for _ in range(MIXTURE_ROUNDS):
        parity = cells.ij.sum(axis=1) % 2
        parts = [cells.select(parity == k) for k in (0, 1)]
        if min(len(part.ij) for part in parts) < CORNERS_COMPARED_MIN:
            break
        means = [_mean_cell(level, part) for part in parts]
        if means[0] is None or means[1] is None:
            break
        even, odd = means[0].values, means[1].values
        if np.mean((even - odd) ** 2) < MIXTURE_MIN * np.var(0.5 * (even + odd)):
            break
        brighter = int(odd.mean() > even.mean())
        cells = _along_diagonals(parts[brighter], brighter)
    return cells


def fit_lattice_shapes(level: Callable[[int], Array32], cells: Lattice) -> CellShapes | None:
    """Fit the patterns whose bright places are at ``cells``; None if too little of it is in view.

    ``level`` returns the image reduced by powers of two: large cells need no more pixels than small ones.
    """
    cell = _mean_cell(level, cells)
    return None if cell is None else fit_shapes(cell)


def centre_cells(level: Callable[[int], Array32], cells: Lattice) -> Lattice:
    """Return the cells of a lattice of any equal places, moved to their motif."""
    cell = _mean_cell(level, cells)
    if cell is None:
        return cells
    shift = np.array(find_motif(cell))
    return replace(cells, xy=cells.xy + np.einsum("a,nab->nb", shift, cells.axes))


def _mean_cell(level: Callable[[int], Array32], cells: Lattice) -> UnitCell | None:
    """Return a coarse mean of some cells."""
    spacing = float(np.median(np.linalg.norm(cells.axes, axis=2)))
    octave = max(0, int(np.ceil(np.log2(spacing / FULL_RESOLUTION_PX))))
    image, cells = level(octave), cells.reduced(2.0**octave)
    area = max(float(np.median(np.abs(np.linalg.det(cells.axes)))), 1.0)
    most = max(COARSE_SAMPLE, int(COARSE_SAMPLE_PIXELS / area))
    few = np.random.default_rng(0).permutation(len(cells.ij))[:most]
    count = len(few)
    # Cells may be too few for local maps, and their axes are good enough.
    flat = np.zeros((count, 2, 2))
    maps = LocalMaps(
        cells.xy[few], cells.axes[few], flat, flat[:, 0], np.full(count, 4.0), np.ones(count)
    )
    return bin_cells(gather_cells(image, maps), maps)


def _sample(image: Array32, maps: LocalMaps) -> Mask:
    """Select some cells that lie in the image as a whole; (n,)."""
    reach = 0.5 * np.abs(maps.axes).sum(axis=1) + 1.0
    limit = np.array([image.shape[1], image.shape[0]]) - 1
    inside = np.all((maps.xy >= reach) & (maps.xy <= limit - reach), axis=1) & maps.usable
    chosen = np.flatnonzero(inside)
    pixels = max(1.0, float(np.median(np.abs(maps.cell_px2))))
    count = min(CELL_SAMPLE, max(CELL_SAMPLE_MIN, int(CELL_SAMPLE_PIXELS / pixels)))
    picked = np.random.default_rng(0).permutation(chosen)[:count]
    keep = np.zeros(len(maps.xy), dtype=np.bool_)
    keep[picked] = True
    return keep


def refine_cells(image: Array32, cells: Lattice, shape: CellShape) -> RefinedCorners | None:
    """Fit all dots or crossings of a lattice, drop bad ones, add missed ones; None without any.

    Parameters
    ----------
    image
        (h, w) float32 with a contrast of about 1.
    cells
        Bright places of the pattern, or any of parallel lines.
    shape
        Its shape. Dots are located at their centres, lines where they cross, and parallel lines at any place along
        them, where their positions stay as they are.
    """
    learnt = _learn(image, _at_feature(cells, shape), shape.pattern == "grating")
    if learnt is None:
        return None
    rough, cell, noise = learnt
    maps = fit_local_maps(rough.ij, rough.ij, rough.xy, leave_out_self=False)
    rough, maps = rough.select(maps.usable), maps.select(maps.usable)
    if len(rough.ij) < CORNERS_COMPARED_MIN:
        return None
    first = _fit(image, rough.ij, maps, cell, noise, iterations=3)
    expected = first.fit.shown > OUTLINE_SHOWN_MIN
    if first.good.sum() < CORNERS_COMPARED_MIN:
        return None
    quality = float(first.good[expected].mean())
    known = _fill(image, first.select(first.good), cell, noise)
    for _ in range(LAST_ROUNDS):
        maps = fit_local_maps(known.cells, known.cells, known.fit.xy, leave_out_self=False)
        known, maps = known.select(maps.usable), maps.select(maps.usable)
        if len(known.cells) < CORNERS_COMPARED_MIN:
            return None
        known = _fit(image, known.cells, maps, cell, noise, iterations=2)
    last = known
    if last.good.sum() < CORNERS_COMPARED_MIN:
        return None
    keep = last.good & _undisturbed(last.fit, last.good)
    keep = find_consistent(last.cells, last.maps, last.fit, keep)
    if keep.sum() < CORNERS_COMPARED_MIN:
        return None
    agreeing = int(keep.sum())
    keep = select_connected(last.cells, last.maps, last.fit, keep)
    order = np.lexsort(last.cells[keep].T[::-1])
    covariance = last.fit.covariance * inflate_variance(last.fit, keep)[:, None, None]
    spacing = float(np.median(np.sqrt(np.abs(last.maps.cell_px2[keep]))))
    failed = np.concatenate([first.maps.xy[expected & ~first.good], last.maps.xy[~keep]])
    return RefinedCorners(
        last.cells[keep][order],
        last.fit.xy[keep][order],
        covariance[keep][order],
        last.fit.scan_response[keep][order],
        shape.blur * spacing,
        quality,
        failed,
        agreeing - int(keep.sum()),
    )


def _at_feature(cells: Lattice, shape: CellShape) -> Lattice:
    """Move a lattice of bright places to the dots, or to the crossings of the lines."""
    # The opening between lines and their crossing are half a cell apart along both axes.
    moved = shape.centred == (shape.pattern == "lines")
    if not moved:
        return cells
    maps = fit_local_maps(cells.ij, cells.ij, cells.xy, leave_out_self=False)
    half = maps.xy + 0.5 * maps.axes.sum(axis=1) + 0.125 * maps.bend.sum(axis=1) + 0.25 * maps.twist
    return Lattice(cells.ij, half, maps.axes).select(maps.usable)


def _learn(
    image: Array32, cells: Lattice, is_grating: bool
) -> tuple[Lattice, UnitCell, NoiseModel] | None:
    """Learn the mean cell and the noise from some cells; also return all cells, centred."""
    if len(cells.ij) < CORNERS_COMPARED_MIN:
        return None
    maps = fit_local_maps(cells.ij, cells.ij, cells.xy, leave_out_self=False)
    few = _sample(image, maps)
    if few.sum() < CORNERS_COMPARED_MIN:
        return None
    some = maps.select(few)
    windows = gather_cells(image, some)
    # The first round weighs all pixels equally.
    average = _average_lines if is_grating else average_cells
    cell = average(windows, some, None)
    fit = fit_cells(windows, some, cell, None, iterations=2)
    for left in range(MEAN_ROUNDS - 1, -1, -1):
        typical = float(np.median(fit.gain))
        good = (fit.gain > 0.5 * typical) & (fit.chi2 < 4.0 * float(np.median(fit.chi2)))
        if typical <= 0.0 or good.sum() < CORNERS_COMPARED_MIN:
            return None
        noise = fit_noise(fit.select(good))
        some, windows, fit = some.select(good), windows.select(good), fit.select(good)
        cell = average(windows, some, fit)
        if not np.any(cell.values):
            # Noise explains all that they have in common.
            return None
        if left:
            fit = fit_cells(windows, some, cell, noise, iterations=2)
    u, v = cell.find_centre()
    # The spline has the scale of the mean gain, which is about 1.
    centred = maps.xy + u * maps.axes[:, 0] + v * maps.axes[:, 1]
    return Lattice(cells.ij, centred, maps.axes), cell.shift(u, v), noise


def _average_lines(windows: PixelWindows, maps: LocalMaps, fit: CellFit | None) -> UnitCell:
    return average_cells(windows, maps, fit).average_along()


@dataclass(frozen=True)
class _FittedCells:
    """Cells with their local maps and fits, and which of them are credible."""

    cells: Indices
    maps: LocalMaps
    fit: CellFit
    good: Mask

    def select(self, keep: Mask) -> _FittedCells:
        return _FittedCells(
            self.cells[keep], self.maps.select(keep), self.fit.select(keep), self.good[keep]
        )


def _fit(
    image: Array32,
    cells: Indices,
    maps: LocalMaps,
    cell: UnitCell,
    noise: NoiseModel,
    *,
    iterations: int,
) -> _FittedCells:
    fit = fit_cells(gather_cells(image, maps), maps, cell, noise, iterations=iterations)
    spacing = np.linalg.norm(maps.axes, axis=2).min(axis=1)
    moved = np.linalg.norm(fit.xy - maps.xy, axis=1)
    good = (fit.shown > OUTLINE_SHOWN_MIN) & (moved < 0.25 * spacing)
    good &= fit.shift_px < LAST_STEP_MAX_PX + 0.01 * spacing
    good &= np.isfinite(fit.chi2)
    if np.any(good):
        good &= fit.gain > CONTRAST_MIN * float(np.median(fit.gain[good]))
    return _FittedCells(cells, maps, fit, good)


def _undisturbed(fit: CellFit, good: Mask) -> Mask:
    """Select cells that look like the mean cell, as far as noise and what is visible tell; (n,)."""
    pooled = float(np.median(fit.chi2[good]))
    significant = fit.chi2 > pooled * (1.0 + CHI2_EXCESS + CHI2_SIGMAS * np.sqrt(2.0 / fit.freedom))
    surplus = fit.variance.mean(axis=1) * np.maximum(1.0 - pooled / fit.chi2, 0.0)
    contrast = 0.5 * np.abs(fit.level[:, 1] - fit.level[:, 0])
    return ~(significant & (surplus > (MISFIT_VISIBLE * contrast) ** 2))


def _fill(image: Array32, known: _FittedCells, cell: UnitCell, noise: NoiseModel) -> _FittedCells:
    """Fit free cells next to good ones, round by round, as long as that finds more."""
    limit = np.array([image.shape[1], image.shape[0]]) - 1
    tried = _keys(known.cells)
    while True:
        near = np.unique((known.cells[:, None] + STEPS[None]).reshape(-1, 2), axis=0)
        near = near[~np.isin(_keys(near), tried)]
        if not len(near):
            break
        maps = fit_local_maps(near, known.cells, known.fit.xy)
        inside = np.all((maps.xy >= 0) & (maps.xy <= limit), axis=1) & maps.usable
        near, maps = near[inside], maps.select(inside)
        if not len(near):
            break
        tried = np.concatenate([tried, _keys(near)])
        fitted = _fit(image, near, maps, cell, noise, iterations=4)
        if not np.any(fitted.good):
            break
        more = fitted.select(fitted.good)
        known = _FittedCells(
            np.concatenate([known.cells, more.cells]),
            LocalMaps.join([known.maps, more.maps]),
            CellFit.join([known.fit, more.fit]),
            np.concatenate([known.good, more.good]),
        )
    return known


def _keys(cells: Indices) -> Indices:
    """Return one number per cell; indices stay far below 2^20."""
    return np.asarray(cells[:, 0] * (1 << 21) + cells[:, 1], dtype=np.int64)
