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

"""What the filter knows of frames that a part of the picture pulls, such as a gripper at rest over a few particles."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.drift.scenes import KINDS, draw
from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.filter_update import limit_by_pull, widen_earlier
from semcal_ros.core.drift.operations import AddKeyframe, CloneKeyframe, Measure, Predict
from semcal_ros.core.drift.smoother import Mark, estimate_process_noise, separate_common, smooth
from semcal_ros.core.drift.state import BASE_SIZE, DriftState
from semcal_ros.core.drift.tracker import DriftTracker
from tests.helpers.long_tests import long_but

NOISE = 0.05


def _filter(psd: float = 1e-6) -> DriftFilter:
    """At rest, with keyframe 0 at a place that is known."""
    covariance = np.diag([*[1.0] * 2, *[0.1] * 2, *[0.0] * (BASE_SIZE - 4), *[1e-8] * 4])
    start = DriftState(0.0, np.zeros(BASE_SIZE + 4), covariance, (0,))
    return DriftFilter.begin(start, psd, keeps_history=True)


def _measure(shift: Array, pull: Array) -> Measure:
    own, common = NOISE**2 * np.eye(2), np.outer(pull, pull)
    if not np.any(pull):
        return Measure(0, shift, own)
    return Measure(0, shift, own + common, independent=own, common=common)


def _sigmas(filtered: DriftFilter) -> Array:
    return np.sqrt(np.diag(filtered.state.covariance)[:2])


def test_no_mean_of_frames_that_are_pulled_alike_is_better_than_the_pull() -> None:
    filtered, pull = _filter(), np.array([0.3, 0.0])
    for k in range(1, 31):
        filtered = filtered.apply(Predict(float(k)))
        measure = _measure(np.array([0.3, 0.0]), pull)
        filtered = filtered.update(limit_by_pull(measure, filtered.state, pull))
    along, across = _sigmas(filtered)
    # Thirty independent errors would leave a fifth of it.
    assert 0.29 < along < 0.4
    assert across < NOISE / 2.0


def test_a_pull_below_what_is_left_of_the_noise_changes_nothing() -> None:
    filtered, pull = _filter().apply(Predict(1.0)), np.array([0.02, 0.0])
    measure = _measure(np.zeros(2), pull)
    limited = limit_by_pull(measure, filtered.state, pull)
    np.testing.assert_array_equal(limited.covariance, measure.covariance)
    # It is of chance, and another one in the next frame.
    assert limited.without_common() is limited and not np.any(limited.common)
    measure = _measure(np.zeros(2), np.zeros(2))
    assert limit_by_pull(measure, filtered.state, np.zeros(2)) is measure


def test_where_more_is_known_than_the_pull_tells_the_frame_says_nothing_along_it() -> None:
    filtered = _filter()
    for k in range(1, 11):
        filtered = filtered.apply(Predict(float(k))).update(_measure(np.zeros(2), np.zeros(2)))
    filtered, pull = filtered.apply(Predict(11.0)), np.array([0.0, 2.0])
    measure = limit_by_pull(_measure(np.array([0.1, 1.9]), pull), filtered.state, pull)
    updated = filtered.update(measure)
    assert updated.state.mean[1] == pytest.approx(filtered.state.mean[1], abs=1e-4)
    assert _sigmas(updated)[1] == pytest.approx(_sigmas(filtered)[1], rel=1e-3)
    # Across it does.
    assert updated.state.mean[0] > 0.01


def test_earlier_frames_were_pulled_by_as_much_less_as_they_moved_less() -> None:
    filtered, pull = _filter(), np.array([0.8, 0.0])
    for k in (1, 2, 3):
        shift = np.array([0.0, 0.5 * k])
        filtered = filtered.apply(Predict(float(k))).update(_measure(shift, np.zeros(2)))
    filtered = filtered.apply(Predict(4.0))
    latest = _measure(np.array([0.0, 2.0]), pull)
    widened = widen_earlier(filtered, latest, pull)
    found = [event.covariance for event in widened.events if isinstance(event, Measure)]
    # All three alike: together they say as much as one.
    alone = [np.sqrt(c[0, 0] / 3.0) for c in found]
    np.testing.assert_allclose(alone, [0.2, 0.4, 0.6])
    np.testing.assert_allclose([np.sqrt(c[1, 1]) for c in found], NOISE)
    assert _sigmas(widened)[0] > 3.0 * _sigmas(filtered)[0]
    # Once is enough, and what may be chance is not.
    assert widen_earlier(widened, latest, pull) is widened
    weak = np.array([4.0 * NOISE, 0.0])
    assert widen_earlier(filtered, _measure(np.array([0.0, 2.0]), weak), weak) is filtered


def test_a_frame_that_is_measured_twice_is_widened_where_earlier_ones_are_no_longer_kept() -> None:
    """Without a smoother, events are kept as long as the process noise is estimated from them: 16 measurements."""
    start, nothing = _filter().start.without_keyframes(), np.zeros(2)
    filtered = DriftFilter.begin(start, 1e-6, keeps_history=False)
    filtered = filtered.apply(AddKeyframe(0, np.zeros(4), 0.0, 1e-8 * np.eye(4), 1.0))
    for k in range(1, 31):
        filtered = filtered.apply(Predict(float(k))).update(_measure(nothing, nothing)).mark_frame()
    twice = filtered.apply(Predict(31.0)).update(_measure(np.array([0.0, 2.0]), nothing))
    pull = np.array([0.8, 0.0])
    widened = widen_earlier(twice, _measure(np.array([0.0, 2.0]), pull), pull)
    assert _sigmas(widened)[0] > _sigmas(twice)[0]
    # The frames before stay as they were.
    assert _sigmas(widened)[0] < 1.05 * _sigmas(filtered.apply(Predict(31.0)))[0]


def test_the_covariance_of_a_pull_is_told_apart_from_that_of_the_noise() -> None:
    filtered, pull = _filter().apply(Predict(1.0)), np.array([0.3, 0.4])
    measure = limit_by_pull(_measure(np.zeros(2), pull), filtered.state, pull)
    independent = measure.without_common().covariance
    np.testing.assert_allclose(independent, NOISE**2 * np.eye(2))
    # What is found of earlier frames later on, and does not pull the others, is noise.
    wider = measure.widened(np.eye(2))
    np.testing.assert_allclose(wider.without_common().covariance, independent + np.eye(2))
    np.testing.assert_allclose(wider.common, measure.common)
    assert wider.without_common().without_common().common.tolist() == np.zeros((2, 2)).tolist()


def test_a_pull_goes_with_the_keyframes_that_were_measured_under_it() -> None:
    pulls = [np.diag([variance, 0.0]) for variance in (0.04, 0.01)]
    measures = [Measure(key, np.zeros(2), np.eye(2), common=c) for key, c in enumerate(pulls)]
    clone = CloneKeyframe(1, 0, np.zeros(4), 1.0, np.zeros((4, 4)))
    events = (measures[0], Mark(), clone, measures[1], Mark())
    separated, common = separate_common(events)
    assert [type(event) for event in separated] == [type(event) for event in events]
    np.testing.assert_allclose(common, pulls)


def test_a_random_walk_under_a_pull_is_followed_with_hindsight() -> None:
    """As a part of the noise of each frame, the pull makes the likeliest path one that nearly all frames contradict."""
    rng, pull = np.random.default_rng(5), np.array([0.6, 0.0])
    filtered, walk = _filter(psd=0.01), np.zeros(2)
    truth = []
    for k in range(1, 41):
        walk = walk + rng.normal(0.0, 0.3, 2)
        truth.append(walk)
        seen = walk + 0.5 * pull + rng.normal(0.0, NOISE, 2)
        filtered = filtered.apply(Predict(float(k)))
        measure = limit_by_pull(_measure(seen, pull), filtered.state, pull)
        filtered = filtered.update(measure).mark_frame()
    events, common = separate_common(filtered.events)
    noise = estimate_process_noise(filtered.start, events, filtered.process_noise)
    errors, sigmas = [], []
    for state, at, of_pull in zip(
        smooth(filtered.start, events, noise), truth, common, strict=True
    ):
        errors.append(state.position - at)
        sigmas.append(np.sqrt(np.diag(state.covariance[:2, :2] + of_pull)))
    off, sigma = np.array(errors), np.array(sigmas)
    # All frames have the pull, and what remains is their noise. With the pull as noise of each, 0.14 px remained.
    np.testing.assert_allclose(off.mean(axis=0), 0.5 * pull, atol=0.05)
    assert np.all(off.std(axis=0) < 1.2 * NOISE)
    assert np.all(np.abs(off) < 3.0 * sigma)


@pytest.mark.slow
@pytest.mark.parametrize("seed", long_but(lambda seed: seed == 101, [101, 102, 107]))
def test_a_gripper_that_was_there_from_the_start_is_in_the_sigma(seed: int) -> None:
    frames, drift, _ = draw(KINDS["gripper over sparse"], seed)
    tracker = DriftTracker()
    for k, (frame, at) in enumerate(zip(frames, drift, strict=True)):
        update = tracker.update(frame, float(k))
        off = np.abs(update.drift_px - at)
        # Of 180 numbers, one exceeds 3.5 sigmas by chance in eight of 100 such trials; off by 4 to 5 they were before.
        assert np.all((off < 0.1) | (off < 3.5 * update.sigma_px)), k
