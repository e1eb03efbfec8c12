"""A frame as it came in, and as it would be if it had been scanned in an instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import RESAMPLED_TYPES, Array, check_image
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.raw_positions import RasterDrift, camera_key, raw_from_output
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.registration.reference import Region

__all__ = ["MotionCorrector", "ScanFrame", "resampleable"]


# Motions that bend a frame by less are left in it.
_NEGLIGIBLE_PX = 1e-3
_CAMERAS = 16
_SAMPLES = 96


@dataclass(frozen=True)
class ScanFrame:
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
    def sample(self) -> bytes:
        """Some of its pixels, by which to see that a picture came once more."""
        rows, cols = (max(1, n // _SAMPLES) for n in self.image.shape[:2])
        return np.ascontiguousarray(self.image[::rows, ::cols]).tobytes()

    @property
    def px_from_unit(self) -> Array:
        """(2, 2) px per unit of the drift: per m with a camera, per px without."""
        return np.eye(2) if self.camera is None else self.camera.ideal_from_sem_jacobian


class MotionCorrector:
    """Frames in ideal pixels, as if scanned in the instant of their centre.

    Parameters
    ----------
    interpolation
        Of the rectification.
    """

    def __init__(self, interpolation: str) -> None:
        self._rectifier = Rectifier(interpolation)
        self._scanned: dict[tuple[object, ...], Region] = {}

    def of(self, shot: ScanFrame, motion: Array) -> tuple[NDArray[np.generic], Region]:
        """The picture without a drift velocity and acceleration (4,) (unit per s and s^2), and the
        rectangle of it that was scanned.
        """
        width, height = shot.size
        camera = None if shot.rectified else shot.camera
        bent = _bent_px(shot, motion)
        drift = None
        if float(np.max(bent)) > _NEGLIGIBLE_PX:
            # The rectifier takes px where it is given no camera.
            unit = np.eye(2) if camera is not None else shot.px_from_unit
            drift = RasterDrift(np.zeros(2), unit @ motion[:2], unit @ motion[2:])
        if camera is None and drift is None:
            return shot.image, (0, 0, width, height)
        left, top, right, bottom = self._still(shot.size, camera)
        if drift is not None:
            x, y = (int(np.ceil(b)) for b in bent)
            left, right = min(left + x, width // 3), max(right - x, 2 * width // 3)
            top, bottom = min(top + y, height // 3), max(bottom - y, 2 * height // 3)
        picture = self._rectifier.rectify(shot.image, camera, drift, shot.timing)
        return picture, (left, top, right, bottom)

    def _still(self, size: tuple[int, int], camera: ScanCamera | None) -> Region:
        """What was scanned of a frame that nothing moved in."""
        key = camera_key(size, camera)
        if key not in self._scanned:
            if len(self._scanned) >= _CAMERAS:
                self._scanned.clear()
            self._scanned[key] = _scanned(size, camera)
        return self._scanned[key]


def _bent_px(shot: ScanFrame, motion: Array) -> Array:
    """(2,) by how much a motion displaces pixels of a frame at most."""
    if shot.timing is None:
        return np.zeros(2)
    half_s = 0.5 * shot.timing.acquisition_time_s
    displaced = np.abs(shot.px_from_unit @ motion[:2]) * half_s
    return np.asarray(displaced + np.abs(shot.px_from_unit @ motion[2:]) * 0.5 * half_s**2)


def _scanned(size: tuple[int, int], camera: ScanCamera | None) -> Region:
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
        raw = [raw_from_output(edge, size, camera, None, None) for edge in edges]
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


def resampleable(image: NDArray[np.generic]) -> NDArray[np.generic]:
    """The image in a type that can be resampled.

    Raises
    ------
    InvalidValueError
        If it is no picture.
    """
    pixels = check_image(image)
    return pixels if pixels.dtype.name in RESAMPLED_TYPES else pixels.astype(np.float32)
