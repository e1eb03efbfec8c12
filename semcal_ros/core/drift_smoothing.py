"""Drift of a whole recording, with hindsight.

What happened to the :class:`~semcal_ros.core.drift_map.DriftMap` while a recording was tracked is
done again with the acceleration noise that makes the measurements most likely, and then undone
backwards by the Rauch-Tung-Striebel recursion (Rauch, Tung and Striebel 1965, doi:10.2514/3.3166).
With white acceleration the result is the cubic smoothing spline through the measurements (Wahba
1978, doi:10.1111/j.2517-6161.1978.tb01050.x), with one that lasts a stiffer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.drift_map import DriftMap, Linear, Measure, Operation, Restlessness
from semcal_ros.core.errors import InvalidValueError

__all__ = ["Event", "Mark", "likely_restlessness", "replayed", "smoothed"]

Array = NDArray[np.float64]

_OUTLIER_NIS = 25.0
_MAX_FOR_LIKELIHOOD = 600
_LOG_RANGE = (-14.0, 5.0)
_SMALLEST_EIGENVALUE = 1e-12


@dataclass(frozen=True)
class Mark:
    """The state of now is that of one frame."""


Event = Operation | Measure | Mark


@dataclass(frozen=True)
class _Node:
    """A state to come back to: predicted from the one before by ``step``, then filtered."""

    step: Linear
    predicted: DriftMap
    filtered: DriftMap
    marked: bool


def _forwards(
    start: DriftMap, events: Sequence[Event], restlessness: Restlessness
) -> tuple[list[_Node], float, int]:
    """Nodes at all measurements and marks; minus twice the log likelihood of the measurements, and
    their number.
    """
    state, cost, count = start, 0.0, 0
    step = _nothing(start)
    nodes = []
    for event in events:
        if isinstance(event, Operation):
            linear = event.linear(state, restlessness)
            state = linear.of(state)
            step = _after(step, linear)
            continue
        predicted = state
        if isinstance(event, Measure):
            outcome = event(state, restlessness)
            state = outcome.state
            count += 1
            if count > 2:
                size = float(np.linalg.slogdet(outcome.innovation_covariance)[1])
                cost += min(outcome.nis + outcome.shear_nis, 2.0 * _OUTLIER_NIS) + size
        nodes.append(_Node(step, predicted, state, isinstance(event, Mark)))
        step = _nothing(state)
    return nodes, cost, count


def _nothing(state: DriftMap) -> Linear:
    size = state.mean.size
    return Linear(np.eye(size), np.zeros(size), np.zeros((size, size)), state.time_s, state.keys)


def _after(first: Linear, second: Linear) -> Linear:
    """Both, one after the other."""
    matrix = second.matrix @ first.matrix
    covariance = second.matrix @ first.covariance @ second.matrix.T + second.covariance
    offset = second.matrix @ first.offset + second.offset
    return Linear(matrix, offset, covariance, second.time_s, second.keys)


def replayed(start: DriftMap, events: Sequence[Event], restlessness: Restlessness) -> DriftMap:
    """The state after everything happened again."""
    nodes, _, _ = _forwards(start, events, restlessness)
    state = nodes[-1].filtered if nodes else start
    last = max((k for k, e in enumerate(events) if not isinstance(e, Operation)), default=-1)
    for event in events[last + 1 :]:
        if isinstance(event, Operation):
            state = event(state, restlessness)
    return state


def smoothed(
    start: DriftMap, events: Sequence[Event], restlessness: Restlessness
) -> list[DriftMap]:
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
    nodes, _, _ = _forwards(start, events, restlessness)
    found: list[DriftMap] = []
    after: DriftMap | None = None
    for k in range(len(nodes) - 1, -1, -1):
        state = nodes[k].filtered
        if after is not None:
            state = _stepped_back(state, nodes[k + 1], after)
        if nodes[k].marked:
            found.append(state)
        after = state
    return found[::-1]


def _stepped_back(filtered: DriftMap, node: _Node, after: DriftMap) -> DriftMap:
    """The smoothed state before ``node``, whose own smoothed state is ``after``."""
    predicted = node.predicted.covariance
    # Metres and metres per second differ by orders of magnitude.
    unit = np.sqrt(np.maximum(np.diag(predicted), 1e-300))
    values, vectors = np.linalg.eigh(predicted / np.outer(unit, unit))
    # What is known exactly, as the drift of the first frame is, nothing can change.
    kept = values > _SMALLEST_EIGENVALUE * values[-1]
    basis = vectors[:, kept]
    inverse = (basis / values[kept]) @ basis.T / np.outer(unit, unit)
    gain = filtered.covariance @ node.step.matrix.T @ inverse
    mean = filtered.mean + gain @ (after.mean - node.predicted.mean)
    covariance = filtered.covariance + gain @ (after.covariance - predicted) @ gain.T
    return replace(filtered, mean=mean, covariance=0.5 * (covariance + covariance.T))


def likely_restlessness(
    start: DriftMap,
    events: Sequence[Event],
    near: Restlessness,
    memories: Sequence[float] = (0.0, 2.0, 8.0),
) -> Restlessness:
    """The restlessness that makes the measurements most likely.

    Parameters
    ----------
    start, events
        As for :func:`smoothed`; from a long recording the first part is taken.
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
    start: DriftMap, events: Sequence[Event], near: float, memory_s: float
) -> tuple[float, Restlessness]:
    """Minus twice the log likelihood of the best density, and it."""

    def of(log_psd: float) -> Restlessness:
        return Restlessness(near * float(np.exp(log_psd)), memory_s)

    def cost(log_psd: float) -> float:
        return _forwards(start, events, of(log_psd))[1]

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
