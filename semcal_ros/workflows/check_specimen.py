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

"""What any specimen tells about a calibration, without a grid: ratios of scales and isotropy."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np

from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import Array32
from semcal_ros.core.camera.scan_camera import RectifiedCamera
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.core.registration.affine import NotAlignedError, align_affine
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    ConfigSource,
    OnProgress,
    Source,
    count_frames,
    ignore_progress,
    open_source,
    require_calibration,
    resolve_config,
)

__all__ = ["ScaleRatio", "SpecimenCheck", "check_specimen"]

# Beyond so many sigmas something has changed: of ten numbers, one is beyond 3.3 by chance in a hundred checks.
_SIGMAS = 3.3
# Field widths further apart share too few pixels.
_MOST_RATIO = 4.0
# 1-sigma of the drift from the first to the last line of an image, px, which stretches and shears it.
_DRIFT_PX = 0.3


@dataclass(frozen=True)
class ScaleRatio:
    """Two magnifications of one place against each other.

    Attributes
    ----------
    low, high
        The magnifications.
    scale, scale_sigma
        Ratio of nm per px at ``low`` to that at ``high`` that the calibration states, over the true one, less one; and
        its joint 1-sigma.
    aspect, aspect_sigma, skew, skew_sigma
        The same of the aspect ratio and of the angle between the axes, rad.
    reason
        Why they could not be compared; the numbers are NaN then.
    """

    low: float
    high: float
    scale: float = math.nan
    scale_sigma: float = math.nan
    aspect: float = math.nan
    aspect_sigma: float = math.nan
    skew: float = math.nan
    skew_sigma: float = math.nan
    reason: str = ""

    @property
    def largest_sigmas(self) -> float:
        """The largest of the three in its sigmas; NaN where nothing was compared."""
        parts = (
            (self.scale, self.scale_sigma),
            (self.aspect, self.aspect_sigma),
            (self.skew, self.skew_sigma),
        )
        return max(abs(value) / sigma for value, sigma in parts)


@dataclass(frozen=True)
class SpecimenCheck:
    """Ratios between neighbouring magnifications.

    Attributes
    ----------
    ratios
        One for each pair of neighbouring magnifications, ascending.
    notes
        Notes for the user.
    """

    ratios: tuple[ScaleRatio, ...]
    notes: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether nothing that was compared differs by more than chance explains."""
        return all(r.largest_sigmas <= _SIGMAS for r in self.ratios if not r.reason)


def check_specimen(
    calibration: CalibrationSource,
    source: Source,
    *,
    config: ConfigSource | None = None,
    on_progress: OnProgress = ignore_progress,
) -> SpecimenCheck:
    """Compare images of one place at two or more magnifications with what a calibration says of their scales.

    It sees whether the scales of two magnifications have changed against each other, and with them aspect and skew.
    It does not see a change that is common to all magnifications, which needs a grid, nor the distortion.

    Parameters
    ----------
    calibration
        A calibration or its file.
    source
        A recording, or (image, magnification) tuples; the first frame of each magnification is used. The specimen
        must have texture, and stay where it is, untilted.
    config
        A ``msg_configs`` name or file; the default is ``generic``.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

    Raises
    ------
    BagError
        If there are fewer than two magnifications, or no two of them can be compared.
    """
    model = require_calibration(calibration)
    chosen = resolve_config(config, model)
    images: dict[float, Array32] = {}
    with open_source(source, chosen) as recording:
        advance = count_frames(on_progress, "reading", recording.frame_count)
        for frame in recording.frames():
            if frame.magnification not in images:
                grey = to_gray(frame.visible, frame.encoding)
                images[frame.magnification] = np.asarray(grey, dtype=np.float32)
            advance(1)
        notes = recording.notes
    if len(images) < 2:
        raise BagError(
            "images at one magnification",
            expected="one place of a specimen at two magnifications or more",
            do="set another magnification without moving the stage",
        )
    ordered = sorted(images)
    on_progress("comparing", 0, None)
    ratios = tuple(
        _compare(model, (low, images[low]), (high, images[high]))
        for low, high in itertools.pairwise(ordered)
    )
    if all(ratio.reason for ratio in ratios):
        raise BagError(
            f"no two magnifications that can be compared ({ratios[0].reason})",
            expected="one place of a specimen with texture, at magnifications within a factor of 4",
        )
    return SpecimenCheck(ratios, notes)


def _compare(
    model: Calibration, low: tuple[float, Array32], high: tuple[float, Array32]
) -> ScaleRatio:
    cameras = [
        model.at(g).resized(image.shape[1], image.shape[0]).rectified for g, image in (low, high)
    ]
    ratio = cameras[0].pixel_size_m[0] / cameras[1].pixel_size_m[0]
    if ratio > _MOST_RATIO:
        return ScaleRatio(low[0], high[0], reason=f"{ratio:.2g} times apart")
    flat = [model.rectify(image, g) for g, image in (low, high)]
    template = _reduce(np.asarray(flat[1], dtype=np.float32), ratio)
    try:
        found = align_affine(template, np.asarray(flat[0], dtype=np.float32))
    except (NotAlignedError, InvalidValueError) as error:
        return ScaleRatio(low[0], high[0], reason=str(error))
    a, b, c, d = found.matrix.ravel()
    # Of a matrix near one: scale, stretch along x against y, and shear.
    maps = np.array([[0.5, 0.0, 0.0, 0.5], [0.5, 0.0, 0.0, -0.5], [0.0, 1.0, 1.0, 0.0]])
    own = np.sqrt(np.diag(maps @ found.covariance @ maps.T))
    # A line lasts longer than the pixels of it: drift moves lines, which stretches and shears the image.
    drift = _DRIFT_PX * math.sqrt(2.0) / template.shape[0] * np.array([0.5, 0.5, 1.0])
    stated = [_relative_sigmas(camera) for camera in cameras]
    sigma = np.sqrt(own**2 + drift**2 + stated[0] ** 2 + stated[1] ** 2)
    values = (math.sqrt(a * d - b * c) - 1.0, 0.5 * (a - d), b + c)
    return ScaleRatio(
        low[0], high[0], values[0], sigma[0], values[1], sigma[1], values[2], sigma[2]
    )


def _reduce(image: Array32, ratio: float) -> Array32:
    """Reduce an image by a ratio of at least one, without aliasing."""
    size = tuple(max(1, math.floor(side / ratio)) for side in image.shape)
    blurred = image
    if ratio > 1.0:
        sigma = 0.5 * math.sqrt(ratio**2 - 1.0)
        blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)
    # Pixel centres at multiples of the ratio, about the middle of the image.
    middle = [0.5 * (side - 1.0) for side in image.shape]
    first = [m - ratio * 0.5 * (n - 1.0) for m, n in zip(middle, size, strict=True)]
    warp = np.array([[ratio, 0.0, first[1]], [0.0, ratio, first[0]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    reduced = cv2.warpAffine(blurred, warp, (size[1], size[0]), flags=flags)
    return np.asarray(reduced, dtype=np.float32)


def _relative_sigmas(camera: RectifiedCamera) -> np.ndarray:
    """Return the 1-sigma of scale, aspect and skew of a rectified image."""
    assert camera.covariance is not None
    sigma = np.sqrt(np.maximum(np.diag(camera.covariance)[:3], 0.0))
    return np.array([sigma[0] / camera.m, sigma[1], sigma[2]])
