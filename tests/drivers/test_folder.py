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

"""A folder that a microscope saves into: each finished picture once, whatever happens on the way."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semcal_ros.core.errors import MicroscopeError, UnusableFrameError
from semcal_ros.drivers.folder import FolderSource
from semcal_ros.drivers.source import SourceFrame
from tests.helpers.sem_files import PIXEL_M, number_in, numbered_image, save_sem_tiff

# Long enough for a busy machine; nothing waits longer than it has to, but for what must not come.
SOON_S, NOTHING_S = 10.0, 0.8
QUICK = {"settle_s": 0.15, "poll_s": 0.1, "give_up_s": 0.5}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "sem"
    made.mkdir()
    return made


@pytest.fixture(params=["watched", "polled"])
def make(
    request: pytest.FixtureRequest, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., FolderSource]]:
    """Sources of the folder, opened; with what the system tells, and without it as on a network share."""
    if request.param == "polled":
        monkeypatch.setitem(sys.modules, "watchdog.events", None)
    else:
        pytest.importorskip("watchdog")
    made: list[FolderSource] = []

    def open_source(**options: Any) -> FolderSource:
        source = FolderSource(folder, tmp_path / "folder.journal", **{**QUICK, **options})
        assert ("watched, and" in source.open()) == (request.param == "watched")
        made.append(source)
        return source

    yield open_source
    for source in made:
        source.close()


def read(source: FolderSource) -> SourceFrame:
    frame = source.read(SOON_S)
    assert frame is not None
    return frame


def read_all(source: FolderSource, count: int) -> list[int]:
    """The numbers of the next frames, each confirmed."""
    numbers = []
    for _ in range(count):
        frame = read(source)
        numbers.append(number_in(frame.image))
        source.confirm(frame)
    return numbers


def test_a_picture_with_all_that_its_file_says(folder: Path, make: Callable[..., Any]) -> None:
    source = make()
    path = save_sem_tiff(folder / "one.tif", numbered_image(5))
    frame = read(source)
    assert np.array_equal(frame.image, numbered_image(5))
    assert frame.field_width_m == pytest.approx(128 * PIXEL_M)
    assert frame.conditions["accelerating_voltage_v"] == 5000.0
    assert frame.conditions["detector"] == "ETD"
    assert frame.stage == {"tilt": 0.1, "rotation": 0.2}
    # It was finished when it was written, after a scan of 50 ms.
    assert frame.start_ns == path.stat().st_mtime_ns - 50_000_000
    assert frame.acquisition_s == 0.05


def test_files_of_before_are_left_alone_and_none_comes_twice(
    folder: Path, make: Callable[..., Any]
) -> None:
    save_sem_tiff(folder / "before.tif", numbered_image(1))
    source = make()
    (folder / "before.tif").rename(folder / "sorted.tif")
    save_sem_tiff(folder / "a.tif", numbered_image(2))
    assert read_all(source, 1) == [2]
    (folder / "a.tif").rename(folder / "b.tif")
    assert source.read(NOTHING_S) is None
    save_sem_tiff(folder / "b.tif", numbered_image(2))
    assert source.read(NOTHING_S) is None
    # The same name with another picture, as of a program that always saves to one file.
    save_sem_tiff(folder / "b.tif", numbered_image(3))
    assert read_all(source, 1) == [3]


def test_a_burst_comes_whole_and_in_order(folder: Path, make: Callable[..., Any]) -> None:
    source = make()
    for number in range(30):
        save_sem_tiff(folder / f"{number % 7}_{number}.tif", numbered_image(number))
    frames = [read(source) for _ in range(30)]
    assert sorted(number_in(f.image) for f in frames) == list(range(30))
    # One that was still unfinished when those after it were ready may come later.
    late = sum(a.start_ns > b.start_ns for a, b in pairwise(frames))
    assert late <= 2
    assert len({frame.start_ns for frame in frames}) == 30


def test_a_picture_that_is_written_slowly_comes_when_it_is_complete(
    folder: Path, make: Callable[..., Any], tmp_path: Path
) -> None:
    data = save_sem_tiff(tmp_path / "whole.tif", numbered_image(9)).read_bytes()
    source = make()
    with open(folder / "slow.tif", "wb") as stream:
        for part in range(0, len(data), len(data) // 5):
            stream.write(data[part : part + len(data) // 5])
            stream.flush()
            assert source.read(0.05) is None
    assert read_all(source, 1) == [9]
    # Under another name until it is complete.
    (folder / "next.tmp").write_bytes(
        save_sem_tiff(tmp_path / "w.tif", numbered_image(10)).read_bytes()
    )
    assert source.read(NOTHING_S) is None
    (folder / "next.tmp").rename(folder / "next.tif")
    assert read_all(source, 1) == [10]


def test_half_a_picture_is_refused_in_the_end_and_holds_up_nothing(
    folder: Path, make: Callable[..., Any], tmp_path: Path
) -> None:
    data = save_sem_tiff(tmp_path / "whole.tif", numbered_image(9)).read_bytes()
    source = make()
    (folder / "half.tif").write_bytes(data[: len(data) // 2])
    save_sem_tiff(folder / "next.tif", numbered_image(10))
    assert read_all(source, 1) == [10]
    with pytest.raises(UnusableFrameError, match=r"half\.tif"):
        source.read(SOON_S)
    assert source.read(NOTHING_S) is None
    # Written again as a whole, it is a picture like any other.
    (folder / "half.tif").write_bytes(data)
    assert read_all(source, 1) == [9]


def test_what_was_not_published_comes_again(folder: Path, make: Callable[..., Any]) -> None:
    source = make()
    save_sem_tiff(folder / "a.tif", numbered_image(1))
    assert read_all(source, 1) == [1]
    source.close()
    save_sem_tiff(folder / "b.tif", numbered_image(2))
    save_sem_tiff(folder / "c.tif", numbered_image(3))
    source = make()
    first = read(source)
    assert number_in(first.image) == 2
    # Not confirmed, as if the process had been killed: its journal is the same for the next one.
    source._taken.clear()
    source.close()
    assert read_all(make(), 2) == [2, 3]


@pytest.mark.parametrize(("backlog", "numbers"), [("all", [1, 2]), ("skip", [2])])
def test_backlogs(folder: Path, make: Callable[..., Any], backlog: str, numbers: list[int]) -> None:
    save_sem_tiff(folder / "before.tif", numbered_image(1))
    source = make(backlog=backlog)
    save_sem_tiff(folder / "later.tif", numbered_image(2))
    assert sorted(read_all(source, len(numbers))) == numbers
    assert source.read(NOTHING_S) is None


def test_a_folder_that_goes_away_and_comes_back(folder: Path, make: Callable[..., Any]) -> None:
    source = make()
    aside = folder.with_name("unmounted")
    folder.rename(aside)
    with pytest.raises(MicroscopeError, match="cannot be read"):
        source.read(SOON_S)
    source.close()
    with pytest.raises(MicroscopeError, match="cannot be read"):
        source.open()
    save_sem_tiff(aside / "meanwhile.tif", numbered_image(4))
    aside.rename(folder)
    source.open()
    assert read_all(source, 1) == [4]


def test_two_nodes_do_not_share_a_journal(folder: Path, make: Callable[..., Any]) -> None:
    make()
    with pytest.raises(MicroscopeError, match="in use by another process"):
        make()


def test_a_journal_that_was_cut_off(folder: Path, make: Callable[..., Any], tmp_path: Path) -> None:
    source = make()
    for number in (1, 2):
        save_sem_tiff(folder / f"{number}.tif", numbered_image(number))
    assert sorted(read_all(source, 2)) == [1, 2]
    source.close()
    journal = tmp_path / "folder.journal"
    os.truncate(journal, journal.stat().st_size - 20)
    # The last one is not known to have been published.
    source = make()
    assert len(read_all(source, 1)) == 1
    source.close()
    assert make().read(NOTHING_S) is None


def test_other_files_are_left_alone(folder: Path, make: Callable[..., Any]) -> None:
    source = make(pattern="view_*.tif view_*.png")
    for name in ("other.tif", ".view_1.tif", "view_1.txt", "view_1.mp4"):
        (folder / name).write_bytes(b"no picture")
    (folder / "view_2.tif").mkdir()
    # A link to itself cannot be looked at, and a pipe would never end.
    (folder / "view_4.tif").symlink_to("view_4.tif")
    os.mkfifo(folder / "view_5.tif")
    assert source.read(NOTHING_S) is None
    save_sem_tiff(folder / "view_3.tif", numbered_image(3))
    assert read_all(source, 1) == [3]


def test_a_text_file_that_comes_after_its_picture_is_waited_for(
    folder: Path, make: Callable[..., Any]
) -> None:
    import cv2

    source = make()
    cv2.imwrite(str(folder / "jeol.tif"), numbered_image(3))
    assert source.read(0.4) is None
    text = "$CM_FORMAT JEOL-SEM\r\n$CM_MAG 50\r\n$CM_FULL_SIZE 128 96\r\n"
    (folder / "jeol.txt").write_text(text + "$$SM_MICRON_BAR 64\r\n$$SM_MICRON_MARKER 64um\r\n")
    frame = read(source)
    assert frame.conditions["maker"] == "jeol"
    assert frame.field_width_m == pytest.approx(128e-6)
    # Without any text it comes after a while, with the field width that was given or none.
    cv2.imwrite(str(folder / "plain.tif"), numbered_image(4))
    begun_s = time.monotonic()
    frame = read(source)
    assert frame.field_width_m is None
    assert time.monotonic() - begun_s > 1.5
