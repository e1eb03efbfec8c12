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

"""Grey images as files: TIFF with its pixel size, and PNG."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_bytes

__all__ = ["GREY_SUFFIXES", "TIFF_SUFFIXES", "write_grey_image"]

TIFF_SUFFIXES = (".tif", ".tiff")
GREY_SUFFIXES = (*TIFF_SUFFIXES, ".png")


def write_grey_image(
    path: Path,
    values: NDArray[np.float32],
    pixel_size_m: tuple[float, float],
    dtype: np.dtype[Any] | None = None,
) -> None:
    """Write grey levels completely or not at all.

    Parameters
    ----------
    path
        ``.tif`` or ``.tiff`` for 32-bit grey levels with their pixel size, ``.png`` for whole
        numbers.
    values
        (h, w) grey levels; NaN is written to a PNG as 0.
    pixel_size_m
        (x, y) in m.
    dtype
        Type of the grey levels in a PNG, uint8 or uint16.

    Raises
    ------
    InvalidValueError
        If a PNG is wanted of other grey levels, or the suffix is not one of these.
    OSError
        If the file cannot be written; an existing one is untouched.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF_SUFFIXES:
        data = _encode_tiff(values, pixel_size_m)
    elif suffix == ".png" and dtype is not None and dtype.kind == "u":
        top = np.iinfo(dtype).max
        levels = np.clip(np.rint(np.nan_to_num(values)), 0, top).astype(dtype)
        data = bytes(cv2.imencode(".png", levels)[1])
    else:
        raise InvalidValueError(
            f"{path} for grey levels of type {dtype}",
            expected="a .tif, which holds grey levels of 32 bits, or a .png of 8 or 16 bits",
        )
    atomic_write_bytes(path, data)


def _encode_tiff(values: NDArray[np.float32], pixel_size_m: tuple[float, float]) -> bytes:
    """Encode a file of 32-bit grey levels whose pixel size ImageJ understands."""
    per_um = [1e-6 / size for size in pixel_size_m]
    file = io.BytesIO()
    tifffile.imwrite(
        file,
        values,
        imagej=True,
        resolution=(per_um[0], per_um[1]),
        metadata={"axes": "YX", "unit": "um"},
    )
    return file.getvalue()
