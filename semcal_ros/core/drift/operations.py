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

"""What happens to the state of the drift: time, frames that become keyframes, measurements.

Everything but a measurement is a linear map with noise. It is an object, so that it can be done
again with another process noise and undone backwards (:mod:`semcal_ros.core.drift.smoother`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import Array, equilibrate, invert_scaled
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.state import BASE_SIZE, KEYFRAME_SIZE, MOTION_SIZE, DriftState
from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True)
class Transition:
    """``new = matrix old + offset`` plus noise of ``covariance``, at ``time_s`` with ``keys``."""

    matrix: Array
    offset: Array
    covariance: Array
    time_s: float
    keys: tuple[int, ...]

    def apply(self, state: DriftState) -> DriftState:
        """The new state."""
        covariance = self.matrix @ state.covariance @ self.matrix.T + self.covariance
        mean = self.matrix @ state.mean + self.offset
        return DriftState(self.time_s, mean, 0.5 * (covariance + covariance.T), self.keys)


def _identity(state: DriftState) -> Transition:
    size = state.mean.size
    return Transition(
        np.eye(size), np.zeros(size), np.zeros((size, size)), state.time_s, state.keys
    )


class Operation(ABC):
    """A linear map of the state."""

    @abstractmethod
    def transition(self, state: DriftState, process_noise: ProcessNoise) -> Transition:
        """The map at a state."""

    def __call__(self, state: DriftState, process_noise: ProcessNoise) -> DriftState:
        """The state afterwards."""
        return self.transition(state, process_noise).apply(state)


@dataclass(frozen=True)
class Predict(Operation):
    """Time passes until ``time_s``."""

    time_s: float

    def transition(self, state: DriftState, process_noise: ProcessNoise) -> Transition:
        """The map; see the base class.

        Raises
        ------
        InvalidValueError
            If the time is earlier than the state's, or the process noise is negative.
        """
        dt = self.time_s - state.time_s
        if not (
            0.0 <= dt < np.inf and process_noise.psd >= 0.0 and process_noise.time_constant_s >= 0.0
        ):
            raise InvalidValueError(
                f"a prediction from {state.time_s} s to {self.time_s} s with {process_noise}",
                expected="a later time and numbers >= 0",
            )
        step = _identity(state)
        if dt > 0.0:
            transition, noise = process_noise.discretise(dt)
            for axis in (0, 1):
                of_axis = slice(axis, MOTION_SIZE, 2)
                step.matrix[of_axis, of_axis] = transition
                step.covariance[of_axis, of_axis] = noise
        return replace(step, time_s=self.time_s)


@dataclass(frozen=True)
class Inflate(Operation):
    """The covariance of drift, velocity and acceleration grows by ``covariance`` (6, 6)."""

    covariance: Array

    def transition(self, state: DriftState, process_noise: ProcessNoise) -> Transition:
        """The map; see the base class."""
        step = _identity(state)
        step.covariance[:MOTION_SIZE, :MOTION_SIZE] = self.covariance
        return step


@dataclass(frozen=True)
class AddKeyframe(Operation):
    """The present frame becomes keyframe ``key`` without having been measured.

    Attributes
    ----------
    key
        Number of the keyframe.
    removed
        (4,) velocity and acceleration that were taken out of its image.
    acceleration_term_s2
        b of :mod:`semcal_ros.core.drift.state`.
    noise
        (4, 4) noise of the position and the shear of its image.
    scan_s
        Time that the frame took, s.
    """

    key: int
    removed: Array
    acceleration_term_s2: float
    noise: Array
    scan_s: float

    def transition(self, state: DriftState, process_noise: ProcessNoise) -> Transition:
        """The map; see the base class."""
        size = state.mean.size
        matrix = np.vstack([np.eye(size), np.eye(KEYFRAME_SIZE, size)])
        matrix[size : size + 2, 4:6] = self.acceleration_term_s2 * np.eye(2)
        covariance = np.zeros((size + KEYFRAME_SIZE, size + KEYFRAME_SIZE))
        covariance[size:, size:] = self.noise + process_noise.frame_covariance(self.scan_s)
        offset = np.zeros(size + KEYFRAME_SIZE)
        offset[size : size + 2] = -self.acceleration_term_s2 * self.removed[2:]
        offset[size + 2 :] = -self.removed[:2]
        return Transition(matrix, offset, covariance, state.time_s, (*state.keys, self.key))


@dataclass(frozen=True)
class CloneKeyframe(Operation):
    """The present frame becomes keyframe ``key``, as it was measured against ``parent``.

    Attributes
    ----------
    key, parent
        Numbers of the keyframes.
    shift
        (4,) what was measured: the shift, and the shear over the frame time.
    shear_ratio
        What the frame shows of a velocity that is left in the parent's shear: the frame time of the parent over that of
        the frame, times the height of the frame's field over that of the parent's.
    noise
        (4, 4) added to the covariance.
    zoom
        (2, 2) Z of :mod:`semcal_ros.core.drift.state`.
    """

    key: int
    parent: int
    shift: Array
    shear_ratio: float
    noise: Array
    zoom: Array = field(default_factory=lambda: np.zeros((2, 2)))

    def widened(self, covariance: Array) -> CloneKeyframe:
        """The same with a covariance (2, 2) added to that of the shift."""
        noise = self.noise.copy()
        noise[:2, :2] += covariance
        return replace(self, noise=noise)

    def transition(self, state: DriftState, process_noise: ProcessNoise) -> Transition:
        """The map; see the base class."""
        size = state.mean.size
        matrix = np.vstack([np.eye(size), np.zeros((KEYFRAME_SIZE, size))])
        keyframe = state.keyframe_slice(self.parent)
        matrix[size:, keyframe] = np.diag([1.0, 1.0, self.shear_ratio, self.shear_ratio])
        matrix[size : size + 2, MOTION_SIZE:BASE_SIZE] = self.zoom
        covariance = np.zeros((size + KEYFRAME_SIZE, size + KEYFRAME_SIZE))
        covariance[size:, size:] = self.noise
        offset = np.append(np.zeros(size), self.shift)
        return Transition(matrix, offset, covariance, state.time_s, (*state.keys, self.key))


@dataclass(frozen=True)
class CorrectShear(Operation):
    """A further velocity and acceleration ``removed`` (4,) are taken out of keyframe ``key``."""

    key: int
    removed: Array
    acceleration_term_s2: float

    def transition(self, state: DriftState, process_noise: ProcessNoise) -> Transition:
        """The map; see the base class."""
        step = _identity(state)
        keyframe = state.keyframe_slice(self.key)
        step.offset[keyframe.start : keyframe.start + 2] = (
            -self.acceleration_term_s2 * self.removed[2:]
        )
        step.offset[keyframe.start + 2 : keyframe.stop] = -self.removed[:2]
        return step


@dataclass(frozen=True)
class Marginalise(Operation):
    """Keyframe ``key`` leaves the state."""

    key: int

    def transition(self, state: DriftState, process_noise: ProcessNoise) -> Transition:
        """The map; see the base class."""
        size, keyframe = state.mean.size, state.keyframe_slice(self.key)
        kept = np.delete(np.arange(size), np.arange(keyframe.start, keyframe.stop))
        keys = tuple(k for k in state.keys if k != self.key)
        matrix = np.eye(size)[kept]
        empty = np.zeros((kept.size, kept.size))
        return Transition(matrix, np.zeros(kept.size), empty, state.time_s, keys)


@dataclass(frozen=True)
class MeasureOutcome:
    """Outcome of :class:`Measure`.

    Attributes
    ----------
    state
        The updated state.
    jacobian
        (2 or 4, n) derivative of the measurement with respect to the state.
    innovation, innovation_covariance
        Measurement minus prediction, and the covariance expected of it.
    gain
        (n, 2 or 4) Kalman gain.
    nis
        Normalised innovation squared of the shift alone; chi-square with 2 degrees of freedom when
        all is well.
    shear_nis
        That of the shear, given the shift; 0 where there is none.
    """

    state: DriftState
    jacobian: Array
    innovation: Array
    innovation_covariance: Array
    gain: Array
    nis: float
    shear_nis: float


@dataclass(frozen=True)
class Measure:
    """A registration against keyframe ``key``.

    Attributes
    ----------
    shift
        (2,) shift, or (4,) shift and shear as a velocity (the shear over the frame time). The
        motion that was taken out of the frame is added again: the velocity to the shear, and b
        times the acceleration to the shift.
    covariance
        Covariance of ``shift`` from the noise of the frame alone.
    shear_ratio
        What the frame shows of a velocity that is left in the keyframe's shear: the frame time of the keyframe over
        that of the frame, times the height of the frame's field over that of the keyframe's.
    acceleration_term_s2
        b of :mod:`semcal_ros.core.drift.state`.
    scan_s
        Time that the frame took.
    zoom
        (2, 2) Z of :mod:`semcal_ros.core.drift.state`.
    independent, common
        What of the covariance differs from frame to frame, as large as that, or None where all of it does; and (2, 2)
        the covariance of what pulls the shift of this frame and those of others alike. A filter that knows nothing of
        such a pull takes ``covariance``, which may be larger than both.

    Raises
    ------
    InvalidValueError
        If the measurement is not finite or its covariance not positive definite.
    """

    key: int
    shift: Array
    covariance: Array
    shear_ratio: float = 1.0
    acceleration_term_s2: float = 0.0
    scan_s: float = 0.0
    zoom: Array = field(default_factory=lambda: np.zeros((2, 2)))
    independent: Array | None = None
    common: Array = field(default_factory=lambda: np.zeros((2, 2)))

    def __post_init__(self) -> None:
        # Here and not with each use: the likelihood of a process noise applies all measurements once more.
        values = np.append(self.shift, self.covariance)
        good = bool(np.all(np.isfinite(values)))
        if good:
            good = bool(np.all(np.diag(self.covariance) > 0.0))
        if good:
            good = float(np.linalg.eigvalsh(equilibrate(self.covariance)[0])[0]) > 0.0
        if not good:
            raise InvalidValueError(
                f"measured shift {self.shift.tolist()} with covariance {self.covariance.tolist()}",
                expected="finite numbers and a positive definite covariance",
            )

    def widened(self, covariance: Array, common: Array | None = None) -> Measure:
        """The same with a covariance (2, 2) added to that of the shift, and to that of the shear as if it had grown by
        as much in the time of a scan. Where ``common`` (2, 2) is told, it is that of a pull of other frames, too.
        """
        wider = replace(self, covariance=self._add(self.covariance, covariance))
        if common is not None:
            independent = self.covariance if self.independent is None else self.independent
            return replace(wider, independent=independent, common=self.common + common)
        if self.independent is None:
            return wider
        return replace(wider, independent=self._add(self.independent, covariance))

    def _add(self, known: Array, covariance: Array) -> Array:
        wider = known.copy()
        wider[:2, :2] += covariance
        if self.shift.size > 2 and self.scan_s > 0.0:
            wider[2:, 2:] += covariance / self.scan_s**2
        return wider

    def with_noise_alone(self) -> Measure:
        """The measurement of which nothing is taken for common to frames."""
        if self.independent is None:
            return self
        return replace(self, independent=None, common=np.zeros((2, 2)))

    def without_common(self) -> Measure:
        """The measurement with the covariance of what differs from frame to frame alone."""
        if self.independent is None:
            return self
        return replace(self, covariance=self.independent, independent=None, common=np.zeros((2, 2)))

    def jacobian(self, state: DriftState) -> Array:
        """(2 or 4, n) derivative of the measurement with respect to the state."""
        count, start = self.shift.size, state.keyframe_slice(self.key).start
        jacobian = np.zeros((count, state.mean.size))
        jacobian[:, :count] = np.eye(count)
        jacobian[:2, 4:6] = self.acceleration_term_s2 * np.eye(2)
        jacobian[:2, MOTION_SIZE:BASE_SIZE] = -self.zoom
        factors = [1.0, 1.0, self.shear_ratio, self.shear_ratio]
        jacobian[:, start : start + count] = -np.diag(factors[:count])
        return jacobian

    def __call__(self, state: DriftState, process_noise: ProcessNoise) -> MeasureOutcome:
        """The state updated by the measurement.

        Raises
        ------
        InvalidValueError
            If the state has no such keyframe.
        """
        if self.key not in state.keys:
            raise InvalidValueError(
                f"a measurement against keyframe {self.key}", expected=f"one of {state.keys}"
            )
        jacobian = self.jacobian(state)
        count = self.shift.size
        noise = self.covariance + process_noise.frame_covariance(self.scan_s)[:count, :count]
        innovation = self.shift - jacobian @ state.mean
        mixed = state.covariance @ jacobian.T
        expected = jacobian @ mixed + noise
        expected = 0.5 * (expected + expected.T)
        # Metres and metres per second differ by orders of magnitude.
        inverse = invert_scaled(expected)
        gain = mixed @ inverse
        # Joseph's form stays symmetric and positive when the measurement is much sharper than the
        # prediction.
        remaining = np.eye(state.mean.size) - gain @ jacobian
        covariance = remaining @ state.covariance @ remaining.T + gain @ noise @ gain.T
        new = replace(
            state,
            mean=state.mean + gain @ innovation,
            covariance=0.5 * (covariance + covariance.T),
        )
        nis = _mahalanobis_square(innovation[:2], expected[:2, :2])
        both = float(innovation @ inverse @ innovation)
        shear_nis = max(both - nis, 0.0)
        return MeasureOutcome(new, jacobian, innovation, expected, gain, nis, shear_nis)

    def without_shear(self) -> Measure:
        """The measurement without its shear."""
        independent = None if self.independent is None else self.independent[:2, :2]
        return replace(
            self,
            shift=self.shift[:2],
            covariance=self.covariance[:2, :2],
            independent=independent,
        )


def _mahalanobis_square(vector: Array, covariance: Array) -> float:
    return float(vector @ np.linalg.solve(covariance, vector))
