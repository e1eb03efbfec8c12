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

"""What ``semcal calibrate --method pda`` prints: equations that give back the functions, and the choice of the step."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from semcal_ros import Calibration
from semcal_ros.cli import calibrate_command
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import SquareAssignment
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES
from semcal_ros.workflows.calibrate import CalibrateOptions, RecordingCalibration
from semcal_ros.workflows.find_grid import CollectedViews
from tests.helpers.calibrations import CALIBRATED_EVENLY, calibrated
from tests.helpers.long_tests import long_but
from tests.helpers.semcal_runs import refused, run

VIEWS = 3

# A calibration takes some seconds.
pytestmark = pytest.mark.slow


@pytest.fixture
def printed(monkeypatch, tmp_path, capsys):
    """What the command prints for corners that are found already, and the calibration file."""

    def found(_recording, asked: CalibrateOptions, **_):
        result = calibrated("jsm820", asked.of_core(), CALIBRATED_EVENLY, VIEWS)
        nothing = np.zeros(0)
        squares = SquareAssignment(nothing, 1.0, nothing)
        collected = CollectedViews((), (), (), squares, result.model.image_size)
        return RecordingCalibration(Calibration.from_model(result.model), result, collected)

    def call(*arguments):
        path = tmp_path / "cal.yaml"
        capsys.readouterr()
        assert run("calibrate", "grid", "-o", path, *arguments) == 0
        return capsys.readouterr().out, Calibration.load(path)

    monkeypatch.setattr(calibrate_command, "calibrate_recording", found)
    return call


def _solve(right_side: str, order: int, conditions: list[float], u: np.ndarray) -> np.ndarray:
    """Integrate ``x'' = a x' + b x`` as it is printed, from x at both ends and inner derivatives at the first."""
    terms = dict.fromkeys(range(order), 0.0)
    for factor, primes in re.findall(r"([+-]\S+) x('*)", right_side):
        terms[len(primes)] = float(factor)

    def derivative(_u, state):
        return [*state[1:], sum(terms[j] * state[j] for j in range(order))]

    # A linear equation: its solution is the sum of those that start at the unit vectors.
    basis = [
        solve_ivp(derivative, (0.0, 1.0), e, t_eval=u, rtol=1e-11, atol=1e-13).y[0]
        for e in np.eye(order)
    ]
    first, last, *inner = conditions
    known = [first, *inner][: order - 1] if order > 1 else [first]
    start = np.zeros(order)
    start[: len(known)] = known
    if order > 1:
        # The highest derivative at the start is what makes the other end right.
        start[-1] = (last - sum(s * b[-1] for s, b in zip(start, basis, strict=True))) / basis[-1][
            -1
        ]
    return sum(s * b for s, b in zip(start, basis, strict=True))


@pytest.mark.parametrize("order", long_but(lambda order: order == 2, [1, 2, 3]))
def test_the_printed_equations_give_back_the_functions(printed, order):
    out, cal = printed("--method", "pda", "--pda-order", order)
    low, high = cal.magnification_range
    u = np.linspace(0.0, 1.0, 41)
    left = "x" + "'" * order
    rows = re.findall(rf"^ *(\w+) +(?:px|1/m)? +{left} = (.*?)  +(\S.*)$", out, re.MULTILINE)
    assert [name for name, _, _ in rows] == list(FUNCTION_NAMES)
    for name, right_side, numbers in rows:
        found = _solve(right_side, order, [float(v) for v in numbers.split()], u)
        true = np.array([cal.functions[name](low + t * (high - low)) for t in u])
        # Six digits of the weights, eight of the values; a small difference of large solutions costs some of them.
        np.testing.assert_allclose(
            found, true, atol=2e-4 * np.ptp(true) + 2e-7 * np.abs(true).max()
        )
    assert f"u = (g - {low:g}) / {high - low:g}, from 0 to 1" in out
    assert "scale is m over nominal" in out


def test_the_equations_are_there_for_a_notebook(printed):
    _, cal = printed("--method", "pda")
    assert [e.name for e in cal.equations] == list(FUNCTION_NAMES)
    for e in cal.equations:
        function = cal.functions[e.name]
        low, high = e.g_range
        assert e.order == 2 and e.g_range == cal.magnification_range
        assert e.start[0] == pytest.approx(function(low), rel=1e-12)
        assert e.end == pytest.approx(function(high), rel=1e-12)
        # x' at the lower end, over u.
        h = 1e-6
        slope = (function(low + h * (high - low)) - function(low)) / h
        assert e.start[1] == pytest.approx(slope, rel=1e-3, abs=1e-6 * (1.0 + abs(function(low))))


def test_focal_length_and_skew_are_the_papers(printed):
    out, cal = printed("--method", "pda")
    (row,) = re.findall(r"^ *f = m/rho +px +(\S+) +(\S+)$", out, re.MULTILINE)
    (skew,) = re.findall(r"^ *s = skew f +px +(\S+) +(\S+)$", out, re.MULTILINE)
    low, high = (cal.at(g) for g in cal.magnification_range)
    # K = [[a f, s, px], [0, f/a, py], [0, 0, 1]]
    assert float(row[0]) == pytest.approx(np.sqrt(low.K[0, 0] * low.K[1, 1]), rel=1e-6)
    assert float(skew[0]) == pytest.approx(low.K[0, 1], rel=1e-6)
    # The equation of rho may lead below zero at the other end, where there is no K.
    assert float(row[1]) == pytest.approx(high.m / high.rho, rel=1e-6)


@pytest.mark.long
def test_other_methods_print_no_equations(printed):
    for arguments in (("--method", "discrete"), ("--method", "pda", "--legendre", 3)):
        out, cal = printed(*arguments)
        assert cal.equations == ()
        assert "dx/du" not in out


def test_readings_of_a_stage_that_are_not_used_are_called_so(printed, monkeypatch):
    plain = calibrate_command.calibrate_recording

    def with_stage(*args, **given):
        done = plain(*args, **given)
        views = tuple(replace(v, stage=StageReading()) for v in done.result.views)
        return replace(done, result=replace(done.result, views=views))

    monkeypatch.setattr(calibrate_command, "calibrate_recording", with_stage)
    out, _ = printed("--method", "pda", "--pda-order", 1)
    assert "the stage is known for 18 of 18 views, but method pda does not use it" in out


@pytest.mark.long
def test_the_choice_of_the_step_is_printed(printed):
    out, cal = printed("--method", "pda", "--pda-step", "auto")
    fit = cal.statistics["fit"]
    table = re.findall(r"^ *([\d.]+) +(\d+) +([\d.]+) +([\d.]+|inf) *(chosen)?", out, re.MULTILINE)
    rows = [row for row in table if float(row[0]) in [s["step"] for s in fit["steps"]]]
    assert len(rows) == len(fit["steps"]) >= 2
    (chosen,) = (row for row in rows if row[4])
    assert float(chosen[0]) == fit["step"]
    assert float(chosen[3]) == min(float(row[3]) for row in rows)
    assert fit["options"]["pda_step"] == "auto"


def test_a_step_that_is_none_is_refused(tmp_path, capsys):
    for text in ("best", "-500", "nan"):
        line = refused(capsys, "calibrate", "grid", "-o", tmp_path / "c.yaml", "--pda-step", text)
        assert "auto" in line


@pytest.mark.parametrize(
    ("method", "option", "value"),
    [
        ("joint", "--tau", "3"),
        ("joint", "--pda-order", "2"),
        ("pda", "--residual", "on"),
        ("pda", "--breakpoints", "900"),
        ("discrete", "--legendre", "3"),
    ],
)
def test_options_of_another_method_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str, option: str, value: str
) -> None:
    arguments = ("calibrate", tmp_path, "-o", tmp_path / "c.yaml", "--method", method)
    (tmp_path / "a.png").touch()
    line = refused(capsys, *arguments, option, value)
    assert f"{option} with --method {method}, which does not use it" in line
