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

"""Difference of two calibrations, over its joint sigma.

A raw pixel of one calibration is taken to the plane of the specimen and projected with the other. What a shift of the
specimen would do is taken out, as in a projection diff (mrcal, "Projection diff"): it trades off against the principal
point, and no measurement within one image needs it. What is left is the difference relative to the image centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.judgement.thresholds import (
    COMPARED_ACROSS,
    COMPARED_COUNT,
    DIFFERENT_SIGMAS,
)
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.uncertainty import (
    make_field_lattice,
    make_similarity_moves,
    predict_aligned_sigma_px,
    predict_shape_sigma_px,
)
from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True, eq=False)
class DifferenceAt:
    """The second calibration against the first at one magnification.

    Attributes
    ----------
    magnification
        The magnification.
    scale, scale_sigma
        Relative difference of nm per px, the mean of both axes, and its joint 1-sigma.
    pixel_size_m
        nm per px of the first calibration, m.
    xy
        (n, 2) raw pixels of the first, a lattice over its field, row by row; NaN rows have no difference.
    difference_px, sigma_px
        (n, 2) difference relative to the image centre, px, and (n,) its joint 1-sigma along the worse axis.
    shape_px, shape_sigma_px
        (n, 2) what the best shift, turn and scale leave of it, and (n,) its joint 1-sigma: a scale that is known less
        well than aspect, skew and distortion would hide these.
    """

    magnification: float
    scale: float
    scale_sigma: float
    pixel_size_m: float
    xy: Array
    difference_px: Array
    sigma_px: Array
    shape_px: Array
    shape_sigma_px: Array

    @property
    def worst_px(self) -> float:
        """Largest length of the difference in the field, px."""
        return float(np.nanmax(np.linalg.norm(self.difference_px, axis=1)))

    @property
    def scale_sigmas(self) -> float:
        """Difference of nm per px in its joint sigmas."""
        return abs(self.scale) / self.scale_sigma if self.scale_sigma > 0.0 else _sigmas(self.scale)

    @property
    def field_sigmas(self) -> float:
        """Largest difference over the field, or that of the whole shape, in its joint sigmas."""
        length = np.linalg.norm(self.difference_px, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = length / self.sigma_px
        ratio = ratio[np.isfinite(ratio)]
        return max(float(ratio.max()), self.shape_sigmas) if len(ratio) else _sigmas(self.worst_px)

    @property
    def shape_sigmas(self) -> float:
        """RMS of what shift, turn and scale leave, over that of its joint sigma."""
        length = np.linalg.norm(self.shape_px, axis=1)
        known = np.isfinite(length) & np.isfinite(self.shape_sigma_px)
        square = float(np.sum(length[known] ** 2))
        variance = float(np.sum(self.shape_sigma_px[known] ** 2))
        return math.sqrt(square / variance) if variance > 0.0 else 0.0


def _sigmas(difference: float) -> float:
    """Sigmas of a difference between calibrations without covariance."""
    return 0.0 if difference == 0.0 else float("inf")


@dataclass(frozen=True, eq=False)
class CalibrationDifference:
    """Difference of two calibrations over the magnifications that both cover.

    Attributes
    ----------
    at
        The difference at each magnification, ascending.
    low, high
        The range that both cover.
    same_recording
        Whether both come from one recording, so that their errors are not independent and the joint sigma is too
        large; None where it is not known.
    """

    at: tuple[DifferenceAt, ...]
    low: float
    high: float
    same_recording: bool | None

    @property
    def largest_sigmas(self) -> float:
        """Largest difference, of nm per px or over the field, in joint sigmas."""
        return max(max(one.scale_sigmas, one.field_sigmas) for one in self.at)

    @property
    def agree(self) -> bool:
        """Whether nothing differs by more than chance explains."""
        return self.largest_sigmas <= DIFFERENT_SIGMAS


def compare_calibrations(
    first: CalibrationModel, second: CalibrationModel, magnifications: Sequence[float] = ()
) -> CalibrationDifference:
    """Compare two calibrations over image field and magnification.

    Parameters
    ----------
    first, second
        The calibrations, with the same proportions of the image; the second is brought to the image size and the
        display width of the first.
    magnifications
        Where to compare, in the sense of the first; by default some over the range that both cover.

    Raises
    ------
    InvalidValueError
        For images of other proportions, ranges without overlap, or magnifications outside of it.
    """
    ratio = second.image_width / first.image_width
    if abs(second.image_height / first.image_height / ratio - 1.0) > 0.5 / first.image_height:
        raise InvalidValueError(
            f"images of {first.image_width} x {first.image_height} and {second.image_width} x "
            f"{second.image_height} px",
            expected="calibrations of images with the same proportions",
        )
    # The same field has another number on another display.
    other_g = second.display_width_m / first.display_width_m
    ranges = first.magnification_range, tuple(g / other_g for g in second.magnification_range)
    low, high = max(r[0] for r in ranges), min(r[1] for r in ranges)
    if low > high * (1.0 + 1e-9):
        raise InvalidValueError(
            f"calibrations from {ranges[0][0]:g}x to {ranges[0][1]:g}x and from {ranges[1][0]:g}x to {ranges[1][1]:g}x",
            expected="ranges that overlap",
        )
    high = max(low, high)
    chosen = sorted(float(g) for g in magnifications)
    if not chosen:
        chosen = (
            [low]
            if high <= low * (1.0 + 1e-9)
            else np.geomspace(low, high, COMPARED_COUNT).tolist()
        )
    outside = [g for g in chosen if not low * (1.0 - 1e-9) <= g <= high * (1.0 + 1e-9)]
    if outside:
        raise InvalidValueError(
            f"magnification {outside[0]:g}",
            expected=f"{low:g} to {high:g}, which both calibrations cover",
        )
    size = first.image_size
    compared = tuple(
        _compare_at(first.at(g), replace(second.at(g * other_g).resized(*size), magnification=g))
        for g in np.clip(chosen, low, high).tolist()
    )
    digests = first.provenance.recording_sha256, second.provenance.recording_sha256
    same = digests[0] == digests[1] if all(digests) else None
    return CalibrationDifference(compared, low, high, same)


def _compare_at(first: ScanCamera, second: ScanCamera) -> DifferenceAt:
    xy = make_field_lattice(first.width, first.height, COMPARED_ACROSS)
    middle = 0.5 * np.array([[first.width - 1.0, first.height - 1.0]])
    ideal = first.undistort(np.concatenate([middle, xy]))
    known = np.all(np.isfinite(ideal), axis=1)
    moved = np.full_like(ideal, np.nan)
    # What the first camera sees at the centre, the second one sees there when the specimen is shifted by so much.
    there = second.undistort(middle)
    if np.all(known[:1]) and np.all(np.isfinite(there)):
        points = first.sem_from_ideal(ideal[known])
        moved[known] = second.project(points + second.sem_from_ideal(there) - points[:1])
    difference = moved[1:] - xy
    sigma, shape_sigma = (
        np.where(
            known[1:],
            np.hypot(predict(first, _finite(ideal[1:])), predict(second, _finite(ideal[1:]))),
            np.nan,
        )
        for predict in (predict_shape_sigma_px, predict_aligned_sigma_px)
    )
    sizes = [float(np.mean(camera.pixel_size_m)) for camera in (first, second)]
    return DifferenceAt(
        magnification=first.magnification,
        scale=sizes[1] / sizes[0] - 1.0,
        scale_sigma=math.hypot(_relative_sigma(first), _relative_sigma(second)),
        pixel_size_m=sizes[0],
        xy=xy,
        difference_px=difference,
        sigma_px=sigma,
        shape_px=_align(xy, difference),
        shape_sigma_px=shape_sigma,
    )


def _align(xy: Array, difference: Array) -> Array:
    """Return what the best shift, turn and scale leave of (n, 2) differences at (n, 2) pixels; NaN rows stay."""
    known = np.all(np.isfinite(difference), axis=1)
    left = np.full_like(difference, np.nan)
    columns, values = make_similarity_moves(xy[known]).reshape(-1, 4), difference[known].ravel()
    found = np.linalg.lstsq(columns, values, rcond=None)[0]
    left[known] = (values - columns @ found).reshape(-1, 2)
    return left


def _finite(xy: Array) -> Array:
    return np.nan_to_num(xy, nan=0.0)


def _relative_sigma(camera: ScanCamera) -> float:
    """Relative 1-sigma of nm per px, of the worse axis."""
    if camera.covariance is None:
        return 0.0
    return max(s / x for s, x in zip(camera.pixel_size_sigma_m, camera.pixel_size_m, strict=True))
