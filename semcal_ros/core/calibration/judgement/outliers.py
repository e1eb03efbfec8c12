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

"""Views that disagree with the others, such as one whose magnification was recorded wrongly.

A wrong magnification is a wrong scale. Under a perspective projection the height of a view imitates
it; under a parallel one a tilt of a stretched grid does in part. So a view is compared with the
others in three ways: its height with those at its own magnification, its misfit and the stretch of
its lattice with all.

What is found here is left out in :mod:`semcal_ros.core.calibration.pipeline`, which fits anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import stdtrit

from semcal_ros.core.arrays import Array, Indices, Mask, invert_scaled, solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Effects, Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    Adjustment,
    BundleResult,
    refine,
    variance_factor,
)
from semcal_ros.core.calibration.estimator.problem import Priors, Setup
from semcal_ros.core.calibration.estimator.residuals import heights_on_beam, whitened_norm
from semcal_ros.core.calibration.estimator.thresholds import FLAT_RAD
from semcal_ros.core.calibration.judgement.thresholds import (
    DETERMINED_MIN,
    HEIGHT_SIGMAS,
    HEIGHT_SPREAD_MIN_M,
    JUMP_FALSE_ALARMS,
    MISFIT_RATIO,
    OUTLIER_FALSE_ALARMS,
    SHAPE_SPREAD_MIN,
    SMOOTHER_ORDERS,
    STEP_LEFT_MIN,
    SWAMPED_PART,
    TILT_SIGMAS,
    TRIMMED_PART,
    USUAL_VIEWS,
    VIEWS_MIN,
    WRONG_PART_MAX,
    WRONG_QUANTILE_SIGMAS,
)
from semcal_ros.core.calibration.views import ViewStatus
from semcal_ros.core.camera.calibration_model import columns_of
from semcal_ros.core.errors import Rejection


@dataclass(frozen=True)
class ChangePoint:
    """What the scales of the magnifications do that a smooth function does not: a jump, or one that is odd.

    Attributes
    ----------
    below, above
        Neighbouring magnifications between which the scale jumps. They are the same one where this magnification alone
        departs from the course of the others.
    relative, sigma
        Size relative to the scale, and its 1-sigma.
    """

    below: float
    above: float
    relative: float
    sigma: float


@dataclass(frozen=True)
class FreeScales:
    """Scales of the M magnifications, each free, over the nominal ones.

    Attributes
    ----------
    departure
        (M,) from the adjusted ones.
    half
        (M, M) lower triangle whose square is their covariance if visits scatter as usual.
    repeated_squares, repeated
        Sum of the squares of what visits of one magnification differ by, in usual sigmas, and how many such differences
        the views determine.
    """

    departure: Array
    half: Array
    repeated_squares: float
    repeated: float

    def whiten(self, values: Array) -> Array:
        """Values (M,) or (M, n) in sigmas."""
        return np.asarray(solve_triangular(self.half, values, lower=True), dtype=np.float64)


def find_change_point(setup: Setup, adjustment: Adjustment) -> ChangePoint | None:
    """Find the most significant jump of the scale between two magnifications, or None if none is significant.

    The scales of the magnifications, each free, are compared with the chosen function of the adjustment, with and
    without a step between two of them, or a departure of one alone (:func:`find_change`). Breakpoints that the function
    already has are left out.

    It fails to find a jump where the function has nearly as many coefficients as there are magnifications that were
    each visited once.
    """
    g = setup.magnifications
    index = np.arange(len(g))
    candidates = [
        (g[k - 1], g[k], index >= k)
        for k in range(1, len(g))
        if not any(g[k - 1] < b <= g[k] for b in setup.breakpoints)
    ]
    # The lowest or the highest one alone is a step, too.
    candidates += [(g[k], g[k], index == k) for k in range(1, len(g) - 1)]
    if not candidates:
        return None
    own = columns_of(adjustment.functions)["scale"]
    smooth = adjustment.problem.designs[:, 0, own] / setup.nominal_px_per_m(g)[:, None]
    place = np.log(g / np.sqrt(g[0] * g[-1]))
    size = adjustment.functions["scale"].smooth_size
    orders = range(size, size + min(SMOOTHER_ORDERS, len(g) - smooth.shape[1] - 1))
    further = np.stack([place**k for k in orders], axis=1) if orders else np.zeros((len(g), 0))
    try:
        scales = _free_scales(setup, adjustment)
    except np.linalg.LinAlgError:
        # By itself, the scale of a magnification is not determined.
        return None
    found = find_change(scales, smooth, [where for _, _, where in candidates], further)
    if found is None:
        return None
    below, above, _ = candidates[found[0]]
    return ChangePoint(float(below), float(above), *found[1:])


def find_change(
    scales: FreeScales, smooth: Array, candidates: Sequence[Mask], further: Array
) -> tuple[int, float, float] | None:
    """Find the candidate by which the scales change most significantly besides a smooth function.

    How much they scatter about it is not known: it is estimated from what the function and the change leave, from what
    visits of the same magnification differ by, and from the usual scatter of visits as one observation, so that a
    change has to be significant by Student's t. Without one, one is found with the chance `JUMP_FALSE_ALARMS`, shared
    among the candidates by Bonferroni's inequality. Nor is it a change what a smooth function of a few more
    coefficients explains better: a course of the scale that the chosen one is too stiff for does not scatter.

    Parameters
    ----------
    scales
        Scales of the M magnifications.
    smooth
        (M, K) values of the functions whose sum is the smooth one.
    candidates
        (M,) where the scale is changed, for each; at least one.
    further
        (M, F) values of the next functions, by which a smooth one would bend more.

    Returns
    -------
    Index of the candidate, relative size of the change and its 1-sigma, or None if none is significant.
    """
    freedom = len(smooth) - smooth.shape[1] + scales.repeated
    if freedom <= 0.0:
        return None
    basis = np.linalg.qr(scales.whiten(smooth))[0]
    left = scales.whiten(scales.departure)
    left -= basis @ (basis.T @ left)
    highest = -float(stdtrit(freedom, 0.5 * JUMP_FALSE_ALARMS / len(candidates)))
    best, gained = None, 0.0
    for k, where in enumerate(candidates):
        change = scales.whiten(where.astype(np.float64))
        whole = change @ change
        change -= basis @ (basis.T @ change)
        information = change @ change
        if information < STEP_LEFT_MIN * whole:
            continue
        size = float(change @ left / information)
        scatter = left @ left - size**2 * information + scales.repeated_squares
        sigma = float(np.sqrt((np.maximum(scatter, 0.0) + 1.0) / (freedom * information)))
        if abs(size) > highest * sigma:
            highest = abs(size) / sigma
            best, gained = (k, size, sigma), float(size**2 * information)
    more = scales.whiten(further)
    bends = np.linalg.qr(more - basis @ (basis.T @ more))[0]
    return None if np.sum((bends.T @ left) ** 2) > gained else best


def _free_scales(setup: Setup, adjustment: Adjustment) -> FreeScales:
    problem, result = adjustment.problem, adjustment.result
    squares, repeated = 0.0, 0.0
    if problem.effects is not None:
        # A jump that is not in the model makes the visits look as if they did not come back.
        effects = replace(
            problem.effects,
            scale_sigma=min(problem.effects.scale_sigma, setup.priors.visit_scale_sigma),
            height_sigma_m=min(problem.effects.height_sigma_m, setup.priors.visit_height_sigma_m),
        )
        problem = replace(problem, effects=effects)
        result = refine(problem, result.state, tolerance=1e-4)
        squares, repeated = _compare_visits(effects, result)
    own = columns_of(adjustment.functions)["scale"]
    nominal = setup.nominal_px_per_m(setup.magnifications)
    matrix, right = result.equations(problem)
    others = np.delete(np.arange(len(right)), np.arange(own.start, own.stop))
    pull = result.information[:, :, 0] * nominal[:, None]
    cross = np.einsum("mpk,mp->km", problem.designs, pull)[others]
    inner = np.diag(pull[:, 0] * nominal)
    gradient = result.gradient[:, 0] * nominal
    solved = solve_scaled(matrix[np.ix_(others, others)], np.column_stack([cross, right[others]]))
    information = inner - cross.T @ solved[:, :-1]
    covariance = invert_scaled(0.5 * (information + information.T))
    departure = covariance @ (gradient - cross.T @ solved[:, -1])
    variance = max(variance_factor(problem, result), 1.0)
    half = np.asarray(
        np.linalg.cholesky(0.5 * variance * (covariance + covariance.T)), dtype=np.float64
    )
    return FreeScales(departure, half, squares / variance, repeated)


def _compare_visits(effects: Effects, result: BundleResult) -> tuple[float, float]:
    """Return the sum of squares of what visits of one magnification differ by, in sigmas, and how many differences are
    determined.
    """
    scale = result.state.visits[:, 0] / effects.scale_sigma
    known = np.maximum(1.0 - result.visit_variance[:, 0] / effects.scale_sigma**2, 0.0)
    squares, repeated = 0.0, 0.0
    for group in np.unique(effects.visit_group):
        own = effects.visit_group == group
        squares += float(np.sum((scale[own] - scale[own].mean()) ** 2))
        repeated += float(np.mean(known[own]) * (own.sum() - 1))
    return squares, repeated


def find_wrong_tilts(problem: Problem, result: BundleResult) -> Mapping[int, float]:
    """Find the views whose tilt contradicts the stage; index and contradiction in sigmas of each, the worst first.

    One wrong reading moves the constant offsets, and with them all the others: only those that are
    at least half as wrong as the worst are returned.
    """
    if problem.attitudes is None:
        return {}
    left = result.prior_residuals["attitude"]
    free = np.maximum(1.0 - result.prior_variance["attitude"], DETERMINED_MIN)
    deviation = np.max(np.abs(left) / np.sqrt(free), axis=1)
    limit = max(TILT_SIGMAS, 0.5 * float(deviation.max()))
    worst = np.argsort(-deviation)
    return {int(v): float(deviation[v]) for v in worst if deviation[v] > limit}


@dataclass(frozen=True, eq=False)
class Deviations:
    """How much each view disagrees with the others.

    Attributes
    ----------
    height_m, stretch, misfit
        (V,) height about that of the other views at its magnification, m; the larger of stretch and shear of
        its lattice; RMS residual over that of the median view, each without the largest quarter of the corners.
    others_height_m
        (V,) RMS of such heights among the views with which it is compared, m.
    visit_scale
        (V,) relative scale of a view's visit about that of the others, where it has no other view; else 0.
    of_limit
        (V,) deviation of height, stretch and visit together, over the limit for it. A wrong scale is imitated by each
        in part, as the projection lets it.
    """

    height_m: Array
    stretch: Array
    misfit: Array
    others_height_m: Array
    visit_scale: Array
    of_limit: Array

    def reject(self, view: int) -> Rejection[ViewStatus]:
        """Return why a view is left out."""
        residuals = f"residuals that are {self.misfit[view]:.1f} times the usual"
        if self.misfit[view] > MISFIT_RATIO and self.of_limit[view] <= 1.0:
            return Rejection(
                ViewStatus.OUTLIER,
                f"does not agree with the other views: {residuals}; wrong magnification or square size, or corners "
                "that are not the grid's",
            )
        return Rejection(
            ViewStatus.OUTLIER,
            f"does not agree with the other views: {1e6 * abs(self.height_m[view]):.0f} um of height, where the others "
            f"scatter by {1e6 * self.others_height_m[view]:.0f} um, a grid stretched by "
            f"{100.0 * self.stretch[view]:.2g} %, a scale that differs by {100.0 * abs(self.visit_scale[view]):.2g} % "
            f"more, and {residuals}; wrong magnification, or a wrong square size",
        )


def measure_deviations(
    problem: Problem, result: BundleResult, usual_height_m: float = Priors.height_sigma_m
) -> Deviations:
    """Measure how much each view disagrees with the others; ``problem`` and ``result`` are the adjustment.

    A view has no part in what it is compared with: where there are few, it would rule their spread. Heights scatter
    where the stage moves, so that a tilted view is compared with tilted ones, and ``usual_height_m`` is their usual
    1-sigma.
    """
    count = len(problem.group)
    squares = whitened_norm(problem, result.residuals_px) ** 2
    square = np.array([_trimmed_mean(own) for own in np.split(squares, problem.starts[1:-1])])
    misfit = np.sqrt(square / max(float(np.median(square)), 1e-30))
    tilted = result.state.rotations[:, 2, 2] <= np.cos(FLAT_RAD)
    lattices = np.abs(result.state.lattices)
    stretch = np.max(lattices, axis=1) if len(lattices) else np.zeros(count)
    # The origin of a tilted lattice lies higher the farther it is from the beam.
    on_beam, _, _ = heights_on_beam(problem, result.state)
    height, others = np.zeros(count), np.zeros(count)
    of_limit = np.zeros(count)
    for v in range(count):
        rest = np.arange(count) != v
        heights, from_views = _heights_without(problem, on_beam, v)
        like = heights[rest & (tilted | ~tilted[v])]
        limit, others[v] = _limit(like, from_views, count, usual_height_m, HEIGHT_SPREAD_MIN_M)
        height[v] = heights[v]
        of_limit[v] = abs(height[v]) / limit
        if len(lattices):
            bend, _ = _limit(stretch[rest], count - 1, count, SHAPE_SPREAD_MIN, SHAPE_SPREAD_MIN)
            of_limit[v] = np.hypot(of_limit[v], stretch[v] / bend)
    visit_scale, visit_of_limit = _measure_lone_visits(problem, result)
    of_limit = np.hypot(of_limit, visit_of_limit)
    return Deviations(height, stretch, misfit, others, visit_scale, of_limit)


def _trimmed_mean(squares: Array) -> float:
    """Mean without the largest part, since one wrong corner is no wrong view (least trimmed squares, Rousseeuw and Van
    Driessen 2006, doi:10.1007/s10618-005-0024-4).
    """
    kept = max(int(np.ceil(TRIMMED_PART * len(squares))), 1)
    return float(np.mean(np.partition(squares, kept - 1)[:kept]))


def _measure_lone_visits(problem: Problem, result: BundleResult) -> tuple[Array, Array]:
    """Return the (V,) relative scales of visits about those of others, and the (V,) deviations of scale and height over
    the limit for them, where a view is the only one of its visit; else 0.

    A view whose magnification is stated wrongly is a visit of its own, whose scale or height explains that.
    """
    scale, out = np.zeros(len(problem.group)), np.zeros(len(problem.group))
    effects = problem.effects
    if effects is None:
        return scale, out
    visits, count = result.state.visits, np.bincount(effects.visit)
    usual = Priors.visit_scale_sigma, Priors.visit_height_sigma_m
    least = SHAPE_SPREAD_MIN, HEIGHT_SPREAD_MIN_M
    for v in np.flatnonzero(count[effects.visit] == 1):
        own = effects.visit[v]
        others = np.delete(visits, own, axis=0)
        middle = np.median(others, axis=0) if len(others) else np.zeros(2)
        deviation = visits[own] - middle
        limits = [
            _limit(spread, len(others), len(count), *known)[0]
            for spread, *known in zip((others - middle).T, usual, least, strict=True)
        ]
        scale[v] = deviation[0]
        out[v] = np.hypot(*(deviation / limits))
    return scale, out


def _heights_without(problem: Problem, height: Array, view: int) -> tuple[Array, int]:
    """Return the (V,) heights about the medians of the others, and of how many views that of ``view`` is the median."""
    rest = np.arange(len(height)) != view
    offset = height - np.median(height[rest]) if np.any(rest) else np.zeros(len(height))
    from_views = int(rest.sum())
    for own in _members(problem):
        if len(own) >= VIEWS_MIN:
            offset[own] = height[own] - np.median(height[own[rest[own]]])
            if view in own:
                from_views = len(own) - 1
    return offset, from_views


def _limit(
    others: Array, from_views: int, count: int, usual: float, least: float
) -> tuple[float, float]:
    """Return the deviation from the others from which a view is odd, and the RMS deviation of the others.

    The spread is that of the others alone, or together with :data:`USUAL_VIEWS` that have the ``usual`` one, whichever
    lets more be seen: the first says much where there are many, the second where there are few. Each gets half of the
    chance :data:`OUTLIER_FALSE_ALARMS`, shared among the ``count`` views by Bonferroni's inequality; a deviation over
    a spread that is known from few is Student's t. The median of others is uncertain itself, of normal ones by
    sqrt(pi / 2) of what their mean is. Where there are many views, as many may be wrong as are left out at once, and
    the spread is that without them (Rosner 1983, doi:10.1080/00401706.1983.10487848). Heights are a mixture, narrow
    where the prior holds them and wide where the views tell them: it is at least that of the wide ones, which are more
    than a tenth.
    """
    wrong = max(int(WRONG_PART_MAX * count), 1)
    squares = np.sort(others**2)[: max(len(others) - wrong + 1, 1)]
    freedom = max(len(squares) - 1, 0)
    total = float(np.sum(squares))
    wide = 0.0
    if len(others):
        wide = float(np.quantile(np.abs(others), 1.0 - WRONG_PART_MAX)) / WRONG_QUANTILE_SIGMAS
    chance = 0.25 * OUTLIER_FALSE_ALARMS / count
    wider = np.sqrt(1.0 + 0.5 * np.pi / max(from_views, 1))
    limits = []
    for known, square in (
        (freedom, total),
        (freedom + USUAL_VIEWS, total + USUAL_VIEWS * usual**2),
    ):
        if known > 0:
            sigmas = max(HEIGHT_SIGMAS, -wider * float(stdtrit(known, chance)))
            limits.append(sigmas * max(float(np.sqrt(square / known)), wide, least))
    return min(limits), float(np.sqrt(total / max(len(squares), 1)))


def _members(problem: Problem) -> list[Indices]:
    """Return the views of each magnification."""
    return [np.flatnonzero(problem.group == k) for k in range(len(problem.designs))]


def find_outliers(
    problem: Problem, result: BundleResult, usual_height_m: float = Priors.height_sigma_m
) -> Mapping[int, Rejection[ViewStatus]]:
    """Find the views that disagree with the others; index and reason of each.

    ``problem`` and ``result`` are the adjustment, ``usual_height_m`` is as for :func:`measure_deviations`. One wrong
    view makes sound ones look wrong that are compared with it (swamping: Davies and Gather 1993,
    doi:10.1080/01621459.1993.10476339), so only those are returned that are nearly as odd as the oddest: a fit without
    these tells of the others. Where they are half of the views at a magnification, or many in all, the fault is not in
    single views, and none is returned.
    """
    found = measure_deviations(problem, result, usual_height_m)
    oddness = np.maximum(found.of_limit, found.misfit / MISFIT_RATIO)
    odd = oddness > max(1.0, SWAMPED_PART * float(oddness.max()))
    outliers: dict[int, Rejection[ViewStatus]] = {}
    if odd.sum() > max(1.0, WRONG_PART_MAX * len(odd)) or 2 * odd.sum() >= len(odd):
        return outliers
    for own in _members(problem):
        if len(own) >= VIEWS_MIN and 2 * odd[own].sum() >= len(own):
            continue
        for v in own[odd[own]]:
            outliers[int(v)] = found.reject(int(v))
    return outliers
