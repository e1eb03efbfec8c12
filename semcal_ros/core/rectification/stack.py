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

"""Average of drift-corrected frames, with its uncertainty in each pixel.

Frames of a drifting specimen blur when they are averaged as they are. Here each one is first moved
to where the specimen was in the first frame, so that the noise falls as one over the root of the
number of frames and the structure stays. Only sums are kept, so that the memory does not depend on
how many frames there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.rectification.thresholds import EDGE_PX, REACH_PX


@dataclass(frozen=True)
class StackedImage:
    """Average of a stack.

    Attributes
    ----------
    mean
        (h, w) float32 grey levels; NaN where no frame was scanned.
    standard_error
        (h, w) float32 1-sigma of ``mean`` from the scatter of the frames, grey levels; NaN where
        fewer than two frames were scanned. Of each pixel on its own: interpolation makes the noise
        of neighbours dependent. What all frames share, such as a blur, is not in it.
    count
        (h, w) int32 number of frames in each pixel.
    frames
        Number of frames that were added.
    """

    mean: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    count: NDArray[np.int32]
    frames: int


@dataclass(frozen=True, eq=False)
class StackSums:
    """What a stack has added up so far.

    Attributes
    ----------
    total, squares, count
        (h, w) sums of grey levels and of their squares, and number of frames in each pixel.
    frames
        Number of frames that were added.
    """

    total: Array
    squares: Array
    count: NDArray[np.int32]
    frames: int


class Stack:
    """Averages frames in the coordinates of the first one at zero drift.

    Parameters
    ----------
    size
        (width, height) of the frames, px.
    interpolation
        ``"linear"``, ``"cubic"`` (the default: linear blurs each frame by another amount) or
        ``"lanczos4"``.

    Raises
    ------
    InvalidValueError
        If the size is not positive or the interpolation unknown.
    """

    def __init__(self, size: tuple[int, int], interpolation: str = "cubic") -> None:
        width, height = size
        if width < 1 or height < 1:
            raise InvalidValueError(f"a stack of {width} x {height} px", expected="a positive size")
        self._rectifier = Rectifier(interpolation)
        self._reach = REACH_PX[interpolation]
        self._size = (width, height)
        # Sums of single-precision grey levels in double precision: the rounding of their
        # squares is far below the resolution of the grey levels.
        self._sum: Array = np.zeros((height, width))
        self._squares: Array = np.zeros((height, width))
        self._count = np.zeros((height, width), dtype=np.int32)
        self._frames = 0

    @property
    def frames(self) -> int:
        """Number of frames that were added."""
        return self._frames

    def rectify(
        self,
        image: NDArray[np.generic],
        camera: ScanCamera | None,
        drift: RasterDrift | None = None,
        timing: ScanTiming | None = None,
    ) -> tuple[NDArray[np.float32], Mask]:
        """A frame as :meth:`add` wants it; arguments as for
        :meth:`~semcal_ros.core.rectification.rectifier.Rectifier.rectify`.

        Returns
        -------
        (h, w) float32 rectified frame, 0 where it was not scanned, and (h, w) bool, where it was.

        Raises
        ------
        InvalidValueError
            If the image has another size than the stack or is not grey, or the drift is not usable.
        """
        grey = _check_grey(image, self._size)
        map_x, map_y = self._rectifier.maps(self._size, camera, drift, timing)
        rectified = self._rectifier.remapped(grey, map_x, map_y)
        return np.asarray(rectified, dtype=np.float32), find_scanned(
            map_x, map_y, self._size, self._reach
        )

    def add(self, image: NDArray[np.float32], valid: Mask) -> None:
        """Add a rectified image.

        Parameters
        ----------
        image
            (h, w) float32 grey levels; values that are not finite do not count.
        valid
            (h, w) bool: the pixels that were scanned.

        Raises
        ------
        InvalidValueError
            If image or mask have another shape than the stack.
        """
        width, height = self._size
        if image.shape != (height, width) or valid.shape != (height, width):
            raise InvalidValueError(
                f"an image of shape {image.shape} with a mask of shape {valid.shape}",
                expected=f"({height}, {width})",
            )
        finite = np.isfinite(image)
        used = valid & finite
        values = image.astype(np.float32) if finite.all() else np.where(finite, image, 0.0)
        values = np.ascontiguousarray(values, dtype=np.float32)
        mask = used.astype(np.uint8)
        cv2.accumulate(values, self._sum, mask)
        cv2.accumulateSquare(values, self._squares, mask)
        self._count += mask
        self._frames += 1

    def sums(self) -> StackSums:
        """What was added so far; it changes with the stack."""
        return StackSums(self._sum, self._squares, self._count, self._frames)

    def merge(self, part: StackSums) -> None:
        """Add what another stack of the same size and interpolation has added up.

        Raises
        ------
        InvalidValueError
            If it has another size.
        """
        if part.total.shape != self._sum.shape:
            raise InvalidValueError(
                f"sums of shape {part.total.shape}", expected=f"{self._sum.shape}"
            )
        self._sum += part.total
        self._squares += part.squares
        self._count += part.count
        self._frames += part.frames

    def result(self) -> StackedImage:
        """The average of all that was added so far."""
        n = self._count.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = self._sum / n
            scatter = np.maximum(self._squares - n * mean**2, 0.0) / (n - 1.0)
            error = np.sqrt(scatter / n)
        error[self._count < 2] = np.nan
        return StackedImage(
            mean.astype(np.float32), error.astype(np.float32), self._count.copy(), self._frames
        )


def find_scanned(
    map_x: NDArray[np.float32], map_y: NDArray[np.float32], size: tuple[int, int], reach: int = 0
) -> Mask:
    """Which output pixels come from scanned pixels only, (h, w) bool.

    Parameters
    ----------
    map_x, map_y
        (h, w) raw pixel of each output pixel, as :meth:`~semcal_ros.core.rectification.rectifier.Rectifier.maps`
        gives them.
    size
        (width, height) of the raw frame.
    reach
        Pixels beyond the two nearest ones that the interpolation takes: 0 for linear, 1 for cubic,
        3 for lanczos4.
    """
    width, height = size
    low = reach - EDGE_PX
    inside_x = (map_x >= low) & (map_x <= width - 1 - low)
    return np.asarray(inside_x & (map_y >= low) & (map_y <= height - 1 - low))


def _check_grey(image: NDArray[np.generic], size: tuple[int, int]) -> NDArray[np.float32]:
    width, height = size
    if image.shape != (height, width) or image.dtype.kind not in "uif":
        raise InvalidValueError(
            f"an image of shape {image.shape} and type {image.dtype}",
            expected=f"({height}, {width}) grey levels",
        )
    return image.astype(np.float32)
