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

"""Errors that corners of an image share, so that their number does not make a calibration as certain as it seems.

*Lines*: vibration and mains hum move whole lines along x. The estimate by least squares stays as it is; its covariance
is that of the sandwich formula (White 1982, doi:10.2307/1912526), ``H^-1 (J' V J) H^-1``, with the covariance ``V`` of
the residuals between lines, which is estimated from their products.

*Bends*: charging, a drift within the image that does not go on evenly, or a lens that creeps while it is scanned
displace neighbouring corners alike, in each image otherwise. Left to least squares, a tenth of a pixel of these passes
for the perspective of other tilts, and lattices and drifts of ten times their usual size make room for them. So every
corner is made as uncertain as independent ones would have to be for images to be bent as much by chance.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.polynomial.legendre import legvander2d
from scipy.linalg import toeplitz
from scipy.optimize import nnls
from scipy.special import chdtri

from semcal_ros.core.arrays import Array, Indices, equilibrate, mad_sigma, solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.normal_equations import (
    normal_equations,
    reduced_normal_equations,
    schur_complement,
)
from semcal_ros.core.calibration.estimator.problem import Setup
from semcal_ros.core.calibration.estimator.residuals import corner_rows
from semcal_ros.core.calibration.estimator.thresholds import (
    ALONG_LINE_MIN,
    JITTER_GAIN,
    JITTER_LENGTHS,
    LAG_MAX,
    LAG_PAIRS_MIN,
    MEDIAN_FREEDOM,
    OUTLIER_SIGMAS,
    SHARED_CONDITION,
    SHARED_CORNERS,
    SHARED_DEGREE,
    SHARED_FALSE_ALARMS,
    SHARED_PAIRS_MIN,
)
from semcal_ros.core.calibration.views import median_sigma_px


@dataclass(frozen=True)
class LineJitter:
    """Covariance of the x errors of lines, as a sum of Gaussian functions of their distance.

    Attributes
    ----------
    variance_px2
        Variance of each part.
    length_lines
        Its length of correlation, lines.
    """

    variance_px2: tuple[float, ...] = ()
    length_lines: tuple[float, ...] = ()

    @property
    def sigma_px(self) -> float:
        """1-sigma of the whole jitter, px."""
        return float(np.sqrt(sum(self.variance_px2)))

    def covariance_px2(self, lag: Array) -> Array:
        """Return the covariance at distances in lines."""
        out = np.zeros(len(lag))
        for variance, length in zip(self.variance_px2, self.length_lines, strict=True):
            out += variance * np.exp(-0.5 * (lag / length) ** 2)
        return out


def _lines(problem: Problem, part: slice) -> Indices:
    """Return the line of each corner of a view, from 0; pixel centres are at whole numbers."""
    line = np.round(problem.observed_px[part, 1]).astype(np.intp)
    return np.asarray(line - line.min(), dtype=np.intp)


def estimate_jitter(problem: Problem, result: BundleResult) -> LineJitter:
    """Estimate the jitter from products of residuals of the same view.

    The result is without parts where nothing significant is found.
    """
    product, pairs = np.zeros(LAG_MAX), np.zeros(LAG_MAX)
    squares, used = 0.0, 0.0
    for part in problem.points_of_views:
        inlier = result.huber_weight[part] >= 1.0
        x = result.residuals_px[part, 0]
        if problem.across is not None:
            # A shift of a line of the raster shows by its part across the lines of the grating.
            by_x = problem.across[part, 0] ** 2
            inlier = inlier & (by_x > ALONG_LINE_MIN)
            x = x / np.maximum(by_x, ALONG_LINE_MIN)
        x = np.where(inlier, x, 0.0)
        line = _lines(problem, part)
        sums, counts = (np.bincount(line, weights=w) for w in (x, inlier.astype(float)))
        own = min(len(sums), LAG_MAX)
        for k in range(own):
            product[k] += sums[k:] @ sums[: len(sums) - k]
            pairs[k] += counts[k:] @ counts[: len(counts) - k]
        # A corner is no pair with itself; pairs on one line are counted twice.
        product[0] -= x @ x
        pairs[0] -= inlier.sum()
        squares += float(x @ x)
        used += float(inlier.sum())
    product[0] *= 0.5
    pairs[0] *= 0.5
    known = pairs >= LAG_PAIRS_MIN
    if not np.any(known):
        return LineJitter()
    lag = np.arange(LAG_MAX)[known]
    variance = squares / max(used, 1.0)
    weight = np.sqrt(pairs[known]) / variance
    target = product[known] / pairs[known] * weight
    # What is nearly gone at the least distance that was compared would take any variance.
    lengths = [s for s in JITTER_LENGTHS if s >= lag[0]]
    if not lengths:
        return LineJitter()
    design = np.stack([np.exp(-0.5 * (lag / s) ** 2) for s in lengths], axis=1) * weight[:, None]
    found, left = nnls(design, target)
    if float(target @ target) - left**2 < JITTER_GAIN:
        return LineJitter()
    parts = [(float(v), s) for v, s in zip(found, lengths, strict=True) if v > 0.0]
    return LineJitter(tuple(v for v, _ in parts), tuple(s for _, s in parts))


def jitter_covariance(problem: Problem, result: BundleResult, jitter: LineJitter) -> Array:
    """Return the (K, K) covariance of theta that the correlation of lines adds.

    ``result`` is the adjustment of ``problem``, at its optimum.
    """
    state = result.state
    size = len(state.theta)
    if not jitter.variance_px2:
        return np.zeros((size, size))
    normal = normal_equations(problem, state)
    reduced = schur_complement(problem, state, normal, 0.0)
    matrix, _ = reduced_normal_equations(
        problem, state.theta, reduced.information, reduced.gradient
    )
    corners = corner_rows(problem, state)
    inner = problem.layout.view.start
    columns = corners.columns[:-1]
    meat = np.zeros((size, size))
    kernel = np.zeros((0, 0))
    for v, part in enumerate(problem.points_of_views):
        xx, yx, _ = problem.whitening[part].T * np.sqrt(corners.huber_weight[part])
        rows = corners.rows[:, :-1, part]
        score = np.zeros((problem.layout.size, rows.shape[2]))
        score[columns] = rows[0] * xx + rows[1] * yx
        # What a shift of each corner along x does to the theta of the optimum.
        outer = score[:inner] - reduced.views.by_rest[v].T @ score[inner:]
        if problem.effects is not None:
            own = reduced.visits.by_rest[problem.effects.visit[v]]
            first = problem.layout.visit.start
            outer = outer[:first] - own.T @ outer[first:]
        pull = problem.designs[problem.group[v]].T @ outer
        line = _lines(problem, part)
        count = int(line.max()) + 1
        by_line = np.zeros((count, size))
        np.add.at(by_line, line, pull.T)
        if len(kernel) < count:
            kernel = toeplitz(jitter.covariance_px2(np.arange(count, dtype=np.float64)))
        own_variance = float(jitter.covariance_px2(np.zeros(1))[0])
        # A corner's own variance is among the noise already.
        meat += by_line.T @ kernel[:count, :count] @ by_line - own_variance * pull @ pull.T
    half = solve_scaled(matrix, meat)
    added = solve_scaled(matrix, half.T)
    return _positive_part(0.5 * (added + added.T))


def _positive_part(matrix: Array) -> Array:
    """Return the nearest matrix without negative eigenvalues, in units of its diagonal."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(scale, scale)


def estimate_shared_excess_px(setup: Setup, problem: Problem, result: BundleResult) -> float:
    """Estimate by how much corners have to be more uncertain, since neighbouring ones are off alike.

    So many independent ones would then scatter as much in the polynomials of the place, from the second degree to
    :data:`SHARED_DEGREE`, that describe the residuals along y. The coefficients are compared between views that follow
    one another in the order of the magnifications, so that a distortion that the camera lacks, which is the same in
    both, does not count; nor does what moves lines along x. The median over the pairs of views lets single views be
    wrong.

    It fails with fewer than six views, or some thirty corners in each, and with errors that are the same in all images.
    What changes within a fifth of the image passes for independent.

    Parameters
    ----------
    setup
        The views, in the order of the magnifications.
    problem, result
        Their adjustment.

    Returns
    -------
    1-sigma per axis, px, to be added to that of the corners; 0 where the coefficients scatter no more than the corners
    of each view let expect, which by chance is not so in :data:`SHARED_FALSE_ALARMS` of all recordings.
    """
    if problem.across is not None:
        return 0.0
    bends = [_bend(setup, problem, result, part) for part in problem.points_of_views]
    pairs = [(a, b) for a, b in pairwise(bends) if a is not None and b is not None]
    if len(pairs) < SHARED_PAIRS_MIN:
        return 0.0
    found = np.empty((len(pairs), 2))
    for k, (a, b) in enumerate(pairs):
        change = a.coefficients - b.coefficients
        square = change @ np.linalg.solve(a.cofactor + b.cofactor, change) / len(change)
        found[k] = square, square / (0.5 * (a.variance_px2 + b.variance_px2))
    variance, ratio = np.median(found, axis=0)
    freedom = len(pairs[0][0].coefficients)
    # Chi-square over its freedom has a median below 1 (Wilson and Hilferty 1931, doi:10.1073/pnas.17.12.684).
    below = (1.0 - 2.0 / (9.0 * freedom)) ** 3
    independent = MEDIAN_FREEDOM * freedom * len(pairs)
    if ratio <= below * float(chdtri(independent, SHARED_FALSE_ALARMS)) / independent:
        return 0.0
    return float(np.sqrt(max(variance / below - median_sigma_px(setup.views) ** 2, 0.0)))


@dataclass(frozen=True)
class _Bend:
    """How the residuals of a view along y are bent: the coefficients of polynomials from the second degree on, their
    covariance over the variance of the corners, and this variance.
    """

    coefficients: Array
    cofactor: Array
    variance_px2: float


def _bend(setup: Setup, problem: Problem, result: BundleResult, part: slice) -> _Bend | None:
    """Return the bend of a view, or None if too few corners, or too small a part of the image, tell it."""
    y = result.residuals_px[part, 1]
    # By what the view itself scatters: it may be more than its corners say.
    inlier = np.abs(y) < OUTLIER_SIGMAS * mad_sigma(y)
    u, v = (2.0 * problem.observed_px[part][inlier] / setup.image_size - 1.0).T
    all_of = legvander2d(u, v, (SHARED_DEGREE, SHARED_DEGREE))
    order = np.add.outer(np.arange(SHARED_DEGREE + 1), np.arange(SHARED_DEGREE + 1)).ravel()
    # A shift and two slopes are the pose's.
    chosen = np.argsort(order, kind="stable")[: int(np.sum(order <= SHARED_DEGREE))]
    design, lowest = all_of[:, chosen], 3
    if len(design) < SHARED_CORNERS * len(chosen):
        return None
    y = y[inlier]
    scaled, scale = equilibrate(design.T @ design)
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < SHARED_CONDITION * values[-1]:
        return None
    cofactor = (vectors / values) @ vectors.T * np.outer(scale, scale)
    coefficients = cofactor @ (design.T @ y)
    return _Bend(coefficients[lowest:], cofactor[lowest:, lowest:], float(np.mean(y**2)))
