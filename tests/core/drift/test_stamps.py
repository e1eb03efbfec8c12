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

"""Stamps that are equal, or go back: what cannot be known from them is said, and no drift is made up."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.estimates import DriftPath, DriftUpdate
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.registration.failures import MatchFailure
from tests.helpers.drift_scenes import Texture, noisy, small_camera

TEXTURE = Texture(seed=4, n=512)
# Drift from one frame to the next, px.
STEP_PX = np.array([0.6, -0.4])
SAME = "coasting: time: the same as that of the previous frame, before any drift is known"


def grey(picture: Array) -> np.ndarray:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def frame(k: int, step_px: Array = STEP_PX) -> np.ndarray:
    """Frame number k of a specimen that drifts steadily."""
    x, y = (k * step_px).tolist()
    return grey(noisy(TEXTURE.view((x, y), 192), 4.0, k))


def track(times: list[float], step_px: Array = STEP_PX) -> tuple[list[DriftUpdate], DriftPath]:
    """The drift at frames with those stamps: live, and with hindsight."""
    history = DriftHistory()
    tracker = DriftTracker(history=history)
    updates = [tracker.update(frame(k, step_px), t) for k, t in enumerate(times)]
    return updates, history.smooth()


def errors_px(path: list[DriftUpdate], step_px: Array = STEP_PX) -> Array:
    """(n, 2) of the drift at each frame, px."""
    return np.array([u.drift_px - k * step_px for k, u in enumerate(path)])


def test_before_any_drift_is_known_a_frame_of_the_same_time_is_not_measured() -> None:
    """Stamps of a whole second, at two frames a second: the second frame gets the time of the first."""
    updates, path = track([float(k // 2) for k in range(8)])
    for second in (updates[1], path[1]):
        assert second.rejection is not None
        assert second.rejection.status is MatchFailure.REPEATED_TIME
        assert second.status_text.startswith(SAME)
        assert np.all(np.isinf(second.sigma_px))
    # No frame after it has its drift left in, which was 0.7 px.
    assert all(u.accepted for u in updates[2:])
    errors, sigmas = errors_px(updates)[2:], np.array([u.sigma_px for u in updates])[2:]
    assert np.all(np.abs(errors) < 4.0 * sigmas)
    assert float(np.max(sigmas)) < 0.05


def test_without_any_other_time_no_drift_is_stated() -> None:
    updates, path = track([0.0] * 4)
    assert [u.status_text[: len(SAME)] for u in updates] == ["keyframe", SAME, SAME, SAME]
    assert not path.followed
    assert all(np.all(np.isinf(u.sigma_px)) for u in [*updates[1:], *path[1:4]])


def test_a_frame_that_was_sent_twice_is_said_to_be_one() -> None:
    tracker = DriftTracker()
    tracker.update(frame(0), 0.0)
    again = tracker.update(frame(0), 0.0)
    assert again.status_text == "coasting: image: the same as the previous frame"


@pytest.mark.parametrize(
    "step_px", [0.05 * STEP_PX, STEP_PX, 5.0 * STEP_PX], ids=["slow", "usual", "fast"]
)
def test_later_a_frame_of_the_same_time_is_measured_and_spoils_nothing(step_px: Array) -> None:
    """It was taken up to an interval later: its drift may be that of so much time, and its velocity is not infinite."""
    times = [float(k) for k in range(14)]
    times[9] = times[8]
    updates, path = track(times, step_px)
    assert all(u.accepted for u in updates)
    for known in (updates, list(path.updates)):
        errors, sigmas = errors_px(known, step_px)[1:], np.array([u.sigma_px for u in known])[1:]
        assert np.all(np.abs(errors) < 4.0 * sigmas)
        assert float(np.max(sigmas[7:])) < 0.05
    variances = np.array([np.diag(u.covariance)[2:] for u in updates[2:]])
    assert np.all(variances > 0.0)
    # A change of the velocity by as much as itself is all that such a stamp may tell.
    assert np.all(variances[6:] < (2.0 * np.hypot(*step_px)) ** 2 + 0.1**2)


def test_frames_of_the_same_time_that_match_nothing_leave_the_velocity_finite() -> None:
    tracker = DriftTracker()
    for k in range(6):
        tracker.update(frame(k), float(k))
    other = Texture(seed=9, n=256).view((0.0, 0.0), 192)
    lost = [tracker.update(grey(noisy(other, 4.0, 50 + k)), 5.0) for k in range(9)]
    assert any(u.restarted for u in lost)
    # The first step's sigma, 10 px, in each interval.
    assert all(np.all(np.diag(u.covariance)[2:] < 100.0**2) for u in lost)


@pytest.mark.parametrize("is_blank", [False, True], ids=["seen", "blank"])
def test_a_time_that_goes_back_begins_anew_and_says_so(is_blank: bool) -> None:
    history = DriftHistory()
    tracker = DriftTracker(history=history)
    live = []
    for k in range(9):
        image = np.zeros((192, 192), np.uint8) if is_blank and k == 4 else frame(k)
        live.append(tracker.update(image, float(k if k < 4 else k - 3)))
    first = 5 if is_blank else 4
    assert live[first].status_text == "keyframe" and np.all(live[first].drift_m == 0.0)
    for path in (DriftPath(live), history.smooth()):
        assert path.restarted.tolist() == [k == 4 for k in range(9)]
        # What is counted from another frame is no drift since the first one.
        assert path.trusted.tolist() == [k < 4 for k in range(9)]
        errors = errors_px(list(path.updates))[first:] + first * STEP_PX
        assert float(np.max(np.abs(errors))) < 0.05


def test_a_stream_that_gains_a_camera_begins_anew_and_says_so() -> None:
    tracker = DriftTracker()
    camera = small_camera(2000.0)
    updates = [tracker.update(frame(k), float(k), camera if k >= 2 else None) for k in range(4)]
    assert [u.restarted for u in updates] == [False, False, True, False]


def test_to_begin_late_or_to_be_reset_is_no_restart() -> None:
    """Nothing was counted from a frame before."""
    tracker = DriftTracker()
    blank = np.zeros((192, 192), np.uint8)
    updates = [tracker.update(f, t) for f, t in ((blank, 3.0), (blank, 2.0), (frame(0), 4.0))]
    tracker.reset()
    updates.append(tracker.update(frame(1), 0.0))
    assert [u.accepted for u in updates] == [False, False, True, True]
    assert not any(u.restarted for u in updates)


@pytest.mark.parametrize("begin_s", [0.0, 0.2, 0.35, 0.6])
@pytest.mark.parametrize("interval_s", [0.5, pytest.param(0.7, marks=pytest.mark.long)])
def test_hindsight_that_contradicts_the_frames_is_not_believed(
    begin_s: float, interval_s: float
) -> None:
    """Frames that share a second are stamped a millisecond apart, as by a driver whose frames come in bursts."""
    times: list[float] = []
    for k in range(24):
        second = float(np.floor(begin_s + interval_s * k))
        times.append(second if not times or second > times[-1] else times[-1] + 1e-3)
    step_px = 2.0 * STEP_PX
    updates, path = track(times, step_px)
    for found in (updates, list(path)[1:]):
        used = [u for u in found if u.accepted and u is not updates[0]]
        assert len(used) > 12
    for k, update in enumerate(path):
        if k and update.accepted:
            assert np.all(np.abs(update.drift_px - k * step_px) < 4.0 * update.sigma_px)
    assert np.all(np.diagonal(path.covariance[1:], axis1=1, axis2=2) >= 0.0)
