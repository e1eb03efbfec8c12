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

"""Bidirectional scans: the phase of odd lines is estimated with a true sigma, removed, and found where undeclared."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from benchmarks.drift.scenes import KINDS, draw
from benchmarks.thresholds.fleets.rectification import shift_odd_lines
from semcal_ros.core.arrays import AnyImage, Array
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.rectification.line_phase import (
    LinePhase,
    LinePhaseCorrector,
    estimate_line_phase,
    remove_line_phase,
)
from tests.helpers.long_tests import long_but


@cache
def scene(name: str) -> tuple[list[AnyImage], Array]:
    """Frames with noise, and the drift; only of one scene are several looked at."""
    frames, drift, _ = draw(KINDS[name], 100, 12 if name == "gold" else 1)
    return frames, drift


def noisy_scene(name: str) -> AnyImage:
    return scene(name)[0][0]


@pytest.mark.parametrize(
    "name",
    long_but(lambda n: n in ("gold", "scratches"), ["gold", "fractal", "lattice", "scratches"]),
)
@pytest.mark.parametrize("phase_px", long_but(lambda phase: phase == -6.0, [-6.0, 0.3, 2.7]))
def test_the_phase_is_right_within_its_sigma(name: str, phase_px: float) -> None:
    found = estimate_line_phase(shift_odd_lines(noisy_scene(name), phase_px))
    assert found.sigma_px < 0.06
    # Once in 15000.
    assert abs(found.shift_px - phase_px) < 4.0 * found.sigma_px
    assert found.is_seen


def test_the_sigma_is_that_of_the_scatter() -> None:
    clean = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(256, 256)), (0, 0), 2.5)
    clean = clean / clean.std()
    rng = np.random.default_rng(1)
    found = [
        estimate_line_phase(shift_odd_lines(clean, 1.3) + rng.normal(0.0, 1.0, clean.shape))
        for _ in range(40)
    ]
    z = np.array([(f.shift_px - 1.3) / f.sigma_px for f in found])
    # The RMS of 40 normal deviates is 1 within 11 %; the sigma itself is known to a sixth.
    assert 0.65 < np.sqrt(np.mean(z**2)) < 1.5


@pytest.mark.parametrize("name", ["gold", "lattice", "scratches", "sparse", "clouds"])
def test_none_is_seen_where_there_is_none(name: str) -> None:
    assert not estimate_line_phase(noisy_scene(name)).is_seen


@pytest.mark.parametrize("seed", range(8))
def test_stripes_along_the_lines_tell_none(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stripes = 100.0 + 40.0 * np.sign(rng.normal(size=(256, 1))) * np.ones(256)
    assert not np.isfinite(estimate_line_phase(rng.normal(stripes, 8.0)).sigma_px)


def test_of_what_repeats_only_the_phase_below_a_quarter_of_the_period_is_told() -> None:
    x, rng = np.arange(256), np.random.default_rng(0)
    grating = 100.0 + 50.0 * np.sin(2.0 * np.pi * x / 8.0) * np.ones((256, 1))
    told = estimate_line_phase(rng.normal(shift_odd_lines(grating, 1.3), 8.0))
    assert abs(told.shift_px - 1.3) < 4.0 * told.sigma_px < 0.1
    for phase in (3.0, -2.7, 4.0):
        lines, frame = LinePhaseCorrector(True), rng.normal(shift_odd_lines(grating, phase), 8.0)
        assert lines.correct(frame) is frame
        assert "were not moved" in lines.note


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_lines_are_moved_back_by_half_each(dtype: type) -> None:
    x = np.arange(200.0)

    def wave(shift: float) -> Array:
        return 120.0 + 80.0 * np.sin((x - shift) / 5.0)

    image = np.empty((32, 200))
    image[0::2], image[1::2] = wave(10.0), wave(11.4)
    out = remove_line_phase(np.rint(image).astype(dtype), 1.4)
    assert out.dtype == dtype
    # Half a grey level of rounding twice, and what the filter leaves.
    assert np.max(np.abs(out[:, 10:-10] - wave(10.7)[10:-10])) < 1.1


def test_images_of_colours_and_images_too_small_are_taken() -> None:
    image = np.repeat(noisy_scene("gold")[:, :, None], 3, axis=2)
    assert not estimate_line_phase(image).is_seen
    assert remove_line_phase(image, 0.5).shape == image.shape
    assert not estimate_line_phase(image[:8]).is_seen
    assert not estimate_line_phase(np.zeros((64, 64), dtype=np.uint8)).is_seen


@pytest.mark.parametrize("width", [512, 640])
def test_a_picture_whose_lines_are_alike_spoils_no_stream(width: int) -> None:
    """The colour bars of a video grabber: they scatter by nothing, and a grain of rounding is no phase."""
    bars = np.tile(np.repeat(np.arange(0, 256, 32, dtype=np.uint8), width // 8), (512, 1))
    lines = LinePhaseCorrector(False)
    for frame in [bars, bars, bars, *scene("gold")[0][:3]]:
        lines.correct(frame)
    assert not lines.phase.is_seen


def test_a_stream_is_freed_of_it_and_tracked_as_without() -> None:
    frames, drift = scene("gold")
    lines, tracker = LinePhaseCorrector(True), DriftTracker()
    for k, frame in enumerate(frames):
        raw = np.clip(np.rint(shift_odd_lines(frame, 3.4)), 0, 255).astype(np.uint8)
        update = tracker.update(lines.correct(raw), float(k))
        assert update.accepted
    assert abs(lines.phase.shift_px - 3.4) < 4.0 * lines.phase.sigma_px < 0.1
    assert np.max(np.abs(update.drift_px - drift[11])) < 0.1
    assert "moved back" in lines.note


def test_another_phase_is_followed_at_once() -> None:
    frame = noisy_scene("gold")
    lines = LinePhaseCorrector(True)
    for phase in (3.4, 1.2):
        for _ in range(3):
            lines.correct(shift_odd_lines(frame, phase).astype(np.float32))
        assert abs(lines.phase.shift_px - phase) < 0.1


def test_an_undeclared_phase_is_said_and_left() -> None:
    frame = shift_odd_lines(noisy_scene("gold"), 2.0).astype(np.float32)
    lines = LinePhaseCorrector(False)
    assert lines.correct(frame) is frame
    assert "bidirectional: true" in lines.note
    assert "2.0" in lines.note
    quiet = LinePhaseCorrector(False)
    quiet.correct(noisy_scene("gold"))
    assert quiet.note == ""


def test_infinite_pixels_tell_no_phase() -> None:
    image = np.random.default_rng(0).normal(size=(64, 96)).astype(np.float32)
    image[::3, ::5] = np.inf
    image[1::3, 2::5] = np.nan
    assert estimate_line_phase(image) == LinePhase(0.0, np.inf)
