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

"""Pictures of the page: what is black, what is white, and which part is shown."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.viewer.pictures import (
    Contrast,
    Levels,
    Region,
    choose_levels,
    choose_region,
    encode_picture,
    outline,
)


def decode(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def test_contrast_of_12_bits_in_16_uses_what_is_there() -> None:
    ramp = np.linspace(1000, 3000, 64 * 64).reshape(64, 64).astype(np.uint16)
    full = choose_levels(ramp, Contrast("full"))
    assert (full.low, full.high) == (0.0, 4095.0)
    auto = choose_levels(ramp, Contrast("auto"))
    # Half a per cent of the ramp at either end is 10 levels.
    assert (auto.low, auto.high) == (pytest.approx(1010, abs=1), pytest.approx(2990, abs=1))
    assert (auto.least, auto.greatest) == (0.0, 4095.0)
    fixed = choose_levels(ramp, Contrast("fixed", 2000, 2500))
    shown = decode(encode_picture(ramp, fixed, Region(0, 0, 64, 64), 64)[0])
    # JPEG is exact to a few levels on a ramp.
    assert shown[0].max() <= 4
    assert shown[-1].min() >= 251
    assert shown[24].mean() == pytest.approx(0.0, abs=4)
    assert shown[40].mean() == pytest.approx((ramp[40].mean() - 2000) / 500 * 255, abs=4)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_an_even_image_is_grey(dtype: type) -> None:
    image = np.full((32, 32), 7, dtype)
    data, _ = encode_picture(image, choose_levels(image, Contrast()), Region(0, 0, 32, 32), 32)
    assert np.all(np.abs(decode(data).astype(int) - 127) <= 1)


def test_a_float_image_with_holes_is_shown() -> None:
    image = np.linspace(-1.0, 1.0, 64 * 64).reshape(64, 64).astype(np.float32)
    image[:, :4] = np.nan
    levels = choose_levels(image, Contrast("full"))
    assert levels.low == pytest.approx(-1.0, abs=0.01)
    shown = decode(encode_picture(image, levels, Region(0, 0, 64, 64), 64)[0])
    assert shown[-1, 40:].min() > 245
    hopeless = np.full((8, 8), np.nan, np.float32)
    encode_picture(hopeless, choose_levels(hopeless, Contrast()), Region(0, 0, 8, 8), 8)


def test_a_colour_image_keeps_its_colours() -> None:
    image = np.zeros((32, 32, 3), np.uint8)
    image[..., 2] = 255
    levels = choose_levels(image, Contrast("full"))
    shown = decode(encode_picture(image, levels, Region(0, 0, 32, 32), 32)[0])
    assert shown[16, 16, 2] > 240
    assert shown[16, 16, 0] < 15


def test_the_part_that_is_shown_lies_in_the_image() -> None:
    assert choose_region((640, 480)) == Region(0, 0, 640, 480)
    assert choose_region((640, 480), 4.0, (0.5, 0.5)) == Region(240, 180, 160, 120)
    assert choose_region((640, 480), 4.0, (1.0, 0.0)) == Region(480, 0, 160, 120)
    # Held at 32 times.
    assert choose_region((640, 480), 1e9, (0.5, 0.5)).width == 20
    with pytest.raises(InvalidValueError):
        choose_region((640, 480), float("nan"))


def test_a_large_image_is_averaged_and_a_small_part_keeps_its_pixels() -> None:
    board = (np.indices((512, 512)).sum(axis=0) % 2 * 255).astype(np.uint8)
    levels = Levels(0.0, 255.0, 0.0, 255.0)
    data, size = encode_picture(board, levels, Region(0, 0, 512, 512), 128)
    assert size == (128, 128)
    # Every fourth pixel alone would be black.
    assert decode(data).mean() == pytest.approx(127.5, abs=2)
    assert encode_picture(board, levels, Region(0, 0, 32, 16), 128)[1] == (32, 16)


def test_wrong_contrasts_are_refused() -> None:
    for wrong in (("auto", 5.0, 5.0), ("auto", 0.0, float("inf")), ("best", 0.0, 1.0)):
        with pytest.raises(InvalidValueError):
            Contrast(*wrong)


def test_a_mask_is_outlined_by_its_corners() -> None:
    mask = np.zeros((40, 60), np.uint8)
    mask[10:20, 30:50] = 255
    assert {point for points in outline(mask) for point in points} == {
        (30, 10),
        (30, 19),
        (49, 19),
        (49, 10),
    }
    assert outline(np.zeros((40, 60), np.uint8)) == ()
