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

"""What a recording without a configured scan timing is told about its drift."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semcal_ros.config.config import load_config
from semcal_ros.core.drift.estimates import DriftPath, DriftPredictor, DriftUpdate
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.workflows.follow_drift import (
    describe_beginnings,
    describe_untracked,
    estimate_timing,
)
from semcal_ros.workflows.track_drift import DriftTrack
from tests.helpers.drift_scenes import make_drift_update

LOST = Rejection(MatchFailure.NO_PEAK, "lost")


def note_of(updates: Sequence[DriftUpdate]) -> str:
    follower: Any = SimpleNamespace(
        updates=updates, height_px=200, path=lambda live: DriftPath(updates)
    )
    config, note = estimate_timing(load_config("generic"), follower, None)
    assert config.scan is None
    return note


def updates(step_px: float, rejected: Sequence[int] = ()) -> list[DriftUpdate]:
    return [
        make_drift_update(
            time_s=float(k),
            # What was only predicted is far from what was measured.
            drift_m=np.array([k * step_px + 20.0 * (k in rejected), 0.0]),
            rejection=LOST if k in rejected else None,
        )
        for k in range(12)
    ]


@pytest.mark.parametrize(("step_px", "noted"), [(0.4, False), (0.6, True)])
def test_fast_drift_is_noted_where_the_shear_of_the_frames_is_unknown(
    step_px: float, noted: bool
) -> None:
    note = note_of(updates(step_px))
    assert ("drift of up to 0.6 px" in note) == noted
    # What the beam sees of a specimen that moves by v T in a frame is 1 + v T / height as large.
    assert ("wrong by up to 0.3 %" in note) == noted


def test_frames_that_were_only_predicted_do_not_count() -> None:
    assert note_of(updates(0.1, rejected=(3, 7))) == ""


def path_of(times: Sequence[float], refused: Sequence[int] = ()) -> DriftPath:
    blank = Rejection(MatchFailure.UNUSABLE_IMAGE, "blank (all pixels at 0)")
    return DriftPath(
        [
            make_drift_update(time_s=t, rejection=blank if k in refused else None)
            for k, t in enumerate(times)
        ]
    )


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (path_of([0.0, 1.0, 1.0, 2.0], refused=[2, 3]), []),
        (path_of([0.0, 1.0], refused=[0, 1]), []),
        (
            path_of([0.0, 1.0], refused=[0]),
            ["drift is counted from frame 2: frame 1 could not be used (blank (all pixels at 0))"],
        ),
        (
            path_of([0.0, 1.0, 2.0, 3.0, 1.5], refused=[0, 1, 2]),
            [
                "drift is counted from frame 4: frames 1 to 3 could not be used (blank (all pixels at 0))",
                "time runs backwards at frame 5: from there on, drift is counted from that frame",
            ],
        ),
        (
            path_of([5.0, 4.0, 3.0, 2.0, 1.0, 0.0]),
            [
                "time runs backwards at frames 2, 3, 4 and 2 more: "
                "from there on, drift is counted from that frame"
            ],
        ),
    ],
)
def test_from_which_frame_drift_is_counted_is_said(path: DriftPath, said: list[str]) -> None:
    assert describe_beginnings(path) == said


def test_that_most_frames_were_not_tracked_is_said() -> None:
    times = [float(k) for k in range(6)]
    (said,) = describe_untracked(path_of(times, refused=[1, 2, 3, 5]))
    assert said.startswith(
        "only 2 of 6 frames could be tracked: the drift of the others is predicted"
    )
    assert describe_untracked(path_of(times, refused=[1, 2, 3])) == []
    # That none was is another matter, and an error.
    assert describe_untracked(path_of(times, refused=[1, 2, 3, 4, 5])) == []


def test_where_tracking_began_again_is_said_with_what_is_known_of_it() -> None:
    updates = list(path_of([float(k) for k in range(12)]).updates)
    elsewhere = Rejection(MatchFailure.DISSIMILAR, "too little of the specimen in common")
    for k in (3, 5, 7, 9):
        updates[k] = replace(
            updates[k], rejection=elsewhere, restarted=True, covariance=np.eye(6) * 96.0**2
        )
    place = "how far the specimen had moved since the frames before is known to 96 px (1-sigma)"
    assert describe_beginnings(DriftPath(tuple(updates))) == [
        *(
            f"tracking began again at frame {k} (too little of the specimen in common): {place}"
            for k in (4, 6, 8)
        ),
        "tracking began again 1 more time",
    ]


def test_the_table_says_in_which_direction_a_drift_is_known(tmp_path: Path) -> None:
    """Known to 0.01 along (1, 1) and to 1 across; pixels run the other way along y, and are twice as many along x."""
    covariance = np.zeros((3, 4, 4))
    covariance[1, :2, :2] = 0.5 * np.array([[1.0001, -0.9999], [-0.9999, 1.0001]])
    covariance[2] = np.diag(np.full(4, np.inf))
    path = DriftPath(
        [make_drift_update(covariance=c, px_from_unit=np.diag([2.0, -1.0])) for c in covariance]
    )
    predictor = cast("DriftPredictor", None)
    DriftTrack((0, 1, 2), path, {}, predictor, load_config("generic"), ()).save(tmp_path / "d.csv")
    with (tmp_path / "d.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    in_m, in_px = ([float(row[f"correlation_{unit}"]) for row in rows] for unit in ("m", "px"))
    # What is exact, as the first frame, or not known at all is not correlated.
    np.testing.assert_allclose(in_m, [0.0, -0.9999 / 1.0001, 0.0], atol=1e-12)
    np.testing.assert_allclose(in_px, [0.0, 0.9999 / 1.0001, 0.0], atol=1e-12)
    assert float(rows[1]["sigma_x_px"]) == pytest.approx(np.sqrt(2.0 * 1.0001))
