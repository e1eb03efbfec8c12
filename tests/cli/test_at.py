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

import numpy as np
import pytest

from semcal_ros import Calibration
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.camera.residual_field import zero_field
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


def _with_terms(values: dict[str, float], *, field_px: float = 0.0) -> Calibration:
    """The calibration with constant further terms, for 96 x 96 images."""
    plain = make_calibration()
    functions = dict(plain.functions) | {
        name: ContinuousFunction("chebyshev_log", np.array([value]), (500.0, 8000.0))
        for name, value in values.items()
    }
    field = None
    if field_px:
        zero = zero_field((96, 96), (500.0, 8000.0), 1)
        field = replace(zero, coefficients=zero.coefficients + [field_px / 48.0, 0.0])
    size = sum(function.size for function in functions.values())
    size += 0 if field is None else field.size
    return replace(plain, functions=functions, residual=field, covariance=1e-8 * np.eye(size))


def _lines_of_distortion(told: str) -> list[str]:
    lines = told.splitlines()
    begin = next(k for k, line in enumerate(lines) if line.startswith("xi_t"))
    end = next(k for k, line in enumerate(lines) if line.startswith("centre px"))
    return lines[begin + 1 : end]


def test_each_kind_of_distortion_has_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cal.yaml"
    terms = {
        "xi_r4": -0.003,
        "xi_u": 0.004,
        "xi_w": 0.002,
        "xi_s": -0.01,
        "coil_x2": 0.02,
        "coil_y3": 0.01,
        "settling_3": 0.02,
    }
    _with_terms(terms, field_px=0.25).save(path)
    assert run("at", path, 2000) == 0
    told = _lines_of_distortion(capsys.readouterr().out)
    first = [line.split()[0] for line in told]
    assert first == ["xi_r4", "xi_u", "xi_w", "spiral", "coils", "settling", "field"]
    assert told[0].startswith("xi_r4        -0.003 +- 0.0001 (all radial ")
    assert told[1].startswith("xi_u         0.004 +- 0.0001 (all decentring ")
    assert told[3].startswith("spiral       -0.01 +- 0.0001 (")
    # P2 is 0.97 in the first column of 96, P3 0.94 in the first row.
    assert told[4] == "coils        0.93 px at most along x, 0.45 px along y"
    assert told[6] == "field        0.25 px at most, of the residual field"
    assert run("at", path, 2000, "--json") == 0
    sizes = json.loads(capsys.readouterr().out)["terms_px"]
    kinds = ["radial", "decentring", "spiral", "coils", "settling", "residual field"]
    assert list(sizes) == kinds
    assert sizes["residual field"] == pytest.approx(0.25)
    assert f"({sizes['spiral']:.2f} px at most)" in told[3]
    assert told[5] == f"settling     {sizes['settling']:.2f} px at most along x"


def test_kinds_that_are_not_there_have_no_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cal.yaml"
    for calibration, expected in (
        (make_calibration(), []),
        (_with_terms({}, field_px=0.25), []),
        (_with_terms({"xi_s": 0.01}), ["spiral"]),
        (_with_terms({"settling_1": 0.01}), ["settling"]),
    ):
        calibration.save(path)
        assert run("at", path, 2000) == 0
        told = _lines_of_distortion(capsys.readouterr().out)
        assert [line.split()[0] for line in told] == expected
