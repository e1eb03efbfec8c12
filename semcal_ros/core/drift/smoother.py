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

"""Drift of a whole recording with hindsight.

The events of a :class:`~semcal_ros.core.drift.filter.DriftFilter` are applied again with the process
noise that makes the measurements most likely, and then undone backwards. The recursion is that of
Bryson and Frazier (1963; modified by Bierman 1973,
Int. J. Control 18, 65-75), which needs no
inverse of a predicted covariance: positions of keyframes are copies of each other, so that such an
inverse does not exist.

With a white acceleration the result is the cubic smoothing spline through the measurements (Wahba
1978, doi:10.1111/j.2517-6161.1978.tb01050.x), with one that lasts a stiffer one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from semcal_ros.core.arrays import Array, invert_scaled
from semcal_ros.core.drift.operations import (
    AddKeyframe,
    CloneKeyframe,
    Measure,
    MeasureOutcome,
    Operation,
)
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.thresholds import (
    DENSITY_GRID,
    DENSITY_LOG_RANGE,
    DENSITY_LOG_TOLERANCE,
    LIKELIHOOD_MEASUREMENTS_MAX,
    LIKELIHOOD_MEASUREMENTS_MIN,
    MEASUREMENT_COST_MAX,
    MEASUREMENTS_UNCOUNTED,
    SMOOTHER_BLOCK,
    WALK_EVIDENCE_MIN,
    WALK_FRAMES,
    WALK_LOG_RANGE,
)
from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True)
class Mark:
    """The present state is that of one frame."""


Event = Operation | Measure | Mark


@dataclass(frozen=True)
class _Update:
    """A measurement: its Jacobian, its innovation with the inverse of its covariance, and the part
    ``I - K H`` of the prediction's errors that remains.
    """

    jacobian: Array
    innovation: Array
    inverse: Array
    remaining: Array


#: What the backward pass needs: the matrix of an operation, a measurement, or the state of a frame.
_Step = Array | _Update | DriftState


def _run_forward(
    start: DriftState, events: Sequence[Event], process_noise: ProcessNoise
) -> Iterator[_Step]:
    """The step of each event."""
    state = start
    for event in events:
        step: _Step
        if isinstance(event, Operation):
            transition = event.transition(state, process_noise)
            state = transition.apply(state)
            step = transition.matrix
        elif isinstance(event, Measure):
            outcome = event(state, process_noise)
            state = outcome.state
            remaining = np.eye(state.mean.size) - outcome.gain @ outcome.jacobian
            inverse = invert_scaled(outcome.innovation_covariance)
            step = _Update(outcome.jacobian, outcome.innovation, inverse, remaining)
        else:
            step = state
        yield step


def _apply(
    start: DriftState, events: Sequence[Event], process_noise: ProcessNoise
) -> Iterator[tuple[DriftState, MeasureOutcome | None]]:
    """The state after each event, with what came of a measurement."""
    state = start
    for event in events:
        outcome = None
        if isinstance(event, Operation):
            state = event(state, process_noise)
        elif isinstance(event, Measure):
            outcome = event(state, process_noise)
            state = outcome.state
        yield state, outcome


def replay(start: DriftState, events: Sequence[Event], process_noise: ProcessNoise) -> DriftState:
    """The state after all events are applied again."""
    state = start
    for after, _ in _apply(start, events, process_noise):
        state = after
    return state


def separate_common(events: Sequence[Event]) -> tuple[list[Event], list[Array]]:
    """Separate what pulls the measurements of a filter alike from what differs between them.

    No mean of frames makes a pull smaller, and it says nothing of how the drift changes: as a part of the noise of each
    frame it would make all of them worth next to nothing, and the path a straight line.

    Returns
    -------
    The events with the covariances of what differs, and (2, 2) the covariance of the pull at each mark: that of the
    latest measurement, and of those by which its keyframe came to its place.
    """
    separated: list[Event] = []
    at_marks: list[Array] = []
    latest, of_keyframes = np.zeros((2, 2)), dict[int, Array]()
    for event in events:
        if isinstance(event, Measure):
            latest = event.common + of_keyframes.get(event.key, 0.0)
            separated.append(event.without_common())
            continue
        if isinstance(event, AddKeyframe):
            of_keyframes[event.key] = latest
        elif isinstance(event, CloneKeyframe):
            of_keyframes[event.key] = of_keyframes.get(event.parent, np.zeros((2, 2)))
        elif isinstance(event, Mark):
            at_marks.append(latest)
        separated.append(event)
    return separated, at_marks


def smooth(
    start: DriftState, events: Sequence[Event], process_noise: ProcessNoise
) -> list[DriftState]:
    """States at the marks, without their keyframes, each given all measurements.

    Steps are kept of one block of events at a time, and computed again from the state before it: those of a
    long recording with many keyframes would not fit into memory.

    Parameters
    ----------
    start
        State before the first event.
    events
        Events of a filter.
    process_noise
        Process noise of the drift.

    Raises
    ------
    InvalidValueError
        If a time goes back or the process noise is negative.
    """
    blocks: list[tuple[DriftState, Sequence[Event]]] = []
    last = start
    for first in range(0, len(events), SMOOTHER_BLOCK):
        blocks.append((last, events[first : first + SMOOTHER_BLOCK]))
        last = replay(*blocks[-1], process_noise)
    smoothed: list[DriftState] = []
    # Adjoint of the state and its information: what later measurements say of it.
    adjoint = np.zeros(last.mean.size)
    information = np.zeros((last.mean.size, last.mean.size))
    while blocks:
        steps = list(_run_forward(*blocks.pop(), process_noise))
        for step in reversed(steps):
            if isinstance(step, _Update):
                weighted = step.jacobian.T @ step.inverse
                adjoint = step.remaining.T @ adjoint - weighted @ step.innovation
                information = (
                    weighted @ step.jacobian + step.remaining.T @ information @ step.remaining
                )
            elif isinstance(step, DriftState):
                mean = step.mean - step.covariance @ adjoint
                covariance = step.covariance - step.covariance @ information @ step.covariance
                covariance = 0.5 * (covariance + covariance.T)
                known = replace(step, mean=mean, covariance=covariance)
                smoothed.append(known.without_keyframes())
            else:
                adjoint, information = step.T @ adjoint, step.T @ information @ step
    return smoothed[::-1]


def estimate_process_noise(
    start: DriftState,
    events: Sequence[Event],
    near: ProcessNoise,
    time_constants: Sequence[float] = (0.0, 2.0, 8.0),
    deviations: float = 0.0,
) -> ProcessNoise:
    """The process noise that makes the measurements most likely, or one that is larger by some deviations.

    A smooth drift is preferred to a random walk unless the measurements are strong evidence for the latter. Where
    ``deviations`` are told and there is no strong evidence for either, the process noise has both.

    Parameters
    ----------
    start, events
        As for :func:`smooth`; from a long recording the first part is taken.
    near
        A guess whose density is greater than 0 and right within some orders of magnitude, and
        whose time constant is that of a few frames.
    time_constants
        Multiples of that time constant to choose from, of a smooth drift; 0 is a white acceleration. A random walk has
        the time constant itself, and is not tried where that is 0.
    deviations
        The density is the largest whose likelihood lies within so many standard deviations of the highest, but no
        more than the guess unless the likeliest is: what shows to be more is known well enough. A few
        measurements are most likely with hardly any noise a good part of the time, and a filter that believes it
        follows a bent path by a straight line, at too small a sigma.

    Raises
    ------
    InvalidValueError
        If the density of ``near`` is not positive.
    """
    if not near.psd > 0.0:
        raise InvalidValueError(f"{near}", expected="a positive density")
    part = list(events)[: 4 * LIKELIHOOD_MEASUREMENTS_MAX]
    if sum(isinstance(event, Measure) for event in part) < LIKELIHOOD_MEASUREMENTS_MIN:
        return near
    few_frames_s = near.time_constant_s
    smooth_near, walk_near = near, None
    if few_frames_s > 0.0:
        # The guess as either of them, with which it predicts a step of the same length.
        smooth_near = _as_restless(replace(near, walk_s2=0.0), near, few_frames_s)
        walk_near = _as_restless(
            replace(near, walk_s2=WALK_FRAMES * few_frames_s**2), near, few_frames_s
        )
    likely = min(
        (
            _maximise_likelihood(
                start, part, replace(smooth_near, time_constant_s=factor * few_frames_s)
            )
            for factor in time_constants
        ),
        key=lambda smooth: smooth.lowest,
    )
    if walk_near is not None:
        middle = _as_restless(walk_near, likely.process_noise, few_frames_s).psd / walk_near.psd
        lowest, highest = (float(np.log(middle)) + end for end in WALK_LOG_RANGE)
        walk = _refine(_Likelihood(start, part, walk_near), (lowest, highest))
        evidence = likely.lowest - walk.lowest
        if evidence > WALK_EVIDENCE_MIN:
            likely = walk
        elif deviations > 0.0 and evidence > -WALK_EVIDENCE_MIN:
            return _add(likely.larger_by(deviations), walk.larger_by(deviations))
    return likely.larger_by(deviations)


def _as_restless(model: ProcessNoise, other: ProcessNoise, step_s: float) -> ProcessNoise:
    """A process noise with the density at which it predicts as long a step as another one."""
    steps = [noise.discretise(step_s)[1][0, 0] for noise in (other, model)]
    return replace(model, psd=model.psd * float(steps[0] / steps[1]))


def _add(smooth: ProcessNoise, walk: ProcessNoise) -> ProcessNoise:
    """The acceleration of one and the steps of the other."""
    return replace(smooth, walk_s2=walk.psd * walk.walk_s2 / smooth.psd)


@dataclass(frozen=True)
class _Likelihood:
    """How likely measurements are with the process noise ``near``, but for its density."""

    start: DriftState
    events: Sequence[Event]
    near: ProcessNoise

    def with_density(self, log_psd: float) -> ProcessNoise:
        """The process noise whose density is greater by that logarithm."""
        return replace(self.near, psd=self.near.psd * float(np.exp(log_psd)))

    def cost(self, log_psd: float) -> float:
        """Minus twice the logarithm of the likelihood."""
        costs = [
            min(outcome.nis + outcome.shear_nis, MEASUREMENT_COST_MAX)
            + float(np.linalg.slogdet(outcome.innovation_covariance)[1])
            for _, outcome in _apply(self.start, self.events, self.with_density(log_psd))
            if outcome is not None
        ]
        return sum(costs[MEASUREMENTS_UNCOUNTED:], start=0.0)


@dataclass(frozen=True)
class _Likeliest:
    """The density at which the cost is lowest."""

    likelihood: _Likelihood
    log_psd: float
    lowest: float

    @property
    def process_noise(self) -> ProcessNoise:
        """The process noise with that density."""
        return self.likelihood.with_density(self.log_psd)

    def larger_by(self, deviations: float) -> ProcessNoise:
        """The process noise with that density, or with one that is larger by so many standard deviations."""
        likely = self.log_psd
        if deviations > 0.0:
            # Minus twice the log likelihood rises by one at one deviation.
            still = self.lowest + deviations**2
            cost, larger = self.likelihood.cost, DENSITY_LOG_RANGE[1]
            if cost(larger) > still:
                larger = float(
                    brentq(lambda v: cost(v) - still, likely, larger, xtol=DENSITY_LOG_TOLERANCE)
                )
            # What the measurements show to be more than the guess is known well enough.
            likely = max(likely, min(larger, 0.0))
        return self.likelihood.with_density(likely)


def _maximise_likelihood(
    start: DriftState, events: Sequence[Event], near: ProcessNoise
) -> _Likeliest:
    """The best density of a process noise, within some orders of magnitude of the one of ``near``."""
    likelihood = _Likelihood(start, events, near)
    grid = np.linspace(*DENSITY_LOG_RANGE, DENSITY_GRID)
    best = int(np.argmin([likelihood.cost(float(v)) for v in grid]))
    bounds = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, DENSITY_GRID - 1)])
    return _refine(likelihood, bounds)


def _refine(likelihood: _Likelihood, bounds: tuple[float, float]) -> _Likeliest:
    found = minimize_scalar(
        likelihood.cost,
        bounds=bounds,
        method="bounded",
        options={"xatol": DENSITY_LOG_TOLERANCE},
    )
    return _Likeliest(likelihood, float(found.x), float(found.fun))
