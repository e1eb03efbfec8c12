"""The drift map while it is being made: what happened, and how restless the drift is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.drift_map import (
    DriftMap,
    Measure,
    MeasureOutcome,
    Move,
    Operation,
    Settle,
    Widen,
    still,
)
from semcal_ros.core.drift_smoothing import Event, Mark

__all__ = ["DriftFilter"]

Array = NDArray[np.float64]

# Part of the way that the process noise goes with each innovation.
_PACE = 0.2
_LARGEST_NIS = 6.0
# Process noise that moves the drift by less than this part of a measurement's sigma between two
# frames is as good as none.
_LEAST_MOTION = 0.02


@dataclass
class _Pending:
    """A keyframe whose own noise is known only when something is registered against it."""

    key: int
    removed: Array
    index: int
    before: DriftMap


class DriftFilter:
    """State of the drift, kept up to date.

    Parameters
    ----------
    time_s
        Time at which the drift is zero.
    acceleration_psd
        Process noise, length^2 / s^3; None estimates it from the innovations.
    history
        Whether to keep what happened for good.
    """

    def __init__(self, time_s: float, acceleration_psd: float | None, history: bool) -> None:
        self.start = still(time_s)
        self.state = self.start
        self.events: list[Event] = []
        self.psd = acceleration_psd or 0.0
        self.measured = 0
        self._adapts = acceleration_psd is None
        self._history = history
        self._pending: _Pending | None = None

    @property
    def pending(self) -> int | None:
        """The keyframe that nothing was registered against yet."""
        return None if self._pending is None else self._pending.key

    def do(self, operation: Operation) -> None:
        """Something happens to the state."""
        self.state = operation(self.state, self.psd)
        self.events.append(operation)

    def mark(self) -> None:
        """The state of now is that of a frame."""
        if self._history:
            self.events.append(Mark())
        elif self._pending is None:
            self.events.clear()

    def settle_later(self, key: int, removed: Array) -> None:
        """The frame of now becomes a keyframe that was not measured; its noise is told later."""
        self._pending = _Pending(key, removed, len(self.events), self.state)
        self.do(Settle(key, removed, np.zeros((4, 4))))

    def first_velocity(self, sigma: float, psd: float) -> None:
        """Prior of the velocity: the keyframe of the first frame was taken at it, too."""
        pending = self._pending
        assert pending is not None
        widened = Widen(np.diag([0.0, 0.0, sigma**2, sigma**2]))
        self.events.insert(pending.index, widened)
        pending.index += 1
        pending.before = widened(pending.before)
        if self._adapts:
            self.psd = psd
        self._again()

    def settle(self, noise: Array) -> None:
        """The noise (4, 4) of the keyframe that was pending."""
        pending = self._pending
        if pending is not None:
            self.events[pending.index] = Settle(pending.key, pending.removed, noise)
            self._again()

    def _again(self) -> None:
        """The state since the pending keyframe; nothing but time has passed."""
        pending = self._pending
        assert pending is not None
        state = pending.before
        for event in self.events[pending.index :]:
            if isinstance(event, Operation):
                state = event(state, self.psd)
        self.state = state

    def accept(self, measure: Measure, outcome: MeasureOutcome) -> None:
        """A measurement is used."""
        self.state = outcome.state
        self.events.append(measure)
        self._pending = None
        self.measured += 1

    def adapt(self, nis: float, noise: Array, dt_s: float) -> None:
        """Nudge the process noise until innovations are as large as predicted (2 on average).

        ``noise`` (2, 2) is that of the measurement, ``dt_s`` the time since the one before.
        """
        if not self._adapts or self.measured <= 1 or not dt_s > 0.0:
            return
        excess = float(np.clip(0.5 * nis, 0.0, _LARGEST_NIS)) - 1.0
        least = 3.0 * _LEAST_MOTION**2 * 0.5 * float(np.trace(noise)) / dt_s**3
        self.psd = max(self.psd * float(np.exp(_PACE * excess)), least)

    def forecast(self, time_s: float) -> DriftMap:
        """The state at a later time, from what is known now."""
        return Move(time_s)(self.state, self.psd)
