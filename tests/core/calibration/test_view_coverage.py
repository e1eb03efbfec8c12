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

"""What found views cover, of grids whose pose is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.judgement.findings import (
    estimate_tilt_deg,
    measure_view_coverage,
)
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.corners import LatticeDetection

SIZE = (320, 240)


def detection(tilt_deg: float = 0.0, turn_deg: float = 0.0, part: float = 1.0) -> LatticeDetection:
    """A grid of 10 px, seen in parallel projection, in the left part of the field."""
    i, j = np.meshgrid(np.arange(-60, 60), np.arange(-60, 60))
    ij = np.stack([i.ravel(), j.ravel()], axis=1)
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turned = 10.0 * ij @ np.array([[c, s], [-s, c]])
    xy = turned * [1.0, np.cos(np.radians(tilt_deg))] + [160.0, 120.0]
    seen = np.all((xy >= 0) & (xy < [part * SIZE[0], SIZE[1]]), axis=1)
    n = int(seen.sum())
    return LatticeDetection(
        ij[seen],
        xy[seen],
        np.full(n, 0.05),
        10.0,
        SIZE,
        np.tile(0.0025 * np.eye(2), (n, 1, 1)),
        1.0,
        np.empty((0, 2)),
    )


def view(g: float, found: LatticeDetection, tilt_rad: float | None = None) -> FoundView:
    stage = None if tilt_rad is None else StageReading(tilt_rad=tilt_rad)
    return FoundView("v", g, np.zeros((4, 4), np.uint8), found, stage, 0)


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0, 40.0])
@pytest.mark.parametrize("turn_deg", [0.0, 25.0])
def test_the_tilt_is_seen_in_the_lattice(tilt_deg: float, turn_deg: float) -> None:
    # Exact without perspective and noise, but for the rounding of an arc cosine near one.
    assert estimate_tilt_deg(detection(tilt_deg, turn_deg)) == pytest.approx(tilt_deg, abs=1e-4)


def test_views_together_fill_the_field() -> None:
    assert measure_view_coverage([]).field_share == 0.0
    half = measure_view_coverage([view(100.0, detection(part=0.5))])
    assert half.field_share == pytest.approx(0.5)
    assert half.views == {100.0: 1}
    both = measure_view_coverage(
        [view(200.0, detection(part=0.5)), view(100.0, detection(20.0)), view(200.0, detection())]
    )
    assert both.field_share == 1.0
    assert both.views == {100.0: 1, 200.0: 2}
    assert both.tilts_deg == pytest.approx((0.0, 20.0, 0.0), abs=1e-4)


def test_what_the_stage_says_goes_before_what_is_seen() -> None:
    told = view(100.0, detection(20.0), np.radians(-21.0))
    assert measure_view_coverage([told]).tilts_deg == pytest.approx((-21.0,))
    silent = replace(told, stage=StageReading())
    assert measure_view_coverage([silent]).tilts_deg == pytest.approx((20.0,), abs=1e-4)
