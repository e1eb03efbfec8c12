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

"""What makes a reconstructed ball too small, one cause at a time.

Poses, points and normals are the true ones; patches are measured in twelve frames of half a turn to and fro. The
figure is the part of the movement that the measured positions lack: the ball comes out smaller by
as much. ``python -m examples.nano_ball --only-looks --seeds 60`` reconstructs whole recordings.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import lru_cache
from typing import Any
from unittest import mock

import cv2
import numpy as np

from benchmarks.table import quick_from_command_line, show
from semcal_ros.applications.reconstruction import SequenceTracker, TrackKeyframe, patches
from semcal_ros.applications.reconstruction.appearance import (
    Shading,
    compute_log_grey,
    prepare_appearance,
)
from semcal_ros.applications.reconstruction.feature_tracks import project_to_plane
from semcal_ros.applications.reconstruction.patches import PatchSettings, PosedSurface
from semcal_ros.synthetic import Detector
from semcal_ros.synthetic.specimens.ball import (
    BallOnTip,
    BallPlan,
    Turning,
    ball_microscope,
    ball_plan,
)

RADIUS_M = 450e-9
FRAMES = 12
TEXTURES = ("noise", "spots", "speckle")
SMOOTHING_PX = PatchSettings().smoothing_px


@contextmanager
def shading_left_in() -> Iterator[None]:
    """Patches as they are, without the brightness that belongs to the slope taken out."""
    flat = Shading(np.zeros((3, 3), dtype=np.float32))
    with mock.patch.object(patches, "fit_shading", return_value=flat):
        yield


@contextmanager
def smoothed_in_the_image() -> Iterator[None]:
    """The same smoothing, but before the patches are cut out."""

    exact = compute_log_grey

    def log_grey(image: Any) -> Any:
        return cv2.GaussianBlur(exact(image), (0, 0), SMOOTHING_PX)

    def unchanged(drawn: Any, settings: PatchSettings) -> Any:
        return drawn

    with (
        mock.patch(f"{__name__}.compute_log_grey", log_grey),
        mock.patch.object(patches, "_smooth_patches", unchanged),
    ):
        yield


@contextmanager
def normalised_in_the_image() -> Iterator[None]:
    """As it was: the local mean and contrast of the image divided out instead of the shading."""

    def texture(image: Any) -> Any:
        return prepare_appearance(image, smoothing_px=SMOOTHING_PX).texture

    with (
        smoothed_in_the_image(),
        mock.patch(f"{__name__}.compute_log_grey", texture),
        shading_left_in(),
    ):
        yield


@contextmanager
def cut_by_an_affine_map() -> Iterator[None]:
    """Patches that are turned and foreshortened, but not bent with the surface."""
    exact = patches._cut_patches

    def flat(*given: Any) -> Any:
        cut = exact(*given)
        return replace(cut, bend=np.zeros_like(cut.bend))

    with mock.patch.object(patches, "_cut_patches", flat):
        yield


@contextmanager
def both() -> Iterator[None]:
    with shading_left_in(), smoothed_in_the_image():
        yield


@lru_cache(maxsize=20)
def record(
    seed: int,
    grain_m: float = 30e-9,
    pixel_m: float = 6.5e-9,
    mount_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
    electrons: float = 300.0,
    **body: Any,
) -> tuple[BallPlan, list[Any]]:
    """Plan and images; most cases differ only in how they are measured."""
    texture = TEXTURES[seed % len(TEXTURES)]
    specimen = BallOnTip(
        grain_m=grain_m / 4.0 if texture == "noise" else grain_m,
        texture_name=texture, tip_length_m=0.0, contrast=0.2, seed=seed,
    )  # fmt: skip
    specimen = replace(specimen, **body)
    side = 16 * int(np.ceil(1.2e-6 / pixel_m / 16.0))
    microscope = ball_microscope(width=side, height=side)
    magnification = microscope.display_width_m / side / pixel_m
    still = (0.0, 0.0, 0.0)
    motion = Turning(
        2.0 * FRAMES, rolls=1.0, yaws=0.5, roll_rad=0.6, yaw_rad=0.2, travel_m=still,
        centre_m=still, mount_rad=mount_rad,
    )  # fmt: skip
    plan = ball_plan(
        microscope, frames=FRAMES, interval_s=1.0, magnifications=(magnification,),
        specimen=specimen, motion=motion, detector=Detector(electrons=electrons), seed=seed,
    )  # fmt: skip
    return plan, [plan.render(k) for k in range(FRAMES)]


def missing_percent(
    seed: int,
    *,
    half_px: int = 7,
    slopes_deg: tuple[float, float] = (0.0, 58.0),
    scale: float = 1.0,
    at_features: bool = False,
    **scene: Any,
) -> float:
    """Part of the movement that patches of a random texture lack, per cent.

    Points are drawn at random; ``at_features`` takes those that the tracker chooses in the middle frame instead.
    """
    plan, images = record(seed, **scene)
    microscope = plan.microscope
    camera = microscope.camera_at(plan.frames[0].magnification)
    times = np.array([f.start_time_s for f in plan.frames])
    rotations, places = plan.pose_at(times + microscope.timing.centre_offset_s)
    none = (np.empty(0, dtype=np.intp), np.empty((0, 2)), np.zeros((2, 3)))
    frames = [TrackKeyframe(k, t, images[k], camera, *none) for k, t in enumerate(times)]
    rng = np.random.default_rng(seed)
    if at_features:
        middle = FRAMES // 2
        out = look_for_features(images[middle], frames[middle], rotations[middle], places[middle])
        rng.shuffle(out)
    else:
        out = rng.normal(size=(3000, 3))
        out /= np.linalg.norm(out, axis=1)[:, None]
    slope = np.degrees(np.arccos(np.clip(-out @ rotations[FRAMES // 2, 2], -1.0, 1.0)))
    out = out[(slope >= slopes_deg[0]) & (slope <= slopes_deg[1])][:150]
    posed = PosedSurface(
        rotations, places, RADIUS_M * out, out, np.full(len(out), 1.0 / RADIUS_M)
    )  # fmt: skip
    log_greys = [compute_log_grey(image) for image in images]
    settings = PatchSettings(half_px=half_px)
    seen = patches.measure_patches(frames, log_greys, microscope.timing, posed, settings)
    sem = RADIUS_M * out @ np.swapaxes(rotations, 1, 2) + places[:, None]
    true = camera.project_ideal(sem.reshape(-1, 3)).reshape(FRAMES, -1, 2)[seen.view, seen.point]
    moved, error = true.copy(), scale * seen.xy - true
    for values in (moved, error):
        for point in np.unique(seen.point):
            values[seen.point == point] -= values[seen.point == point].mean(axis=0)
    return float(100.0 * np.sum(moved * error) / np.sum(moved**2))


def look_for_features(image: Any, frame: TrackKeyframe, rotation: Any, place: Any) -> Any:
    """Directions (n, 3) from the centre of the body to the features of an image."""
    tracker = SequenceTracker()
    tracker.add(image, frame.camera, 0.0)
    seen = project_to_plane(frame.camera, tracker.keyframes[0].xy) - place[:2]
    across = seen / RADIUS_M
    across = across[np.linalg.norm(across, axis=1) < 0.99]
    # The field is narrow: the beam is parallel to 1e-5.
    depth = -np.sqrt(1.0 - np.sum(across**2, axis=1))
    return np.column_stack([across, depth]) @ rotation


CASES: dict[str, tuple[dict[str, Any], Callable[[], Any]]] = {
    "as it is": ({}, nullcontext),
    "local mean and contrast divided out": ({}, normalised_in_the_image),
    "the same within 35 deg of the beam": ({"slopes_deg": (0.0, 35.0)}, normalised_in_the_image),
    "the same beyond 35 deg": ({"slopes_deg": (35.0, 58.0)}, normalised_in_the_image),
    "shading left in": ({}, shading_left_in),
    "smoothed in the image": ({}, smoothed_in_the_image),
    "both of these": ({}, both),
    "patches of 11 px (15)": ({"half_px": 5}, nullcontext),
    "patches of 21 px": ({"half_px": 10}, nullcontext),
    "points within 35 deg of the beam": ({"slopes_deg": (0.0, 35.0)}, nullcontext),
    "points beyond 35 deg": ({"slopes_deg": (35.0, 58.0)}, nullcontext),
    "patches cut by an affine map alone": ({}, cut_by_an_affine_map),
    "points that the tracker chooses": ({"at_features": True}, nullcontext),
    "calibration 0.1 % too large": ({"scale": 1.001}, nullcontext),
    "both, grains of 60 nm": ({"grain_m": 60e-9}, both),
    "local mean divided out, 60 nm": ({"grain_m": 60e-9}, normalised_in_the_image),
    "grains of 60 nm": ({"grain_m": 60e-9}, nullcontext),
    "both, without a limb": ({"slope_power": 0.0}, both),
    "no limb": ({"slope_power": 0.0}, nullcontext),
    "axis along y": ({"mount_rad": (0.0, 0.0, np.pi / 2.0)}, nullcontext),
    "strong limb": ({"slope_power": 1.3, "least_cosine": 0.04}, nullcontext),
    "60 electrons (300)": ({"electrons": 60.0}, nullcontext),
    "grains of 18 nm": ({"grain_m": 18e-9}, nullcontext),
    "11 nm per px (6.5)": ({"pixel_m": 11e-9, "grain_m": 45e-9}, nullcontext),
    "axis tilted by 25 deg": ({"mount_rad": (0.0, 0.44, 0.8)}, nullcontext),
    "detector on one side": ({"detector_side": (0.3, 0.15)}, nullcontext),
    "charging": ({"charging": 0.3}, nullcontext),
}


def main() -> None:
    seeds = 4 if quick_from_command_line(__doc__) else 20
    rows: list[list[object]] = []
    for name, (given, changed) in CASES.items():
        with changed():
            values = np.array([missing_percent(seed, **given) for seed in range(seeds)])
        error = float(values.std(ddof=1) / np.sqrt(seeds))
        print(f"{name}: {values.mean():+.3f} +- {error:.3f} %", flush=True)
        rows.append(
            [name, float(values.mean()), error, float(np.median(values)), float(values.min())]
        )
    show(
        f"Movement of patches relative to that of the specimen, {seeds} seeds",
        ["one thing changed", "mean %", "+-", "median %", "lowest %"],
        rows,
        "negative: the ball comes out too small by as much",
    )


if __name__ == "__main__":
    main()
