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

"""Errors name what was misspelt, the option to use, and the range of a number."""

from __future__ import annotations

import errno
import io
import os
import sys
from dataclasses import replace
from pathlib import Path

import click
import cv2
import numpy as np
import pytest

from semcal_ros.cli import main
from semcal_ros.cli.output import echo_rejected
from semcal_ros.core.calibration.views import RejectedView, ViewStatus
from semcal_ros.core.errors import Rejection
from tests.helpers.node_scenes import make_calibration


@pytest.mark.parametrize(
    ("given", "question"),
    [
        ("calibrat grid", "did you mean calibrate?"),
        ("measure cantilevr x", "cantilever"),
        ("drift x --confg generic", "--config"),
        ("simulate x --plan gridd", "did you mean grid?"),
        ("simulate x --preset jms820", "did you mean jsm820?"),
        ("simulate x --plan drift --specimen golld", "did you mean gold?"),
        ("drift x -o d.csv --config jsm280", "did you mean jsm820?"),
        ("drift grid -o d.csv", "did you mean gird?"),
        ("at cal.yam 100", "did you mean cal.yaml?"),
    ],
)
def test_what_is_misspelt_is_recognised(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    given: str,
    question: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gird").mkdir()
    (tmp_path / "cal.yaml").write_text("")
    assert main(given.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert question in line


def test_what_resembles_nothing_gets_no_guess(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["xyz"]) == 2
    assert "did you mean" not in capsys.readouterr().err


def test_rejected_views_are_told_by_kind(capsys: pytest.CaptureFixture[str]) -> None:
    views = [
        RejectedView(f"frame {k}", 100.0, Rejection(ViewStatus.OTHER_IMAGE_SIZE, f"{k} px wide"))
        for k in range(7)
    ]
    echo_rejected([*views, replace(views[0], rejection=Rejection(ViewStatus.OUTLIER, "outlier"))])
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("rejected: frame 0 at 100, frame 1 at 100, ")
    assert first.endswith("frame 4 at 100, 2 more: 0 px wide")
    assert second == "rejected: frame 0 at 100: outlier"


@pytest.mark.parametrize(
    ("option", "reason"),
    [
        ("--pixel-size 43.9", "expected 1e-13 to 1 m; state the unit, as in --pixel-size 43.9nm"),
        ("--display-width 127", "expected 0.001 to 100 m; state the unit"),
        ("--frame-interval 1e9", "expected 1e-06 to 1e+06 s; state the unit"),
        ("--frame-time 1e9", "expected at most 1e+06 s; state the unit"),
        ("--frame-time 1e400", "'1e400' is too large"),
        ("--magnification 1e30", "expected 0.001 to 1e+08"),
        ("--pixel-size 5lightyears", "is not a length such as 35um"),
        ("--pixel-size 0", "is not above 0"),
    ],
)
def test_a_number_that_is_too_large_is_not_called_negative(
    capsys: pytest.CaptureFixture[str], option: str, reason: str
) -> None:
    assert main(["drift", "x", "-o", "d.csv", *option.split()]) == 2
    assert reason in capsys.readouterr().err


@pytest.mark.parametrize("how", ["itself", "a symbolic link", "a hard link"])
@pytest.mark.parametrize("command", ["export", "calibrate", "import-calibration"])
def test_no_output_writes_over_a_file_that_is_read(
    command: str, how: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    read, written = tmp_path / "read.yaml", tmp_path / "written.yaml"
    make_calibration().save(read)
    before = read.read_bytes()
    if how == "itself":
        written = read
    elif how == "a hard link":
        written.hardlink_to(read)
    else:
        written.symlink_to(read)
    arguments: dict[str, list[object]] = {
        "export": [read, "--format", "ros", "--magnification", "1000"],
        "calibrate": [tmp_path, "--config", read],
        "import-calibration": [read, "--image-size", "64x64"],
    }
    assert main([str(a) for a in (command, *arguments[command], "-o", written)]) == 2
    assert "is also an input of this command" in capsys.readouterr().err
    assert read.read_bytes() == before


def test_the_calibration_that_is_renewed_may_be_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = tmp_path / "cal.yaml"
    make_calibration().save(calibration)
    assert main(["update", str(calibration), str(tmp_path / "none"), "-o", str(calibration)]) == 2
    assert "none" in capsys.readouterr().err


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_numbers_that_are_not_finite_are_refused(
    number: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", str(tmp_path / "bag"), "--blur", number]) == 2
    assert "--blur" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_reader_who_has_seen_enough_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a closed pipe, click ends the process with the status of a failure."""

    def write(*_: object, **__: object) -> None:
        raise OSError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr(click, "echo", write)
    monkeypatch.setattr("semcal_ros.cli.info_command.click.echo", write)
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    calibration = tmp_path / "cal.yaml"
    make_calibration().save(calibration)
    assert main(["info", str(calibration)]) == 0


def test_a_closed_stderr_keeps_no_command_from_its_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "picture.png"
    cv2.imwrite(str(picture), np.arange(64 * 64, dtype=np.uint16).reshape(64, 64))
    monkeypatch.setattr(sys, "stderr", None)
    assert main(["info", str(picture), "--pixel-size", "5nm"]) == 0
    assert "64 x 64" in capsys.readouterr().out


def test_a_command_of_a_group_writes_over_nothing_that_it_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = tmp_path / "cal.yaml"
    make_calibration().save(calibration)
    given = ["measure", "cantilever", str(tmp_path), "--calibration", str(calibration)]
    given += ["--length", "5um", "-o", str(calibration)]
    assert main(given) == 2
    assert "is also an input of this command" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["drift", "check", "rectify"])
def test_a_display_width_that_would_do_nothing_is_refused(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration, bag = tmp_path / "cal.yaml", tmp_path / "bag"
    make_calibration().save(calibration)
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    given: list[object] = [command, bag, "--display-width", "127mm"]
    if command == "check":
        given.insert(1, calibration)
    else:
        given += ["--calibration", calibration, "-o", tmp_path / "out.csv"]
    assert main([str(a) for a in given]) == 2
    assert "--display-width beside a calibration" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["a pipe", "a link to itself"])
@pytest.mark.parametrize("command", ["info", "stack"])
def test_what_cannot_be_read_at_all_is_refused_at_once(
    command: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "picture.tif"
    if kind == "a pipe":
        os.mkfifo(picture)
    else:
        picture.symlink_to(picture)
    output = ["-o", str(tmp_path / "mean.tif")] * (command == "stack")
    assert main([command, str(picture), "--pixel-size", "5nm", *output]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("semcal: ")
    assert "picture.tif" in line
