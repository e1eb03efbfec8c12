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

"""Where a calibration is saved: said beforehand, and no file of somebody else is lost silently."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from semcal_ros.nodes.calibration_server import OUTPUT, OutputFile
from tests.nodes.common.test_parameters import declared


def made(**given: Any) -> tuple[Any, OutputFile, list[str]]:
    node, parameters = declared(OUTPUT, **given)
    said: list[str] = []
    return node, OutputFile(parameters, said.append), said


def save(path: Path) -> None:
    path.write_text("new")


def test_the_default_is_in_the_working_directory_or_in_the_folder_that_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    assert made()[1].plan == f"~/save will write {tmp_path}/calibration.yaml"
    assert made(directory="data")[1].plan == f"~/save will write {folder}/calibration.yaml"
    assert made(directory=str(folder), output="a.yaml")[1].path() == folder / "a.yaml"


def test_the_default_never_replaces_a_file_that_was_there(tmp_path: Path) -> None:
    old = tmp_path / "calibration.yaml"
    old.write_text("old")
    _, output, _ = made(directory=str(tmp_path))
    own = tmp_path / "calibration_2.yaml"
    assert output.plan == f"~/save will write {own}"
    # Its own file is replaced without a word.
    for _ in range(2):
        assert output.write(save) == f"saved to {own}"
    assert old.read_text() == "old"


def test_a_file_that_is_named_is_replaced_and_that_is_said(tmp_path: Path) -> None:
    node, output, said = made(directory=str(tmp_path))
    file = tmp_path / "live.yaml"
    file.write_text("old")
    assert node.set("output", "live.yaml").successful
    assert said == [f"~/save will replace {file}"]
    answer = output.write(save)
    assert answer == f"saved to {file}, in place of a file that this node had not written"
    assert output.write(save) == f"saved to {file}"


def test_a_folder_that_cannot_be_written_to_is_said_before_the_work(tmp_path: Path) -> None:
    _, output, _ = made(output=str(tmp_path / "missing" / "a.yaml"))
    assert "cannot write" in output.plan
    assert "set the parameter output" in output.plan


def test_callers_of_services_cannot_write_what_is_no_calibration(tmp_path: Path) -> None:
    node, _, _ = made(directory=str(tmp_path))
    for name in (".bashrc", "run.sh", "yaml"):
        result = node.set("output", name)
        assert not result.successful
        assert "ends in .yaml" in result.reason
