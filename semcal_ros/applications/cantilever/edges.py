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

"""Sub-pixel edges of the beam, in blocks along it.

In each block the grey levels near an edge follow ``low + step * Phi((n - e) / width)``: a straight
edge under a round beam. Low, step and e are fitted to the raw pixels by least squares, all blocks
at once, with a taper that moves with the edge, so that no pixel enters or leaves abruptly. Features
that the model lacks, such as a bright rim, shift all frames alike; deflections are differences.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from semcal_ros.applications.cantilever.thresholds import (
    EDGE_PIXELS_MIN,
    EDGE_STEPS,
    EDGE_WIDTHS_PX,
    TINY,
    WIDTH_SIGMAS,
)
from semcal_ros.core.arrays import Array, Indices, Mask, mad_sigma


@dataclass(frozen=True)
class EdgeModel:
    """How edges are fitted; lengths in m.

    Attributes
    ----------
    width_m
        1-sigma of the edge.
    reach_m
        How far from the edge pixels count.
    start_m, block_m, blocks
        Arc length at which the first block begins, length of a block, and number of blocks.
    half_width_m
        Half the width of the beam.
    """

    width_m: float
    reach_m: float
    start_m: float
    block_m: float
    blocks: int
    half_width_m: float

    @property
    def centres_m(self) -> Array:
        """(blocks,) arc lengths."""
        return np.asarray(self.start_m + self.block_m * (np.arange(self.blocks) + 0.5))


@dataclass(frozen=True)
class EdgeFit:
    """Edges of one frame: the left (negative side) and the right one, as columns.

    Attributes
    ----------
    across_m
        (blocks, 2) positions of the edges across the axis, at the centres of the blocks.
    sigma_m
        (blocks, 2) 1-sigma from the pixel noise; infinite where there is no edge.
    step
        (blocks, 2) how much brighter the beam is.
    chi2
        Sum of squared residuals over all blocks, in squared grey levels.
    """

    across_m: Array
    sigma_m: Array
    step: Array
    chi2: float


@dataclass(frozen=True)
class StepFit:
    """One straight edge: its position and 1-sigma in m, and its step in grey levels."""

    place_m: float
    sigma_m: float
    step: float


def fit_edges(
    along_m: Array, across_m: Array, grey: Array, model: EdgeModel, predicted_m: Array
) -> EdgeFit:
    """Fit both edges in all blocks.

    Parameters
    ----------
    along_m, across_m, grey
        (n,) coordinates and grey levels of pixels.
    model
        Blocks and edge.
    predicted_m
        (blocks, 2) expected positions of the edges.
    """
    block = np.floor((along_m - model.start_m) / model.block_m).astype(np.intp)
    inside = (block >= 0) & (block < model.blocks)
    block = block[inside]
    along, across, level = (v[inside] for v in (along_m, across_m, grey))
    results, chi2 = [], 0.0
    for side, sign in enumerate((1.0, -1.0)):
        line = _interpolate_line(along, model, predicted_m[:, side])
        near = np.abs(across - line) < 2.0 * model.reach_m
        # With the sign the beam is always on the side of growing coordinates.
        distance = sign * (across - line)[near]
        place, sigma, step, left = fit_blocks(
            block[near], distance, level[near], model, model.blocks
        )
        results.append((predicted_m[:, side] + sign * place, sigma, step))
        chi2 += left
    across_fit, sigmas, steps = (np.stack(parts, axis=1) for parts in zip(*results, strict=True))
    return EdgeFit(across_fit, sigmas, steps, chi2)


def fit_step(
    distance_m: Array, grey: Array, model: EdgeModel, *, rough_m: float | None = None
) -> StepFit:
    """Fit one straight edge to pixels, given by their distance from its expected position.

    Distances are positive on the bright side. With ``rough_m`` the edge is searched for up to that
    distance from the expected position.
    """
    best: tuple[float, float, float, float] | None = None
    reach = 0.0 if rough_m is None else rough_m
    starts = np.arange(-reach, reach + 1e-15, 0.5 * model.reach_m) if reach > 0.0 else np.zeros(1)
    for start in starts:
        near = np.abs(distance_m - start) < 2.0 * model.reach_m
        if near.sum() < EDGE_PIXELS_MIN:
            continue
        zero = np.zeros(int(near.sum()), dtype=np.intp)
        found = fit_blocks(zero, distance_m[near] - start, grey[near], model, 1)
        place, sigma, step = (float(v[0]) for v in found[:3])
        if np.isfinite(sigma) and step > 0.0 and (best is None or step / sigma > best[3]):
            best = (start + place, sigma, step, step / sigma)
    if best is None:
        return StepFit(float("nan"), float("inf"), 0.0)
    return StepFit(*best[:3])


def choose_width(
    along_m: Array, across_m: Array, grey: Array, model: EdgeModel, predicted_m: Array, px_m: float
) -> float:
    """Choose the edge width, m, with the least residuals; ``px_m`` is the size of a pixel."""
    widths = [w * px_m for w in EDGE_WIDTHS_PX]
    left = [
        fit_edges(along_m, across_m, grey, replace(model, width_m=w), predicted_m).chi2
        for w in widths
    ]
    k = int(np.clip(np.argmin(left), 1, len(widths) - 2))
    # Parabola through the minimum and its neighbours, in the logarithm of the width.
    a, b, c = left[k - 1], left[k], left[k + 1]
    shift = 0.5 * (a - c) / max(a - 2.0 * b + c, TINY)
    return float(widths[k] * 1.16 ** float(np.clip(shift, -1.0, 1.0)))


def _interpolate_line(along: Array, model: EdgeModel, values: Array) -> Array:
    """Interpolate and extrapolate values at the centres of the blocks to the pixels."""
    centres = model.centres_m
    if len(centres) < 2:
        return np.full(along.shape, values[0])
    at = np.clip((along - centres[0]) / model.block_m, 0.0, None)
    k = np.minimum(at.astype(np.intp), len(centres) - 2)
    part = (along - centres[k]) / model.block_m
    return np.asarray(values[k] + part * (values[k + 1] - values[k]))


def fit_blocks(
    block: Indices, distance: Array, grey: Array, model: EdgeModel, count: int
) -> tuple[Array, Array, Array, float]:
    """Fit the edge of each block to pixels at distances from where it is expected, positive on the bright side.

    Returns
    -------
    Positions, 1-sigmas (infinite where there is no edge) and steps, (count,) each, and the sum of
    squared residuals.
    """
    place, slope = np.zeros(count), np.zeros(count)
    low, step = np.zeros(count), np.zeros(count)
    width, reach = model.width_m, model.reach_m
    information = np.zeros((count, 3, 3))
    squares, weight_sum = low.copy(), low.copy()
    for iteration in range(EDGE_STEPS):
        z = distance - place[block]
        taper = np.where(np.abs(z) < reach, np.cos(0.5 * np.pi * z / reach) ** 2, 0.0)
        shape = ndtr(z / width)
        if iteration == 0:
            third = np.zeros_like(z)
        else:
            # Scaled by the width, so that the equations are well conditioned.
            third = -slope[block] * np.exp(-0.5 * (z / width) ** 2) / np.sqrt(2.0 * np.pi)
        columns = (np.ones_like(z), shape, third)
        information = _accumulate_normal(block, taper, columns, count)
        sums = [np.bincount(block, taper * c * grey, count) for c in columns]
        right = np.asarray(np.stack(sums, axis=1), dtype=np.float64)
        if iteration == 0:
            information[:, 2, 2] = 1.0
        solution = _solve_guarded(information, right)
        low, step = solution[:, 0], solution[:, 1]
        slope = step
        place = place + np.clip(solution[:, 2] * width, -0.5 * reach, 0.5 * reach)
        place = np.clip(place, -reach, reach)
        left = grey - low[block] - step[block] * shape - solution[block, 2] * third
        squares = np.asarray(np.bincount(block, taper * left**2, count), dtype=np.float64)
        weight_sum = np.asarray(np.bincount(block, taper, count), dtype=np.float64)
    # The taper weights pixels at the rim less than their noise would: noise adds with its square.
    noise = np.bincount(block, taper**2, count) / np.maximum(weight_sum, TINY)
    variance = squares / np.maximum(weight_sum - 3.0 * noise, 1.0)
    inverse = np.linalg.pinv(information, hermitian=True)
    sandwich = inverse @ _accumulate_normal(block, taper**2, columns, count) @ inverse
    sigma = width * np.sqrt(np.maximum(variance * sandwich[:, 2, 2], 0.0))
    good = (weight_sum > EDGE_PIXELS_MIN) & (np.abs(place) < 0.95 * reach) & (step > 0.0)
    sigma = np.where(good & (sigma > 0.0), sigma, np.inf)
    return place, sigma, step, float(squares.sum())


def _accumulate_normal(
    block: Indices, weight: Array, columns: tuple[Array, Array, Array], count: int
) -> Array:
    gram = np.zeros((count, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            sums = np.bincount(block, weight * columns[i] * columns[j], count)
            gram[:, i, j] = gram[:, j, i] = sums
    return gram


def _solve_guarded(matrix: Array, right: Array) -> Array:
    """Solve (n, 3, 3) systems that may be singular."""
    guard = 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] + TINY
    return np.asarray(np.linalg.solve(matrix + guard * np.eye(3), right[..., None])[..., 0])


def find_unchanged_width(moved: Array, noise: Array) -> Mask:
    """Find the blocks, (blocks,) bool, in which the width of the beam has not changed.

    In the others something lies on an edge. Their neighbours are left out, too, because that body
    may reach into them a little.

    Parameters
    ----------
    moved, noise
        (blocks, 2) displacements of both edges, and their 1-sigma; infinite where unknown.
    """
    both = np.isfinite(noise).all(axis=1)
    if int(both.sum()) < 4:
        return np.ones(len(moved), dtype=bool)
    change = moved[:, 1] - moved[:, 0]
    sigma = np.hypot(noise[:, 0], noise[:, 1])
    away = np.zeros(len(moved))
    # Focus or charging may change the width of the whole beam.
    away[both] = (change[both] - np.median(change[both])) / sigma[both]
    scale = max(mad_sigma(away[both]), 1.0)
    odd = ~both | (np.abs(away) > WIDTH_SIGMAS * scale)
    near = odd.copy()
    near[1:] |= odd[:-1]
    near[:-1] |= odd[1:]
    return np.asarray(~near)
