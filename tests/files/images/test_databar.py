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

from semcal_ros.files.images.databar import DatabarCutter, DatabarFinder, find_databar
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


def test_a_finder_waits_for_the_next_image_only_where_there_is_a_bar() -> None:
    assert DatabarFinder().find_rows(scanned()) == 0
    finder = DatabarFinder()
    assert finder.find_rows(with_bar(scanned(), 24, "1000x 5 kV")) is None
    assert finder.find_rows(with_bar(scanned(), 24, "500x 5 kV")) == 24
    # Decided: the beam may be blanked now.
    assert finder.find_rows(with_bar(np.zeros((200, 300), np.uint8), 24, "500x")) == 24
    # Images of another size are others.
    assert finder.find_rows(scanned(224, 280)) == 0


def test_a_blank_image_tells_nothing() -> None:
    finder = DatabarFinder()
    assert finder.find_rows(np.zeros((224, 300), np.uint8)) == 0
    assert finder.find_rows(with_bar(np.zeros((200, 300), np.uint8), 24, "5 kV")) is None
    assert finder.find_rows(with_bar(scanned(), 24, "5 kV")) is None
    assert finder.find_rows(with_bar(scanned(), 24, "5 kV")) == 24


def with_ground(clipped_rows: int, seed: int) -> NDArray[np.uint8]:
    """A specimen that ends above a hole, from which hardly anything comes but a grain of dust."""
    rng = np.random.default_rng(seed)
    mean = np.full((200, 300), 120.0)
    mean[-clipped_rows:] = -12.0
    cv2.circle(mean, (150, 192), 5, 150.0, -1)
    return np.clip(np.rint(rng.normal(mean, 8.0)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("rows", [16, 30, 48])
def test_a_dark_ground_is_no_bar(rows: int) -> None:
    finder = DatabarFinder()
    first = finder.find_rows(with_ground(rows, seed=0))
    assert (finder.find_rows(with_ground(rows, seed=1)) if first is None else first) == 0
    # A single image does suggest one: text does not stay in one image.
    assert find_databar(with_ground(rows, seed=0)) == rows


def test_a_dark_ground_without_anything_in_it_is_no_bar() -> None:
    empty = with_bar(scanned(), 30)
    assert find_databar(empty) == 0


@pytest.mark.parametrize("seed", range(20))
def test_random_bars_are_found_in_their_second_image(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = int(rng.integers(200, 900)), int(rng.integers(300, 1100))
    height = int(rng.integers(14, rows // 6))
    ink, paper = ((255, 0), (0, 255), (230, 20), (20, 128))[seed % 4]
    deep = seed % 3 == 0
    font = int(rng.choice([cv2.FONT_HERSHEY_PLAIN, cv2.FONT_HERSHEY_SIMPLEX]))
    finder, seen = DatabarFinder(), None
    for k in range(2):
        bar = np.full((height, columns), paper, np.uint8)
        texts = (
            f"EHT = {rng.choice([1, 5, 10]):.2f} kV",
            f"Mag = {10 ** (k + 3)} X",
            "Signal A = SE2",
        )
        for column, text in enumerate(texts):
            cv2.putText(
                bar,
                text,
                (4 + column * columns // 3, height - 4),
                font,
                min(height / 40, columns / 900),
                ink,
                lineType=cv2.LINE_AA if seed % 2 else cv2.LINE_8,
            )
        field = rng.normal(rng.uniform(60, 180), rng.uniform(6, 30), (rows, columns))
        image = np.vstack([np.clip(np.rint(field), 0, 255).astype(np.uint8), bar])
        image = image.astype(np.uint16) * 257 if deep else image
        seen = finder.find_rows(np.dstack([image] * 3) if seed % 5 == 0 else image)
        assert (seen is None) is (k == 0)
    assert seen == height


def test_a_cutter_keeps_to_what_is_stated() -> None:
    image = with_bar(scanned(), 24, "5 kV")
    kept = DatabarCutter(0)
    assert kept.cut(image) is not None and kept.rows == 0 and not kept.has_found
    stated = DatabarCutter(10)
    cut = stated.cut(image)
    assert cut is not None and cut.shape == (214, 300) and not stated.has_found
    finding = DatabarCutter(None)
    assert finding.cut(image) is None
    found = finding.cut(image)
    assert found is not None and found.shape == (200, 300) and finding.has_found
