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
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, equilibrate, invert_scaled, solve_scaled
from semcal_ros.core.calibration.estimator.trust_region import (
    MIN_DAMPING,
    Descent,
    DescentStatus,
    Step,
    descend,
)
from semcal_ros.core.errors import CalibrationError
from semcal_ros.core.ladder.residuals import Link, pair_rows, pair_values
from semcal_ros.core.ladder.unknowns import (
    POSE_SIZE,
    LadderSetup,
    LadderState,
    jump_sigmas,
    slope_sigma,
)

__all__ = ["LadderFit", "add_up", "adjust", "prior_information"]

# Gauss-Newton steps; from the poses of the correspondences five are enough.
_ITERATIONS, _TOLERANCE = 30, 1e-9
# A first spread of the drift in a frame, px, and bounds: half a pixel is what a good stage does, and more than a tenth
# of the picture is no drift. The spread is estimated until it changes by less than 2 %.
_FIRST_DRIFT_PX, _LEAST_DRIFT_PX, _MOST_DRIFT = 1.0, 0.03, 0.1
_SPREAD_ROUNDS, _SPREAD_STEPS, _SPREAD_CHANGE = 3, 200, 0.02
# A jump must lower twice the cost by this: of 12 places without one, 3 in 10 000 do so by chance.
_JUMP_GAIN = 20.0
_MOST_JUMPS = 4
# The first picture has its place: its turn (rad) and shift (px) are fixed to these.
_GAUGE = (1e-9, 1e-7)
# Links whose mean square residual exceeds that of the others by this factor are left out: chance makes 2.
_BAD_LINK = 9.0


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
    drift_sigma_px
        Spread of the drift within a frame, px.
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
    drift_sigma_px: float
    jumps: tuple[int, ...]
    kept: tuple[int, ...]
    descent: Descent[LadderState]


def prior_information(setup: LadderSetup, drift_sigma_px: float, jumps: tuple[int, ...]) -> Array:
    """(N,) inverse variances of the priors, all of mean zero but those of the bends' start."""
    components, bends, steps, visits, slopes, poses = setup.bounds
    information = np.zeros(setup.size)
    information[components] = 1.0
    information[bends] = 1.0 / setup.bend_sigmas**2
    information[steps] = 1.0 / jump_sigmas(setup, jumps) ** 2
    information[visits] = 1.0 / setup.visit_sigma**2
    information[slopes] = 1.0 / slope_sigma() ** 2
    own = information[poses].reshape(-1, POSE_SIZE)
    own[:, 3:] = 1.0 / drift_sigma_px**2
    own[0, 0], own[0, 1:3] = _GAUGE[0] ** -2, _GAUGE[1] ** -2
    information[poses] = own.ravel()
    return information


def add_up(state: LadderState, links: Sequence[Link]) -> tuple[Array, Array, Array]:
    """Normal matrix (N, N), right-hand side (N,) and sum of squares of each link, without priors."""
    size = state.setup.size
    matrix, right = np.zeros((size, size)), np.zeros(size)
    squares = np.empty(len(links))
    for number, link in enumerate(links):
        rows = pair_rows(state, link)
        at = np.ix_(rows.columns, rows.columns)
        matrix[at] += rows.jacobian.T @ rows.jacobian
        right[rows.columns] += rows.jacobian.T @ rows.values
        squares[number] = rows.values @ rows.values
    return matrix, right, squares


def adjust(
    setup: LadderSetup,
    state: LadderState,
    links: Sequence[Link],
    on_progress: Callable[[int], object] = lambda _: None,
) -> LadderFit:
    """Adjust a ladder from a start.

    Raises
    ------
    CalibrationError
        If the adjustment does not converge.
    """
    jumps: tuple[int, ...] = ()
    kept = tuple(range(len(links)))
    drift = _FIRST_DRIFT_PX
    while True:
        used = [links[k] for k in kept]
        state, drift, descent = _settle(setup, state, used, drift, jumps)
        on_progress(len(jumps) + 1)
        matrix, right, squares = add_up(state, used)
        found = (
            None
            if len(jumps) == _MOST_JUMPS
            else _find_jump(setup, state, matrix, right, drift, jumps)
        )
        if found is not None:
            jumps = tuple(sorted((*jumps, found)))
            continue
        factors = squares / np.array([2.0 * len(link) for link in used])
        bad = factors > _BAD_LINK * float(np.median(factors))
        if not np.any(bad):
            break
        kept = tuple(k for k, wrong in zip(kept, bad, strict=True) if not wrong)
    if descent.status in (DescentStatus.ITERATION_LIMIT, DescentStatus.SINGULAR):
        raise CalibrationError(
            f"an adjustment of {len(kept)} pairs of pictures that did not end: {descent.status.value}",
            expected="pictures that agree on one specimen",
            do="record the ladder again, with more overlap",
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


def _settle(
    setup: LadderSetup,
    state: LadderState,
    links: Sequence[Link],
    drift: float,
    jumps: tuple[int, ...],
) -> tuple[LadderState, float, Descent[LadderState]]:
    """Adjust, with the spread of the drift within the frames."""
    poses, most = setup.bounds[5], _MOST_DRIFT * setup.image_size[1]
    for _ in range(_SPREAD_ROUNDS):
        descent = _descend(setup, state, links, drift, jumps)
        state, before = descent.state, drift
        matrix, right, _ = add_up(state, links)
        # Another spread moves the unknowns by little, so that the equations stay as they are.
        wanted = right + matrix @ state.values
        for _ in range(_SPREAD_STEPS):
            inverse = invert_scaled(matrix + np.diag(prior_information(setup, drift, jumps)))
            values = (inverse @ wanted)[poses].reshape(-1, POSE_SIZE)[:, 3:]
            variances = np.diag(inverse)[poses].reshape(-1, POSE_SIZE)[:, 3:]
            # The spread that the values and what is not known of them make most likely (expectation-maximisation).
            now = float(np.clip(np.sqrt(np.mean(values**2 + variances)), _LEAST_DRIFT_PX, most))
            settled = abs(np.log(now / drift)) < 0.05 * _SPREAD_CHANGE
            drift = now
            if settled:
                break
        if abs(np.log(drift / before)) < _SPREAD_CHANGE:
            break
    return state, drift, descent


def _descend(
    setup: LadderSetup,
    state: LadderState,
    links: Sequence[Link],
    drift: float,
    jumps: tuple[int, ...],
) -> Descent[LadderState]:
    information = prior_information(setup, drift, jumps)

    def cost_of(candidate: LadderState) -> float:
        with np.errstate(all="ignore"):
            total = sum(float(np.sum(pair_values(candidate, link) ** 2)) for link in links)
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
        max_iterations=_ITERATIONS,
        tolerance=_TOLERANCE,
        # The correspondences give poses to a fraction of a pixel, from where the problem is nearly linear.
        first_damping=MIN_DAMPING,
    )


def _find_jump(
    setup: LadderSetup,
    state: LadderState,
    matrix: Array,
    right: Array,
    drift: float,
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
    return free[best] if gains[best] > _JUMP_GAIN else None
