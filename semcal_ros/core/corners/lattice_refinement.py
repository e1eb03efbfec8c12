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

"""Refine a grown lattice to every corner in view at sub-pixel accuracy: fill in, fit, reject."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Array32, Indices, Mask
from semcal_ros.core.corners.checks import (
    FittedCorners,
    contrast_signs,
    find_consistent,
    find_credible,
    find_undisturbed,
    inflate_variance,
    select_connected,
)
from semcal_ros.core.corners.corner_fit import (
    Learnt,
    NoiseModel,
    band_px,
    fit_corners,
    fit_noise,
    learn,
    loose_prior,
    rough_start,
    smooth_levels,
)
from semcal_ros.core.corners.edge_model import LOG_BLUR, EdgeGeometry, gather_windows
from semcal_ros.core.corners.lattice import STEPS, Lattice
from semcal_ros.core.corners.local_map import LocalMaps, fit_local_maps
from semcal_ros.core.corners.thresholds import (
    ASSUMED_VARIANCE,
    CORNER_SAMPLE,
    CORNER_SECOND_SAMPLE,
    CORNERS_COMPARED_MIN,
    FIRST_BLUR_PX,
    GROW_ROUNDS,
    HOPELESS_PART,
    MARGIN_PX,
    RIM_PART,
)


@dataclass(frozen=True)
class RefinedCorners:
    """Corners that passed all checks.

    Attributes
    ----------
    ij, xy
        (n, 2) indices and positions.
    covariance
        (n, 2, 2), px^2.
    scan_response
        (n, 2, 2) as of :class:`~semcal_ros.core.corners.corner_fit.PositionFit`.
    blur_px
        Median blur.
    quality
        Part of the corners expected well inside the image that passed.
    rejected_xy
        (k, 2) expected positions of lattice points in the image that did not pass, px.
    foreign
        Number of good corners that do not continue this lattice.
    """

    ij: Indices
    xy: Array
    covariance: Array
    scan_response: Array
    blur_px: float
    quality: float
    rejected_xy: Array
    foreign: int = 0


@dataclass(frozen=True)
class _Knowledge:
    """Noise, priors and sign of the contrast, learnt from the first fits."""

    noise: NoiseModel
    learnt: Learnt
    sign: float

    @property
    def blur_px(self) -> float:
        return float(np.exp(self.learnt.common[LOG_BLUR]))


def refine_lattice(image: Array32, lattice: Lattice) -> RefinedCorners | None:
    """Fit all corners of a lattice, drop bad ones, add missed ones; None if fewer than six remain.

    Noise, blur and the spread of the nuisance parameters over the image are learnt from a sample
    of the corners. With these all corners are fitted, then the missed ones beside them, then all
    again with the shading and the bends that the neighbours show.

    Parameters
    ----------
    image
        (h, w) float32 with a contrast of about 1.
    lattice
        Grown from saddle points.
    """
    grown = _plausible(_shuffle(lattice))
    if len(grown.ij) < CORNERS_COMPARED_MIN:
        return None
    maps = fit_local_maps(grown.ij, grown.ij, grown.xy, leave_out_self=False)
    grown, maps = grown.select(maps.usable), maps.select(maps.usable)
    if len(grown.ij) < CORNERS_COMPARED_MIN:
        return None
    few = np.arange(len(grown.ij)) < CORNER_SAMPLE
    start = _start(maps, grown.xy, FIRST_BLUR_PX)
    first = _first_fit(image, grown.ij[few], maps.select(few), start[few])
    if first.good.sum() < CORNERS_COMPARED_MIN:
        return None
    part = _quality(first, image)
    if part < HOPELESS_PART:
        return _result(first, first.good, part, first.maps.xy[~first.good])
    knowledge = _learn(first)
    maps, start = _better_maps(grown, first, knowledge.blur_px)
    grown, maps, start = grown.select(maps.usable), maps.select(maps.usable), start[maps.usable]
    if len(grown.ij) < CORNERS_COMPARED_MIN:
        return None
    second = _fit(image, grown.ij, maps, start, knowledge, iterations=2)
    part = _quality(second, image)
    if second.good.sum() < CORNERS_COMPARED_MIN:
        return None
    known = _fill(image, second.select(second.good), knowledge)
    last = _last_fit(image, known, knowledge)
    if last is None:
        return None
    keep = last.good & find_undisturbed(last)
    keep = find_consistent(last.cells, last.maps, last.fit, keep)
    if keep.sum() < CORNERS_COMPARED_MIN:
        return None
    agreeing, keep = int(keep.sum()), select_connected(last.cells, last.maps, last.fit, keep)
    passed = last.cells[keep]
    doubtful = np.concatenate([second.cells[~second.good], last.cells[~keep]])
    expected = np.concatenate([second.maps.xy[~second.good], last.maps.xy[~keep]])
    result = _result(last, keep, part, _find_failed(doubtful, expected, passed, image))
    return replace(result, foreign=agreeing - len(passed))


def _quality(fitted: FittedCorners, image: Array32) -> float:
    """Return the part that passed of the corners expected well inside the image."""
    size = np.array([image.shape[1], image.shape[0]])
    slack = MARGIN_PX + RIM_PART * np.linalg.norm(fitted.maps.axes, axis=2).min(axis=1)[:, None]
    expected = np.all((fitted.maps.xy >= slack) & (fitted.maps.xy <= size - 1 - slack), axis=1)
    return float(fitted.good[expected].mean()) if np.any(expected) else 0.0


def _better_maps(grown: Lattice, first: FittedCorners, blur_px: float) -> tuple[LocalMaps, Array]:
    """Fit local maps through the fitted positions in place of the saddle points.

    Also returns the (n, 2) positions from which to start.
    """
    count = len(first.cells)
    xy = grown.xy.copy()
    xy[:count][first.good] = first.fit.xy[first.good]
    known = np.concatenate([first.good, np.ones(len(xy) - count, dtype=bool)])
    maps = fit_local_maps(grown.ij, grown.ij[known], xy[known], leave_out_self=False)
    return maps, _start(maps, xy, blur_px)


def _start(maps: LocalMaps, xy: Array, blur_px: float) -> Array:
    """Return (n, 2) positions from which to start: of the maps, or as found if these are far off.

    Maps average the errors of saddle points, a few tenths of a pixel. But through large squares they
    miss strong distortions by pixels, and a fit does not return from farther than the blur.
    """
    missed = np.linalg.norm(maps.xy - xy, axis=1) > blur_px
    return np.where(missed[:, None], xy, maps.xy)


def _shuffle(lattice: Lattice) -> Lattice:
    """Return the lattice in random but fixed order, so that its first corners are a fair sample."""
    order = np.random.default_rng(0).permutation(len(lattice.ij))
    return Lattice(lattice.ij[order], lattice.xy[order], lattice.axes[order])


def _find_failed(cells: Indices, xy: Array, passed: Indices, image: Array32) -> Array:
    """Return (k, 2) positions in the image of the cells, each once, that did not pass."""
    keys, first = np.unique(_keys(cells), return_index=True)
    size = np.array([image.shape[1], image.shape[0]])
    inside = np.all((xy[first] >= 0) & (xy[first] <= size - 1), axis=1)
    return xy[first][inside & ~np.isin(keys, _keys(passed))]


def _result(
    fitted: FittedCorners, keep: Mask, quality: float, rejected_xy: Array
) -> RefinedCorners:
    fit = fitted.fit
    order = np.lexsort(fitted.cells[keep].T[::-1])
    covariance = fit.covariance[keep] * inflate_variance(fit, keep)[keep, None, None]
    return RefinedCorners(
        fitted.cells[keep][order],
        fit.xy[keep][order],
        covariance[order],
        fit.scan_response[keep][order],
        float(np.median(fit.blur_px[keep])),
        quality,
        rejected_xy,
    )


def _plausible(lattice: Lattice) -> Lattice:
    """Return the lattice without points that do not fit their neighbours."""
    maps = fit_local_maps(lattice.ij, lattice.ij, lattice.xy)
    residual = np.linalg.norm(maps.xy - lattice.xy, axis=1)
    spacing = np.linalg.norm(lattice.axes, axis=2).min(axis=1)
    keep = (residual < 0.3 * spacing) & maps.usable
    return lattice.select(keep)


def _first_fit(image: Array32, cells: Indices, maps: LocalMaps, start: Array) -> FittedCorners:
    """Fit with equal weights and loose priors, from (n, 2) positions ``start``."""
    windows = gather_windows(image, start, maps.axes, maps.bend, band_px(FIRST_BLUR_PX))
    geometry = EdgeGeometry.from_map(maps.axes, maps.bend)
    prior = loose_prior(maps, geometry, FIRST_BLUR_PX)
    fit = fit_corners(windows, geometry, None, prior, noise=None, iterations=3)
    return FittedCorners(cells, maps, windows, fit, find_credible(cells, maps, fit, image))


def _learn(first: FittedCorners) -> _Knowledge:
    good = first.select(first.good)
    geometry = EdgeGeometry.from_map(good.maps.axes, good.maps.bend)
    learnt = learn(
        good.fit.parameters,
        good.fit.normal,
        loose_prior(good.maps, geometry, FIRST_BLUR_PX),
        ASSUMED_VARIANCE,
        float(np.median(good.fit.chi2)),
    )
    sign = float(np.sign(np.median(good.fit.contrast * contrast_signs(good.cells))))
    return _Knowledge(fit_noise(good.fit), learnt, sign)


def _relearn(known: FittedCorners, knowledge: _Knowledge) -> _Knowledge:
    """Learn again from the second fits; the first ones knew neither blur nor noise."""
    few = known.select(np.arange(len(known.cells)) < CORNER_SECOND_SAMPLE)
    geometry = EdgeGeometry.from_map(few.maps.axes, few.maps.bend)
    prior = knowledge.learnt.prior(few.maps, geometry)
    noise = float(np.median(few.fit.chi2))
    again = learn(few.fit.parameters, few.fit.normal, prior, 1.0, noise)
    return replace(knowledge, learnt=replace(again, spread=again.spread * knowledge.learnt.spread))


def _fit(
    image: Array32,
    cells: Indices,
    maps: LocalMaps,
    start_xy: Array,
    knowledge: _Knowledge,
    *,
    iterations: int,
) -> FittedCorners:
    """Fit all cells from (n, 2) positions and their local maps, and judge each fit on its own."""
    band = band_px(knowledge.blur_px)
    windows = gather_windows(image, start_xy, maps.axes, maps.bend, band)
    geometry = EdgeGeometry.from_map(maps.axes, maps.bend)
    prior = knowledge.learnt.prior(maps, geometry)
    start = rough_start(windows, prior, knowledge.sign * contrast_signs(cells))
    fit = fit_corners(windows, geometry, start, prior, noise=knowledge.noise, iterations=iterations)
    return FittedCorners(cells, maps, windows, fit, find_credible(cells, maps, fit, image))


def _last_fit(image: Array32, known: FittedCorners, knowledge: _Knowledge) -> FittedCorners | None:
    """Fit once more, with maps and levels through the corners themselves."""
    maps = fit_local_maps(known.cells, known.cells, known.fit.xy, leave_out_self=False)
    known, maps = known.select(maps.usable), maps.select(maps.usable)
    if len(known.cells) < CORNERS_COMPARED_MIN:
        return None
    knowledge = _relearn(known, knowledge)
    geometry = EdgeGeometry.from_map(maps.axes, maps.bend)
    prior = smooth_levels(
        knowledge.learnt.prior(maps, geometry), known.cells, known.fit.linear, maps
    )
    fit = fit_corners(
        known.windows,
        geometry,
        known.fit.parameters,
        prior.near(known.fit.parameters),
        noise=knowledge.noise,
        iterations=1,
        judged=True,
    )
    good = find_credible(known.cells, maps, fit, image)
    return FittedCorners(known.cells, maps, known.windows, fit, good)


def _fill(image: Array32, known: FittedCorners, knowledge: _Knowledge) -> FittedCorners:
    """Fit free cells next to good corners, round by round, as long as that finds more."""
    limit = np.array([image.shape[1], image.shape[0]]) - 1 - MARGIN_PX
    tried = _keys(known.cells)
    for _ in range(GROW_ROUNDS):
        near = np.unique((known.cells[:, None] + STEPS[None]).reshape(-1, 2), axis=0)
        near = near[~np.isin(_keys(near), tried)]
        if not len(near):
            break
        maps = fit_local_maps(near, known.cells, known.fit.xy)
        inside = np.all((maps.xy >= MARGIN_PX) & (maps.xy <= limit), axis=1)
        inside &= maps.usable
        near, maps = near[inside], maps.select(inside)
        if not len(near):
            break
        tried = np.concatenate([tried, _keys(near)])
        fitted = _fit(image, near, maps, maps.xy, knowledge, iterations=4)
        if not np.any(fitted.good):
            break
        known = FittedCorners.join(known, fitted.select(fitted.good))
    return known


def _keys(cells: Indices) -> Indices:
    """Return one number per cell; indices stay far below 2^20."""
    return np.asarray(cells[:, 0] * (1 << 21) + cells[:, 1], dtype=np.int64)
