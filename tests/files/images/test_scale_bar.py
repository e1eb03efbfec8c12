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

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.files.images.scale_bar import (
    add_databar,
    choose_scale_bar,
    draw_scale_bar,
    format_length,
)


@given(width=st.integers(64, 8192), pixel_size_m=st.floats(1e-11, 1e-4))
def test_a_bar_is_a_round_length_of_a_tenth_to_a_quarter_of_the_width(
    width: int, pixel_size_m: float
) -> None:
    bar = choose_scale_bar(width, pixel_size_m)
    # From 1 to 2, 2 to 5 and 5 to 10 the largest step is a factor of 2.5.
    assert 0.099 * width <= bar.length_px <= 0.2500001 * width
    assert bar.length_px * pixel_size_m == pytest.approx(bar.length_m)
    assert f"{bar.length_m:.0e}"[0] in "125"


@pytest.mark.parametrize(
    ("length_m", "text"),
    [(5e-7, "500 nm"), (1e-6, "1 µm"), (2e-3, "2 mm"), (9.9999e-7, "1 µm"), (1e-10, "100 pm")],
)
def test_lengths_in_words(length_m: float, text: str) -> None:
    assert format_length(length_m) == text


def test_the_label_says_how_well_the_length_is_known() -> None:
    bar = choose_scale_bar(512, 43.9e-9, 0.0571e-9)
    # 5 um are 113.9 px of 43.9 nm; the sigma is 5 um x 0.0571 / 43.9.
    assert bar.label == "5 µm ± 6.5 nm"
    assert bar.pixel_size == "43.900 ± 0.057 nm per px"
    assert choose_scale_bar(512, 43.9e-9, 1.4e-9).label == "5 µm ± 160 nm"
    assert choose_scale_bar(512, 43.9e-9).label == "5 µm (nominal)"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("colours", [(), (3,)])
def test_a_databar_leaves_the_image_alone(dtype: type, colours: tuple[int, ...]) -> None:
    image = np.random.default_rng(1).integers(40, 200, (300, 512, *colours)).astype(dtype)
    bar = choose_scale_bar(512, 43.9e-9, 0.057e-9)
    out = add_databar(image, bar)
    assert out.dtype == dtype
    np.testing.assert_array_equal(out[:300], image)
    strip = out[300:].reshape(len(out) - 300, 512, -1)[..., 0]
    # The bar is the longest white line in the middle of the strip, and its contrast that of the image.
    middle = strip[len(strip) // 2]
    runs = np.diff(np.flatnonzero(np.diff(np.r_[0, middle == image.max(), 0])))[::2]
    assert max(runs) == round(bar.length_px)
    assert strip.min() == image.min()


def test_a_blank_image_gets_a_visible_bar() -> None:
    out = add_databar(np.zeros((64, 256), np.uint8), choose_scale_bar(256, 1e-8))
    assert out.max() == 255
    gone = add_databar(np.full((64, 256), np.nan, np.float32), choose_scale_bar(256, 1e-8))
    assert np.nanmax(gone) > np.nanmin(gone)


def test_a_bar_in_a_picture_has_its_length_and_place() -> None:
    bar = choose_scale_bar(512, 43.9e-9)
    for above in (0, 60):
        picture = np.full((512, 512), 128, np.uint8)
        draw_scale_bar(picture, bar, above_px=above)
        rows = np.flatnonzero((picture == 255).sum(axis=1) >= round(bar.length_px))
        assert len(rows) >= 2
        columns = np.flatnonzero(picture[rows[0]] == 255)
        assert np.ptp(columns) + 1 == round(bar.length_px)
        assert 512 - above - rows[-1] < 20
