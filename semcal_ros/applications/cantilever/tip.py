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

"""The outline of the free end, and the position of its apex: square, round, tapered or chamfered.

The end of the beam is the farthest point of its outline on the centre line: the length that a maker
states runs to it. Two families of outlines contain all common ends. Both have a facet across the
axis, on whose either side a flank leads to the straight side: a straight line (square, chamfered,
tapered, pointed), or a quarter of an ellipse (rounded, semicircular). The outline is fitted to the
edges that are found along it, block by block as those of the beam (:mod:`.edges`), and the families
are averaged, each as likely as it fits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from semcal_ros.applications.cantilever.edges import EdgeModel, fit_blocks
from semcal_ros.applications.cantilever.thresholds import (
    APEX_BIN_PX,
    BLOCK_PX,
    BLOCKS_SPARE,
    CORNER_RAD,
    CORNER_WIDTHS,
    FLANK_MAX,
    LOSS_MAX,
    MIDDLE_PART,
    ROUGH_APEX_PX,
    SETTLED_PX,
    SHORT_REACH,
    STRAIGHT_MIN_PX,
    STRAIGHT_PART,
    TIP_BLOCK_MIN_PX,
    TIP_SEARCH,
    TIP_STEPS,
    WEIGHT_MIN,
)
from semcal_ros.core.arrays import Array, mad_sigma
from semcal_ros.core.robust_losses import tukey_loss, tukey_weight

#: Coordinates along and across the axis, m, and grey levels, (n,) each.
PixelSamples = tuple[Array, Array, Array]

Flank = Literal["straight", "elliptic"]


@dataclass(frozen=True)
class TipFit:
    """The free end; lengths in m.

    Attributes
    ----------
    apex_m, sigma_m
        Arc length of the apex, and its 1-sigma: scatter of the edges and choice of the family.
    flank_m
        How far before the apex the beam begins to narrow.
    facet_m
        Width of the facet.
    flank
        Family that fits best.
    """

    apex_m: float
    sigma_m: float
    flank_m: float
    facet_m: float
    flank: Flank


@dataclass(frozen=True)
class _Outline:
    """An outline, with the apex at a and the straight sides at the half width."""

    flank: Flank
    apex: float
    length: float
    facet: float  # half its width
    half: float

    def distance(self, along: Array, across: Array) -> Array:
        """Distance from the outline, positive outside; exact to first order near it."""
        before, n = self.apex - along, np.abs(across)
        away = np.maximum(n - self.half, -before)
        depth = self.half - self.facet
        if self.length <= 0.0 or depth <= 0.0:
            return np.asarray(away)
        if self.flank == "straight":
            cut = (n - self.facet) * self.length - before * depth
            return np.asarray(np.maximum(away, cut / np.hypot(self.length, depth)))
        u = np.maximum(1.0 - before / self.length, 0.0)
        v = np.maximum((n - self.facet) / depth, 0.0)
        radius = np.maximum(np.hypot(u, v), 1e-9)
        slope = np.maximum(np.hypot(u / self.length, v / depth) / radius, 1e-9 / self.length)
        return np.asarray(np.where((u > 0.0) & (v > 0.0), (radius - 1.0) / slope, away))

    def width_at(self, before: Array) -> Array:
        """Half the width at distances before the apex; zero beyond it."""
        part = np.clip(before / max(self.length, 1e-12), 0.0, 1.0)
        if self.flank == "elliptic":
            part = np.sqrt(np.maximum(1.0 - (1.0 - part) ** 2, 0.0))
        wide = self.facet + (self.half - self.facet) * part
        return np.asarray(np.where(before >= 0.0, wide, 0.0))

    def points(self, spacing: float, straight: float) -> Array:
        """(n, 2) points along and across, evenly spaced along the outline from side to side."""
        turn = np.linspace(0.0, 0.5 * np.pi, 400)
        if self.flank == "elliptic":
            before, n = self.length * (1.0 - np.sin(turn)), (self.half - self.facet) * np.cos(turn)
        else:
            before, n = (
                self.length * np.array([1.0, 0.0]),
                (self.half - self.facet) * np.array([1.0, 0.0]),
            )
        one = np.column_stack([self.apex - before, self.facet + n])
        one = np.vstack([[self.apex - self.length - straight, self.half], one, [self.apex, 0.0]])
        both = np.vstack([one, one[-2::-1] * [1.0, -1.0]])
        walked = np.append(0.0, np.cumsum(np.hypot(*np.diff(both, axis=0).T)))
        keep = np.append(True, np.diff(walked) > 1e-12)
        at = np.linspace(0.0, walked[-1], max(int(np.ceil(walked[-1] / spacing)), 8) + 1)
        return np.column_stack([np.interp(at, walked[keep], both[keep, k]) for k in (0, 1)])


def find_apex(samples: PixelSamples, end_m: float, half_m: float, px_m: float) -> float:
    """Find roughly where the beam ends on its centre line, or ``end_m`` if that does not show.

    Parameters
    ----------
    samples
        Pixels around the end; a bright beam.
    end_m
        Where its edges end: before the apex of a tapered tip.
    half_m
        Half the width of the beam.
    px_m
        Size of a pixel.
    """
    along, across, grey = samples
    middle = np.abs(across) < max(MIDDLE_PART * half_m, 2.0 * px_m)
    middle &= np.abs(along - end_m) < TIP_SEARCH * half_m
    background = np.abs(along - end_m) < TIP_SEARCH * half_m
    background &= (np.abs(across) > 1.3 * half_m) & (np.abs(across) < 2.5 * half_m)
    if not (middle.any() and background.any()):
        return end_m
    first, size = float(along[middle].min()), APEX_BIN_PX * px_m
    bins = np.floor((along[middle] - first) / size).astype(np.intp)
    number = np.bincount(bins)
    profile = np.bincount(bins, grey[middle]) / np.maximum(number, 1)
    # Where the image ends nothing is known.
    profile = profile[: len(number) if (number > 0).all() else int(np.argmin(number > 0))]
    inner = profile[: max(int((end_m - half_m - first) / size), 0)]
    if inner.size == 0:
        return end_m
    beam, ground = float(np.median(inner)), float(np.median(grey[background]))
    if not beam > ground:
        return end_m
    # The most likely change between two known levels in noise.
    likely = np.cumsum(profile - 0.5 * (beam + ground))
    return first + size * (int(np.argmax(likely)) + 1.0)


def fit_tip(samples: PixelSamples, rough_m: float, model: EdgeModel, px_m: float) -> TipFit | None:
    """Fit the outline of the free end; None if it is not seen.

    Parameters
    ----------
    samples
        Pixels around the end; a bright beam.
    rough_m
        The apex, as :func:`find_apex` finds it.
    model
        Edge and half width of the beam.
    px_m
        Size of a pixel.
    """
    along, across, grey = samples
    wide = model.half_width_m + 3.0 * model.reach_m
    near = (along > rough_m - (FLANK_MAX + 1.0) * model.half_width_m) & (np.abs(across) < wide)
    samples = along[near], across[near], grey[near]
    starts = _start_outlines(samples, rough_m, model, px_m)
    fits = [fit for start in starts if (fit := _refine(samples, start, model, px_m))]
    if not fits:
        return None
    cost, scale = np.array([fit[2] for fit in fits]), np.array([fit[3] for fit in fits])
    # The outlines share most of their blocks, so their costs compare as those of one set of data,
    # which scatters as much as about the best of them: texture moves an edge by more than its noise.
    cost += np.array([fit[4] for fit in fits]) * scale[int(np.argmin(cost))] ** 2
    best_one = int(np.argmin(cost))
    likely = np.exp(-0.5 * (cost - cost[best_one]) / scale[best_one] ** 2)
    likely /= likely.sum()
    apexes, sigmas = np.array([fit[0].apex for fit in fits]), np.array([fit[1] for fit in fits])
    apex = float(likely @ apexes)
    spread = likely @ (sigmas**2 + (apexes - apex) ** 2)
    best = fits[int(np.argmax(likely))][0]
    sigma = float(np.hypot(np.sqrt(spread), _find_reach_error(samples, best, model, px_m)))
    return TipFit(apex, sigma, best.length, 2.0 * best.facet, best.flank)


def _find_reach_error(
    samples: PixelSamples, outline: _Outline, model: EdgeModel, px_m: float
) -> float:
    """Find the 1-sigma of what a bright rim or a halo, which the model of an edge lacks, moves the apex by.

    It pulls an edge by the more, the farther the fit reaches; from the apex with a shorter reach, the one with none
    is extrapolated.
    """
    shorter = replace(model, reach_m=SHORT_REACH * model.reach_m)
    again = _refine(samples, outline, shorter, px_m)
    if again is None:
        return model.width_m
    return abs(again[0].apex - outline.apex) / (1.0 - SHORT_REACH)


def _start_outlines(
    samples: PixelSamples, rough_m: float, model: EdgeModel, px_m: float
) -> list[_Outline]:
    """Find an outline of each family near the widths that the brightness shows."""
    along, across, grey = samples
    half, size = model.half_width_m, 2.0 * px_m
    rows = int(FLANK_MAX * half / size)
    columns = int(1.6 * half / px_m) + 8
    row = np.floor((rough_m + 0.5 * half - along) / size).astype(np.intp)
    column = np.floor(np.abs(across) / px_m).astype(np.intp)
    rows += int(0.5 * half / size)
    inside = (row >= 0) & (row < rows) & (column < columns)
    place = row[inside] * columns + column[inside]
    number = np.bincount(place, minlength=rows * columns).reshape(rows, columns)
    total = np.bincount(place, grey[inside], rows * columns).reshape(rows, columns)
    mean = total / np.maximum(number, 1)
    # Beyond the rough apex, and negative before it.
    beyond = np.asarray(0.5 * half - size * (np.arange(rows) + 0.5), dtype=np.float64)
    deep = beyond < -2.0 * half
    core = np.arange(columns) * px_m < 0.7 * half
    outside = np.arange(columns) * px_m > half + 3.0 * px_m
    levels = [mean[area & (number > 0)] for area in (deep[:, None] & core, deep[:, None] & outside)]
    starts = [_Outline("straight", rough_m, 0.0, half, half)]
    if not all(level.size for level in levels):
        return starts
    middle = 0.5 * sum(float(np.median(level)) for level in levels)
    likely = np.cumsum(np.where(number > 0, mean - middle, 0.0), axis=1)
    peak = likely.max(axis=1)
    widths: Array = np.where(peak > 0.0, px_m * (np.argmax(likely, axis=1) + 1.0), 0.0)
    widths = np.minimum(widths, 1.2 * half)
    lengths = half * np.array([0.15, 0.3, 0.5, 0.75, 1.0, 1.4, 1.9, 2.5, 3.2])
    shifts = half * np.array([-0.3, -0.15, -0.05, 0.0, 0.05, 0.15, 0.3])
    flanks: tuple[Flank, ...] = ("straight", "elliptic")
    # Narrow facets and wide ones: the widths do not tell well where a facet ends.
    for flank, facets in product(flanks, ((0.0, 0.15, 0.3), (0.4, 0.6, 0.8, 0.95))):
        options = [
            _Outline(flank, rough_m + float(shift), float(length), facet * half, half)
            for length, facet, shift in product(lengths, facets, shifts)
        ]
        costs = [
            np.abs(one.width_at(one.apex - rough_m - beyond) - widths).sum() for one in options
        ]
        starts.append(options[int(np.argmin(costs))])
    return starts


def _refine(
    samples: PixelSamples, start: _Outline, model: EdgeModel, px_m: float
) -> tuple[_Outline, float, float, float, float] | None:
    """Fit an outline: it, the 1-sigma of its apex, chi2, scatter over noise, and Schwarz's penalty for its unknowns."""
    outline = start
    square = start.length <= 0.0 or start.facet >= start.half
    for _ in range(TIP_STEPS):
        found = _measure_blocks(samples, outline, model, px_m)
        if found is None:
            return None
        points, outwards, sigma, missing = found
        design = _sensitivities(outline, points, px_m, square)
        # What the edges leave open: the apex is known roughly, and a flank that nothing shows stays.
        prior = np.array([MIDDLE_PART * start.half + ROUGH_APEX_PX * px_m, start.half, start.half])
        away = np.array([start.apex - outline.apex, 0.0, 0.0])
        unknowns = design.shape[1]
        solved = _solve_robustly(design, outwards, sigma, away[:unknowns], prior[:unknowns])
        if solved is None:
            return None
        step, covariance, cost, scale = solved
        step = np.clip(step, -model.reach_m, model.reach_m)
        values = [outline.apex, outline.length, outline.facet][: len(step)] + step
        length, facet = (values[1], values[2]) if not square else (0.0, outline.half)
        outline = _Outline(
            outline.flank,
            float(values[0]),
            float(np.clip(length, 0.0, FLANK_MAX * outline.half)),
            float(np.clip(facet, 0.0, outline.half)),
            outline.half,
        )
        if float(np.max(np.abs(step))) < SETTLED_PX * px_m:
            break
        if not square and (outline.length < px_m or outline.facet > outline.half - 0.5 * px_m):
            return None  # the square one
    # Where an outline says that there is an edge and there is none, it is as wrong as it can be.
    cost += missing * LOSS_MAX * scale**2
    penalty = len(step) * float(np.log(len(outwards)))
    return outline, float(np.sqrt(covariance[0, 0])), cost, scale, penalty


def _measure_blocks(
    samples: PixelSamples, outline: _Outline, model: EdgeModel, px_m: float
) -> tuple[Array, Array, Array, int] | None:
    """Fit the edge in blocks along the outline: centres, how far outside it is, 1-sigma, and how many lack one."""
    straight = max(STRAIGHT_PART * outline.half, STRAIGHT_MIN_PX * px_m)
    points = outline.points(0.5 * px_m, straight)
    heading = np.arctan2(*np.gradient(points, axis=0).T[::-1])
    turn = np.abs(np.gradient(np.unwrap(heading))) / 0.5
    around = np.ones(2 * int(2.0 * CORNER_WIDTHS * model.width_m / px_m) + 1)
    sharp = np.convolve(turn > CORNER_RAD, around, mode="same") > 0.5
    block_px = np.clip(0.25 * outline.half / px_m, TIP_BLOCK_MIN_PX, BLOCK_PX)
    per_block = int(2 * block_px)
    count = max(len(points) // per_block, 1)
    number = np.minimum(np.arange(len(points)) * count // len(points), count - 1)
    # Only pixels that may count: those within reach of an edge that is itself within reach.
    close = np.abs(outline.distance(samples[0], samples[1])) < 2.0 * model.reach_m
    if not close.any():
        return None
    along, across, grey = (v[close] for v in samples)
    _, nearest = KDTree(points).query(np.column_stack([along, across]))
    # Beyond the ends of the outline nothing is known.
    inner = ~sharp[nearest] & (nearest > 0) & (nearest < len(points) - 1)
    away = outline.distance(along[inner], across[inner])
    place, sigma, step, _ = fit_blocks(number[nearest[inner]], -away, grey[inner], model, count)
    good = np.isfinite(sigma) & (step > 0.0)
    # Of one contrast: a particle or a rim has another.
    good &= step > 0.4 * np.median(step[good]) if good.any() else False
    if not good.any():
        return None
    # Blocks that hold pixels, not those out of view.
    filled = np.bincount(number[nearest[inner]], minlength=count) >= block_px
    # Where the outline has a corner, nothing was measured.
    weight = np.bincount(number[~sharp], minlength=count)
    good &= weight > 0
    sums = [np.bincount(number[~sharp], points[~sharp, k], count) for k in (0, 1)]
    centres = np.stack(sums, axis=1)[good] / weight[good, None]
    return centres, -place[good], sigma[good], int(np.count_nonzero(filled & ~good))


def _sensitivities(outline: _Outline, points: Array, px_m: float, square: bool) -> Array:
    """Return how far the outline moves outwards at points for each unit of apex, flank and facet."""

    def moved(apex: float, length: float, facet: float) -> Array:
        other = _Outline(outline.flank, apex, length, facet, outline.half)
        return other.distance(points[:, 0], points[:, 1])

    apex, length, facet, h = outline.apex, outline.length, outline.facet, 0.25 * px_m
    columns = [moved(apex - h, length, facet) - moved(apex + h, length, facet)]
    if not square:
        columns.append(moved(apex, length - h, facet) - moved(apex, length + h, facet))
        columns.append(moved(apex, length, facet - h) - moved(apex, length, facet + h))
    return np.column_stack(columns) / (2.0 * h)


def _solve_robustly(
    design: Array, seen: Array, sigma: Array, expected: Array, expected_sigma: Array
) -> tuple[Array, Array, float, float] | None:
    """Fit by Tukey's biweight with a prior: unknowns, covariance, chi2, and the scatter over the noise."""
    if len(seen) < design.shape[1] + BLOCKS_SPARE:
        return None
    weight, scale = np.ones(len(seen)), 1.0
    known = 1.0 / expected_sigma**2
    for iteration in range(8):
        total = weight / (scale * sigma) ** 2
        inverse = np.linalg.inv((design * total[:, None]).T @ design + np.diag(known))
        solution = inverse @ ((design * total[:, None]).T @ seen + known * expected)
        left = (seen - design @ solution) / sigma
        scale = max(mad_sigma(left), 1.0)
        weight = tukey_weight(left, scale * (2.0 if iteration < 2 else 1.0))
        if int(np.count_nonzero(weight > WEIGHT_MIN)) < design.shape[1] + BLOCKS_SPARE:
            return None
    # Of a rejected block counts what Tukey's loss counts.
    chi2 = 2.0 * float(np.sum(tukey_loss(left, scale))) * scale**2
    return np.asarray(solution), np.asarray(inverse), chi2, scale
