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

"""The Kalman filter of the drift, its history of events, and the adaptation of its process noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.operations import (
    AddKeyframe,
    CloneKeyframe,
    Inflate,
    Measure,
    Operation,
    Predict,
)
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.smoother import Event, Mark, estimate_process_noise, replay
from semcal_ros.core.drift.state import DriftState

# Logarithm by which the process noise changes with an innovation of one unit of excess: some five
# frames are averaged.
_ADAPTATION = 0.2
# A normalised innovation squared (2 on average) counts as at most three times as large as it should
# be, so that a single outlier raises the process noise by no more than 1.5.
_MAX_NIS = 6.0
# Process noise that moves the drift by less than this part of a measurement's sigma between two
# frames has no effect.
_MIN_MOTION = 0.02
# Frame intervals in which an acceleration decays: with a longer time constant the filter follows a
# smooth drift more closely, and overshoots when a rough one turns.
_TIME_CONSTANT = 1.0
# Numbers of measurements after which the process noise is estimated again from all of them.
_ESTIMATE_AFTER = (4, 8, 16)
# By how many deviations it is taken larger then: of so few measurements, too large an uncertainty is the lesser evil.
_LARGER_SIGMAS = 1.0


@dataclass
class _PendingKeyframe:
    """A keyframe whose own noise is known only when something has been registered against it."""

    operation: AddKeyframe
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
        Whether to keep all events, for a smoother.
    """

    def __init__(self, start: DriftState, acceleration_psd: float | None, history: bool) -> None:
        self.start = start
        self.state = start
        self.events: list[Event] = []
        self.process_noise = ProcessNoise(acceleration_psd or 0.0)
        self.measured = 0
        self._adapts = acceleration_psd is None
        self._history = history
        self._pending: _PendingKeyframe | None = None

    @property
    def pending(self) -> int | None:
        """The keyframe that nothing was registered against yet."""
        return None if self._pending is None else self._pending.operation.key

    def apply(self, operation: Operation) -> None:
        """Apply an operation to the state."""
        self.state = operation(self.state, self.process_noise)
        self.events.append(operation)

    def mark_frame(self) -> None:
        """Note that the present state is that of a frame."""
        if self._history:
            self.events.append(Mark())
        elif self._pending is None and self.measured >= _ESTIMATE_AFTER[-1]:
            self.events.clear()

    def add_keyframe(self, key: int, removed: Array, acceleration_term_s2: float) -> None:
        """Make the present frame a keyframe that was not measured; :meth:`set_keyframe_noise` tells
        its noise later.

        The arguments are those of :class:`~semcal_ros.core.drift.operations.AddKeyframe`.
        """
        operation = AddKeyframe(key, removed, acceleration_term_s2, np.zeros((4, 4)), 0.0)
        self._pending = _PendingKeyframe(operation, len(self.events), self.state)
        self.apply(operation)

    def set_motion_prior(self, sigma: float, psd: float, interval_s: float) -> None:
        """Set the prior of the velocity, and of the process noise unless that was given; the
        keyframe of the first frame was taken at that velocity, too.
        """
        pending = self._pending
        assert pending is not None
        given = self.process_noise.psd
        self.process_noise = replace(
            self.process_noise,
            psd=psd if self._adapts else given,
            time_constant_s=_TIME_CONSTANT * interval_s,
        )
        variances = [0.0, sigma**2, self.process_noise.acceleration_variance]
        prior = Inflate(np.diag(np.repeat(variances, 2)))
        self.events.insert(pending.index, prior)
        pending.index += 1
        pending.before = prior(pending.before, self.process_noise)
        self._replay_since(pending)

    def set_keyframe_noise(self, noise: Array, scan_s: float) -> None:
        """Set the noise (4, 4) of the pending keyframe, and the time that it took."""
        pending = self._pending
        if pending is not None:
            self.events[pending.index] = replace(pending.operation, noise=noise, scan_s=scan_s)
            self._replay_since(pending)

    def _replay_since(self, pending: _PendingKeyframe) -> None:
        """Apply again what happened since the pending keyframe: nothing but time has passed."""
        state = pending.before
        for event in self.events[pending.index :]:
            if isinstance(event, Operation):
                state = event(state, self.process_noise)
        self.state = state

    def update(self, measure: Measure) -> None:
        """Update the state by a measurement."""
        self.state = measure(self.state, self.process_noise).state
        self.events.append(measure)
        self._pending = None
        self.measured += 1
        if self._adapts and self.measured in _ESTIMATE_AFTER and self.process_noise.psd > 0.0:
            # The first guess is worth less than what was measured since.
            times = [event.time_s for event in self.events if isinstance(event, Predict)]
            interval_s = float(np.median(np.diff([self.start.time_s, *times])))
            near = self.process_noise
            if interval_s > 0.0:
                near = replace(near, time_constant_s=_TIME_CONSTANT * interval_s)
            self.process_noise = estimate_process_noise(
                self.start, self.events, near, (1.0,), _LARGER_SIGMAS
            )
            self.state = replay(self.start, self.events, self.process_noise)

    def widen_measurements(self, covariance: Array) -> None:
        """Add a covariance (2, 2) of the shift to all measurements so far, or to the present drift where they are no
        longer kept.
        """
        if not self._history and self.measured >= _ESTIMATE_AFTER[-1]:
            both = np.zeros((6, 6))
            both[:2, :2] = covariance
            self.apply(Inflate(both))
            return
        self.events = [
            event.widened(covariance) if isinstance(event, Measure | CloneKeyframe) else event
            for event in self.events
        ]
        self.state = replay(self.start, self.events, self.process_noise)

    def set_flicker(self, flicker: Array) -> None:
        """Set the variances (4,) of :attr:`.process_noise.ProcessNoise.flicker`."""
        x, y, vx, vy = flicker.tolist()
        self.process_noise = replace(self.process_noise, flicker=(x, y, vx, vy))

    def adapt_process_noise(self, nis: float, noise: Array, dt_s: float) -> None:
        """Change the process noise until innovations are as large as predicted.

        Parameters
        ----------
        nis
            Normalised innovation squared of the latest shift, 2 on average.
        noise
            (2, 2) covariance of the measurement.
        dt_s
            Time since the frame before.
        """
        if not self._adapts or self.measured <= 1 or not dt_s > 0.0:
            return
        excess = float(np.clip(0.5 * nis, 0.0, _MAX_NIS)) - 1.0
        least = 3.0 * _MIN_MOTION**2 * 0.5 * float(np.trace(noise)) / dt_s**3
        psd = max(self.process_noise.psd * float(np.exp(_ADAPTATION * excess)), least)
        self.process_noise = replace(self.process_noise, psd=psd)
