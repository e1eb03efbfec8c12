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

"""Rotation and scale of the specimen's image, in the drift of a stream."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.similarity import (
    SimilarityEstimate,
    SimilarityMatch,
    constrain_registration,
    turn_drift,
)
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.rectification.raw_positions import (
    RasterDrift,
    raw_from_output,
    similarity_matrix,
)
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.register import register_pair
from tests.helpers.drift_scenes import DriftingSpecimen, Texture, noisy, small_camera

SIZE = 192
#: Drift (px) and rotation from frame to frame. A third of this rotation made a tracker of shifts alone refuse
#: 29 of 76 frames.
STEP_PX = np.array([0.7, -0.4])
TURN = np.deg2rad(0.06)
#: Part of the interval in which a frame is scanned.
SCAN = ScanTiming(0.8)


@lru_cache(maxsize=1)
def scene() -> Array:
    """Spline coefficients of a scene of 2 x 2 fields."""
    picture = Texture(3, 2 * SIZE, 1.5, 5.0).view((0.0, 0.0), 2 * SIZE)
    return np.asarray(spline_filter(picture, order=5, mode="grid-wrap"))


def seen(
    time_s: float, turn: float, growth: float, timing: ScanTiming | None = None, noise: float = 5.0
) -> NDArray[np.uint8]:
    """Frame whose centre is at ``time_s``: X from its middle is seen at ``M X + drift``, each pixel at its
    own time.
    """
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    times = np.full(x.shape, time_s)
    if timing is not None:
        times += timing.pixel_offset_s(y, x, SIZE, SIZE) - timing.centre_offset_s
    middle = 0.5 * (SIZE - 1)
    u = x - middle - STEP_PX[0] * times
    v = y - middle - STEP_PX[1] * times
    cos, sin, shrink = np.cos(turn * times), np.sin(turn * times), np.exp(-growth * times)
    at = shrink * (-sin * u + cos * v) + SIZE, shrink * (cos * u + sin * v) + SIZE
    picture = map_coordinates(scene(), at, order=5, mode="grid-wrap", prefilter=False)
    grey = noisy(np.asarray(picture), noise, int(1000 * time_s) % 2**31)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def track(
    turn: float,
    growth: float,
    timing: ScanTiming | None = None,
    settings: DriftSettings | None = None,
    count: int = 14,
) -> tuple[list[DriftUpdate], list[DriftUpdate]]:
    """Live and with hindsight."""
    history = DriftHistory()
    tracker = DriftTracker(settings or DriftSettings(similarity=True), history=history)
    before_s = 0.0 if timing is None else timing.centre_offset_s
    frames = (seen(float(k), turn, growth, timing) for k in range(count))
    live = [tracker.update(frame, k - before_s, None, timing) for k, frame in enumerate(frames)]
    return live, list(history.smooth().updates)


def errors_in_sigmas(updates: list[DriftUpdate], turn: float, growth: float) -> Array:
    """(n, 4) of drift, rotation and scale."""
    rows = []
    for update in updates:
        t = update.time_s
        error = np.append(
            update.drift_m - STEP_PX * t, update.similarity[:2] - np.array([turn, growth]) * t
        )
        variance = np.append(
            np.diag(update.covariance)[:2], np.diag(update.similarity_covariance)[:2]
        )
        rows.append(error / np.sqrt(variance))
    return np.array(rows)


@pytest.mark.parametrize(("turn", "growth"), [(TURN, 0.0), (0.0, 3e-4)])
def test_what_turns_or_grows_is_followed_and_no_frame_is_refused(
    turn: float, growth: float
) -> None:
    live, smoothed = track(turn, growth)
    assert [u.reason for u in live if not u.accepted] == []
    for updates in (live, smoothed):
        sigmas = errors_in_sigmas(updates[1:], turn, growth)
        # 13 frames share the noise of the keyframe, so that four sigmas are one in 10 000 for each number.
        assert np.max(np.abs(sigmas)) < 4.0
    assert live[-1].similarity[:2] == pytest.approx([13 * turn, 13 * growth], abs=4e-4)
    assert smoothed[-1].similarity[2:] == pytest.approx([turn, growth], abs=4e-5)
    drift = np.array([u.drift_m for u in live])
    # As well as without a rotation: a hundredth of a pixel, and twice that for a single number.
    assert drift == pytest.approx(np.outer(np.arange(14.0), STEP_PX), abs=0.04)


def test_without_the_rotation_such_frames_are_refused() -> None:
    live, _ = track(TURN, 0.0, settings=DriftSettings(similarity=False))
    rejections = [u.rejection for u in live if u.rejection is not None]
    assert rejections
    assert rejections[0].status is MatchFailure.HALVES_DISAGREE


def test_a_stream_that_does_not_turn_is_the_same_with_and_without_looking_for_it() -> None:
    live, smoothed = track(0.0, 0.0, count=10)
    plain, plain_smoothed = track(0.0, 0.0, settings=DriftSettings(similarity=False), count=10)
    for ours, theirs in ((live, plain), (smoothed, plain_smoothed)):
        for a, b in zip(ours, theirs, strict=True):
            assert np.array_equal(a.drift_m, b.drift_m)
            assert np.array_equal(a.covariance, b.covariance)
            assert not np.any(a.similarity)
    # What a frame does not exclude: its own noise over the lever of its halves.
    sigmas = np.array([np.sqrt(np.diag(u.similarity_covariance)[:2]) for u in live[1:]])
    assert np.all((sigmas > 3e-5) & (sigmas < 3e-3))


def test_the_rotation_during_a_scan_is_removed_from_the_picture() -> None:
    # So fast that the part within a frame shows: 0.24 degrees in a scan are 0.2 px at the ends of its edges.
    turn = 5 * TURN
    live, _ = track(turn, 0.0, SCAN, count=9)
    assert all(u.accepted for u in live)
    last, rectifier = live[-1], Rectifier("lanczos4")
    still = seen(0.0, 0.0, 0.0, None, 0.0).astype(np.float32)
    clean = seen(last.time_s, turn, 0.0, SCAN, 0.0).astype(np.float32)
    corrected = rectifier.rectify(clean, None, last.raster, SCAN)
    instant = rectifier.rectify(
        clean, None, RasterDrift(last.drift_m, last.velocity_m_s, last.acceleration_m_s2), SCAN
    )
    inner = slice(20, -20)
    miss = [np.std((picture - still)[inner, inner]) for picture in (corrected, instant)]
    # Grey levels are rounded twice (0.4), the specimen has 40 RMS with a gradient of some 10 per px; without
    # the turning during the scan 0.9 remain.
    assert miss[0] < 0.75
    assert miss[1] > 6.0


def test_rotation_and_scale_of_a_pair_are_within_their_sigma() -> None:
    turn, growth = 8e-4, -5e-4
    sums, pairs = np.zeros(6), 24
    for k in range(pairs):
        before = seen(0.0, 0.0, 0.0, None, 6.0 + 1e-3 * k)
        found = register_pair(before, seen(1.0 + 1e-3 * k, turn, growth))
        fit = found.fit_similarity()
        assert fit is not None
        t = 1.0 + 1e-3 * k
        truth = np.array([*STEP_PX * t, 0.0, 0.0, turn * t, growth * t])
        sums += (fit.values - truth) ** 2 / np.diag(fit.covariance)
    # Chi-square with 24 degrees of freedom over 24: one in 1000 above.
    assert np.all(sums / pairs < 2.2)
    # Of 144 numbers, a mean of one is within 0.64 to 1.4 but once in 500 times. It is 0.6 of 60 pairs: floors of the
    # sigma, for distortion, that these pictures do not need.
    assert 0.4 < float(np.mean(sums / pairs)) < 1.4


def test_the_shift_that_counts_is_that_of_the_origin() -> None:
    # The middle of what both frames show lies 15 px off, where a rotation of 0.1 degrees shifts by 0.03 px.
    turn = 2e-3
    before, now = seen(0.0, 0.0, 0.0, None, 5.0), seen(40.0, turn / 40.0, 0.0, None, 6.0)
    found = register_pair(before, now)
    fit = found.fit_similarity()
    assert fit is not None
    camera = replace(small_camera(1000.0), px=70.0, py=120.0, aspect=1.0, skew=0.0)
    for frame, origin in (
        (ScanFrame(now, None, None), np.full(2, 95.5)),
        (ScanFrame(now, camera, None), np.array([camera.rectified.px, camera.rectified.py])),
    ):
        known = np.array([turn, 0.0]), np.zeros((2, 2))
        match = SimilarityMatch(fit, np.zeros(2), (), *known)
        constrained = constrain_registration(found, match, np.zeros(2), frame)
        # The scene turns about the middle of the image; in the axes of the first frame.
        arm = origin - 95.5
        truth = similarity_matrix(-known[0]) @ (40.0 * STEP_PX - arm) + arm
        error = constrained.shift_px - truth
        sigma = np.sqrt(np.diag(constrained.covariance))
        assert np.all(np.abs(error) < 4.0 * sigma) and np.all(sigma < 0.02)
        appears = np.array([0.3, 0.1])
        turned = constrain_registration(found, match, appears, frame)
        assert similarity_matrix(appears) @ turned.shift_px == pytest.approx(constrained.shift_px)
    # The shift of the middle of what is compared is another one than that of an origin that lies elsewhere.
    assert np.max(np.abs(found.shift_px - truth) / sigma) > 4.0


def test_a_distortion_is_not_taken_for_a_change_of_scale() -> None:
    specimen, camera = (
        DriftingSpecimen(0.25e-6),
        replace(small_camera(1000.0), xi_r=0.008, ex=130.0),
    )
    tracker = DriftTracker(DriftSettings(similarity=True))
    for k in range(6):
        drift_m = np.array([4e-6 * k, -2e-6 * k])
        frame = specimen.frame(camera, ScanTiming(1.0), drift_m, np.zeros(2), k)
        update = tracker.update(frame, float(k))
    assert not np.any(update.similarity)


def test_a_wrong_place_is_not_explained_by_a_rotation() -> None:
    tracker = DriftTracker(DriftSettings(similarity=True))
    tracker.update(seen(0.0, TURN, 0.0), 0.0)
    other = np.ascontiguousarray(seen(0.0, 0.0, 0.0)[::-1, ::-1].T)
    update = tracker.update(other, 1.0)
    assert not update.accepted
    assert not np.any(update.similarity)


def test_raw_positions_turn_about_the_origin_of_the_sem_frame() -> None:
    camera: ScanCamera = small_camera(1000.0)
    similarity, drift_m = np.array([0.02, -0.01]), np.array([2e-6, -1e-6])
    rectified = camera.rectified
    xy = np.array([[10.0, 20.0], [150.0, 90.0], [rectified.px, rectified.py]])
    raster = RasterDrift(drift_m, np.zeros(2), np.zeros(2), similarity)
    raw = raw_from_output(xy, (SIZE, SIZE), camera, raster, None)
    at = rectified.sem_from_ideal(xy)[:, :2]
    moved = at @ similarity_matrix(similarity).T + drift_m
    homogeneous = np.column_stack([moved, np.zeros(3)])
    assert raw == pytest.approx(camera.project(homogeneous), abs=1e-6)


def test_maps_of_a_turning_specimen_are_exact_at_every_time_of_the_scan() -> None:
    raster = RasterDrift(
        np.array([3.0, -2.0]),
        np.array([4.0, 2.0]),
        np.zeros(2),
        np.array([0.01, 0.002]),
        np.array([0.02, -0.01]),
    )
    map_x, map_y = Rectifier().maps((96, 96), None, raster, SCAN)
    y, x = np.mgrid[:96, :96].astype(np.float64)
    since_s = SCAN.pixel_offset_s(map_y, map_x, 96, 96) - SCAN.centre_offset_s
    dx, dy = x - 47.5, y - 47.5
    cos, sin = np.exp(0.002) * np.cos(0.01), np.exp(0.002) * np.sin(0.01)
    # The rate turns what is turned already: d/dt (M X) = (growth + i turn) M X, in complex numbers.
    turned = (dx + 1j * dy) * (cos + 1j * sin) * (1.0 + since_s * (-0.01 + 0.02j))
    assert map_x == pytest.approx(47.5 + 3.0 + 4.0 * since_s + turned.real, abs=2e-3)
    assert map_y == pytest.approx(47.5 - 2.0 + 2.0 * since_s + turned.imag, abs=2e-3)


def test_the_drift_in_the_axes_of_the_image_has_the_covariance_of_a_sample() -> None:
    rng = np.random.default_rng(1)
    means = [np.array([20.0, -8.0, 1.5, 0.7]), np.array([0.05, 0.01, 2e-3, -1e-3])]
    spreads = [0.02 * rng.standard_normal((4, 4)), np.diag([2e-3, 1e-3, 1e-3, 2e-3])]
    draws = [m + rng.standard_normal((6000, 4)) @ s.T for m, s in zip(means, spreads, strict=True)]

    def drift_of(motion: Array, similarity: Array) -> Array:
        # From the definition: the derivative of M(t) u(t).
        step, at = 1e-4, []
        for t in (-step, step):
            matrix = similarity_matrix(similarity[:2] + similarity[2:] * t)
            at.append(matrix @ (motion[:2] + motion[2:] * t))
        return np.append(0.5 * (at[0] + at[1]), (at[1] - at[0]) / (2 * step))

    sample = np.array([drift_of(m, s) for m, s in zip(*draws, strict=True)])
    estimate = SimilarityEstimate(means[1], spreads[1] @ spreads[1].T)
    turned = turn_drift(
        means[0][:2], means[0][2:], np.zeros(2), spreads[0] @ spreads[0].T, estimate
    )
    assert np.append(turned.position, turned.velocity) == pytest.approx(drift_of(*means), rel=1e-6)
    # 20 000 draws tell a variance to 1 %; the map is curved by as much again.
    assert np.diag(turned.covariance) == pytest.approx(np.var(sample, axis=0), rel=0.07)


def test_a_forecast_turns_on() -> None:
    tracker = DriftTracker(DriftSettings(similarity=True))
    for k in range(12):
        tracker.update(seen(float(k), TURN, 0.0), float(k))
    ahead = tracker.predictor().at(14.0)
    sigma = np.sqrt(np.diag(ahead.similarity_covariance))
    assert abs(ahead.rotation_rad - 14 * TURN) < 4.0 * sigma[0]
    assert sigma[0] < 14 * TURN / 5
    assert (
        np.max(np.abs(ahead.drift_m - 14 * STEP_PX) / np.sqrt(np.diag(ahead.covariance)[:2])) < 4.0
    )
