"""The picture that drift is measured against, and its journey through a change of magnification."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.raster import ScanTiming
from semcal_ros.core.rectify import RasterDrift, Rectifier, raw_from_output
from semcal_ros.core.registration import (
    Reference,
    Region,
    RegistrationSettings,
    prepare_reference,
)

__all__ = ["Keyframe", "Shot", "carried", "make_keyframe", "picture_of", "scale_ratio"]

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
    """A reference picture with the drift at its time.

    Attributes
    ----------
    shot, velocity
        The frame, and the drift velocity (unit per s) by which its shear was removed.
    reference
        Its picture, prepared for registration.
    drift
        (2,) drift at which it was taken, as estimated then.
    """

    shot: Shot
    velocity: Array
    reference: Reference
    drift: Array


def picture_of(
    shot: Shot, velocity: Array, rectifier: Rectifier
) -> tuple[NDArray[np.generic], Region]:
    """The frame in ideal pixels as if scanned in the instant of its centre, and the rectangle of
    it that was scanned.
    """
    width, height = shot.size
    camera = None if shot.rectified else shot.camera
    # The rectifier takes px where it is given no camera.
    speed = velocity if camera is not None else shot.px_from_unit @ velocity
    within_frame = np.abs(shot.px_from_unit @ velocity)
    moving = (
        shot.timing is not None and float(np.max(within_frame)) * shot.timing.frame_time_s > 1e-3
    )
    if camera is None and not moving:
        return shot.image, (0, 0, width, height)
    drift = RasterDrift(np.zeros(2), speed) if moving else None
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


def make_keyframe(
    shot: Shot,
    drift: Array,
    velocity: Array,
    rectifier: Rectifier,
    settings: RegistrationSettings,
) -> Keyframe:
    """A keyframe of a frame whose drift is known or defined."""
    picture, region = picture_of(shot, velocity, rectifier)
    reference = prepare_reference(picture, region=region, settings=settings)
    return Keyframe(shot, velocity.copy(), reference, drift.copy())


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


def carried(
    key: Keyframe, now: Shot, rectifier: Rectifier, settings: RegistrationSettings
) -> Keyframe:
    """The keyframe as the camera of ``now`` would show it.

    Both cameras must be known. Ideal pixels of two magnifications are related by the affine map of
    the reference plane.
    """
    before, after = key.shot.camera, now.camera
    if before is None or after is None:
        return key
    picture, region = picture_of(key.shot, key.velocity, rectifier)
    matrix = now.px_from_unit @ np.linalg.inv(key.shot.px_from_unit)
    offset = np.array([after.px, after.py]) - matrix @ np.array([before.px, before.py])
    shrink = float(np.sqrt(abs(np.linalg.det(matrix))))
    gray = np.asarray(picture, dtype=np.float32)
    if gray.ndim == 3:
        gray = gray.mean(axis=2)
    if shrink < 0.95:
        # Structure finer than the new pixels would alias.
        sigma = 0.45 * float(np.sqrt(1.0 / shrink**2 - 1.0))
        gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), sigma), dtype=np.float32)
    warp = np.column_stack([matrix, offset])
    width, height = now.size
    new = cv2.warpAffine(gray, warp, (width, height), flags=cv2.INTER_CUBIC)
    reference = prepare_reference(
        new, region=_image_of(region, matrix, offset, now.size), settings=settings
    )
    return replace(key, reference=reference)


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
