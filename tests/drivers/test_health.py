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

"""What a person at the microscope may have done, seen from its frames."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.drivers.health import FrameWatch, is_blank
from semcal_ros.drivers.source import SourceFrame


def frame(width_m: float | None = 1e-5, *, volt: float = 5e3, dark: bool = False) -> SourceFrame:
    noise = np.random.default_rng(1).normal(size=(64, 64))
    image = np.clip(10 + 0.5 * noise if dark else 120 + 30 * noise, 0, 255).astype(np.uint8)
    # A field width of 10 um is that of frames from before anything is asked for.
    return SourceFrame(
        image, 0 if width_m == 1e-5 else 20, None, width_m, {"accelerating_voltage_v": volt}
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_blank_images(dtype: type) -> None:
    top = np.iinfo(dtype).max
    random = np.random.default_rng(2)
    dark = np.round(0.05 * top + 0.001 * top * random.normal(size=(200, 100))).astype(dtype)
    assert is_blank(dark)
    assert is_blank(np.full((200, 100), top, dtype))
    # A faint picture: 4 % of the range.
    dark[:, 50:] += dtype(round(0.04 * top))
    assert not is_blank(dark)


def test_blank_images_of_numbers_that_have_no_range() -> None:
    picture = np.random.default_rng(2).normal(1e-9, 1e-10, (200, 100)).astype(np.float32)
    assert not is_blank(picture)
    assert is_blank(np.full_like(picture, 0.25))
    assert is_blank(np.full_like(picture, np.nan))


def test_one_dark_frame_is_no_blanked_beam() -> None:
    watch = FrameWatch()
    assert watch.see(frame(dark=True)) == []
    assert len(watch.see(frame(dark=True))) == 1
    assert watch.see(frame(dark=True)) == []
    assert watch.conditions() == ["blank frames"]
    watch.see(frame())
    assert watch.conditions() == []


def test_a_magnification_that_a_person_turns_is_told_until_it_is_confirmed() -> None:
    watch = FrameWatch()
    watch.see(frame(1e-5))
    # Nothing was asked for from here: whatever it is, is right.
    assert watch.see(frame(2e-5)) == []
    watch.asked(5e-6, now_ns=10)
    # Of a frame that had begun before.
    assert watch.see(frame(1e-5)) == []
    watch.see(frame(5.001e-6))
    assert watch.conditions() == []
    assert "turned at the microscope" in watch.see(frame(2e-5))[0]
    assert watch.see(frame(2e-5)) == []
    watch.acknowledge()
    assert watch.conditions() == []


def test_another_voltage_is_told_until_it_is_confirmed_or_back() -> None:
    watch = FrameWatch()
    watch.see(frame(volt=5000.0))
    assert watch.see(frame(volt=5010.0)) == []
    assert "10000 V" in watch.see(frame(volt=1e4))[0]
    watch.see(frame(volt=5e3))
    assert watch.conditions() == []
    watch.see(frame(volt=1e4))
    watch.acknowledge()
    assert watch.conditions() == []
    assert len(watch.see(frame(volt=5e3))) == 1
