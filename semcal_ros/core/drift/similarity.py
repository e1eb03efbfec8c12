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

"""Rotation and scale of the specimen's image, where a stream shows any.

Stages and scan coils turn and magnifications creep by a few hundredths of a degree or parts in 10 000 from
frame to frame. What lay at X, counted from the origin of the sem frame, is then seen at

    M X + drift,        M = exp(s) R(theta).

Matrices like M commute, and theta and s of two in a row add. So a frame without its M and a keyframe
without its own differ by a shift alone, and the filter of the drift holds ``u = M^-1 drift``. A second
filter of the same kind (:mod:`semcal_ros.core.drift.filter`) holds ``(theta, s)`` in the place of x
and y, with the (theta, s) at which each keyframe seems to have been taken.

Most streams do not turn. Nothing is estimated, and nothing changes, until frames contradict a shift
alone at a level that chance reaches once in a million frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import Array, solve_scaled
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.measurement import keyframe_noise
from semcal_ros.core.drift.operations import (
    CloneKeyframe,
    Inflate,
    Marginalise,
    Measure,
    Operation,
    Predict,
    Transition,
)
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.shared_sequence import SharedSequence
from semcal_ros.core.drift.smoother import estimate_process_noise, smooth
from semcal_ros.core.drift.state import KEYFRAME_SIZE, MOTION_SIZE, DriftState, initial_state
from semcal_ros.core.drift.thresholds import (
    INNOVATION_CHI2_MAX,
    INTERVAL_S_MIN,
    RAW_DISTORTION,
    RAW_OFF_CENTRE,
    SCREEN_SIGMAS,
    TURN_FLOOR_PX,
    TURN_OF_SHIFT,
    UNMEASURED_TURN,
    UNPREDICTED_MAX,
)
from semcal_ros.core.rectification.raw_positions import rotation_centre, similarity_matrix
from semcal_ros.core.registration.inverse_compositional import Alignment, SimilarityFit
from semcal_ros.core.registration.register import Registration

# Places of the parameters in ScanCamera.covariance.
_DISTORTIONS, _DISTORTION_CENTRE = slice(6, 8), slice(8, 10)


@dataclass(frozen=True)
class SimilarityEstimate:
    """Rotation and scale at one time.

    Attributes
    ----------
    mean
        (4,) rotation (rad, from x towards y) and logarithm of the scale since the first frame, and
        their rates per s.
    covariance
        (4, 4); infinite where nothing is known.
    """

    mean: Array
    covariance: Array


@dataclass(frozen=True)
class SimilarityMatch:
    """What a registration says of rotation and scale.

    Attributes
    ----------
    fit
        The fit, or None where there was too little to compare.
    removed
        (2,) rotation and scale that were taken out of the frame beforehand.
    operations
        What happens to the filter when the match is used; empty before there is one.
    turn, covariance
        (2,) rotation and scale of the frame against the keyframe, given all that is known, and (2, 2).
    nis
        Normalised innovation squared.
    """

    fit: SimilarityFit | None
    removed: Array
    operations: tuple[Inflate | Measure, ...]
    turn: Array
    covariance: Array
    nis: float = float("nan")

    def remaining_px(self, size: tuple[int, int]) -> float:
        """How far pixels at the edge still are from where they belong."""
        return float(np.hypot(*(self.turn - self.removed))) * 0.5 * max(size)


@dataclass(frozen=True)
class PlaceKeyframe(Operation):
    """Keyframe ``key`` appears with the present rotation and scale plus ``offset`` (2,), or, where it
    does not follow the state, with those of ``offset``; ``noise`` is (2, 2).
    """

    key: int
    offset: Array
    noise: Array
    follows: bool

    def transition(self, state: DriftState, process_noise: ProcessNoise) -> Transition:
        """The map; see the base class."""
        del process_noise
        size = state.mean.size
        matrix = np.vstack([np.eye(size), np.zeros((KEYFRAME_SIZE, size))])
        if self.follows:
            matrix[size : size + 2, :2] = np.eye(2)
        offset = np.zeros(size + KEYFRAME_SIZE)
        offset[size : size + 2] = self.offset
        covariance = np.zeros((size + KEYFRAME_SIZE, size + KEYFRAME_SIZE))
        covariance[size : size + 2, size : size + 2] = self.noise
        return Transition(matrix, offset, covariance, state.time_s, (*state.keys, self.key))


@dataclass(frozen=True)
class QuietKeyframe:
    """Rotation and scale of a keyframe while none was found: a sum of insignificant measurements.

    ``visit`` is the variance of its scale against that of the present visit of the magnification; zero in the same one.
    """

    mean: Array
    covariance: Array
    time_s: float
    visit: float = 0.0


@dataclass(frozen=True)
class SimilarityPredictor:
    """All that a prediction of rotation and scale needs."""

    state: DriftState
    process_noise: ProcessNoise

    def at(self, time_s: float) -> SimilarityEstimate:
        """Predict rotation and scale."""
        return _estimate(Predict(time_s)(self.state, self.process_noise))


@dataclass(frozen=True)
class SimilarityState:
    """What a stream has shown of rotation and scale: looked for, and followed once they are found. What happens to it
    makes another one.

    Attributes
    ----------
    keeps_history
        Whether to keep what a smoother needs.
    filter
        The filter that follows them; None until any were found.
    quiet
        The keyframes before, by number.
    times
        Times of the frames before, where the history is kept.
    suspected
        Time of the latest frame that showed any, and what it showed (2,).
    before_marks
        Number of frames before the keyframe at which the filter starts.
    was_outlier
        Whether the latest measurement was too far from its prediction.
    """

    keeps_history: bool
    filter: DriftFilter | None = None
    quiet: dict[int, QuietKeyframe] = field(default_factory=dict)
    times: SharedSequence[float] = field(default_factory=SharedSequence)
    suspected: tuple[float, Array] | None = None
    before_marks: int = 0
    was_outlier: bool = False

    @property
    def is_active(self) -> bool:
        """Whether rotation or scale was found."""
        return self.filter is not None

    # -- time and keyframes -----------------------------------------------------------------------

    def predict(self, time_s: float) -> SimilarityState:
        """Predict until a time."""
        return self if self.filter is None else self._apply(self.filter, Predict(time_s))

    def change_visit(self, variance: float) -> SimilarityState:
        """Note a change of the magnification, since which all scales are others by a ``variance``: a step, and no
        beginning of a creep.
        """
        if self.filter is None:
            quiet = {key: replace(known, visit=variance) for key, known in self.quiet.items()}
            return replace(self, quiet=quiet, suspected=None)
        spread = np.zeros((MOTION_SIZE, MOTION_SIZE))
        spread[1, 1] = variance
        return self._apply(self.filter, Inflate(spread))

    def mark_frame(self, time_s: float) -> SimilarityState:
        """Note that the present state is that of a frame."""
        if self.filter is not None:
            return replace(self, filter=self.filter.mark_frame())
        return replace(self, times=self.times.with_item(time_s)) if self.keeps_history else self

    def add_keyframe(self, key: int, removed: Array, time_s: float) -> SimilarityState:
        """Note a keyframe that was not measured, from a frame without ``removed`` (2,)."""
        if self.filter is not None:
            place = PlaceKeyframe(key, -removed, np.zeros((2, 2)), follows=True)
            return self._apply(self.filter, place)
        latest = next(reversed(self.quiet.values()), None)
        covariance = np.zeros((2, 2)) if latest is None else latest.covariance
        return self._with_quiet(key, QuietKeyframe(np.zeros(2), covariance, time_s))

    def clone_keyframe(
        self, key: int, parent: int, registration: Registration, removed: Array, time_s: float
    ) -> SimilarityState:
        """Note a frame that became a keyframe as it was measured against ``parent``."""
        fit = registration.fit_similarity()
        if self.filter is not None:
            if fit is None or not np.all(np.isfinite(fit.covariance)):
                return self.add_keyframe(key, removed, time_s)
            shift = np.append(fit.values[4:], np.zeros(2))
            clone = CloneKeyframe(key, parent, shift, 1.0, np.zeros((4, 4)))
            return self._apply(self.filter, clone)
        mean, covariance = self.quiet[parent].mean, self.quiet[parent].covariance
        if fit is None:
            covariance = covariance + np.eye(2) * UNMEASURED_TURN**2
        else:
            mean, covariance = mean + fit.values[4:], covariance + fit.covariance[4:, 4:]
        return self._with_quiet(key, QuietKeyframe(mean, covariance, time_s))

    def forget(self, key: int) -> SimilarityState:
        """Forget a keyframe."""
        rest = {k: quiet for k, quiet in self.quiet.items() if k != key}
        known = replace(self, quiet=rest)
        return known if known.filter is None else known._apply(known.filter, Marginalise(key))

    def _apply(self, drift_filter: DriftFilter, operation: Operation) -> SimilarityState:
        return replace(self, filter=drift_filter.apply(operation))

    def _with_quiet(self, key: int, quiet: QuietKeyframe) -> SimilarityState:
        return replace(self, quiet={**self.quiet, key: quiet})

    def keyframe_similarity(self, key: int) -> Array:
        """(2,) rotation and scale with which a keyframe appears."""
        if self.filter is None:
            return np.zeros(2)
        return self.filter.state.keyframe_state(key)[:2].copy()

    def expected_turn(self, key: int) -> Array:
        """(2,) rotation and scale of the present frame against a keyframe, as they are predicted."""
        if self.filter is None:
            return np.zeros(2)
        return self.filter.state.position - self.keyframe_similarity(key)

    @property
    def keys(self) -> tuple[int, ...]:
        """Numbers of the keyframes, once rotation or scale was found."""
        return () if self.filter is None else self.filter.state.keys

    @property
    def position(self) -> Array:
        """(2,) rotation and scale at the present time."""
        return np.zeros(2) if self.filter is None else self.filter.state.position.copy()

    @property
    def rate(self) -> Array:
        """(2,) rates of rotation and scale, per s."""
        return np.zeros(2) if self.filter is None else self.filter.state.velocity.copy()

    # -- measurements -----------------------------------------------------------------------------

    def suggest_turn(
        self, key: int, registration: Registration, removed: Array, frame: ScanFrame
    ) -> Array | None:
        """(2,) rotation and scale to take out of a frame whose registration failed without; None where
        they would explain nothing.
        """
        fit = registration.fit_similarity()
        if fit is None:
            return None
        turn = removed + fit.values[4:]
        covariance = fit.covariance[4:, 4:]
        if self.filter is None:
            covariance = covariance + _floor(registration, frame) + self._visit_covariance(key)
        expected = self.expected_turn(key)
        if self.filter is None and self.suspected is not None:
            # An accepted frame has shown the beginning of it.
            expected = expected + self.suspected[1]
        unpredicted = np.abs(turn - expected)
        if not (
            _mahalanobis(fit.values[4:], covariance) > INNOVATION_CHI2_MAX
            and max(unpredicted) < UNPREDICTED_MAX
        ):
            return None
        return np.asarray(turn)

    def match(
        self,
        key: int,
        registration: Registration,
        removed: Array,
        frame: ScanFrame,
        averaged: float,
        *,
        measures: bool,
    ) -> tuple[SimilarityState, SimilarityMatch]:
        """Compare a registration with what is expected.

        Parameters
        ----------
        key
            Number of the keyframe.
        registration
            The registration of a frame from which ``removed`` (2,) was taken.
        frame
            The frame.
        averaged
            Number of frames in the mean of the keyframe.
        measures
            Whether rotation and scale are measured: not across a change of magnification.

        Returns
        -------
        What is known now, since the noise of a keyframe is known when something is compared with it, and the match,
        which :meth:`use` makes use of.
        """
        known, drift_filter = self, self.filter
        if drift_filter is None:
            return self, SimilarityMatch(None, removed, (), removed, np.zeros((2, 2)))
        fit = registration.fit_similarity()
        state, nis = drift_filter.state, float("nan")
        operations: tuple[Inflate | Measure, ...] = ()
        if fit is not None and measures:
            measure = _make_measure(key, fit, removed, averaged, _floor(registration, frame))
            if drift_filter.pending == key:
                drift_filter = drift_filter.set_keyframe_noise(keyframe_noise(measure), 0.0)
                known, state = replace(self, filter=drift_filter), drift_filter.state
            outcome = measure(state, drift_filter.process_noise)
            nis = outcome.nis
            if nis <= INNOVATION_CHI2_MAX:
                state, operations = outcome.state, (measure,)
            elif self.was_outlier:
                # Twice in a row: it turns otherwise than expected.
                innovation = np.outer(outcome.innovation, outcome.innovation)
                spread = np.zeros((MOTION_SIZE, MOTION_SIZE))
                spread[:2, :2] = np.diag(np.diag(innovation))
                inflate = Inflate(spread)
                inflated = inflate(state, drift_filter.process_noise)
                state = measure(inflated, drift_filter.process_noise).state
                operations = (inflate, measure)
        turn, covariance = state.predict_shift(key)
        return known, SimilarityMatch(fit, removed, operations, turn, covariance, nis)

    def use(self, match: SimilarityMatch, since_s: float) -> SimilarityState:
        """Update the filter by a match."""
        updated = self.filter
        if updated is None or match.fit is None:
            return self
        for operation in match.operations:
            if isinstance(operation, Measure):
                noise = operation.covariance[:2, :2]
                updated = updated.update(operation).adapt_process_noise(match.nis, noise, since_s)
            else:
                updated = updated.apply(operation)
        return replace(self, filter=updated, was_outlier=bool(match.nis > INNOVATION_CHI2_MAX))

    # -- evidence ---------------------------------------------------------------------------------

    def _visit_covariance(self, key: int) -> Array:
        """(2, 2) what a keyframe of another visit of its magnification adds, as long as nothing is followed."""
        return np.diag([0.0, self.quiet[key].visit])

    def confirm_turn(
        self,
        key: int,
        registration: Registration,
        removed: Array,
        frame: ScanFrame,
        time_s: float,
        last_s: float,
    ) -> tuple[SimilarityState, Array | None]:
        """(2,) rotation and scale that an accepted registration against keyframe ``key`` at ``time_s`` and the one
        before it, at ``last_s``, show in the same sense; None where they do not, or where they are followed already.
        With what is known now.
        """
        if self.filter is not None or not _stands_out(registration.alignment):
            return self, None
        fit = registration.fit_similarity()
        if fit is None:
            return self, None
        values = fit.values[4:]
        covariance = fit.covariance[4:, 4:] + _floor(registration, frame)
        covariance = covariance + self._visit_covariance(key)
        if _mahalanobis(values, covariance) <= INNOVATION_CHI2_MAX:
            return self, None
        before, known = self.suspected, replace(self, suspected=(time_s, values))
        if before is None or before[0] != last_s:
            return known, None
        # The inner product in units of their noise.
        is_same = float(before[1] @ solve_scaled(covariance, values)) > 0.0
        return known, np.asarray(removed + values) if is_same else None

    def activate(self, key: int, turn: Array, time_s: float) -> SimilarityState:
        """Begin to follow rotation and scale, of which a frame at ``time_s`` shows about ``turn`` (2,)
        against keyframe ``key``.

        They begin at that keyframe; what the keyframes before it have summed up is its sigma.
        """
        start = self.quiet[key]
        state = initial_state(start.time_s)
        covariance = state.covariance.copy()
        covariance[:2, :2] = start.covariance
        mean = np.append(start.mean, np.zeros(state.mean.size - 2))
        drift_filter = DriftFilter.begin(
            replace(state, mean=mean, covariance=covariance), None, keeps_history=self.keeps_history
        ).add_keyframe(key, np.zeros(4), 0.0)
        times = [t for t in self.times if t >= start.time_s]
        interval_s = max(time_s - (times[-1] if times else start.time_s), INTERVAL_S_MIN)
        # All of it may have come in the last interval.
        step = float(np.hypot(*turn))
        drift_filter = drift_filter.set_motion_prior(
            step / interval_s, step**2 / interval_s**3, interval_s
        )
        for other, quiet in self.quiet.items():
            if other != key:
                place = PlaceKeyframe(other, quiet.mean, quiet.covariance, follows=False)
                drift_filter = drift_filter.apply(place)
        for t in times:
            drift_filter = drift_filter.apply(Predict(t)).mark_frame()
        drift_filter = drift_filter.apply(Predict(time_s))
        return replace(self, filter=drift_filter, before_marks=len(self.times) - len(times))

    # -- results ----------------------------------------------------------------------------------

    def estimate(
        self, registration: Registration | None, frame: ScanFrame, *, is_first: bool = False
    ) -> SimilarityEstimate:
        """Rotation and scale at the present frame; zero, with what its registration does not exclude as
        sigma, as long as none were found.
        """
        if self.filter is not None:
            return _estimate(self.filter.state)
        if is_first:
            return SimilarityEstimate(np.zeros(4), np.diag([0.0, 0.0, np.inf, np.inf]))
        variance = np.full(4, np.inf)
        if registration is not None and registration.accepted:
            alignment = registration.alignment
            lever = _half_lever_px(alignment, frame)
            square = alignment.half_difference_px[0] ** 2 + alignment.half_variance[0]
            variance[:2] = square[::-1] / lever**2 + np.diag(_floor(registration, frame))
        return SimilarityEstimate(np.zeros(4), np.diag(variance))

    def predictor(self) -> SimilarityPredictor | None:
        """What a prediction needs; None where nothing was found."""
        if self.filter is None:
            return None
        return SimilarityPredictor(self.filter.state.without_keyframes(), self.filter.process_noise)

    def smooth(self) -> list[SimilarityEstimate | None]:
        """Rotation and scale of all frames, given all measurements; None where none were found."""
        drift_filter = self.filter
        if drift_filter is None:
            return [None] * len(self.times)
        process_noise = estimate_process_noise(
            drift_filter.start, drift_filter.events, drift_filter.process_noise
        )
        states = smooth(drift_filter.start, drift_filter.events, process_noise)
        first = _estimate(drift_filter.start)
        square = first.covariance[:2, :2] + np.outer(first.mean[:2], first.mean[:2])
        before = np.diag(np.append(np.diag(square), [np.inf, np.inf]))
        quiet = SimilarityEstimate(np.zeros(4), before)
        return [*[quiet] * self.before_marks, *[_estimate(s) for s in states]]


def _estimate(state: DriftState) -> SimilarityEstimate:
    return SimilarityEstimate(state.mean[:4].copy(), state.drift_covariance.copy())


def _make_measure(
    key: int, fit: SimilarityFit, removed: Array, averaged: float, floor: Array
) -> Measure:
    share = averaged / (averaged + 1.0) if np.isfinite(averaged) else 1.0
    return Measure(key, fit.values[4:] + removed, share * fit.covariance[4:, 4:] + floor)


def _floor(registration: Registration, frame: ScanFrame) -> Array:
    """(2, 2) variance of what distortion and interpolation leave.

    A radial distortion ``xi |q|^2 q`` with its centre at e stretches what is shifted by d by
    ``6 xi e d + 3 xi d^2`` on average, all lengths in units of that of q.
    """
    camera, width = frame.camera, float(frame.size[0])
    xi, off_centre, per_width = 0.0, 0.0, 2.0
    if camera is None:
        xi, off_centre = RAW_DISTORTION, RAW_OFF_CENTRE
    elif camera.covariance is not None:
        variances = np.diag(camera.covariance)
        xi = float(np.sqrt(np.max(variances[_DISTORTIONS])))
        per_width = width / camera.norm_px
        off_centre = float(np.sqrt(np.sum(variances[_DISTORTION_CENTRE]))) / camera.norm_px
    part = float(np.hypot(*registration.shift_px)) / width
    linear = max(TURN_OF_SHIFT, 6.0 * xi * off_centre * per_width) * part
    curved = 3.0 * xi * (part * per_width) ** 2
    return np.eye(2) * ((TURN_FLOOR_PX / width) ** 2 + linear**2 + curved**2)


def _half_lever_px(alignment: Alignment, frame: ScanFrame) -> float:
    """Distance of the middles of the left and the right half of what is compared."""
    return 0.5 * max(frame.size[0] - abs(float(alignment.shift_px[0])), 1.0)


def _stands_out(alignment: Alignment) -> bool:
    square, variance = alignment.half_difference_px[0] ** 2, alignment.half_variance[0]
    return bool(np.any(square > SCREEN_SIGMAS**2 * variance))


def _mahalanobis(vector: Array, covariance: Array) -> float:
    return float(vector @ solve_scaled(covariance, vector))


def constrain_registration(
    registration: Registration, match: SimilarityMatch, keyframe: Array, frame: ScanFrame
) -> Registration:
    """The registration of a frame that may turn, as the filter of the drift uses it.

    Shift and shear are those of the origin of the sem frame, in the axes of the first frame, given what
    is known of rotation and scale. ``keyframe`` (2,) is how the keyframe appears.
    """
    if match.fit is None:
        return registration
    middle = rotation_centre(frame.size, None)
    fit = match.fit.about(rotation_centre(frame.size, frame.camera) - middle)
    gain = np.linalg.solve(fit.covariance[4:, 4:], fit.covariance[4:, :4]).T
    known = match.turn - match.removed
    joint = fit.values[:4] + gain @ (known - fit.values[4:])
    covariance = fit.covariance[:4, :4] - gain @ fit.covariance[4:, :4]
    covariance = covariance + gain @ match.covariance @ gain.T
    axes = np.kron(np.eye(2), similarity_matrix(-keyframe))
    joint, covariance = axes @ joint, axes @ covariance @ axes.T
    alignment = replace(
        registration.alignment,
        shift_px=joint[:2],
        covariance=covariance[:2, :2],
        joint_px=joint,
        joint_covariance=covariance,
    )
    return replace(registration, alignment=alignment)


@dataclass(frozen=True)
class TurnedDrift:
    """Drift of a specimen that turns, in the axes of the image."""

    position: Array
    velocity: Array
    acceleration: Array
    covariance: Array


def turn_drift(
    position: Array,
    velocity: Array,
    acceleration: Array,
    covariance: Array,
    similarity: SimilarityEstimate,
) -> TurnedDrift:
    """The drift ``M u`` from u and its rates, with the covariance (4, 4) of drift and velocity."""
    matrix = similarity_matrix(similarity.mean[:2])
    turn, growth = similarity.mean[2:].tolist()
    rate = np.array([[growth, -turn], [turn, growth]])
    moved = matrix @ position
    speed = matrix @ velocity + rate @ moved
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    # By theta and s of the drift, and of its velocity; by their rates of the velocity alone.
    jacobian = np.zeros((4, 4))
    jacobian[:2, 0], jacobian[:2, 1] = quarter @ moved, moved
    jacobian[2:, 0], jacobian[2:, 1] = quarter @ speed, speed
    jacobian[2:, 2], jacobian[2:, 3] = quarter @ moved, moved
    both = np.kron(np.eye(2), matrix)
    both[2:, :2] = rate @ matrix
    known = both @ covariance @ both.T + jacobian @ similarity.covariance @ jacobian.T
    return TurnedDrift(moved, speed, matrix @ acceleration, known)
