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

"""One adjustment of a whole ladder: functions of the camera, jumps, visits, slope and poses together.

The covariance of the calibration of the grid is the prior of what it knows. The drift within the frames has a spread
that is estimated with the rest, as the spreads of a calibration are. A jump of the scale between two magnifications is
looked for where none is expected: by how much the cost would fall if it were free, as for a term of the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from semcal_ros.core.arrays import Array, equilibrate, invert_scaled, solve_scaled
from semcal_ros.core.calibration.estimator.thresholds import DAMPING_MIN
from semcal_ros.core.calibration.estimator.trust_region import Descent, DescentStatus, Step, descend
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.ladder.residuals import Link, pair_rows, pair_values
from semcal_ros.core.ladder.thresholds import (
    COMPARING_STEPS,
    CREEP_SIGMA,
    DRIFT_FIRST_PX,
    DRIFT_MAX,
    DRIFT_MIN_PX,
    DRIFT_ROUNDS,
    DRIFTS_TRIED,
    FIT_STEPS,
    FIT_TOLERANCE,
    GAUGE,
    JUMP_GAIN,
    JUMPS_MAX,
    LINK_FACTOR,
    POSE_SIZE,
    SETTLED_DRIFT_PX,
    TURNED_RAD,
    UNEXPLAINED_RATIO,
    VIBRATION_PX,
)
from semcal_ros.core.ladder.unknowns import LadderSetup, LadderState, jump_sigmas, slope_sigma
from semcal_ros.core.wording import counted


@dataclass(frozen=True)
class DriftSpread:
    """1-sigma of the drift during a frame per axis, px of the finest magnification.

    Attributes
    ----------
    steady_px
        Of what all pictures of a visit have in common.
    change_px
        Of what each has beside that.
    """

    steady_px: float
    change_px: float


@dataclass(frozen=True, eq=False)
class LadderFit:
    """An adjusted ladder.

    Attributes
    ----------
    state
        The unknowns.
    covariance
        (N, N) of the unknowns, with the excess of the residuals.
    variance_factor
        Mean square of the residuals over their sigmas, for the degrees of freedom.
    link_factors
        The same of each link.
    drift
        Spread of the drift within a frame.
    jumps
        Which of the jumps were found.
    kept
        Which of the links were used.
    descent
        How it ended.
    """

    state: LadderState
    covariance: Array
    variance_factor: float
    link_factors: Array
    drift: DriftSpread
    jumps: tuple[int, ...]
    kept: tuple[int, ...]
    descent: Descent[LadderState]


def drift_sigmas(setup: LadderSetup, drift_sigma_px: float) -> Array:
    """(M,) 1-sigma of the change of the drift in each picture, px, where it is ``drift_sigma_px`` in the finest.

    A specimen drifts by as many metres at all magnifications.
    """
    magnifications = np.array([picture.magnification for picture in setup.pictures])
    return np.hypot(drift_sigma_px * magnifications / magnifications.max(), VIBRATION_PX)


def prior_information(setup: LadderSetup, drift: DriftSpread, jumps: tuple[int, ...]) -> Array:
    """(N,) inverse variances of the priors, all of mean zero but those of the bends' start."""
    components, bends, steps, visits, slopes, poses, drifts, creep = setup.bounds
    information = np.zeros(setup.size)
    information[components] = 1.0
    information[bends] = 1.0 / setup.bend_sigmas**2
    information[steps] = 1.0 / jump_sigmas(setup, jumps) ** 2
    information[visits] = 1.0 / setup.visit_sigma**2
    information[slopes] = 1.0 / slope_sigma() ** 2
    information[creep] = 1.0 / CREEP_SIGMA**2
    own = information[poses].reshape(-1, POSE_SIZE)
    own[:, 3:] = drift_sigmas(setup, drift.change_px)[:, None] ** -2
    for visit, spread in zip(setup.visit_of, drift_sigmas(setup, drift.steady_px), strict=True):
        start = drifts.start + 2 * int(visit)
        information[start : start + 2] = spread**-2
    own[0, 0], own[0, 1:3] = GAUGE[0] ** -2, GAUGE[1] ** -2
    information[poses] = own.ravel()
    return information


def share_noise(setup: LadderSetup, links: Sequence[Link]) -> list[Link]:
    """Give links the share of what they tell.

    The noise of a picture is in all of its links. Of n pictures of one place, each with the variance one, the
    n (n - 1)/2 differences with the variance two, taken for independent, would tell as much as n (n - 1)/4 of them; the
    pictures tell as much as n - 1. So each difference counts by 4/n, where n pictures see a place.
    """
    full = max(len(link) for link in links)
    covered = np.ones(len(setup.pictures))
    for link in links:
        for number, area in zip((link.first, link.second), _areas(setup, link), strict=True):
            covered[number] += min(len(link) * area / full, 1.0)
    return [
        replace(link, share=min(8.0 / float(covered[link.first] + covered[link.second]), 1.0))
        for link in links
    ]


def _areas(setup: LadderSetup, link: Link) -> tuple[float, float]:
    """How much larger a block is in either picture than in the coarser one, by area."""
    first, second = (setup.pictures[k].magnification for k in (link.first, link.second))
    return 1.0, (second / first) ** 2


def add_up(state: LadderState, links: Sequence[Link]) -> tuple[Array, Array, Array]:
    """Normal matrix (N, N) and right-hand side (N,), with the shares of the links and without priors; and (L,) the
    sums of squares of the links.
    """
    size = state.setup.size
    matrix, right = np.zeros((size, size)), np.zeros(size)
    squares = np.empty(len(links))
    for number, link in enumerate(links):
        rows = pair_rows(state, link)
        at = np.ix_(rows.columns, rows.columns)
        matrix[at] += link.share * (rows.jacobian.T @ rows.jacobian)
        right[rows.columns] += link.share * (rows.jacobian.T @ rows.values)
        squares[number] = rows.values @ rows.values
    return matrix, right, squares


def adjust(
    setup: LadderSetup,
    state: LadderState,
    links: Sequence[Link],
    on_progress: Callable[[int], object] = lambda _: None,
) -> LadderFit:
    """Adjust a ladder from a start.

    A drift of more than a pixel within a frame is believed where it explains what a smaller one does not: otherwise it
    would also be an aspect or a skew, and whatever else is not in the model would be taken for it.

    Raises
    ------
    CalibrationError
        If the adjustment does not converge, or if without the pairs that contradict the others some pictures have none.
    """
    fit = _adjust(setup, state, links, on_progress, DRIFT_MAX * setup.image_size[1])
    if max(fit.drift.steady_px, fit.drift.change_px) <= SETTLED_DRIFT_PX:
        return fit
    settled = _adjust(setup, state, links, on_progress, SETTLED_DRIFT_PX)
    is_as_good = settled.variance_factor <= UNEXPLAINED_RATIO * fit.variance_factor
    return settled if is_as_good and len(settled.kept) >= len(fit.kept) else fit


def cost_after_few_steps(setup: LadderSetup, state: LadderState, links: Sequence[Link]) -> float:
    """Return half the sum of squares near the minimum, to compare starts; infinite where there is no camera."""
    drift = DriftSpread(DRIFT_FIRST_PX, DRIFT_FIRST_PX)
    return _descend(setup, state, share_noise(setup, links), drift, (), COMPARING_STEPS).cost


def _adjust(
    setup: LadderSetup,
    state: LadderState,
    links: Sequence[Link],
    on_progress: Callable[[int], object],
    most_drift_px: float,
) -> LadderFit:
    """Adjust with a spread of the drift of at most so many px."""
    jumps: tuple[int, ...] = ()
    kept = tuple(range(len(links)))
    first = min(DRIFT_FIRST_PX, most_drift_px)
    drift = DriftSpread(first, first)
    while True:
        used = share_noise(setup, [links[k] for k in kept])
        state, drift, descent = _settle(setup, state, used, drift, jumps, most_drift_px)
        on_progress(len(jumps) + 1)
        matrix, right, squares = add_up(state, used)
        found = (
            None
            if len(jumps) == JUMPS_MAX
            else _find_jump(setup, state, matrix, right, drift, jumps)
        )
        if found is not None:
            jumps = tuple(sorted((*jumps, found)))
            continue
        factors = squares / np.array([2.0 * len(link) for link in used])
        bad = factors > LINK_FACTOR * float(np.median(factors))
        if not np.any(bad):
            break
        kept = tuple(k for k, wrong in zip(kept, bad, strict=True) if not wrong)
        _refuse_loose_pictures(setup, links, kept)
    if descent.status in (DescentStatus.ITERATION_LIMIT, DescentStatus.SINGULAR):
        raise CalibrationError(
            f"an adjustment of {len(kept)} pairs of pictures that did not end: {descent.status.value}",
            expected="pictures that agree on one specimen at rest",
            do="use a specimen that neither moves nor charges, and record the ladder again with more overlap",
        )
    information = prior_information(setup, drift, jumps)
    whole = matrix + np.diag(information)
    inverse = invert_scaled(whole)
    # The unknowns that the pictures determine, not the priors, take degrees of freedom.
    taken = float(np.trace(inverse @ matrix))
    count = 2.0 * sum(len(link) for link in used)
    factor = float(squares.sum()) / max(count - taken, 1.0)
    # The part of the covariance that comes from the residuals grows with their excess; the priors stay.
    excess = max(factor, 1.0)
    covariance = invert_scaled(matrix / excess + np.diag(information))
    return LadderFit(state, covariance, factor, factors, drift, jumps, kept, descent)


def _refuse_loose_pictures(setup: LadderSetup, links: Sequence[Link], kept: Sequence[int]) -> None:
    """Refuse pictures of which a part has no pair with the others any more: nothing would tell where it lies."""
    size = len(setup.pictures)
    pairs = np.array([(links[k].first, links[k].second) for k in kept], dtype=np.intp).reshape(
        -1, 2
    )
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(size, size))
    _, part = connected_components(graph, directed=False)
    loose = size - int(np.max(np.bincount(part)))
    if loose:
        raise CalibrationError(
            f"pairs of pictures that contradict each other: without the {len(links) - len(kept)} of "
            f"{counted(len(links), 'pair')} that do most, {counted(loose, 'picture')} of {size} cannot be placed",
            expected="pictures that agree on one specimen at rest",
            do="use a specimen that neither repeats itself, moves nor charges",
        )


def _settle(
    setup: LadderSetup,
    state: LadderState,
    links: Sequence[Link],
    drift: DriftSpread,
    jumps: tuple[int, ...],
    most_drift_px: float,
) -> tuple[LadderState, DriftSpread, Descent[LadderState]]:
    """Adjust, with the spread of the drift within the frames."""
    for _ in range(DRIFT_ROUNDS):
        descent = _descend(setup, state, links, drift, jumps)
        state, before = descent.state, drift
        matrix, right, _ = add_up(state, links)
        drift = _most_likely_drift(setup, state, matrix, right, jumps, most_drift_px)
        if drift == before:
            break
    return state, drift, descent


def _most_likely_drift(
    setup: LadderSetup,
    state: LadderState,
    matrix: Array,
    right: Array,
    jumps: tuple[int, ...],
    most_drift_px: float,
) -> DriftSpread:
    """The spread of the drift that makes the correspondences most likely, whatever the unknowns are.

    Minus twice the logarithm of the marginal likelihood is, but for a constant, x' P x - g' H^-1 g + log det H
    - log det P, with the prior ``P``, the equations ``H`` with it, and the gradient ``g`` at the state ``x``. Another
    spread moves the unknowns by little, so that the equations of the pictures stay as they are. All spreads are tried,
    since there may be more than one minimum.
    """
    spreads = np.geomspace(DRIFT_MIN_PX, most_drift_px, DRIFTS_TRIED).tolist()
    # Without a turned scan a steady drift is a stretch of the camera, and its spread is that of the changes.
    steady = spreads if _has_turns(setup, state) else [None]
    best, least = DriftSpread(spreads[0], spreads[0]), np.inf
    for change in spreads:
        for common in steady:
            drift = DriftSpread(change if common is None else common, change)
            information = prior_information(setup, drift, jumps)
            scaled, scale = equilibrate(matrix + np.diag(information))
            factor = np.linalg.cholesky(scaled)
            gradient = right - information * state.values
            half = solve_triangular(factor, scale * gradient, lower=True)
            cost = 2.0 * float(np.sum(np.log(np.diag(factor))) - np.sum(np.log(scale)))
            cost += float(state.values**2 @ information) - float(half @ half)
            cost -= float(np.sum(np.log(information[information > 0.0])))
            if cost < least:
                best, least = drift, cost
    return best


def _has_turns(setup: LadderSetup, state: LadderState) -> bool:
    """Whether a third of the visits has a scan that is turned against the others."""
    angles = state.poses[:, 0]
    turned = 0
    for visit in range(len(setup.visits)):
        own = angles[setup.visit_of == visit]
        turned += bool(np.any(np.abs(np.angle(np.exp(1j * (own - own[0])))) > TURNED_RAD))
    return 3 * turned >= len(setup.visits)


def _descend(
    setup: LadderSetup,
    state: LadderState,
    links: Sequence[Link],
    drift: DriftSpread,
    jumps: tuple[int, ...],
    most_steps: int = FIT_STEPS,
) -> Descent[LadderState]:
    information = prior_information(setup, drift, jumps)

    def cost_of(candidate: LadderState) -> float:
        try:
            with np.errstate(all="ignore"):
                total = sum(
                    link.share * float(np.sum(pair_values(candidate, link) ** 2)) for link in links
                )
        except InvalidValueError:
            # A step to where there is no camera.
            return float("inf")
        prior = float(candidate.values**2 @ information)
        cost = 0.5 * (total + prior)
        return cost if np.isfinite(cost) else float("inf")

    def linearise(current: LadderState) -> Callable[[float], Step[LadderState] | None]:
        matrix, right, _ = add_up(current, links)
        whole = matrix + np.diag(information)
        gradient = right - information * current.values

        def solve(damping: float) -> Step[LadderState] | None:
            try:
                change = solve_scaled(whole, gradient, damping)
            except np.linalg.LinAlgError:
                return None
            candidate = LadderState(setup, current.values + change)
            predicted = float(gradient @ change - 0.5 * change @ whole @ change)
            return Step(candidate, cost_of(candidate), predicted)

        return solve

    return descend(
        state,
        cost_of(state),
        linearise,
        max_iterations=most_steps,
        tolerance=FIT_TOLERANCE,
        # The correspondences give poses to a fraction of a pixel, from where the problem is nearly linear.
        first_damping=DAMPING_MIN,
    )


def _find_jump(
    setup: LadderSetup,
    state: LadderState,
    matrix: Array,
    right: Array,
    drift: DriftSpread,
    jumps: tuple[int, ...],
) -> int | None:
    """The jump that would lower the cost most, if by enough."""
    columns = setup.bounds[2]
    free = [k for k in range(columns.stop - columns.start) if k not in jumps]
    if not free:
        return None
    information = prior_information(setup, drift, jumps)
    rest = np.ones(setup.size, dtype=bool)
    rest[[columns.start + k for k in free]] = False
    whole = (matrix + np.diag(information))[np.ix_(rest, rest)]
    gradient = right - information * state.values
    scaled, scale = equilibrate(whole)
    factor = np.linalg.cholesky(scaled)
    gains = []
    for k in free:
        column = columns.start + k
        # What is left of a jump when everything else follows it.
        half = np.linalg.solve(factor, scale * matrix[rest, column])
        curvature = matrix[column, column] - float(half @ half)
        score = right[column] - float(half @ np.linalg.solve(factor, scale * gradient[rest]))
        gains.append(score**2 / curvature if curvature > 0.0 else 0.0)
    best = int(np.argmax(gains))
    return free[best] if gains[best] > JUMP_GAIN else None
