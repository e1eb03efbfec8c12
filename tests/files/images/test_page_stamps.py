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

"""Files that state whole seconds are stamped when they were taken, as far as their seconds tell it."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.files.images.image_file import ImageFile, ImagePage
from semcal_ros.files.images.page_stamps import stamp_pages

_BEGIN = datetime(2026, 3, 2, 10, 0, 0)


def _stamp(times_s: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Stamps, s, of files that were taken at these times and state whole seconds, and the notes."""
    files = [
        ImageFile(
            Path(f"f_{k:03d}.tif"),
            (ImagePage((8, 8)),),
            lambda: iter(()),
            _BEGIN + timedelta(seconds=int(np.floor(time_s))),
        )
        for k, time_s in enumerate(times_s)
    ]
    pages, notes = stamp_pages(files, None)
    assert [page.file for page in pages] == files
    stamps = np.array([page.stamp_ns for page in pages])
    assert np.all(np.diff(stamps) > 0)
    return (stamps - int(_BEGIN.timestamp()) * 1_000_000_000) * 1e-9, notes


@given(st.floats(0.2, 4.0), st.floats(0.0, 1.0), st.integers(8, 40))
def test_images_at_one_interval_are_stamped_at_it(
    interval_s: float, begin_s: float, count: int
) -> None:
    times_s = begin_s + interval_s * np.arange(count)
    stamps_s, _ = _stamp(times_s)
    # Seconds that count - 1 intervals span tell their sum to within one.
    assert np.allclose(np.diff(stamps_s), interval_s, atol=1.1 / (count - 1))
    assert np.all(np.abs(stamps_s - times_s) < 1.1)


def test_images_on_whole_seconds_keep_them() -> None:
    times_s = 2.0 * np.arange(9)
    stamps_s, notes = _stamp(times_s)
    assert np.allclose(stamps_s - stamps_s[0], times_s, rtol=0.0, atol=1e-6)
    assert not any("interval" in note for note in notes)


def test_a_pause_does_not_spoil_the_interval() -> None:
    times_s = 0.7 * np.arange(20)
    times_s[9:] += 61.3
    stamps_s, notes = _stamp(times_s)
    steps = np.delete(np.diff(stamps_s), 8)
    assert np.allclose(steps, 0.7, atol=0.06)
    assert any("which fits the files' whole seconds" in note for note in notes)


def test_images_that_no_interval_fits_are_spread_over_their_second() -> None:
    stamps_s, notes = _stamp(np.array([0.1, 0.2, 0.3, 0.9, 2.0, 3.9, 3.95, 5.5, 6.5, 7.5]))
    assert np.allclose(stamps_s - stamps_s[0], [0.0, 0.25, 0.5, 0.75, 2.0, 3.0, 3.5, 5.0, 6.0, 7.0])
    assert any("4 images have the second of the image before" in note for note in notes)


def test_irregular_images_in_seconds_of_their_own_are_left_as_they_are() -> None:
    times_s = np.array([0.0, 7.0, 9.0, 30.0, 33.0])
    stamps_s, notes = _stamp(times_s)
    assert np.allclose(stamps_s - stamps_s[0], times_s, rtol=0.0, atol=1e-6)
    assert not any("interval" in note for note in notes)
