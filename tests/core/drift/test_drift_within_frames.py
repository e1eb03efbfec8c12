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

"""Drift inside the frame, through a zoom, and over a long way, on recordings with known truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.rectification.raw_positions import RasterDrift, raw_from_output
from semcal_ros.synthetic import Detector, Drift, GoldOnCarbon, Pose, preset, render_frame
from tests.helpers.drift_scenes import Texture, noisy
from tests.helpers.long_tests import long_but

SIZE = 384
MICROSCOPE = preset("jsm820").with_image_size(SIZE, SIZE)


def frame_of(magnification: float, timing: ScanTiming, drift: Drift, start_s: float, number: int):
    microscope = MICROSCOPE.with_timing(timing)
    image = render_frame(
        microscope,
        GoldOnCarbon(0),
        Pose.flat(),
        magnification,
        start_time_s=start_s,
        drift=drift,
        seed=(0, number),
        detector=Detector(),
    )
    return image, microscope.camera_at(magnification)


def left_px(
    camera: ScanCamera,
    timing: ScanTiming,
    drift: Drift,
    start_s: float,
    zero: np.ndarray,
    found: RasterDrift,
) -> np.ndarray:
    """(n,) distance in px, all over the field, between where the correction puts what a raw pixel
    saw and where it belongs at the drift that was true when the pixel was scanned.
    """

    def belongs(raw: np.ndarray) -> np.ndarray:
        passes = np.arange(timing.averages) * timing.frame_time_s
        # Of all passes together: the offset of a pixel is the mean over them.
        first = timing.pixel_offset_s(raw[:, 1], raw[:, 0], SIZE, SIZE) - passes.mean()
        moved = np.mean([drift(start_s + first + p) for p in passes], axis=0)
        return camera.rect_from_raw(raw) - camera.m * (moved - zero)

    side = np.linspace(0.0, SIZE - 1.0, 5)
    field = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    output = belongs(field)
    raw = raw_from_output(output, (SIZE, SIZE), camera, found, timing)
    return np.asarray(np.hypot(*(belongs(raw) - output).T))


@pytest.mark.slow
@pytest.mark.parametrize("timing", [ScanTiming(2.0, 1, 0.1), ScanTiming(0.25, 8, 0.1)])
def test_drift_within_frames_at_20000x_is_removed_all_over_the_field(timing: ScanTiming) -> None:
    drift = Drift(
        velocity_m_s=(40e-9, -25e-9), wander_m=30e-9, wander_period_s=(60.0, 15.0), seed=3
    )
    history = DriftHistory()
    tracker = DriftTracker(history=history)
    zero = drift(np.array([timing.centre_offset_s]))[0]
    starts = timing.acquisition_time_s * np.arange(7)
    updates = []
    for k, start in enumerate(starts):
        image, camera = frame_of(20_000.0, timing, drift, start, k)
        updates.append(tracker.update(image, start, camera, timing))
    assert all(u.accepted for u in updates)
    path = history.smooth()

    def of(found: list[RasterDrift]) -> np.ndarray:
        parts = zip(starts, found, strict=True)
        return np.array([left_px(camera, timing, drift, s, zero, f) for s, f in parts])

    after = of([path[k].raster for k in range(len(path))])
    shifted = of([RasterDrift(u.drift_m, np.zeros(2)) for u in updates])
    # A shift of the whole image leaves half of what the drift moves in a pass: 80 nm in 2 s, in
    # px of 15 nm, or an eighth of it.
    assert float(shifted[1:].max()) > (2.0 if timing.averages == 1 else 0.25)
    assert float(np.sqrt(np.mean(after**2))) < 0.03
    assert float(after.max()) < 0.05 * (1.0 if timing.averages == 1 else 2.0)
    # Live, once the pace is known.
    live = of([u.raster for u in updates])[3:]
    assert float(np.sqrt(np.mean(live**2))) < 0.05


@pytest.mark.slow
def test_drift_is_continuous_through_a_zoom() -> None:
    timing = ScanTiming(0.4, 1, 0.1)
    drift = Drift(velocity_m_s=(20e-9, -12e-9), settling_m=(-200e-9, 300e-9), settling_time_s=15.0)
    tracker = DriftTracker()
    zero = drift(np.array([timing.centre_offset_s]))[0]
    steps = [1000.0, 2000.0, 4000.0, 8000.0, 4000.0, 2000.0, 1000.0]
    errors, sigmas, statuses = [], [], []
    for k, magnification in enumerate(np.repeat(steps, 3)):
        start = 0.5 * k
        image, camera = frame_of(float(magnification), timing, drift, start, k)
        update = tracker.update(image, start, camera, timing)
        truth = drift(np.array([start + timing.centre_offset_s]))[0] - zero
        errors.append(update.drift_m - truth)
        sigmas.append(np.sqrt(np.diag(update.covariance)[:2]))
        statuses.append(update.status_text)
    assert not [s for s in statuses if s.startswith("coasting")]
    # On the way back the keyframes of the way out serve again.
    assert [k for k, s in enumerate(statuses) if s == "keyframe"] == [0, 3, 6, 9]
    error, sigma = np.array(errors)[1:], np.array(sigmas)[1:]
    assert np.all(np.abs(error) < 4.0 * sigma)
    # The steps of the zoom are no steps of the drift; and at 300 nm per px the drift of the first
    # frame is known to a hundredth of a px.
    assert np.all(np.abs(np.diff(error, axis=0)) < 4.0 * sigma[1:])
    assert float(np.max(sigma[3:])) < 5e-9


def test_drift_is_right_while_every_frame_zooms() -> None:
    """What is left of the shear of a keyframe is over its field, of which the next frame shows a part."""
    timing = ScanTiming(0.4, 1, 0.1)
    # A pixel and more from frame to frame.
    drift = Drift(velocity_m_s=(700e-9, -400e-9))
    tracker = DriftTracker()
    zero = drift(np.array([timing.centre_offset_s]))[0]
    scores = []
    for k in range(9):
        image, camera = frame_of(1000.0 * 1.12**k, timing, drift, 0.5 * k, k)
        covariance = np.zeros((10, 10))
        # The calibration knows the centre of the zoom to 5 px.
        covariance[[3, 4], [3, 4]] = 25.0
        camera = replace(camera, covariance=covariance)
        update = tracker.update(image, 0.5 * k, camera, timing)
        truth = drift(np.array([0.5 * k + timing.centre_offset_s]))[0] - zero
        error = (update.drift_m - truth) * camera.m
        scores.append(error / np.maximum(np.sqrt(np.diag(update.covariance)[:2]) * camera.m, 0.01))
    assert np.max(np.abs(scores)) < 4.0


@pytest.mark.parametrize(
    "scales",
    long_but(
        lambda scales: scales[0] < 0.0, [(0.0, 1e-3, 1.5e-3, -1e-3), (-1e-3, 8e-4, 5e-4, 1.2e-3)]
    ),
)
@pytest.mark.parametrize("follows_scale", [False, True])
def test_a_scale_that_comes_back_to_a_part_in_1000_is_no_drift(
    scales: tuple[float, ...], follows_scale: bool
) -> None:
    """A frame that is taller by a part in 1000 is no drift in y, and another visit is no creep of the scale."""
    timing = ScanTiming(4.0, 1, 0.1)
    drift = Drift(velocity_m_s=(20e-9, -12e-9))
    history = DriftHistory()
    tracker = DriftTracker(DriftSettings(similarity=follows_scale), history=history)
    zero = drift(np.array([timing.centre_offset_s]))[0]
    truths, updates, cameras = [], [], []
    for k, (g, scale) in enumerate(
        zip(np.repeat([2000.0, 3300.0] * 2, 3), np.repeat(scales, 3), strict=True)
    ):
        image, _ = frame_of(float(g * (1.0 + scale)), timing, drift, 5.0 * k, k)
        camera = MICROSCOPE.with_timing(timing).camera_at(float(g))
        updates.append(tracker.update(image, 5.0 * k, camera, timing))
        truths.append(drift(np.array([5.0 * k + timing.centre_offset_s]))[0] - zero)
        cameras.append(camera)
    assert [u.status_text for u in updates if not u.accepted] == []
    path = history.smooth()
    for k, camera in enumerate(cameras[1:], 1):
        for found in (updates[k], path[k]):
            # The true scale is not that of the camera, which moves what has drifted by as much.
            error_px = (found.drift_m - truths[k]) * camera.m
            sigma_px = np.sqrt(np.diag(found.covariance)[:2]) * camera.m
            assert np.all(np.abs(error_px) < 4.0 * np.hypot(sigma_px, 0.01)), (k, error_px)
            assert np.max(sigma_px) < 0.2


@pytest.mark.parametrize("ratio", [1.02, 1.5])
def test_a_specimen_that_moves_at_a_zoom_is_found_by_the_next_frame(ratio: float) -> None:
    """Microscopes do shift the image where they change the magnification."""
    timing = ScanTiming(0.4, 1, 0.1)
    drift = Drift(velocity_m_s=(200e-9, -100e-9))
    # At once, before the frame.
    after = replace(drift, settling_m=(3e-6, -2e-6), settling_time_s=1e-9)
    tracker = DriftTracker()
    zero = drift(np.array([timing.centre_offset_s]))[0]
    for k in range(9):
        moved, own = k >= 5, after if k >= 5 else drift
        image, camera = frame_of(1000.0 * (ratio if moved else 1.0), timing, own, 0.5 * k, k)
        camera = replace(camera, covariance=np.diag([0.0] * 3 + [25.0] * 2 + [0.0] * 5))
        update = tracker.update(image, 0.5 * k, camera, timing)
        error = update.drift_m - (own(np.array([0.5 * k + timing.centre_offset_s]))[0] - zero)
        sigma = np.sqrt(np.diag(update.covariance)[:2])
        assert np.all(np.abs(error) < 4.0 * np.maximum(sigma, 0.01 / camera.m)), (
            k,
            error * camera.m,
        )
        assert update.accepted == (k != 5)


@pytest.mark.slow
@pytest.mark.long
def test_of_a_random_walk_frames_after_a_zoom_say_nothing_of_the_step_before_it() -> None:
    """Where the centre of the zoom is not known, the drift at the zoom is as it was predicted, for good: a smooth$
    drift would be told by the frames that follow.
    """
    timing, step_m = ScanTiming(0.4, 1, 0.1), 300e-9
    live, hindsight = [], []
    for seed in range(4):
        places = np.cumsum(step_m * np.random.default_rng(seed).standard_normal((16, 2)), axis=0)
        history = DriftHistory()
        tracker = DriftTracker(history=history)
        for k, place in enumerate(places):
            still = Drift(velocity_m_s=(0.0, 0.0), settling_m=tuple(place), settling_time_s=1e-9)
            magnification = 1000.0 if k < 11 else 1200.0
            image, camera = frame_of(magnification, timing, still, 1.0 + 0.5 * k, k)
            camera = replace(camera, covariance=np.diag([0.0] * 3 + [625.0] * 2 + [0.0] * 5))
            update = tracker.update(image, 0.5 * k, camera, timing)
            assert update.accepted
        for found, errors in ((update, live), (history.smooth()[15], hindsight)):
            sigma = np.sqrt(np.diag(found.covariance)[:2])
            errors.extend((found.drift_m - (places[-1] - places[0])) / sigma)
            # It is known to about a step.
            assert 0.3 * step_m < float(np.max(sigma)) < 3.0 * step_m
    for errors in (live, hindsight):
        # Eight errors: an RMS of 1.8 by chance once in a thousand times.
        assert float(np.sqrt(np.mean(np.square(errors)))) < 1.8


@pytest.mark.long
@pytest.mark.slow
def test_out_and_back_over_many_keyframes_ends_where_it_began() -> None:
    texture, frames, far = Texture(3, 360), 160, 200.0
    tracker = DriftTracker()
    errors, sigmas, keyframes = [], [], 0
    for k in range(frames):
        out = 1.0 - abs(2.0 * k / (frames - 1) - 1.0)
        truth = np.array([far * out, 30.0 * np.sin(6.0 * out)])
        picture = noisy(texture.view((truth[0], truth[1]), 128), 8.0, k)
        image = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        update = tracker.update(image, 0.1 * k)
        assert update.accepted, update.reason
        errors.append(update.drift_px - truth)
        sigmas.append(np.sqrt(np.diag(update.covariance)[:2]))
        keyframes += update.status_text == "keyframe"
    assert keyframes >= 5
    error, sigma = np.array(errors), np.array(sigmas)
    # Single images are good to 0.01 px: nothing of the way is left at its end.
    assert float(np.max(np.abs(error[-1]))) < 0.05
    assert np.all(sigma[-1] < 0.03)
    # The way adds uncertainty, and says so.
    assert np.all(sigma[frames // 2] > 1.5 * sigma[-1])
    assert np.all(np.abs(error[1:]) < 4.5 * sigma[1:])


def test_drift_of_recursive_averages_is_that_of_their_effective_time() -> None:
    size, averages = 128, 4
    texture = Texture(5, 256, 1.5, 5.0)

    def drift_px(time_s: Any) -> tuple[Any, Any]:
        return 0.1 * time_s + 0.01 * time_s**2, -0.007 * time_s**2

    rng = np.random.default_rng(0)
    timing = ScanTiming(1.0, recursive_averages=averages)
    history = DriftHistory()
    tracker, shown = DriftTracker(history=history), np.zeros((size, size))
    for k in range(-30, 14):
        # Passes in an instant, in the middle of their second; long ago they were at rest.
        view = texture.view(drift_px(max(k + 0.5, -12.0)), size)
        image = 128.0 + 40.0 * view + 3.0 * rng.standard_normal(view.shape)
        shown = image if k == -30 else shown + (image - shown) / averages
        if k >= 0:
            tracker.update(shown.astype(np.float32), float(k), None, timing)
    updates = history.smooth().updates
    # The mean of an accelerated drift over the weights of the passes differs from the drift at their mean time by
    # half the acceleration times their variance: by the same in each frame. The blur is not undone.
    times = np.array([u.time_s for u in updates])
    assert times[0] == 0.5 - (averages - 1)
    drift = np.array([u.drift_m for u in updates])

    def error(late_s: float) -> float:
        truth = np.stack(drift_px(times + late_s), axis=1)
        return float(np.max(np.abs(drift - truth + truth[0])))

    # An image that is blurred to one side by some pixels seems to lie less far to that side.
    assert error(0.0) < 0.1
    # The stamps alone would be wrong by three passes.
    assert error(averages - 1.0) > 0.5


@pytest.mark.slow
@pytest.mark.long
def test_the_stated_uncertainty_of_averaged_passes_is_honest() -> None:
    """20 recordings of a steady drift, each with another specimen, in px; passes that are averaged before."""
    # After fewer frames the process noise is not known yet, and the sigma is on the safe side.
    size, frames, seeds, noise = 96, 6, 20, 20.0

    def follow(seed: int, averages: int) -> tuple[np.ndarray, np.ndarray]:
        texture = Texture(seed, 256, 1.5, 5.0)
        rng = np.random.default_rng((averages, seed))
        velocity = rng.normal(0.0, 0.3, 2)
        history = DriftHistory()
        tracker = DriftTracker(history=history)
        for k in range(frames):
            # Passes in an instant, in the middle of their time.
            middles = k + (np.arange(averages) + 0.5) / averages
            passes = [texture.view((velocity[0] * t, velocity[1] * t), size) for t in middles]
            image = 128.0 + 40.0 * np.mean(passes, axis=0)
            image += noise / np.sqrt(averages) * rng.standard_normal(image.shape)
            timing = ScanTiming(1.0 / averages, averages)
            assert tracker.update(image.astype(np.float32), float(k), None, timing).accepted
        updates = history.smooth().updates
        moved = updates[-1].drift_m - updates[0].drift_m
        truth = velocity * (updates[-1].time_s - updates[0].time_s)
        return moved - truth, np.sqrt(np.diag(updates[-1].covariance)[:2])

    stated = []
    for averages in (2, 8):
        found = [follow(seed, averages) for seed in range(seeds)]
        z = np.array([error / sigma for error, sigma in found])
        # The RMS of 40 scores scatters by 0.11; that of x and y of one specimen is nearly independent.
        assert 0.7 < np.sqrt(np.mean(z**2)) < 1.35, (averages, z)
        stated.append(float(np.median([sigma for _, sigma in found])))
    # Four times the passes: half of the noise.
    assert stated[1] == pytest.approx(0.5 * stated[0], rel=0.15)


def _view_of_cluster(at: tuple[float, float], time_s: float, frame_s: float, jump: Any) -> Any:
    """Particles that lie together, each pixel where they are at its own time; ``jump`` is that of the stage."""
    size, rng = 256, np.random.default_rng(3)
    y, x = np.mgrid[0.0:size, 0.0:size]
    now = time_s + frame_s * (y + x / size) / size
    picture = np.full((size, size), 55.0)
    for _ in range(14):
        left, top = at + rng.uniform(-22.0, 22.0, 2)
        left, top = left + jump[0] + CLUSTER_SPEED[0] * now, top + jump[1] + CLUSTER_SPEED[1] * now
        sharp = (rng.uniform(3.0, 7.0) - np.hypot(x - left, y - top)) / 1.2
        picture += rng.uniform(40.0, 90.0) * ndtr(sharp)
    noise = 10.0 * np.random.default_rng(int(time_s)).normal(size=picture.shape)
    return np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)


CLUSTER_SPEED = np.array([0.7, -0.4])


@pytest.mark.parametrize(
    ("at", "jump"),
    [((160.0, 70.0), (-45.0, 30.0)), ((90.0, 190.0), (40.0, -35.0)), ((128.0, 60.0), (50.0, 20.0))],
)
def test_a_stage_that_moves_between_frames_gives_no_velocity(
    at: tuple[float, float], jump: tuple[float, float]
) -> None:
    """Particles beside the middle line show no shear: a velocity of 13 px per frame moved them by up to 4 px."""
    tracker = DriftTracker()
    after = []
    for k in range(12):
        moved = np.array(jump) * (k >= 6)
        image = _view_of_cluster(at, float(k), 0.9, moved)
        update = tracker.update(image, float(k), None, ScanTiming(0.9))
        if k >= 6 and update.accepted:
            after.append(update.drift_m - CLUSTER_SPEED * k - moved)
    assert len(after) >= 3
    assert np.max(np.abs(after)) < 0.6
