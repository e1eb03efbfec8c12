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

"""The time of one pass, from how changing drift shears the frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.estimates import DriftPath, DriftStatus
from semcal_ros.core.drift.frame_time import (
    FrameTimeEstimate,
    estimate_frame_time,
)
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.thresholds import (
    SHEAR_OF_SHIFT_DISTORTED,
    SHEAR_OF_SHIFT_RECTIFIED,
)
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.registration.failures import MatchFailure
from tests.helpers.drift_scenes import DriftingSpecimen, make_drift_update, small_camera

PX_M = 50e-9
Law = Callable[[np.ndarray], np.ndarray]


def wandering(seed: int, px: float = 1.0) -> Law:
    """Drift (n, 2) in px at times (n,) whose velocity changes within some ten seconds."""
    rng = np.random.default_rng(seed)
    period, phase = rng.uniform(12.0, 40.0, (2, 3)), rng.uniform(0.0, 6.28, (2, 3))
    return lambda t: px * np.sin(2 * np.pi * t[:, None, None] / period + phase).sum(axis=2)


def settling(t: np.ndarray) -> np.ndarray:
    """One exponential in both directions."""
    return np.outer(1.0 - np.exp(-t / 20.0), [12.0, -7.0])


class Stream:
    """What a tracker would report of frames that take ``time_s`` each, one per second, without
    images; ``gradient`` is B.
    """

    def __init__(
        self,
        law: Law,
        time_s: float,
        seed: int,
        *,
        frames: int = 60,
        sigma_px: float = 0.02,
        velocity_sigma_px_s: float = 0.03,
        gradient: float = 0.0,
    ) -> None:
        rng = np.random.default_rng([seed, 5])
        t = np.arange(float(frames))
        position = law(t)
        velocity = (law(t + 1e-3) - law(t - 1e-3)) / 2e-3
        # A smoothed velocity is an expectation: what it lacks does not depend on it.
        true = velocity + velocity_sigma_px_s * rng.standard_normal((frames, 2))
        key = (np.arange(frames) - 1) // 20 * 20
        noise = sigma_px * rng.standard_normal((frames, 2))
        shear = time_s * (true - true[key]) + gradient * (position - position[key])
        shear += noise - noise[key]
        own = np.diag([1e-6, 1e-6, velocity_sigma_px_s**2, velocity_sigma_px_s**2]) * PX_M**2
        self.updates = [
            make_drift_update(
                time_s=float(t[k]),
                drift_m=position[k] * PX_M,
                velocity_m_s=velocity[k] * PX_M,
                covariance=own,
                status=DriftStatus.TRACKED if k else DriftStatus.KEYFRAME,
                px_from_unit=np.eye(2) / PX_M,
                shear_px=shear[k] if k else np.full(2, np.nan),
                shear_covariance=np.eye(2) * 2.0 * sigma_px**2,
                keyframe_time_s=float(t[key[k]]) if k else float("nan"),
            )
            for k in range(frames)
        ]

    @property
    def path(self) -> DriftPath:
        return DriftPath(tuple(self.updates))

    def estimate(self, shear_of_shift: float = SHEAR_OF_SHIFT_DISTORTED) -> FrameTimeEstimate:
        return estimate_frame_time(self.path, shear_of_shift=shear_of_shift)


@pytest.mark.parametrize("time_s", [0.9, 0.2])
@pytest.mark.parametrize("gradient", [0.0, 0.01])
def test_the_time_is_found_within_what_is_stated(time_s: float, gradient: float) -> None:
    found = [
        Stream(wandering(seed), time_s, seed, gradient=gradient).estimate() for seed in range(30)
    ]
    assert all(e.observable and e.converged for e in found), [e.reason for e in found]
    times = np.array([e.frame_time_s for e in found])
    sigmas = np.array([e.sigma_s for e in found])
    z = (times - time_s) / sigmas
    # The part for what one image's registrations have in common is in sigma, not in this scatter.
    assert np.sqrt(np.mean(z**2)) < 1.1
    assert np.max(np.abs(z)) < 3.5
    # No attenuation by the noise of the velocities.
    assert np.mean(times) == pytest.approx(time_s, abs=max(4.0 * np.std(times) / 30**0.5, 0.003))
    assert np.max(sigmas) < 0.1 * time_s + 0.02
    assert 0.5 < np.median([e.chi2_per_dof for e in found]) < 1.6


def test_noise_larger_than_stated_enlarges_sigma() -> None:
    z = []
    for seed in range(20):
        stream = Stream(wandering(seed), 0.3, seed, sigma_px=0.04, velocity_sigma_px_s=0.0)
        stream.updates = [
            replace(u, shear_covariance=u.shear_covariance / 4.0) for u in stream.updates
        ]
        found = stream.estimate()
        assert found.chi2_per_dof > 1.5
        z.append((found.frame_time_s - 0.3) / found.sigma_s)
    assert np.sqrt(np.mean(np.square(z))) < 1.2


def test_a_few_outliers_do_no_harm() -> None:
    clean = Stream(wandering(3), 0.8, 3)
    spoilt = Stream(wandering(3), 0.8, 3)
    for k in (7, 24, 33, 52):
        spoilt.updates[k] = replace(
            spoilt.updates[k], shear_px=spoilt.updates[k].shear_px + [1.0, -2.0]
        )
    before, after = clean.estimate(), spoilt.estimate()
    assert after.observable
    assert after.frame_time_s == pytest.approx(before.frame_time_s, abs=1.5 * before.sigma_s)


def test_frames_that_are_refused_or_have_no_keyframe_do_not_count() -> None:
    stream = Stream(wandering(1), 0.8, 1)
    before = stream.estimate()
    refused = Rejection(MatchFailure.OUTLIER, "far from the prediction")
    bad: dict[int, dict[str, Any]] = {4: {"rejection": refused}}
    bad[9] = {"keyframe_time_s": float("nan")}
    bad[15] = {"shear_covariance": np.full((2, 2), np.inf)}
    # Tracking began anew, and nothing was measured since.
    bad[23] = {"covariance": np.diag([1e-18, 1e-18, np.inf, np.inf])}
    for k, changes in bad.items():
        stream.updates[k] = replace(stream.updates[k], **changes)
    after = stream.estimate()
    assert (before.frames, after.frames) == (59, 55)
    assert after.frame_time_s == pytest.approx(before.frame_time_s, abs=before.sigma_s)


def test_a_steady_drift_tells_nothing() -> None:
    for seed in range(10):
        law: Law = lambda t: np.outer(t, [1.5, -0.8])  # noqa: E731
        found = Stream(law, 0.8, seed, velocity_sigma_px_s=0.0).estimate()
        assert not found.observable
        assert "velocity of the drift changes too little" in found.reason


def test_noise_alone_tells_nothing() -> None:
    for seed in range(20):
        # Velocities change, but nothing is sheared; or nothing moves at all.
        for law, time_s in ((wandering(seed), 0.0), (wandering(seed, 0.0), 0.8)):
            assert not Stream(law, time_s, seed).estimate().observable


def test_a_settling_is_known_as_well_as_the_distortion() -> None:
    """Shift and velocity go together there, so distortion looks like a frame time."""
    for gradient in (SHEAR_OF_SHIFT_DISTORTED, -SHEAR_OF_SHIFT_DISTORTED):
        stream = Stream(settling, 0.4, 2, gradient=gradient, velocity_sigma_px_s=0.01)
        found = stream.estimate()
        assert found.sigma_s > 0.5 * SHEAR_OF_SHIFT_DISTORTED * 20.0 / 2**0.5
        assert abs(found.frame_time_s - 0.4) < 3.0 * found.sigma_s
    known = Stream(settling, 0.4, 2, velocity_sigma_px_s=0.01).estimate(SHEAR_OF_SHIFT_RECTIFIED)
    assert known.observable
    assert known.frame_time_s == pytest.approx(0.4, abs=3.0 * known.sigma_s)
    assert known.sigma_s < 0.6 * found.sigma_s


def test_a_pass_is_not_longer_than_the_interval() -> None:
    longer = Stream(wandering(4), 1.6, 4).estimate()
    assert not longer.observable
    assert "longer than the 1 s between frames" in longer.reason
    equal = [Stream(wandering(seed), 1.0, seed).estimate() for seed in range(10)]
    assert all(e.observable and e.frame_time_s <= 1.0 for e in equal)
    assert any(e.frame_time_s == 1.0 for e in equal)
    negative = Stream(wandering(4), -0.8, 4).estimate()
    assert not negative.observable
    assert "negative" in negative.reason


def test_bad_arguments_and_short_streams() -> None:
    stream = Stream(wandering(1), 0.8, 1)
    short = estimate_frame_time(DriftPath(stream.updates[:5]))
    assert not short.observable
    assert "4 frames" in short.reason
    for value in (0.0, float("nan")):
        with pytest.raises(InvalidValueError, match="shear_of_shift"):
            stream.estimate(value)


def tracked(law_px: Law, timing: ScanTiming, frames: int, seed: int) -> FrameTimeEstimate:
    """From images: a tracker that knows nothing of their raster, one of them per second."""
    camera = small_camera(2000.0)
    specimen = DriftingSpecimen(pitch_m=0.1e-6, seed=seed)
    unit = np.linalg.inv(camera.ideal_from_sem_jacobian)
    history = DriftHistory()
    tracker = DriftTracker(history=history)
    for k in range(frames):
        time_s = np.array([0.0, k, k - 0.5 * timing.frame_time_s, k + 0.5 * timing.frame_time_s])
        zero, middle, first, last = law_px(time_s) @ unit.T
        velocity = (last - first) / timing.frame_time_s
        picture = specimen.frame(camera, timing, middle - zero, velocity, 1000 * seed + k)
        tracker.update(picture, float(k), camera)
    return estimate_frame_time(history.smooth(), shear_of_shift=SHEAR_OF_SHIFT_RECTIFIED)


@pytest.mark.slow
@pytest.mark.parametrize(("time_s", "px"), [(0.95, 0.5), (0.4, 1.0)])
def test_pictures_with_a_true_raster(time_s: float, px: float) -> None:
    found = tracked(wandering(11, px), ScanTiming(time_s, 1, 0.1), 24, 2)
    assert found.observable, found
    assert found.frame_time_s == pytest.approx(time_s, abs=2.5 * found.sigma_s)
    assert found.sigma_s < 0.12 * time_s


def test_pictures_of_a_steady_drift() -> None:
    found = tracked(lambda t: np.outer(t, [0.8, -0.5]), ScanTiming(0.95), 10, 1)
    assert not found.observable
