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

"""Bars with text below a picture, which no metadata tell of."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semcal_ros.files.images.databar import find_databar
from semcal_ros.files.images.image_series import list_image_series

RNG = np.random.default_rng(0)


def scanned(rows: int = 200, columns: int = 300, level: float = 90.0) -> NDArray[np.uint8]:
    noisy = RNG.normal(level, 9.0, (rows, columns))
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def with_bar(picture: NDArray[np.uint8], rows: int, text: str = "") -> NDArray[np.uint8]:
    bar = np.zeros((rows, picture.shape[1]), np.uint8)
    cv2.putText(bar, text, (4, rows - 6), cv2.FONT_HERSHEY_PLAIN, 1.0, 255)
    return np.vstack([picture, bar])


@pytest.mark.parametrize("rows", [12, 30, 60])
def test_a_bar_is_found_to_the_row(rows: int) -> None:
    assert find_databar(with_bar(scanned(), rows, "5.0 kV 10 um")) == rows


@pytest.mark.parametrize("level", [90.0, 10.0, 250.0], ids=["grey", "dark", "nearly white"])
def test_a_picture_without_one_keeps_its_rows(level: float) -> None:
    assert find_databar(scanned(level=level)) == 0


def test_what_is_clipped_everywhere_or_half_of_the_picture_is_no_bar() -> None:
    clipped = np.where(scanned() > 85, 255, scanned()).astype(np.uint8)
    assert find_databar(clipped) == 0
    assert find_databar(with_bar(scanned(100), 100)) == 0
    assert find_databar(np.zeros((100, 100), np.uint8)) == 0
    assert find_databar(with_bar(scanned(), 4)) == 0


def test_files_are_cut_and_it_is_said(tmp_path: Path) -> None:
    paths = []
    for k in range(3):
        path = tmp_path / f"{k}.png"
        cv2.imwrite(str(path), with_bar(scanned(), 24, f"{k} kV"))
        paths.append(path)
    series = list_image_series(paths, display_width_m=0.12, pixel_size_m=1e-8)
    assert [image.databar_rows for image in series.images] == [24, 24, 24]
    assert (
        "the lowest 24 rows are a data bar and are cut off; --databar-rows 0 keeps them"
        in series.notes
    )
    kept = list_image_series(paths, display_width_m=0.12, pixel_size_m=1e-8, databar_rows=0)
    assert [image.databar_rows for image in kept.images] == [0, 0, 0]
    assert not any("data bar" in note for note in kept.notes)
