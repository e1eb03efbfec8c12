"""What happens to the drift map: time, frames that become keyframes, measurements.

Everything but a measurement is linear with noise of its own: an object that can be done again with
another restlessness, and undone backwards (:mod:`semcal_ros.core.drift.smoother`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import Array, equilibrate, invert_scaled
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.state import EACH, MOVING, OWN, DriftState
from semcal_ros.core.errors import InvalidValueError

__all__ = [
    "AddKeyframe",
    "CloneKeyframe",
    "CorrectShear",
    "Inflate",
    "Linear",
    "Marginalise",
    "Measure",
    "MeasureOutcome",
    "Operation",
    "Predict",
]


@dataclass(frozen=True)
class Linear:
    """``new = matrix old + offset`` plus noise of ``covariance``, at ``time_s`` with ``keys``."""

    matrix: Array
    offset: Array
    covariance: Array
    time_s: float
    keys: tuple[int, ...]

    def of(self, state: DriftState) -> DriftState:
        """The new state."""
        covariance = self.matrix @ state.covariance @ self.matrix.T + self.covariance
        mean = self.matrix @ state.mean + self.offset
        return DriftState(self.time_s, mean, 0.5 * (covariance + covariance.T), self.keys)


def _same(state: DriftState) -> Linear:
    size = state.mean.size
    return Linear(np.eye(size), np.zeros(size), np.zeros((size, size)), state.time_s, state.keys)


class Operation(ABC):
    """Something that happens to the state and is linear."""

    @abstractmethod
    def linear(self, state: DriftState, restlessness: ProcessNoise) -> Linear:
        """Its matrices for a state."""

    def __call__(self, state: DriftState, restlessness: ProcessNoise) -> DriftState:
        """The state after it."""
        return self.linear(state, restlessness).of(state)


@dataclass(frozen=True)
class Predict(Operation):
    """Time goes on until ``time_s``."""

    time_s: float

    def linear(self, state: DriftState, restlessness: ProcessNoise) -> Linear:
        """As described in the module.

        Raises
        ------
        InvalidValueError
            If the time is earlier than the state's, or the restlessness negative.
        """
        dt = self.time_s - state.time_s
        if not (0.0 <= dt < np.inf and restlessness.psd >= 0.0 and restlessness.memory_s >= 0.0):
            raise InvalidValueError(
                f"a prediction from {state.time_s} s to {self.time_s} s with {restlessness}",
                expected="a later time and numbers >= 0",
            )
        step = _same(state)
        if dt > 0.0:
            move, noise = restlessness.over(dt)
            for axis in (0, 1):
                of_axis = slice(axis, MOVING, 2)
                step.matrix[of_axis, of_axis] = move
                step.covariance[of_axis, of_axis] = noise
        return replace(step, time_s=self.time_s)


@dataclass(frozen=True)
class Inflate(Operation):
    """Drift, velocity and acceleration become more uncertain: noise of ``covariance`` (6, 6) is
    added.
    """

    covariance: Array

    def linear(self, state: DriftState, restlessness: ProcessNoise) -> Linear:
        """As described."""
        step = _same(state)
        step.covariance[:MOVING, :MOVING] = self.covariance
        return step


@dataclass(frozen=True)
class AddKeyframe(Operation):
    """The frame of now becomes keyframe ``key`` without having been measured.

    Its picture lies at the drift with its own noise ``noise`` (4, 4); ``removed`` (4,) is the
    velocity and the acceleration that were taken out of it, ``bow`` is b of the module, ``scan_s``
    the time it took.
    """

    key: int
    removed: Array
    bow: float
    noise: Array
    scan_s: float

    def linear(self, state: DriftState, restlessness: ProcessNoise) -> Linear:
        """As described."""
        size = state.mean.size
        matrix = np.vstack([np.eye(size), np.eye(EACH, size)])
        matrix[size : size + 2, 4:6] = self.bow * np.eye(2)
        covariance = np.zeros((size + EACH, size + EACH))
        covariance[size:, size:] = self.noise + restlessness.within(self.scan_s)
        offset = np.zeros(size + EACH)
        offset[size : size + 2] = -self.bow * self.removed[2:]
        offset[size + 2 :] = -self.removed[:2]
        return Linear(matrix, offset, covariance, state.time_s, (*state.keys, self.key))


@dataclass(frozen=True)
class CloneKeyframe(Operation):
    """The frame of now becomes keyframe ``key``, as it was measured against ``parent``.

    ``shift`` (4,) is what was measured: shift, and shear over the frame time; ``time_ratio`` is the
    frame time of the parent over that of the frame; ``noise`` (4, 4) is added; ``zoom`` (2, 2) is Z
    of the module.
    """

    key: int
    parent: int
    shift: Array
    time_ratio: float
    noise: Array
    zoom: Array = field(default_factory=lambda: np.zeros((2, 2)))

    def linear(self, state: DriftState, restlessness: ProcessNoise) -> Linear:
        """As described."""
        size = state.mean.size
        matrix = np.vstack([np.eye(size), np.zeros((EACH, size))])
        at = state.of(self.parent)
        matrix[size:, at] = np.diag([1.0, 1.0, self.time_ratio, self.time_ratio])
        matrix[size : size + 2, MOVING:OWN] = self.zoom
        covariance = np.zeros((size + EACH, size + EACH))
        covariance[size:, size:] = self.noise
        offset = np.append(np.zeros(size), self.shift)
        return Linear(matrix, offset, covariance, state.time_s, (*state.keys, self.key))


@dataclass(frozen=True)
class CorrectShear(Operation):
    """Another velocity and acceleration ``removed`` (4,) were taken out of keyframe ``key``."""

    key: int
    removed: Array
    bow: float

    def linear(self, state: DriftState, restlessness: ProcessNoise) -> Linear:
        """As described."""
        step = _same(state)
        at = state.of(self.key)
        step.offset[at.start : at.start + 2] = -self.bow * self.removed[2:]
        step.offset[at.start + 2 : at.stop] = -self.removed[:2]
        return step


@dataclass(frozen=True)
class Marginalise(Operation):
    """Keyframe ``key`` is forgotten."""

    key: int

    def linear(self, state: DriftState, restlessness: ProcessNoise) -> Linear:
        """As described."""
        size, at = state.mean.size, state.of(self.key)
        kept = np.delete(np.arange(size), np.arange(at.start, at.stop))
        keys = tuple(k for k in state.keys if k != self.key)
        matrix = np.eye(size)[kept]
        empty = np.zeros((kept.size, kept.size))
        return Linear(matrix, np.zeros(kept.size), empty, state.time_s, keys)


@dataclass(frozen=True)
class MeasureOutcome:
    """Outcome of :class:`Measure`.

    Attributes
    ----------
    state
        The updated state.
    row
        (2 or 4, n) derivative of the measurement by the state.
    innovation, innovation_covariance
        Measurement minus prediction, and what prediction and noise lead one to expect of it.
    gain
        (n, 2 or 4) by which the innovation changes the state.
    nis
        Normalised innovation squared of the shift alone; chi-square with 2 degrees of freedom when
        all is well.
    shear_nis
        That of the shear, given the shift; 0 where there is none.
    """

    state: DriftState
    row: Array
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
        (2,) shift, or (4,) shift and shear as a velocity (the shear over the frame time). What was
        taken out of the frame before is added: the velocity, and to the shift b times the
        acceleration.
    covariance
        Of ``shift``: the noise of the frame alone.
    time_ratio
        Frame time of the keyframe over that of the frame.
    bow
        b of the module.
    scan_s
        Time that the frame took.
    zoom
        (2, 2) Z of the module.
    """

    key: int
    shift: Array
    covariance: Array
    time_ratio: float = 1.0
    bow: float = 0.0
    scan_s: float = 0.0
    zoom: Array = field(default_factory=lambda: np.zeros((2, 2)))

    def row(self, state: DriftState) -> Array:
        """(2 or 4, n) derivative of the measurement by the state."""
        count, at = self.shift.size, state.of(self.key).start
        row = np.zeros((count, state.mean.size))
        row[:, :count] = np.eye(count)
        row[:2, 4:6] = self.bow * np.eye(2)
        row[:2, MOVING:OWN] = -self.zoom
        factors = [1.0, 1.0, self.time_ratio, self.time_ratio]
        row[:, at : at + count] = -np.diag(factors[:count])
        return row

    def __call__(self, state: DriftState, restlessness: ProcessNoise) -> MeasureOutcome:
        """The state with the measurement used.

        Raises
        ------
        InvalidValueError
            If the measurement is not finite or its covariance not positive definite.
        """
        self._check(state)
        row = self.row(state)
        count = self.shift.size
        noise = self.covariance + restlessness.within(self.scan_s)[:count, :count]
        innovation = self.shift - row @ state.mean
        mixed = state.covariance @ row.T
        expected = row @ mixed + noise
        expected = 0.5 * (expected + expected.T)
        # Metres and metres per second differ by orders of magnitude.
        inverse = invert_scaled(expected)
        gain = mixed @ inverse
        # Joseph's form stays symmetric and positive when the measurement is much sharper than the
        # prediction.
        keep = np.eye(state.mean.size) - gain @ row
        covariance = keep @ state.covariance @ keep.T + gain @ noise @ gain.T
        new = replace(
            state,
            mean=state.mean + gain @ innovation,
            covariance=0.5 * (covariance + covariance.T),
        )
        nis = _square(innovation[:2], expected[:2, :2])
        both = float(innovation @ inverse @ innovation)
        shear_nis = max(both - nis, 0.0)
        return MeasureOutcome(new, row, innovation, expected, gain, nis, shear_nis)

    def _check(self, state: DriftState) -> None:
        if self.key not in state.keys:
            raise InvalidValueError(
                f"a measurement against keyframe {self.key}", expected=f"one of {state.keys}"
            )
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

    def of_shift(self) -> Measure:
        """The measurement without its shear."""
        return replace(self, shift=self.shift[:2], covariance=self.covariance[:2, :2])


def _square(vector: Array, covariance: Array) -> float:
    return float(vector @ np.linalg.solve(covariance, vector))
