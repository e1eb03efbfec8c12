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


@pytest.mark.parametrize("wrong", [(0.0, 1, 0.0), (np.nan, 1, 0.0), (1.0, 0, 0.0), (1.0, 1, 1.0)])
def test_impossible_timings_are_refused(wrong: tuple[float, int, float]) -> None:
    with pytest.raises(InvalidValueError):
        ScanTiming(*wrong)
