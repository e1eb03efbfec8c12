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

"""The commands for what to do next: they run as they stand, with the files of the calibration."""

from __future__ import annotations

import math
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from semcal_ros.calibration import Calibration
from semcal_ros.cli.at_command import command as at_command
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.plan import Judgement, PlannedVisit
from semcal_ros.report import write_calibration_report
from semcal_ros.report.calibration import page
from semcal_ros.report.calibration.page import suggest_commands
from semcal_ros.report.html import encode
from tests.helpers.report_samples import Page

GOOD = Judgement(100.0, 5000.0, 0.002, 147.0, 1e-6, 0.001, None)


def test_a_visit_is_planned_and_used() -> None:
    visit = PlannedVisit(139.2, 25e-6, 0.001161, 5000.0)
    (_, plan), (_, update) = suggest_commands(replace(GOOD, next_visit=visit), "to day/cal.yaml")
    # Not below 0.1161 %, so that one visit meets it.
    assert plan == "semcal plan 'to day/cal.yaml' --target 0.12% --ageing 0.01%"
    assert shlex.split(update) == [
        *("semcal", "update", "to day/cal.yaml", "views_139x"),
        *("-o", "to day/cal_improved.yaml", "--ageing", "0.01%"),
    ]


def test_where_nothing_helps_the_budget_is_shown() -> None:
    ((_, command),) = suggest_commands(GOOD, "cal.yaml")
    assert command == "semcal at cal.yaml 147 --budget"
    ((_, command),) = suggest_commands(replace(GOOD, at=10000.0), "cal.yaml")
    assert command == "semcal at cal.yaml 10000 --budget"
    assert suggest_commands(replace(GOOD, floor=math.nan), "cal.yaml") == []
    assert suggest_commands(GOOD, "") == []


@pytest.mark.slow
@pytest.mark.long
def test_the_command_of_the_page_runs(
    result: CalibrationResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What counts here is the text.
    monkeypatch.setattr(encode, "_FIGURE_DPI", 48.0)
    monkeypatch.setattr(page, "judge_calibration", lambda _: GOOD)
    file = tmp_path / "my cal.yaml"
    Calibration.from_model(result.model).save(file)
    path = write_calibration_report(result, tmp_path / "r.html", calibration=str(file))
    ((what, command),) = suggest_commands(GOOD, str(file))
    assert f"{what} {command}" in Page(path.read_text(encoding="utf-8")).text
    semcal, name, *arguments = shlex.split(command)
    assert (semcal, name) == ("semcal", "at")
    done = CliRunner().invoke(at_command, arguments)
    assert done.exit_code == 0, done.output
