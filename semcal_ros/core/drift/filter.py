"""The drift map while it is being made: what happened, and how restless the drift is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.operations import AddKeyframe, Inflate, Measure, Operation, Predict
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.smoother import Event, Mark, estimate_process_noise, replay
from semcal_ros.core.drift.state import DriftState

__all__ = ["DriftFilter"]


# Part of the way that the process noise goes with each innovation.
_PACE = 0.2
_LARGEST_NIS = 6.0
# Process noise that moves the drift by less than this part of a measurement's sigma between two
# frames is as good as none.
_LEAST_MOTION = 0.02
# Frames in which an acceleration is taken to fade: a longer memory follows a smooth drift more
# closely and overshoots when a rough one turns.
_MEMORY = 1.0
# Numbers of measurements after which the restlessness is estimated anew from all of them.
_LEARNT = (4, 8, 16)


@dataclass
class _Pending:
    """A keyframe whose own noise is known only when something is registered against it."""

    settle: AddKeyframe
    index: int
    before: DriftState


class DriftFilter:
    """State of the drift, kept up to date.

    Parameters
    ----------
    start
        State at the time at which the drift is zero.
    acceleration_psd
        Process noise, length^2 / s^3; None estimates it from the innovations.
    history
        Whether to keep what happened for good.
    """

    def __init__(self, start: DriftState, acceleration_psd: float | None, history: bool) -> None:
        self.start = start
        self.state = start
        self.events: list[Event] = []
        self.restlessness = ProcessNoise(acceleration_psd or 0.0)
        self.measured = 0
        self._adapts = acceleration_psd is None
        self._history = history
        self._pending: _Pending | None = None

    @property
    def pending(self) -> int | None:
        """The keyframe that nothing was registered against yet."""
        return None if self._pending is None else self._pending.settle.key

    def do(self, operation: Operation) -> None:
        """Something happens to the state."""
        self.state = operation(self.state, self.restlessness)
        self.events.append(operation)

    def mark(self) -> None:
        """The state of now is that of a frame."""
        if self._history:
            self.events.append(Mark())
        elif self._pending is None and self.measured >= _LEARNT[-1]:
            self.events.clear()

    def settle_later(self, key: int, removed: Array, bow: float) -> None:
        """The frame of now becomes a keyframe that was not measured; its noise is told later.

        The arguments are those of :class:`~semcal_ros.core.drift.operations.AddKeyframe`.
        """
        settle = AddKeyframe(key, removed, bow, np.zeros((4, 4)), 0.0)
        self._pending = _Pending(settle, len(self.events), self.state)
        self.do(settle)

    def first_velocity(self, sigma: float, psd: float, interval_s: float) -> None:
        """Prior of the velocity, and of how restless the drift is; the keyframe of the first frame
        was taken at that velocity, too.
        """
        pending = self._pending
        assert pending is not None
        given = self.restlessness.psd
        self.restlessness = ProcessNoise(psd if self._adapts else given, _MEMORY * interval_s)
        variances = [0.0, sigma**2, self.restlessness.acceleration_variance]
        widened = Inflate(np.diag(np.repeat(variances, 2)))
        self.events.insert(pending.index, widened)
        pending.index += 1
        pending.before = widened(pending.before, self.restlessness)
        self._again()

    def settle(self, noise: Array, scan_s: float) -> None:
        """The noise (4, 4) of the keyframe that was pending, and the time it took."""
        pending = self._pending
        if pending is not None:
            self.events[pending.index] = replace(pending.settle, noise=noise, scan_s=scan_s)
            self._again()

    def _again(self) -> None:
        """The state since the pending keyframe; nothing but time has passed."""
        pending = self._pending
        assert pending is not None
        state = pending.before
        for event in self.events[pending.index :]:
            if isinstance(event, Operation):
                state = event(state, self.restlessness)
        self.state = state

    def accept(self, measure: Measure) -> None:
        """A measurement is used."""
        self.state = measure(self.state, self.restlessness).state
        self.events.append(measure)
        self._pending = None
        self.measured += 1
        if self._adapts and self.measured in _LEARNT and self.restlessness.psd > 0.0:
            # The guess that all began with is worth less than what was seen since.
            times = [event.time_s for event in self.events if isinstance(event, Predict)]
            interval_s = float(np.median(np.diff([self.start.time_s, *times])))
            near = self.restlessness
            if interval_s > 0.0:
                near = replace(near, memory_s=_MEMORY * interval_s)
            self.restlessness = estimate_process_noise(self.start, self.events, near, (1.0,))
            self.state = replay(self.start, self.events, self.restlessness)

    def adapt(self, nis: float, noise: Array, dt_s: float) -> None:
        """Nudge the process noise until innovations are as large as predicted (2 on average).

        ``noise`` (2, 2) is that of the measurement, ``dt_s`` the time since the one before.
        """
        if not self._adapts or self.measured <= 1 or not dt_s > 0.0:
            return
        excess = float(np.clip(0.5 * nis, 0.0, _LARGEST_NIS)) - 1.0
        least = 3.0 * _LEAST_MOTION**2 * 0.5 * float(np.trace(noise)) / dt_s**3
        psd = max(self.restlessness.psd * float(np.exp(_PACE * excess)), least)
        self.restlessness = replace(self.restlessness, psd=psd)
