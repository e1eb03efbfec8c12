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

"""Balls of other looks, one for every seed, and bodies that are no balls; small frames, the true camera.

Texture, grains, limb, detector, charging, substrate, tip and turn axes are drawn by the seed, and so is the height
of the ball: with the 1-sigma that its interval assumes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from semcal_ros.applications.reconstruction import SequenceTracker, measure_ball, reconstruct
from semcal_ros.core.errors import StructureError
from semcal_ros.synthetic.drift import Drift, drift_preset
from semcal_ros.synthetic.specimens.ball import draw_ball_plan

# Two pixel sizes: 138 and 112 px across the ball.
PIXELS_M = (6.5e-9, 8e-9)
FRAMES = (100, 180, 330, 600, 1100, 2000)
# The field has just room for the ball and its movement: a longer recording drifts as far as one of this many frames.
DRIFTING_FRAMES = 100
# As many as the tracker finds in 100 frames or more; the time grows with their number.
MOST_KEYFRAMES = 60
# 3 % longer across the beam, and a tenth of the radius high: to be told from a ball.
OTHER_BODIES: dict[str, dict[str, Any]] = {
    "ellipsoid 3 %": {"stretch": (1.0, 1.03, 1.0)},
    "bump 45 nm": {"bump_m": 45e-9, "bump_towards": (0.1, 0.3, -1.0)},
}


@dataclass(frozen=True)
class Look:
    """What came out for one seed; errors in per cent of the diameter."""

    seed: int
    frames: int
    body: str
    texture: str
    grain_nm: float
    points: int
    error_percent: float
    sigma_percent: float
    held: bool
    is_ball: bool
    departure: str


def slow_down(drift: Drift, factor: float) -> Drift:
    """The drift with its velocity times a factor below 1: a long recording then goes no farther than a short one."""
    x_m_s, y_m_s = (v * min(1.0, factor) for v in drift.velocity_m_s)
    return replace(drift, velocity_m_s=(x_m_s, y_m_s))


def reconstruct_look(seed: int, body: str = "ball") -> Look | str:
    """Reconstruct one recording with the true camera; the reason if that fails."""
    frames, pixel_m = FRAMES[seed % len(FRAMES)], PIXELS_M[seed % len(PIXELS_M)]
    given = OTHER_BODIES.get(body, {})
    drift = slow_down(drift_preset("slow"), DRIFTING_FRAMES / frames)
    plan = draw_ball_plan(seed, frames=frames, pixel_m=pixel_m, drift=drift, **given)
    tracker = SequenceTracker()
    for index, frame in enumerate(plan.frames):
        camera = plan.microscope.camera_at(frame.magnification)
        tracker.add(plan.render(index), camera, frame.start_time_s)
    keyframes = tracker.finish()
    if len(keyframes) > MOST_KEYFRAMES:
        chosen = np.linspace(0, len(keyframes) - 1, MOST_KEYFRAMES).round().astype(int)
        keyframes = [keyframes[int(k)] for k in chosen]
    try:
        found = measure_ball(reconstruct(keyframes, plan.microscope.timing))
    except StructureError as reason:
        return f"seed {seed}, {body}: {reason}"
    true = plan.specimen.diameter_m
    low, high = found.interval_m
    round_ = found.roundness
    name = plan.specimen.texture_name
    return Look(
        seed, frames, body, name, 1e9 * plan.specimen.grain_m * (4.0 if name == "noise" else 1.0),
        int(np.count_nonzero(found.sphere.inliers)), 100.0 * (found.diameter_m / true - 1.0),
        100.0 * found.sigma_m / true, low <= true <= high, round_.is_ball,
        f"{round_.kind} {1e9 * round_.height_m:+.1f} +- {1e9 * round_.height_sigma_m:.1f} nm",
    )  # fmt: skip


def compare_looks(seeds: int, first: int = 0) -> dict[str, Any]:
    """Reconstruct a ball for every seed from the first, and both other bodies for every fifth; print and summarise."""
    made, failed = [], []
    for seed in range(first, first + seeds):
        for body in ("ball", *(OTHER_BODIES if seed % 5 == 0 else ())):
            look = reconstruct_look(seed, body)
            if isinstance(look, str):
                failed.append(look)
                print(look, flush=True)
                continue
            made.append(look)
            print(
                f"seed {seed:2d}  {look.frames:4d} frames  {body:13}  {look.texture:8} {look.grain_nm:3.0f} nm  "
                f"{look.points:4d} points  {look.error_percent:+.2f} +- {look.sigma_percent:.2f} %  "
                f"{'held' if look.held else 'NOT HELD'}  {'ball' if look.is_ball else 'no ball'}: "
                f"{look.departure}",
                flush=True,
            )
    balls = [look for look in made if look.body == "ball"]
    others = [look for look in made if look.body != "ball"]
    errors = np.array([look.error_percent for look in balls])
    pulls = errors / np.array([look.sigma_percent for look in balls])
    return {
        "looks": seeds,
        "looks_failed": failed,
        "looks_median_error_percent": float(np.median(errors)),
        "looks_worst_error_percent": float(errors[np.argmax(np.abs(errors))]),
        "looks_rms_error_over_sigma": float(np.sqrt(np.mean(pulls**2))),
        "looks_interval_holds_truth": float(np.mean([look.held for look in balls])),
        "looks_least_points": min(look.points for look in balls),
        "balls_said_to_be_none": sum(not look.is_ball for look in balls),
        "others_found": f"{sum(not look.is_ball for look in others)} of {len(others)}",
    }
