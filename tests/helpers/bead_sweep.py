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

"""A recording in which the magnification rises while a bead moves over a specimen that is still, with the truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import Array
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter

__all__ = ["SIZE", "magnifications", "make_pattern", "picture", "truth_nm", "write_sweep"]

SIZE = 256
_PERIOD_NS = 200_000_000
_START_NS = 1_700_000_000_000_000_000
# Of the coarsest grains, and the side of their pattern in grains: where the finest one repeats is out of the picture.
_GRAIN_M = 6e-6
_PATTERN = 512
_BEAD_PX = 3.0


def magnifications(frames: int, first: float, last: float) -> Array:
    """(frames,) magnifications in equal ratios."""
    return np.geomspace(first, last, frames)


def _path_m(calibration: Calibration, g: Array) -> Array:
    """(n, 2) places of the bead in the sem frame: an arc that stays in each field, about what its middle shows."""
    turn = np.linspace(0.0, 2.0, len(g))
    out = np.empty((len(g), 2))
    for k, (one, angle) in enumerate(zip(g, turn, strict=True)):
        camera = calibration.at(one).resized(SIZE, SIZE)
        middle = np.array([0.5 * (SIZE - 1)] * 2) - [camera.px, camera.py]
        reach_px = 0.25 * SIZE * np.array([np.cos(angle), np.sin(angle)])
        out[k] = np.linalg.solve(camera.ideal_from_sem_jacobian, middle + reach_px)
    return out


def make_pattern() -> Array:
    """The specimen."""
    return np.random.default_rng(3).normal(size=(_PATTERN, _PATTERN))


def picture(
    calibration: Calibration,
    g: float,
    bead_m: Array,
    pattern: Array,
    moved_m: Array | tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """The raw picture of a bead at a place of the sem frame, on a specimen that was moved by ``moved_m``."""
    camera = calibration.at(g).resized(SIZE, SIZE)
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    raw = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    ideal = camera.undistort(raw) - [camera.px, camera.py]
    specimen = np.linalg.solve(camera.ideal_from_sem_jacobian, ideal.T).T - np.asarray(moved_m)
    grey = np.zeros(len(raw))
    wrapped = np.pad(pattern, ((0, 1), (0, 1)), mode="wrap").astype(np.float32)
    # Grains of all sizes, so that there is something to see at every magnification.
    for octave in range(6):
        at = (specimen / _GRAIN_M * 2.0**octave) % _PATTERN
        column, row = (at[:, k].astype(np.float32).reshape(SIZE, SIZE) for k in (0, 1))
        grey += cv2.remap(wrapped, column, row, cv2.INTER_LINEAR).ravel()
    ideal = camera.ideal_from_sem_jacobian @ bead_m + [camera.px, camera.py]
    place = camera.distort(ideal[None])[0]
    square = np.sum((raw - place) ** 2, axis=1)
    grey = 60.0 + 8.0 * grey + 150.0 * np.exp(-0.5 * square / _BEAD_PX**2)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8).reshape(SIZE, SIZE)


def write_sweep(path: Path, calibration: Calibration, g: Array) -> None:
    """Write the recording, with one frame for each magnification."""
    pattern = make_pattern()
    with BagWriter(path) as writer:
        for index, (one, bead_m) in enumerate(zip(g, _path_m(calibration, g), strict=True)):
            stamp_ns = _START_NS + index * _PERIOD_NS
            value = blank_message("std_msgs/msg/Float64")
            value.data = float(one)
            writer.write("/sem/magnification", stamp_ns - _PERIOD_NS // 4, value)
            frame = blank_message("sensor_msgs/msg/Image")
            frame.header.stamp.sec, frame.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            frame.height = frame.width = frame.step = SIZE
            frame.encoding = "mono8"
            frame.data = picture(calibration, one, bead_m, pattern).reshape(-1)
            writer.write("/sem/image_raw", stamp_ns, frame)


def truth_nm(calibration: Calibration, g: Array) -> Array:
    """(n, 2) where the bead is from what the middle of each rectified picture shows, nm."""
    out = _path_m(calibration, g)
    for k, one in enumerate(g):
        rectified = calibration.at(one).resized(SIZE, SIZE).rectified
        middle = np.array([0.5 * (SIZE - 1)] * 2) - [rectified.px, rectified.py]
        out[k] -= np.linalg.solve(rectified.ideal_from_sem_jacobian, middle)
    return 1e9 * out
