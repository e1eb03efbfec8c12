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

"""Undo distortion, skew and drift of a frame in one interpolation, into square pixels.

The raw position of every output pixel (:mod:`semcal_ros.core.rectification.raw_positions`) is computed in bands of
rows that stay in the processor's cache while the image is resampled at them
(:mod:`semcal_ros.core.rectification.chebyshev_map`); a map that is needed a second time is kept as a whole.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import RESAMPLED_TYPES, AnyImage, Array32, check_image
from semcal_ros.core.caches import LruCache
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.chebyshev_map import RawMap, SmoothMaps
from semcal_ros.core.rectification.raw_positions import (
    RasterDrift,
    camera_key,
    check_drift,
    drift_key,
)
from semcal_ros.core.rectification.thresholds import BAND_PIXELS, MAPS_KEPT, SIDE_MAX_PX

_INTERPOLATIONS = {
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos4": cv2.INTER_LANCZOS4,
}


class Rectifier:
    """Rectifies frames, keeping the parts of the maps that do not change.

    Parameters
    ----------
    interpolation
        ``"linear"`` (the default), ``"cubic"`` or ``"lanczos4"``. OpenCV 4 rounds positions of the
        map to 1/32 px.

    Notes
    -----
    The image keeps its size and type. Pixels that were not scanned come out as 0. Bands of a frame
    are resampled by as many threads as OpenCV uses (``cv2.setNumThreads``); an instance itself is
    not meant to be shared between threads.
    """

    def __init__(self, interpolation: str = "linear") -> None:
        if interpolation not in _INTERPOLATIONS:
            raise InvalidValueError(
                f"interpolation {interpolation!r}", expected=" or ".join(_INTERPOLATIONS)
            )
        self._interpolation = interpolation
        self._flag = _INTERPOLATIONS[interpolation]
        self._smooth = SmoothMaps()
        self._maps: LruCache[tuple[object, ...], tuple[Array32, Array32]] = LruCache(MAPS_KEPT)
        self._last: tuple[object, ...] | None = None
        self._scratch: deque[Array32] = deque()

    def __reduce__(self) -> tuple[type[Rectifier], tuple[str]]:
        """Without its maps, which another process computes in less time than they take to arrive."""
        return type(self), (self._interpolation,)

    def rectify(
        self,
        image: AnyImage,
        camera: ScanCamera | None,
        drift: RasterDrift | None = None,
        timing: ScanTiming | None = None,
        *,
        out: AnyImage | None = None,
    ) -> AnyImage:
        """The frame as ``camera.rectified`` would see the specimen at zero drift.

        Parameters
        ----------
        image
            (h, w) or (h, w, 3) of uint8, uint16 or float32.
        camera
            Camera of this frame's magnification; scaled to the image's size if it has another.
            None: the pixels stay where they are.
        drift
            Drift during this frame: in m with a camera, in px without; None for none.
        timing
            Raster timing, by which the drift's velocity shears the frame; None takes the frame as
            an instant.
        out
            C-contiguous array of the image's shape and type to write to and return, such as the
            memory of a message; a new one without.

        Raises
        ------
        InvalidValueError
            If the image has another type or shape, ``out`` does not fit, or the drift is not finite
            or too fast for the raster.
        """
        _check_image(image)
        output = np.empty_like(image, order="C") if out is None else _check_output(out, image)
        if camera is None and drift is None:
            np.copyto(output, image)
            return output
        check_drift(drift)
        height, width = image.shape[:2]
        fitted = None if camera is None else camera.resized(width, height)
        key = camera_key((width, height), fitted) + drift_key(drift, timing)
        if key in self._maps or key == self._last:
            # A map that is needed twice is likely to be needed again.
            return self._remap(image, *self._whole_maps(key, fitted, drift, timing), output)
        self._last = key
        raw_map = self._smooth.make_map((width, height), fitted, drift, timing)
        self._resample_in_bands(image, raw_map, output)
        return output

    def maps(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift | None = None,
        timing: ScanTiming | None = None,
    ) -> tuple[Array32, Array32]:
        """Raw x and y, (h, w) float32 each, of every output pixel of an image of ``size`` (width,
        height).
        """
        check_drift(drift)
        fitted = None if camera is None else camera.resized(*size)
        key = camera_key(size, fitted) + drift_key(drift, timing)
        return self._whole_maps(key, fitted, drift, timing)

    def remapped(self, image: AnyImage, map_x: Array32, map_y: Array32) -> AnyImage:
        """The image at raw positions as :meth:`maps` gives them; 0 outside it."""
        return self._remap(image, map_x, map_y, None)

    def _remap(
        self, image: AnyImage, map_x: Array32, map_y: Array32, out: AnyImage | None
    ) -> AnyImage:
        raw, output = cast("NDArray[np.float32]", image), cast("NDArray[np.float32]", out)
        border = cv2.BORDER_CONSTANT
        warped = cv2.remap(raw, map_x, map_y, self._flag, output, borderMode=border, borderValue=0)
        return np.asarray(warped)

    # -- maps -------------------------------------------------------------------------------------

    def _whole_maps(
        self,
        key: tuple[object, ...],
        camera: ScanCamera | None,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> tuple[Array32, Array32]:
        """Both maps of the size that the key begins with, kept for the next frame."""
        return self._maps.get_or_compute(
            key, lambda: self._compute_maps(key, camera, drift, timing)
        )

    def _compute_maps(
        self,
        key: tuple[object, ...],
        camera: ScanCamera | None,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> tuple[Array32, Array32]:
        width, height = cast("tuple[int, int]", key[:2])
        raw_map = self._smooth.make_map((width, height), camera, drift, timing)
        both = np.empty((height, width), np.float32), np.empty((height, width), np.float32)

        def copy(top: int, bottom: int, band: Array32) -> None:
            both[0][top:bottom], both[1][top:bottom] = band[:, :width], band[:, width:]

        self._for_each_band(raw_map, copy)
        return both

    def _resample_in_bands(self, image: AnyImage, raw_map: RawMap, output: AnyImage) -> None:
        width = raw_map.size[0]

        def resample(top: int, bottom: int, band: Array32) -> None:
            self._remap(image, band[:, :width], band[:, width:], output[top:bottom])

        self._for_each_band(raw_map, resample)

    def _for_each_band(self, raw_map: RawMap, use: Callable[[int, int, Array32], None]) -> None:
        """Call ``use`` with first row, end and maps of all bands, in several threads."""
        width, height = raw_map.size
        rows = max(BAND_PIXELS // width, 1)
        tops = deque(range(0, height, rows))

        def work() -> None:
            try:
                scratch = self._scratch.pop()
            except IndexError:
                scratch = np.empty((0, 0), np.float32)
            if scratch.shape != (rows, 2 * width):
                scratch = np.empty((rows, 2 * width), np.float32)
            while tops:
                try:
                    top = tops.popleft()
                except IndexError:
                    break
                bottom = min(top + rows, height)
                band = scratch[: bottom - top]
                raw_map.band(top, bottom, band)
                use(top, bottom, band)
            self._scratch.append(scratch)

        helpers = min(cv2.getNumThreads(), len(tops)) - 1
        others = [_helpers().submit(work) for _ in range(helpers)]
        work()
        for other in others:
            # On a busy machine all is done before another thread has begun.
            if not other.cancel():
                other.result()


@lru_cache(maxsize=1)
def _helpers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(cv2.getNumThreads() - 1, 1), thread_name_prefix="rectify")


def _check_image(image: AnyImage) -> None:
    check_image(image, types=RESAMPLED_TYPES)
    if max(image.shape) > SIDE_MAX_PX:
        raise InvalidValueError(
            f"an image of {image.shape[1]} x {image.shape[0]} px",
            expected=f"at most {SIDE_MAX_PX} px along each side",
        )


def _check_output(out: AnyImage, image: AnyImage) -> AnyImage:
    same = out.shape == image.shape and out.dtype == image.dtype
    if not (same and out.flags.c_contiguous and out.flags.writeable):
        raise InvalidValueError(
            f"an output of shape {out.shape} and type {out.dtype}",
            expected=f"a writeable contiguous one of shape {image.shape} and type {image.dtype}",
        )
    return out
