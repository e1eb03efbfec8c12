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

"""When the pixels of a frame are acquired."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError


@pytest.mark.parametrize("averages", [1, 2, 5])
def test_mean_and_variance_of_the_times_of_averaged_passes(averages: int) -> None:
    timing = ScanTiming(0.4, averages, 0.2)
    passes = 0.4 * np.arange(averages)
    assert timing.pass_variance_s2 == pytest.approx(np.var(passes), abs=1e-15)
    # Line 3 of 8 begins after 3 / 8 of a pass; of its period 80 % are spent on the pixels.
    expected = passes.mean() + 0.4 * 3 / 8 + 0.8 * 0.4 / 8 * 10 / 40
    assert timing.pixel_offset_s(3, 10, 8, 40) == pytest.approx(expected)
    assert timing.acquisition_time_s == pytest.approx(0.4 * averages)
    assert timing.centre_offset_s == pytest.approx(0.2 * averages)


def test_a_line_that_is_scanned_several_times_is_seen_at_the_mean_of_its_scans() -> None:
    timing = ScanTiming(0.6, 1, 0.2, line_averages=3)
    # Each of 8 lines takes 0.075 s, three times 0.025 s, of which 0.02 s are spent on 40 pixels.
    scans = [3 * 0.075 + k * 0.025 + 0.02 * 10 / 40 for k in range(3)]
    assert timing.pixel_offset_s(3, 10, 8, 40) == pytest.approx(np.mean(scans))
    assert timing.acquisition_time_s == pytest.approx(0.6)
    # The last scan of the last line ends with the frame.
    assert timing.pixel_offset_s(7, 40, 8, 40) + 0.025 + 0.005 == pytest.approx(0.6)


def test_lines_of_a_bidirectional_scan_have_the_time_of_their_middle() -> None:
    timing = ScanTiming(0.8, bidirectional=True)
    # Lines of 0.1 s. A tenth of the way along an even one is 0.01 s after its beginning, along an odd one 0.09 s.
    places = [(2, 4), (3, 4)]
    times = [float(timing.pixel_offset_s(row, col, 8, 40)) for row, col in places]
    assert np.mean(times) == pytest.approx(np.mean([0.21, 0.39]))
    assert np.diff(times) == pytest.approx(0.1)


def test_a_recursive_average_is_as_old_as_its_weights_say() -> None:
    timing = ScanTiming(0.5, 1, 0.1, recursive_averages=4)
    weights = np.zeros(400)
    weights[0] = 1.0
    for k in range(1, 400):
        weights *= 1.0 - 1.0 / 4.0
        weights[k] += 1.0 / 4.0
    starts = 0.5 * (np.arange(400) - 399.0)
    shown = float(weights @ starts)
    plain = ScanTiming(0.5, 1, 0.1)
    offset = timing.pixel_offset_s(3, 10, 8, 40) - plain.pixel_offset_s(3, 10, 8, 40)
    assert offset == pytest.approx(shown)
    assert timing.centre_offset_s == pytest.approx(0.25 + shown)


@pytest.mark.parametrize(
    "wrong",
    [{"line_averages": 0}, {"recursive_averages": 0}, {"averages": 2, "recursive_averages": 2}],
)
def test_impossible_averages_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(InvalidValueError):
        ScanTiming(1.0, **wrong)


@pytest.mark.parametrize("wrong", [(0.0, 1, 0.0), (np.nan, 1, 0.0), (1.0, 0, 0.0), (1.0, 1, 1.0)])
def test_impossible_timings_are_refused(wrong: tuple[float, int, float]) -> None:
    with pytest.raises(InvalidValueError):
        ScanTiming(*wrong)
