"""The pictures that drift is measured against.

The noise of a reference limits every registration against it, above all in noisy pictures. So each
frame that was registered well is added to its keyframe, shifted to where the keyframe lies, until
the noise of the mean no longer matters; then it stays as it is, so that it cannot wander.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.raster import ScanTiming
from semcal_ros.core.rectify import RasterDrift, Rectifier, raw_from_output
from semcal_ros.core.registration import (
    Reference,
    Region,
    Registration,
    RegistrationSettings,
    prepare_reference,
)
from semcal_ros.core.subpixel import MARGIN, sampled

__all__ = [
    "Keyframe",
    "Shot",
    "carried",
    "keyframe_of",
    "make_keyframe",
    "picture_of",
    "resampleable",
    "scale_ratio",
]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shot:
    """A frame as it came in.

    Attributes
    ----------
    image
        Raw picture.
    camera
        Its camera at the image's size, or None.
    timing
        Its raster, or None for an instant.
    rectified
        Whether the picture already is in the camera's ideal pixels.
    """

    image: NDArray[np.generic]
    camera: ScanCamera | None
    timing: ScanTiming | None
    rectified: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.image.shape[1], self.image.shape[0]

    @property
    def px_from_unit(self) -> Array:
        """(2, 2) px per unit of the drift: per m with a camera, per px without."""
        return np.eye(2) if self.camera is None else self.camera.ideal_from_sem_jacobian


@dataclass(frozen=True)
class Keyframe:
    """A reference picture.

    Attributes
    ----------
    shot
        The frame it began with.
    removed
        (4,) drift velocity and acceleration (unit per s and s^2) that were removed from that frame.
    mean
        (h, w) float32 mean of the frames, in ideal pixels of the camera.
    region
        The part of it that was scanned.
    time_s
        Time of the first frame.
    averaged
        Number of frames in the mean.
    """

    shot: Shot
    removed: Array
    mean: NDArray[np.float32]
    region: Region
    time_s: float
    averaged: int = 1

    @property
    def nbytes(self) -> int:
        """Memory of its pictures."""
        return self.mean.nbytes + self.shot.image.nbytes

    def reference(self, settings: RegistrationSettings) -> Reference:
        """Everything that a registration needs of it."""
        return prepare_reference(
            self.mean, region=self.region, settings=settings, averaged=float(self.averaged)
        )

    def with_frame(
        self, picture: NDArray[np.generic], region: Region, registration: Registration
    ) -> Keyframe:
        """The keyframe with another frame in its mean, where the two overlap."""
        gray = _gray(picture)
        shift = registration.shift_px
        whole = np.floor(shift).astype(int)
        spans = []
        for axis in (0, 1):
            # What the interpolation reaches beyond the region was not scanned; beyond the picture it
            # is mirrored.
            edges = 0, gray.shape[1 - axis]
            low = MARGIN if region[axis] > edges[0] else 0
            high = MARGIN if region[axis + 2] < edges[1] else 1
            first = max(self.region[axis], region[axis] + low - int(whole[axis]))
            last = min(self.region[axis + 2], region[axis + 2] - high - int(whole[axis]))
            spans.append((first, last))
        (left, right), (top, bottom) = spans
        if right - left < 8 or bottom - top < 8:
            return self
        plain = np.array([1.0])
        corner = left + int(whole[0]), top + int(whole[1])
        size = right - left, bottom - top
        moved = sampled(gray, corner, size, shift - whole, (plain, plain), -registration.offset)
        mean = self.mean.copy()
        part = mean[top:bottom, left:right]
        share = np.float32(1.0 / (self.averaged + 1))
        part += (moved * np.float32(1.0 / registration.gain) - part) * share
        return replace(self, mean=mean, averaged=self.averaged + 1)


def _gray(picture: NDArray[np.generic]) -> NDArray[np.float32]:
    if picture.ndim == 3:
        return np.asarray(picture.mean(axis=2), dtype=np.float32)
    return np.asarray(picture, dtype=np.float32)


def picture_of(
    shot: Shot, motion: Array, rectifier: Rectifier
) -> tuple[NDArray[np.generic], Region]:
    """The frame in ideal pixels as if scanned in the instant of its centre, and the rectangle of
    it that was scanned.

    ``motion`` (4,) is drift velocity and acceleration, unit per s and s^2.
    """
    width, height = shot.size
    camera = None if shot.rectified else shot.camera
    # The rectifier takes px where it is given no camera.
    unit = np.eye(2) if camera is not None else shot.px_from_unit
    drift = None
    if shot.timing is not None:
        time_s = shot.timing.acquisition_time_s
        bent = np.abs(shot.px_from_unit @ motion[:2]) * time_s
        bent += np.abs(shot.px_from_unit @ motion[2:]) * time_s**2
        if float(np.max(bent)) > 1e-3:
            drift = RasterDrift(np.zeros(2), unit @ motion[:2], unit @ motion[2:])
    if camera is None and drift is None:
        return shot.image, (0, 0, width, height)
    region = _scanned(shot.size, camera, drift, shot.timing)
    return rectifier.rectify(shot.image, camera, drift, shot.timing), region


def _scanned(
    size: tuple[int, int],
    camera: ScanCamera | None,
    drift: RasterDrift | None,
    timing: ScanTiming | None,
) -> Region:
    """Rectangle of output pixels of which all come from inside of the raw frame."""
    width, height = size
    left, top, right, bottom = 0, 0, width, height
    for _ in range(4):
        x, y = np.linspace(left, right - 1, 17), np.linspace(top, bottom - 1, 17)
        edges = [
            np.stack([np.full(17, float(left)), y], axis=1),
            np.stack([x, np.full(17, float(top))], axis=1),
            np.stack([np.full(17, right - 1.0), y], axis=1),
            np.stack([x, np.full(17, bottom - 1.0)], axis=1),
        ]
        raw = [raw_from_output(edge, size, camera, drift, timing) for edge in edges]
        # An interpolation reaches two pixels beyond its position; a hole in the distortion counts
        # as far outside.
        lacking = [
            2.0 - np.nan_to_num(raw[0][:, 0], nan=-width / 8).min(),
            2.0 - np.nan_to_num(raw[1][:, 1], nan=-height / 8).min(),
            np.nan_to_num(raw[2][:, 0], nan=1.125 * width).max() - (width - 3.0),
            np.nan_to_num(raw[3][:, 1], nan=1.125 * height).max() - (height - 3.0),
        ]
        steps = [int(np.ceil(max(v, 0.0))) for v in lacking]
        left, top = min(left + steps[0], width // 3), min(top + steps[1], height // 3)
        right, bottom = (
            max(right - steps[2], 2 * width // 3),
            max(bottom - steps[3], 2 * height // 3),
        )
        if not any(steps):
            break
    return left, top, right, bottom


def make_keyframe(shot: Shot, motion: Array, rectifier: Rectifier, time_s: float) -> Keyframe:
    """A keyframe of a frame from which velocity and acceleration (4,) are removed."""
    return keyframe_of(shot, motion, *picture_of(shot, motion, rectifier), time_s)


def keyframe_of(
    shot: Shot, removed: Array, picture: NDArray[np.generic], region: Region, time_s: float
) -> Keyframe:
    """A keyframe of a frame whose picture without the motion ``removed`` (4,) is known."""
    return Keyframe(shot, removed.copy(), _gray(picture).copy(), region, time_s)


def resampleable(image: NDArray[np.generic]) -> NDArray[np.generic]:
    """The image in a type that can be resampled.

    Raises
    ------
    InvalidValueError
        If it is no picture.
    """
    shape = image.shape
    if image.dtype.kind not in "uif" or not (
        len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)
    ):
        raise InvalidValueError(
            f"an image of shape {shape} and type {image.dtype}",
            expected="(h, w) or (h, w, 3) of integers or floats",
        )
    return image if image.dtype.name in ("uint8", "uint16", "float32") else image.astype(np.float32)


def scale_ratio(before: Shot, now: Shot) -> float:
    """By which factor the px per unit differ, at least 1; infinite where they cannot be
    compared.
    """
    if (before.camera is None) != (now.camera is None):
        return float("inf")
    if before.camera is None:
        return 1.0 if before.size == now.size else float("inf")
    stretch = np.linalg.svd(now.px_from_unit @ np.linalg.inv(before.px_from_unit), compute_uv=False)
    return float(max(stretch.max(), 1.0 / stretch.min()))


def carried(key: Keyframe, now: Shot) -> Keyframe:
    """The keyframe as the camera of ``now`` would show it.

    Both cameras must be known. Ideal pixels of two magnifications are related by the affine map of
    the reference plane.
    """
    before, after = key.shot.camera, now.camera
    if before is None or after is None:
        return key
    matrix = now.px_from_unit @ np.linalg.inv(key.shot.px_from_unit)
    offset = np.array([after.px, after.py]) - matrix @ np.array([before.px, before.py])
    shrink = float(np.sqrt(abs(np.linalg.det(matrix))))
    gray = key.mean
    if shrink < 0.95:
        # Structure finer than the new pixels would alias.
        sigma = 0.45 * float(np.sqrt(1.0 / shrink**2 - 1.0))
        gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), sigma), dtype=np.float32)
    warp = np.column_stack([matrix, offset])
    width, height = now.size
    new = cv2.warpAffine(gray, warp, (width, height), flags=cv2.INTER_CUBIC)
    region = _image_of(key.region, matrix, offset, now.size)
    mean = np.asarray(new, dtype=np.float32)
    return Keyframe(now, key.removed, mean, region, key.time_s, key.averaged)


def _image_of(region: Region, matrix: Array, offset: Array, size: tuple[int, int]) -> Region:
    """Upright rectangle inside of the affine image of a rectangle and inside of the picture."""
    left, top, right, bottom = region[0] + 2, region[1] + 2, region[2] - 3, region[3] - 3
    corners = np.array(
        [[left, top], [right, top], [left, bottom], [right, bottom]], dtype=np.float64
    )
    moved = corners @ matrix.T + offset
    x0, x1 = max(moved[0, 0], moved[2, 0], 0.0), min(moved[1, 0], moved[3, 0], size[0] - 1.0)
    y0, y1 = max(moved[0, 1], moved[1, 1], 0.0), min(moved[2, 1], moved[3, 1], size[1] - 1.0)
    inside = (int(np.ceil(x0)), int(np.ceil(y0)), int(np.floor(x1)) + 1, int(np.floor(y1)) + 1)
    if inside[2] <= inside[0] or inside[3] <= inside[1]:
        return 0, 0, 1, 1
    return inside
