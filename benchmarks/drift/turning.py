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

"""Streams that drift and turn, or grow: frames refused, errors, and errors over their stated sigma.

    python -m benchmarks.drift.turning [--seeds 2] [--size 256] [--frames 76]

Each specimen is a quintic spline through a random scene, seen about the middle of the image at
``exp(s) R(theta) X + drift``, with noise of 8 grey levels of 40 RMS. Errors over sigma are root mean squares
over all frames but the first. The time is that of a frame in ms.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from benchmarks.table import show
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.tracker import DriftTracker

CONTRAST, NOISE = 40.0, 8.0
#: Rotation (rad) and scale a frame, and the part of the interval in which one is scanned.
MOTIONS = {
    "0.02 deg": (np.deg2rad(0.02), 0.0, 0.0),
    "0.02 deg, scanned": (np.deg2rad(0.02), 0.0, 0.8),
    "scale 1e-4": (0.0, 1e-4, 0.0),
    "none": (0.0, 0.0, 0.0),
}
#: Width of the blur and correlation length of the scenes, px.
SCENES = {"gold": (1.5, 4.0), "fine": (1.3, 0.0), "coarse": (2.0, 15.0)}


def make_scene(kind: str, n: int, seed: int) -> Array:
    """Spline coefficients of n x n px of unit variance."""
    blur, grain = SCENES[kind]
    w = 2.0 * np.pi * np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None, :])
    white = np.fft.rfft2(np.random.default_rng(seed).standard_normal((n, n)))
    picture = np.fft.irfft2(white * np.exp(-0.5 * (w * blur) ** 2) / (1.0 + (w * grain) ** 2))
    picture = picture / picture.std()
    if kind == "gold":
        picture = np.tanh(picture)
    return np.asarray(spline_filter(picture, order=5, mode="grid-wrap"))


def motion_at(times: Array, turn: float, growth: float) -> tuple[Array, Array, Array]:
    """Drift (..., 2), rotation and scale."""
    x = 0.5 * times + 1.5 * np.sin(times / 9.0)
    y = 0.3 * times + np.sin(times / 13.0)
    return np.stack([x, y], axis=-1), turn * times, growth * times


def see(coefficients: Array, size: int, times: Array, turn: float, growth: float) -> Array:
    """Image whose pixels are scanned at ``times`` (size, size)."""
    y, x = np.mgrid[:size, :size].astype(np.float64)
    drift, angle, log_scale = motion_at(times, turn, growth)
    middle = 0.5 * (size - 1)
    u, v, shrink = x - middle - drift[..., 0], y - middle - drift[..., 1], np.exp(-log_scale)
    cos, sin = np.cos(angle), np.sin(angle)
    at = shrink * (-sin * u + cos * v) + size, shrink * (cos * u + sin * v) + size
    picture = map_coordinates(coefficients, at, order=5, mode="grid-wrap", prefilter=False)
    return np.asarray(picture)


def measure(kind: str, motion: str, size: int, frames: int, seed: int) -> list[list[object]]:
    """Rows of the table, live and with hindsight."""
    turn, growth, scanned = MOTIONS[motion]
    timing = ScanTiming(scanned) if scanned else None
    coefficients = make_scene(kind, 2 * size, seed)
    y, x = np.mgrid[:size, :size]
    rng = np.random.default_rng(seed + 1000)
    offset_s = np.zeros((size, size))
    if timing is not None:
        offset_s = timing.pixel_offset_s(y, x, size, size) - timing.centre_offset_s
    history = DriftHistory()
    tracker = DriftTracker(DriftSettings(similarity=True), history=history)
    live, spent_s = [], 0.0
    for k in range(frames):
        image = 128.0 + CONTRAST * see(coefficients, size, k + offset_s, turn, growth)
        image += NOISE * rng.standard_normal(image.shape)
        grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        start_s = k - (0.0 if timing is None else timing.centre_offset_s)
        began = time.perf_counter()
        live.append(tracker.update(grey, start_s, None, timing))
        spent_s += time.perf_counter() - began
    truth, angle, log_scale = motion_at(np.arange(1.0, frames), turn, growth)
    rows: list[list[object]] = []
    for name, updates in (("live", live), ("hindsight", list(history.smooth().updates))):
        later = updates[1:]
        error = np.array([u.drift_m for u in later]) - truth
        sigma = np.sqrt([np.diag(u.covariance)[:2] for u in later])
        turned = np.array([u.similarity[:2] for u in later]) - np.stack([angle, log_scale], axis=1)
        of_turn = np.sqrt([np.diag(u.similarity_covariance)[:2] for u in later])
        ratios = [rms(error / sigma), *rms(turned / of_turn, axis=0)]
        refused = sum(not u.accepted for u in updates)
        figures = [rms(error), *(1e6 * rms(turned, axis=0)), *ratios, 1e3 * spent_s / frames]
        rows.append([motion, kind, name, refused, *(f"{v:.3g}" for v in figures)])
    return rows


def rms(values: Array, axis: int | None = None) -> Array:
    """Root mean square."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=axis)))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--frames", type=int, default=76)
    given = parser.parse_args()
    rows = [
        row
        for motion in MOTIONS
        for kind in SCENES
        for seed in range(given.seeds)
        for row in measure(kind, motion, given.size, given.frames, seed)
    ]
    heads = "motion scene estimate refused drift_px rotation_urad scale_ppm"
    title = f"{given.frames} frames of {given.size} px that drift and turn"
    show(title, [*heads.split(), "drift/sigma", "rotation/sigma", "scale/sigma", "ms"], rows)


if __name__ == "__main__":
    main()
