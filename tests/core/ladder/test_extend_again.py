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

"""Ladders upon ladders: a calibration that was extended goes on where it ends, or says why not."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.calibration import Calibration
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.ladder.extend import LadderResult, extend_calibration
from semcal_ros.core.ladder.matching import LadderPicture
from tests.helpers.ladders import (
    SIZE,
    aligned_rms_px,
    calibration_of,
    camera_at,
    ladder_of,
    make_scope,
)

pytestmark = pytest.mark.long

FIRST, SECOND = (5000.0, 7400.0, 11000.0), (7400.0, 11000.0, 16000.0, 23000.0)
RELAY = (9500.0, 0.005)


@pytest.fixture(scope="module")
def once() -> LadderResult:
    scope = make_scope(1, RELAY)
    return extend_calibration(calibration_of(scope), ladder_of(scope, FIRST))


@pytest.fixture(scope="module")
def twice(once: LadderResult) -> LadderResult:
    # From the file, as a person would go on the next day.
    again = Calibration.loads(Calibration.from_model(once.model).dumps())
    return extend_calibration(again, ladder_of(make_scope(1, RELAY), SECOND, seed=1))


def test_upwards_and_upwards_again(once: LadderResult, twice: LadderResult) -> None:
    scope = make_scope(1, RELAY)
    assert once.model.magnification_range == (1000.0, 11000.0)
    assert twice.model.magnification_range == (1000.0, 23000.0)
    ladder, before = twice.model.ladder, once.model.ladder
    assert ladder is not None and before is not None
    # The grid stays where it was, and the relay of the first ladder is still known.
    assert ladder.anchored == before.anchored == (1000.0, 8000.0)
    assert ladder.relays[: len(before.relays)] == before.relays
    assert [twice.model.origin_of(g) for g in (8000.0, 9000.0, 23000.0, 24000.0)] == [
        "grid",
        "specimen",
        "specimen",
        "extrapolated",
    ]
    for g in (6000.0, 10900.0, 13000.0, 18000.0, 23000.0):
        camera, truth = twice.model.at(g), camera_at(scope, g)
        errors = np.subtract(camera.pixel_size_m, truth.pixel_size_m)
        assert np.all(np.abs(errors) < 3.0 * np.array(camera.pixel_size_sigma_m)), g
        assert aligned_rms_px(twice.model, scope, g) < 0.1
    # The end of the second ladder is known no better than that of the first.
    ends = [
        result.model.at(g).pixel_size_sigma_m[0] / result.model.at(g).pixel_size_m[0]
        for result, g in ((once, 11000.0), (twice, 23000.0))
    ]
    assert ends[0] < ends[1] < 0.01
    assert Calibration.loads(Calibration.from_model(twice.model).dumps()).ladder == ladder


def test_the_other_side_is_refused_before_anything_is_measured(once: LadderResult) -> None:
    blank = [LadderPicture(np.zeros((SIZE, SIZE)), g) for g in (1400.0, 900.0)]
    with pytest.raises(InvalidValueError, match=r"ladder downwards .* extended upwards already"):
        extend_calibration(once.model, blank)
    both = [*blank, *(LadderPicture(np.zeros((SIZE, SIZE)), g) for g in (7000.0, 10000.0))]
    grid = calibration_of(make_scope(1, RELAY))
    with pytest.raises(InvalidValueError, match="beyond one end of it; make two files"):
        extend_calibration(grid, both)
    inside = [LadderPicture(np.zeros((SIZE, SIZE)), g) for g in (3000.0, 4500.0)]
    with pytest.raises(InvalidValueError, match="beyond one end of it; record pictures beyond it"):
        extend_calibration(grid, inside)
