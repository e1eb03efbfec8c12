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

"""A frame as it was scanned, and corrected for what moved during the scan.

A specimen that drifts while a frame is scanned line by line is sheared and stretched in it, as by
the rolling shutter of a camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import RESAMPLED_TYPES, AnyImage, Array, Mask, check_image
from semcal_ros.core.caches import LruCache
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.thresholds import (
    CUBIC_REACH_PX,
    EDGE_POINTS,
    FIXED_PART_MAX,
    NEGLIGIBLE_PX,
    REGIONS,
    SAMPLES,
    SHRINKS_MAX,
)
from semcal_ros.core.rectification.raw_positions import (
    RasterDrift,
    camera_key,
    raw_from_output,
    rotation_centre,
    similarity_matrix,
)
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.registration.reference import Region


@dataclass(frozen=True)
class ScanFrame:
    """A frame as it was scanned.

    Attributes
    ----------
    image
        The image.
    camera
        Its camera at the image's size, or None.
    timing
        Its raster timing, or None for an instant.
    rectified
        Whether the image already is in the camera's rectified pixels.
    fixed
        (h, w) True at pixels that do not show the specimen, and are filled from around; None where all do.
    """

    image: AnyImage
    camera: ScanCamera | None
    timing: ScanTiming | None
    rectified: bool = False
    fixed: Mask | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.image.shape[1], self.image.shape[0]

    @property
    def sample(self) -> bytes:
        """Some of its pixels, by which an image that comes again is recognised."""
        rows, cols = (max(1, n // SAMPLES) for n in self.image.shape[:2])
        return np.ascontiguousarray(self.image[::rows, ::cols]).tobytes()

    @property
    def px_from_unit(self) -> Array:
        """(2, 2) rectified px per unit of the drift: per m with a camera, per px without."""
        return np.eye(2) if self.camera is None else self.camera.rectified.ideal_from_sem_jacobian

    @property
    def field_height(self) -> float:
        """Height of the field in units of the drift."""
        return float(self.size[1] / np.sqrt(abs(np.linalg.det(self.px_from_unit))))

    @property
    def acquisition_time_s(self) -> float:
        """Time that it took, s."""
        return 0.0 if self.timing is None else self.timing.acquisition_time_s

    @property
    def acceleration_term_s2(self) -> float:
        """Distance of the mean of an accelerated drift over the frame from the drift at its middle,
        per unit of acceleration: the mean of t^2 / 2.
        """
        return self.acquisition_time_s**2 / 24.0


class MotionCorrector:
    """Makes frames in rectified pixels as if they had been scanned in the instant of their centre.

    Parameters
    ----------
    interpolation
        Interpolation of the rectification.
    """

    def __init__(self, interpolation: str) -> None:
        self._rectifier = Rectifier(interpolation)
        self._turning = Rectifier("lanczos4")
        self._regions: LruCache[tuple[object, ...], Region] = LruCache(REGIONS)

    def corrected_image(
        self,
        frame: ScanFrame,
        motion: Array,
        turn: Array | None = None,
        turn_rate: Array | None = None,
    ) -> tuple[AnyImage, Region]:
        """The image without a motion, and the rectangle of it that was scanned.

        Parameters
        ----------
        frame
            The frame.
        motion
            (4,) drift velocity (unit per s) and acceleration (unit per s^2).
        turn, turn_rate
            (2,) rotation and scale (:mod:`semcal_ros.core.drift.similarity`) and their rates to take out;
            None for none. The motion is then that in the axes of the first frame.
        """
        width, height = frame.size
        camera = None if frame.rectified else frame.camera
        displaced = _max_displacement_px(frame, motion)
        if turn is not None and not np.any(turn):
            turn = None
        if turn is not None:
            displaced = displaced + float(np.hypot(*turn)) * 0.5 * float(np.hypot(width, height))
        drift = None
        if float(np.max(displaced)) > NEGLIGIBLE_PX:
            # The rectifier takes px where it is given no camera.
            unit = np.eye(2) if camera is not None else frame.px_from_unit
            drift = RasterDrift(np.zeros(2), unit @ motion[:2], unit @ motion[2:])
            if turn is not None:
                drift = _turned(frame, drift, turn, turn_rate)
        if camera is None and drift is None:
            return frame.image, (0, 0, width, height)
        left, top, right, bottom = self._regions.get_or_compute(
            camera_key(frame.size, camera), lambda: _find_scanned_region(frame.size, camera)
        )
        if drift is not None:
            x, y = (int(np.ceil(d)) for d in displaced)
            left, right = min(left + x, width // 3), max(right - x, 2 * width // 3, 1)
            top, bottom = min(top + y, height // 3), max(bottom - y, 2 * height // 3, 1)
        region = left, top, right, bottom
        if turn is not None:
            # A rotation moves most pixels by a fraction of one: cubic interpolation would falsify it by a
            # tenth on fine textures, and rounding to grey levels would undo it on coarse ones.
            raw = frame.image.astype(np.float32)
            return self._turning.rectify(raw, camera, drift, frame.timing), region
        image = self._rectifier.rectify(frame.image, camera, drift, frame.timing)
        return image, region

    def corrected_mask(
        self,
        frame: ScanFrame,
        motion: Array,
        turn: Array | None = None,
        turn_rate: Array | None = None,
    ) -> Mask | None:
        """The pixels of the corrected image that do not show the specimen, not even in part; arguments as for
        :meth:`corrected_image`. None where all do.
        """
        if frame.fixed is None:
            return None
        if not self._resamples(frame, motion, turn):
            return frame.fixed
        drawn = replace(frame, image=np.where(frame.fixed, np.float32(1.0), np.float32(0.0)))
        image, _ = self.corrected_image(drawn, motion, turn, turn_rate)
        return np.asarray(np.asarray(image, dtype=np.float32) > FIXED_PART_MAX)

    @staticmethod
    def _resamples(frame: ScanFrame, motion: Array, turn: Array | None) -> bool:
        """Whether a corrected image is another one than that of the frame."""
        is_raw = frame.camera is not None and not frame.rectified
        is_turned = turn is not None and bool(np.any(turn))
        return (
            is_raw
            or is_turned
            or float(np.max(_max_displacement_px(frame, motion))) > NEGLIGIBLE_PX
        )


def _turned(
    frame: ScanFrame, drift: RasterDrift, turn: Array, turn_rate: Array | None
) -> RasterDrift:
    """The drift of a specimen that turns about the origin of the sem frame."""
    matrix = similarity_matrix(turn)
    position = drift.position
    if frame.rectified and frame.camera is not None:
        # The rectifier, which is given no camera, turns about the middle of the image.
        off_centre = rotation_centre(frame.size, frame.camera) - rotation_centre(frame.size, None)
        position = off_centre - matrix @ off_centre
    rate = np.zeros(2) if turn_rate is None else turn_rate
    return RasterDrift(position, matrix @ drift.velocity, matrix @ drift.acceleration, turn, rate)


def _max_displacement_px(frame: ScanFrame, motion: Array) -> Array:
    """(2,) by how much a motion displaces pixels of a frame at most."""
    half_s = 0.5 * frame.acquisition_time_s
    displaced = np.abs(frame.px_from_unit @ motion[:2]) * half_s
    return displaced + np.abs(frame.px_from_unit @ motion[2:]) * 0.5 * half_s**2


def _find_scanned_region(size: tuple[int, int], camera: ScanCamera | None) -> Region:
    """Rectangle of output pixels that all come from inside the raw frame."""
    width, height = size
    left, top, right, bottom = 0, 0, width, height
    for _ in range(SHRINKS_MAX):
        x, y = (
            np.linspace(left, right - 1, EDGE_POINTS),
            np.linspace(top, bottom - 1, EDGE_POINTS),
        )
        edges = [
            np.stack([np.full(EDGE_POINTS, float(left)), y], axis=1),
            np.stack([x, np.full(EDGE_POINTS, float(top))], axis=1),
            np.stack([np.full(EDGE_POINTS, right - 1.0), y], axis=1),
            np.stack([x, np.full(EDGE_POINTS, bottom - 1.0)], axis=1),
        ]
        raw = [raw_from_output(edge, size, camera, None, None) for edge in edges]
        # A hole in the distortion counts as far outside.
        lacking = [
            CUBIC_REACH_PX - np.nan_to_num(raw[0][:, 0], nan=-width / 8).min(),
            CUBIC_REACH_PX - np.nan_to_num(raw[1][:, 1], nan=-height / 8).min(),
            np.nan_to_num(raw[2][:, 0], nan=1.125 * width).max() - (width - 1.0 - CUBIC_REACH_PX),
            np.nan_to_num(raw[3][:, 1], nan=1.125 * height).max() - (height - 1.0 - CUBIC_REACH_PX),
        ]
        steps = [int(np.ceil(max(v, 0.0))) for v in lacking]
        left, top = min(left + steps[0], width // 3), min(top + steps[1], height // 3)
        right, bottom = (
            max(right - steps[2], 2 * width // 3, 1),
            max(bottom - steps[3], 2 * height // 3, 1),
        )
        if not any(steps):
            break
    return left, top, right, bottom


def resampleable(image: AnyImage) -> AnyImage:
    """The image in a type that can be resampled.

    Raises
    ------
    InvalidValueError
        If it is not an image.
    """
    pixels = check_image(image)
    if pixels.dtype.name in RESAMPLED_TYPES:
        return pixels
    # What a float of 32 bits cannot hold becomes infinite, and is refused as that.
    with np.errstate(over="ignore"):
        return pixels.astype(np.float32)
