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

"""Selection of the number of coefficients of each continuous function.

An adjustment leaves one information matrix per magnification (poses eliminated), and a
candidate set of functions is fitted to these alone. A candidate is judged by
leave-one-magnification-out cross-validation on these summaries: fitted to all magnifications but
one, how much worse does it explain the images of that one? The two outermost magnifications are
never left out, since the calibration does not claim to hold beyond them; there the fit itself
counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from semcal_ros.core.arrays import Array, Indices, solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.estimator.problem import variance_factor, with_shared
from semcal_ros.core.camera.calibration_model import ALL_FUNCTIONS
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES

__all__ = ["Summary", "candidate_names", "select_functions"]


# Most coefficients of one function. It bounds the search; with few magnifications their number is
# the smaller limit.
_MAX_SIZE = 8
# What a function may be: a polynomial in log g or in g.
_POLYNOMIALS = ("chebyshev_log", "chebyshev")
# Gain in half chi-squares that pays for one coefficient, as in Akaike's criterion.
_GAIN_PER_COEFFICIENT = 1.0
# That of a term that is not there yet: by chance in one of 600 terms that are not needed, as the chance of a chi-square
# of one degree of freedom above 10.
_GAIN_OF_TERM = 5.0
# Most coefficients of a function of the scan: coils and settling hardly change with the magnification.
_MAX_SCAN_SIZE = 3
# Gain in half chi-squares by which a choice must be better to replace the previous one.
_CLEARLY = 2.0


@dataclass(frozen=True)
class Summary:
    """Quadratic approximation of the reprojection error around one adjustment.

    Attributes
    ----------
    information, right
        (M, C, C) and (M, C): the cost of a camera c, followed by the shared unknowns, at
        magnification i is ``0.5 c' information[i] c - right[i]' c`` plus a constant, in units of
        the noise variance.
    shared_mean, shared_precision
        (C - P,) prior of the shared unknowns.
    """

    information: Array
    right: Array
    shared_mean: Array = field(default_factory=lambda: np.zeros(0))
    shared_precision: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, problem: Problem, result: BundleResult) -> Summary:
        """Summarise an adjustment, scaled to the variance that its residuals show."""
        cameras = problem.designs @ result.state.theta
        right = np.einsum("mpq,mq->mp", result.information, cameras) + result.gradient
        variance = variance_factor(problem, result)
        shared = len(problem.prior_mean) - len(problem.shared)
        return cls(
            result.information / variance,
            right / variance,
            problem.prior_mean[shared:],
            problem.prior_sigma[shared:] ** -2.0,
        )


def candidate_names(
    functions: Mapping[str, ContinuousFunction], terms: Sequence[str]
) -> tuple[str, ...]:
    """Return the names of functions that are there, or may be chosen from ``terms``, in the order of all."""
    return tuple(name for name in ALL_FUNCTIONS if name in functions or name in terms)


class _Candidates:
    """Cross-validation scores of candidate function sets.

    The equations of all coefficients that any candidate may have are made once; a candidate is a
    choice among them.
    """

    def __init__(
        self,
        summary: Summary,
        setup: Setup,
        base: Mapping[str, ContinuousFunction],
        terms: Sequence[str],
    ):
        self.names = candidate_names(base, terms)
        self.setup = setup
        self.scores: dict[tuple[tuple[str, int], ...], float] = {}
        self.priors: dict[tuple[str, str, int], tuple[Array, Array]] = {}
        # Columns of each function in the order of its coefficients, and those of its jumps.
        self.columns: dict[tuple[str, str], Indices] = {}
        self.jumps: dict[str, Indices] = {}
        magnifications = [float(g) for g in setup.magnifications]
        blocks: list[Array] = []
        rows: list[int] = []
        for row, name in enumerate(self.names):
            most = _most_of(name)
            most = max(most, base[name].smooth_size if name in base else 0)
            for kind in _POLYNOMIALS:
                blank = ContinuousFunction(kind, np.zeros(most), base["scale"].g_range)
                self.columns[name, kind] = np.arange(len(rows), len(rows) + most)
                blocks.append(np.stack([blank.basis(g) for g in magnifications]))
                rows += [row] * most
            breaks = setup.breaks_of(name)
            self.jumps[name] = np.arange(len(rows), len(rows) + len(breaks))
            blocks.append((np.array(magnifications)[:, None] >= breaks).astype(np.float64))
            rows += [row] * len(breaks)
        shared = len(summary.shared_mean)
        self.shared = np.arange(len(rows), len(rows) + shared)
        self.shared_prior = summary.shared_mean, summary.shared_precision
        values = np.concatenate(blocks, axis=1)
        # The scale is the first of the functions.
        nominal = setup.nominal_px_per_m(setup.magnifications)
        values[:, np.array(rows) == 0] *= nominal[:, None]
        designs = np.zeros((len(magnifications), len(self.names), len(rows)))
        designs[:, rows, np.arange(len(rows))] = values
        designs = with_shared(designs, shared)
        transposed = np.swapaxes(designs, 1, 2)
        self.matrices = transposed @ summary.information @ designs
        self.rights = (transposed @ summary.right[:, :, None])[:, :, 0]

    def _prior(self, name: str, kind: str, size: int) -> tuple[Array, Array]:
        if size == 0:
            return np.zeros(0), np.zeros(0)
        key = (name, kind, size)
        if key not in self.priors:
            mean, sigma = self.setup.coefficient_priors(name, kind, size)
            self.priors[key] = mean, sigma**-2.0
        return self.priors[key]

    def score(self, sizes: Mapping[str, tuple[str, int]]) -> float:
        """Return the cost of predicting inner magnifications and of fitting the outermost ones."""
        key = tuple(sizes[name] for name in self.names)
        if key not in self.scores:
            self.scores[key] = self._score(sizes)
        return self.scores[key]

    def _score(self, sizes: Mapping[str, tuple[str, int]]) -> float:
        chosen: list[Indices] = []
        for name in self.names:
            kind, size = sizes[name]
            chosen += [self.columns[name, kind][:size], self.jumps[name]]
        columns = np.concatenate([*chosen, self.shared])
        priors = [self._prior(name, *sizes[name]) for name in self.names]
        mean, precision = (
            np.concatenate(parts) for parts in zip(*priors, self.shared_prior, strict=True)
        )
        matrices = self.matrices[:, columns[:, None], columns]
        rights = self.rights[:, columns]
        matrix = matrices.sum(axis=0) + np.diag(precision)
        right = rights.sum(axis=0) + precision * mean
        # The inner magnifications are predicted from the others, the two outermost ones from all.
        inner = np.ones((len(matrices), 1, 1))
        inner[[0, -1]] = 0.0
        solution = solve_scaled(matrix - inner * matrices, right - inner[:, 0] * rights)
        bent = (matrices @ solution[:, :, None])[:, :, 0]
        return float(np.sum((0.5 * bent - rights) * solution))


def select_functions(
    summary: Summary,
    setup: Setup,
    functions: Mapping[str, ContinuousFunction],
    free: Sequence[str],
    terms: Sequence[str],
    current: Mapping[str, tuple[str, int]] | None = None,
) -> dict[str, tuple[str, int]]:
    """Choose (kind, size) of the functions named in ``free`` and ``terms`` greedily.

    Coefficients are added one or two at a time, as polynomials in log g or in g, as long as the
    cross-validation gains more than :data:`_GAIN_PER_COEFFICIENT` for each, and removed where that
    costs less. One of ``terms`` may have none, and needs more of a gain for the first. The ``current``
    choice stays unless another one is clearly better.
    """
    candidates = _Candidates(summary, setup, functions, terms)
    most = len(setup.magnifications) - 1
    limits = {name: min(_MAX_SIZE, most) for name in free}
    limits |= {name: min(_most_of(name), max(most, 1)) for name in terms}
    sizes = {name: (own.kind, own.smooth_size) for name, own in functions.items()}
    sizes.update(dict.fromkeys(free, ("chebyshev_log", 1)))
    sizes.update(dict.fromkeys(terms, ("chebyshev_log", 0)))
    while True:
        score = candidates.score(sizes)
        best: tuple[float, str, tuple[str, int]] | None = None
        for name, option in _moves(sizes, limits, terms):
            trial = candidates.score({**sizes, name: option})
            gain = score - trial - _price(option[1]) + _price(sizes[name][1])
            if name in free:
                gain = score - trial - _cost(option) + _cost(sizes[name])
            if gain > 1e-6 and (best is None or gain > best[0]):
                best = (gain, name, option)
        if best is None:
            break
        sizes[best[1]] = best[2]
    if current is not None:
        kept = {**sizes, **current}
        more = sum(kept[name][1] - sizes[name][1] for name in free) * _GAIN_PER_COEFFICIENT
        more += sum(_price(kept[name][1]) - _price(sizes[name][1]) for name in terms)
        if candidates.score(kept) + more < score + _CLEARLY:
            sizes = kept
    return {name: sizes[name] for name in (*free, *terms)}


def _most_of(name: str) -> int:
    """Return the most coefficients that a function may have."""
    return _MAX_SCAN_SIZE if name in SCAN_NAMES else _MAX_SIZE


def _cost(option: tuple[str, int]) -> float:
    """Return what a function that is always there must gain: that in g itself somewhat more, as it is less natural."""
    kind, size = option
    return _GAIN_PER_COEFFICIENT * (size + (kind != "chebyshev_log"))


def _price(size: int) -> float:
    """Return what a term of so many coefficients must gain."""
    return 0.0 if size == 0 else _GAIN_OF_TERM + _GAIN_PER_COEFFICIENT * (size - 1)


def _moves(
    sizes: Mapping[str, tuple[str, int]], limits: Mapping[str, int], terms: Sequence[str]
) -> list[tuple[str, tuple[str, int]]]:
    moves = []
    for name, limit in limits.items():
        kind, size = sizes[name]
        least = 0 if name in terms else 1
        for other in _POLYNOMIALS[:1] if name in terms else _POLYNOMIALS:
            for change in (-1, 0, 1, 2):
                option = (other, size + change)
                if least <= option[1] <= limit and option != (kind, size):
                    moves.append((name, option))
    return moves
