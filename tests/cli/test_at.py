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

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from semcal_ros.core.camera.provenance import Provenance
from tests.helpers.node_scenes import make_calibration
from tests.helpers.semcal_runs import refused, run


def test_the_budget_says_what_it_does_not_know(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cal.yaml"
    make_calibration().save(path)
    assert run("at", path, 2000, "--budget", "--length", "10um", "--height", "-20um") == 0
    told = capsys.readouterr()
    assert "position of both edges" in told.out
    assert "length 10000 nm" in told.out
    assert "the squares of the grid count as exact" in told.err
    assert run("at", path, 2000, "--budget", "--json") == 0
    assert json.loads(capsys.readouterr().out)["coverage"] == 2.0
    assert "both, or neither" in refused(capsys, "at", path, 2000, "--length", "10um")


ORIGIN = Provenance(
    calibrated="2026-11-20 10:11:12",
    software_version="0.9",
    recording="grid\x1b[31m",
    configuration="jsm820",
    conditions={
        "model": ("SUPRA 40VP",),
        "acceleration_voltage_v": (5e3, 5e3),
        "working_distance_m": (9.9e-3, 1e-2),
    },
)


def test_where_a_calibration_comes_from_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cal.yaml"
    warned = {"warnings": ["scale: the grid is worn"], "rms_px": "much", "views": 12}
    replace(make_calibration(), provenance=ORIGIN, statistics=warned).save(path)
    assert run("at", path, 2000) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2] == (
        "calibrated   2026-11-20 10:11:12 UTC, recording grid [31m, configuration jsm820, semcal_ros 0.9"
    )
    assert lines[-1] == (
        "conditions   microscope SUPRA 40VP; voltage 5 kV, working distance 9.9 mm to 10 mm"
    )
    assert run("info", path) == 0
    told = capsys.readouterr().out
    for line in (
        "voltage           5 kV",
        "calibrated        2026-11-20 10:11:12 UTC",
        "range             500x to 8000x, 3 magnifications",
        "views             12",
        "RMS               not recorded",
        "  scale: the grid is worn",
    ):
        assert line in told.splitlines()
    assert run("info", path, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["conditions"]["acceleration_voltage_v"] == [5e3, 5e3]
    assert data["recording_sha256"] is None


def test_what_is_not_known_is_said_to_be_not_recorded_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cal.yaml"
    make_calibration().save(path)
    assert run("at", path, 2000) == 0
    told = capsys.readouterr()
    assert told.out.splitlines()[-2:] == ["calibrated   not recorded", "conditions   not recorded"]
    assert told.err == ""
    assert run("info", path) == 0
    told = capsys.readouterr()
    assert "conditions     not recorded" in told.out.splitlines()
    assert told.err == ""
    path.write_text("format: other\n")
    assert "cal.yaml" in refused(capsys, "info", path)
