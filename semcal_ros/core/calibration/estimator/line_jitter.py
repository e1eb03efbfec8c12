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

"""Errors that corners on neighbouring scan lines share, such as vibration and mains hum.

Such a jitter moves whole lines along x. The corners on them are then wrong together, and their
number does not make a calibration as certain as if they were independent. The estimate by least
squares stays as it is; its covariance is that of the sandwich formula (White 1982,
doi:10.2307/1912526), ``H^-1 (J' V J) H^-1``, with the covariance ``V`` of the residuals between
lines, which is estimated from their products.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import toeplitz
from scipy.optimize import nnls

from semcal_ros.core.arrays import Array, Indices, solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.normal_equations import (
    normal_equations,
    reduced_normal_equations,
    schur_complement,
)
from semcal_ros.core.calibration.estimator.residuals import corner_rows

__all__ = ["LineJitter", "estimate_jitter", "jitter_covariance"]

# Lengths of correlation that are tried, lines: hardly more than one line, that of one corner's window,
# and multiples of it up to a quarter of a small image. Longer ones look like a drift.
_LENGTHS = (0.4, 1.5, 6.0, 24.0)
# Products of residuals are compared up to this many lines apart.
_MOST_LAG = 64
# Improvement in chi-squares below which there is no jitter: three standard deviations.
_SIGNIFICANT = 9.0
# Least sum of weights with which a lag is compared.
_ENOUGH_PAIRS = 20.0


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


def _views(problem: Problem) -> Iterator[slice]:
    for first, last in zip(problem.starts[:-1], problem.starts[1:], strict=True):
        yield slice(int(first), int(last))


def _lines(problem: Problem, part: slice) -> Indices:
    """Return the line of each corner of a view, from 0; pixel centres are at whole numbers."""
    line = np.round(problem.observed_px[part, 1]).astype(np.intp)
    return np.asarray(line - line.min(), dtype=np.intp)


def estimate_jitter(problem: Problem, result: BundleResult) -> LineJitter:
    """Estimate the jitter from products of residuals of the same view.

    The result is without parts where nothing significant is found.
    """
    product, pairs = np.zeros(_MOST_LAG), np.zeros(_MOST_LAG)
    squares = 0.0
    for part in _views(problem):
        inlier = result.huber_weight[part] >= 1.0
        x = np.where(inlier, result.residuals_px[part, 0], 0.0)
        line = _lines(problem, part)
        sums, counts = (np.bincount(line, weights=w) for w in (x, inlier.astype(float)))
        own = min(len(sums), _MOST_LAG)
        for k in range(own):
            product[k] += sums[k:] @ sums[: len(sums) - k]
            pairs[k] += counts[k:] @ counts[: len(counts) - k]
        # A corner is no pair with itself; pairs on one line are counted twice.
        product[0] -= x @ x
        pairs[0] -= inlier.sum()
        squares += float(x @ x)
    product[0] *= 0.5
    pairs[0] *= 0.5
    known = pairs >= _ENOUGH_PAIRS
    if not np.any(known):
        return LineJitter()
    lag = np.arange(_MOST_LAG)[known]
    variance = squares / max(float(np.sum(result.huber_weight >= 1.0)), 1.0)
    weight = np.sqrt(pairs[known]) / variance
    target = product[known] / pairs[known] * weight
    design = np.stack([np.exp(-0.5 * (lag / s) ** 2) for s in _LENGTHS], axis=1) * weight[:, None]
    found, left = nnls(design, target)
    if float(target @ target) - left**2 < _SIGNIFICANT:
        return LineJitter()
    parts = [(float(v), s) for v, s in zip(found, _LENGTHS, strict=True) if v > 0.0]
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
    for v, part in enumerate(_views(problem)):
        xx, yx, _ = problem.whitening[part].T * np.sqrt(corners.huber_weight[part])
        rows = corners.rows[:, :-1, part]
        score = np.zeros((problem.layout.size, rows.shape[2]))
        score[columns] = rows[0] * xx + rows[1] * yx
        # What a shift of each corner along x does to the theta of the optimum.
        outer = score[:inner] - reduced.pose_by_rest[v].T @ score[inner:]
        if problem.effects is not None:
            own = reduced.visit_by_rest[problem.effects.visit[v]]
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
