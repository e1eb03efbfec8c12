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

"""The Kalman filter of the drift, its history of events, and the adaptation of its process noise.

A filter never changes: what happens to it makes another one, so that the one before is still there to go on from.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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
from semcal_ros.core.drift.shared_sequence import SharedSequence
from semcal_ros.core.drift.smoother import Event, Mark, estimate_process_noise, replay
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.thresholds import (
    ADAPTATION,
    ESTIMATED_AFTER,
    INNOVATION_RATIO_MAX,
    LARGER_SIGMAS,
    MOTION_MIN,
    TIME_CONSTANT_FRAMES,
)


@dataclass(frozen=True)
class PendingKeyframe:
    """A keyframe whose own noise is known only when something has been registered against it.

    Attributes
    ----------
    operation
        What made it a keyframe, without its noise.
    index
        Place of that operation among the events.
    before
        State before it.
    """

    operation: AddKeyframe
    index: int
    before: DriftState


@dataclass(frozen=True)
class DriftFilter:
    """The drift as it is known, with what led there. Each method returns another filter.

    Attributes
    ----------
    start
        State from which the :attr:`log` leads to the present one: that at which the drift is zero, as long as all
        events are kept.
    state
        State now.
    process_noise
        How much the drift changes by itself.
    adapts
        Whether the process noise follows the innovations.
    keeps_history
        Whether all events are kept, for a smoother.
    log
        What has happened since the start, as long as it may have to be done again.
    measured
        Number of measurements.
    unmeasured
        The keyframe that nothing was registered against yet.
    """

    start: DriftState
    state: DriftState
    process_noise: ProcessNoise
    adapts: bool
    keeps_history: bool
    log: SharedSequence[Event] = field(default_factory=SharedSequence)
    measured: int = 0
    unmeasured: PendingKeyframe | None = None

    @classmethod
    def begin(
        cls, start: DriftState, acceleration_psd: float | None, *, keeps_history: bool
    ) -> DriftFilter:
        """The filter at its start.

        Parameters
        ----------
        start
            State at the time at which the drift is zero.
        acceleration_psd
            Process noise, length^2 / s^3; None estimates it from the innovations.
        keeps_history
            Whether to keep all events, for a smoother.
        """
        process_noise = ProcessNoise(acceleration_psd or 0.0)
        return cls(start, start, process_noise, acceleration_psd is None, keeps_history)

    @property
    def events(self) -> tuple[Event, ...]:
        """What has happened, in order."""
        return tuple(self.log)

    @property
    def pending(self) -> int | None:
        """Number of the keyframe that nothing was registered against yet."""
        return None if self.unmeasured is None else self.unmeasured.operation.key

    @property
    def knows_motion(self) -> bool:
        """Whether anything is known of the velocity: its prior, or more."""
        return self.measured > 0 or bool(np.any(self.state.drift_covariance[2:, 2:]))

    @property
    def interval_s(self) -> float:
        """Typical time from one frame to the next; 0 before it is known."""
        return self.process_noise.time_constant_s / TIME_CONSTANT_FRAMES

    def apply(self, operation: Operation) -> DriftFilter:
        """The filter after an operation on its state."""
        state = operation(self.state, self.process_noise)
        return replace(self, state=state, log=self.log.with_item(operation))

    def mark_frame(self) -> DriftFilter:
        """Note that the present state is that of a frame."""
        if self.keeps_history:
            return replace(self, log=self.log.with_item(Mark()))
        if self.unmeasured is None and self.measured >= ESTIMATED_AFTER[-1]:
            return replace(self, start=self.state, log=SharedSequence())
        return self

    def add_keyframe(self, key: int, removed: Array, acceleration_term_s2: float) -> DriftFilter:
        """Make the present frame a keyframe that was not measured; :meth:`set_keyframe_noise` tells
        its noise later.

        The arguments are those of :class:`~semcal_ros.core.drift.operations.AddKeyframe`.
        """
        operation = AddKeyframe(key, removed, acceleration_term_s2, np.zeros((4, 4)), 0.0)
        pending = PendingKeyframe(operation, len(self.log), self.state)
        return replace(self.apply(operation), unmeasured=pending)

    def set_motion_prior(self, sigma: float, psd: float, interval_s: float) -> DriftFilter:
        """Set the prior of the velocity, and of the process noise unless that was given; the
        keyframe of the first frame was taken at that velocity, too.
        """
        pending = self.unmeasured
        assert pending is not None
        process_noise = replace(
            self.process_noise,
            psd=psd if self.adapts else self.process_noise.psd,
            time_constant_s=TIME_CONSTANT_FRAMES * interval_s,
        )
        variances = [0.0, sigma**2, process_noise.acceleration_variance]
        prior = Inflate(np.diag(np.repeat(variances, 2)))
        events = self.events
        known = replace(
            self,
            process_noise=process_noise,
            log=SharedSequence.of((*events[: pending.index], prior, *events[pending.index :])),
            unmeasured=replace(
                pending, index=pending.index + 1, before=prior(pending.before, process_noise)
            ),
        )
        return known._replay_since_pending()

    def set_keyframe_noise(self, noise: Array, scan_s: float) -> DriftFilter:
        """Set the noise (4, 4) of the pending keyframe, and the time that it took."""
        pending = self.unmeasured
        if pending is None:
            return self
        known = replace(pending.operation, noise=noise, scan_s=scan_s)
        events = self.events
        changed = (*events[: pending.index], known, *events[pending.index + 1 :])
        return replace(self, log=SharedSequence.of(changed))._replay_since_pending()

    def _replay_since_pending(self) -> DriftFilter:
        """Apply again what happened since the pending keyframe: nothing but time has passed."""
        pending = self.unmeasured
        assert pending is not None
        state = pending.before
        for event in self.events[pending.index :]:
            if isinstance(event, Operation):
                state = event(state, self.process_noise)
        return replace(self, state=state)

    def update(self, measure: Measure) -> DriftFilter:
        """The filter after a measurement."""
        updated = replace(
            self,
            state=measure(self.state, self.process_noise).state,
            log=self.log.with_item(measure),
            unmeasured=None,
            measured=self.measured + 1,
        )
        if self.adapts and updated.measured in ESTIMATED_AFTER and self.process_noise.psd > 0.0:
            return updated._estimate_process_noise()
        return updated

    def _estimate_process_noise(self) -> DriftFilter:
        """Estimate the process noise from all measurements: the first guess is worth less than they are."""
        events = self.events
        times = [event.time_s for event in events if isinstance(event, Predict)]
        interval_s = float(np.median(np.diff([self.start.time_s, *times])))
        near = self.process_noise
        if interval_s > 0.0:
            near = replace(near, time_constant_s=TIME_CONSTANT_FRAMES * interval_s)
        process_noise = estimate_process_noise(self.start, events, near, (1.0,), LARGER_SIGMAS)
        state = replay(self.start, events, process_noise)
        return replace(self, process_noise=process_noise, state=state)

    def widen_measurements(self, covariance: Array) -> DriftFilter:
        """Add a covariance (2, 2) of the shift to all measurements so far, or to the present drift where they are no
        longer kept.
        """
        if not self.keeps_history and self.measured >= ESTIMATED_AFTER[-1]:
            both = np.zeros((6, 6))
            both[:2, :2] = covariance
            return self.apply(Inflate(both))
        events = tuple(
            event.widened(covariance) if isinstance(event, Measure | CloneKeyframe) else event
            for event in self.log
        )
        return replace(
            self,
            log=SharedSequence.of(events),
            state=replay(self.start, events, self.process_noise),
        )

    def widen_pulled(self, measure: Measure, pull: Array) -> DriftFilter:
        """Widen all measurements so far against the keyframe of ``measure``, which is seen to be pulled by ``pull``
        (2,): those before were by as much less as their shifts are shorter, and all alike, so that together they say no
        more than one.

        Measurements that are no longer kept stay as they were.
        """
        reach, size = float(np.hypot(*measure.shift[:2])), float(np.hypot(*pull))
        along = pull / size
        count = sum(isinstance(e, Measure) and e.key == measure.key for e in self.log)

        def widened(event: Event) -> Event:
            if not isinstance(event, Measure) or event.key != measure.key:
                return event
            part = min(float(np.hypot(*event.shift[:2])) / reach, 1.0) if reach > 0.0 else 1.0
            squared, outer = (part * size) ** 2, np.outer(along, along)
            lacks = count * squared - float(along @ event.covariance[:2, :2] @ along)
            return event.widened(lacks * outer, squared * outer) if lacks > 0.0 else event

        events = tuple(widened(event) for event in self.log)
        if all(new is old for new, old in zip(events, self.log, strict=True)):
            return self
        state = replay(self.start, events, self.process_noise)
        return replace(self, log=SharedSequence.of(events), state=state)

    def set_flicker(self, flicker: Array) -> DriftFilter:
        """Set the variances (4,) of :attr:`.process_noise.ProcessNoise.flicker`."""
        x, y, vx, vy = flicker.tolist()
        return replace(self, process_noise=replace(self.process_noise, flicker=(x, y, vx, vy)))

    def adapt_process_noise(self, nis: float, noise: Array, dt_s: float) -> DriftFilter:
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
        if not self.adapts or self.measured <= 1 or not dt_s > 0.0:
            return self
        excess = float(np.clip(0.5 * nis, 0.0, INNOVATION_RATIO_MAX)) - 1.0
        least = 3.0 * MOTION_MIN**2 * 0.5 * float(np.trace(noise)) / dt_s**3
        psd = max(self.process_noise.psd * float(np.exp(ADAPTATION * excess)), least)
        return replace(self, process_noise=replace(self.process_noise, psd=psd))
