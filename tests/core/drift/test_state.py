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

"""The drift map against the differential equation, hand-made answers and its own statistics."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.operations import (
    AddKeyframe,
    CloneKeyframe,
    CorrectShear,
    Inflate,
    Marginalise,
    Measure,
    Predict,
)
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.state import DriftState, initial_state
from semcal_ros.core.errors import InvalidValueError

WHITE = ProcessNoise(0.3)
FADING = ProcessNoise(0.3, 1.7)
# Numbers of a state before those of its keyframes.
BASE_SIZE = initial_state(0.0).mean.size


def random_state(seed: int = 0, keys: tuple[int, ...] = (4, 7)) -> DriftState:
    """A state in which everything correlates with everything."""
    rng = np.random.default_rng(seed)
    size = BASE_SIZE + 4 * len(keys)
    root = rng.standard_normal((size, size)) + np.eye(size)
    return DriftState(1.0, rng.standard_normal(size), root @ root.T, keys)


def square(vector: Array, covariance: Array) -> float:
    return float(vector @ np.linalg.solve(covariance, vector))


# -- time ---------------------------------------------------------------------------------------


def test_prediction_moves_with_the_velocity_and_widens() -> None:
    start = DriftState(
        1.0,
        np.array([1.0, 2.0, 0.5, -1.0, 0.0, 0.0]),
        np.diag([4.0, 4.0, 1.0, 1.0, 0.0, 0.0]),
    )
    later = Predict(3.0)(start, WHITE)
    np.testing.assert_allclose(later.mean[:4], [2.0, 0.0, 0.5, -1.0])
    assert later.time_s == 3.0
    # 4 + dt^2 * 1 + q dt^3 / 3, and the velocity's 1 + q dt, with dt = 2.
    assert later.covariance[0, 0] == pytest.approx(8.0 + 0.3 * 8.0 / 3.0)
    assert later.covariance[3, 3] == pytest.approx(1.0 + 0.3 * 2.0)
    assert later.covariance[0, 2] == pytest.approx(2.0 + 0.3 * 2.0)
    assert later.covariance[0, 1] == 0.0
    # The state before is untouched.
    assert start.time_s == 1.0
    np.testing.assert_array_equal(start.mean, [1.0, 2.0, 0.5, -1.0, 0.0, 0.0])


def test_a_fading_acceleration_moves_the_drift_by_its_integral() -> None:
    state = DriftState(0.0, np.array([0.0, 0.0, 0.0, 0.0, 2.0, -1.0]), np.zeros((6, 6)))
    later = Predict(3.0)(state, ProcessNoise(0.0, 1.5))
    fade = np.exp(-2.0)
    # a(t) = a exp(-t / 1.5): v = 1.5 a (1 - fade), x = 1.5 a (3 - 1.5 (1 - fade)).
    np.testing.assert_allclose(later.acceleration, [2.0 * fade, -fade])
    np.testing.assert_allclose(later.velocity, 1.5 * (1.0 - fade) * np.array([2.0, -1.0]))
    way = 1.5 * (3.0 - 1.5 * (1.0 - fade))
    np.testing.assert_allclose(later.position, way * np.array([2.0, -1.0]))


@pytest.mark.parametrize("process_noise", [WHITE, FADING, ProcessNoise(2.0, 40.0)])
def test_a_prediction_in_two_steps_equals_one(process_noise: ProcessNoise) -> None:
    state = random_state()
    if process_noise.time_constant_s == 0.0:
        # A white acceleration has no value that a prediction could begin with.
        state = Predict(1.1)(state, process_noise)
    once = Predict(4.0)(state, process_noise)
    twice = Predict(4.0)(Predict(1.9)(state, process_noise), process_noise)
    np.testing.assert_allclose(once.mean, twice.mean, rtol=1e-12, atol=1e-12)
    # Rounding of numbers near 100.
    np.testing.assert_allclose(once.covariance, twice.covariance, rtol=1e-11, atol=1e-11)
    # Keyframes do not move.
    np.testing.assert_array_equal(once.mean[6:], state.mean[6:])
    np.testing.assert_array_equal(once.covariance[6:, 6:], state.covariance[6:, 6:])


def test_no_time_changes_nothing() -> None:
    state = random_state()
    for process_noise in (WHITE, FADING):
        same = Predict(state.time_s)(state, process_noise)
        np.testing.assert_array_equal(same.mean, state.mean)
        np.testing.assert_array_equal(same.covariance, state.covariance)


steps = st.floats(1e-3, 3.5)


@settings(max_examples=60, deadline=None)
@given(steps, steps, st.floats(0.5, 1e4), st.floats(1e-20, 1e3))
def test_transitions_are_a_semigroup(a: float, b: float, memory: float, psd: float) -> None:
    process_noise = ProcessNoise(psd, memory, walk_s2=0.3)
    first, first_noise = process_noise.discretise(a)
    second, second_noise = process_noise.discretise(b)
    both, both_noise = process_noise.discretise(a + b)
    unit = np.sqrt(np.diag(both_noise))
    # Exponentials of up to 14 cost the matrix exponential up to 8 of 16 digits.
    np.testing.assert_allclose(second @ first, both, rtol=1e-9, atol=1e-12)
    summed = second @ first_noise @ second.T + second_noise
    np.testing.assert_allclose(
        summed / np.outer(unit, unit), both_noise / np.outer(unit, unit), atol=1e-7
    )


def noise_by_quadrature(psd: float, time_constant_s: float, dt_s: float) -> Array:
    """Integral over the responses ``g(s)`` of ``[x, v, a]`` to a unit impulse s ago."""
    ends = np.minimum(time_constant_s * 2.0 ** np.arange(-3, 7), dt_s)
    edges = np.unique(np.concatenate([[0.0, dt_s], ends]))
    nodes, weights = np.polynomial.legendre.leggauss(20)
    total = np.zeros((3, 3))
    for low, high in itertools.pairwise(edges):
        s = low + 0.5 * (high - low) * (nodes + 1.0)
        gone = -np.expm1(-s / time_constant_s)
        response = np.stack([s - time_constant_s * gone, gone, (1.0 - gone) / time_constant_s])
        total += (response * (0.5 * (high - low) * weights)) @ response.T
    return psd * total


@pytest.mark.parametrize("ratio", [1e-3, 0.1, 1.0, 3.0, 15.0, 60.0])
def test_noise_is_the_integral_over_the_impulse_responses(ratio: float) -> None:
    dt, psd = 0.7, 0.3
    move, noise = ProcessNoise(psd, dt / ratio).discretise(dt)
    expected = noise_by_quadrature(psd, dt / ratio, dt)
    unit = np.sqrt(np.diag(expected))
    # Correlations.
    np.testing.assert_allclose(
        noise / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-9
    )
    np.testing.assert_array_equal(noise, noise.T)
    assert np.linalg.eigvalsh(noise / np.outer(unit, unit))[0] > 0.0
    gone = -np.expm1(-ratio)
    memory = dt / ratio
    exact = [[1.0, dt, memory * (dt - memory * gone)], [0.0, 1.0, memory * gone], [0, 0, 1 - gone]]
    np.testing.assert_allclose(move, exact, rtol=1e-9, atol=1e-12)


def test_white_noise_is_the_integral_too_and_a_short_memory_comes_near_it() -> None:
    dt, psd = 0.7, 0.3
    move, white = WHITE.discretise(dt)
    exact = psd * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    np.testing.assert_allclose(white[:2, :2], exact)
    np.testing.assert_array_equal(move, [[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    assert np.linalg.eigvalsh(white).min() > -1e-16
    for ratio in (10.0, 20.0):
        short_move, short = ProcessNoise(psd, dt / ratio).discretise(dt)
        np.testing.assert_allclose(short_move[:2, :2], move[:2, :2])
        # In the first order of the memory the velocity lacks 1.5 memories of the interval, the
        # drift 3 and their product 2; the second order is that of 3 / ratio^2.
        lacking = np.array([[3.0, 2.0], [2.0, 1.5]]) / ratio
        np.testing.assert_allclose(short[:2, :2] / exact, 1.0 - lacking, atol=3.5 / ratio**2)


def test_an_acceleration_converges_to_the_variance_that_is_stated_for_it() -> None:
    move, noise = FADING.discretise(0.9)
    variance = FADING.acceleration_variance
    assert variance == pytest.approx(0.5 * 0.3 / 1.7)
    # In the long run as much is added as fades.
    assert move[2, 2] ** 2 * variance + noise[2, 2] == pytest.approx(variance)
    assert WHITE.acceleration_variance == 0.0


def test_a_simulated_fading_acceleration_has_the_stated_noise() -> None:
    rng = np.random.default_rng(3)
    paths, parts, dt = 4000, 200, 1.2
    h = dt / parts
    x, v, a = np.zeros((3, paths))
    for _ in range(parts):
        kick = np.sqrt(FADING.psd * h) * rng.standard_normal(paths) / FADING.time_constant_s
        x, v, a = x + h * v, v + h * a, a - h * a / FADING.time_constant_s + kick
    seen = np.cov([x, v, a])
    stated = FADING.discretise(dt)[1]
    unit = np.sqrt(np.diag(stated))
    # Variances of 4000 paths scatter by 2.2 %, steps of a 200th are off by 1 %.
    np.testing.assert_allclose(seen / np.outer(unit, unit), stated / np.outer(unit, unit), atol=0.1)


@pytest.mark.parametrize("memory", [0.0, 0.05, 1.0, 20.0])
def test_what_a_frame_adds_of_its_own_is_exact_when_white_and_never_too_small(
    memory: float,
) -> None:
    scan, psd = 0.8, 0.3
    # Both halves of the acquisition begin at its middle; an impulse at s moves what is after it.
    left = 0.5 * scan - (np.arange(4000) + 0.5) * 0.5 * scan / 4000
    drift, pace = 0.5 * left**2, left
    if memory > 0.0:
        gone = -np.expm1(-left / memory)
        drift, pace = 0.5 * left**2 - memory * left + memory**2 * gone, left - memory * gone
    exact = psd / scan * np.array([np.mean(drift**2), np.mean(pace**2)])
    stated = np.diag(ProcessNoise(psd, memory).frame_covariance(scan))
    np.testing.assert_array_equal(stated[:2], stated[0])
    np.testing.assert_array_equal(stated[2:], stated[2])
    if memory == 0.0:
        # 4000 rectangles for an integral.
        np.testing.assert_allclose(stated[[0, 2]], exact, rtol=1e-5)
    white = np.diag(ProcessNoise(psd).frame_covariance(scan))
    assert np.all(stated <= white)
    assert np.all(stated[[0, 2]] > 0.999 * exact)


def test_a_simulated_random_walk_has_the_stated_noise() -> None:
    rng = np.random.default_rng(4)
    walk, scan, parts = ProcessNoise(1e-9, 1.0, walk_s2=4e8), 0.8, 400
    steps = np.sqrt(walk.psd * walk.walk_s2 * scan / parts) * rng.standard_normal((6000, parts))
    path = np.cumsum(steps, axis=1)
    mean = path.mean(axis=1) - path[:, parts // 2 - 1]
    seen = np.var(mean), np.var(path[:, -1] / scan)
    # Variances of 6000 paths scatter by 1.8 %.
    np.testing.assert_allclose(np.diag(walk.frame_covariance(scan))[[0, 2]], seen, rtol=0.08)
    np.testing.assert_allclose(walk.discretise(scan)[1][0, 0], np.var(path[:, -1]), rtol=0.08)


# -- measuring ----------------------------------------------------------------------------------


def test_a_measurement_weighs_by_variance() -> None:
    mean, variances = np.zeros((2, BASE_SIZE + 4))
    mean[:4] = 1.0, 2.0, 0.5, -1.0
    variances[:4] = 3.0, 3.0, 1.0, 1.0
    variances[BASE_SIZE : BASE_SIZE + 2] = 1.0
    state = DriftState(1.0, mean, np.diag(variances), (0,))
    # Drift 3 and keyframe 1 make a prior variance of 4; that of the measurement is 4: half way,
    # three quarters of it by the drift and one quarter, backwards, by the keyframe.
    outcome = Measure(0, np.array([3.0, 2.0]), 4.0 * np.eye(2))(state, WHITE)
    np.testing.assert_allclose(outcome.state.position, [1.75, 2.0])
    np.testing.assert_allclose(outcome.state.keyframe_state(0), [-0.25, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(outcome.innovation, [2.0, 0.0])
    np.testing.assert_allclose(outcome.innovation_covariance, 8.0 * np.eye(2))
    assert outcome.nis == pytest.approx(4.0 / 8.0)
    assert outcome.shear_nis == 0.0
    assert outcome.state.covariance[0, 0] == pytest.approx(3.0 - 9.0 / 8.0)
    # What they share: both are now nearer to the measured difference than to themselves.
    assert outcome.state.predict_shift(0)[1][0, 0] == pytest.approx(2.0)
    # The state before is untouched.
    np.testing.assert_array_equal(state.mean, mean)
    np.testing.assert_array_equal(state.covariance, np.diag(variances))


def test_shift_and_shear_together_are_bayes_rule() -> None:
    state = random_state(3)
    rng = np.random.default_rng(4)
    root = rng.standard_normal((4, 4))
    zoom = np.array([[0.5, 0.1], [0.0, 0.4]])
    measure = Measure(7, rng.standard_normal(4), root @ root.T, 1.3, 0.2, 0.6, zoom)
    outcome = measure(state, FADING)
    # In information form, written out: shift = p + b a - m - Z e, shear = v - 1.3 w.
    row, at = np.zeros((4, BASE_SIZE + 8)), BASE_SIZE + 4
    row[0, [0, 4, at]] = row[1, [1, 5, at + 1]] = 1.0, 0.2, -1.0
    row[2, [2, at + 2]] = row[3, [3, at + 3]] = 1.0, -1.3
    row[:2, 6:8] = [[-0.5, -0.1], [0.0, -0.4]]
    noise = measure.covariance + FADING.frame_covariance(0.6)
    information = np.linalg.inv(state.covariance) + row.T @ np.linalg.solve(noise, row)
    covariance = np.linalg.inv(information)
    right = np.linalg.solve(state.covariance, state.mean)
    right += row.T @ np.linalg.solve(noise, measure.shift)
    # Rounding: the inverse of a random matrix of 16 rows has a condition of some thousands.
    np.testing.assert_allclose(outcome.state.covariance, covariance, atol=1e-9)
    np.testing.assert_allclose(outcome.state.mean, covariance @ right, atol=1e-9)
    # Shift, and shear given the shift, are all there is to be surprised about.
    whole = square(outcome.innovation, outcome.innovation_covariance)
    shift = square(outcome.innovation[:2], outcome.innovation_covariance[:2, :2])
    assert outcome.nis == pytest.approx(shift)
    assert outcome.nis + outcome.shear_nis == pytest.approx(whole)
    # Without its shear it is the measurement of a shift.
    alone = measure.without_shear()(state, FADING)
    assert alone.nis == pytest.approx(outcome.nis)
    assert alone.shear_nis == pytest.approx(0.0, abs=1e-12)


def test_units_do_not_matter() -> None:
    # nm or m: 18 orders of magnitude between variances of drift and of shifts in px.
    results = []
    for unit in (1.0, 1e-9):
        process_noise = ProcessNoise(0.3 * unit**2, 1.7)
        state = random_state(5)
        state = DriftState(1.0, state.mean * unit, state.covariance * unit**2, state.keys)
        state = Predict(2.5)(state, process_noise)
        measure = Measure(4, np.array([1.0, -2.0, 0.3, 0.1]) * unit, np.eye(4) * 0.01 * unit**2)
        outcome = measure(state, process_noise)
        results.append((outcome.state.mean / unit, outcome.state.covariance / unit**2))
        assert outcome.nis > 0.0
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(results[0][1], results[1][1], rtol=1e-9, atol=1e-12)


def test_a_covariance_stays_positive_when_a_measurement_is_very_sharp() -> None:
    state = random_state(6)
    for sigma in (1e-3, 1e-5, 1e-6):
        for key in (4, 7):
            state = Measure(key, np.zeros(4), np.eye(4) * sigma**2)(state, WHITE).state
        # Nothing below zero but rounding of numbers near 10.
        assert np.linalg.eigvalsh(state.covariance)[0] > -1e-14


@pytest.mark.parametrize("memory", [0.0, 2.0])
def test_innovations_are_consistent_and_velocity_is_found(memory: float) -> None:
    rng = np.random.default_rng(5)
    sigma, dt, parts = 0.3, 0.7, 20
    process_noise = ProcessNoise(0.05, memory)
    truth, pace = np.zeros(2), np.array([1.5, -0.8])
    turn = np.sqrt(process_noise.acceleration_variance) * rng.standard_normal(2)
    variances = [0.0, 4.0, process_noise.acceleration_variance]
    state = Inflate(np.diag(np.repeat(variances, 2)))(initial_state(0.0), process_noise)
    # A keyframe without noise at the beginning: shifts are drifts.
    state = AddKeyframe(0, np.zeros(4), 0.0, np.zeros((4, 4)), 0.0)(state, process_noise)
    nis, nees = [], []
    h = dt / parts
    for k in range(1, 400):
        for _ in range(parts):
            # Steps by the trapezium of the velocity; a white acceleration kicks it.
            kick = np.sqrt(process_noise.psd * h) * rng.standard_normal(2)
            before = pace
            if memory > 0.0:
                turn = turn - h * turn / memory + kick / memory
                pace = pace + h * turn
            else:
                pace = pace + kick
            truth = truth + 0.5 * h * (before + pace)
        seen = truth + sigma * rng.standard_normal(2)
        state = Predict(k * dt)(state, process_noise)
        outcome = Measure(0, seen, sigma**2 * np.eye(2))(state, process_noise)
        state = outcome.state
        nis.append(outcome.nis)
        away = state.mean[:4] - np.append(truth, pace)
        nees.append(square(away, state.drift_covariance))
    # Chi-square means 2 and 4 with standard errors 0.1 and about 0.3 (errors in time correlate).
    assert np.mean(nis) == pytest.approx(2.0, abs=0.4)
    assert np.mean(nees) == pytest.approx(4.0, abs=1.0)
    assert np.all(np.linalg.eigvalsh(state.drift_covariance) > 0.0)
    # The pace is known much better than from two frames, and right.
    sigmas = np.sqrt(np.diag(state.drift_covariance)[2:])
    assert np.all(sigmas < 0.7 * np.sqrt(2.0) * sigma / dt)
    assert np.all(np.abs(state.velocity - pace) < 4.0 * sigmas)


# -- keyframes ----------------------------------------------------------------------------------


def sampled(state: DriftState, count: int, seed: int) -> Array:
    """(count, n) draws of a state."""
    root = np.linalg.cholesky(state.covariance)
    rng = np.random.default_rng(seed)
    return state.mean + rng.standard_normal((count, state.mean.size)) @ root.T


def assert_like_draws(state: DriftState, draws: Array) -> None:
    """Mean and covariance of a state are those of draws."""
    unit = np.sqrt(np.diag(state.covariance))
    count = len(draws)
    # Five standard errors of a mean, and of a correlation or a variance.
    assert np.max(np.abs(draws.mean(axis=0) - state.mean) / unit) < 5.0 / np.sqrt(count)
    seen = np.cov(draws.T) / np.outer(unit, unit)
    stated = state.covariance / np.outer(unit, unit)
    assert np.max(np.abs(seen - stated)) < 5.0 * np.sqrt(2.0 / count)


def test_a_new_keyframe_lies_where_the_frame_lies() -> None:
    state, removed, acceleration_term_s2 = random_state(7), np.array([0.3, -0.2, 0.5, 0.1]), 0.4
    noise = np.diag([0.5, 0.2, 0.1, 0.3])
    # Enough process noise for what happens within the frame to matter, too.
    noisy = ProcessNoise(40.0)
    extended = AddKeyframe(9, removed, acceleration_term_s2, noise, 0.8)(state, noisy)
    assert extended.keys == (4, 7, 9)
    assert extended.keyframe_slice(9) == slice(BASE_SIZE + 8, BASE_SIZE + 12)
    draws = sampled(state, 40000, 1)
    own = noise + noisy.frame_covariance(0.8)
    error = np.random.default_rng(2).standard_normal((40000, 4)) * np.sqrt(np.diag(own))
    # The image is that of p + b a; b times what was taken out for the acceleration is gone, and
    # so is the velocity that was taken out.
    where = np.column_stack(
        [draws[:, :2] + acceleration_term_s2 * (draws[:, 4:6] - removed[2:]), draws[:, 2:4]]
    )
    where[:, 2:] -= removed[:2]
    assert_like_draws(extended, np.column_stack([draws, where + error]))
    # A frame now is expected where the keyframe lies, but for the acceleration_term_s2.
    shift, _ = extended.predict_shift(9)
    np.testing.assert_allclose(shift, -acceleration_term_s2 * (state.acceleration - removed[2:]))


def test_a_clone_copies_the_parent_with_what_was_measured() -> None:
    state = random_state(8)
    shift, noise = np.array([5.0, -3.0, 0.2, 0.1]), np.diag([0.1, 0.2, 0.3, 0.4])
    zoom = np.array([[0.5, 0.1], [0.0, 0.4]])
    cloned = CloneKeyframe(8, 4, shift, 1.5, noise, zoom)(state, FADING)
    assert cloned.keys == (4, 7, 8)
    draws = sampled(state, 40000, 3)
    error = np.random.default_rng(4).standard_normal((40000, 4)) * np.sqrt(np.diag(noise))
    where = draws[:, BASE_SIZE : BASE_SIZE + 4] * [1.0, 1.0, 1.5, 1.5] + shift + error
    # What was measured lacks Z e.
    where[:, :2] += draws[:, 6:8] @ zoom.T
    assert_like_draws(cloned, np.column_stack([draws, where]))
    # Without noise of its own their distance is known exactly.
    exact = CloneKeyframe(8, 4, shift, 1.0, np.zeros((4, 4)))(state, FADING)
    both = np.hstack([-np.eye(4), np.zeros((4, 4)), np.eye(4)])
    np.testing.assert_allclose(both @ exact.mean[BASE_SIZE:], shift)
    np.testing.assert_allclose(
        both @ exact.covariance[BASE_SIZE:, BASE_SIZE:] @ both.T, 0.0, atol=1e-13
    )


def test_a_corrected_shear_moves_a_keyframe_and_leaves_every_covariance() -> None:
    state = random_state(9)
    removed = np.array([0.3, -0.2, 0.5, 0.1])
    again = CorrectShear(7, removed, 0.4)(state, FADING)
    change = again.mean - state.mean
    np.testing.assert_allclose(
        change[state.keyframe_slice(7)], [-0.2, -0.04, -0.3, 0.2], atol=1e-12
    )
    change[state.keyframe_slice(7)] = 0.0
    np.testing.assert_array_equal(change, 0.0)
    np.testing.assert_allclose(again.covariance, state.covariance, rtol=1e-15)
    # The same as if it had been taken out when the keyframe was made.
    start, noise = random_state(9, ()), np.eye(4)
    later = CorrectShear(1, removed, 0.4)(
        AddKeyframe(1, np.ones(4), 0.4, noise, 0.5)(start, WHITE), WHITE
    )
    at_once = AddKeyframe(1, np.ones(4) + removed, 0.4, noise, 0.5)(start, WHITE)
    np.testing.assert_allclose(later.mean, at_once.mean, atol=1e-12)
    np.testing.assert_allclose(later.covariance, at_once.covariance, atol=1e-12)


def test_drop_forgets_one_keyframe_and_nothing_else() -> None:
    state = random_state(10, (4, 7, 5))
    left = Marginalise(7)(state, FADING)
    kept = np.r_[0 : BASE_SIZE + 4, BASE_SIZE + 8 : BASE_SIZE + 12]
    assert left.keys == (4, 5)
    np.testing.assert_allclose(left.mean, state.mean[kept])
    np.testing.assert_allclose(left.covariance, state.covariance[np.ix_(kept, kept)])
    np.testing.assert_array_equal(left.keyframe_state(5), state.keyframe_state(5))
    # Which is what would be without it from the beginning.
    measure = Measure(5, np.array([0.1, 0.2]), np.eye(2))
    before = Marginalise(7)(measure(state, FADING).state, FADING)
    after = measure(left, FADING).state
    np.testing.assert_allclose(before.mean, after.mean, atol=1e-12)
    np.testing.assert_allclose(before.covariance, after.covariance, atol=1e-12)


def test_widen_adds_to_the_drift_and_not_to_the_keyframes() -> None:
    state = random_state(11)
    wider = Inflate(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))(state, FADING)
    np.testing.assert_array_equal(wider.mean, state.mean)
    added = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0] + [0.0] * (BASE_SIZE + 2))
    np.testing.assert_allclose(wider.covariance - state.covariance, added, atol=1e-12)


@dataclass
class Stream:
    """Frames of a simulated specimen: where it is, and where each frame's noise makes it seem.

    Attributes
    ----------
    times
        (n,) of the frames.
    drift, pace, turn
        (n, 2) truth.
    seen, seen_pace
        (n, 2) with the noise of each frame.
    """

    times: Array
    drift: Array
    pace: Array
    turn: Array
    seen: Array
    seen_pace: Array


SIGMA, SIGMA_PACE, SIGMA_START = 0.3, 0.4, 2.0
FRAME_NOISE = np.diag([SIGMA**2] * 2 + [SIGMA_PACE**2] * 2)
BOW = 0.05


def simulate(count: int, process_noise: ProcessNoise, seed: int) -> Stream:
    """A stream by small steps of the differential equation."""
    rng = np.random.default_rng(seed)
    parts, h = 40, 1.0 / 40.0
    steps = parts * (count - 1)
    kicks = np.sqrt(process_noise.psd * h) * rng.standard_normal((steps, 2))
    turn = np.zeros((steps + 1, 2))
    turn[0] = np.sqrt(process_noise.acceleration_variance) * rng.standard_normal(2)
    fade = 1.0 - h / process_noise.time_constant_s
    for k in range(steps):
        turn[k + 1] = fade * turn[k] + kicks[k] / process_noise.time_constant_s
    pace = np.zeros_like(turn)
    pace[0] = SIGMA_START * rng.standard_normal(2)
    pace[1:] = pace[0] + h * np.cumsum(turn[:-1] + turn[1:], axis=0) / 2.0
    drift = np.zeros_like(turn)
    drift[1:] = h * np.cumsum(pace[:-1] + pace[1:], axis=0) / 2.0
    drift, pace, turn = drift[::parts], pace[::parts], turn[::parts]
    seen = drift + BOW * turn + SIGMA * rng.standard_normal((count, 2))
    seen_pace = pace + SIGMA_PACE * rng.standard_normal((count, 2))
    return Stream(np.arange(float(count)), drift, pace, turn, seen, seen_pace)


def begun(process_noise: ProcessNoise) -> DriftState:
    """The first frame is a keyframe; its velocity and acceleration have their priors."""
    variances = [0.0, SIGMA_START**2, process_noise.acceleration_variance]
    state = Inflate(np.diag(np.repeat(variances, 2)))(initial_state(0.0), process_noise)
    return AddKeyframe(0, np.zeros(4), BOW, FRAME_NOISE, 0.0)(state, process_noise)


def follow(
    stream: Stream, process_noise: ProcessNoise, *, chain: int, with_shear: bool
) -> tuple[list[DriftState], dict[int, Array]]:
    """The filter's states after each frame, and where the keyframes truly are.

    Every ``chain`` frames the frame becomes the keyframe of those that follow; only three
    keyframes are kept, the first one always.
    """
    state, states, current = begun(process_noise), [], 0
    truth = {0: np.append(stream.seen[0], stream.seen_pace[0])}
    states.append(state)
    for k in range(1, len(stream.times)):
        state = Predict(float(stream.times[k]))(state, process_noise)
        frame = np.append(stream.seen[k], stream.seen_pace[k])
        # A registration knows only the difference of two images.
        count = 4 if with_shear else 2
        measure = Measure(
            current, (frame - truth[current])[:count], FRAME_NOISE[:count, :count], 1.0, BOW
        )
        state = measure(state, process_noise).state
        if k % chain == 0:
            shift, noise = np.zeros(4), np.zeros((4, 4))
            shift[:count] = measure.shift
            truth[k] = truth[current] + shift
            state = CloneKeyframe(k, current, shift, 1.0, noise)(state, process_noise)
            current = k
            if len(state.keys) > 3:
                gone = state.keys[1]
                state = Marginalise(gone)(state, process_noise)
                del truth[gone]
        states.append(state)
    return states, truth


NOISE = ProcessNoise(0.05, 3.0)


@pytest.mark.parametrize("with_shear", [False, True])
def test_errors_of_simulated_streams_are_as_stated(with_shear: bool) -> None:
    runs, count = 80, 16
    nees, landmarks, bias = [], [], []
    for seed in range(runs):
        stream = simulate(count, NOISE, seed)
        states, truth = follow(stream, NOISE, chain=4, with_shear=with_shear)
        last = states[-1]
        true = np.concatenate([stream.drift[-1], stream.pace[-1], stream.turn[-1]])
        nees.append(square(last.mean[:6] - true, last.covariance[:6, :6]))
        bias.append((last.mean[:2] - true[:2]) / np.sqrt(np.diag(last.covariance)[:2]))
        key = last.keys[-1]
        away = last.keyframe_state(key)[:2] - truth[key][:2]
        landmarks.append(
            square(
                away, last.covariance[last.keyframe_slice(key), last.keyframe_slice(key)][:2, :2]
            )
        )
        assert len(last.keys) == 3
        assert last.keys[0] == 0
    # Sums of independent chi-squares, within what happens but once in ten thousand times.
    low, high = stats.chi2.ppf([5e-5, 1.0 - 5e-5], 6 * runs)
    assert low < np.sum(nees) < high
    low, high = stats.chi2.ppf([5e-5, 1.0 - 5e-5], 2 * runs)
    assert low < np.sum(landmarks) < high
    assert np.max(np.abs(np.mean(bias, axis=0))) < 4.0 / np.sqrt(runs)


def test_noise_of_a_keyframe_does_not_average_out() -> None:
    # At rest, and known to be: only the noise of the images is left.
    rest = ProcessNoise(0.0)
    state = AddKeyframe(0, np.zeros(4), 0.0, FRAME_NOISE, 0.0)(initial_state(0.0), rest)
    # A drift that may be anywhere but does not move.
    state = Inflate(np.diag([100.0, 100.0, 0.0, 0.0, 0.0, 0.0]))(state, rest)
    for _ in range(400):
        state = Measure(0, np.zeros(2), FRAME_NOISE[:2, :2])(state, rest).state
    # 400 frames leave a 20th of the noise of each; that of the keyframe stays: sigma^2 (1 + 1/400).
    assert state.covariance[0, 0] == pytest.approx(SIGMA**2 * (1.0 + 1.0 / 400.0), rel=1e-3)


def test_coming_back_to_the_first_keyframe_undoes_what_was_lost_on_the_way() -> None:
    process_noise = ProcessNoise(0.5, 3.0)
    state, current, times = begun(process_noise), 0, 0.0
    sigmas = []
    for k in range(1, 13):
        times += 1.0
        state = Predict(times)(state, process_noise)
        state = Measure(current, np.zeros(2), FRAME_NOISE[:2, :2])(state, process_noise).state
        # As an image it weighs a little otherwise than it did when it was measured.
        state = CloneKeyframe(k, current, np.zeros(4), 1.0, FRAME_NOISE * 0.2)(state, process_noise)
        current = k
        sigmas.append(float(np.sqrt(state.covariance[0, 0])))
    # Each link adds its noise.
    assert np.all(np.diff(sigmas) > 0.0)
    chained = float(
        np.sqrt(state.covariance[state.keyframe_slice(6).start, state.keyframe_slice(6).start])
    )
    state = Predict(times + 1.0)(state, process_noise)
    back = Measure(0, np.zeros(2), FRAME_NOISE[:2, :2])(state, process_noise).state
    sigma = float(np.sqrt(back.covariance[0, 0]))
    # Two images at most, as for the first frame after the keyframe.
    assert sigma < np.sqrt(2.0) * SIGMA
    assert sigma < 0.75 * sigmas[-1]
    # The keyframes on the way become better known, too.
    assert (
        np.sqrt(back.covariance[back.keyframe_slice(6).start, back.keyframe_slice(6).start])
        < 0.97 * chained
    )
    # Another look at the end of the chain would have helped less.
    stay = Measure(current, np.zeros(2), FRAME_NOISE[:2, :2])(state, process_noise).state
    assert np.sqrt(stay.covariance[0, 0]) > 1.2 * sigma


def test_the_mean_drift_over_a_frame_is_bowed_by_the_acceleration() -> None:
    # What the module says of b: the mean of a t^2 / 2 over A is a A^2 / 24.
    scan, acceleration = 1.3, np.array([0.7, -0.4])
    t = (np.arange(100000) + 0.5) / 100000 * scan - 0.5 * scan
    mean = np.mean(0.5 * t**2) * acceleration
    state = initial_state(0.0)
    state = DriftState(0.0, np.insert(np.zeros(BASE_SIZE - 2), 4, acceleration), state.covariance)
    state = AddKeyframe(0, np.zeros(4), 0.0, np.zeros((4, 4)), 0.0)(state, WHITE)
    measure = Measure(0, mean, np.eye(2), acceleration_term_s2=scan**2 / 24.0)
    np.testing.assert_allclose(measure(state, WHITE).innovation[:2], acceleration * 0.0, atol=1e-9)


def test_a_zoom_there_and_back_is_known_better_than_a_zoom() -> None:
    centre = np.array([[4.0, 1.2], [1.2, 2.25]])
    zoom = np.array([[-0.3, 0.02], [0.0, -0.28]])
    rest = ProcessNoise(0.0)
    exact, sharp = np.zeros((4, 4)), 1e-6 * np.eye(2)
    state = AddKeyframe(0, np.zeros(4), 0.0, exact, 0.0)(initial_state(0.0, centre), rest)
    state = Inflate(np.diag([100.0, 100.0, 0.0, 0.0, 0.0, 0.0]))(state, rest)
    np.testing.assert_array_equal(state.covariance[6:8, 6:8], centre)
    # Over there nobody knows what was drift and what was the zoom (a prior of 100 tells 0.5 %).
    there = CloneKeyframe(1, 0, np.zeros(4), 1.0, exact, zoom)(state, rest)
    there = Measure(1, np.zeros(2), sharp)(there, rest).state
    np.testing.assert_allclose(there.drift_covariance[:2, :2], zoom @ centre @ zoom.T, rtol=0.01)
    # Back by the same way the error has undone itself.
    back = CloneKeyframe(2, 1, np.zeros(4), 1.0, exact, -zoom)(there, rest)
    at = back.keyframe_slice(2)
    np.testing.assert_allclose(back.covariance[at, at], 0.0, atol=1e-12)
    # Seen from the first keyframe before and after, a specimen at rest tells the error: what a
    # sharp look after the zoom adds to one from before it.
    before = Measure(0, np.zeros(2), sharp)(state, rest).state
    error = np.array([1.5, -0.7])
    after = Measure(0, -zoom @ error, sharp, zoom=zoom)(before, rest).state
    found, spread = after.mean[6:8], after.covariance[6:8, 6:8]
    # 1 / 0.3 px per unit and noises of 0.001 for each look: a few thousandths.
    np.testing.assert_allclose(found, error, atol=0.03)
    assert np.all(np.sqrt(np.diag(spread)) < 0.01)


# -- refusals -----------------------------------------------------------------------------------


def test_bad_input_is_refused() -> None:
    state = random_state()
    with pytest.raises(InvalidValueError, match="later time"):
        Predict(0.5)(state, WHITE)
    with pytest.raises(InvalidValueError, match="later time"):
        Predict(float("nan"))(state, WHITE)
    for wrong in (
        ProcessNoise(-1.0),
        ProcessNoise(float("nan")),
        ProcessNoise(1.0, -2.0),
        ProcessNoise(1.0, float("nan")),
    ):
        with pytest.raises(InvalidValueError, match="numbers >= 0"):
            Predict(2.0)(state, wrong)
    for shift in ([np.nan, 0.0], [0.0, np.inf], [0.0, 0.0, np.nan, 0.0]):
        with pytest.raises(InvalidValueError, match="finite"):
            Measure(4, np.array(shift), np.eye(len(shift)))(state, WHITE)
    with pytest.raises(InvalidValueError, match="positive definite"):
        Measure(4, np.zeros(2), -1000.0 * np.eye(2))(state, WHITE)
    with pytest.raises(InvalidValueError, match="positive definite"):
        Measure(4, np.zeros(2), np.full((2, 2), np.nan))(state, WHITE)
