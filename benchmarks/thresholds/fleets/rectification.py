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

"""Maps from rectified to raw pixels, beside exact positions, and the phase of bidirectional scans.

A map is promised to be right to 0.002 px, with a residual field and a drift to 0.004 px: an error below that counts as
the promise itself, and one beyond is wrong in silence. Exact positions are computed once, by unchanged code. Phases are
errors in px; their pictures are scenes of ``benchmarks.drift.scenes``, a grating, stripes and noise.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.thresholds.answers import Answer, digest_of
from semcal_ros.core.camera.residual_field import ResidualField, zero_field
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.chebyshev_map import SmoothMaps
from semcal_ros.core.rectification.line_phase import LinePhaseCorrector, estimate_line_phase
from semcal_ros.core.rectification.raw_positions import RasterDrift, raw_from_output
from semcal_ros.synthetic import preset

Floats = NDArray[np.float64]

SIZE, G = (288, 216), 2000.0
TIMING = ScanTiming(2.0, averages=2, flyback_fraction=0.1)
PROMISED_PX, PROMISED_WITH_FIELD_PX = 0.002, 0.004
# Position, velocity and acceleration, in px and s.
DRIFTS = {
    "still": None,
    "slow": ((-7.3, 4.1), (0.4, -0.3), (0.0, 0.0)),
    "fast": ((31.0, -20.0), (-3.0, 5.0), (0.0, 0.0)),
    "accelerated": ((1.0, 2.0), (3.0, -2.0), (2.0, 4.0)),
}
RANDOM_SCANS = 6
PHASES_PX = {
    "gold": 2.7,
    "fractal": -6.0,
    "scratches": 0.3,
    "fibres": 1.4,
    "sparse": 0.0,
    "clouds": 0.0,
}
SEED, SIDE_PX, STREAM_FRAMES, PICTURES = 100, 192, 12, 12
WRONG_PX, WRONG_SIGMAS = 0.05, 4.0


@dataclass(frozen=True)
class MapCase:
    """Maps of a stream, one after the other, and exact raw positions (n, 2) of some pixels (n, 2) of each."""

    cameras: tuple[ScanCamera, ...]
    drifts: tuple[RasterDrift | None, ...]
    pixels: NDArray[np.intp]
    exact: tuple[Floats, ...]


@dataclass(frozen=True)
class PhaseCase:
    """Frames, and the phase of their odd lines, px; of a stream, whether it is declared to be bidirectional."""

    frames: tuple[Floats, ...]
    phase_px: float
    declared: bool | None = None


def draw() -> dict[str, Any]:
    """Compute the exact positions, and draw the pictures."""
    # Not where they are compared: each run imports what it needs.
    from benchmarks.drift import scenes

    plain = preset("pincushion").camera_at(G).resized(*SIZE)
    settling = replace(
        plain, coil_x3=-0.006, coil_y2=0.004, settling_1=-0.005, settling_2=0.012, settling_4=0.006
    )
    cases: dict[str, Any] = {}
    for name, motion in DRIFTS.items():
        drift = _drift_px(plain, motion)
        cases[f"plain, {name}"] = _expect([plain], [drift])
        cases[f"settling, {name}"] = _expect([settling], [drift])
        field = make_settling_field(SIZE, 2.0)
        cases[f"field, {name}"] = _expect([replace(plain, residual=field.at(G))], [drift])
    both = replace(settling, residual=make_settling_field(SIZE, 1.0).at(G))
    cases["settling and field"] = _expect([both], [_drift_px(plain, DRIFTS["slow"])])
    steep = replace(plain, residual=make_settling_field(SIZE, 20.0).at(G))
    cases["a steep field"] = _expect([steep], [None])
    zoom = [
        replace(
            preset("pincushion").camera_at(g).resized(*SIZE),
            residual=make_settling_field(SIZE, 2.0).at(g),
        )
        for g in (300.0, 320.0, 340.0, 2000.0, 320.0, 8000.0)
    ]
    starts = [_drift_px(plain, ((x, 0.5), (0.1 * x, 0.0), (0.0, 0.0))) for x in (0.0, 1.0, 30.0)]
    cases["zoom with a field"] = _expect(zoom, [None] * len(zoom))
    cases["a stage that starts"] = _expect([zoom[3]] * 3, starts)
    rng = np.random.default_rng(SEED)
    for number in range(RANDOM_SCANS):
        own = {n: rng.normal(0.0, 0.004 if "coil" in n else 0.003) for n in SCAN_NAMES}
        motion = rng.normal(0.0, [[10.0], [2.0], [0.5]], (3, 2))
        drift = _drift_px(plain, motion)
        cases[f"scan {number}"] = _expect([replace(plain, **own)], [drift])

    scenes.SIZE = SIDE_PX
    for name, phase in PHASES_PX.items():
        pictures = [scenes.draw(scenes.KINDS[name], SEED + k, 1)[0][0] for k in range(PICTURES)]
        shifted = tuple(shift_odd_lines(picture, phase) for picture in pictures)
        cases[f"phase of {name}"] = PhaseCase(shifted, phase)
    x = np.arange(SIDE_PX)
    grating = 100.0 + 50.0 * np.sin(2.0 * np.pi * x / 8.0) * np.ones((SIDE_PX, 1))
    for phase in (1.3, 3.0):
        lines = tuple(rng.normal(shift_odd_lines(grating, phase), 8.0) for _ in range(PICTURES))
        cases[f"phase of a grating, {phase:g}"] = PhaseCase(lines, phase)
    signs = np.sign(rng.normal(size=(PICTURES, SIDE_PX, 1)))
    stripes = tuple(rng.normal(100.0 + 40.0 * one * np.ones(SIDE_PX), 8.0) for one in signs)
    cases["phase of stripes"] = PhaseCase(stripes, 0.0)
    noise = tuple(rng.normal(100.0, 8.0, (PICTURES, SIDE_PX, SIDE_PX)))
    cases["phase of noise"] = PhaseCase(noise, 0.0)
    gold, _, _ = scenes.draw(scenes.KINDS["gold"], SEED, STREAM_FRAMES)
    for declared in (True, False):
        stream = tuple(shift_odd_lines(frame, 3.4) for frame in gold)
        name = "declared" if declared else "not declared"
        cases[f"stream, {name}"] = PhaseCase(stream, 3.4, declared)
    return cases


def _drift_px(camera: ScanCamera, motion: Any) -> RasterDrift | None:
    return None if motion is None else RasterDrift(*(np.array(v) / camera.m for v in motion))


def make_settling_field(size: tuple[int, int], strength_px: float) -> ResidualField:
    """A beam that settles at the start of the lines, and a bend, changing with the magnification."""
    zero = zero_field(size, (100.0, 10000.0), 3)
    coefficients = zero.coefficients.copy()
    # Near enough to where each basis function has its maximum.
    x, y = (
        np.array([np.mean(knots[k + 1 : k + 4]) for k in range(len(knots) - 4)])
        for knots in (zero.knots_x, zero.knots_y)
    )
    amplitude = strength_px / (0.5 * size[0]) * np.array([1.0, 1.3, 0.6])[:, None, None]
    coefficients[..., 0] = amplitude * (np.exp(-(x + 1.0) / 0.15) + 0.5 * np.sin(3.0 * y)[:, None])
    coefficients[..., 1] = amplitude * 0.5 * np.sin(3.0 * x) * np.cos(2.0 * y)[:, None]
    return replace(zero, coefficients=coefficients)


def _expect(cameras: list[ScanCamera], drifts: list[RasterDrift | None]) -> MapCase:
    x, y = np.meshgrid(*(np.union1d(np.arange(0, n, 5), n - 1) for n in SIZE))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    exact = [
        raw_from_output(pixels.astype(np.float64), SIZE, camera, drift, TIMING)
        for camera, drift in zip(cameras, drifts, strict=True)
    ]
    return MapCase(tuple(cameras), tuple(drifts), pixels, tuple(exact))


def shift_odd_lines(image: NDArray[Any], phase_px: float) -> Floats:
    """The image with odd lines moved to the right, exactly, as a periodic one."""
    out = image.astype(np.float64)
    wave = np.exp(-2j * np.pi * np.fft.rfftfreq(image.shape[1]) * phase_px)
    out[1::2] = np.fft.irfft(np.fft.rfft(out[1::2], axis=1) * wave, image.shape[1], axis=1)
    return out


def run(case: MapCase | PhaseCase) -> Answer:
    """Make the maps of a stream, or estimate its phase."""
    return _make_maps(case) if isinstance(case, MapCase) else _estimate(case)


def _make_maps(case: MapCase) -> Answer:
    start = time.process_time()
    maps, (width, height) = SmoothMaps(), SIZE
    x, y = case.pixels.T
    found, made = [], []
    for camera, drift in zip(case.cameras, case.drifts, strict=True):
        made.append(maps.make_map(SIZE, camera, drift, TIMING))
        band = np.empty((height, 2 * width), np.float32)
        made[-1].band(0, height, band)
        found.append(np.stack([band[y, x], band[y, width + x]], axis=1).astype(np.float64))
    seconds = time.process_time() - start
    promised = PROMISED_PX if case.cameras[0].residual is None else PROMISED_WITH_FIELD_PX
    off = []
    for positions, exact in zip(found, case.exact, strict=True):
        scanned = np.all((exact > -1.0) & (exact < np.array(SIZE)), axis=1)
        off.append((positions - exact)[scanned])
    # Where the map has no position for what was scanned, it is as wrong as can be.
    error = np.abs(np.nan_to_num(np.concatenate(off), nan=1e4))
    counted = np.maximum(error, promised)
    return Answer(
        f"{sum(one.is_interpolated for one in made)} of {len(made)} interpolated",
        len(made),
        float(np.sqrt(np.mean(counted**2))),
        float(error.max()),
        wrong=int(np.any(error > promised)),
        digest=digest_of(*found),
        seconds=seconds,
    )


def _estimate(case: PhaseCase) -> Answer:
    start = time.process_time()
    if case.declared is None:
        phases = [estimate_line_phase(frame) for frame in case.frames]
        decision = f"{sum(phase.is_seen for phase in phases)} of {len(phases)} seen"
    else:
        lines = LinePhaseCorrector(case.declared)
        moved = sum(lines.correct(frame) is not frame for frame in case.frames)
        phases = [lines.phase] if case.declared else []
        # The note has numbers.
        note = " ".join(word for word in lines.note.split() if word.isalpha())
        decision = f"{moved} of {len(case.frames)} moved, {note[:60]}"
    seconds = time.process_time() - start
    found = np.array([(phase.shift_px, phase.sigma_px, phase.is_seen) for phase in phases])
    known = found[np.isfinite(found[:, 1])] if len(found) else np.zeros((0, 3))
    if not len(known):
        return Answer(decision, digest=digest_of(found), seconds=seconds)
    error = np.abs(known[:, 0] - case.phase_px)
    score = error / known[:, 1]
    wrong = (known[:, 2] > 0.0) & (error > WRONG_PX) & (score > WRONG_SIGMAS)
    return Answer(
        decision,
        len(known),
        float(np.sqrt(np.mean(error**2))),
        float(error.max()),
        float(np.sqrt(np.mean(score**2))),
        int(wrong.sum()),
        digest_of(found),
        seconds,
    )
