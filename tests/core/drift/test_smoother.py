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

"""Hindsight against the exact conditional distribution, and its own statistics."""

from __future__ import annotations

import itertools
import tracemalloc

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift import smoother
from semcal_ros.core.drift.operations import (
    AddKeyframe,
    CloneKeyframe,
    CorrectShear,
    Inflate,
    Marginalise,
    Measure,
    Operation,
    Predict,
)
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.smoother import (
    Event,
    Mark,
    estimate_process_noise,
    replay,
    smooth,
)
from semcal_ros.core.drift.state import BASE_SIZE, DriftState, initial_state
from semcal_ros.core.errors import InvalidValueError


def root_of(covariance: Array) -> Array:
    """A square root of a positive semidefinite matrix."""
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return np.asarray(unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


class Dense:
    """Every number ever as a linear function of one vector of independent standard normal noises.

    Nothing of the package but the noise of the differential equation
    (:meth:`ProcessNoise.over`) and of a frame (:meth:`ProcessNoise.within`) is used.
    """

    def __init__(self, process_noise: ProcessNoise, centre: Array | None = None) -> None:
        self.process_noise = process_noise
        self.time_s = 0.0
        self.noises = 0
        # Rows are (constant, derivatives by the noises so far).
        self.drift_covariance = np.zeros((6, 1))
        self.places: dict[int, Array] = {}
        self.seen: list[tuple[Array, Array, Array]] = []
        self.marked: list[Array] = []
        self.centre = self.noise(np.zeros((2, 2)) if centre is None else centre)

    def noise(self, covariance: Array) -> Array:
        """Rows of new noise."""
        root = root_of(covariance)
        rows = np.hstack([np.zeros((len(root), 1 + self.noises)), root])
        self.noises += root.shape[1]
        return rows

    @staticmethod
    def sum(*parts: Array) -> Array:
        width = max(p.shape[1] for p in parts)
        return np.asarray(sum(np.pad(p, ((0, 0), (0, width - p.shape[1]))) for p in parts))

    @staticmethod
    def stacked(*parts: Array) -> Array:
        width = max(p.shape[1] for p in parts)
        return np.vstack([np.pad(p, ((0, 0), (0, width - p.shape[1]))) for p in parts])

    @staticmethod
    def constant(values: Array) -> Array:
        return np.asarray(values, dtype=np.float64)[:, None]

    def do(self, event: Event) -> None:
        drift, pace, turn = (
            self.drift_covariance[:2],
            self.drift_covariance[2:4],
            self.drift_covariance[4:],
        )
        if isinstance(event, Predict):
            move, noise = self.process_noise.discretise(event.time_s - self.time_s)
            stirred = self.noise(np.kron(noise, np.eye(2)))
            self.drift_covariance = self.sum(
                np.kron(move, np.eye(2)) @ self.drift_covariance, stirred
            )
            self.time_s = event.time_s
        elif isinstance(event, Inflate):
            self.drift_covariance = self.sum(self.drift_covariance, self.noise(event.covariance))
        elif isinstance(event, AddKeyframe):
            where = np.vstack([drift + event.acceleration_term_s2 * turn, pace])
            gone = -np.append(event.acceleration_term_s2 * event.removed[2:], event.removed[:2])
            own = self.noise(event.noise + self.process_noise.frame_covariance(event.scan_s))
            self.places[event.key] = self.sum(where, self.constant(gone), own)
        elif isinstance(event, CloneKeyframe):
            ratio = np.array([1.0, 1.0, event.shear_ratio, event.shear_ratio])
            copy = ratio[:, None] * self.places[event.parent]
            zoomed = np.vstack([event.zoom, np.zeros((2, 2))]) @ self.centre
            own = self.noise(event.noise)
            self.places[event.key] = self.sum(copy, zoomed, self.constant(event.shift), own)
        elif isinstance(event, CorrectShear):
            gone = -np.append(event.acceleration_term_s2 * event.removed[2:], event.removed[:2])
            self.places[event.key] = self.sum(self.places[event.key], self.constant(gone))
        elif isinstance(event, Marginalise):
            del self.places[event.key]
        elif isinstance(event, Measure):
            ratio = np.array([1.0, 1.0, event.shear_ratio, event.shear_ratio])
            where = np.vstack([drift + event.acceleration_term_s2 * turn, pace])
            zoomed = np.vstack([-event.zoom, np.zeros((2, 2))]) @ self.centre
            expected = self.sum(where, zoomed, -ratio[:, None] * self.places[event.key])
            count = event.shift.size
            frame = self.process_noise.frame_covariance(event.scan_s)[:count, :count]
            self.seen.append((expected[:count], event.shift, event.covariance + frame))
        else:
            self.marked.append(self.state())

    def state(self) -> Array:
        return self.stacked(self.drift_covariance, self.centre, *self.places.values())

    def given(self) -> list[tuple[Array, Array]]:
        """Mean and covariance of each marked state, given all that was seen."""

        def filled(rows: Array) -> Array:
            return np.pad(rows, ((0, 0), (0, 1 + self.noises - rows.shape[1])))

        # Least squares of what was seen, whitened, and of the noises themselves, all of size 1. By
        # its triangular factor nothing small is the difference of large numbers.
        rows, wanted = [np.eye(self.noises)], [np.zeros(self.noises)]
        for expected, shift, noise in self.seen:
            unit = np.linalg.cholesky(noise)
            every = filled(expected)
            rows.append(np.linalg.solve(unit, every[:, 1:]))
            wanted.append(np.linalg.solve(unit, shift - every[:, 0]))
        orthogonal, triangle = np.linalg.qr(np.vstack(rows))
        mean = np.linalg.solve(triangle, orthogonal.T @ np.concatenate(wanted))
        found = []
        for state in self.marked:
            every = filled(state)
            root = scipy.linalg.solve_triangular(triangle.T, every[:, 1:].T, lower=True)
            found.append((every[:, 0] + every[:, 1:] @ mean, root.T @ root))
        return found


def covariance_of(rng: np.random.Generator, size: int, unit: float) -> Array:
    root = rng.standard_normal((size, size)) + np.eye(size)
    return np.asarray(root @ root.T * (0.1 * unit) ** 2)


def random_events(rng: np.random.Generator, count: int, unit: float) -> list[Event]:
    """What may happen to a recording, in any order."""
    widths = np.repeat([0.0, 1.5 * unit, 0.3 * unit], 2)
    events: list[Event] = [Inflate(np.diag(widths**2))]
    keys: list[int] = []
    time_s, following = 0.0, 0

    def add() -> AddKeyframe:
        noise = covariance_of(rng, 4, unit)
        removed = unit * rng.standard_normal(4)
        return AddKeyframe(following, removed, 0.1 * rng.uniform(), noise, rng.uniform())

    events += [add(), Mark()]
    keys.append(following)
    following += 1
    for _ in range(count):
        # Two events at one time happen, too.
        if rng.uniform() < 0.8:
            time_s += rng.uniform(0.2, 2.0)
            events.append(Predict(time_s))
        what = rng.choice(
            ["shift", "both", "clone", "copy", "add", "marginalise", "inflate", "shear", "coast"],
            p=[0.25, 0.25, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05, 0.1],
        )
        key = int(rng.choice(keys))
        if what in ("shift", "both", "clone", "copy"):
            size = 2 if what == "shift" else 4
            shift, noise = unit * rng.standard_normal(size), covariance_of(rng, size, unit)
            ratio, acceleration_term_s2 = rng.uniform(0.5, 2.0), 0.1 * rng.uniform()
            zoom = unit * rng.standard_normal((2, 2)) * rng.choice([0.0, 0.3])
            events.append(
                Measure(key, shift, noise, ratio, acceleration_term_s2, rng.uniform(), zoom)
            )
            if what in ("clone", "copy"):
                # A copy without noise makes the covariance of the state singular.
                own = covariance_of(rng, 4, unit) if what == "clone" else np.zeros((4, 4))
                events.append(
                    CloneKeyframe(following, key, unit * rng.standard_normal(4), ratio, own, zoom)
                )
                keys.append(following)
                following += 1
        elif what == "add":
            events.append(add())
            keys.append(following)
            following += 1
        elif what == "marginalise" and len(keys) > 1:
            events.append(Marginalise(key))
            keys.remove(key)
        elif what == "inflate":
            events.append(Inflate(covariance_of(rng, 6, unit)))
        elif what == "shear":
            events.append(CorrectShear(key, unit * rng.standard_normal(4), 0.1 * rng.uniform()))
        events.append(Mark())
    return events


def assert_same(state: DriftState, mean: Array, covariance: Array, atol: float) -> None:
    """Equal within a part of the deviations that the truth has."""
    variances = np.diag(covariance).copy()
    # What is known exactly is compared on the scale of the rest in its unit.
    for part in (np.r_[0:6, 8 : len(mean)], np.r_[6:8]):
        variances[part] = np.maximum(variances[part], 1e-16 * np.max(variances[part]))
    unit = np.sqrt(variances)
    np.testing.assert_allclose((state.mean - mean) / unit, 0.0, atol=atol)
    np.testing.assert_allclose(
        (state.covariance - covariance) / np.outer(unit, unit), 0.0, atol=atol
    )


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.8, 6.0]),
    # Units: px, and m.
    st.sampled_from([1.0, 1e-9]),
)
def test_smoothed_states_are_the_exact_conditional_ones(
    seed: int, memory: float, unit: float
) -> None:
    rng = np.random.default_rng(seed)
    process_noise = ProcessNoise(0.3 * unit**2, memory)
    events = random_events(rng, 12, unit)
    # The error of the principal point is in px, whatever the unit of the drift.
    centre = np.array([[4.0, 1.2], [1.2, 2.25]])
    dense = Dense(process_noise, centre)
    for event in events:
        dense.do(event)
    expected = dense.given()
    states = smooth(initial_state(0.0, centre), events, process_noise)
    assert len(states) == len(expected) == sum(isinstance(e, Mark) for e in events)
    for state, (mean, covariance) in zip(states, expected, strict=True):
        # A part in 1e12 of a variance counts as nothing, and sums of 16 digits leave 1e-4 of it; of
        # 2400 sequences the worst was off by 4e-6.
        assert_same(state, mean[:BASE_SIZE], covariance[:BASE_SIZE, :BASE_SIZE], 3e-5)


def test_marks_may_repeat_and_nothing_measured_leaves_the_prediction() -> None:
    process_noise = ProcessNoise(0.3, 2.0)
    assert smooth(initial_state(0.0), [], process_noise) == []
    events: list[Event] = [
        Mark(),
        Predict(1.5),
        Mark(),
        Mark(),
        Inflate(np.eye(6)),
        Predict(2.0),
        Mark(),
    ]
    states = smooth(initial_state(0.0), events, process_noise)
    assert [s.time_s for s in states] == [0.0, 1.5, 1.5, 2.0]
    plain = Predict(1.5)(initial_state(0.0), process_noise)
    for state in states[1:3]:
        np.testing.assert_allclose(state.covariance, plain.covariance, atol=1e-12)
    wide = Predict(2.0)(Inflate(np.eye(6))(plain, process_noise), process_noise)
    np.testing.assert_allclose(states[3].covariance, wide.covariance)


def test_the_last_state_of_hindsight_is_that_of_the_filter() -> None:
    process_noise = ProcessNoise(0.3, 2.0)
    events = random_events(np.random.default_rng(12), 20, 1.0)
    last = smooth(initial_state(0.0), events, process_noise)[-1]
    state = replay(initial_state(0.0), events, process_noise).without_keyframes()
    np.testing.assert_array_equal(last.mean, state.mean)
    np.testing.assert_array_equal(last.covariance, state.covariance)


def test_blocks_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    process_noise = ProcessNoise(0.3, 2.0)
    events = random_events(np.random.default_rng(5), 20, 1.0)
    whole = smooth(initial_state(0.0), events, process_noise)
    # Blocks that end with all kinds of events, and one that is exactly full.
    for block in (1, 7, len(events) - 1, len(events)):
        monkeypatch.setattr(smoother, "SMOOTHER_BLOCK", block)
        for one, other in zip(
            whole, smooth(initial_state(0.0), events, process_noise), strict=True
        ):
            np.testing.assert_array_equal(one.mean, other.mean)
            np.testing.assert_array_equal(one.covariance, other.covariance)


def test_memory_does_not_grow_with_the_frames_times_the_keyframes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(smoother, "SMOOTHER_BLOCK", 30)
    process_noise = ProcessNoise(0.3, 2.0)
    events: list[Event] = [AddKeyframe(key, np.zeros(4), 0.0, np.eye(4), 0.0) for key in range(12)]
    for k in range(120):
        events += [Predict(k + 1.0), Measure(k % 12, np.zeros(2), np.eye(2)), Mark()]
    peaks = []
    for part in (events[: 12 + 3 * 60], events):
        tracemalloc.start()
        smooth(initial_state(0.0), part, process_noise)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # Of a frame remain its state without keyframes, (8,) and (8, 8), and a tenth of a state with keyframes, (56, 56),
    # between two blocks: 4 kB. Its steps and its state are four of the latter, 100 kB.
    assert (peaks[1] - peaks[0]) / 60 < 8e3


def test_replayed_is_one_thing_after_the_other() -> None:
    process_noise = ProcessNoise(0.3, 2.0)
    for seed in range(8):
        events = random_events(np.random.default_rng(seed), 12, 1.0)
        # With and without operations after the last measurement, and with nothing but operations.
        for part in (events, events[:-1], events[:-4], events[:2], [], [*events, Predict(99.0)]):
            state = initial_state(0.0)
            for event in part:
                if isinstance(event, Operation):
                    state = event(state, process_noise)
                elif isinstance(event, Measure):
                    state = event(state, process_noise).state
            again = replay(initial_state(0.0), part, process_noise)
            np.testing.assert_array_equal(again.mean, state.mean)
            np.testing.assert_array_equal(again.covariance, state.covariance)
            assert (again.time_s, again.keys) == (state.time_s, state.keys)


# -- simulated paths ----------------------------------------------------------------------------

START_PACE = 3.0


def simulated(
    rng: np.random.Generator, times: Array, process_noise: ProcessNoise, sigma: float
) -> tuple[list[Event], Array]:
    """A path with the exact statistics of the process_noise, seen from one keyframe that has as much
    noise as every frame, and its truth (n, 4).
    """
    turn = np.sqrt(process_noise.acceleration_variance)
    state = rng.standard_normal((3, 2)) * np.array([0.0, START_PACE, turn])[:, None]
    noise = np.diag(np.repeat([sigma**2, 0.0], 2))
    widths = np.repeat([0.0, START_PACE, turn], 2)
    events: list[Event] = [Inflate(np.diag(widths**2))]
    # The keyframe's velocity is never compared with anything.
    events += [AddKeyframe(0, np.zeros(4), 0.0, noise, 0.0), Mark()]
    key = state[0] + sigma * rng.standard_normal(2)
    truth = [state[:2].ravel()]
    roots: dict[float, tuple[Array, Array]] = {}
    for before, now in itertools.pairwise(times):
        step = round(float(now - before), 9)
        if step not in roots:
            move, spread = process_noise.discretise(step)
            roots[step] = move, root_of(spread)
        move, root = roots[step]
        state = move @ state + root @ rng.standard_normal((3, 2))
        truth.append(state[:2].ravel())
        shift = state[0] - key + sigma * rng.standard_normal(2)
        events += [Predict(float(now)), Measure(0, shift, np.eye(2) * sigma**2), Mark()]
    return events, np.array(truth)


@pytest.mark.parametrize("memory", [0.0, 2.0])
def test_intervals_cover_the_truth_as_often_as_they_say(memory: float) -> None:
    process_noise = ProcessNoise(0.05, memory)
    runs, times = 60, np.arange(12.0)
    away, chi2 = [], []
    for seed in range(runs):
        events, truth = simulated(np.random.default_rng(seed), times, process_noise, 0.3)
        states = smooth(initial_state(0.0), events, process_noise)
        # One time of each path, so that all are independent, and not that which is known exactly.
        k = 1 + seed % 11
        error = states[k].mean[:4] - truth[k]
        away.append(error / np.sqrt(np.diag(states[k].drift_covariance)))
        chi2.append(float(error @ np.linalg.solve(states[k].drift_covariance, error)))
        assert np.all(states[0].position == 0.0)
        assert np.all(states[0].drift_covariance[:2, :2] == 0.0)
    # 120 positions and as many velocities: four binomial deviations.
    for values in (np.array(away)[:, :2], np.array(away)[:, 2:]):
        inside = np.abs(values)
        assert abs(np.mean(inside < 1.0) - 0.683) < 4.0 * np.sqrt(0.683 * 0.317 / (2 * runs))
        assert abs(np.mean(inside < 1.96) - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / (2 * runs))
    low, high = stats.chi2.ppf([5e-5, 1.0 - 5e-5], 4 * runs)
    assert low < np.sum(chi2) < high


def test_hindsight_is_better_than_the_filter_and_says_so() -> None:
    process_noise = ProcessNoise(0.05, 2.0)
    live_error, error, live_sigma, sigma = [], [], [], []
    for seed in range(10):
        events, truth = simulated(np.random.default_rng(seed), np.arange(30.0), process_noise, 0.3)
        states = smooth(initial_state(0.0), events, process_noise)
        for k in (10, 20):
            state = replay(initial_state(0.0), events[: 3 + 3 * k], process_noise)
            assert state.time_s == states[k].time_s
            # Positions share the noise of the keyframe with everything; velocities do not.
            live_error.append(state.velocity - truth[k, 2:])
            error.append(states[k].velocity - truth[k, 2:])
            live_sigma.append(np.sqrt(state.drift_covariance[2, 2]))
            sigma.append(np.sqrt(states[k].drift_covariance[2, 2]))
            assert state.drift_covariance[0, 0] > states[k].drift_covariance[0, 0]
    assert np.mean(sigma) < 0.7 * np.mean(live_sigma)
    assert np.sqrt(np.mean(np.square(error))) < 0.8 * np.sqrt(np.mean(np.square(live_error)))


def test_a_stiff_path_is_the_straight_line_fit_through_the_beginning() -> None:
    rng = np.random.default_rng(2)
    times = np.arange(1.0, 40.0)
    seen = np.stack([2.0 * times, -times], axis=1) + rng.standard_normal((39, 2))
    # A prior of the velocity that says nothing, and a keyframe without noise.
    events: list[Event] = [
        Inflate(np.diag(np.repeat([0.0, 100.0, 0.0], 2))),
        AddKeyframe(0, np.zeros(4), 0.0, np.zeros((4, 4)), 0.0),
    ]
    for time, shift in zip(times, seen, strict=True):
        events += [Predict(float(time)), Measure(0, shift, np.eye(2)), Mark()]
    states = smooth(initial_state(0.0), events, ProcessNoise(1e-9))
    slope = times @ seen / (times @ times)
    # A prior of 100 pulls by a part in 2e6 of the slope, which is 3e-4 of its deviation; a density of
    # 1e-9 bends by less, and rounding costs some digits where the path is that stiff.
    sigma = 1.0 / np.sqrt(times @ times)
    for time, state in zip(times, states, strict=True):
        np.testing.assert_allclose(state.position, slope * time, atol=0.01 * sigma * time)
        np.testing.assert_allclose(state.velocity, slope, atol=0.01 * sigma)
    for time, state in zip(times[9:], states[9:], strict=True):
        np.testing.assert_allclose(
            np.diag(state.drift_covariance)[:2], (sigma * time) ** 2, rtol=1e-2
        )


def test_a_gap_is_bridged_and_becomes_uncertain() -> None:
    process_noise = ProcessNoise(0.01)
    events, truth = simulated(np.random.default_rng(3), np.arange(50.0), process_noise, 0.3)
    gap = range(22, 29)
    # Three events before the second frame, then three for each.
    without = [e for k, e in enumerate(events) if not (k % 3 == 1 and k // 3 in gap)]
    assert len(without) == len(events) - len(gap)
    full, bridged = (smooth(initial_state(0.0), e, process_noise) for e in (events, without))
    sigma = [float(np.sqrt(s.drift_covariance[0, 0])) for s in bridged]
    # Half of what is stated anyhow is the noise of the keyframe.
    assert sigma[25] > 1.3 * np.sqrt(full[25].drift_covariance[0, 0])
    assert sigma[25] > sigma[23] > sigma[21]
    assert sigma[25] > sigma[27] > sigma[29]
    for k in gap:
        error = bridged[k].mean[:4] - truth[k]
        assert error @ np.linalg.solve(bridged[k].drift_covariance, error) < stats.chi2.ppf(
            1.0 - 1e-4, 4
        )


# -- process_noise -------------------------------------------------------------------------------


@pytest.mark.parametrize(("psd", "guess"), [(0.04, 0.04), (0.04, 40.0), (4.0, 0.04)])
def test_the_density_of_a_path_is_found_from_a_guess_that_is_far_off(
    psd: float, guess: float
) -> None:
    found = []
    for seed in range(2):
        events, _ = simulated(np.random.default_rng(seed), np.arange(50.0), ProcessNoise(psd), 0.05)
        likely = estimate_process_noise(initial_state(0.0), events, ProcessNoise(guess), (0.0,))
        assert likely.time_constant_s == 0.0
        found.append(likely.psd)
    # Were every change of pace seen, the logarithm would be known to sqrt(2 / 98) = 0.14; the noise
    # makes 0.16 of it for the larger density, and 0.26 for the smaller. Four of the latter, and the
    # tenth that the search leaves, are a factor of 3, where the guesses are off by up to 1000.
    assert np.all(np.abs(np.log(np.array(found) / psd)) < 4.0 * 0.26 + 0.1)


def test_one_deviation_more_than_the_likeliest_density_is_seldom_too_small() -> None:
    truth, likeliest, larger = ProcessNoise(0.01, 1.0), [], []
    for seed in range(16):
        events, _ = simulated(np.random.default_rng(seed), np.arange(5.0), truth, 0.05)
        for deviations, found in ((0.0, likeliest), (1.0, larger)):
            # A guess that is as far off as that from the first step.
            estimate = estimate_process_noise(
                initial_state(0.0), events, ProcessNoise(0.16, 1.0), (1.0,), deviations
            )
            found.append(np.log(estimate.psd / truth.psd))
    # Of four measurements, hardly any noise at all is often the likeliest.
    assert np.min(likeliest) < -5.0
    assert np.min(larger) > -3.0
    # Five of six would be above if the likelihood were a normal one, but for the chance of sixteen series.
    assert np.mean(np.array(larger) > 0.0) > 0.6


def test_what_shows_to_be_more_than_the_guess_is_not_taken_larger_still() -> None:
    truth = ProcessNoise(0.16, 1.0)
    for seed in range(4):
        events, _ = simulated(np.random.default_rng(seed), np.arange(17.0), truth, 0.05)
        likeliest, larger = (
            estimate_process_noise(
                initial_state(0.0), events, ProcessNoise(0.001, 1.0), (1.0,), deviations
            )
            for deviations in (0.0, 1.0)
        )
        assert likeliest.psd > 0.001
        assert larger.psd == likeliest.psd


def test_units_do_not_change_what_is_likely() -> None:
    found = []
    for unit in (1.0, 1e-9):
        process_noise = ProcessNoise(0.04 * unit**2)
        rng = np.random.default_rng(5)
        # The prior of the velocity stays, so that both see the same numbers.
        events, _ = simulated(rng, np.arange(20.0), ProcessNoise(0.04), 0.05)
        scaled: list[Event] = []
        for event in events:
            if isinstance(event, Measure):
                event = Measure(event.key, event.shift * unit, event.covariance * unit**2)
            elif isinstance(event, Inflate):
                event = Inflate(event.covariance * unit**2)
            elif isinstance(event, AddKeyframe):
                event = AddKeyframe(event.key, event.removed, 0.0, event.noise * unit**2, 0.0)
            scaled.append(event)
        likely = estimate_process_noise(initial_state(0.0), scaled, process_noise, (0.0,))
        found.append(likely.psd / unit**2)
    # Equal but for rounding: the search takes the same steps.
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_a_long_memory_is_told_from_a_white_acceleration() -> None:
    rng = np.random.default_rng(0)
    near = ProcessNoise(1.0, 1.0)
    for true in (ProcessNoise(4.0, 8.0), ProcessNoise(4.0)):
        events, _ = simulated(rng, np.arange(40.0), true, 0.02)
        # Forty seconds hold five memories, and noise of 0.02 hides little of changes of pace of 1:
        # the likelihoods differ by far more than they scatter.
        assert (
            estimate_process_noise(initial_state(0.0), events, near, (0.0, 8.0)).time_constant_s
            == true.time_constant_s
        )


def test_a_random_walk_is_told_from_a_smooth_drift() -> None:
    near = ProcessNoise(1.0, 1.0)
    for true in (ProcessNoise(1.0 / 30.0, 1.0, walk_s2=30.0), ProcessNoise(0.04, 1.0)):
        walks = []
        for seed in range(6):
            rng = np.random.default_rng(seed)
            events, _ = simulated(rng, np.arange(17.0), true, 0.02)
            found = estimate_process_noise(initial_state(0.0), events, near, (1.0,))
            walks.append(found.walk_s2 > 0.0)
            if all(walks) and true.walk_s2 > 0.0:
                # The logarithm of a variance of 32 independent steps is known to sqrt(2 / 32) = 0.25.
                assert abs(np.log(found.psd / true.psd)) < 4.0 * 0.25
        assert np.mean(walks) == float(true.walk_s2 > 0.0)


def test_what_may_be_smooth_or_a_walk_is_allowed_to_be_both() -> None:
    near = ProcessNoise(1.0, 1.0)
    events, _ = simulated(np.random.default_rng(0), np.arange(6.0), ProcessNoise(0.04, 1.0), 0.3)
    smooth_drift = estimate_process_noise(initial_state(0.0), events, near, (1.0,))
    both = estimate_process_noise(initial_state(0.0), events, near, (1.0,), deviations=1.0)
    assert smooth_drift.walk_s2 == 0.0
    assert both.walk_s2 > 0.0
    assert both.psd > smooth_drift.psd


@pytest.mark.long
def test_after_a_gap_in_a_random_walk_the_error_is_as_large_as_its_sigma() -> None:
    true = ProcessNoise(1.0 / 30.0, 1.0, walk_s2=30.0)
    scaled = []
    for seed in range(40):
        events, truth = simulated(np.random.default_rng(seed), np.arange(25.0), true, 0.02)
        seen = [e for k, e in enumerate(events) if not (isinstance(e, Measure) and 46 < k < 64)]
        found = estimate_process_noise(initial_state(0.0), seen, ProcessNoise(1.0, 1.0), (1.0,))
        state = smooth(initial_state(0.0), seen, found)[17]
        sigma = np.sqrt(np.diag(state.drift_covariance)[:2])
        scaled.append((state.position - truth[17, :2]) / sigma)
    # 80 errors: four deviations of an RMS of 1, 4 / sqrt(160).
    assert abs(float(np.sqrt(np.mean(np.square(scaled)))) - 1.0) < 0.32


def test_few_measurements_leave_the_process_noise_as_it_was() -> None:
    events, _ = simulated(np.random.default_rng(0), np.arange(4.0), ProcessNoise(0.04), 0.05)
    near = ProcessNoise(0.7, 3.0)
    assert estimate_process_noise(initial_state(0.0), events, near) is near


def test_an_outlier_counts_for_no_more_than_its_bound() -> None:
    process_noise = ProcessNoise(1e-3)
    events, _ = simulated(np.random.default_rng(1), np.arange(50.0), process_noise, 0.1)
    index = 3 * 30 + 1
    wild = events[index]
    assert isinstance(wild, Measure)
    found = []
    for away in (50.0, 5000.0):
        events[index] = Measure(0, wild.shift + away, wild.covariance)
        found.append(estimate_process_noise(initial_state(0.0), events, process_noise, (0.0,)).psd)
    # A hundred times as far away would make a path that had to follow ten thousand times as
    # restless.
    assert found[1] < 100.0 * found[0]


# -- refusals -----------------------------------------------------------------------------------


def test_bad_input_is_refused() -> None:
    events: list[Event] = [Predict(2.0), Mark(), Predict(1.0)]
    for function in (smooth, replay):
        with pytest.raises(InvalidValueError, match="later time"):
            function(initial_state(0.0), events, ProcessNoise(1.0))
        with pytest.raises(InvalidValueError, match="numbers >= 0"):
            function(initial_state(0.0), events[:1], ProcessNoise(-1.0))
    for psd in (0.0, -1.0, float("nan")):
        with pytest.raises(InvalidValueError, match="positive density"):
            estimate_process_noise(initial_state(0.0), [], ProcessNoise(psd))
