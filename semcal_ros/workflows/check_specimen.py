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

"""What any specimen tells about a calibration, without a grid: ratios of scales, and isotropy under stage moves."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Annotated

import cv2
import numpy as np

from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import Array32, check_positive
from semcal_ros.core.calibration.stage import StageIsotropy, fit_stage_moves
from semcal_ros.core.camera.scan_camera import RectifiedCamera
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.core.registration.affine import NotAlignedError, align_affine
from semcal_ros.core.registration.register import register_pair
from semcal_ros.files.recordings import RecordedFrame
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
from semcal_ros.workflows.options import CONFIG, PROGRESS, KeywordsOf, Option

#: Relative 1-sigma of the length of a move along either axis of a stage, and of the right angle between them, where
#: nothing else is stated. Screws without an encoder are a few tenths of a per cent off over short moves.
STAGE_ACCURACY = 5e-3

# Beyond so many sigmas something has changed: of ten numbers, one is beyond 3.3 by chance in a hundred checks.
_SIGMAS = 3.3
# Field widths further apart share too few pixels.
_MOST_RATIO = 4.0
# 1-sigma of the drift from the first to the last line of an image, px, which stretches and shears it.
_DRIFT_PX = 0.3
# Part of the image by which the specimen must move for more than noise to be measured.
_LEAST_MOVE = 0.05
# A move on a stage that is tilted by as much looks 0.1 % shorter.
_FLAT_RAD = 0.05


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
class MovesCheck:
    """The pixels at one magnification against moves of the stage.

    Attributes
    ----------
    magnification
        Where that is.
    found
        Scales and skew against the stage.
    scale_sigma, skew_sigma
        1-sigma with which both sides know them: of either scale, and of the skew; of the scatter, the stage's accuracy
        and the calibration.
    """

    magnification: float
    found: StageIsotropy
    scale_sigma: tuple[float, float]
    skew_sigma: float

    @property
    def largest_sigmas(self) -> float:
        """The largest of the three in its sigmas."""
        return max(
            abs(self.found.scale_x) / self.scale_sigma[0],
            abs(self.found.scale_y) / self.scale_sigma[1],
            abs(self.found.skew) / self.skew_sigma,
        )


@dataclass(frozen=True)
class SpecimenCheck:
    """Ratios between neighbouring magnifications, and what moves of the stage tell at each.

    Attributes
    ----------
    ratios
        One for each pair of neighbouring magnifications, ascending.
    notes
        Notes for the user.
    moves
        One for each magnification at which the stage was moved enough, ascending.
    """

    ratios: tuple[ScaleRatio, ...]
    notes: tuple[str, ...] = ()
    moves: tuple[MovesCheck, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether nothing that was compared differs by more than chance explains."""
        return all(r.largest_sigmas <= _SIGMAS for r in self.ratios if not r.reason) and all(
            move.largest_sigmas <= _SIGMAS for move in self.moves
        )


@dataclass(frozen=True)
class SpecimenCheckOptions:
    """What is known of the recording of a specimen."""

    stage_accuracy: Annotated[
        float,
        Option(
            "With --specimen: relative 1-sigma of a move of the stage along either of its axes.",
            kind="ratio",
            python="And of the angle between these.",
        ),
    ] = STAGE_ACCURACY
    config: Annotated[ConfigSource | None, CONFIG] = None
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@KeywordsOf(SpecimenCheckOptions)
def check_specimen(
    calibration: CalibrationSource, source: Source, options: SpecimenCheckOptions
) -> SpecimenCheck:
    """Compare images of one place at two or more magnifications with what a calibration says of their scales.

    It sees whether the scales of two magnifications have changed against each other, and with them aspect and skew.
    It does not see a change that is common to all magnifications, which needs a grid, nor the distortion.

    Where the stage tells x and y, five frames and more of one magnification between which it moved by some of the
    field, along both axes, tell the size of the pixels along x and y and the angle between them: as well as the
    stage knows its own moves, and no better.

    Parameters
    ----------
    calibration
        A calibration or its file.
    source
        A recording, or (image, magnification) tuples; the first frame of each magnification is used. The specimen
        must have texture, and stay where it is, untilted.

    Raises
    ------
    BagError
        If there are fewer than two magnifications and no moves of the stage, or no two of them can be compared.
    """
    check_positive(options.stage_accuracy, "stage_accuracy =")
    model = require_calibration(calibration)
    chosen = resolve_config(options.config, model)
    images: dict[float, Array32] = {}
    moves: dict[float, _Moves] = {}
    with open_source(source, chosen, model) as recording:
        advance = count_frames(options.on_progress, "reading", recording.frame_count)
        for frame in recording.frames():
            if frame.magnification not in images:
                grey = to_gray(frame.visible, frame.encoding)
                images[frame.magnification] = np.asarray(grey, dtype=np.float32)
            if _tells_position(frame):
                moves.setdefault(frame.magnification, _Moves(model)).add(frame)
            advance(1)
        notes = recording.notes
    moved = tuple(
        check
        for g in sorted(moves)
        if (check := moves[g].judge(g, options.stage_accuracy)) is not None
    )
    if len(images) < 2 and moved:
        return SpecimenCheck((), notes, moved)
    if len(images) < 2:
        raise BagError(
            "images at one magnification",
            expected="one place of a specimen at two magnifications or more",
            do="set another magnification without moving the stage, or record its x and y while it moves",
        )
    ordered = sorted(images)
    options.on_progress("comparing", 0, None)
    ratios = tuple(
        _compare(model, (low, images[low]), (high, images[high]))
        for low, high in itertools.pairwise(ordered)
    )
    if all(ratio.reason for ratio in ratios) and not moved:
        raise BagError(
            f"no two magnifications that can be compared ({ratios[0].reason})",
            expected="one place of a specimen with texture, at magnifications within a factor of 4",
        )
    return SpecimenCheck(ratios, notes, moved)


def _tells_position(frame: RecordedFrame) -> bool:
    stage = frame.stage
    if stage is None or stage.x_m is None or stage.y_m is None:
        return False
    return abs(stage.tilt_rad or 0.0) < _FLAT_RAD


@dataclass
class _Moves:
    """Frames of one magnification, each registered against the first, with the positions of the stage."""

    model: Calibration
    first: Array32 | None = None
    rows: list[tuple[float, float, float, float, float]] = field(default_factory=list)

    def add(self, frame: RecordedFrame) -> None:
        grey = to_gray(frame.visible, frame.encoding)
        flat = np.asarray(self.model.rectify(grey, frame.magnification), dtype=np.float32)
        shift = np.zeros(2)
        if self.first is None:
            self.first = flat
        else:
            found = register_pair(self.first, flat)
            if not found.accepted:
                return
            shift = found.shift_px
        assert frame.stage is not None and frame.stage.x_m is not None
        assert frame.stage.y_m is not None
        place = (frame.stage.x_m, frame.stage.y_m)
        self.rows.append((*place, float(shift[0]), float(shift[1]), 1e-9 * frame.stamp_ns))

    def judge(self, magnification: float, stage_accuracy: float) -> MovesCheck | None:
        """Compare them; None where the stage did not move enough."""
        assert self.first is not None
        height, width = self.first.shape
        camera = self.model.at(magnification).resized(width, height).rectified
        values = np.array(self.rows)
        pixel_m = camera.pixel_size_m[0]
        if np.max(np.ptp(values[:, 2:4], axis=0)) < _LEAST_MOVE * min(width, height):
            return None
        try:
            found = fit_stage_moves(values[:, :2], values[:, 2:4], values[:, 4], pixel_m)
        except InvalidValueError:
            return None
        stated = [s / pixel_m for s in camera.pixel_size_sigma_m]
        scale = tuple(
            math.sqrt(sigma**2 + stage_accuracy**2 + known**2)
            for sigma, known in zip((found.scale_x_sigma, found.scale_y_sigma), stated, strict=True)
        )
        skew = math.sqrt(found.skew_sigma**2 + stage_accuracy**2 + _relative_sigmas(camera)[2] ** 2)
        return MovesCheck(magnification, found, (scale[0], scale[1]), skew)


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
    sigmas = np.sqrt(np.diag(maps @ found.covariance @ maps.T))
    # A line lasts longer than the pixels of it: drift moves lines, which stretches and shears the image.
    drift = _DRIFT_PX * math.sqrt(2.0) / template.shape[0] * np.array([0.5, 0.5, 1.0])
    stated = [_relative_sigmas(camera) for camera in cameras]
    sigma = np.sqrt(sigmas**2 + drift**2 + stated[0] ** 2 + stated[1] ** 2)
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
