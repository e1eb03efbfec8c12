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

"""The comparison of Fig. 16a, on tables whose differences are known."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from examples.cantilever.figure_16a import (
    compare_calibrations,
    draw_comparison,
    root_mean_square_nm,
    show_comparison,
    spread_nm,
)
from semcal_ros.files.bags.writer import SIMULATED_START_NS
from semcal_ros.workflows.measure_cantilever import CANTILEVER_COLUMNS

MAGNIFICATIONS = (6450.0, 7760.0, 8890.0)
# Three poses of two frames each.
TRUE_NM = (0.0, 250.0, 100.0)
SEPARATE_NM = {6450.0: 3.0, 7760.0: -1.0, 8890.0: 1.0}


def write(path: Path, error_nm: dict[float, float], *, lost: bool = False) -> Path:
    """A table that is wrong by so much at each magnification, in the bent poses, by -+ 5 nm in the two frames."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, CANTILEVER_COLUMNS, restval=0)
        table.writeheader()
        for number, (g, pose, frame) in enumerate(frames()):
            nm = TRUE_NM[pose] + (error_nm[g] if pose else 0.0) + (5.0 if frame else -5.0)
            unknown = lost and (g, pose, frame) == (6450.0, 1, 1)
            row = {"stamp_ns": SIMULATED_START_NS + number * 10**9, "magnification": g}
            deflection = {"deflection_m": "nan" if unknown else 1e-9 * nm}
            table.writerow({**row, "pose": pose + 1, **deflection, "deflection_by_length_m": "nan"})
    return path


def frames() -> list[tuple[float, int, int]]:
    return [(g, pose, frame) for pose in range(3) for g in MAGNIFICATIONS for frame in range(2)]


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    path = tmp_path / "truth.json"
    true = [
        {"start_time_s": float(number), "deflection_m": 1e-9 * TRUE_NM[pose]}
        for number, (_, pose, _) in enumerate(frames())
    ]
    path.write_text(json.dumps({"frames": true}), encoding="utf-8")
    return path


def test_differences_errors_and_spread_are_those_that_were_put_in(tmp_path, truth, capsys) -> None:
    ours = write(tmp_path / "ours.csv", dict.fromkeys(MAGNIFICATIONS, 0.5))
    theirs = write(tmp_path / "theirs.csv", SEPARATE_NM)
    found = compare_calibrations(ours, theirs, truth)
    assert found.magnifications == MAGNIFICATIONS
    expected = np.outer([0.5 - e for e in SEPARATE_NM.values()], [0.0, 1.0, 1.0])
    np.testing.assert_allclose(1e9 * found.difference_m, expected, atol=1e-9)
    assert root_mean_square_nm(found.continuous_m - found.truth_m) == pytest.approx(0.5)
    # Errors 3, -1, 1: mean square 11/3, and a standard deviation of 2.
    assert root_mean_square_nm(found.separate_m - found.truth_m) == pytest.approx(np.sqrt(11 / 3))
    assert spread_nm(found.separate_m) == pytest.approx(2.0)
    assert spread_nm(found.continuous_m) == pytest.approx(0.0, abs=1e-9)
    # Differences -2.5, 1.5, -0.5: mean square 35/12.
    show_comparison(found)
    printed = capsys.readouterr().out
    assert "continuous minus separate: 1.71 nm RMS, 2.50 nm at most" in printed
    assert "0.50 nm continuous, 1.91 nm separate" in printed
    assert "0.00 and 2.00 nm" in printed
    assert draw_comparison(found)[1:4] == b"PNG"


def test_a_frame_that_one_calibration_lost_counts_for_neither(tmp_path, truth) -> None:
    ours = write(tmp_path / "ours.csv", SEPARATE_NM)
    theirs = write(tmp_path / "theirs.csv", SEPARATE_NM, lost=True)
    found = compare_calibrations(ours, theirs, truth)
    np.testing.assert_allclose(found.difference_m, 0.0, atol=1e-18)
    # Of this pose the frame that is 5 nm too low is left.
    assert 1e9 * (found.separate_m - found.truth_m)[0, 1] == pytest.approx(3.0 - 5.0)


def test_without_the_ends_in_view_the_known_length_says_nothing(tmp_path, truth) -> None:
    ours = write(tmp_path / "ours.csv", SEPARATE_NM)
    found = compare_calibrations(ours, ours, truth, scale="length")
    assert np.isnan(found.difference_m).all()
