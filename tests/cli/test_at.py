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
from pathlib import Path

import pytest

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
