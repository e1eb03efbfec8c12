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

"""PNG is exact and JPEG close, streams of image_transport are read as it reads them, and the rest is refused."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from semcal_ros.bridge.codec_headers import MAX_PIXELS
from semcal_ros.bridge.compressed import (
    CODECS,
    decoded_image,
    fill_compressed,
    image_from_compressed,
)
from semcal_ros.bridge.fields import assign_bytes
from semcal_ros.bridge.images import ENCODINGS, fill_image
from semcal_ros.core.errors import InvalidValueError, MessageError
from semcal_ros.files.bags.messages import blank_message

New = Callable[[str], Any]
COMPRESSED = "sensor_msgs/msg/CompressedImage"
SIGNATURE = b"\x89PNG\r\n\x1a\n"


def message_of(new: New, text: str, data: bytes) -> Any:
    message = new(COMPRESSED)
    message.format = text
    assign_bytes(message, "data", np.frombuffer(data, np.uint8))
    return message


def read(text: str, data: bytes) -> tuple[NDArray[Any], str]:
    return image_from_compressed(message_of(blank_message, text, data))


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(
    width: int,
    height: int,
    depth: int,
    colour: int,
    rows: bytes,
    extra: bytes = b"",
    interlace: int = 0,
) -> bytes:
    """A PNG made here, so that the reader is not judged by the writer."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlace)
    body = (
        chunk(b"IHDR", header) + extra + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )
    return SIGNATURE + body


def rows_of(image: NDArray[Any]) -> bytes:
    """Rows of a PNG without filter; samples of two bytes begin with the high one."""
    ordered = image.astype(image.dtype.newbyteorder(">"))
    return b"".join(b"\0" + row.tobytes() for row in ordered)


def encoded(suffix: str, image: NDArray[Any], *parameters: int) -> bytes:
    done, data = cv2.imencode(suffix, image, parameters)
    assert done
    return bytes(data)


def smooth(channels: int = 1) -> NDArray[np.uint8]:
    """Waves of 12 to 40 px, which no quantisation of JPEG at high quality takes away."""
    y, x = np.mgrid[0:61, 0:83]
    waves = [120 + 60 * np.sin(x / (2 + k) + y / 6) * np.cos(y / (3 + k)) for k in range(channels)]
    stacked = np.stack(waves, axis=-1) if channels > 1 else waves[0]
    return np.rint(stacked).astype(np.uint8)


@st.composite
def images(draw: st.DrawFn) -> tuple[str, NDArray[Any]]:
    encoding = draw(st.sampled_from(CODECS["png"]))
    pixel = ENCODINGS[encoding]
    shape = draw(hnp.array_shapes(min_dims=2, max_dims=2, max_side=19))
    if pixel.channels > 1:
        shape += (pixel.channels,)
    return encoding, draw(hnp.arrays(pixel.dtype, shape))


# -- the way there and back ----------------------------------------------------------------------------


@given(case=images(), level=st.integers(0, 9))
@settings(max_examples=150, deadline=None)
def test_png_is_exact(new: New, header: Any, case: tuple[str, NDArray[Any]], level: int) -> None:
    encoding, image = case
    message = new(COMPRESSED)
    fill_compressed(message, image, encoding, header, "png", png_level=level)
    found, name = image_from_compressed(message)
    assert (name, found.dtype, found.shape) == (encoding, image.dtype, image.shape)
    assert not found.flags.writeable
    np.testing.assert_array_equal(found, image)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_001, 999_999_999)
    assert message.header.frame_id == "sem_optical"


@given(case=images())
@settings(max_examples=50, deadline=None)
def test_views_and_the_other_byte_order_are_written_as_they_look(case: tuple[str, Any]) -> None:
    encoding, image = case
    for odd in (image[::-1, ::-1], image.astype(image.dtype.newbyteorder(">"))):
        message = blank_message(COMPRESSED)
        fill_compressed(message, odd, encoding, blank_message("std_msgs/msg/Header"), "png")
        np.testing.assert_array_equal(image_from_compressed(message)[0], odd)


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1), (513, 257)])
def test_sizes_and_sixteen_bits(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 2**16, size, dtype=np.uint16)
    message = blank_message(COMPRESSED)
    fill_compressed(message, image, "mono16", blank_message("std_msgs/msg/Header"), "png")
    np.testing.assert_array_equal(image_from_compressed(message)[0], image)


@pytest.mark.parametrize("encoding", CODECS["jpeg"])
def test_jpeg_is_close(new: New, header: Any, encoding: str) -> None:
    channels = ENCODINGS[encoding].channels
    image = smooth(channels)
    message = new(COMPRESSED)
    fill_compressed(message, image, encoding, header, "jpeg", jpeg_quality=100)
    found, name = image_from_compressed(message)
    assert (name, found.shape) == (encoding, image.shape)
    if channels == 1:
        # All quantisation steps are 1 at quality 100. Coefficients rounded by at most 1/2 err by 1/sqrt(12) in the
        # mean square, and so do the pixels, since the transform keeps lengths; then they are rounded again.
        error = found.astype(float) - image
        assert np.sqrt(np.mean(error**2)) < np.hypot(12**-0.5, 12**-0.5) * 1.1
    else:
        # Colour is also averaged over 2 x 2 px; channels in the wrong order differ by far more.
        error = found.astype(float) - image
        swapped = found[..., ::-1].astype(float) - image
        assert np.sqrt(np.mean(error**2)) < 0.25 * np.sqrt(np.mean(swapped**2))


def test_quality_and_level_do_what_they_say(header: Any) -> None:
    noise = np.random.default_rng(1).normal(128.0, 20.0, (128, 128)).clip(0, 255).astype(np.uint8)
    message = blank_message(COMPRESSED)

    def size(codec: str, **options: int) -> int:
        fill_compressed(message, noise, "mono8", header, codec, **options)
        return len(message.data)

    assert size("jpeg", jpeg_quality=30) < size("jpeg", jpeg_quality=95) < noise.size
    # Stored: the pixels, one byte for each row, and what the file needs beside them.
    assert noise.size + 128 < size("png", png_level=0) < noise.size + 128 + 500
    assert size("png", png_level=3) < 0.9 * noise.size


@pytest.mark.parametrize(
    ("encoding", "codec", "text"),
    [
        ("mono8", "png", "mono8; png compressed "),
        ("mono16", "png", "mono16; png compressed "),
        ("bgr8", "png", "bgr8; png compressed bgr8"),
        ("rgb8", "png", "rgb8; png compressed bgr8"),
        ("mono8", "jpeg", "mono8; jpeg compressed mono8"),
        ("bgr8", "jpeg", "bgr8; jpeg compressed bgr8"),
        ("rgb8", "jpeg", "rgb8; jpeg compressed bgr8"),
    ],
)
def test_the_format_is_that_of_image_transport(
    new: New, header: Any, encoding: str, codec: str, text: str
) -> None:
    pixel = ENCODINGS[encoding]
    image = np.zeros((8, 8) if pixel.channels == 1 else (8, 8, 3), pixel.dtype)
    image[..., -1] = 200
    message = new(COMPRESSED)
    fill_compressed(message, image, encoding, header, codec)
    assert message.format == text
    # Red, which the codec knows by itself whatever is written beside it.
    if (encoding, codec) == ("rgb8", "png"):
        as_bgr = cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(as_bgr[..., ::-1], image)


def test_either_message_type(header: Any) -> None:
    image = smooth()
    raw, compressed = blank_message("sensor_msgs/msg/Image"), blank_message(COMPRESSED)
    fill_image(raw, image, "mono8", header)
    fill_compressed(compressed, image, "mono8", header, "png")
    for message in (raw, compressed):
        found, encoding = decoded_image(message)
        assert encoding == "mono8"
        np.testing.assert_array_equal(found, image)


# -- streams of others ---------------------------------------------------------------------------------

GREY = smooth()
WIDE = GREY.astype(np.uint16) * 257
COLOUR = smooth(3)


@pytest.mark.parametrize(
    ("text", "data", "encoding", "expected"),
    [
        ("mono8; png compressed ", encoded(".png", GREY), "mono8", GREY),
        ("mono8; png compressed", encoded(".png", GREY), "mono8", GREY),
        ("mono8;png compressed mono8", encoded(".png", GREY), "mono8", GREY),
        ("8UC1; png compressed ", encoded(".png", GREY), "mono8", GREY),
        ("mono16; png compressed ", encoded(".png", WIDE), "mono16", WIDE),
        ("16UC1; png compressed", encoded(".png", WIDE), "mono16", WIDE),
        # Written by hand, by cv_bridge, and by early releases.
        ("png", encoded(".png", GREY), "mono8", GREY),
        ("png", encoded(".png", WIDE), "mono16", WIDE),
        ("PNG", encoded(".png", COLOUR), "bgr8", COLOUR),
        ("", encoded(".png", COLOUR), "bgr8", COLOUR),
        # The codec was given the channels in the order that the end of the format names ...
        ("bgr8; png compressed bgr8", encoded(".png", COLOUR), "bgr8", COLOUR),
        ("rgb8; png compressed bgr8", encoded(".png", COLOUR), "rgb8", COLOUR[..., ::-1]),
        ("rgb8; png compressed rgb8", encoded(".png", COLOUR), "rgb8", COLOUR),
        ("bgr8; png compressed rgb8", encoded(".png", COLOUR), "bgr8", COLOUR[..., ::-1]),
        # ... and in that of red, green, blue where it names none.
        ("rgb8; png compressed", encoded(".png", COLOUR), "rgb8", COLOUR),
    ],
)
def test_png_of_others(text: str, data: bytes, encoding: str, expected: NDArray[Any]) -> None:
    image, name = read(text, data)
    assert name == encoding
    np.testing.assert_array_equal(image, expected)
    assert not image.flags.writeable


@pytest.mark.parametrize(
    ("text", "picture", "encoding"),
    [
        ("mono8; jpeg compressed mono8", GREY, "mono8"),
        ("jpeg", GREY, "mono8"),
        ("jpg", COLOUR, "bgr8"),
        ("rgb8; jpeg compressed bgr8", COLOUR, "rgb8"),
        # image_transport halves the depth for JPEG and says so: what is left are 8 bits.
        ("mono16; jpeg compressed mono8", GREY, "mono8"),
    ],
)
def test_jpeg_of_others(text: str, picture: NDArray[Any], encoding: str) -> None:
    data = encoded(".jpg", picture)
    image, name = read(text, data)
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, decoded[..., ::-1] if encoding == "rgb8" else decoded)
    assert name == encoding


def test_progressive_jpeg_and_what_follows_the_end() -> None:
    data = encoded(".jpg", GREY, cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
    plain, _ = read("jpeg", data)
    padded, _ = read("jpeg", data + bytes(100))
    np.testing.assert_array_equal(plain, padded)
    assert np.abs(plain.astype(int) - GREY).max() < 20


def test_a_frame_is_not_turned_by_metadata() -> None:
    tag = struct.pack("<HHII", 0x0112, 3, 1, 6)  # orientation: turn by 90 degrees
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + tag + bytes(4)
    jpeg = encoded(".jpg", GREY)
    turned = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (83, 61, 3)
    assert read("jpeg", turned)[0].shape == GREY.shape == (61, 83)


def test_png_made_by_hand_with_metadata() -> None:
    extra = chunk(b"gAMA", struct.pack(">I", 22222)) + chunk(b"tEXt", b"Software\0test")
    for image, depth in ((GREY, 8), (WIDE, 16)):
        data = png(image.shape[1], image.shape[0], depth, 0, rows_of(image), extra)
        np.testing.assert_array_equal(read("png", data)[0], image)


def test_interlaced_png() -> None:
    # Adam7 takes a 2 x 2 image in three passes: (0, 0), (0, 1), then the second row.
    data = png(2, 2, 8, 0, b"\0\x01\0\x02\0\x03\x04", interlace=1)
    np.testing.assert_array_equal(read("png", data)[0], [[1, 2], [3, 4]])


# -- refusals ------------------------------------------------------------------------------------------

SMALL = np.arange(48, dtype=np.uint8).reshape(6, 8)
PLAIN = png(8, 6, 8, 0, rows_of(SMALL))
JPEG = encoded(".jpg", GREY)


def frame_of(jpeg: bytes) -> int:
    """Where the frame header of a baseline JPEG begins."""
    return jpeg.index(b"\xff\xc0")


def with_frame(jpeg: bytes, change: Callable[[bytearray, int], Any]) -> bytes:
    changed = bytearray(jpeg)
    change(changed, frame_of(jpeg))
    return bytes(changed)


def put(offset: int, value: int, kind: str) -> Callable[[bytearray, int], None]:
    return lambda data, start: struct.pack_into(kind, data, start + offset, value)


BAD_IMAGES = {
    "empty": (b"", "without data"),
    "text": (b"no image at all", "unknown format"),
    "tiff": (encoded(".tiff", GREY.astype(np.float32)), "are TIFF.*Image for 32FC1"),
    "webp": (encoded(".webp", COLOUR), "are WebP"),
    "png signature only": (SIGNATURE, "truncated"),
    "png half": (encoded(".png", GREY)[:2000], "truncated"),
    "png without end": (PLAIN[:-12], "truncated"),
    "png with a chunk beyond its end": (PLAIN[:-8] + b"IENDxxxx", "checksum"),
    "png without header": (SIGNATURE + chunk(b"IDAT", b"") + chunk(b"IEND", b""), "header"),
    "png with two headers": (
        png(
            8, 6, 8, 0, rows_of(SMALL), chunk(b"IHDR", struct.pack(">IIBBBBB", 9, 9, 8, 0, 0, 0, 0))
        ),
        "two headers",
    ),
    "png with pixels missing": (png(8, 6, 8, 0, rows_of(SMALL)[:-9]), "cannot be decoded"),
    "png with no filter of that number": (png(8, 6, 8, 0, b"\7" * 54), "cannot be decoded"),
    "png of 1 bit": (png(8, 6, 1, 0, b"\0\0" * 6), "grey of 1 bit"),
    "png of 16 bit colour": (encoded(".png", COLOUR.astype(np.uint16)), "colour of 16 bit"),
    "png with palette": (
        png(8, 6, 8, 3, rows_of(SMALL * 0), chunk(b"PLTE", b"abc")),
        "palette of 8 bit",
    ),
    "png with alpha": (encoded(".png", np.zeros((6, 8, 4), np.uint8)), "alpha of 8 bit"),
    "png with grey and alpha": (png(8, 6, 8, 4, b"\0" + bytes(16)), "grey and alpha"),
    "png with transparency": (png(8, 6, 8, 0, rows_of(SMALL), chunk(b"tRNS", b"\0\1")), "transp"),
    "png that moves": (
        png(8, 6, 8, 0, rows_of(SMALL), chunk(b"acTL", struct.pack(">II", 1, 0))),
        "animation",
    ),
    "png of no colour type": (png(8, 6, 8, 5, rows_of(SMALL)), "colour type 5"),
    "png with height 0": (png(8, 0, 8, 0, b""), "8 x 0 pixels"),
    "png bomb": (png(2**20, 2**20, 8, 0, b""), f"at most {MAX_PIXELS} pixels"),
    "png declares what it cannot hold": (png(4000, 4000, 16, 0, b"\0"), "pixels per byte"),
    "png of countless chunks": (
        PLAIN[:33] + chunk(b"teXt", b"") * 65536 + PLAIN[33:],
        "more than 65536 chunks",
    ),
    "jpeg start only": (JPEG[:4], "truncated"),
    "jpeg without header": (JPEG[: frame_of(JPEG)] + b"\xff\xd9\0\0", "marker is missing"),
    "jpeg half": (JPEG[: len(JPEG) // 2], "truncated"),
    "jpeg without end": (JPEG[:-2], "truncated"),
    "jpeg with garbage for a marker": (with_frame(JPEG, put(0, 0x1234, ">H")), "marker is missing"),
    "jpeg with a short frame": (with_frame(JPEG, put(2, 4, ">H")), "too short"),
    "jpeg of 12 bit": (with_frame(JPEG, put(4, 12, "B")), "jpeg with 12 bit.*choose png"),
    "jpeg of 16 bit, lossless": (
        with_frame(JPEG, lambda d, at: (put(1, 0xC3, "B")(d, at), put(4, 16, "B")(d, at))),
        "lossless.*16 bit",
    ),
    "jpeg with arithmetic coding": (with_frame(JPEG, put(1, 0xC9, "B")), "arithmetic"),
    "jpeg with four components": (with_frame(JPEG, put(9, 4, "B")), "4 components"),
    "jpeg with height 0": (with_frame(JPEG, put(5, 0, ">H")), "83 x 0 pixels"),
    "jpeg bomb": (
        with_frame(JPEG, lambda d, at: (put(5, 65500, ">H")(d, at), put(7, 65500, ">H")(d, at))),
        f"at most {MAX_PIXELS} pixels",
    ),
    "jpeg declares what it cannot hold": (
        with_frame(JPEG, lambda d, at: (put(5, 8000, ">H")(d, at), put(7, 8000, ">H")(d, at))),
        "pixels per byte",
    ),
    "jpeg of countless scans": (JPEG[:-2] + b"\xff\xda\0\0" * 100 + b"\xff\xd9", "100 scans"),
}


@pytest.mark.parametrize("name", BAD_IMAGES)
def test_images_that_are_refused(new: New, name: str) -> None:
    data, reason = BAD_IMAGES[name]
    with pytest.raises(MessageError, match=reason) as caught:
        image_from_compressed(message_of(new, "", data))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "data", "reason"),
    [
        ("jpeg", encoded(".png", GREY), "data are mono8 as png"),
        ("png", JPEG, "data are mono8 as jpeg"),
        ("mono8; png compressed ", encoded(".png", WIDE), "data are mono16"),
        ("mono16; png compressed ", encoded(".png", GREY), "data are mono8"),
        ("mono16; jpeg compressed ", JPEG, "data are mono8"),
        ("bgr8; png compressed bgr8", encoded(".png", GREY), "data are mono8"),
        ("mono8; jpeg compressed mono8", encoded(".jpg", COLOUR), "data are bgr8"),
        ("32FC1; png compressed ", encoded(".png", WIDE), "32FC1"),
        ("bayer_rggb8; jpeg compressed mono8", JPEG, "bayer_rggb8.*mono16"),
        ("bgra8; jpeg compressed bgr8", encoded(".jpg", COLOUR), "bgra8"),
        ("16UC1; compressedDepth png", bytes(12) + encoded(".png", WIDE), "unknown format"),
        ("16UC1; compressedDepth png", encoded(".png", WIDE), "compressedDepth"),
        ("mono8; tiff compressed ", encoded(".png", GREY), "tiff"),
        ("h264", encoded(".png", GREY), "h264"),
        ("mono8", encoded(".png", GREY), "'mono8'"),
        ("mono8;", encoded(".png", GREY), "'mono8;'"),
        ("mono8; png compressed mono8 twice", encoded(".png", GREY), "twice"),
        ("x" * 10_000, encoded(".png", GREY), "'x{60}'"),
    ],
)
def test_formats_that_are_refused(text: str, data: bytes, reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        read(text, data)


@pytest.mark.parametrize("text", ["mono8; png compressed ", "mono8; jpeg compressed mono8"])
@given(where=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255), cut=st.booleans())
@settings(max_examples=150, deadline=None)
def test_cut_data_are_refused_and_a_damaged_png_too(
    text: str, where: float, flip: int, cut: bool
) -> None:
    data = encoded(".png" if "png" in text else ".jpg", GREY)
    position = int(where * len(data))
    damaged = data[:position] if cut else bytearray(data)
    if not cut:
        damaged[position] ^= flip
    try:
        image, encoding = read(text, bytes(damaged))
    except MessageError:
        return
    assert not cut
    assert (image.dtype, encoding) == (np.uint8, "mono8")
    assert "jpeg" in text, "a PNG has a checksum over every byte"


@given(data=st.binary(max_size=200), png_like=st.booleans())
@settings(max_examples=150, deadline=None)
def test_any_bytes_are_refused_by_the_one_error(data: bytes, png_like: bool) -> None:
    with pytest.raises(MessageError):
        read("", (SIGNATURE if png_like else b"\xff\xd8\xff") + data)


def test_messages_of_other_types_and_data() -> None:
    with pytest.raises(MessageError, match=re.escape("sensor_msgs/msg/CompressedImage")):
        image_from_compressed(blank_message("std_msgs/msg/String"))
    message = blank_message(COMPRESSED)
    message.data = [137, 80]
    with pytest.raises(MessageError, match="contiguous bytes"):
        image_from_compressed(message)


@pytest.mark.parametrize(
    ("encoding", "codec", "options", "reason"),
    [
        ("mono16", "jpeg", {}, "mono16 image as jpeg.*choose png"),
        ("32FC1", "png", {}, "32FC1 image as png.*mono16.*use the raw image"),
        ("32FC1", "jpeg", {}, "32FC1 image as jpeg"),
        ("yuv422", "png", {}, "yuv422"),
        ("mono8", "tiff", {}, "codec 'tiff'.*png, jpeg"),
        ("mono8", "png", {"png_level": 10}, "png_level of 10.*0 to 9"),
        ("mono8", "jpeg", {"jpeg_quality": 0}, "jpeg_quality of 0.*1 to 100"),
    ],
)
def test_what_a_codec_does_not_carry(
    header: Any, encoding: str, codec: str, options: dict[str, int], reason: str
) -> None:
    pixel = ENCODINGS.get(encoding, ENCODINGS["mono8"])
    message = blank_message(COMPRESSED)
    with pytest.raises(InvalidValueError, match=reason):
        fill_compressed(message, np.zeros((4, 4), pixel.dtype), encoding, header, codec, **options)
    assert (message.format, len(message.data)) == ("", 0)


@pytest.mark.parametrize(
    ("image", "encoding"),
    [
        (np.zeros((4, 4), np.uint16), "mono8"),
        (np.zeros((4, 4, 3), np.uint8), "mono8"),
        (np.zeros((4, 4), np.uint8), "rgb8"),
        (np.zeros((4, 4, 4), np.uint8), "bgr8"),
        (np.zeros((0, 4), np.uint8), "mono8"),
        (np.zeros(4, np.uint8), "mono8"),
    ],
)
def test_images_that_do_not_fit_their_encoding(header: Any, image: Any, encoding: str) -> None:
    with pytest.raises(InvalidValueError, match="expected a non-empty"):
        fill_compressed(blank_message(COMPRESSED), image, encoding, header, "png")


def test_a_jpeg_cannot_be_that_wide(header: Any) -> None:
    image = np.zeros((1, 65501), np.uint8)
    with pytest.raises(InvalidValueError, match=r"65501 x 1 pixels as jpeg.*choose png"):
        fill_compressed(blank_message(COMPRESSED), image, "mono8", header, "jpeg")
