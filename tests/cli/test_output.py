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

"""What several commands print: the progress of long work."""

from __future__ import annotations

import io
import time
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.cli import output
from semcal_ros.cli.output import echo_term_sizes, show_progress
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from tests.helpers.node_scenes import make_calibration


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _use_terminal(monkeypatch: pytest.MonkeyPatch, after_s: float = 0.02) -> _Terminal:
    """A terminal as stderr, and bars sooner than after a second.

    No fixture: pytest replaces stderr before each test.
    """
    monkeypatch.setattr(output, "_SHOWN_AFTER_S", after_s)
    monkeypatch.setattr(output, "_TICK_S", 0.01)
    stderr = _Terminal()
    monkeypatch.setattr("sys.stderr", stderr)
    return stderr


def _wait_for(text: str, stderr: _Terminal) -> bool:
    end_s = time.monotonic() + 5.0
    while text not in stderr.getvalue() and time.monotonic() < end_s:
        time.sleep(0.01)
    return text in stderr.getvalue()


def test_a_stage_that_counts_nothing_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = _use_terminal(monkeypatch)
    with show_progress() as on_progress:
        assert _wait_for("opening [", terminal)
        on_progress("adjusting", 0, None)
        assert _wait_for("adjusting [", terminal)
    # The line is cleared for what the command prints.
    assert terminal.getvalue().rpartition("\r")[2] == ""
    assert terminal.getvalue().rstrip("\r").rpartition("\r")[2].strip() == ""


def test_a_stage_that_counts_shows_how_much_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = _use_terminal(monkeypatch)
    with show_progress() as on_progress:
        on_progress("finding corners", 0, 8)
        on_progress("finding corners", 2, 8)
        assert _wait_for(" 25%|", terminal)
        assert _wait_for("2 of 8", terminal)


def test_quick_work_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = _use_terminal(monkeypatch, after_s=60.0)
    with show_progress() as on_progress:
        on_progress("drift", 1, 2)
        time.sleep(0.05)
    assert "drift" not in terminal.getvalue()


def test_only_terminals_see_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output, "_SHOWN_AFTER_S", 0.0)
    stderr = io.StringIO()
    monkeypatch.setattr("sys.stderr", stderr)
    with show_progress() as on_progress:
        on_progress("drift", 1, 2)
    assert stderr.getvalue() == ""


def test_distortion_is_told_by_its_kinds_where_a_calibration_has_further_terms(
    capsys: pytest.CaptureFixture[str],
) -> None:
    plain = make_calibration()
    echo_term_sizes(plain)
    assert capsys.readouterr().out == ""
    # It grows with log g: the largest is that of the highest magnification, 0.02 half widths of 48 px.
    spiral = ContinuousFunction("chebyshev_log", np.array([0.01, 0.01]), (500.0, 8000.0))
    size = len(plain.covariance) + 2
    terms = replace(
        plain,
        functions={**plain.functions, "xi_s": spiral},
        covariance=1e-8 * np.eye(size),
    )
    echo_term_sizes(terms)
    told = capsys.readouterr().out
    assert told.startswith("distortion: radial ")
    assert ", decentring " in told
    assert ", spiral 3" in told
    assert "coils" not in told
    assert told.endswith(" px (largest, at any calibrated magnification)\n")
