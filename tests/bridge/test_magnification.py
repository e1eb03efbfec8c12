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

"""Magnifications from messages: known answers, and refusals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.bridge.magnification import read_magnification
from semcal_ros.config.config import MicroscopeConfig, load_config, parse_config
from semcal_ros.core.errors import InvalidValueError, MessageError
from semcal_ros.files.bags.messages import blank_message

New = Callable[[str], Any]
FLOAT64 = "std_msgs/msg/Float64"


def convert_message(
    message: Any, config: MicroscopeConfig, image_width_px: int | None = None
) -> float:
    return read_magnification(message, config).magnification(image_width_px)


def config_for(magnification: str) -> MicroscopeConfig:
    return parse_config(
        f"{{name: test, display_width_m: 0.12, magnification: {{{magnification}}}}}"
    )


def float64(new: New, value: float) -> Any:
    message = new(FLOAT64)
    message.data = value
    return message


@pytest.mark.parametrize(
    ("magnification", "value", "expected"),
    [
        ("quantity: magnification", 5000.0, 5000.0),
        # The same field is 24 um wide: 5000 x on 0.12 m, 10 000 x on 0.24 m.
        ("quantity: magnification, display_width_m: 0.24", 10000.0, 5000.0),
        ("quantity: field_width, unit: um", 24.0, 5000.0),
        ("quantity: field_width, unit: m", 24e-6, 5000.0),
        ("quantity: field_width, unit: mm", 0.024, 5000.0),
        ("quantity: pixel_size, unit: nm", 46.875, 5000.0),  # 24 um / 512
        ("quantity: pixel_size, unit: pm", 46875.0, 5000.0),
        ("quantity: pixel_size, unit: nm, image_width_px: 1024", 23.4375, 5000.0),
    ],
)
def test_known_answers(new: New, magnification: str, value: float, expected: float) -> None:
    config = config_for(magnification)
    result = convert_message(float64(new, value), config, 512)
    assert result == pytest.approx(expected, rel=1e-12)


def test_pixel_size_in_a_stamped_vector(new: New) -> None:
    config = load_config("pixel_size_nm")
    message = new(config.magnification.type)
    message.vector.x, message.vector.y = 46.875, -1.0
    message.header.stamp.sec, message.header.stamp.nanosec = 3, 5
    reading = read_magnification(message, config)
    assert reading.needs_image_width
    assert reading.value == pytest.approx(46.875e-9, rel=1e-12)
    assert reading.stamp_ns == 3_000_000_005
    assert reading.field_width_m(512) == pytest.approx(24e-6, rel=1e-12)
    assert reading.magnification(512) == pytest.approx(5000.0, rel=1e-12)
    assert reading.magnification(1024) == pytest.approx(2500.0, rel=1e-12)


def test_a_pixel_size_needs_the_image_width(new: New) -> None:
    reading = read_magnification(float64(new, 10.0), config_for("quantity: pixel_size, unit: nm"))
    for width in (None, 0, -3):
        with pytest.raises(InvalidValueError, match="image width"):
            reading.magnification(width)


def test_vendor_example() -> None:
    # A Thermo Fisher frame of 1536 px with pixels of 269.792 nm: 500 x on the 207.2 mm wide display
    # that its data bar means, and 1250 x on one of 518 mm. One field of view, so one magnification.
    results = [
        convert_message(float64(blank_message, value), config_for(text), 1536)
        for value, text in [
            (269.792, "quantity: pixel_size, unit: nm"),
            (500.0, "quantity: magnification, display_width_m: 0.2072"),
            (1250.0, "quantity: magnification, display_width_m: 0.518"),
        ]
    ]
    assert results == pytest.approx([0.12 / (1536 * 269.792e-9)] * 3, rel=1e-4)  # 4 given digits


@given(g=st.floats(10.0, 1e6), width_m=st.floats(0.1, 0.6), width_px=st.integers(16, 8192))
def test_every_quantity_means_the_same_field(g: float, width_m: float, width_px: int) -> None:
    field_m = 0.12 / g
    cases = [
        ("quantity: magnification", g),
        (f"quantity: magnification, display_width_m: {width_m!r}", width_m / field_m),
        ("quantity: field_width, unit: nm", field_m * 1e9),
        ("quantity: pixel_size, unit: um", field_m * 1e6 / width_px),
    ]
    for text, value in cases:
        message = float64(blank_message, value)
        result = convert_message(message, config_for(text), width_px)
        assert result == pytest.approx(g, rel=1e-9)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, -math.inf, 0.5, 1e9])
def test_impossible_magnifications(new: New, value: float) -> None:
    with pytest.raises(MessageError) as caught:
        read_magnification(float64(new, value), config_for("quantity: magnification"))
    assert "\n" not in str(caught.value)
    assert f"{value:g}" in str(caught.value)


@pytest.mark.parametrize("value", [5e-324, 1e-300, 1e-3, 1e300, math.inf, math.nan, 0.0, -4.0])
@pytest.mark.parametrize(
    "text",
    [
        "quantity: pixel_size, unit: pm",
        "quantity: field_width, unit: pm",
        "quantity: magnification, display_width_m: 1e-300",
    ],
)
def test_absurd_lengths_do_not_divide_by_zero(text: str, value: float) -> None:
    with pytest.raises(MessageError):
        convert_message(float64(blank_message, value), config_for(text), 512)


def test_a_wrong_unit_is_noticed(new: New) -> None:
    # 46.875 taken as metres instead of nanometres.
    with pytest.raises(MessageError, match="unit"):
        convert_message(float64(new, 46.875), config_for("quantity: pixel_size, unit: m"), 512)


def test_field_paths(new: New) -> None:
    message = new("sensor_msgs/msg/JointState")
    message.position = (
        np.array([7.0, 800.0]) if isinstance(message.position, np.ndarray) else [7.0, 800.0]
    )
    text = "quantity: magnification, type: sensor_msgs/msg/JointState, field: 'position[{}]'"
    assert convert_message(message, config_for(text.format(1))) == 800.0
    with pytest.raises(MessageError, match="2 elements"):
        read_magnification(message, config_for(text.format(2)))


@pytest.mark.parametrize("field", ["value", "data.x", "data[0]"])
def test_a_field_that_is_not_there(new: New, field: str) -> None:
    with pytest.raises(MessageError, match="field"):
        read_magnification(
            float64(new, 500.0), config_for(f"quantity: magnification, field: '{field}'")
        )


@pytest.mark.parametrize(
    ("type_name", "field"),
    [
        ("std_msgs/msg/String", "data"),
        ("std_msgs/msg/Bool", "data"),
        ("std_msgs/msg/Header", "stamp"),
    ],
)
def test_a_field_that_is_no_number(new: New, type_name: str, field: str) -> None:
    with pytest.raises(MessageError, match="expected a number"):
        read_magnification(new(type_name), config_for(f"quantity: magnification, field: '{field}'"))


@pytest.mark.parametrize("type_name", ["Float32", "Int32", "UInt64"])
def test_other_number_types(new: New, type_name: str) -> None:
    message = new(f"std_msgs/msg/{type_name}")
    message.data = 2048.0 if type_name == "Float32" else 2048
    reading = read_magnification(message, config_for("quantity: magnification"))
    assert reading.magnification() == 2048.0
    assert reading.stamp_ns is None
