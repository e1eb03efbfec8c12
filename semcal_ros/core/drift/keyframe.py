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

"""The images that drift is measured against.

The noise of a reference limits every registration against it. Each frame that was registered well
is therefore added to its keyframe, shifted to where the keyframe lies, until the noise of the mean
no longer matters. Then the mean stays as it is, so that it cannot wander.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from semcal_ros.core.arrays import AnyImage, Array, Image, Mask
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.thresholds import (
    BLUR_BELOW,
    COMMON_PX_MIN,
    FRAMES_AVERAGED,
    KEPT_CORRELATION_MIN,
    MERGED_GAINS,
    PIXEL_SIGMA_PX,
    USUAL_RATIO,
    WORN_FRAMES,
    WORN_RATIO,
)
from semcal_ros.core.registration.fixed_pixels import grow_mask
from semcal_ros.core.registration.fractional_delay import FINE, sample_shifted
from semcal_ros.core.registration.reference import Reference, Region, RegistrationSettings
from semcal_ros.core.registration.register import Registration, prepare_reference, to_gray


@dataclass(frozen=True)
class Keyframe:
    """A reference image.

    Attributes
    ----------
    frame
        The frame it began with.
    removed
        (4,) drift velocity and acceleration (unit per s and s^2) that were removed from that frame.
    mean
        (h, w) float32 mean of the frames, in rectified pixels of the camera.
    region
        The part of it that was scanned.
    time_s
        Time of the first frame.
    averaged
        Number of frames in the mean.
    turn
        (2,) rotation and scale that were removed from the first frame.
    fixed
        (h, w) True at pixels of the mean that do not show the specimen; None where all do.
    compared
        Number of frames in the mean when it was last compared with the first of them
        (:func:`~semcal_ros.core.drift.matching.free_of_pull`).
    residual
        The least that any frame left unexplained, grey levels.
    worn
        How many frames in a row have left much more.
    differs
        Whether the latest frame agreed so little with it that the specimen may have changed.
    changes
        How often the specimen had changed since the first keyframe of the chain from which this one was measured.
    """

    frame: ScanFrame
    removed: Array
    mean: Image
    region: Region
    time_s: float
    averaged: int = 1
    turn: Array = field(default_factory=lambda: np.zeros(2))
    fixed: Mask | None = None
    compared: int = 0
    residual: float = float("inf")
    worn: int = 0
    differs: bool = False
    changes: int = 0

    @property
    def nbytes(self) -> int:
        """Memory of its images."""
        return self.mean.nbytes + self.frame.image.nbytes

    def prepare_reference(self, settings: RegistrationSettings) -> Reference:
        """Prepare it for registrations."""
        raw = to_gray(self.frame.image)
        return prepare_reference(
            self.mean,
            region=self.region,
            settings=settings,
            averaged=float(self.averaged),
            raw=raw if raw.shape == self.mean.shape else None,
            fixed=self.fixed,
        )

    @property
    def is_worn(self) -> bool:
        """Whether the specimen has changed since."""
        return self.worn >= WORN_FRAMES

    def allow_for_change(self, registration: Registration) -> Registration:
        """The registration with a covariance that has what a specimen which has changed does to more than one frame.

        Noise is another one in each frame, and what has changed is the same: it pulls all of them alike, and the filter
        must not average it.
        """
        residual = _unexplained(registration)
        if not residual > USUAL_RATIO * self.residual:
            return registration
        share = 1.0 - (USUAL_RATIO * self.residual / residual) ** 2
        factor, alignment = 1.0 + (FRAMES_AVERAGED - 1.0) * share, registration.alignment
        alignment = replace(
            alignment,
            covariance=factor * alignment.covariance,
            joint_covariance=factor * alignment.joint_covariance,
        )
        return replace(registration, alignment=alignment)

    def note_match(self, registration: Registration) -> Keyframe:
        """The keyframe after a frame was measured against it, and left more or less unexplained."""
        residual = _unexplained(registration)
        worn = self.worn + 1 if residual > WORN_RATIO * self.residual else 0
        # With less contrast, it does not say what a usual one leaves.
        is_usual = registration.contrast > MERGED_GAINS[0]
        least = min(residual, self.residual) if is_usual else self.residual
        differs = registration.correlation < KEPT_CORRELATION_MIN
        return replace(self, residual=least, worn=worn, differs=differs)

    def with_frame(
        self,
        image: AnyImage,
        region: Region,
        registration: Registration,
        fixed: Mask | None = None,
    ) -> Keyframe:
        """The keyframe with another frame in its mean, where the two overlap and the frame shows the specimen: not
        at its pixels ``fixed`` (h, w).
        """
        gray = np.asarray(to_gray(image), dtype=np.float32)
        shift = registration.shift_px
        whole = np.floor(shift).astype(int)
        spans = []
        for axis in (0, 1):
            # What the interpolation reaches beyond the region was not scanned; beyond the image it
            # is mirrored.
            edges = 0, gray.shape[1 - axis]
            low = FINE.reach if region[axis] > edges[0] else 0
            high = FINE.reach if region[axis + 2] < edges[1] else 1
            first = max(self.region[axis], region[axis] + low - int(whole[axis]))
            last = min(self.region[axis + 2], region[axis + 2] - high - int(whole[axis]))
            spans.append((first, last))
        (left, right), (top, bottom) = spans
        if min(right - left, bottom - top) < COMMON_PX_MIN:
            return self
        plain = np.array([1.0])
        # By a gain that the noise of the reference lowers, each mean would have more contrast than the one before.
        contrast, alignment = registration.contrast, registration.alignment
        offset = alignment.offset + (alignment.gain - contrast) * float(np.mean(self.mean))
        corner = left + int(whole[0]), top + int(whole[1])
        size = right - left, bottom - top
        moved = sample_shifted(gray, corner, size, shift - whole, plain, FINE, -offset)
        mean = self.mean.copy()
        part = mean[top:bottom, left:right]
        share = np.float32(1.0 / (self.averaged + 1))
        change = (moved * np.float32(1.0 / contrast) - part) * share
        if fixed is not None:
            # Its place is filled from around, without the structure that the mean has there.
            around = grow_mask(fixed, FINE.reach)
            change[around[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]]] = 0.0
        part += change
        return replace(self, mean=mean, averaged=self.averaged + 1)


def _unexplained(registration: Registration) -> float:
    """Grey levels that a frame left unexplained; amplified, it leaves more of its noise."""
    return registration.alignment.residual_rms / max(registration.contrast, 1.0)


def make_keyframe(
    frame: ScanFrame,
    removed: Array,
    image: AnyImage,
    region: Region,
    time_s: float,
    turn: Array | None = None,
    fixed: Mask | None = None,
) -> Keyframe:
    """A keyframe from a frame and its image without the motion ``removed`` (4,) and the rotation and scale
    ``turn`` (2,), which does not show the specimen at its pixels ``fixed`` (h, w).
    """
    gray = np.array(to_gray(image), dtype=np.float32)
    turned = np.zeros(2) if turn is None else turn.copy()
    return Keyframe(frame, removed.copy(), gray, region, time_s, turn=turned, fixed=fixed)


def scale_ratio(before: ScanFrame, now: ScanFrame) -> float:
    """Factor by which the px per unit differ, at least 1; infinite where they cannot be compared."""
    if before.camera is not None and now.camera is not None:
        # Rectified pixels are square: it is the same in all directions.
        ratio = now.camera.m / before.camera.m
        return max(ratio, 1.0 / ratio)
    is_same = before.camera is now.camera and before.size == now.size
    return 1.0 if is_same else float("inf")


def resample_keyframe(key: Keyframe, now: ScanFrame) -> Keyframe:
    """The keyframe as the camera of ``now`` would show it.

    Both cameras must be known. Rectified pixels of two magnifications are related by the zoom of
    the reference plane about the principal point.
    """
    if key.frame.camera is None or now.camera is None:
        return key
    before, after = key.frame.camera.rectified, now.camera.rectified
    matrix = now.px_from_unit @ np.linalg.inv(key.frame.px_from_unit)
    offset = np.array([after.px, after.py]) - matrix @ np.array([before.px, before.py])
    shrink = float(np.sqrt(abs(np.linalg.det(matrix))))
    gray = key.mean
    if shrink < BLUR_BELOW:
        sigma = PIXEL_SIGMA_PX * float(np.sqrt(1.0 / shrink**2 - 1.0))
        gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), sigma), dtype=np.float32)
    warp = np.column_stack([matrix, offset])
    width, height = now.size
    new = cv2.warpAffine(gray, warp, (width, height), flags=cv2.INTER_CUBIC)
    region = _map_region(key.region, matrix, offset, now.size)
    mean = np.asarray(new, dtype=np.float32)
    fixed = None
    if key.fixed is not None:
        drawn = cv2.warpAffine(key.fixed.astype(np.float32), warp, (width, height))
        fixed = np.asarray(drawn > 0.0)
    return Keyframe(now, key.removed, mean, region, key.time_s, key.averaged, key.turn, fixed)


def _map_region(region: Region, matrix: Array, offset: Array, size: tuple[int, int]) -> Region:
    """Upright rectangle inside the affine image of a rectangle and inside the image."""
    left, top, right, bottom = region[0] + 2, region[1] + 2, region[2] - 3, region[3] - 3
    corners = np.array(
        [[left, top], [right, top], [left, bottom], [right, bottom]], dtype=np.float64
    )
    mapped = corners @ matrix.T + offset
    x0, x1 = max(mapped[0, 0], mapped[2, 0], 0.0), min(mapped[1, 0], mapped[3, 0], size[0] - 1.0)
    y0, y1 = max(mapped[0, 1], mapped[1, 1], 0.0), min(mapped[2, 1], mapped[3, 1], size[1] - 1.0)
    inside = (int(np.ceil(x0)), int(np.ceil(y0)), int(np.floor(x1)) + 1, int(np.floor(y1)) + 1)
    if inside[2] <= inside[0] or inside[3] <= inside[1]:
        return 0, 0, 1, 1
    return inside
