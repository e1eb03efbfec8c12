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

"""The live tracker on simulated specimens with known drift, and on the reference recording."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage, spatial, special

from benchmarks.drift.scenes import KINDS, draw
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift import tracker
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.drift.frame import MotionCorrector, ScanFrame
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.keyframe_store import Candidate
from semcal_ros.core.drift.matching import Match, RejectedMatch
from semcal_ros.core.drift.remade_keyframes import correct_shear
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.registration.failures import MatchFailure
from tests.helpers.drift_scenes import DriftingSpecimen, Texture, lattice, noisy, small_camera
from tests.helpers.long_tests import long_but

TIMING = ScanTiming(0.9, 1, 0.1)
SPECIMEN = DriftingSpecimen(pitch_m=0.1e-6, seed=3)
CAMERA = small_camera(2000.0)


class Run:
    """Frames of a specimen that drifts along a straight line and sways a little, tracked."""

    def __init__(self, velocity: tuple[float, float], **tracker: object) -> None:
        self.velocity = np.array(velocity)
        self.tracker = DriftTracker(DriftSettings(**tracker))  # type: ignore[arg-type]
        self.updates: list[DriftUpdate] = []
        self.errors_px: list[np.ndarray] = []
        self.sigmas_px: list[np.ndarray] = []
        self.origin = self.truth(TIMING.centre_offset_s)[0]

    def truth(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        sway = 0.2e-6
        position = self.velocity * t + [sway * np.sin(t / 4.0), 0.0]
        return position, self.velocity + [sway / 4.0 * np.cos(t / 4.0), 0.0]

    def step(self, k: int, camera: ScanCamera = CAMERA, spoil: object = None) -> DriftUpdate:
        position, velocity = self.truth(k + TIMING.centre_offset_s)
        drift = position - self.origin
        image = SPECIMEN.frame(camera, TIMING, drift, velocity, k)
        if callable(spoil):
            image = spoil(image)
        update = self.tracker.update(image, float(k), camera, TIMING)
        jacobian = camera.rectified.ideal_from_sem_jacobian
        self.updates.append(update)
        self.errors_px.append(jacobian @ (update.drift_m - drift))
        spread = jacobian @ update.covariance[:2, :2] @ jacobian.T
        self.sigmas_px.append(np.sqrt(np.diag(spread)))
        return update


def test_sign_unit_and_time() -> None:
    run = Run((0.3e-6, -0.2e-6))
    first, last = run.step(0), [run.step(k) for k in range(1, 6)][-1]
    assert first.status_text == "keyframe"
    assert np.all(first.drift_m == 0.0)
    assert first.time_s == pytest.approx(0.45)
    assert last.status_text == "tracked"
    assert last.units == "m"
    # Five seconds at 0.3 and -0.2 um/s, and the sway.
    assert last.drift_m[0] == pytest.approx(1.5e-6 + 0.19e-6, abs=0.03e-6)
    assert last.drift_m[1] == pytest.approx(-1.0e-6, abs=0.01e-6)
    assert last.velocity_m_s[1] == pytest.approx(-0.2e-6, abs=0.02e-6)
    np.testing.assert_allclose(last.drift_px, CAMERA.m * last.drift_m)


def test_accuracy_covariance_and_velocity() -> None:
    run = Run((0.1e-6, -0.05e-6))
    for k in range(16):
        run.step(k)
    error, sigma = np.array(run.errors_px)[1:], np.array(run.sigmas_px)[1:]
    # Noise of 5 grey levels on 192 x 192 px of texture: the bound is near 0.01 px.
    assert float(np.sqrt(np.mean(error**2))) < 0.03
    assert np.mean(np.abs(error) < 3.0 * sigma) > 0.9
    assert all(u.accepted for u in run.updates)
    true_velocity = run.truth(15 + TIMING.centre_offset_s)[1]
    np.testing.assert_allclose(run.updates[-1].velocity_m_s, true_velocity, atol=0.02e-6)


def test_drift_within_the_frame_does_not_bias_a_large_shift() -> None:
    # 8 px per frame: keyframe and frame overlap in rows that were scanned at different times.
    run = Run((1.0e-6, -0.6e-6))
    for k in range(8):
        run.step(k)
    error, sigma = np.array(run.errors_px), np.array(run.sigmas_px)
    assert np.all(np.abs(error) < 4.0 * sigma + 0.03)
    # Without the scan times the first steps are wrong by a tenth of a pixel and more.
    assert float(np.max(np.abs(error))) < 0.12


@pytest.mark.slow
def test_rekeys_before_the_overlap_is_lost_and_chains_the_uncertainty() -> None:
    run = Run((1.2e-6, 0.4e-6))
    updates = [run.step(k) for k in range(26)]
    keys = [k for k, u in enumerate(updates) if u.status_text == "keyframe"]
    assert len(keys) >= 4
    assert all(u.accepted for u in updates)
    # 250 px of travel: more than the width of the image.
    assert np.hypot(*updates[-1].drift_px) > 192.0
    error, sigma = np.array(run.errors_px), np.array(run.sigmas_px)
    assert np.all(np.abs(error) < 4.5 * sigma + 0.03)
    # Each of the keyframes on the way adds something.
    assert sigma[-1, 0] > 1.5 * sigma[6, 0]


@pytest.mark.parametrize("name", ["gold that changes", "ridges that change"])
def test_a_specimen_that_changes_is_followed_by_keyframes_that_change_with_it(name: str) -> None:
    """Another one grows in its place, by 1.4 % in each frame; parts stop fitting the first keyframe at a quarter."""
    frames, drift, _ = draw(KINDS[name], 101)
    tracker = DriftTracker()
    updates = [tracker.update(frame, float(k)) for k, frame in enumerate(frames)]
    assert all(u.accepted for u in updates)
    assert [u.status_text for u in updates].count("keyframe") >= 2
    error = np.array([u.drift_px for u in updates])[1:] - drift[1:]
    sigma = np.array([np.sqrt(np.diag(u.covariance)[:2]) for u in updates])[1:]
    # What grows pulls all frames alike.
    assert float(np.max(np.abs(error))) < 0.15
    assert float(np.sqrt(np.mean((error / sigma) ** 2))) < 1.7
    assert float(np.max(np.abs(error) / sigma)) < 3.5


def test_carries_drift_through_changes_of_magnification() -> None:
    run = Run((0.15e-6, -0.1e-6))
    steps = [1500.0] * 3 + [2000.0] * 2 + [3500.0] * 2 + [2000.0] * 2 + [1500.0]
    updates = [run.step(k, small_camera(g)) for k, g in enumerate(steps)]
    assert all(u.accepted for u in updates), [u.status_text for u in updates]
    # Back at a magnification its own keyframe serves again.
    assert [k for k, u in enumerate(updates) if u.status_text == "keyframe"] == [0, 3, 5]
    # Half a tenth of a pixel at each magnification; the drift itself is 3 to 20 px.
    assert np.all(np.abs(np.array(run.errors_px)) < 4.0 * np.array(run.sigmas_px) + 0.05)


def test_another_size_of_pictures_without_a_camera_is_said() -> None:
    texture, tracker = Texture(1), DriftTracker()
    sizes = [128, 128, 96, 96]
    updates = [
        tracker.update(noisy(texture.view((0.1 * k, 0.0), n), 8.0, k, contrast=13.0), float(k))
        for k, n in enumerate(sizes)
    ]
    told = "coasting: image of 96 x 96 px: no earlier one has this size"
    assert [u.status_text for u in updates] == ["keyframe", "tracked", told, "tracked"]


def test_too_large_a_change_coasts_and_says_so() -> None:
    run = Run((0.15e-6, -0.1e-6))
    for k in range(3):
        run.step(k, small_camera(1000.0))
    jump = run.step(3, small_camera(4000.0))
    after = run.step(4, small_camera(4000.0))
    assert jump.status_text.startswith("coasting: scale changed by a factor of 4.0")
    assert not jump.accepted
    assert after.accepted
    assert np.all(np.abs(run.errors_px[-1]) < 4.0 * run.sigmas_px[-1])
    assert run.sigmas_px[3][0] > 5.0 * run.sigmas_px[2][0]


def test_coasts_through_a_blanked_beam_and_recovers() -> None:
    run = Run((0.1e-6, -0.05e-6))
    for k in range(5):
        run.step(k)
    blank = [run.step(k, spoil=lambda image: image * 0) for k in range(5, 9)]
    assert all(u.status_text.startswith("coasting: image: blank") for u in blank)
    sigma = np.array(run.sigmas_px)[:, 0]
    assert np.all(np.diff(sigma[4:9]) > 0.0)
    assert np.all(np.abs(run.errors_px[8]) < 4.0 * run.sigmas_px[8])
    back = run.step(9)
    assert back.status_text == "tracked"
    assert np.all(np.abs(run.errors_px[9]) < 0.06)


def test_a_move_of_the_stage_is_not_drift() -> None:
    run = Run((0.1e-6, 0.0))
    for k in range(4):
        run.step(k)
    moved = run.step(4, spoil=lambda image: np.roll(image, (60, 60), axis=(0, 1)))
    assert moved.status_text.startswith("coasting: ")
    assert float(np.max(np.abs(run.errors_px[-1]))) < 1.0
    assert run.step(5).status_text == "tracked"


@pytest.mark.parametrize("jump", [(70.0, 0.0), (0.0, -70.0)])
def test_a_jump_along_one_axis_is_a_move_of_the_stage(jump: tuple[float, float]) -> None:
    texture, tracker = Texture(4), DriftTracker(DriftSettings(max_jump=0.3))
    for k in range(5):
        tracker.update(noisy(texture.view((0.2 * k, 0.0), 160), 4.0, k), float(k))
    update = tracker.update(noisy(texture.view(jump, 160), 4.0, 9), 5.0)
    assert update.rejection is not None
    # 70 of 160 px is more than 0.3 of the width.
    assert update.rejection.status is MatchFailure.STAGE_MOVE


def test_an_absurd_velocity_is_not_taken_out_of_a_keyframe() -> None:
    """Seen with a stage that steps fast under a charging specimen: the tracker raised "drift of 5.5e+03 px/s"."""
    run = Run((0.0, 0.0))
    run.step(0)
    state = run.tracker.state
    assert state is not None
    drift = state.filter.state
    (key,) = drift.keys
    mean = drift.mean.copy()
    # The keyframe moved by 20 000 px in a second.
    mean[drift.keyframe_slice(key)] = [0.0, 0.0, 2e-3, 2e-3]
    setup = TrackerSetup(DriftSettings(), MotionCorrector("cubic"), keeps_history=False)
    after, corrected = correct_shear(setup, state, key, replace(drift, mean=mean))
    assert not corrected and after is state


def test_goes_on_at_another_place_after_a_while() -> None:
    run = Run((0.1e-6, 0.0), lost_after=3)
    for k in range(4):
        run.step(k)
    elsewhere = [run.step(k, spoil=lambda image: image[::-1].copy()) for k in range(4, 9)]
    assert [u.accepted for u in elsewhere[:3]] == [False, False, False]
    assert elsewhere[3].accepted
    # What happened in between is not known, and that stays in the covariance.
    assert run.sigmas_px[-1][0] > 5.0 * run.sigmas_px[3][0]


def test_a_small_real_jump_is_believed_when_it_stays() -> None:
    tracker = DriftTracker()
    wide = DriftingSpecimen(pitch_m=1.0, seed=5)
    jumps = [0.0] * 8 + [9.0] * 3

    def view(k: int) -> np.ndarray:
        start = 300 - int(jumps[k])
        return noisy(wide.picture[300:460, start : start + 160].astype(np.float64), 4.0, k)

    statuses = [tracker.update(view(k), float(k)) for k in range(len(jumps))]
    assert "deviations from the prediction" in statuses[8].reason
    assert statuses[9].accepted
    np.testing.assert_allclose(statuses[10].drift_px, [9.0, 0.0], atol=0.1)


@pytest.mark.parametrize("pace", [3.2, 13.0])
def test_a_sudden_onset_of_drift_is_followed(pace: float) -> None:
    """Rest, then a steady pace: nothing of the way may be lost, however sure the filter was of the rest."""
    tracker = DriftTracker()
    wide = DriftingSpecimen(pitch_m=1.0, seed=5)
    way = np.concatenate([np.zeros(8), pace * np.arange(1, 9)])

    def view(k: int) -> np.ndarray:
        shifted = ndimage.shift(wide.picture[260:500, 200:500], (0.0, way[k]), order=5)
        return noisy(shifted[40:200, 120:280].astype(np.float64), 4.0, k)

    updates = [tracker.update(view(k), float(k)) for k in range(len(way))]
    refused = [k for k, u in enumerate(updates) if not u.accepted]
    # A pace that drift is not expected to have must be seen twice.
    assert refused == ([] if pace < 6.0 else [8])
    for k in range(9, len(way)):
        sigma = np.sqrt(np.diag(updates[k].covariance)[:2])
        error = np.abs(updates[k].drift_px - [way[k], 0.0])
        assert np.all(error < 5.0 * sigma + 0.03), (k, error, sigma)
    np.testing.assert_allclose(updates[-1].velocity_m_s, [pace, 0.0], atol=0.1)


def test_the_sigma_in_px_is_that_of_the_registration_and_not_of_the_scale() -> None:
    """A scale that is known to 3 % makes metres uncertain, and pixels not."""
    uncertain = replace(CAMERA, covariance=np.diag([(0.03 * CAMERA.m) ** 2, *np.zeros(9)]))
    sigmas = []
    for camera in (CAMERA, uncertain):
        run = Run((0.3e-6, -0.2e-6))
        # As many as tell that the drift is smooth.
        for k in range(9):
            update = run.step(k, camera)
        sigmas.append(update.sigma_px)
        of_metres = np.sqrt(
            np.diag(update.px_from_unit @ update.covariance[:2, :2] @ update.px_from_unit.T)
        )
        if camera is uncertain:
            expected = np.hypot(update.sigma_px, 0.03 * np.abs(update.drift_px))
            np.testing.assert_allclose(of_metres, expected, rtol=0.05)
            assert np.max(of_metres) > 2.0 * np.max(update.sigma_px)
    # A camera that is less certain also makes a measured shear less certain, which has a little to do with it.
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=0.05)


def test_a_lattice_with_defects_is_followed_without_hops() -> None:
    tracker = DriftTracker()
    worst = 0.0
    y, x = np.mgrid[:192, :192]
    for k in range(14):
        shift = (1.3 * k, -0.7 * k)
        picture = lattice(192, 14.0, shift)
        for column, row in ((70.0, 110.0), (120.0, 60.0), (105.0, 135.0)):
            square = (x - column - shift[0]) ** 2 + (y - row - shift[1]) ** 2
            picture = picture + 2.0 * np.exp(-square / 18.0)
        update = tracker.update(noisy(picture, 4.0, k), float(k))
        assert update.accepted, update.reason
        worst = max(worst, float(np.max(np.abs(update.drift_px - shift))))
    # 18 px of travel on a lattice that repeats after 20 px.
    assert worst < 0.1


def test_without_a_camera_drift_is_in_px_and_said_so() -> None:
    tracker = DriftTracker()
    wide = DriftingSpecimen(pitch_m=1.0, seed=5)
    for k in range(3):
        crop = wide.picture[300 - 3 * k : 460 - 3 * k, 300 + 2 * k : 460 + 2 * k]
        update = tracker.update(noisy(crop.astype(np.float64), 4.0, k), float(k))
    assert not update.calibrated
    assert update.units == "px"
    np.testing.assert_allclose(update.drift_m, [-4.0, 6.0], atol=0.05)
    np.testing.assert_allclose(update.velocity_m_s, [-2.0, 3.0], atol=0.1)
    # With a camera the unit changes: a new beginning.
    again = tracker.update(noisy(crop.astype(np.float64), 4.0, 9), 3.0, CAMERA)
    assert again.status_text == "keyframe"
    assert again.calibrated
    assert np.all(again.drift_m == 0.0)


def test_already_rectified_frames() -> None:
    plain = replace(CAMERA, xi_r=0.0, xi_t=0.0, aspect=1.0, skew=0.0)
    trackers = [DriftTracker(), DriftTracker()]
    for k in range(3):
        drift = np.array([0.2e-6, -0.1e-6]) * k
        image = SPECIMEN.frame(plain, ScanTiming(1e-6), drift, np.zeros(2), k)
        results = [
            trackers[0].update(image, float(k), CAMERA, rectified=True),
            trackers[1].update(image, float(k), plain),
        ]
    # They differ by a border of two pixels that a resampled frame loses: 0.01 px is 1.2 nm.
    np.testing.assert_allclose(results[0].drift_m, results[1].drift_m, atol=1.2e-9)
    np.testing.assert_allclose(results[0].drift_m, [0.4e-6, -0.2e-6], atol=0.01e-6)


def test_clock_that_jumps_back_and_reset_start_anew() -> None:
    run = Run((0.3e-6, 0.0))
    for k in range(3):
        run.step(k)
    assert run.updates[-1].drift_m[0] > 0.5e-6
    image = SPECIMEN.frame(CAMERA, TIMING, np.zeros(2), np.zeros(2), 1)
    again = run.tracker.update(image, -5.0, CAMERA, TIMING)
    assert again.status_text == "keyframe"
    assert np.all(again.drift_m == 0.0)
    run.tracker.update(image, -4.0, CAMERA, TIMING)
    run.tracker.reset()
    assert run.tracker.update(image, -3.0, CAMERA, TIMING).status_text == "keyframe"


def test_a_first_frame_without_picture_is_no_keyframe() -> None:
    tracker = DriftTracker()
    first = tracker.update(np.zeros((100, 100), np.uint8), 0.0)
    assert first.status_text.startswith("coasting: blank")
    crop = SPECIMEN.picture[:100, :100].astype(np.float64)
    assert tracker.update(noisy(crop, 4.0, 0), 1.0).status_text == "keyframe"


def test_bad_input_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="frame time"):
        DriftTracker().update(np.zeros((64, 64), np.uint8), float("nan"))
    with pytest.raises(InvalidValueError, match="type bool"):
        DriftTracker().update(np.zeros((64, 64), bool), 0.0)
    with pytest.raises(InvalidValueError, match="rekey_overlap"):
        DriftSettings(rekey_overlap=1.5)


@pytest.mark.parametrize(
    ("level", "reason"),
    [
        (1e16, "values beyond 1e+15"),
        (1e30, "values beyond 1e+15"),
        (1e40, "values that are not finite"),
    ],
)
def test_values_whose_squares_overflow_are_refused_and_spoil_nothing(
    level: float, reason: str
) -> None:
    texture = Texture(seed=4, n=256)
    frames = [noisy(texture.view((0.6 * k, 0.0), 128), 4.0, k) for k in range(4)]
    hot = frames[2].copy()
    hot[5, 7] = -level
    for spoilt in (frames[2] * level, hot):
        tracker = DriftTracker()
        given = [frames[0], frames[1], spoilt, frames[3]]
        said = [tracker.update(image, float(k)).status_text for k, image in enumerate(given)]
        assert said == ["keyframe", "tracked", f"coasting: image: {reason}", "tracked"]
    first = DriftTracker()
    assert first.update(frames[0] * level, 0.0).status_text == f"coasting: {reason}"
    assert first.update(frames[1], 1.0).status_text == "keyframe"


def _gold() -> Path:
    root = os.environ.get("SEMCAL_REFERENCE_DATA")
    if not root:
        pytest.skip("SEMCAL_REFERENCE_DATA is not set")
    return Path(root) / "gold_drift_5000x"


def _gold_frames(folder: Path) -> list[tuple[float, np.ndarray]]:
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    frames = []
    with Reader(folder) as reader:
        images = [c for c in reader.connections if c.msgtype == "sensor_msgs/msg/Image"]
        for connection, _, data in reader.messages(images):
            message = store.deserialize_cdr(data, connection.msgtype)
            stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            picture = np.asarray(message.data).reshape(message.height, message.step)
            frames.append((stamp, picture[:, : message.width]))
    return frames


@pytest.mark.slow
def test_reference_recording_of_gold_on_carbon() -> None:
    folder = _gold()
    truth = json.loads((folder / "truth.json").read_text())
    p = truth["params"]["5000.0"]
    camera = ScanCamera(
        magnification=5000.0,
        m=p["m"] * 1e6,
        aspect=p["a"],
        skew=p["s"] / p["m"],
        px=p["px"],
        py=p["py"],
        rho=p["rho"] * 1e6,
        xi_r=p["xr"],
        xi_t=p["xt"],
        ex=p["ex"],
        ey=p["ey"],
        norm_px=256.0,
        width=512,
        height=512,
    )
    scan = truth["scan"]
    timing = ScanTiming(scan["frame_s"], scan["averages"], scan["flyback"])
    frames = _gold_frames(folder)
    tracker = DriftTracker()
    updates = [tracker.update(image, t - frames[0][0], camera, timing) for t, image in frames]
    assert all(u.accepted for u in updates)
    drift = 1e-6 * np.array([f["drift_um"] for f in truth["frames"]])
    error = (np.array([u.drift_m for u in updates]) - (drift - drift[0])).T
    error_px = camera.rectified.ideal_from_sem_jacobian @ error
    # The goal of the project is 0.03 px; the noise of the two images allows about 0.005.
    assert float(np.sqrt(np.mean(np.sum(error_px**2, axis=0)))) < 0.03


def test_a_frozen_picture_says_nothing_about_drift() -> None:
    run = Run((0.3e-6, -0.2e-6))
    frozen = SPECIMEN.frame(CAMERA, TIMING, *run_truth(run, 5), 5)
    for k in range(12):
        update = run.step(k, spoil=(lambda _: frozen) if 5 <= k < 9 else None)
        if 6 <= k < 9:
            assert update.status_text == "coasting: image: the same as the previous frame"
    assert run.updates[9].accepted
    error, sigma = np.array(run.errors_px)[1:], np.array(run.sigmas_px)[1:]
    assert np.all(np.abs(error) < 4.5 * sigma + 0.03)


def run_truth(run: Run, k: int) -> tuple[np.ndarray, np.ndarray]:
    position, velocity = run.truth(k + TIMING.centre_offset_s)
    return position - run.origin, velocity


@pytest.mark.parametrize("pause_s", [60.0, 800.0, 1e5])
def test_a_long_pause_is_survived(pause_s: float) -> None:
    texture = Texture(1)
    tracker = DriftTracker()
    times = [*np.arange(8.0), *(7.0 + pause_s + np.arange(1.0, 6.0))]
    for k, t in enumerate(times):
        # It rests during the pause.
        way = 0.3 * min(t, 7.0) + 0.3 * max(t - 7.0 - pause_s, 0.0)
        picture = noisy(texture.view((way, -way), 160), 4.0, k)
        update = tracker.update(np.clip(picture, 0, 255).astype(np.uint8), float(t))
        sigma = np.sqrt(np.diag(update.covariance)[:2])
        assert np.all(np.isfinite(sigma))
        assert np.all(np.abs(update.drift_px - [way, -way]) < 5.0 * sigma + 0.02)
    assert update.accepted


def test_after_a_restart_the_place_is_uncertain() -> None:
    texture, other = Texture(1), Texture(2)
    tracker = DriftTracker()
    for k in range(6):
        tracker.update(noisy(texture.view((0.1 * k, 0.0), 160), 4.0, k), float(k))
    updates = [
        tracker.update(noisy(other.view((0.1 * k, 0.0), 160), 4.0, k), float(k))
        for k in range(6, 20)
    ]
    (restart,) = [k for k, u in enumerate(updates) if u.restarted]
    # Where the other place lies is unknown within a jump that would be refused.
    assert np.all(np.sqrt(np.diag(updates[-1].covariance)[:2]) > 30.0)
    assert updates[restart + 2].accepted


def _track(views: list[np.ndarray]) -> tuple[list[DriftUpdate], DriftTracker, DriftHistory]:
    history = DriftHistory()
    tracker = DriftTracker(history=history)
    updates = [tracker.update(view, float(k)) for k, view in enumerate(views)]
    return updates, tracker, history


@pytest.mark.parametrize("kind", ["another place each time", "noise", "blank"])
def test_what_was_never_measured_has_no_sigma(kind: str) -> None:
    rng = np.random.default_rng(0)
    views = {
        "another place each time": [
            noisy(Texture(k).view((0.0, 0.0), 160), 4.0, k) for k in range(4)
        ],
        "noise": [rng.normal(128.0, 20.0, (160, 160)) for _ in range(4)],
        "blank": [np.full((160, 160), 7.0)] * 4,
    }[kind]
    updates, tracker, history = _track(views)
    has_zero = kind == "another place each time"
    for path in (updates, history.smooth().updates):
        # The drift of the first frame is zero by definition, if it can be compared with anything.
        assert np.all(np.diag(path[0].covariance)[:2] == (0.0 if has_zero else np.inf))
        assert np.all(np.diag(path[0].covariance)[2:] == np.inf)
        assert all(np.all(np.diag(u.covariance) == np.inf) for u in path[1:])
    assert np.all(np.diag(tracker.predictor().at(9.0).covariance) == np.inf)


def test_a_blank_frame_before_the_first_keyframe_is_not_at_zero() -> None:
    texture = Texture(4)
    blank = np.full((160, 160), 7.0)
    seen = [noisy(texture.view((0.5 * k, 0.0), 160), 4.0, k) for k in range(4)]
    _, _, history = _track([blank, blank, *seen])
    sigma = history.smooth().sigma_m
    assert np.all(np.isinf(sigma[:2])) and np.all(sigma[2:] < 0.1)


@pytest.mark.parametrize("frames_at_end", [1, 3, 7])
def test_another_place_at_the_end_is_covered_at_once(frames_at_end: int) -> None:
    """110 px away nothing is left to compare with; the drift before was steady to 0.01 px."""
    texture, truth = Texture(4), [(0.5 * k, -0.2 * k) for k in range(8)]
    truth += [(0.5 * k + 110.0, -0.2 * k + 110.0) for k in range(8, 8 + frames_at_end)]
    views = [noisy(texture.view(d, 128), 4.0, k) for k, d in enumerate(truth)]
    updates, tracker, history = _track(views)
    assert not any(u.accepted for u in updates[8:])
    for path in (updates, history.smooth().updates):
        sigma = np.array([np.sqrt(np.diag(u.covariance)[:2]) for u in path])
        error = np.abs(np.array([u.drift_px for u in path]) - truth)
        # 1-sigma is max_jump, a quarter of the field: 32 px.
        assert np.all(error[8:] < 4.0 * sigma[8:])
        assert np.all(sigma[:8] < 0.5)
    # The forecast knows it, too.
    assert np.sqrt(tracker.predictor().at(len(truth) - 0.5).covariance[0, 0]) > 30.0


def test_noise_instead_of_a_frame_says_nothing_about_the_place() -> None:
    """A burst of noise is no reason to doubt the drift: it coasts, as through a blanked beam."""
    texture, rng = Texture(4), np.random.default_rng(1)
    views = [noisy(texture.view((0.5 * k, 0.0), 160), 4.0, k) for k in range(8)]
    updates, _, _ = _track([*views, *(rng.normal(128.0, 40.0, (160, 160)) for _ in range(3))])
    assert not any(u.accepted for u in updates[8:])
    assert all(np.sqrt(u.covariance[0, 0]) < 1.0 for u in updates[8:])


def test_a_place_that_was_doubted_and_found_again_is_certain_with_hindsight() -> None:
    texture, other = Texture(4), Texture(5)
    views = [noisy(texture.view((0.5 * k, 0.0), 160), 4.0, k) for k in range(12)]
    views[8] = noisy(other.view((0.0, 0.0), 160), 4.0, 8)
    updates, _, history = _track(views)
    assert np.sqrt(updates[8].covariance[0, 0]) > 30.0
    assert np.sqrt(updates[9].covariance[0, 0]) < 0.1
    assert history.smooth().sigma_m[8, 0] < 0.5


@pytest.mark.parametrize("jump_px", [12.0, 35.0])
def test_the_first_frame_after_a_step_of_the_stage_is_not_certain_with_hindsight(
    jump_px: float,
) -> None:
    """It is refused, and the path puts it where it would be without the step."""
    texture = Texture(4)
    x_px = np.array([0.5 * k + jump_px * (k >= 8) for k in range(14)])
    views = [noisy(texture.view((float(x), 0.0), 160), 4.0, k) for k, x in enumerate(x_px)]
    updates, _, history = _track(views)
    assert not updates[8].accepted
    assert all(u.accepted for u in updates[9:])
    path = history.smooth()
    off = np.abs(path.drift_m[:, 0] - x_px)
    assert off[8] > 0.5 * jump_px
    assert np.all(off <= 3.0 * path.sigma_m[:, 0] + 1e-9)
    assert np.all(np.delete(path.sigma_m[:, 0], 8) < 0.2)


def test_where_the_stage_was_while_it_was_away_is_not_known_with_hindsight() -> None:
    """It begins again there, and comes back: that does not tell how far away it was."""
    texture = Texture(4)
    is_away = (np.arange(28) >= 6) & (np.arange(28) < 20)
    truth = np.array([(0.2 * k, -0.1 * k) for k in range(28)]) + 110.0 * is_away[:, None]
    views = [noisy(texture.view((x, y), 160), 4.0, k) for k, (x, y) in enumerate(truth.tolist())]
    updates, _, history = _track(views)
    assert [k for k, u in enumerate(updates) if u.restarted and u.drift_px.any()] == [13]
    assert all(u.accepted for u in updates[14:])
    path = history.smooth()
    off, sigma = np.abs(path.drift_m - truth), path.sigma_m
    # One sigma of a place that is lost is a quarter of the field, which is 0.7 of one here.
    assert np.all(sigma[14:20] > 30.0)
    assert np.all(off[14:20] < 4.0 * sigma[14:20])
    assert np.all(off[20:] < 0.1) and np.all(sigma[20:] < 0.1)


def test_a_frame_that_was_seen_elsewhere_is_not_certain_with_hindsight() -> None:
    """Two steps in succession: what the second one leaves agrees with the velocity that the first one may have had."""
    texture = Texture(4)
    truth = np.array([0.5 * k for k in range(18)])
    truth[8:] -= 13.0
    truth[10] -= 33.0
    truth[11:] -= 10.0
    views = [noisy(texture.view((x, 0.0), 192), 4.0, k) for k, x in enumerate(truth.tolist())]
    updates, _, history = _track(views)
    assert [k for k, u in enumerate(updates) if not u.accepted] == [8, 10]
    path = history.smooth()
    off = np.abs(path.drift_m[:, 0] - truth)
    # Below 0.03 px, what interpolation does to shifts of half a pixel is common to all frames.
    assert np.all((off < 0.03) | (off < 3.0 * path.sigma_m[:, 0]))
    assert np.all(np.delete(path.sigma_m[:, 0], [8, 10]) < 0.2)


@pytest.mark.parametrize(
    ("kind", "jump_px", "said"),
    [("tool over gold", 8.0, "ambiguous"), ("two tools", 3.0, "coarse and fine shift differ")],
)
def test_a_stage_that_jumps_under_a_tool_is_not_denied_by_the_sigma(
    kind: str, jump_px: float, said: str
) -> None:
    """What most of the image agrees with is not believed, but the prediction may be the one that is wrong."""
    frames, drift, _ = draw(replace(KINDS[kind], jump_px=jump_px), 300)
    tracker, coasted = DriftTracker(), 0
    for k, (frame, at) in enumerate(zip(frames, drift, strict=True)):
        update = tracker.update(frame, float(k))
        coasted += said in update.reason
        off = np.abs(update.drift_px - at)
        assert np.all((off < 0.1) | (off < 3.0 * update.sigma_px)), (k, update.reason)
    assert coasted >= 1 and update.accepted


@pytest.mark.parametrize(
    "scene", [pytest.param("gold", marks=pytest.mark.long), "ridges", "tool over gold"]
)
@pytest.mark.parametrize(
    "jump", long_but(lambda jump: jump[0] != 20.0, [(5.0, 0.35), (20.0, 0.45), (60.0, 0.35)])
)
def test_a_stage_that_moves_within_a_frame_is_said_and_believed_when_it_stays(
    scene: str, jump: tuple[float, float]
) -> None:
    """The first lines are where they were predicted, as the specimen beside a tool would be."""
    jump_px, line = jump
    frames, drift, _ = draw(replace(KINDS[scene], jump_px=jump_px, jump_line=line), 301, 20)
    tracker, said = DriftTracker(), {}
    for k, frame in enumerate(frames):
        update = tracker.update(frame, float(k))
        off = np.abs(update.drift_px - drift[k])
        assert np.all((off < 0.1) | (off < 3.0 * update.sigma_px)), (k, update.reason)
        if "moved within the frame" in update.reason:
            said[k] = int(update.reason.split("from line ")[1].split()[0])
    assert list(said) == [15]
    # Told by tiles, some of which show both.
    assert abs(said[15] - line * len(frames[15])) < 32
    # What a part of the image does, a tool does as well as a stage: beside one the drift coasts on.
    assert scene == "tool over gold" or (update.accepted and np.all(off < 0.1))


@pytest.mark.parametrize("seed", [301, 302])
def test_a_frame_whose_parts_fit_elsewhere_coasts_with_a_sigma_that_says_so(seed: int) -> None:
    """A move by 5 px within a frame looks like a strain of a rough ground."""
    kind = replace(KINDS["fractal"], jump_px=5.0, jump_line=0.4)
    frames, drift, _ = draw(kind, seed, 16)
    tracker = DriftTracker()
    for k, frame in enumerate(frames):
        update = tracker.update(frame, float(k))
    assert "strained" in update.reason
    assert np.all(np.abs(update.drift_px - drift[15]) < 3.0 * update.sigma_px)


@pytest.mark.parametrize("seed", range(3))
def test_a_stage_may_move_under_a_tool_that_was_seen_before(seed: int) -> None:
    """The tool stays where it is. What else moves by 11 px, nine tenths of the structure, was refused until it was
    given up, since it was not all.
    """
    texture, tracker = Texture(seed), DriftTracker()
    updates, drift = [], []
    for k in range(16):
        moved = (-0.3 * k - 2.0 * (k >= 10), 0.4 * k - 11.0 * (k >= 10))
        scene = 128.0 + 40.0 * texture.view(moved, 256)
        scene[120:140, :150] = 200.0
        picture = ndimage.gaussian_filter(scene, 1.0)
        picture += np.random.default_rng(100 * seed + k).normal(0.0, 15.0, scene.shape)
        updates.append(tracker.update(picture, float(k)))
        drift.append(moved)
    assert all(u.accepted for u in updates[:10])
    # The second frame after it says that the first one was right.
    assert all(u.accepted for u in updates[11:])
    for update, moved in zip(updates, drift, strict=True):
        if update.accepted and update.covariance[0, 0] > 0.0:
            error = update.drift_px - np.array(moved)
            assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(update.covariance)[:2]) + 0.02)


def _draw_pores(seed: int, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pores 24 px apart, of which one in thirty is missing, and one of their periods."""
    rng, size = np.random.default_rng(seed), 320
    angle = rng.uniform(0.0, 1.5)
    periods = 24.0 * np.array(
        [[np.cos(a), np.sin(a)] for a in (angle, angle + np.pi / 3.0)]  # of a hexagonal lattice
    )
    numbers = np.stack(np.meshgrid(*2 * [np.arange(-20, 21)]), axis=-1).reshape(-1, 2)
    places = (numbers @ periods)[rng.random(len(numbers)) > 0.03] + 0.5 * size + moved
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2)
    distance = spatial.cKDTree(places).query(grid)[0].reshape(size, size)
    return 140.0 - 90.0 * special.expit((7.5 - distance) / 0.8), periods[0]


@pytest.mark.long
def test_a_stage_that_moves_by_nearly_a_period_under_a_cross_hair_is_not_followed_wrongly() -> None:
    """The cross-hair was left out at the predicted shift alone, so that it was a defect of the lattice at any other,
    and the period next to the prediction was taken: 24 px wrong in the first frame of each of ten series.
    """
    found = 0
    for seed in (0, 4, 5):
        tracker, rng = DriftTracker(), np.random.default_rng(seed)
        for k in range(14):
            moved = np.array([-0.45 * k, 0.1 * k])
            if k >= 10:
                moved = moved + _draw_pores(seed, moved)[1] - [3.6, 2.7]
            picture = _draw_pores(seed, moved)[0] + rng.normal(0.0, 14.0, (320, 320))
            picture[160, 20:-20] = picture[20:-20, 160] = 255.0
            update = tracker.update(np.clip(picture, 0.0, 255.0).astype(np.uint8), float(k))
            assert update.accepted or k >= 10
            off = np.abs(update.drift_px - moved)
            if k > 0 and update.accepted:
                assert np.all((off < 0.1) | (off < 4.0 * update.sigma_px)), (seed, k)
        found += update.accepted and bool(update.sigma_px.max() < 0.1)
    # With few defects beside the cross-hair, two of three: seven of ten series were.
    assert found >= 2


def test_a_place_that_was_lost_is_found_again_where_it_is_still_in_sight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Eight frames are refused, for any reason; the frames after it show what was seen before, and tell where it is.
    The sigma stayed at half of the image.
    """
    refuses, match = set(range(6, 14)), tracker.match_keyframe

    def match_seldom(
        setup: TrackerSetup, state: TrackerState, frame: ScanFrame, candidate: Candidate
    ) -> tuple[TrackerState, Match | RejectedMatch]:
        state, found = match(setup, state, frame, candidate)
        if round(state.filter.state.time_s) in refuses:
            return state, RejectedMatch(
                Rejection(MatchFailure.AMBIGUOUS, "ambiguous"), found.registration
            )
        return state, found

    monkeypatch.setattr(tracker, "match_keyframe", match_seldom)
    texture, own = Texture(3), DriftTracker()
    for k in range(20):
        # It turns round while nothing is seen.
        moved = np.array([0.8 * k if k < 6 else 4.8 - 0.6 * (k - 6), 0.3 * k])
        picture = noisy(texture.view((float(moved[0]), float(moved[1])), 192), 8.0, k)
        update = own.update(picture, float(k))
        assert update.accepted == (k not in refuses)
    assert update.sigma_px.max() < 0.1
    assert np.all(np.abs(update.drift_px - moved) < 4.0 * update.sigma_px)
