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

"""Which terms and coefficients the data ask for, as the corners come to be believed.

An adjustment leaves one information matrix per magnification (poses eliminated), and a candidate set of functions is
fitted to these alone. It is judged by leaving out one magnification at a time: fitted to all the others, how much worse
does it explain the images of that one? The two outermost magnifications are never left out, since the calibration does
not claim to hold beyond them; there the fit itself counts.

The corners are believed as far as the model explains them, step by step, so that a strong distortion is not explained
by tilts. A residual field comes last, for what all terms leave.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import Array, Indices, solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    DECENTRING,
    Adjustment,
    BundleResult,
    refine,
    refit_functions,
    residual_variance,
    smooth_names,
)
from semcal_ros.core.calibration.estimator.poses import adjust_with_other_poses, refine_coarsely
from semcal_ros.core.calibration.estimator.problem import (
    Functions,
    Setup,
    VarianceComponents,
    build_problem,
    stack_theta,
    with_shared,
)
from semcal_ros.core.calibration.estimator.residual_field_fit import (
    FittedField,
    GridPattern,
    blank_field,
    choose_field,
    field_system,
    solve_field,
    undo_field,
)
from semcal_ros.core.calibration.estimator.variance_components import (
    limit_lattices,
    update_components,
)
from semcal_ros.core.calibration.start import Start, tempered
from semcal_ros.core.calibration.thresholds import (
    BELIEF_STEP_MIN,
    BELIEF_STEPS,
    CHOICE_GAIN,
    CHOICE_ROUNDS,
    CHOOSING_ROUNDS,
    COEFFICIENT_GAIN,
    EXPLAINED_MIN,
    FIELD_ROUNDS,
    FIELD_SETTLED_PX,
    FREE_ROUNDS,
    LATE_TERM_GAIN,
    SCAN_SIZE_MAX,
    SIZE_MAX,
    TERM_GAIN,
)
from semcal_ros.core.calibration.views import estimate_excess_sigma_px
from semcal_ros.core.camera.calibration_model import ALL_FUNCTIONS, TERM_NAMES, with_coefficients
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.distortion import LATE_TERMS, PRODUCTS
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES
from semcal_ros.core.errors import UnusableCalibrationError

# What a function may be: a polynomial in log g or in g.
_POLYNOMIALS = ("chebyshev_log", "chebyshev")


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
        variance = residual_variance(problem, result)
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


class Candidates:
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
        # Columns of each function in the order of its coefficients, and those of its jumps.
        self.columns: dict[tuple[str, str], Indices] = {}
        self.jumps: dict[str, Indices] = {}
        magnifications = [float(g) for g in setup.magnifications]
        blocks: list[Array] = []
        rows: list[int] = []
        means, sigmas = [], []
        for row, name in enumerate(self.names):
            most = _most_of(name)
            most = max(most, base[name].smooth_size if name in base else 0)
            for kind in _POLYNOMIALS:
                blank = ContinuousFunction(kind, np.zeros(most), base["scale"].g_range)
                self.columns[name, kind] = np.arange(len(rows), len(rows) + most)
                blocks.append(np.stack([blank.basis(g) for g in magnifications]))
                rows += [row] * most
                mean, sigma = setup.coefficient_priors(name, kind, most)
                means.append(mean[:most])
                sigmas.append(sigma[:most])
            breaks = setup.breaks_of(name)
            self.jumps[name] = np.arange(len(rows), len(rows) + len(breaks))
            blocks.append((np.array(magnifications)[:, None] >= breaks).astype(np.float64))
            rows += [row] * len(breaks)
            means.append(mean[most:])
            sigmas.append(sigma[most:])
        shared = len(summary.shared_mean)
        self.shared = np.arange(len(rows), len(rows) + shared)
        values = np.concatenate(blocks, axis=1)
        # The scale is the first of the functions.
        nominal = setup.nominal_px_per_m(setup.magnifications)
        values[:, np.array(rows) == 0] *= nominal[:, None]
        designs = np.zeros((len(magnifications), len(self.names), len(rows)))
        designs[:, rows, np.arange(len(rows))] = values
        designs = with_shared(designs, shared)
        transposed = np.swapaxes(designs, 1, 2)
        self.matrices = transposed @ summary.information @ designs
        self.rights = _times(transposed, summary.right)
        prior_mean = np.concatenate([*means, summary.shared_mean])
        precision = np.concatenate([np.concatenate(sigmas) ** -2.0, summary.shared_precision])
        # The inner magnifications are predicted from the others, the two outermost ones from all.
        inner = np.ones((len(magnifications), 1, 1))
        inner[[0, -1]] = 0.0
        self.others = self.matrices.sum(axis=0) + np.diag(precision) - inner * self.matrices
        self.other_rights = (
            self.rights.sum(axis=0) + precision * prior_mean - inner[:, 0] * self.rights
        )

    def _columns_of(self, sizes: Mapping[str, tuple[str, int]]) -> Indices:
        chosen = []
        for name in self.names:
            kind, size = sizes[name]
            chosen += [self.columns[name, kind][:size], self.jumps[name]]
        return np.concatenate([*chosen, self.shared])

    def score(self, sizes: Mapping[str, tuple[str, int]]) -> float:
        """Return the cost of predicting inner magnifications and of fitting the outermost ones."""
        columns = self._columns_of(sizes)
        solution = solve_scaled(
            _blocks(self.others, columns, columns), self.other_rights[:, columns]
        )
        bent = _times(_blocks(self.matrices, columns, columns), solution)
        return float(np.sum((0.5 * bent - self.rights[:, columns]) * solution))

    def changes(
        self,
        sizes: Mapping[str, tuple[str, int]],
        options: Mapping[str, Sequence[tuple[str, int]]],
    ) -> dict[tuple[str, tuple[str, int]], float]:
        """Return by how much the score falls where a function gets one of its options, for all functions and options.

        All options of a function are blocks that are added to the same rest, whose equations are solved once.
        """
        columns = self._columns_of(sizes)
        # Functions that are not there share one rest.
        named: dict[bytes, tuple[Indices, list[str]]] = {}
        for name in options:
            kind, size = sizes[name]
            rest = columns[~np.isin(columns, self.columns[name, kind][:size])]
            named.setdefault(rest.tobytes(), (rest, []))[1].append(name)
        falls: dict[tuple[str, tuple[str, int]], float] = {}
        for rest, names in named.values():
            blocks: dict[tuple[str, str], list[int]] = {}
            for name in names:
                for kind, size in (sizes[name], *options[name]):
                    blocks.setdefault((name, kind), []).append(size)
            scores = self._scores_beside(rest, blocks)
            for name in names:
                now = scores[name, sizes[name]]
                falls |= {(name, option): now - scores[name, option] for option in options[name]}
        return falls

    def _scores_beside(
        self, rest: Indices, blocks: Mapping[tuple[str, str], Sequence[int]]
    ) -> dict[tuple[str, tuple[str, int]], float]:
        """Return the scores of the columns ``rest`` and the first so many columns of a function of a kind, beyond the
        score of the rest alone; ``blocks`` tells how many, of each.

        With the block inverse, the rest moves by ``-pulled`` times the coefficients that are added.
        """
        added = np.concatenate([self.columns[key][: max(counts)] for key, counts in blocks.items()])
        coupling = _blocks(self.others, rest, added)
        solved = solve_scaled(
            _blocks(self.others, rest, rest),
            np.concatenate([coupling, self.other_rights[:, rest, None]], axis=2),
        )
        pulled, solution = solved[:, :, :-1], solved[:, :, -1]
        right = self.other_rights[:, added] - _times(np.swapaxes(coupling, 1, 2), solution)
        # Slope and curvature of the cost of the magnification that was left out.
        of_rest = _blocks(self.matrices, rest, rest)
        mixed = np.swapaxes(_blocks(self.matrices, rest, added), 1, 2)
        slope = _times(mixed, solution) - self.rights[:, added]
        slope -= _times(np.swapaxes(pulled, 1, 2), _times(of_rest, solution) - self.rights[:, rest])
        bent = of_rest @ pulled
        scores, first = {}, 0
        for (name, kind), counts in blocks.items():
            own = slice(first, first + max(counts))
            transposed = np.swapaxes(pulled[:, :, own], 1, 2)
            left = _blocks(self.others, added[own], added[own]) - transposed @ coupling[:, :, own]
            both = mixed[:, own] @ pulled[:, :, own]
            curvature = transposed @ bent[:, :, own] - both - np.swapaxes(both, 1, 2)
            curvature += _blocks(self.matrices, added[own], added[own])
            for n in counts:
                few = slice(first, first + n)
                change = solve_scaled(left[:, :n, :n], right[:, few])
                cost = 0.5 * _times(curvature[:, :n, :n], change) + slope[:, few]
                scores[name, (kind, n)] = float(np.sum(cost * change))
            first = own.stop
        return scores


def _blocks(matrices: Array, rows: Indices, columns: Indices) -> Array:
    """(M, r, c) some rows and columns of matrices (M, K, K)."""
    return np.asarray(matrices[:, rows[:, None], columns])


def _times(matrices: Array, vectors: Array) -> Array:
    """(M, p) products of matrices (M, p, q) and vectors (M, q)."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


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
    cross-validation gains more than :data:`COEFFICIENT_GAIN` for each, and removed where that
    costs less. One of ``terms`` may have none, and needs more of a gain for the first. The ``current``
    choice stays unless another one is clearly better.
    """
    candidates = Candidates(summary, setup, functions, (*free, *terms))
    # Each magnification is predicted from the others. Two are only fitted, by a straight line.
    known = len(setup.magnifications)
    most = known if known == 2 else known - 1
    limits = {name: min(SIZE_MAX, most) for name in free}
    limits |= {name: min(_most_of(name), max(most, 1)) for name in terms}
    sizes = {name: (own.kind, own.smooth_size) for name, own in functions.items()}
    sizes.update(dict.fromkeys(free, ("chebyshev_log", 1)))
    sizes.update(dict.fromkeys(terms, ("chebyshev_log", 0)))
    while True:
        falls = candidates.changes(sizes, _moves(sizes, limits, terms))
        better = _find_better(candidates, sizes, falls, free)
        if better is None:
            break
        sizes = better
    if current is not None:
        kept = {**sizes, **current}
        more = sum(kept[name][1] - sizes[name][1] for name in free) * COEFFICIENT_GAIN
        more += sum(_price(kept[name][1]) - _price(sizes[name][1]) for name in terms)
        if candidates.score(kept) + more < candidates.score(sizes) + CHOICE_GAIN:
            sizes = kept
    return {name: sizes[name] for name in (*free, *terms)}


def _find_better(
    candidates: Candidates,
    sizes: Mapping[str, tuple[str, int]],
    falls: Mapping[tuple[str, tuple[str, int]], float],
    free: Sequence[str],
) -> dict[str, tuple[str, int]] | None:
    """Return the sizes after the change that gains most; None where none gains.

    What a change gains is known to a part of what its function explains. The score itself decides.
    """

    def price(name: str, option: tuple[str, int]) -> float:
        return _cost(option) if name in free else _price(option[1])

    dearer = {
        (name, option): price(name, option) - price(name, sizes[name]) for name, option in falls
    }
    # Below, it may be rounding.
    score, least = candidates.score(sizes), 1e-6
    for change in sorted(falls, key=lambda change: dearer[change] - falls[change]):
        if falls[change] - dearer[change] <= least:
            return None
        changed = dict([*sizes.items(), change])
        if score - candidates.score(changed) - dearer[change] > least:
            return changed
    return None


def _most_of(name: str) -> int:
    """Return the most coefficients that a function may have."""
    return SCAN_SIZE_MAX if name in SCAN_NAMES else SIZE_MAX


def _cost(option: tuple[str, int]) -> float:
    """Return what a function that is always there must gain: that in g itself somewhat more, as it is less natural."""
    kind, size = option
    return COEFFICIENT_GAIN * (size + (kind != "chebyshev_log"))


def _price(size: int, first: float = TERM_GAIN) -> float:
    """Return what a term of so many coefficients must gain, ``first`` for the first of them."""
    return 0.0 if size == 0 else first + COEFFICIENT_GAIN * (size - 1)


def _moves(
    sizes: Mapping[str, tuple[str, int]], limits: Mapping[str, int], terms: Sequence[str]
) -> dict[str, list[tuple[str, int]]]:
    """Return to what each function may be changed in one step. A constant is the same in both kinds."""
    moves = {}
    for name, limit in limits.items():
        least = 0 if name in terms else 1
        kinds = _POLYNOMIALS[:1] if name in SCAN_NAMES else _POLYNOMIALS
        options = [(kind, sizes[name][1] + more) for kind in kinds for more in (-1, 0, 1, 2)]
        options = [o for o in options if least <= o[1] <= limit and o != sizes[name]]
        moves[name] = [o for o in options if o[1] > 1 or o[0] == _POLYNOMIALS[0]]
    return moves


def excess_px(setup: Setup, adjustment: Adjustment) -> float:
    """Return the scatter of the corners of an adjustment beyond their own sigmas."""
    residuals = adjustment.result.residuals_px
    return estimate_excess_sigma_px(setup.views, residuals, 6 * len(setup.views))


def _anneal(setup: Setup, noisy: Setup, adjustment: Adjustment) -> tuple[Setup, Adjustment]:
    """Believe the corners as far as the model explains them, step by step; return the last setup and adjustment."""
    level = max(view.excess_px for view in noisy.views)
    for _ in range(BELIEF_STEPS):
        excess = min(excess_px(setup, adjustment), level)
        # The first step brings in what the stage says.
        if np.isfinite(noisy.tempering) and (level == 0.0 or excess > BELIEF_STEP_MIN * level):
            break
        level, noisy = excess, tempered(setup, excess)
        spread = update_components(noisy, adjustment.problem, adjustment.result)
        adjustment = select_and_adjust(noisy, adjustment.functions, adjustment.result.state, spread)
    return noisy, adjustment


def select_and_adjust(
    setup: Setup,
    functions: Functions,
    state: State,
    spread: VarianceComponents,
    sizes: Mapping[str, tuple[str, int]] | None = None,
    *,
    always: Sequence[str] | None = None,
    choose_terms: bool = True,
) -> Adjustment:
    """Choose the number of coefficients of every function, and further terms of the camera but for the
    :data:`LATE_TERMS`, until the choice no longer changes.

    The functions ``always`` are never removed; by default they are those of :func:`smooth_names`.
    Products that are there stay. Beside a residual field the terms stay as they are, since it takes the place of those
    that are not there.
    """
    always = smooth_names(functions) if always is None else always
    always = (*always, *(name for name in LATE_TERMS if name in functions))
    spread = limit_lattices(setup, spread)
    problem = build_problem(setup, functions, setup.views, spread)
    state = replace(state, theta=stack_theta(setup, functions, state))
    result, _ = adjust_with_other_poses(setup, functions, spread, problem, state)
    converged, rounds = False, 0
    terms: tuple[str, ...] = ()
    if choose_terms and not setup.priors.is_wide:
        offered = dict.fromkeys((*DECENTRING, *TERM_NAMES))
        terms = tuple(name for name in offered if name not in (*always, *LATE_TERMS))
    while rounds < CHOICE_ROUNDS and not converged:
        rounds += 1
        every = build_problem(setup, functions, setup.views, spread, candidates=(*always, *terms))
        summary = Summary.of(every, refine(every, result.state, max_iterations=0))
        kept = None if setup.tempering == 1.0 and rounds <= FREE_ROUNDS else sizes
        chosen = select_functions(summary, setup, functions, always, terms, kept)
        if chosen == sizes:
            result, count = adjust_with_other_poses(setup, functions, spread, problem, result.state)
            converged = count == 0
            continue
        sizes = chosen
        functions = refit_functions(with_coefficients(functions, result.state.theta), chosen)
        spread = limit_lattices(setup, update_components(setup, problem, result))
        problem = build_problem(setup, functions, setup.views, spread)
        state = replace(result.state, theta=stack_theta(setup, functions, result.state))
        result = refine_coarsely(problem, state)
    functions = with_coefficients(functions, result.state.theta)
    return Adjustment(functions, problem, result, spread, rounds, converged)


def add_late_terms(
    setup: Setup, adjustment: Adjustment, *, always: Sequence[str] | None = None
) -> Adjustment:
    """Return the adjustment with those :data:`LATE_TERMS` that explain what it leaves; unchanged where none does.

    With a radial distortion the products are much like another centre, and the fifth order is much like coils that are
    not linear, so that offered with all other terms, where a fit began would decide between the two. All other
    functions keep their numbers of coefficients while these are judged, and choose them again after it. The products
    are judged first: a centre far off, which takes their place, looks like the fifth order.
    """
    for names in (PRODUCTS, ("xi_r4",)):
        adjustment = _add_terms(setup, adjustment, names, always)
    return adjustment


def _add_terms(
    setup: Setup, adjustment: Adjustment, names: Sequence[str], always: Sequence[str] | None
) -> Adjustment:
    functions, spread = adjustment.functions, adjustment.spread
    offered = [name for name in names if name not in functions]
    if setup.priors.is_wide or not offered:
        return adjustment
    every = build_problem(setup, functions, setup.views, spread, candidates=offered)
    summary = Summary.of(every, refine(every, adjustment.result.state, max_iterations=0))
    candidates = Candidates(summary, setup, functions, offered)
    now = {name: (own.kind, own.smooth_size) for name, own in functions.items()}
    most = min(SCAN_SIZE_MAX, max(len(setup.magnifications) - 1, 1))
    tried = [
        dict(zip(offered, (("chebyshev_log", count) for count in counts), strict=True))
        for counts in itertools.product(range(most + 1), repeat=len(offered))
    ]

    def cost(added: Mapping[str, tuple[str, int]]) -> float:
        price = sum(_price(count, LATE_TERM_GAIN) for _, count in added.values())
        return candidates.score(now | dict(added)) + price

    none, *more = tried
    # A lens has the fifth order with the same sign at all magnifications. What gains by a change of sign alone stands
    # for functions that few magnifications leave too straight.
    if offered == ["xi_r4"] and cost(more[0]) >= cost(none):
        return adjustment
    best = min(tried, key=cost)
    if best is none:
        return adjustment
    # Without coefficients there is no function.
    functions = refit_functions(functions, now | best)
    return select_and_adjust(setup, functions, adjustment.result.state, spread, always=always)


def _grid_pattern(setup: Setup, adjustment: Adjustment, field: ResidualField) -> GridPattern | None:
    """Return the pattern of displacements that turns with the grid, or None if there is none."""
    system = field_system(setup, adjustment.problem, adjustment.result, field, of_grid=True)
    choice = choose_field(setup, system, field)
    return GridPattern(system, choice) if choice.worthwhile else None


def _add_field(
    setup: Setup, adjustment: Adjustment, *, always: bool
) -> tuple[Adjustment, FittedField | None, GridPattern | None]:
    """Add a residual field, or return the adjustment unchanged where it is not worthwhile, or where rounding leaves no
    equations that can be solved, unless there is one ``always``.
    """
    try:
        return _fit_field(setup, adjustment, always=always)
    except UnusableCalibrationError:
        if always:
            raise
        # What cannot be predicted from the rest does not show that there is a field.
        return adjustment, None, None


def _fit_field(
    setup: Setup, adjustment: Adjustment, *, always: bool
) -> tuple[Adjustment, FittedField | None, GridPattern | None]:
    """Fit a residual field, or return the adjustment unchanged where it is not worthwhile.

    What stays with the image is the microscope's; what turns with the grid is the grid's, and no
    field is added for it. The one that predicts views that were left out better decides. Nor is a
    field added that leaves most of the misfit: the lattices of the views may differ by quarter
    turns and by whole squares, so that an irregular grid has no pattern of its own either.

    Each turn solves for camera and field together, and then adjusts poses and camera to
    observations that the field has corrected. In the first turns the strength of the field and the
    numbers of coefficients of the functions are chosen again.
    """
    field = blank = blank_field(setup)
    start, before = adjustment, setup
    for turn in range(FIELD_ROUNDS):
        if np.any(adjustment.result.lost):
            # A field that moves corners to where the camera shows nothing is none.
            return start, None, None
        system = field_system(setup, adjustment.problem, adjustment.result, field)
        if turn < CHOOSING_ROUNDS:
            choice = choose_field(setup, system, blank)
            if not (choice.worthwhile or always):
                return start, None, None
            if turn == 0 and setup.shared and not always:
                pattern = _grid_pattern(setup, adjustment, field)
                of_grid = pattern is not None and pattern.choice.gain > choice.gain
                if of_grid or choice.explained < EXPLAINED_MIN:
                    return start, None, pattern
        theta, field = solve_field(system, choice.prior, blank)
        after = undo_field(setup, field)
        adjustment = _readjust(after, adjustment, theta, choosing=turn < CHOOSING_ROUNDS)
        pairs = zip(before.views, after.views, strict=True)
        change = np.concatenate([a.image_xy - b.image_xy for b, a in pairs])
        before = after
        if turn >= CHOOSING_ROUNDS and np.sqrt(np.mean(change**2)) < FIELD_SETTLED_PX:
            return adjustment, FittedField(field, choice, system, True), None
    return adjustment, FittedField(field, choice, system, False), None


def _current_sizes(adjustment: Adjustment) -> dict[str, tuple[str, int]]:
    own = adjustment.functions
    return {name: (own[name].kind, own[name].smooth_size) for name in smooth_names(own)}


def _readjust(setup: Setup, adjustment: Adjustment, theta: Array, *, choosing: bool) -> Adjustment:
    """Adjust to other views from other coefficients; ``choosing`` selects their number again."""
    functions = with_coefficients(adjustment.functions, theta)
    spread = update_components(setup, adjustment.problem, adjustment.result)
    state = replace(adjustment.result.state, theta=theta)
    if choosing:
        sizes = _current_sizes(adjustment)
        return select_and_adjust(setup, functions, state, spread, sizes, choose_terms=False)
    problem = build_problem(setup, functions, setup.views, spread)
    result = refine_coarsely(problem, state)
    functions = with_coefficients(functions, result.state.theta)
    return replace(adjustment, functions=functions, problem=problem, result=result, spread=spread)


@dataclass(frozen=True)
class Selection:
    """What was chosen.

    Attributes
    ----------
    setup
        The views as they were observed.
    adjustment
        The functions with their numbers of coefficients.
    field, pattern
        The residual field, and what is irregular about the grid, or None.
    excess_px
        1-sigma per axis, px, by which all corners scatter beyond their own.
    """

    setup: Setup
    adjustment: Adjustment
    field: FittedField | None
    pattern: GridPattern | None
    excess_px: float


def select(started: Start, residual: str) -> Selection:
    """Choose terms, numbers of coefficients, and whether there is a residual field.

    Parameters
    ----------
    started
        The first state.
    residual
        Whether there may be a residual field: ``"on"``, ``"off"``, or ``"auto"``, where cross-validation decides.
    """
    setup, noisy = started.setup, started.tempered
    adjustment = select_and_adjust(noisy, started.functions, started.state, started.spread)
    noisy, adjustment = _anneal(setup, noisy, adjustment)
    field, pattern = None, None
    if residual == "on":
        adjustment, field, pattern = _add_field(noisy, adjustment, always=True)
        return Selection(setup, adjustment, field, pattern, excess_px(setup, adjustment))
    plain = noisy, adjustment
    more = add_late_terms(noisy, adjustment)
    if more is not adjustment:
        noisy, adjustment = _anneal(setup, noisy, more)
    if residual == "auto":
        adjustment, field, pattern = _add_field(noisy, adjustment, always=False)
        if field is not None and any(name in adjustment.functions for name in PRODUCTS):
            # What the products stood for is a part of what the field describes, which has them among its patterns.
            # Where there is no solution without them, they stay.
            with suppress(UnusableCalibrationError):
                first = _add_terms(*plain, ("xi_r4",), None)
                instead = _add_field(plain[0], first, always=True)
                if instead[1] is not None:
                    adjustment, field, pattern = instead
    return Selection(setup, adjustment, field, pattern, excess_px(setup, adjustment))
