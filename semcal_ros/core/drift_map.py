"""Drift and the positions of its keyframes, estimated together.

The state holds the drift p, its velocity v and acceleration a, and for each keyframe j where its
picture lies: the drift m_j at which it seems to have been taken, and the velocity w_j by which it
still is sheared. A frame with noise n that is registered against keyframe j has

    shift = p + a b - m_j - Z e + n,        shear = T v - T_j w_j + n'

with the frame times T, and with b = A^2 / 24 for an acquisition that takes A: so far the mean of an
accelerated drift is from its middle. A zoom is about the principal point, of which the calibration
may have an error e (px) that is the same at all magnifications: with Z = J^-1 - J_j^-1 (m per px)
it looks like a drift when frame and keyframe have different magnifications, and in no other way.
All of this is linear, so one Kalman filter holds it, with every correlation:
the noise of a keyframe is shared by all frames that were registered against it and does not average
out, and coming back to an old keyframe undoes what was lost on the way. A frame that becomes a
keyframe itself seems to lie at ``m_new = m_j + shift`` exactly, noise and all, so that a chain of
keyframes is no more than copies of the state.

Between frames the acceleration is random and fades with a time constant (Singer 1970,
doi:10.1109/TAES.1970.310128; with none it is white, and the drift has a constant velocity but for
that: Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2, doi:10.1002/0471221279). Each operation is
an object that can be done again with another restlessness, and undone backwards
(:mod:`semcal_ros.core.drift_smoothing`). Any length unit will do.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from semcal_ros.core.errors import InvalidValueError

__all__ = [
    "Carry",
    "DriftMap",
    "Drop",
    "Linear",
    "Measure",
    "MeasureOutcome",
    "Move",
    "Operation",
    "Reshear",
    "Restlessness",
    "Settle",
    "Widen",
    "still",
]

Array = NDArray[np.float64]

# Drift, velocity and acceleration; with the error of the principal point; each keyframe.
_MOVING, _OWN, _EACH = 6, 8, 4


@dataclass(frozen=True)
class Restlessness:
    """How the drift changes by itself.

    Attributes
    ----------
    psd
        Power spectral density of the acceleration at low frequencies, length^2 / s^3.
    memory_s
        Time in which an acceleration fades; 0 for a white one.
    """

    psd: float
    memory_s: float = 0.0

    @property
    def acceleration_variance(self) -> float:
        """Of each component in the long run; 0 for a white one, whose variance says nothing."""
        return 0.5 * self.psd / self.memory_s if self.memory_s > 0.0 else 0.0

    def within(self, scan_s: float) -> Array:
        """(4, 4) covariance of the mean drift and the mean velocity over an acquisition, given drift,
        velocity and acceleration at its middle.

        A white acceleration of density q gives ``q A^3 / 320`` and ``q A / 12`` over A seconds; of
        one that lasts longer, the state knows a part.
        """
        unknown = self.psd
        if self.memory_s > 0.0:
            unknown *= min(1.0, 0.5 * scan_s / self.memory_s)
        return np.diag(np.repeat([unknown * scan_s**3 / 320.0, unknown * scan_s / 12.0], 2))

    def over(self, dt_s: float) -> tuple[Array, Array]:
        """(3, 3) transition of ``[x, v, a]`` of one axis over an interval, and its noise."""
        if not self.memory_s > 0.0:
            move = np.array([[1.0, dt_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
            noise = np.zeros((3, 3))
            noise[0, :2] = dt_s**3 / 3.0, dt_s**2 / 2.0
            noise[1, :2] = dt_s**2 / 2.0, dt_s
            return move, noise * self.psd
        # Both at once from one matrix exponential (Van Loan 1978, doi:10.1109/TAC.1978.1101743).
        rates = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / self.memory_s]])
        driving = np.zeros((3, 3))
        driving[2, 2] = 1.0 / self.memory_s**2
        # In units in which the interval is 1.
        unit = np.array([1.0, 1.0 / max(dt_s, 1e-300), 1.0 / max(dt_s, 1e-300) ** 2])
        scaled = rates * dt_s / unit[:, None] * unit[None, :]
        noise = driving * dt_s / np.outer(unit, unit)
        both = scipy.linalg.expm(np.block([[-scaled, noise], [np.zeros((3, 3)), scaled.T]]))
        move = both[3:, 3:].T
        spread = move @ both[:3, 3:]
        return (
            np.asarray(move * unit[:, None] / unit[None, :]),
            np.asarray(0.5 * (spread + spread.T) * np.outer(unit, unit) * self.psd),
        )


@dataclass(frozen=True)
class DriftMap:
    """State at one time.

    Attributes
    ----------
    time_s
        Time of the state, s.
    mean
        (8 + 4 k,) ``[x, y, vx, vy, ax, ay, ex, ey]``, then ``[mx, my, wx, wy]`` of each of the k
        keyframes.
    covariance
        Of ``mean``.
    keys
        Numbers of the keyframes, in the order of the state.
    """

    time_s: float
    mean: Array
    covariance: Array
    keys: tuple[int, ...] = ()

    @property
    def position(self) -> Array:
        """(2,) drift."""
        return self.mean[:2]

    @property
    def velocity(self) -> Array:
        """(2,) drift velocity, per s."""
        return self.mean[2:4]

    @property
    def acceleration(self) -> Array:
        """(2,) drift acceleration, per s^2."""
        return self.mean[4:6]

    @property
    def motion(self) -> Array:
        """(4,) velocity and acceleration."""
        return self.mean[2:6]

    @property
    def centre_error_px(self) -> tuple[Array, Array]:
        """(2,) error of the principal point that the zooms so far tell, px, and its covariance."""
        part = slice(_MOVING, _OWN)
        return self.mean[part], self.covariance[part, part]

    @property
    def own(self) -> Array:
        """(4, 4) covariance of drift and velocity."""
        return self.covariance[:4, :4]

    def of(self, key: int) -> slice:
        """Where a keyframe's four numbers stand."""
        start = _OWN + _EACH * self.keys.index(key)
        return slice(start, start + _EACH)

    def where(self, key: int) -> Array:
        """(4,) ``[mx, my, wx, wy]`` of a keyframe."""
        return self.mean[self.of(key)]

    def shift_from(self, key: int) -> tuple[Array, Array]:
        """Expected shift (2,) of a frame taken now against a keyframe, and its covariance (2, 2)."""
        row = np.zeros((2, self.mean.size))
        at = self.of(key).start
        row[:, :2], row[:, at : at + 2] = np.eye(2), -np.eye(2)
        return row @ self.mean, row @ self.covariance @ row.T


def still(time_s: float, centre_covariance: Array | None = None) -> DriftMap:
    """The beginning: no drift, by definition, and no velocity known yet.

    ``centre_covariance`` (2, 2) is that of the principal point, px^2; None where it is known.
    """
    covariance = np.zeros((_OWN, _OWN))
    if centre_covariance is not None:
        covariance[_MOVING:, _MOVING:] = centre_covariance
    return DriftMap(time_s, np.zeros(_OWN), covariance)


@dataclass(frozen=True)
class Linear:
    """``new = matrix old + offset`` plus noise of ``covariance``, at ``time_s`` with ``keys``."""

    matrix: Array
    offset: Array
    covariance: Array
    time_s: float
    keys: tuple[int, ...]

    def of(self, state: DriftMap) -> DriftMap:
        """The new state."""
        covariance = self.matrix @ state.covariance @ self.matrix.T + self.covariance
        mean = self.matrix @ state.mean + self.offset
        return DriftMap(self.time_s, mean, 0.5 * (covariance + covariance.T), self.keys)


def _same(state: DriftMap) -> Linear:
    size = state.mean.size
    return Linear(np.eye(size), np.zeros(size), np.zeros((size, size)), state.time_s, state.keys)


class Operation:
    """Something that happens to the state and is linear."""

    def linear(self, state: DriftMap, restlessness: Restlessness) -> Linear:
        """Its matrices for a state."""
        raise NotImplementedError

    def __call__(self, state: DriftMap, restlessness: Restlessness) -> DriftMap:
        """The state after it."""
        return self.linear(state, restlessness).of(state)


@dataclass(frozen=True)
class Move(Operation):
    """Time goes on until ``time_s``."""

    time_s: float

    def linear(self, state: DriftMap, restlessness: Restlessness) -> Linear:
        """As described in the module.

        Raises
        ------
        InvalidValueError
            If the time is earlier than the state's, or the restlessness negative.
        """
        dt = self.time_s - state.time_s
        if not (dt >= 0.0 and restlessness.psd >= 0.0 and restlessness.memory_s >= 0.0):
            raise InvalidValueError(
                f"a prediction from {state.time_s} s to {self.time_s} s with {restlessness}",
                expected="a later time and numbers >= 0",
            )
        step = _same(state)
        if dt > 0.0:
            move, noise = restlessness.over(dt)
            step.matrix[:_MOVING, :_MOVING] = np.kron(move, np.eye(2))
            step.covariance[:_MOVING, :_MOVING] = np.kron(noise, np.eye(2))
        return replace(step, time_s=self.time_s)


@dataclass(frozen=True)
class Widen(Operation):
    """Drift, velocity and acceleration become more uncertain: noise of ``covariance`` (6, 6) is
    added.
    """

    covariance: Array

    def linear(self, state: DriftMap, restlessness: Restlessness) -> Linear:
        """As described."""
        step = _same(state)
        step.covariance[:_MOVING, :_MOVING] = self.covariance
        return step


@dataclass(frozen=True)
class Settle(Operation):
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

    def linear(self, state: DriftMap, restlessness: Restlessness) -> Linear:
        """As described."""
        size = state.mean.size
        matrix = np.vstack([np.eye(size), np.eye(_EACH, size)])
        matrix[size : size + 2, 4:6] = self.bow * np.eye(2)
        covariance = np.zeros((size + _EACH, size + _EACH))
        covariance[size:, size:] = self.noise + restlessness.within(self.scan_s)
        offset = np.zeros(size + _EACH)
        offset[size : size + 2] = -self.bow * self.removed[2:]
        offset[size + 2 :] = -self.removed[:2]
        return Linear(matrix, offset, covariance, state.time_s, (*state.keys, self.key))


@dataclass(frozen=True)
class Carry(Operation):
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

    def linear(self, state: DriftMap, restlessness: Restlessness) -> Linear:
        """As described."""
        size = state.mean.size
        matrix = np.vstack([np.eye(size), np.zeros((_EACH, size))])
        at = state.of(self.parent)
        matrix[size:, at] = np.diag([1.0, 1.0, self.time_ratio, self.time_ratio])
        matrix[size : size + 2, _MOVING:_OWN] = self.zoom
        covariance = np.zeros((size + _EACH, size + _EACH))
        covariance[size:, size:] = self.noise
        offset = np.append(np.zeros(size), self.shift)
        return Linear(matrix, offset, covariance, state.time_s, (*state.keys, self.key))


@dataclass(frozen=True)
class Reshear(Operation):
    """Another velocity and acceleration ``removed`` (4,) were taken out of keyframe ``key``."""

    key: int
    removed: Array
    bow: float

    def linear(self, state: DriftMap, restlessness: Restlessness) -> Linear:
        """As described."""
        step = _same(state)
        at = state.of(self.key)
        step.offset[at.start : at.start + 2] = -self.bow * self.removed[2:]
        step.offset[at.start + 2 : at.stop] = -self.removed[:2]
        return step


@dataclass(frozen=True)
class Drop(Operation):
    """Keyframe ``key`` is forgotten."""

    key: int

    def linear(self, state: DriftMap, restlessness: Restlessness) -> Linear:
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
    innovation, innovation_covariance
        Measurement minus prediction, and what prediction and noise lead one to expect of it.
    nis
        Normalised innovation squared of the shift alone; chi-square with 2 degrees of freedom when
        all is well.
    shear_nis
        That of the shear, given the shift; 0 where there is none.
    """

    state: DriftMap
    innovation: Array
    innovation_covariance: Array
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

    def row(self, state: DriftMap) -> Array:
        """(2 or 4, n) derivative of the measurement by the state."""
        count, at = self.shift.size, state.of(self.key).start
        row = np.zeros((count, state.mean.size))
        row[:, :count] = np.eye(count)
        row[:2, 4:6] = self.bow * np.eye(2)
        row[:2, _MOVING:_OWN] = -self.zoom
        factors = [1.0, 1.0, self.time_ratio, self.time_ratio]
        row[:, at : at + count] = -np.diag(factors[:count])
        return row

    def __call__(self, state: DriftMap, restlessness: Restlessness) -> MeasureOutcome:
        """The state with the measurement used.

        Raises
        ------
        InvalidValueError
            If the measurement is not finite or its covariance not positive definite.
        """
        row = self.row(state)
        count = self.shift.size
        noise = self.covariance + restlessness.within(self.scan_s)[:count, :count]
        innovation = self.shift - row @ state.mean
        mixed = state.covariance @ row.T
        expected = row @ mixed + noise
        expected = 0.5 * (expected + expected.T)
        unit = np.sqrt(np.maximum(np.diag(expected), 0.0))
        if not (np.all(np.isfinite(innovation)) and np.all(unit > 0.0)):
            raise InvalidValueError(
                f"measured shift {self.shift.tolist()} with covariance {self.covariance.tolist()}",
                expected="finite numbers and a positive definite covariance",
            )
        # Metres and metres per second differ by orders of magnitude.
        scaled = np.linalg.inv(expected / np.outer(unit, unit))
        inverse = scaled / np.outer(unit, unit)
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
        return MeasureOutcome(new, innovation, expected, nis, max(both - nis, 0.0))

    def of_shift(self) -> Measure:
        """The measurement without its shear."""
        return replace(self, shift=self.shift[:2], covariance=self.covariance[:2, :2])


def _square(vector: Array, covariance: Array) -> float:
    return float(vector @ np.linalg.solve(covariance, vector))
