"""Drift of a whole recording, with hindsight.

What happened to the :class:`~semcal_ros.core.drift.state.DriftState` while a recording was tracked is
done again with the acceleration noise that makes the measurements most likely, and then undone
backwards. The recursion is that of Bryson and Frazier (1963; modified by Bierman 1973,
Int. J. Control 18, 65-75), which needs no inverse of a prediction: positions of keyframes are
copies of each other, and such an inverse does not exist.
With white acceleration the result is the cubic smoothing spline through the measurements (Wahba
1978, doi:10.1111/j.2517-6161.1978.tb01050.x), with one that lasts a stiffer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, invert_scaled
from semcal_ros.core.drift.operations import Measure, Operation
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.errors import InvalidValueError

__all__ = ["Event", "Mark", "estimate_process_noise", "replay", "smooth"]


_OUTLIER_NIS = 25.0
_MAX_FOR_LIKELIHOOD = 600
_LOG_RANGE = (-14.0, 5.0)


@dataclass(frozen=True)
class Mark:
    """The state of now is that of one frame."""


Event = Operation | Measure | Mark


@dataclass(frozen=True)
class _Update:
    """What a measurement did: its row, innovation with the inverse of its covariance, and what it
    left of the prediction's errors.
    """

    row: Array
    innovation: Array
    inverse: Array
    kept: Array


#: What is needed to come back: the matrix of an operation, a measurement, or the state of a frame.
_Step = Array | _Update | DriftState


def _forwards(
    start: DriftState, events: Sequence[Event], restlessness: ProcessNoise
) -> tuple[list[_Step], DriftState, float]:
    """The steps, the last state, and minus twice the log likelihood of the measurements."""
    state, cost, count = start, 0.0, 0
    steps: list[_Step] = []
    for event in events:
        if isinstance(event, Operation):
            linear = event.linear(state, restlessness)
            state = linear.of(state)
            steps.append(linear.matrix)
        elif isinstance(event, Measure):
            outcome = event(state, restlessness)
            state = outcome.state
            kept = np.eye(state.mean.size) - outcome.gain @ outcome.row
            inverse = invert_scaled(outcome.innovation_covariance)
            steps.append(_Update(outcome.row, outcome.innovation, inverse, kept))
            count += 1
            if count > 2:
                size = float(np.linalg.slogdet(outcome.innovation_covariance)[1])
                cost += min(outcome.nis + outcome.shear_nis, 2.0 * _OUTLIER_NIS) + size
        else:
            steps.append(state)
    return steps, state, cost


def replay(start: DriftState, events: Sequence[Event], restlessness: ProcessNoise) -> DriftState:
    """The state after everything happened again."""
    return _forwards(start, events, restlessness)[1]


def smooth(
    start: DriftState, events: Sequence[Event], restlessness: ProcessNoise
) -> list[DriftState]:
    """States at the marks, each with the knowledge of all measurements.

    Parameters
    ----------
    start
        State before the first event.
    events
        What happened.
    restlessness
        Of the drift.

    Raises
    ------
    InvalidValueError
        If a time goes back or the restlessness is negative.
    """
    steps, last, _ = _forwards(start, events, restlessness)
    found: list[DriftState] = []
    # What later measurements say of the state, and how much they know of it.
    told = np.zeros(last.mean.size)
    known = np.zeros((last.mean.size, last.mean.size))
    for step in reversed(steps):
        if isinstance(step, _Update):
            told = step.kept.T @ told - step.row.T @ step.inverse @ step.innovation
            known = step.row.T @ step.inverse @ step.row + step.kept.T @ known @ step.kept
        elif isinstance(step, DriftState):
            mean = step.mean - step.covariance @ told
            covariance = step.covariance - step.covariance @ known @ step.covariance
            covariance = 0.5 * (covariance + covariance.T)
            found.append(replace(step, mean=mean, covariance=covariance))
        else:
            told, known = step.T @ told, step.T @ known @ step
    return found[::-1]


def estimate_process_noise(
    start: DriftState,
    events: Sequence[Event],
    near: ProcessNoise,
    memories: Sequence[float] = (0.0, 2.0, 8.0),
) -> ProcessNoise:
    """The restlessness that makes the measurements most likely.

    Parameters
    ----------
    start, events
        As for :func:`smooth`; from a long recording the first part is taken.
    near
        One whose density is right within some orders of magnitude, greater than 0, and whose
        memory is that of few frames.
    memories
        Multiples of that memory to choose from; 0 is a white acceleration.

    Raises
    ------
    InvalidValueError
        If the density of ``near`` is not positive.
    """
    if not near.psd > 0.0:
        raise InvalidValueError(f"{near}", expected="a positive density")
    part = list(events)[: 4 * _MAX_FOR_LIKELIHOOD]
    if sum(isinstance(event, Measure) for event in part) < 4:
        return near
    found = [_likely_psd(start, part, near.psd, m * near.memory_s) for m in memories]
    return min(found, key=lambda pair: pair[0])[1]


def _likely_psd(
    start: DriftState, events: Sequence[Event], near: float, memory_s: float
) -> tuple[float, ProcessNoise]:
    """Minus twice the log likelihood of the best density, and it."""

    def of(log_psd: float) -> ProcessNoise:
        return ProcessNoise(near * float(np.exp(log_psd)), memory_s)

    def cost(log_psd: float) -> float:
        return _forwards(start, events, of(log_psd))[2]

    grid = np.linspace(*_LOG_RANGE, 9)
    costs = [cost(float(v)) for v in grid]
    best = int(np.argmin(costs))
    low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)])
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    cost_a, cost_b = cost(a), cost(b)
    # Seven steps leave a tenth of the logarithm, far less than what the data can tell.
    for _ in range(7):
        if cost_a < cost_b:
            high, b, cost_b = b, a, cost_a
            a = high - ratio * (high - low)
            cost_a = cost(a)
        else:
            low, a, cost_a = a, b, cost_b
            b = low + ratio * (high - low)
            cost_b = cost(b)
    return min(cost_a, cost_b), of(0.5 * (low + high))
