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

"""Scratches in one direction: the drift across them is tracked, and that along them coasts with its own sigma."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from benchmarks.drift.scenes import KINDS, draw
from semcal_ros.core.arrays import AnyImage, Array
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.registration.register import prepare_reference, register

# Of the scratches of that scene, rad.
ANGLE = 0.3
ALONG = np.array([np.cos(ANGLE), np.sin(ANGLE)])
ACROSS = np.array([-np.sin(ANGLE), np.cos(ANGLE)])


def scratched(count: int, seed: int = 101) -> tuple[list[AnyImage], Array]:
    frames, drift, _ = draw(KINDS["scratches"], seed, count)
    return frames, drift[:count]


@pytest.fixture(scope="module")
def tracked() -> tuple[dict[bool, Sequence[DriftUpdate]], Array]:
    frames, drift = scratched(24)
    history = DriftHistory()
    tracker = DriftTracker(history=history)
    live = [tracker.update(frame, float(k)) for k, frame in enumerate(frames)]
    return {False: live, True: history.smooth().updates}, drift


def sigma(covariance: Array, direction: Array) -> float:
    return float(np.sqrt(direction @ covariance[:2, :2] @ direction))


@pytest.mark.parametrize("offline", [False, True], ids=["live", "smoothed"])
def test_across_is_measured_and_along_is_honestly_predicted(
    tracked: tuple[dict[bool, Sequence[DriftUpdate]], Array], offline: bool
) -> None:
    updates, drift = tracked[0][offline], tracked[1]
    assert all(update.accepted for update in updates)
    lines = [update for update in updates if update.along is not None]
    assert len(lines) == len(updates) - 1
    assert all("predicted along" in update.status_text for update in lines)
    errors = np.array([u.drift_px for u in updates]) - drift
    across = errors[1:] @ ACROSS
    stated = np.array([sigma(u.covariance, ACROSS) for u in updates[1:]])
    # The first frame's own error is in all of them; 3.5 sigmas once in 2000.
    assert np.max(np.abs(across) / stated) < 3.5
    assert np.max(np.abs(across)) < 0.04
    along = np.abs(errors[1:] @ ALONG)
    free = np.array([sigma(u.covariance, ALONG) for u in updates[1:]])
    # It drifts by 0.3 px a frame, of which nothing is seen: the stated sigma is that of a prediction.
    assert np.all(along < 3.0 * free)
    assert free[-1] > 20.0
    assert np.all(np.diff(free) > 0.0)


@pytest.mark.long
def test_a_tool_that_comes_in_does_not_tell_the_drift_along_scratches() -> None:
    frames, drift, _ = draw(KINDS["tool over scratches"], 101)
    tracker = DriftTracker()
    for k, frame in enumerate(frames):
        update = tracker.update(frame, float(k))
        if k > 1:
            error = update.drift_px - drift[k]
            assert abs(error @ ALONG) < 3.0 * sigma(update.covariance, ALONG)
            assert abs(error @ ACROSS) < 3.5 * max(sigma(update.covariance, ACROSS), 0.02)


@pytest.mark.long
def test_what_is_predicted_along_lines_is_not_taken_for_known_again() -> None:
    """Particles that come in later tell how they move, and not how far the specimen has moved before."""
    frames, drift = scratched(20)
    rng = np.random.default_rng(0)
    places = np.array([190.0, 190.0]) + rng.uniform(-150.0, 150.0, (60, 2))
    tracker = DriftTracker()
    for k, frame in enumerate(frames):
        picture = frame.astype(np.float32)
        for place in (places + drift[k]) if k >= 10 else ():
            spot = np.rint(place * 16).astype(int)
            cv2.circle(picture, (int(spot[0]), int(spot[1])), 48, 220.0, -1, cv2.LINE_AA, 4)
        noisy = picture + rng.normal(0.0, 6.0, picture.shape)
        update = tracker.update(np.clip(noisy, 0, 255).astype(np.uint8), float(k))
    assert sigma(update.covariance, ALONG) > 10.0
    assert update.along is not None


def test_particles_tell_the_drift_along_scratches_too() -> None:
    frames, drift = scratched(3)
    middle, rng = np.array([190.0, 190.0]), np.random.default_rng(0)
    places = middle + rng.uniform(-150.0, 150.0, (60, 2))
    tracker = DriftTracker()
    for k, frame in enumerate(frames):
        picture = frame.astype(np.float32)
        for place in places + drift[k]:
            spot = np.rint(place * 16).astype(int)
            cv2.circle(picture, (int(spot[0]), int(spot[1])), 48, 220.0, -1, cv2.LINE_AA, 4)
        noisy = picture + rng.normal(0.0, 6.0, picture.shape)
        update = tracker.update(np.clip(noisy, 0, 255).astype(np.uint8), float(k))
        assert update.along is None
    assert update.accepted
    assert np.max(np.abs(update.drift_px - drift[2])) < 0.1


def test_lines_at_equal_distances_are_refused() -> None:
    x = np.arange(256.0)
    rng = np.random.default_rng(0)
    frames = [
        np.tile(120.0 + 60.0 * np.sin((x - shift) / 2.2), (256, 1)) + rng.normal(0, 10, (256, 256))
        for shift in (0.0, 5.0)
    ]
    found = register(
        prepare_reference(frames[0]),
        frames[1],
        guess_px=(0.0, 0.0),
        guess_covariance=np.eye(2) * 100.0,
        takes_lines=True,
    )
    assert not found.accepted


@pytest.mark.long
def test_lines_are_refused_without_a_prediction_and_where_nobody_takes_them() -> None:
    frames, drift = scratched(24)
    reference, spread = prepare_reference(frames[0]), 9.0 * np.eye(2)
    assert not register(reference, frames[1], takes_lines=True).accepted
    for frame, moved in zip(frames[1:], drift[1:], strict=True):
        found = register(reference, frame, guess_px=moved, guess_covariance=spread)
        assert not found.accepted
        assert found.along is None
