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

"""What pages list without a prompt: run elsewhere, or not run for a reason; options and parameters exist everywhere."""

from __future__ import annotations

import re
import shlex
from importlib import import_module
from pathlib import Path

import click
import pytest

from semcal_ros.config.config import parse_config
from semcal_ros.nodes.common.base import node_class
from semcal_ros.nodes.common.command_line import HelpWanted, starting_with
from tests.helpers.listings import listings
from tests.helpers.project import NODES, ROOT

DOC = ROOT / "doc"
PAGES = [ROOT / "README.md", *sorted(DOC.rglob("*.md"))]
PROGRAMS = ("semcal", "ros2", "pip", "cd", "git", "make")
# Their commands are run, and what they print is compared: tests/docs/test_tutorials.py.
RUN = (DOC / "tutorials" / "first_calibration.md", DOC / "howto" / "views.md")
# What of README.md, drivers.md and viewers.md is not run there, and why.
NOT_RUN = {
    "cd ~/ws": "a workspace of ROS; tests/packaging/test_builds.py builds the package",
    "git clone": "its address is not known to it",
    "make demo": "tests/examples/test_examples.py",
    "make demo-live": "does not end; tests/nodes/test_demo.py",
    "make test": "all of this",
    "pip install": "tests/packaging/test_builds.py",
    "ros2 launch": "does not end; tests/packaging/test_launch.py",
    "ros2 run": "does not end; tests/nodes/test_microscope_openfibsem.py and others",
    "ros2 topic pub": "a command of ROS; tests/nodes/test_microscope_sources.py moves the stage",
    "semcal view": "does not end; tests/nodes/test_viewer.py",
}


def _listed(page: Path) -> list[str]:
    """Commands of the listings of a page, with a prompt or without."""
    text = re.sub(
        r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )
    lines = re.findall(r"^    (?:\$ )?(\S.*)$", re.sub(r" *\\\n +", " ", text), re.MULTILINE)
    without_comment = [re.sub(r" +# .*", "", line) for line in lines]
    return [line for line in without_comment if line.partition(" ")[0] in PROGRAMS]


def test_commands_without_a_prompt_are_run_or_have_a_reason() -> None:
    run = {listed.command for page in RUN for listed in listings(page)}
    pages = (ROOT / "README.md", DOC / "drivers.md", DOC / "viewers.md")
    found = [command for page in pages for command in _listed(page)]
    assert len(found) > 20
    assert [c for c in found if c not in run and not c.startswith(tuple(NOT_RUN))] == []
    assert [start for start in NOT_RUN if not any(c.startswith(start) for c in found)] == []


def _commands_of_semcal() -> list[tuple[str, list[str]]]:
    return [
        (f"{page.name}: {command}", shlex.split(command)[1:])
        for page in PAGES
        for command in _listed(page)
        if command.startswith("semcal ")
    ]


def test_options_of_listed_commands_exist() -> None:
    unknown, seen = [], 0
    for where, words in _commands_of_semcal():
        module = words[0].replace("-", "_")
        if module.startswith("_"):
            continue  # `semcal --version`
        command = import_module(f"semcal_ros.cli.{module}_command").command
        while isinstance(command, click.Group):
            command = command.commands[words[1]]
            words = words[1:]
        known = {name for option in command.params for name in option.opts}
        options = [w.partition("=")[0] for w in words if re.match(r"--?[a-z]", w)]
        unknown += [f"{where}: {option}" for option in options if option not in known]
        seen += len(options)
    assert unknown == []
    assert seen > 80


def _declared(node: str) -> set[str]:
    with starting_with(["--help"]), pytest.raises(HelpWanted) as wanted:
        node_class(node)()
    return {declaration.name for declaration in wanted.value.declarations}


@pytest.mark.parametrize("node", NODES)
def test_parameters_of_listed_executables_exist(node: str) -> None:
    known = _declared(node)
    if node == "suite":  # each goes to the node that has it
        inside = ("stream_corrector", "parameter_server", "microscope", "bag_player", "virtual_sem")
        known = known.union(*(_declared(part) for part in inside))
    start = f"ros2 run semcal_ros {node} "
    lines = [c for page in PAGES for c in _listed(page) if c.startswith(start)]
    given = {word.partition(":=")[0] for c in lines for word in shlex.split(c) if ":=" in word}
    assert given <= known


def test_configurations_of_pages_are_valid() -> None:
    texts = [
        text
        for page in PAGES
        for text in re.findall(
            r"^```yaml\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL
        )
        if "display_width_m:" in text
    ]
    assert [parse_config(text).name for text in texts] == ["my SEM", "my other SEM"]
