"""Selection of the number of coefficients of each continuous function.

An adjustment leaves one 10 x 10 information matrix per magnification (poses eliminated), and a
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

from semcal_ros.core.arrays import Array, solve_scaled
from semcal_ros.core.calibration.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.normal_equations import Problem
from semcal_ros.core.calibration.priors import Setup
from semcal_ros.core.calibration.problem import variance_factor, with_shared
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES
from semcal_ros.core.camera.continuous_function import ContinuousFunction

__all__ = ["Summary", "select_functions"]


# Most coefficients of one function. It bounds the search; with few magnifications their number is
# the smaller limit.
_MAX_SIZE = 8
# Gain in half chi-squares that pays for one coefficient, as in Akaike's criterion.
_GAIN_PER_COEFFICIENT = 1.0
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
        (C - 10,) prior of the shared unknowns.
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


class _Candidates:
    """Cross-validation scores of candidate function sets, with the blocks of each function kept."""

    def __init__(self, summary: Summary, setup: Setup, base: Mapping[str, ContinuousFunction]):
        self.summary = summary
        self.setup = setup
        self.base = base
        self.rows: dict[tuple[str, str, int], Array] = {}
        self.priors: dict[tuple[str, str, int], tuple[Array, Array]] = {}
        self.scores: dict[tuple[tuple[str, int], ...], float] = {}

    def _rows(self, name: str, kind: str, size: int) -> Array:
        key = (name, kind, size)
        if key not in self.rows:
            breaks = self.setup.breaks_of(name)
            zeros = np.zeros(size + len(breaks))
            blank = ContinuousFunction(kind, zeros, self.base[name].g_range, breaks=breaks)
            rows = np.stack([blank.basis(float(g)) for g in self.setup.magnifications])
            if name == "scale":
                rows = rows * self.setup.nominal_px_per_m(self.setup.magnifications)[:, None]
            self.rows[key] = rows
        return self.rows[key]

    def _prior(self, name: str, kind: str, size: int) -> tuple[Array, Array]:
        key = (name, kind, size)
        if key not in self.priors:
            mean, sigma = self.setup.coefficient_priors(name, kind, size)
            self.priors[key] = mean, sigma**-2.0
        return self.priors[key]

    def score(self, sizes: Mapping[str, tuple[str, int]]) -> float:
        """Return the cost of predicting inner magnifications and of fitting the outermost ones."""
        key = tuple(sizes[name] for name in FUNCTION_NAMES)
        if key not in self.scores:
            self.scores[key] = self._score(sizes)
        return self.scores[key]

    def _score(self, sizes: Mapping[str, tuple[str, int]]) -> float:
        blocks = [self._rows(name, *sizes[name]) for name in FUNCTION_NAMES]
        total = sum(b.shape[1] for b in blocks)
        designs = np.zeros((len(self.setup.magnifications), len(blocks), total))
        mean, precision = np.zeros(total), np.zeros(total)
        column = 0
        for row, (name, block) in enumerate(zip(FUNCTION_NAMES, blocks, strict=True)):
            stop = column + block.shape[1]
            designs[:, row, column:stop] = block
            mean[column:stop], precision[column:stop] = self._prior(name, *sizes[name])
            column = stop
        shared = len(self.summary.shared_mean)
        if shared:
            designs = with_shared(designs, shared)
            mean = np.concatenate([mean, self.summary.shared_mean])
            precision = np.concatenate([precision, self.summary.shared_precision])
        transposed = np.swapaxes(designs, 1, 2)
        matrices = transposed @ self.summary.information @ designs
        rights = (transposed @ self.summary.right[:, :, None])[:, :, 0]
        matrix = matrices.sum(axis=0) + np.diag(precision)
        right = rights.sum(axis=0) + precision * mean
        # The inner magnifications are predicted from the others, the two outermost ones from all.
        inner = np.ones((len(matrices), 1, 1))
        inner[[0, -1]] = 0.0
        solution = solve_scaled(matrix - inner * matrices, right - inner[:, 0] * rights)
        cameras = np.einsum("mpk,mk->mp", designs, solution)
        quadratic = np.einsum("mp,mpq,mq->m", cameras, self.summary.information, cameras)
        linear = np.einsum("mp,mp->m", cameras, self.summary.right)
        return float(np.sum(0.5 * quadratic - linear))


def select_functions(
    summary: Summary,
    setup: Setup,
    functions: Mapping[str, ContinuousFunction],
    free: Sequence[str],
    current: Mapping[str, tuple[str, int]] | None = None,
) -> dict[str, tuple[str, int]]:
    """Choose (kind, size) of the functions named in ``free`` greedily.

    Coefficients are added one or two at a time, as polynomials in log g or in g, as long as the
    cross-validation gains more than :data:`_GAIN_PER_COEFFICIENT` for each, and removed where that
    costs less. The ``current`` choice stays unless another one is clearly better.
    """
    candidates = _Candidates(summary, setup, functions)
    limit = min(_MAX_SIZE, len(setup.magnifications) - 1)
    sizes = {name: (functions[name].kind, functions[name].smooth_size) for name in FUNCTION_NAMES}
    sizes.update(dict.fromkeys(free, ("chebyshev_log", 1)))
    while True:
        score = candidates.score(sizes)
        best: tuple[float, str, tuple[str, int]] | None = None
        for name, option in _moves(sizes, free, limit):
            change = option[1] - sizes[name][1]
            trial = candidates.score({**sizes, name: option})
            gain = score - trial - _GAIN_PER_COEFFICIENT * change
            if gain > 1e-6 and (best is None or gain > best[0]):
                best = (gain, name, option)
        if best is None:
            break
        sizes[best[1]] = best[2]
    if current is not None:
        kept = {**sizes, **current}
        more = sum(kept[name][1] - sizes[name][1] for name in free)
        if candidates.score(kept) + _GAIN_PER_COEFFICIENT * more < score + _CLEARLY:
            sizes = kept
    return {name: sizes[name] for name in free}


def _moves(
    sizes: Mapping[str, tuple[str, int]], free: Sequence[str], limit: int
) -> list[tuple[str, tuple[str, int]]]:
    moves = []
    for name in free:
        kind, size = sizes[name]
        for other in ("chebyshev_log", "chebyshev"):
            for change in (-1, 0, 1, 2):
                option = (other, size + change)
                if 1 <= option[1] <= limit and option != (kind, size):
                    moves.append((name, option))
    return moves
