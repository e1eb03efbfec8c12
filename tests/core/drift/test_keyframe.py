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

"""Keyframes: their means, their other magnifications, which one is looked at; and what a calibration
leaves open.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift import tracker
from semcal_ros.core.drift.camera_uncertainty import (
    apparent_zoom_shift,
    centre_covariance,
    relative_scale_sigma,
    scale_covariance,
    visit_scale_variance,
    visit_stretch_covariance,
    zoom_covariance,
)
from semcal_ros.core.drift.estimates import DriftStatus, DriftUpdate
from semcal_ros.core.drift.frame import MotionCorrector, ScanFrame, resampleable
from semcal_ros.core.drift.keyframe import (
    Keyframe,
    make_keyframe,
    resample_keyframe,
    scale_ratio,
)
from semcal_ros.core.drift.keyframe_store import KeyframeStore
from semcal_ros.core.drift.matching import Match
from semcal_ros.core.drift.state import DriftState, initial_state
from semcal_ros.core.drift.thresholds import KEPT_CORRELATION_MIN, VISIT_SCALE
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration.fractional_delay import FINE
from semcal_ros.core.registration.inverse_compositional import unmeasured_alignment
from semcal_ros.core.registration.reference import RegistrationSettings
from semcal_ros.core.registration.register import Registration, register, register_pair
from tests.helpers.drift_scenes import DriftingSpecimen, Texture, noisy, small_camera

SIZE = 160
TEXTURE = Texture(2)
NOWHERE = np.zeros(4)
EVERYTHING = (0, 0, SIZE, SIZE)


def known(shift: tuple[float, float], gain: float = 1.0, offset: float = 0.0) -> Registration:
    """A registration without error."""
    alignment = replace(
        unmeasured_alignment(),
        shift_px=np.array(shift),
        covariance=np.zeros((2, 2)),
        joint_px=np.array([*shift, 0.0, 0.0]),
        joint_covariance=np.zeros((4, 4)),
        gain=gain,
        offset=offset,
        residual_rms=0.0,
        overlap=1.0,
        converged=True,
        iterations=1,
    )
    return Registration(alignment, correlation=1.0, rejection=None, contrast=gain)


def make_picture(shift: tuple[float, float], sigma: float, seed: int) -> NDArray[np.float32]:
    return noisy(TEXTURE.view(shift, SIZE), sigma, seed).astype(np.float32)


def keyframe(picture: NDArray[np.generic]) -> Keyframe:
    height, width = picture.shape[:2]
    return make_keyframe(
        ScanFrame(picture, None, None), NOWHERE, picture, (0, 0, width, height), 0.0
    )


INNER = (slice(40, -40), slice(40, -40))


# -- means --------------------------------------------------------------------------------------


def test_another_frame_halves_the_noise_variance() -> None:
    scene = make_picture((0.0, 0.0), 0.0, 0)
    key = keyframe(make_picture((0.0, 0.0), 10.0, 1))
    for count in range(2, 9):
        # Whole pixels: nothing is interpolated.
        shift = (float(count), -2.0 * count)
        key = key.with_frame(make_picture(shift, 10.0, count), EVERYTHING, known(shift))
        assert key.averaged == count
        variance = float(np.var((key.mean - scene)[INNER]))
        # A variance of 6400 px scatters by 1.8 %.
        assert variance == pytest.approx(100.0 / count, rel=0.08)


@pytest.mark.parametrize("shift", [(0.5, 0.5), (3.3, -7.8), (-0.2, 0.9), (12.25, 20.5)])
def test_a_mean_is_neither_moved_nor_blurred(shift: tuple[float, float]) -> None:
    # No noise: all that is left is what the interpolation does to the scene.
    scene = make_picture((0.0, 0.0), 0.0, 0)
    key = keyframe(scene).with_frame(make_picture(shift, 0.0, 0), EVERYTHING, known(shift))
    error = (key.mean - scene)[INNER]
    # The scene has a contrast of 40; half of the 8-tap interpolation's error is in the mean.
    assert np.sqrt(np.mean(error**2)) < 0.004 * 40.0
    # Along the gradients of the scene: moved by less than a thousandth of a pixel.
    gx, gy = (40.0 * g[INNER] for g in TEXTURE.gradient((0.0, 0.0), SIZE))
    moved = np.linalg.lstsq(np.stack([gx.ravel(), gy.ravel()], axis=1), error.ravel(), rcond=None)
    assert np.max(np.abs(moved[0])) < 1e-3
    # Nor has the image lost or gained contrast.
    contrast = np.cov(key.mean[INNER].ravel(), scene[INNER].ravel())
    assert contrast[0, 1] / contrast[1, 1] == pytest.approx(1.0, abs=1e-3)


def test_sixteen_frames_at_sub_pixel_shifts_show_the_scene_with_less_noise() -> None:
    rng = np.random.default_rng(1)
    scene = make_picture((0.0, 0.0), 0.0, 0)
    key = keyframe(make_picture((0.0, 0.0), 8.0, 100))
    for k in range(1, 16):
        shift = tuple(rng.uniform(-6.0, 6.0, 2))
        key = key.with_frame(make_picture(shift, 8.0, k), EVERYTHING, known(shift))
    error = (key.mean - scene)[INNER]
    # White noise would leave 64 / 16; interpolation between pixels averages, and can only lower it.
    assert 0.5 * 64.0 / 16.0 < float(np.var(error)) < 1.05 * 64.0 / 16.0
    # Registered against the noise-free scene it lies where the first frame lay.
    found = register_pair(scene, key.mean)
    assert found.accepted, found.reason
    np.testing.assert_allclose(found.shift_px, 0.0, atol=0.01)


def test_gain_and_offset_of_a_frame_are_taken_out() -> None:
    scene = make_picture((0.0, 0.0), 0.0, 0)
    image = (0.5 * make_picture((2.0, -3.0), 0.0, 0) + 30.0).astype(np.float32)
    key = keyframe(scene).with_frame(image, EVERYTHING, known((2.0, -3.0), 0.5, 30.0))
    # Rounding of 32-bit numbers near 200.
    np.testing.assert_allclose(key.mean[INNER], scene[INNER], atol=1e-3)


def test_only_what_both_show_is_averaged_and_the_first_picture_stays_as_it_was() -> None:
    first = make_picture((0.0, 0.0), 10.0, 1)
    key = keyframe(first)
    shift = (30.0, -20.0)
    region = (5, 8, 150, 140)
    better = key.with_frame(make_picture(shift, 10.0, 2), region, known(shift))
    changed = better.mean != first
    rows, cols = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    # Of the frame's region, seen from the keyframe, without what the interpolation would take from
    # beyond it.
    assert (cols[0], cols[-1] + 1) == (0, 150 - 30 - FINE.reach)
    assert (rows[0], rows[-1] + 1) == (8 + 20 + FINE.reach, 140 + 20 - FINE.reach)
    np.testing.assert_array_equal(key.mean, first)
    assert key.averaged == 1
    assert better.frame is key.frame
    # Nothing in common.
    away = (SIZE - 5.0, 0.0)
    assert key.with_frame(make_picture(away, 1.0, 2), EVERYTHING, known(away)) is key


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_frames_of_every_type_are_averaged(dtype: type) -> None:
    picture = np.rint(make_picture((0.0, 0.0), 0.0, 0)).astype(dtype)
    colour = np.repeat(picture[:, :, None], 3, axis=2)
    for image in (picture, colour):
        key = keyframe(image).with_frame(image, EVERYTHING, known((0.0, 0.0)))
        assert key.mean.dtype == np.float32
        np.testing.assert_allclose(key.mean[INNER], picture[INNER], atol=1e-3)


def test_pictures_that_cannot_be_resampled_are_refused_or_converted() -> None:
    assert resampleable(np.zeros((4, 4), np.uint16)).dtype == np.uint16
    assert resampleable(np.zeros((4, 4), np.int32)).dtype == np.float32
    assert resampleable(np.zeros((4, 4, 3), np.float64)).dtype == np.float32
    for wrong in (
        np.zeros((4, 4), bool),
        np.zeros(4),
        np.zeros((4, 4, 2)),
        np.zeros((4, 4), complex),
    ):
        with pytest.raises(InvalidValueError, match="shape"):
            resampleable(wrong)


# -- other magnifications -----------------------------------------------------------------------

SPECIMEN = DriftingSpecimen(pitch_m=0.05e-6, seed=4)
STILL = np.zeros(2)


def make_scan_frame(camera: ScanCamera, drift_m: Array, seed: int) -> ScanFrame:
    timing = ScanTiming(0.9, 1, 0.1)
    return ScanFrame(
        SPECIMEN.frame(camera, timing, drift_m, STILL, seed, noise=3.0), camera, timing
    )


@pytest.mark.parametrize("ratio", [0.6, 0.8, 1.0, 1.3, 2.0])
def test_a_carried_keyframe_shows_the_drift_in_pixels_of_the_other_camera(ratio: float) -> None:
    before = small_camera(2000.0)
    # The same instrument, whose axis does not go through the same pixel at every magnification.
    now = replace(small_camera(2000.0 * ratio), px=101.5, py=88.25, ex=91.0, ey=97.0, skew=-0.01)
    drift = np.array([1.1e-6, -0.6e-6])
    corrector = MotionCorrector("cubic")
    first = make_scan_frame(before, STILL, 0)
    key = make_keyframe(first, NOWHERE, *corrector.corrected_image(first, NOWHERE), 0.0)
    frame = make_scan_frame(now, drift, 1)
    other = resample_keyframe(key, frame)
    picture = make_keyframe(frame, NOWHERE, *corrector.corrected_image(frame, NOWHERE), 1.0)
    found = register(
        other.prepare_reference(RegistrationSettings()), picture.mean, image_region=picture.region
    )
    assert found.accepted, found.reason
    # Resampling twice by cubic interpolation costs some hundredths of a pixel; noise a hundredth.
    np.testing.assert_allclose(found.shift_px, now.m * drift, atol=0.05)
    assert other.mean.shape == (192, 192)
    left, top, right, bottom = other.region
    assert 0 <= left < right <= 192
    assert 0 <= top < bottom <= 192
    assert scale_ratio(key.frame, frame) == pytest.approx(max(ratio, 1 / ratio), rel=0.05)


@pytest.mark.parametrize("ratio", [0.5, 0.9, 1.3, 2.0])
def test_nothing_around_a_keyframe_gets_into_the_region_of_a_carried_one(ratio: float) -> None:
    now = replace(small_camera(2000.0 * ratio), px=101.5, py=88.25, skew=-0.01)
    bright = np.zeros((192, 192), np.float32)
    bright[20:170, 20:170] = 200.0
    frame = ScanFrame(bright, small_camera(2000.0), None)
    key = make_keyframe(frame, NOWHERE, bright, (20, 20, 170, 170), 0.0)
    other = resample_keyframe(key, ScanFrame(bright, now, None))
    left, top, right, bottom = other.region
    # The cubic interpolation and the blur before it reach over the edge by less than 1 %.
    np.testing.assert_allclose(other.mean[top:bottom, left:right], 200.0, rtol=0.01)
    # And the region is not much smaller than it has to be: 150 px in the new pixels, or what of
    # them lies inside the image.
    corners = np.array([[20.0, 20.0], [169.0, 169.0]])
    seen = now.rectified.project(small_camera(2000.0).rectified.sem_from_ideal(corners))
    seen = np.clip(seen, 0.0, 191.0)
    assert np.all(np.array([left, top]) - seen[0] < 3.0 * max(ratio, 1.0) + 3.0)
    assert np.all(seen[1] - np.array([right, bottom]) < 3.0 * max(ratio, 1.0) + 3.0)


def test_a_keyframe_is_carried_only_between_cameras() -> None:
    plain = keyframe(make_picture((0.0, 0.0), 3.0, 0))
    frame = ScanFrame(plain.frame.image, small_camera(2000.0), None)
    assert resample_keyframe(plain, frame) is plain
    assert resample_keyframe(plain, plain.frame) is plain
    assert scale_ratio(plain.frame, frame) == float("inf")
    assert scale_ratio(frame, plain.frame) == float("inf")
    assert scale_ratio(plain.frame, plain.frame) == 1.0
    # Pixels of images of another size cannot be compared without a camera.
    assert scale_ratio(plain.frame, ScanFrame(np.zeros((50, 60)), None, None)) == float("inf")
    # Pixels are rectified before they are compared, so an aspect is no change of scale.
    wide = ScanFrame(frame.image, replace(small_camera(2000.0), aspect=1.1), None)
    assert scale_ratio(frame, wide) == 1.0
    near = ScanFrame(frame.image, small_camera(2400.0), None)
    assert scale_ratio(frame, near) == pytest.approx(1.2)
    assert scale_ratio(near, frame) == pytest.approx(1.2)


def left(residual: float, contrast: float = 1.0) -> Registration:
    """A registration that leaves some grey levels unexplained."""
    found = known((0.0, 0.0), gain=contrast)
    alignment = replace(found.alignment, residual_rms=residual, covariance=1e-4 * np.eye(2))
    return replace(found, alignment=alignment)


@pytest.mark.parametrize(
    ("residuals", "worn"),
    [
        ([4.0, 4.4, 5.8, 5.9], False),
        ([4.4, 4.0, 6.1, 6.1], False),
        ([4.0, 6.1, 6.1, 4.2, 6.1, 6.1], False),
        ([4.0, 6.1, 6.1, 6.1], True),
    ],
    ids=["usual", "two frames", "a flash twice", "three frames"],
)
def test_three_frames_in_a_row_that_leave_half_as_much_again_wear_a_keyframe_out(
    residuals: list[float], worn: bool
) -> None:
    key = keyframe(make_picture((0.0, 0.0), 3.0, 0))
    for residual in residuals:
        key = key.note_match(left(residual))
    assert key.is_worn == worn


def test_a_frame_that_differs_alone_becomes_no_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of one frame may show the specimen before a move of the stage, and half of it after the move: as a keyframe,
    it hid moves of 15 px for good. A specimen that has changed differs in the next frame, too.
    """
    odd: set[int] = set()
    renew = tracker.renew_keyframe

    def renew_oddly(
        setup: TrackerSetup, state: TrackerState, frame: ScanFrame, match: Match
    ) -> tuple[TrackerState, DriftUpdate]:
        if round(state.filter.state.time_s) in odd:
            low = 0.9 * KEPT_CORRELATION_MIN
            match = replace(match, registration=replace(match.registration, correlation=low))
        return renew(setup, state, frame, match)

    monkeypatch.setattr(tracker, "renew_keyframe", renew_oddly)
    texture = Texture(1)
    pictures = [noisy(texture.view((0.1 * k, 0.0), 128), 8.0, k, contrast=13.0) for k in range(8)]

    def list_keyframes(*frames: int) -> list[int]:
        odd.clear()
        odd.update(frames)
        own = tracker.DriftTracker()
        updates = [own.update(picture, float(k)) for k, picture in enumerate(pictures)]
        return [k for k, u in enumerate(updates) if u.status is DriftStatus.KEYFRAME]

    assert list_keyframes() == [0]
    assert list_keyframes(3) == [0]
    assert list_keyframes(3, 5) == [0]
    assert list_keyframes(3, 4) == [0, 4]


def test_more_or_less_contrast_wears_no_keyframe_out() -> None:
    key = keyframe(make_picture((0.0, 0.0), 3.0, 0)).note_match(left(4.0))
    # Amplified by two, with its noise; then with half of the contrast, when there is less to be left.
    for found in [left(8.0, 2.0)] * 4 + [left(2.0, 0.5)] * 4 + [left(4.2)] * 4:
        key = key.note_match(found)
    assert not key.is_worn
    assert key.residual == 4.0


def test_what_has_changed_counts_once_for_each_frame_over_which_is_averaged() -> None:
    key = keyframe(make_picture((0.0, 0.0), 3.0, 0)).note_match(left(4.0))
    usual, changed = left(4.5), left(2.0 * 1.15 * 4.0)
    assert key.allow_for_change(usual) is usual
    # Three quarters of the square are of the change, and count four times.
    factor = 1.0 + 3.0 * 0.75
    np.testing.assert_allclose(
        key.allow_for_change(changed).covariance, factor * changed.covariance
    )


# -- the store ----------------------------------------------------------------------------------


SETTINGS = RegistrationSettings()


def add_within(
    store: KeyframeStore, added: Keyframe, max_count: int = 48, max_bytes: int = 1 << 28
) -> tuple[KeyframeStore, list[int]]:
    """The store with a keyframe more, and the numbers of those that it has no room for any more."""
    store = store.add(added)
    gone = store.superfluous(max_bytes, max_count)
    for key in gone:
        store = store.forget(key)
    return store, gone


def state_with(places: dict[int, tuple[float, float]], drift: tuple[float, float]) -> DriftState:
    mean = np.append(drift, np.zeros(initial_state(0.0).mean.size - 2))
    for place in places.values():
        mean = np.append(mean, [*place, 0.0, 0.0])
    return DriftState(0.0, mean, np.eye(mean.size), tuple(places))


def test_the_keyframe_in_use_comes_first_as_long_as_it_overlaps_enough() -> None:
    store = KeyframeStore()
    picture = make_picture((0.0, 0.0), 3.0, 0)
    for _ in range(3):
        store = store.add(keyframe(picture))
    assert store.current == 2
    places = {0: (0.0, 0.0), 1: (80.0, 0.0), 2: (40.0, 0.0)}
    frame = ScanFrame(picture, None, None)

    def order(drift: float) -> list[int]:
        state = state_with(places, (drift, 0.0))
        return [c.key for c in store.candidates(state, frame, 0.6, 2.5)]

    # Exactly over keyframe 0, but 75 % of the one in use are seen, too.
    assert order(0.0) == [2, 0, 1]
    # At -30 px of it only 56 %: the old one is better, though the one in use is still next.
    assert order(-30.0) == [0, 2, 1]
    # On the other side it is keyframe 1.
    assert order(110.0) == [1, 2, 0]
    found = store.candidates(state_with(places, (-30.0, 16.0)), frame, 0.6, 2.5)
    # Parts of the width and of the height.
    assert found[0].overlap == pytest.approx((1.0 - 30.0 / SIZE) * (1.0 - 16.0 / SIZE))
    assert not any(c.rescaled for c in found)
    store = store.use(0)
    assert order(40.0)[0] == 0
    # A keyframe that the drift does not know is none.
    few = state_with({1: (80.0, 0.0)}, (0.0, 0.0))
    assert [c.key for c in store.candidates(few, frame, 0.6, 2.5)] == [1]
    # Nothing in common is still a candidate, and the last.
    far = store.candidates(state_with(places, (500.0, 0.0)), frame, 0.6, 2.5)
    assert all(c.overlap == 0.0 for c in far)


def test_a_worn_keyframe_comes_after_the_others_unless_it_is_in_use() -> None:
    picture = make_picture((0.0, 0.0), 3.0, 0)
    worn = replace(keyframe(picture), worn=3)
    store = KeyframeStore().add(worn).add(keyframe(picture)).add(worn)
    state = state_with({0: (0.0, 0.0), 1: (120.0, 0.0), 2: (10.0, 0.0)}, (0.0, 0.0))
    frame = ScanFrame(picture, None, None)
    assert [c.key for c in store.candidates(state, frame, 0.6, 2.5)] == [2, 1, 0]
    # Not in use any more, the last one is worn as well.
    store = store.use(1)
    assert [c.key for c in store.candidates(state, frame, 0.6, 2.5)] == [1, 0, 2]


def test_keyframes_of_another_scale_come_last() -> None:
    store = KeyframeStore()
    cameras = [small_camera(2000.0), small_camera(3000.0), small_camera(2000.0)]
    image = np.zeros((192, 192), np.uint8)
    for camera in cameras:
        frame = ScanFrame(image, camera, None)
        store = store.add(make_keyframe(frame, NOWHERE, image, (0, 0, 192, 192), 0.0))
    # At 3000x everything is in m; 1 um is 12 px.
    places = {0: (0.0, 0.0), 1: (0.0, 0.0), 2: (2e-6, 0.0)}
    state = state_with(places, (0.0, 0.0))

    def order(magnification: float, max_ratio: float = 2.5) -> list[int]:
        frame = ScanFrame(image, small_camera(magnification), None)
        return [c.key for c in store.candidates(state, frame, 0.6, max_ratio)]

    # The one in use, then the one that overlaps more, then the one at 3000x.
    assert order(2000.0) == [2, 0, 1]
    # Back at 3000x its own keyframe comes before the one in use.
    assert order(3000.0)[0] == 1
    assert order(3000.0, 1.2) == [1]
    assert order(4000.0, 1.2) == []
    frame = ScanFrame(image, small_camera(4000.0), None)
    assert store.smallest_scale_ratio(frame) == pytest.approx(4.0 / 3.0)
    found = store.candidates(state, frame, 0.6, 2.5)
    assert all(c.rescaled for c in found)
    assert found[1].ratio in (pytest.approx(2.0), pytest.approx(4.0 / 3.0))


def test_the_oldest_use_is_forgotten_but_never_the_first_or_the_one_in_use() -> None:
    store = KeyframeStore()
    picture = make_picture((0.0, 0.0), 3.0, 0)
    gone: list[int] = []
    for number in range(3):
        store, lost = add_within(store, keyframe(picture), max_count=3)
        assert (store.latest, lost) == (number, [])
    # Keyframe 1 is looked at again, so that 2 was not used for the longest time.
    store = store.use(1)
    for number, oldest in ((3, 2), (4, 1)):
        store, lost = add_within(store, keyframe(picture), max_count=3)
        assert (store.latest, lost) == (number, [oldest])
    for _ in range(10):
        store, lost = add_within(store, keyframe(picture), max_count=3)
        gone += lost
        assert store.current == store.latest
        assert len(store) == 3
    assert 0 not in gone
    assert store[0].averaged == 1
    with pytest.raises(KeyError):
        store[1]


def test_memory_is_bounded_by_bytes() -> None:
    picture = make_picture((0.0, 0.0), 3.0, 0)
    one = keyframe(picture).nbytes
    # The image as it came, and its mean: 4 bytes per pixel each.
    assert one == 2 * 4 * SIZE * SIZE
    store = KeyframeStore()
    for _ in range(12):
        store, _ = add_within(store, keyframe(picture), max_bytes=int(4.5 * one))
        assert len(store) <= 4
    assert len(store) == 4
    assert store[0].nbytes == one
    # However little memory there is, the first one and the one in use stay.
    tight = KeyframeStore()
    for _ in range(5):
        tight, _ = add_within(tight, keyframe(picture), max_bytes=1)
    assert len(tight) == 2
    assert tight[0] is not tight[4]


def test_a_reference_is_prepared_anew_when_its_mean_has_become_much_better() -> None:
    store = KeyframeStore()
    picture = make_picture((0.0, 0.0), 3.0, 0)
    store = store.add(keyframe(picture))
    key = store.latest
    store, first = store.reference(key, SETTINGS)
    assert store.reference(key, SETTINGS)[1] is first
    assert store.averaged(key) == 1
    same = known((0.0, 0.0))
    prepared = []
    for k in range(1, 8):
        mean = store[key].with_frame(make_picture((0.0, 0.0), 3.0, k), EVERYTHING, same)
        store, _ = store.replace(key, mean).reference(key, SETTINGS)
        prepared.append(store.averaged(key))
    assert prepared == [2, 2, 4, 4, 4, 4, 8]
    # Another motion taken out makes another image.
    store = store.replace(key, replace(store[key], removed=np.ones(4)))
    store, before = store.reference(key, SETTINGS)
    store = store.replace(key, replace(store[key], removed=np.zeros(4)))
    assert store.reference(key, SETTINGS)[1] is not before
    # Frames that show little of it, and those that would not matter, are not wanted.
    assert store.has_room(key, 0.8)
    assert not store.has_room(key, 0.7)
    store = store.replace(key, replace(store[key], averaged=32))
    assert not store.has_room(key, 1.0)


# -- what the calibration leaves open -----------------------------------------------------------


def uncertain(camera: ScanCamera, seed: int = 0) -> ScanCamera:
    """The camera with a covariance in which everything correlates."""
    rng = np.random.default_rng(seed)
    sigmas = np.array([0.01 * camera.m, 0.004, 0.003, 1.5, 2.0, 1.0, 1e-3, 1e-3, 1.0, 1.0])
    root = sigmas[:, None] * (rng.standard_normal((10, 10)) + 2.0 * np.eye(10))
    return replace(camera, covariance=root @ root.T)


def test_scale_covariance_is_the_derivative_of_a_length_of_given_pixels() -> None:
    camera = uncertain(small_camera(2000.0))
    drift, velocity = np.array([3e-6, -5e-6]), np.array([-0.4e-6, 0.2e-6])
    jacobian = np.zeros((4, 3))
    for k, name in enumerate(("m", "aspect", "skew")):
        value = getattr(camera, name)
        step = 1e-5 * max(abs(value), 1.0)
        ends = []
        for sign in (1.0, -1.0):
            other = replace(camera, **{name: value + sign * step}).ideal_from_sem_jacobian
            lengths = [
                np.linalg.solve(other, camera.ideal_from_sem_jacobian @ vector)
                for vector in (drift, velocity)
            ]
            ends.append(np.concatenate(lengths))
        jacobian[:, k] = (ends[0] - ends[1]) / (2.0 * step)
    assert camera.covariance is not None
    expected = jacobian @ camera.covariance[:3, :3] @ jacobian.T
    stated = scale_covariance(camera, drift, velocity)
    unit = np.sqrt(np.diag(expected))
    # Central differences of a step of 1e-5 are good to 1e-10, and to 1e-11 / 1e-5 by rounding.
    np.testing.assert_allclose(
        stated / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-6
    )


def test_a_scale_alone_stretches_drift_and_velocity_in_proportion() -> None:
    camera = small_camera(2000.0)
    covariance = np.zeros((10, 10))
    covariance[0, 0] = (0.02 * camera.m) ** 2
    camera = replace(camera, covariance=covariance)
    assert relative_scale_sigma(camera) == pytest.approx(0.02)
    both = np.array([3e-6, -5e-6, -0.4e-6, 0.2e-6])
    stated = scale_covariance(camera, both[:2], both[2:])
    np.testing.assert_allclose(stated, 0.02**2 * np.outer(both, both), rtol=1e-9)


def test_a_camera_that_is_known_exactly_leaves_nothing_open() -> None:
    camera = small_camera(2000.0)
    for exact in (None, camera):
        np.testing.assert_array_equal(scale_covariance(exact, np.ones(2), np.ones(2)), 0.0)
        assert relative_scale_sigma(exact) == 0.0
    np.testing.assert_array_equal(zoom_covariance(camera, small_camera(3000.0)), 0.0)


def test_a_zoom_about_a_wrong_principal_point_is_an_apparent_step() -> None:
    before, after = small_camera(2000.0), small_camera(3400.0)
    specimen = np.array([1e-6, 2e-6])
    for error in ([1.0, 0.0], [0.0, 1.0], [-2.3, 0.7]):
        # Where the specimen seems to lie if the axis is taken for another pixel, before and after.
        seen = []
        for camera in (before, after):
            jacobian = camera.ideal_from_sem_jacobian
            axis = np.array([camera.px, camera.py])
            pixel = axis + jacobian @ specimen
            seen.append(np.linalg.solve(jacobian, pixel - (axis + error)))
        step = seen[1] - seen[0]
        share = np.array(error) / before.norm_px
        np.testing.assert_allclose(step, -apparent_zoom_shift(before, after) @ share, rtol=1e-9)
    # There and back is no step, nor is one without a change of magnification.
    np.testing.assert_allclose(
        apparent_zoom_shift(after, before), -apparent_zoom_shift(before, after)
    )
    np.testing.assert_array_equal(apparent_zoom_shift(before, before), 0.0)
    # As far, in another number of pixels.
    finer = after.resized(2 * after.width, 2 * after.height)
    expected = apparent_zoom_shift(before, after)
    np.testing.assert_allclose(apparent_zoom_shift(before, finer), expected)
    np.testing.assert_allclose(
        apparent_zoom_shift(after, finer), 0.0, atol=1e-9 * np.abs(expected).max()
    )


def test_the_principal_point_is_as_uncertain_as_its_camera_says() -> None:
    camera = uncertain(small_camera(2000.0))
    assert camera.covariance is not None
    expected = camera.covariance[3:5, 3:5] / camera.norm_px**2
    np.testing.assert_array_equal(centre_covariance(camera), expected)
    for exact in (None, small_camera(2000.0)):
        np.testing.assert_array_equal(centre_covariance(exact), 0.0)
    # It is none of the errors of the two scales.
    covariance = np.zeros((10, 10))
    covariance[3:5, 3:5] = [[4.0, 1.2], [1.2, 2.25]]
    pair = [replace(small_camera(g), covariance=covariance) for g in (2000.0, 3400.0)]
    np.testing.assert_array_equal(zoom_covariance(*pair), 0.0)


def test_errors_of_both_scales_move_what_lies_away_from_the_principal_point() -> None:
    covariance = np.zeros((10, 10))
    cameras = []
    for magnification in (2000.0, 3400.0):
        camera = small_camera(magnification)
        covariance = np.zeros((10, 10))
        covariance[0, 0] = (0.01 * camera.m) ** 2
        cameras.append(replace(camera, covariance=covariance, px=60.0, py=140.0))
    expected = np.zeros((2, 2))
    for camera in cameras:
        way = np.linalg.solve(camera.ideal_from_sem_jacobian, [95.5 - 60.0, 95.5 - 140.0])
        expected += 0.01**2 * np.outer(way, way)
    np.testing.assert_allclose(zoom_covariance(*cameras), expected, rtol=1e-9)


def test_a_scale_that_is_wrong_by_one_per_cent_makes_a_frame_one_per_cent_taller() -> None:
    cameras = []
    for magnification in (2000.0, 3400.0):
        camera = small_camera(magnification)
        covariance = np.zeros((10, 10))
        covariance[0, 0] = (0.01 * camera.m) ** 2
        cameras.append(replace(camera, covariance=covariance))
    before, now = cameras
    in_px = now.ideal_from_sem_jacobian
    seen = in_px @ visit_stretch_covariance(before, now, 200.0) @ in_px.T
    # Of both scales, and of what no two visits have in common.
    expected = np.sqrt(2.0 * 0.01**2 + VISIT_SCALE**2) * 200.0
    assert np.sqrt(seen[1, 1]) == pytest.approx(expected, rel=1e-6)
    assert abs(seen[0, 0]) < 1e-6 * seen[1, 1]
    assert visit_scale_variance(before, now) == pytest.approx(2.0 * 0.01**2)
    assert visit_scale_variance(None, None) == VISIT_SCALE**2
