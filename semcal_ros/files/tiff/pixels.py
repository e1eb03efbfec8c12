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

"""Grey pixels of a TIFF page."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from semcal_ros.bridge.codec_headers import MAX_PIXELS as MAX_MESSAGE_PIXELS
from semcal_ros.core.errors import TiffError

# These limits bound the memory that a damaged header can request.
MAX_SIDE_PX = 65_536
# Twice the largest image of a message, 1 GiB at 16 bits: the largest frame may have a data bar below
# it, and a user chooses files, whereas messages come from anyone.
MAX_PIXELS = 2 * MAX_MESSAGE_PIXELS
_MAX_SAMPLES = 4  # red, green, blue, alpha
# Above what Deflate (1032) and LZW reach: beyond, the pixels are not in the file.
_MAX_PACKING = 4096
# Tags of one number: sizes, compression, photometric, orientation, samples, rows per strip, planes, predictor, tiles.
_SINGLE = frozenset({256, 257, 259, 262, 266, 274, 277, 278, 284, 317, 322, 323})
# Offset of the first directory, number of its entries, and an entry's code, type, count and value.
_LAYOUTS = {42: (4, "I", "H", "HHI4x"), 43: (8, "Q", "Q", "HHQ8x")}
# OpenCV decodes other kinds, too, but shows damaged parts as black, without a word.
_DECODED_HERE = (
    tifffile.COMPRESSION.NONE,
    tifffile.COMPRESSION.ADOBE_DEFLATE,
    tifffile.COMPRESSION.DEFLATE,
)
_LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601


def check_directories(path: Path, *, pages: int = 1) -> int:
    """Return the number of directories, of ``pages`` at most, after a check that they can be parsed.

    Refused are several values in a single-value tag, which the parser would multiply, and directories in a loop, of
    which it would drop all but the first. Other damage is left to the parser, ``struct.error`` and ``OSError``
    included.
    """
    with path.open("rb") as file:
        head = file.read(16)
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        layout = _LAYOUTS.get(struct.unpack_from(order + "H", head, 2)[0]) if order else None
        if order is None or layout is None:
            return pages
        place, offset_code, number_code, entry_code = layout
        (offset,) = struct.unpack_from(order + offset_code, head, place)
        number_size, size = (struct.calcsize(order + code) for code in (number_code, entry_code))
        seen: set[int] = set()
        while offset and len(seen) < pages:
            if offset in seen:
                raise TiffError(
                    f"{path.name} has {len(seen)} directories in a loop",
                    expected="a last one",
                    do="copy it again from the microscope",
                )
            seen.add(offset)
            file.seek(offset)
            (number,) = struct.unpack(order + number_code, file.read(number_size))
            entries = file.read(min(number, 2**16) * size)
            for code, _, count in struct.iter_unpack(
                order + entry_code, entries[: len(entries) // size * size]
            ):
                if code in _SINGLE and count != 1:
                    raise TiffError(f"{path.name} has {count} values in tag {code}", expected="one")
            if len(seen) < pages:
                file.seek(offset + number_size + number * size)
                (offset,) = struct.unpack(
                    order + offset_code, file.read(struct.calcsize(order + offset_code))
                )
    return len(seen)


def page_size(path: Path, page: tifffile.TiffPage) -> tuple[int, int]:
    """Return the (width, height) of a page, checked before anything is allocated.

    Raises
    ------
    TiffError
        The page is empty, too large to be an SEM image, or larger than its file can hold.
    """
    width, height = int(page.imagewidth), int(page.imagelength)
    if not (
        0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX and width * height <= MAX_PIXELS
    ):
        raise TiffError(
            f"{path.name} declares {width} x {height} pixels",
            expected=f"at most {MAX_SIDE_PX} a side and {MAX_PIXELS} in all",
            do="check that the file is complete",
        )
    bits, samples = page.bitspersample, int(page.samplesperpixel)
    if (bits not in (8, 16) and not _is_float(page)) or page.imagedepth != 1:
        raise TiffError(
            f"{path.name} has {bits} bits per sample",
            expected="8 or 16, or grey levels of 32 bits with a decimal point",
            do="save it with 16 bits, in ImageJ by Image > Type > 16-bit",
        )
    if not 1 <= samples <= _MAX_SAMPLES:
        raise TiffError(
            f"{path.name} has {samples} samples per pixel", expected=f"1 to {_MAX_SAMPLES}"
        )
    size, needed = path.stat().st_size, width * height * samples * bits // 8
    if needed > size * (1 if page.compression == tifffile.COMPRESSION.NONE else _MAX_PACKING):
        raise TiffError(
            f"{path.name} declares {width} x {height} pixels in a file of {size} bytes",
            expected="a file that holds its pixels",
            do="copy it again from the microscope",
        )
    return width, height


def _is_float(page: tifffile.TiffPage) -> bool:
    """Whether the page has the grey levels with a decimal point that ImageJ writes as 32-bit."""
    return page.dtype == np.float32 and int(page.samplesperpixel) == 1


def _lookup(image: NDArray[Any], colormap: NDArray[Any]) -> NDArray[Any]:
    """Return the grey values of a palette image; the usual grey ramp leaves the indices as they are."""
    table = _LUMA @ np.asarray(colormap, dtype=np.float64) / 257.0
    ramp = np.linspace(0.0, 255.0, table.size)
    if image.dtype == np.uint8 and np.allclose(table, ramp, atol=1.0):
        return image
    return np.asarray(np.rint(table).astype(np.uint8)[image])


def _to_grey(image: NDArray[Any], page: tifffile.TiffPage) -> NDArray[Any]:
    if page.colormap is not None and image.ndim == 2:
        return _lookup(image, page.colormap)
    if image.ndim == 3:
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
            image = np.moveaxis(image, 0, -1)
        mixed = image[..., :3].astype(np.float64) @ _LUMA
        return np.asarray(np.rint(mixed).astype(image.dtype))
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        # Grey levels with a decimal point have no largest value.
        white = 0 if image.dtype.kind == "f" else np.iinfo(image.dtype).max
        return np.asarray(white - image)
    return image


def _decode_by_opencv(path: Path, index: int) -> NDArray[Any]:
    """Decode a grey image with OpenCV's TIFF decoder, which needs no further packages for LZW."""
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    if index == 0:
        image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), flags)
    else:
        _, images = cv2.imreadmulti(str(path), index, 1, flags=flags)
        image = images[0] if images else None
    if image is None:
        raise ValueError("the compressed image cannot be decoded")
    return np.asarray(image)


def grey_image(path: Path, page: tifffile.TiffPage) -> NDArray[Any]:
    """Decode the (h, w) uint8, uint16 or float32 image of a page whose size was checked.

    Raises
    ------
    ValueError, OSError
        The pixel data are truncated or damaged.
    """
    size = (int(page.imagelength), int(page.imagewidth))
    if page.compression in _DECODED_HERE:
        image = _to_grey(np.asarray(page.asarray()), page)
    else:
        image = _decode_by_opencv(path, page.index)
    if image.shape != size or image.dtype not in (np.uint8, np.uint16, np.float32):
        raise ValueError(f"the decoded image is {image.dtype} {image.shape}")
    return np.ascontiguousarray(image)
