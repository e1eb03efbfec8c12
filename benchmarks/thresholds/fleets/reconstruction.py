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

"""Small recordings of balls that turn, drawn by the simulator, and heights from tilted pictures of rough surfaces.

Errors of balls are those of the diameter, in nm; those of heights are of all pixels, in nm, without their median. The
surfaces are ray-cast here. The rest is what must be refused.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from benchmarks.thresholds.answers import Answer, digest_of, refusal
from semcal_ros.applications.reconstruction import (
    Ball,
    SequenceTracker,
    Structure,
    TrackerSettings,
    measure_ball,
    reconstruct,
)
from semcal_ros.applications.reconstruction.tilt_series import measure_heights
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import SemcalError
from semcal_ros.synthetic import Detector
from semcal_ros.synthetic.specimens.ball import (
    BallOnTip,
    BallPlan,
    Turning,
    ball_microscope,
    ball_plan,
    draw_ball_plan,
)

Floats = NDArray[np.float64]

DIAMETER_M = 900e-9
# The pixel size of 2048 px at 9000x, in a smaller picture.
SCOPE = replace(ball_microscope(width=512, height=192), name="small")
# Of the simulator: balls that are measured, and recordings that tell too little.
DRAWN, POOR, DRAWN_FRAMES, DRAWN_PIXEL_M = (0, 2, 6, 8, 9, 11), (3, 5), 32, 10e-9
TEXTURES = range(4)
SIDE, PIXEL_M, AXIS_RAD = 200, 50e-9, np.radians(12.0)
TILTS_RAD, TILT_SIGMA_RAD = tuple(np.radians((-7.0, 0.0, 7.0)).tolist()), 1e-4
WRONG_SIGMAS = 4.0


@dataclass(frozen=True)
class Recording:
    """Pictures of a ball with their cameras and times."""

    images: tuple[Any, ...]
    cameras: tuple[ScanCamera, ...]
    times_s: tuple[float, ...]
    timing: ScanTiming


@dataclass(frozen=True)
class BallCase:
    """Recordings of balls of one kind."""

    recordings: tuple[Recording, ...]


@dataclass(frozen=True)
class HeightCase:
    """Tilted pictures, and the height that each pixel of the reference sees, m."""

    images: tuple[Any, ...]
    tilts_rad: tuple[float, ...]
    height_m: Floats
    axis_rad: float = 0.0


def draw() -> dict[str, Any]:
    """Draw the pictures."""
    turning = Turning(
        60.0,
        rolls=1.0,
        yaws=1.0,
        roll_rad=0.5,
        travel_m=(1e-7, 5e-8, 0.0),
        centre_m=(-2e-7, 0.0, 0.0),
    )
    plain = [
        ball_plan(
            SCOPE,
            frames=20,
            interval_s=3.0,
            magnifications=(36000.0, 36400.0, 36800.0),
            specimen=BallOnTip(seed=seed),
            motion=turning,
            detector=Detector(electrons=400.0),
        )
        for seed in TEXTURES
    ]
    noisy = [replace(plan, detector=Detector(electrons=100.0)) for plan in plain]
    still = Turning(10.0, roll_rad=0.0, yaw_rad=0.0, travel_m=(0, 0, 0), centre_m=(-2e-7, 0, 0))
    cases: dict[str, Any] = {
        "balls": _record(plain),
        "noisy balls": _record(noisy),
        "a still ball": _record(
            [ball_plan(SCOPE, frames=4, magnifications=(36000.0,), motion=still)]
        ),
    }
    for name, seeds in (("drawn balls", DRAWN), ("poor recordings", POOR)):
        drawn = [draw_ball_plan(s, frames=DRAWN_FRAMES, pixel_m=DRAWN_PIXEL_M) for s in seeds]
        cases[name] = _record(drawn)
    relief = _tilt(1, 6.0, TILTS_RAD, ((3.3, -5.1), (0.0, 0.0), (-2.2, 4.7)))
    cases["relief"] = relief
    pair = _tilt(1, 6.0, TILTS_RAD[1:], ((0.0, 0.0), (-2.2, 4.7)))
    cases["pair"] = pair
    cases["steep relief"] = _tilt(2, 14.0, TILTS_RAD, ((0.0, 0.0),) * 3)
    cases["noisy relief"] = _tilt(1, 6.0, TILTS_RAD, ((0.0, 0.0),) * 3, noise=15.0)
    cases["dusty relief"] = replace(relief, images=tuple(_with_dust(i) for i in relief.images))
    cases["little overlap"] = _tilt(1, 6.0, TILTS_RAD[1:], ((0.0, 0.0), (150.0, 0.0)))
    cases["hardly any overlap"] = _tilt(1, 6.0, TILTS_RAD[1:], ((0.0, 0.0), (175.0, 0.0)))
    cases["flat"] = _tilt(3, 0.0, TILTS_RAD[1:], ((0.0, 0.0), (1.0, 2.0)))
    other = _tilt(9, 6.0, TILTS_RAD[1:], ((0.0, 0.0), (0.0, 0.0))).images[1]
    cases["other specimen"] = replace(pair, images=(pair.images[0], other))
    cases["other axis"] = replace(pair, axis_rad=0.5 * np.pi)
    cases["steps too small"] = replace(pair, tilts_rad=(0.0, np.radians(0.3)))
    return cases


def _record(plans: Sequence[BallPlan]) -> BallCase:
    return BallCase(
        tuple(
            Recording(
                tuple(plan.render(k) for k in range(len(plan.frames))),
                tuple(plan.microscope.camera_at(frame.magnification) for frame in plan.frames),
                tuple(frame.start_time_s for frame in plan.frames),
                plan.microscope.timing,
            )
            for plan in plans
        )
    )


def _with_dust(image: Any) -> Any:
    """The same with grains at other places than in the other pictures."""
    rng, out = np.random.default_rng(int(image.sum()) % 1000), image.copy()
    for x, y in rng.uniform(0.0, SIDE, (25, 2)):
        cv2.circle(out, (int(x), int(y)), int(rng.integers(2, 5)), 250, -1)
    return out


class RoughSurface:
    """A rough surface z(x, y) on a grid of pixels, with a texture that is painted on it.

    By splines: OpenCV's cubic kernel shifts what it shows by up to 0.05 px, which follows the relief as parallax does.
    """

    def __init__(self, rng: np.random.Generator, side: int, rms_px: float = 6.0) -> None:
        self.side = side
        self.height = spline_filter(rms_px * _smooth(rng, 22.0, side + 120))
        texture = np.sum([_smooth(rng, s, side + 120) for s in (1.2, 2.5, 6.0)], axis=0)
        self.texture = spline_filter(texture)

    def _look_up(self, of: Floats, x: Floats, y: Floats) -> Floats:
        at = [part + 0.5 * (self.side + 119) for part in (y, x)]
        return np.asarray(map_coordinates(of, at, order=3, prefilter=False, mode="nearest"))

    def look(
        self, tilt_rad: float, shift_px: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[Floats, Floats]:
        """Grey levels, without noise, and heights in px: each ray is followed to where it hits."""
        rows, columns = np.indices((self.side, self.side), dtype=np.float64)
        x, y = (
            part - 0.5 * (self.side - 1) - s
            for part, s in zip((columns, rows), shift_px, strict=True)
        )
        c, s = np.cos(AXIS_RAD), np.sin(AXIS_RAD)
        u, v = c * x + s * y, c * y - s * x
        height = np.zeros_like(u)
        # Slopes of a half times the tilt: each step leaves a sixteenth of the error.
        for _ in range(10):
            across = (v - height * np.sin(tilt_rad)) / np.cos(tilt_rad)
            height = self._look_up(self.height, c * u - s * across, s * u + c * across)
        grey = 120.0 + 25.0 * self._look_up(self.texture, c * u - s * across, s * u + c * across)
        return grey, height


def expose(grey: Floats, rng: np.random.Generator, noise: float = 3.0) -> NDArray[np.uint8]:
    """Bytes with noise."""
    return np.clip(np.rint(grey + rng.normal(0.0, noise, grey.shape)), 0, 255).astype(np.uint8)


def _tilt(
    seed: int,
    rms_px: float,
    tilts_rad: tuple[float, ...],
    shifts_px: tuple[tuple[float, float], ...],
    noise: float = 3.0,
) -> HeightCase:
    """Pictures of a surface, tilted and shifted; the reference is the middle one of three, or that tilted less."""
    surface = RoughSurface(np.random.default_rng([seed, 12]), SIDE, rms_px)
    rng = np.random.default_rng([seed, 13])
    seen = [surface.look(t, s) for t, s in zip(tilts_rad, shifts_px, strict=True)]
    images = tuple(expose(grey, rng, noise) for grey, _ in seen)
    reference = 1 if len(seen) == 3 else int(np.argmin(np.abs(tilts_rad)))
    return HeightCase(images, tilts_rad, PIXEL_M * seen[reference][1])


def _smooth(rng: np.random.Generator, sigma_px: float, side: int) -> Floats:
    field = cv2.GaussianBlur(rng.standard_normal((side, side)), (0, 0), sigma_px)
    return np.asarray(field / field.std())


def run(case: BallCase | HeightCase) -> Answer:
    """Reconstruct balls, or measure heights."""
    start = time.process_time()
    if isinstance(case, BallCase):
        return _balls(case, start)
    try:
        return _heights(case, start)
    except SemcalError as error:
        return refusal(error, time.process_time() - start)


def _balls(case: BallCase, start: float) -> Answer:
    found: list[tuple[Structure, Ball]] = []
    said = ""
    for recording in case.recordings:
        with_times = zip(recording.images, recording.cameras, recording.times_s, strict=True)
        tracker = SequenceTracker(TrackerSettings(spacing_px=8.0))
        for image, camera, at in with_times:
            tracker.add(image, camera, at)
        try:
            structure = reconstruct(tracker.finish(), recording.timing)
            found.append((structure, measure_ball(structure)))
        except SemcalError as error:
            said += str(error)
    seconds = time.process_time() - start
    round_ones = sum(ball.roundness.is_ball for _, ball in found)
    decision = f"{len(found)} of {len(case.recordings)} measured, {round_ones} of them balls"
    measured = np.array([(1e9 * ball.diameter_m, 1e9 * ball.sigma_m) for _, ball in found])
    bits = digest_of(measured, said, *(structure.points_m for structure, _ in found))
    if not found:
        return Answer(decision, digest=bits, seconds=seconds)
    error = np.abs(measured[:, 0] - 1e9 * DIAMETER_M)
    score = error / measured[:, 1]
    return Answer(
        decision,
        sum(len(structure.points_m) for structure, _ in found),
        float(np.sqrt(np.mean(error**2))),
        float(error.max()),
        float(np.sqrt(np.mean(score**2))),
        int(np.sum(score > WRONG_SIGMAS)),
        bits,
        seconds,
    )


def _heights(case: HeightCase, start: float) -> Answer:
    found = measure_heights(
        case.images,
        case.tilts_rad,
        PIXEL_M,
        tilt_sigma_rad=TILT_SIGMA_RAD,
        axis_rad=case.axis_rad,
    )
    seconds = time.process_time() - start
    error = 1e9 * (found.height_m - case.height_m)
    known = np.isfinite(error)
    error = error[known] - np.median(error[known])
    ratio = float(np.sqrt(np.mean((error / (1e9 * found.sigma_m[known])) ** 2)))
    return Answer(
        "heights",
        int(np.sum(known)),
        float(np.sqrt(np.mean(error**2))),
        float(np.abs(error).max()),
        ratio,
        int(ratio > WRONG_SIGMAS),
        digest_of(found.height_m[known], found.sigma_m[known]),
        seconds,
    )
