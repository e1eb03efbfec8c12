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

"""What is left of drift inside a frame after the correction that a tracker's answer gives.

The virtual microscope takes every pixel at its own time, so a drift that moves by several px during
a frame shears and bends it. Where the corrected frame puts what a raw pixel saw is compared with
where it belongs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.rectification.raw_positions import RasterDrift, raw_from_output
from semcal_ros.synthetic import (
    Detector,
    Drift,
    GoldOnCarbon,
    Pose,
    VirtualMicroscope,
    preset,
    render_frame,
)
from semcal_ros.synthetic.drift import DriftFunction

# Steady, settling and wandering: some 10 px of 512 in a frame of 4 s at 20 000x.
STRONG_DRIFT = Drift(
    velocity_m_s=(25e-9, -14e-9), settling_m=(-300e-9, 500e-9), wander_m=60e-9, seed=3
)
SLOW_SCAN = ScanTiming(4.0, 1, 0.1)
# Points along either side of the field, its corners among them.
_POINTS = 9


@dataclass(frozen=True)
class FieldResidual:
    """Lengths of the residuals, px.

    Attributes
    ----------
    corrected
        (frames, points) with the tracker's drift and velocity.
    shifted
        (frames, points) with its drift alone: what a correction of the whole image leaves.
    statuses
        Of the tracker, one per frame.
    moved_px
        Largest way of the specimen within a frame.
    """

    corrected: Array
    shifted: Array
    statuses: tuple[str, ...]
    moved_px: float


def field_points(size: tuple[int, int]) -> Array:
    """(n, 2) raw pixels all over a frame of (width, height)."""
    x, y = np.meshgrid(*(np.linspace(0.0, pixels - 1.0, _POINTS) for pixels in size))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def drift_at_pixels(
    raw: Array, size: tuple[int, int], drift: DriftFunction, start_s: float, timing: ScanTiming
) -> Array:
    """(n, 2) true drift in m when raw pixels (n, 2) were taken, the mean over the passes."""
    first_s = start_s + timing.pixel_offset_s(raw[:, 1], raw[:, 0], size[1], size[0])
    passes = np.arange(timing.averages) - 0.5 * (timing.averages - 1)
    moved = [drift(first_s + k * timing.frame_time_s) for k in passes]
    return np.asarray(np.mean(moved, axis=0))


def field_residual_px(
    camera: ScanCamera,
    timing: ScanTiming,
    drift: DriftFunction,
    start_s: float,
    zero_m: Array,
    found: RasterDrift,
) -> Array:
    """(points,) distance in output px between where the map of ``found`` puts points all over the
    frame and where they would be at the drift ``zero_m``.
    """
    size = (camera.width, camera.height)

    def belongs(raw: Array) -> Array:
        moved_m = drift_at_pixels(raw, size, drift, start_s, timing) - zero_m
        return camera.rect_from_raw(raw) - moved_m @ camera.rectified.ideal_from_sem_jacobian.T

    # Output pixels that should show these points; the map looks for them where it believes.
    output = belongs(field_points(size))
    error = belongs(raw_from_output(output, size, camera, found, timing)) - output
    return np.asarray(np.hypot(error[:, 0], error[:, 1]))


def raster_residual(
    *,
    microscope: VirtualMicroscope | None = None,
    magnification: float = 20_000.0,
    size: int = 512,
    timing: ScanTiming = SLOW_SCAN,
    drift: DriftFunction = STRONG_DRIFT,
    frames: int = 20,
    seed: int = 0,
    detector: Detector | None = None,
    tracker: DriftTracker | None = None,
) -> FieldResidual:
    """Record gold on carbon without a pause, track it with the true camera and timing, and compare.

    The drift is counted from the centre of the first frame, as the tracker does.
    """
    chosen = preset("jsm820") if microscope is None else microscope
    chosen = chosen.with_image_size(size, size).with_timing(timing)
    camera = chosen.camera_at(magnification)
    tracker = DriftTracker() if tracker is None else tracker
    zero_m = np.asarray(drift(np.array([timing.centre_offset_s])))[0]
    corrected, shifted, statuses, ways = [], [], [], []
    for k in range(frames):
        start_s = k * timing.acquisition_time_s
        image = render_frame(
            chosen,
            GoldOnCarbon(seed),
            Pose.flat(),
            magnification,
            start_time_s=start_s,
            drift=drift,
            seed=(seed, k),
            detector=detector or Detector(),
        )
        update = tracker.update(image, start_s, camera, timing)
        statuses.append(update.status_text)
        truth = (camera, timing, drift, start_s, zero_m)
        corrected.append(field_residual_px(*truth, update.raster))
        shifted.append(field_residual_px(*truth, RasterDrift(update.drift_m, np.zeros(2))))
        ways.append(_way_px(camera, timing, drift, start_s))
    return FieldResidual(np.array(corrected), np.array(shifted), tuple(statuses), max(ways))


def _way_px(camera: ScanCamera, timing: ScanTiming, drift: DriftFunction, start_s: float) -> float:
    ends = np.asarray(drift(start_s + np.array([0.0, timing.acquisition_time_s])))
    return float(np.linalg.norm(camera.ideal_from_sem_jacobian @ (ends[1] - ends[0])))


HEADER = ["frame time, passes", "moved px", "correction", "tracked", "RMS px", "max px"]
HEADER += ["RMS, first", "RMS, from 4th", "max, from 4th"]


def rows(result: FieldResidual, label: str) -> list[list[object]]:
    """Two rows under :data:`HEADER`: with and without the velocity."""
    tracked = sum(status == "tracked" for status in result.statuses)
    told = f"{tracked} of {len(result.statuses) - 1}"
    out: list[list[object]] = []
    for name, lengths in (("raster", result.corrected), ("shift only", result.shifted)):
        parts = [_rms(lengths), float(lengths.max()), _rms(lengths[:1])]
        parts += [_rms(lengths[3:]), float(lengths[3:].max())]
        out.append([label, result.moved_px, name, told, *parts])
    return out


def _rms(lengths: Array) -> float:
    return float(np.sqrt(np.mean(lengths**2)))
