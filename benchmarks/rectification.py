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

"""Rectification beside a bare cv2.remap with two float32 maps; its map beside the exact inverse."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle

import cv2
import numpy as np

from benchmarks.table import interleaved, quick_from_command_line, show
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.synthetic import preset

TIMING = ScanTiming(1.0 / 15.0, 8, 0.1)
# The rectifier raises the degree of its polynomials until points in between agree to this.
BOUND_PX = 0.002
COLUMNS = (
    "remap",
    "distortion only",
    "fixed drift",
    "changing drift",
    "changing magnification",
    "both changing",
)


def drift_px(camera: ScanCamera, x: float, y: float, vx: float, vy: float) -> RasterDrift:
    """Drift in px and px per s of this camera's image."""
    return RasterDrift(np.array([x, y]) / camera.m, np.array([vx, vy]) / camera.m)


def map_error_px(
    maps: tuple[np.ndarray, np.ndarray], camera: ScanCamera, drift: RasterDrift | None, size: int
) -> tuple[float, float]:
    """RMS and largest error, in output px: the raw pixels of the map are undistorted and freed of
    their drift by the exact inverse, and must fall on the pixels that they belong to.
    """
    step = max(size // 512, 1)
    y, x = np.mgrid[0:size:step, 0:size:step]
    raw = np.stack([m[::step, ::step].ravel() for m in maps], axis=1).astype(np.float64)
    output = camera.rect_from_raw(raw)
    if drift is not None:
        late_s = TIMING.pixel_offset_s(raw[:, 1], raw[:, 0], size, size) - TIMING.centre_offset_s
        moved_m = drift.position + late_s[:, None] * drift.velocity
        output -= moved_m @ camera.rectified.ideal_from_sem_jacobian.T
    error = np.hypot(output[:, 0] - x.ravel(), output[:, 1] - y.ravel())
    return float(np.sqrt(np.mean(error**2))), float(error.max())


def speed_row(size: int, rounds: int) -> list[object]:
    """Time ratios at one image size."""
    rng = np.random.default_rng(0)
    microscope = preset("jsm820").with_image_size(size, size)
    camera = microscope.camera_at(2000.0)
    image = rng.integers(0, 255, (size, size), dtype=np.uint8)
    fixed = drift_px(camera, 3.3, -2.1, 0.8, -0.5)
    drifts = cycle([drift_px(camera, *rng.normal(size=4)) for _ in range(16)])
    # More magnifications than any cache keeps: each is new to it.
    cameras = cycle([microscope.camera_at(g) for g in np.geomspace(500.0, 8000.0, 97)])
    # One rectifier for each column, as in a stream of that kind.
    still, steady, live, zoom, both = (Rectifier() for _ in range(5))
    map_x, map_y = Rectifier().maps((size, size), camera)

    def both_changing() -> object:
        now = next(cameras)
        return both.rectify(image, now, drift_px(now, *rng.normal(size=4)), TIMING)

    actions = {
        "remap": lambda: cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR),
        "distortion only": lambda: still.rectify(image, camera),
        "fixed drift": lambda: steady.rectify(image, camera, fixed, TIMING),
        "changing drift": lambda: live.rectify(image, camera, next(drifts), TIMING),
        "changing magnification": lambda: zoom.rectify(image, next(cameras)),
        "both changing": both_changing,
    }
    interleaved(actions, 3)
    times = interleaved(actions, rounds)
    return [str(size), *(times[name] / times["remap"] for name in COLUMNS)]


def map_rows(size: int) -> list[list[object]]:
    """Errors of the map at one image size."""
    rows: list[list[object]] = []
    for g, xi_r in ((100.0, 0.05), (2000.0, -0.05)):
        real = preset("jsm820").with_image_size(size, size).camera_at(g)
        for name, camera in (("jsm820", real), ("strong", replace(real, xi_r=xi_r, xi_t=0.01))):
            for moving in (False, True):
                drift = drift_px(camera, 3.3, -2.1, 20.0, -12.0) if moving else None
                maps = Rectifier().maps((size, size), camera, drift, TIMING)
                errors = map_error_px(maps, camera, drift, size)
                label = f"{size} {name} {g:g}x"
                rows.append([label, "yes" if moving else "no", *errors, BOUND_PX])
    return rows


def main() -> None:
    quick = quick_from_command_line(__doc__)
    sizes = (512, 1024, 2048)
    rounds = 10 if quick else 40
    show(
        "Rectifier.rectify: time as ratio to cv2.remap with two float32 maps (mono8, linear)",
        ["size", *COLUMNS],
        [speed_row(size, rounds) for size in sizes],
        "Caches are warm. A drift has a velocity, so that every pixel moves by its own time.",
        "Changing magnification: every frame at one that is not in the cache.",
        f"Medians of {rounds} interleaved rounds.",
    )
    show(
        "Rectifier.maps: error against the exact inverse, px of the output",
        ["frame", "drift", "RMS px", "largest px", "bound px"],
        [row for size in (sizes[:1] if quick else sizes) for row in map_rows(size)],
        "Bound: what the rectifier accepts at its test points, before rounding to float32.",
        "strong: xi_r = +-0.05, xi_t = 0.01. The drift moves by 20 and -12 px/s.",
    )


if __name__ == "__main__":
    main()
