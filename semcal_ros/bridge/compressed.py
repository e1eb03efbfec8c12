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

"""sensor_msgs/msg/CompressedImage to and from arrays, as image_transport's `compressed` writes and reads it.

The field ``format`` is ``ORIGINAL; CODEC compressed TARGET``: the encoding of the raw image, the codec, and for colour
the order in which the codec got its channels. Described in sensor_msgs/msg/CompressedImage
(https://docs.ros.org/en/jazzy/p/sensor_msgs/msg/CompressedImage.html); what is written in each case, and how it is read
where a part is missing, are those of compressed_image_transport
(https://github.com/ros-perception/image_transport_plugins, compressed_publisher.cpp and compressed_subscriber.cpp).
cv_bridge and other publishers give the codec alone.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.codec_headers import CodecHeader, read_codec_header
from semcal_ros.bridge.fields import HeaderMessage, assign_bytes, copy_header, require_fields
from semcal_ros.bridge.images import ENCODINGS, image_from_message
from semcal_ros.core.errors import InvalidValueError, MessageError
from semcal_ros.core.wording import did_you_mean

CODECS = {"png": ("mono8", "mono16", "bgr8", "rgb8"), "jpeg": ("mono8", "bgr8", "rgb8")}
"""Codecs and the encodings that each carries; PNG without loss."""

_CODEC_NAMES = {"png": "png", "jpeg": "jpeg", "jpg": "jpeg"}
# Names that some drivers use for grey values.
_SAME = {"8UC1": "mono8", "16UC1": "mono16"}
_FORMATS = "png, jpeg, or such as 'mono16; png compressed ' with " + ", ".join(CODECS["png"])


def decoded_image(message: Any) -> tuple[NDArray[Any], str]:
    """Pixels and encoding of a sensor_msgs/msg/Image or a sensor_msgs/msg/CompressedImage.

    Raises
    ------
    MessageError
        As :func:`~semcal_ros.bridge.images.image_from_message` and :func:`image_from_compressed`.
    """
    if hasattr(message, "format"):
        return image_from_compressed(message)
    return image_from_message(message), str(message.encoding)


# -- reading -------------------------------------------------------------------------------------------


def describe_compressed(message: Any) -> tuple[tuple[int, int], str]:
    """(width, height) and encoding of a compressed image without decoding it; raises as
    :func:`image_from_compressed`.
    """
    require_fields(message, ("format", "data"), "sensor_msgs/msg/CompressedImage")
    header = read_codec_header(_read_bytes(message.data).data)
    return (header.width, header.height), _agree_on_encoding(str(message.format), header)[0]


def image_from_compressed(message: Any) -> tuple[NDArray[Any], str]:
    """Pixels of a compressed image, and their encoding.

    Parameters
    ----------
    message
        PNG with 8 or 16 bit grey or 8 bit colour, or JPEG with 8 bit grey or colour. An orientation in its metadata is
        ignored: a frame lies as it was scanned. JPEG has no checksum, so a damaged one whose structure is whole decodes
        to wrong pixels.

    Returns
    -------
    Read-only array of shape (height, width) or (height, width, 3), dtype uint8 or uint16, and one of ``mono8``,
    ``mono16``, ``bgr8``, ``rgb8``. A 16 bit stream that its publisher reduced to 8 bit for JPEG is ``mono8``.

    Raises
    ------
    MessageError
        The data are empty, damaged, declare an absurd size, or are of an unsupported kind; or ``format`` is not
        understood or contradicts the data.
    """
    require_fields(message, ("format", "data"), "sensor_msgs/msg/CompressedImage")
    data = _read_bytes(message.data)
    header = read_codec_header(data.data)
    encoding, swapped = _agree_on_encoding(str(message.format), header)
    image = _decode(data, header)
    if swapped:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    image.flags.writeable = False
    return image, encoding


def _read_bytes(data: Any) -> NDArray[np.uint8]:
    if len(data) == 0:
        raise MessageError(
            "a compressed image without data", expected="PNG or JPEG", do="check the publisher"
        )
    try:
        return np.frombuffer(data, dtype=np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise MessageError(
            f"compressed image data of type {type(data).__name__}", expected="contiguous bytes"
        ) from error


def _agree_on_encoding(text: str, header: CodecHeader) -> tuple[str, bool]:
    """Return the encoding of the image, and whether its decoded channels must be reversed."""
    original, codec, target = _parse_format(text)
    if codec and codec != header.codec:
        raise _make_contradiction(text, header)
    if not original:
        return header.encoding, False
    if original in ("bgr8", "rgb8") and header.encoding == "bgr8":
        # Without a target, image_transport takes the channels for red, green, blue.
        got = "bgr" if target.startswith("bgr") else "rgb"
        return original, not original.startswith(got)
    if original == "mono16" and (header.codec, target) == ("jpeg", "mono8"):
        original = "mono8"
    if original != header.encoding:
        raise _make_contradiction(text, header)
    return original, False


def _parse_format(text: str) -> tuple[str, str, str]:
    """Split a ``format`` into original encoding, codec and target; missing parts are empty."""
    before, separator, after = text.partition(";")
    original = _SAME.get(before.strip(), before.strip()) if separator else ""
    words = (after if separator else before).split()
    if not words and not separator:
        return "", "", ""
    codec = _CODEC_NAMES.get(words[0].lower(), "") if words else ""
    known = words[1:2] in ([], ["compressed"]) and len(words) <= 3
    if not codec or not known or original not in ("", *CODECS["png"]):
        raise MessageError(
            f"a compressed image of format {text[:60]!r}",
            expected=_FORMATS,
            do="change the publisher's setting, or send sensor_msgs/msg/Image",
        )
    return original, codec, words[2] if len(words) == 3 else ""


def _make_contradiction(text: str, header: CodecHeader) -> MessageError:
    return MessageError(
        f"a compressed image of format {text[:60]!r} whose data are {header.encoding} as {header.codec}",
        expected="data as the format says",
        do="correct the publisher",
    )


def _decode(data: NDArray[np.uint8], header: CodecHeader) -> NDArray[Any]:
    pixel = ENCODINGS[header.encoding]
    channels = () if pixel.channels == 1 else (pixel.channels,)
    # Unchanged: no conversion of depth or colour, and no rotation by an orientation in the metadata.
    image: Any = None
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        reason = " ".join(str(error).split())
        raise MessageError(f"a {header.codec} that cannot be decoded: {reason}") from error
    if image is None:
        raise MessageError(
            f"a {header.codec} that cannot be decoded",
            expected="an intact one",
            do="check the publisher or the recording",
        )
    if image.shape != (header.height, header.width, *channels) or image.dtype != pixel.dtype:
        raise MessageError(
            f"a {header.codec} that decodes to {image.dtype} of shape {image.shape}",
            expected=f"{header.width} x {header.height} pixels {header.encoding}, as its header says",
        )
    decoded: NDArray[Any] = image
    return decoded


# -- writing -------------------------------------------------------------------------------------------


def fill_compressed(
    message: Any,
    image: NDArray[Any],
    encoding: str,
    header: HeaderMessage,
    codec: str,
    *,
    jpeg_quality: int = 95,
    png_level: int = 3,
) -> None:
    """Set every field of a compressed image message.

    Parameters
    ----------
    message
        The message to fill.
    image
        (height, width) or (height, width, 3) of exactly the type of ``encoding``.
    encoding
        One that the codec carries, see :data:`CODECS`.
    header
        Copied verbatim.
    codec
        ``png`` or ``jpeg``.
    jpeg_quality
        1 to 100.
    png_level
        0 stores the pixels as they are, fast; 1 to 9 compress. The noise of a detector compresses by its distribution
        of grey levels only, not by repetition: all levels above 0 are the same here, and smaller and faster than a
        search for repetitions.

    Raises
    ------
    InvalidValueError
        The codec is unknown or does not carry the encoding or the size; shape or type of the image do not fit the
        encoding; or a setting is out of range.
    """
    _check_carried(codec, encoding)
    pixels = _to_opencv_layout(image, encoding)
    settings = _settings(codec, jpeg_quality, png_level)
    try:
        done, coded = cv2.imencode(f".{codec}", pixels, settings)
    except cv2.error:
        done = False
    if not done:
        raise InvalidValueError(
            f"a {encoding} image of {image.shape[1]} x {image.shape[0]} pixels as {codec}",
            expected="a size that the codec can write (65500 for jpeg)",
            do="choose png" if codec == "jpeg" else "send the raw image",
        )
    copy_header(message.header, header)
    message.format = f"{encoding}; {codec} compressed {_target(encoding, codec)}"
    assign_bytes(message, "data", coded)


def _check_carried(codec: str, encoding: str) -> None:
    if codec not in CODECS:
        raise InvalidValueError(
            f"codec {codec!r}",
            expected="one of " + ", ".join(CODECS),
            do=did_you_mean(codec, CODECS),
        )
    if encoding not in CODECS[codec]:
        fitting = [name for name, carried in CODECS.items() if encoding in carried]
        raise InvalidValueError(
            f"a {encoding} image as {codec}",
            expected="one of " + ", ".join(CODECS[codec]),
            do=f"choose {fitting[0]}" if fitting else "use the raw image",
        )


def _to_opencv_layout(image: NDArray[Any], encoding: str) -> NDArray[Any]:
    """Return the image as OpenCV writes it: contiguous, blue first."""
    pixel = ENCODINGS[encoding]
    shape_fits = image.ndim == 2 if pixel.channels == 1 else image.shape[2:] == (pixel.channels,)
    if not shape_fits or image.size == 0 or image.dtype.newbyteorder("=") != pixel.dtype:
        raise InvalidValueError(
            f"an image of shape {image.shape} and type {image.dtype} for encoding {encoding}",
            expected=f"a non-empty {pixel.dtype} image with {pixel.channels} channel(s)",
        )
    native: NDArray[Any] = np.ascontiguousarray(image, dtype=pixel.dtype)
    return cv2.cvtColor(native, cv2.COLOR_RGB2BGR) if encoding == "rgb8" else native


def _settings(codec: str, jpeg_quality: int, png_level: int) -> list[int]:
    name, value, low, high = {
        "jpeg": ("jpeg_quality", jpeg_quality, 1, 100),
        "png": ("png_level", png_level, 0, 9),
    }[codec]
    if not low <= value <= high:
        raise InvalidValueError(f"{name} of {value}", expected=f"{low} to {high}")
    if codec == "jpeg":
        return [cv2.IMWRITE_JPEG_QUALITY, value]
    settings = [
        cv2.IMWRITE_PNG_COMPRESSION,
        value,
        cv2.IMWRITE_PNG_STRATEGY,
        cv2.IMWRITE_PNG_STRATEGY_RLE,
    ]
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):
        # Older OpenCV tries all filters on every row, in twice the time of the one that noise prefers.
        best = cv2.IMWRITE_PNG_FILTER_AVG if value else cv2.IMWRITE_PNG_FILTER_NONE
        settings += [cv2.IMWRITE_PNG_FILTER, best]
    return settings


def _target(encoding: str, codec: str) -> str:
    if encoding in ("bgr8", "rgb8"):
        return "bgr8"
    return "mono8" if codec == "jpeg" else ""
