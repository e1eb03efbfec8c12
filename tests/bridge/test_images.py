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

"""Images survive the way through a message, whatever its layout, and unusable ones are refused."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semcal_ros.bridge.fields import assign_bytes
from semcal_ros.bridge.images import (
    ENCODINGS,
    fill_image,
    image_from_message,
    to_gray,
    without_databar,
)
from semcal_ros.core.errors import InvalidValueError, MessageError
from semcal_ros.files.bags.messages import blank_message, jazzy_types, serialize_message

New = Callable[[str], Any]
IMAGE = "sensor_msgs/msg/Image"


@st.composite
def images(draw: st.DrawFn) -> tuple[str, Any]:
    encoding = draw(st.sampled_from(sorted(ENCODINGS)))
    pixel = ENCODINGS[encoding]
    shape = draw(hnp.array_shapes(min_dims=2, max_dims=2, max_side=9))
    if pixel.channels > 1:
        shape += (pixel.channels,)
    return encoding, draw(hnp.arrays(pixel.dtype, shape))


def message_of(new: New, encoding: str, image: Any, padding: int = 0, big: bool = False) -> Any:
    """A message built here, byte by byte, so that the reader is not judged by the writer."""
    message = new(IMAGE)
    height, width = image.shape[:2]
    ordered = image.astype(image.dtype.newbyteorder(">" if big else "<"))
    rows = np.frombuffer(ordered.tobytes(), np.uint8).reshape(height, -1)
    filler = np.full((height, padding), 0xA5, np.uint8)
    padded = np.ascontiguousarray(np.hstack([rows, filler]))
    message.encoding, message.height, message.width = encoding, height, width
    message.step, message.is_bigendian = padded.shape[1], int(big)
    assign_bytes(message, "data", padded)
    return message


@given(case=images(), padding=st.integers(0, 7), big=st.booleans())
@settings(max_examples=150, deadline=None)
def test_reads_every_layout(new: New, case: tuple[str, Any], padding: int, big: bool) -> None:
    encoding, image = case
    read = image_from_message(message_of(new, encoding, image, padding, big))
    assert read.dtype == image.dtype
    assert read.dtype.isnative
    assert not read.flags.writeable
    np.testing.assert_array_equal(read, image)


@given(case=images())
@settings(max_examples=60, deadline=None)
def test_what_is_filled_is_read_back(new: New, header: Any, case: tuple[str, Any]) -> None:
    encoding, image = case
    message = new(IMAGE)
    fill_image(message, image, encoding, header)
    np.testing.assert_array_equal(image_from_message(message), image)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_001, 999_999_999)
    assert message.header.frame_id == "sem_optical"
    assert message.step * message.height == len(message.data) == image.nbytes
    assert bool(message.is_bigendian) == (sys.byteorder == "big")


def test_filled_message_is_independent_of_the_image(new: New, header: Any) -> None:
    image = np.zeros((3, 4), np.uint8)
    message = new(IMAGE)
    fill_image(message, image, "mono8", header)
    image[:] = 7
    assert not image_from_message(message).any()


def test_a_message_may_be_filled_again(new: New, header: Any) -> None:
    message = new(IMAGE)
    for shape in ((3, 4), (3, 4), (5, 2)):
        image = np.random.default_rng(shape[0]).integers(0, 255, shape).astype(np.uint8)
        fill_image(message, image, "mono8", header)
        np.testing.assert_array_equal(image_from_message(message), image)
        fill_image(message, 255 - image, "mono8", header)
        np.testing.assert_array_equal(image_from_message(message), 255 - image)


def test_strided_and_foreign_byte_order_sources(new: New, header: Any) -> None:
    image = np.arange(48, dtype=np.uint16).reshape(6, 8)
    message = new(IMAGE)
    fill_image(message, image[::2, ::-2].astype(">u2"), "mono16", header)
    np.testing.assert_array_equal(image_from_message(message), image[::2, ::-2])


def test_view_shares_memory_where_the_layout_allows(new: New) -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    message = message_of(new, "mono8", image, padding=2)
    read = image_from_message(message)
    assert np.shares_memory(read, np.frombuffer(message.data, np.uint8))


def test_filled_message_survives_serialisation(header: Any) -> None:
    message = blank_message(IMAGE)
    image = np.arange(35, dtype=np.uint8).reshape(5, 7)
    fill_image(message, image, "mono8", header)
    again = jazzy_types().deserialize_cdr(serialize_message(message), IMAGE)
    np.testing.assert_array_equal(image_from_message(again), image)


def test_opencv_takes_the_read_only_view(new: New) -> None:
    image = np.arange(64, dtype=np.uint16).reshape(8, 8)
    read = image_from_message(message_of(new, "mono16", image, padding=3))
    rows, cols = np.mgrid[0:8, 0:8].astype(np.float32)
    np.testing.assert_array_equal(cv2.remap(read, cols, rows, cv2.INTER_NEAREST), image)


def broken(field: str, value: Any) -> Any:
    return pytest.param(field, value, id=f"{field}={str(value)[:20]}")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        broken("encoding", "bayer_rggb8"),
        broken("encoding", ""),
        broken("encoding", "MONO8"),
        broken("encoding", "x" * 5000 + "\n\nsecond line"),
        broken("height", 0),
        broken("width", 0),
        broken("height", 4),
        broken("height", 2),
        broken("height", 2**32 - 1),
        broken("width", 2**32 - 1),
        broken("step", 0),
        broken("step", 3),
        broken("step", 5),
        broken("step", 2**32 - 1),
        broken("width", 5),
    ],
)
def test_bad_images_are_refused_in_one_line(new: New, field: str, value: Any) -> None:
    message = message_of(new, "mono8", np.zeros((3, 4), np.uint8))
    setattr(message, field, value)
    with pytest.raises(MessageError) as caught:
        image_from_message(message)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    assert caught.value.expected


def test_unknown_encoding_names_what_is_accepted(new: New) -> None:
    message = message_of(new, "mono8", np.zeros((3, 4), np.uint8))
    message.encoding = "yuv422"
    with pytest.raises(MessageError, match=r"'yuv422'.*mono8, mono16, 32FC1, bgr8, rgb8"):
        image_from_message(message)


def test_empty_and_truncated_data(new: New) -> None:
    message = message_of(new, "mono16", np.zeros((3, 4), np.uint16))
    for size in (0, 1, 23, 25):
        assign_bytes(message, "data", np.zeros(size, np.uint8))
        with pytest.raises(MessageError, match=f"{size} bytes"):
            image_from_message(message)


def test_another_message_type_is_refused(new: New) -> None:
    with pytest.raises(MessageError, match=r"expected sensor_msgs/msg/Image"):
        image_from_message(new("std_msgs/msg/String"))


def test_data_without_a_buffer_are_refused() -> None:
    message = message_of(blank_message, "mono8", np.zeros((1, 2), np.uint8))
    message.data = [0, 0]
    with pytest.raises(MessageError, match="list"):
        image_from_message(message)


@pytest.mark.parametrize(
    ("encoding", "image"),
    [
        ("mono8", np.zeros((2, 2), np.uint16)),
        ("mono8", np.zeros((2, 2, 3), np.uint8)),
        ("bgr8", np.zeros((2, 2), np.uint8)),
        ("bgr8", np.zeros((2, 2, 4), np.uint8)),
        ("bgr8", np.zeros((2, 2, 3, 1), np.uint8)),
        ("32FC1", np.zeros((2, 2), np.float64)),
        ("mono8", np.zeros((0, 2), np.uint8)),
        ("mono12", np.zeros((2, 2), np.uint8)),
    ],
)
def test_fill_refuses_what_does_not_fit(header: Any, encoding: str, image: Any) -> None:
    message = blank_message(IMAGE)
    with pytest.raises(InvalidValueError):
        fill_image(message, image, encoding, header)
    assert message.height == 0


def test_gray_of_known_colours() -> None:
    image = np.array([[[255, 0, 0], [10, 10, 10]]], np.uint8)
    # Weight of the first channel: 0.114 as blue, 0.299 as red.
    np.testing.assert_array_equal(to_gray(image, "bgr8"), [[29, 10]])
    np.testing.assert_array_equal(to_gray(image, "rgb8"), [[76, 10]])
    plain = np.zeros((2, 2), np.uint16)
    assert to_gray(plain) is plain
    with pytest.raises(InvalidValueError):
        to_gray(image.astype(np.float32))


def test_databar_is_cut_at_the_bottom() -> None:
    image = np.arange(12).reshape(4, 3)
    np.testing.assert_array_equal(without_databar(image, 1), image[:3])
    assert without_databar(image, 0).shape == (4, 3)
    for rows in (4, 5, -1):
        with pytest.raises(MessageError):
            without_databar(image, rows)
