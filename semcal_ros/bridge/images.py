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

"""sensor_msgs/msg/Image to and from arrays."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.fields import (
    HeaderMessage,
    byte_memory,
    copy_header,
    require_fields,
    whole_number,
)
from semcal_ros.core.errors import InvalidValueError, MessageError


class PixelFormat(NamedTuple):
    """Array type of an encoding."""

    dtype: np.dtype[Any]
    channels: int

    @property
    def bytes_per_pixel(self) -> int:
        """Bytes of one pixel, all channels."""
        return int(self.dtype.itemsize) * self.channels


ENCODINGS: Mapping[str, PixelFormat] = MappingProxyType(
    {
        "mono8": PixelFormat(np.dtype(np.uint8), 1),
        "mono16": PixelFormat(np.dtype(np.uint16), 1),
        "32FC1": PixelFormat(np.dtype(np.float32), 1),
        "bgr8": PixelFormat(np.dtype(np.uint8), 3),
        "rgb8": PixelFormat(np.dtype(np.uint8), 3),
    }
)
_FIELDS = ("height", "width", "encoding", "is_bigendian", "step", "data")
_GRAY_CODES = {"bgr8": cv2.COLOR_BGR2GRAY, "rgb8": cv2.COLOR_RGB2GRAY}


def image_from_message(
    message: Any, encodings: Mapping[str, PixelFormat] = ENCODINGS
) -> NDArray[Any]:
    """Return the pixels of an image message in the byte order of this machine.

    Parameters
    ----------
    message
        An image with an encoding of ``encodings``; row padding (``step``) and ``is_bigendian``
        are honoured.
    encodings
        What is accepted.

    Returns
    -------
    Read-only array of shape (height, width) or (height, width, 3), of the type of the encoding:
    uint8, uint16 or float32. It shares memory with the message where the layout allows it, so it is
    valid as long as the message is not changed.

    Raises
    ------
    MessageError
        The encoding is not accepted, the image is empty, or the length of the data does not fit
        size and step.
    """
    require_fields(message, _FIELDS, "sensor_msgs/msg/Image")
    pixel = _pixel_format(message.encoding, encodings)
    height, width, step, big_endian = (
        whole_number(getattr(message, name), name)
        for name in ("height", "width", "step", "is_bigendian")
    )
    row_bytes = width * pixel.bytes_per_pixel
    data = _byte_view(message.data)
    _check_layout(height, width, step, data.size, message.encoding, row_bytes)
    rows = data.reshape(height, step)[:, :row_bytes]
    shape = (height, width) if pixel.channels == 1 else (height, width, pixel.channels)
    if pixel.dtype.itemsize == 1:
        image = _split_channels(rows, pixel.channels)
    else:
        image = _wide_pixels(rows, pixel.dtype, big_endian != 0).reshape(shape)
    image.flags.writeable = False
    return image


def _pixel_format(encoding: str, encodings: Mapping[str, PixelFormat]) -> PixelFormat:
    pixel = encodings.get(encoding) if isinstance(encoding, str) else None
    if pixel is None:
        raise MessageError(
            f"an image with encoding {str(encoding)[:40]!r}",
            expected="one of " + ", ".join(encodings),
            do="convert the stream, for example with image_proc, or change the driver's setting",
        )
    return pixel


def _byte_view(data: Any) -> NDArray[np.uint8]:
    try:
        return np.frombuffer(data, dtype=np.uint8) if len(data) else np.empty(0, np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise MessageError(
            f"image data of type {type(data).__name__}", expected="contiguous bytes"
        ) from error


def _check_layout(
    height: int, width: int, step: int, size: int, encoding: str, row_bytes: int
) -> None:
    if height < 1 or width < 1:
        raise MessageError(
            f"an image of {width} x {height} pixels",
            expected="at least one pixel in each direction",
        )
    if step < row_bytes:
        raise MessageError(
            f"an image of {width} {encoding} pixels per row with a step of {step} bytes",
            expected=f"a step of at least {row_bytes} bytes",
            do="correct the driver that fills the message",
        )
    if size != step * height:
        kind = "truncated" if size < step * height else "overlong"
        raise MessageError(
            f"{kind} image data of {size} bytes for {height} rows with a step of {step} bytes",
            expected=f"{step * height} bytes",
            do="check the driver or the recording",
        )


def _split_channels(rows: NDArray[np.uint8], channels: int) -> NDArray[np.uint8]:
    if channels == 1:
        return rows[:]
    # A copy of padded rows: reshaping the last axis of a strided array cannot be a view in every
    # NumPy.
    pixels: NDArray[np.uint8] = np.ascontiguousarray(rows).reshape(rows.shape[0], -1, channels)
    return pixels


def _wide_pixels(rows: NDArray[np.uint8], dtype: np.dtype[Any], big_endian: bool) -> NDArray[Any]:
    pixels: NDArray[Any] = np.ascontiguousarray(rows).view(
        dtype.newbyteorder(">" if big_endian else "<")
    )
    # Bytes of a bag may start at any address; a copy in native order is what OpenCV needs.
    native_view = pixels.dtype.isnative and pixels.flags.aligned
    native: NDArray[Any] = pixels.view(dtype) if native_view else pixels.astype(dtype)
    return native


def to_gray(image: NDArray[Any], encoding: str = "bgr8") -> NDArray[Any]:
    """Convert to a one-channel image of the same depth.

    Parameters
    ----------
    image
        (height, width), returned as it is, or (height, width, 3) uint8.
    encoding
        ``bgr8`` or ``rgb8``: the order of three channels. Luma weights of ITU-R BT.601; equal
        channels stay exact.

    Raises
    ------
    InvalidValueError
        The shape or the encoding is not one of these.
    """
    if image.ndim == 2:
        return image
    code = _GRAY_CODES.get(encoding)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or code is None:
        raise InvalidValueError(
            f"{encoding} image of shape {image.shape} and type {image.dtype}",
            expected="a 2-D image, or bgr8 or rgb8 with three uint8 channels",
        )
    gray: NDArray[Any] = cv2.cvtColor(image, code)
    return gray


def without_databar(image: NDArray[Any], databar_rows: int) -> NDArray[Any]:
    """Return a view without the rows at the bottom; raise :class:`MessageError` if no row is left."""
    if not 0 <= databar_rows < image.shape[0]:
        raise MessageError(
            f"an image of {image.shape[0]} rows with a data bar of {databar_rows} rows",
            expected="a data bar lower than the image",
            do="correct --databar-rows, or image.databar_rows in the configuration",
        )
    return image[: image.shape[0] - databar_rows]


def fill_image(
    message: Any,
    image: NDArray[Any],
    encoding: str,
    header: HeaderMessage,
    encodings: Mapping[str, PixelFormat] = ENCODINGS,
) -> None:
    """Set every field of an image message; the pixels are copied and rows are not padded.

    Parameters
    ----------
    message
        The message to fill.
    image
        (height, width) or (height, width, 3) of exactly the type of ``encoding``.
    encoding
        One of ``encodings``.
    header
        Copied verbatim.
    encodings
        What can be filled in.

    Raises
    ------
    InvalidValueError
        Shape or type of the image do not fit the encoding.
    """
    np.copyto(pixel_memory(message, image, encoding, header, encodings), image)


def pixel_memory(
    message: Any,
    like: NDArray[Any],
    encoding: str,
    header: HeaderMessage,
    encodings: Mapping[str, PixelFormat] = ENCODINGS,
) -> NDArray[Any]:
    """Set every field of an image message but the pixels, and return the memory for them.

    Parameters
    ----------
    message
        The message. If it is reused for an image of the same size it keeps its memory, so an array
        returned for it before changes too.
    like
        Array of the shape and type that the image will have; those of ``encoding``.
    encoding, header, encodings
        As for :func:`fill_image`.

    Returns
    -------
    Writeable array of the shape of ``like``, in the byte order of this machine,
    uninitialised.

    Raises
    ------
    InvalidValueError
        As :func:`fill_image`.
    """
    pixel = encodings.get(encoding)
    if pixel is None:
        raise InvalidValueError(
            f"image encoding {encoding!r}", expected="one of " + ", ".join(encodings)
        )
    dimensions_fit = like.ndim == 2 if pixel.channels == 1 else like.shape[2:] == (pixel.channels,)
    if not dimensions_fit or like.size == 0 or like.dtype.newbyteorder("=") != pixel.dtype:
        raise InvalidValueError(
            f"an image of shape {like.shape} and type {like.dtype} for encoding {encoding}",
            expected=f"a non-empty {pixel.dtype} image with {pixel.channels} channel(s)",
        )
    copy_header(message.header, header)
    message.height, message.width = int(like.shape[0]), int(like.shape[1])
    message.encoding = encoding
    message.is_bigendian = int(sys.byteorder == "big")
    message.step = message.width * pixel.bytes_per_pixel
    memory = byte_memory(message, "data", like.size * pixel.dtype.itemsize)
    pixels: NDArray[Any] = memory.view(pixel.dtype).reshape(like.shape)
    return pixels
