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

"""What a node is started with: nothing is ignored in silence, and help needs no ROS."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.nodes.common.command_line import EXECUTABLES, CommandLine
from tests.helpers.ros_process import running

REPOSITORY = Path(__file__).resolve().parents[3]
DECLARED = ("config", "calibration", "interpolation", "use_sim_time")
NODE = "/sem/rectifier"


def unused(line: CommandLine, *given: str, node: str = NODE) -> list[str]:
    return line.unused_names(given, DECLARED, node)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("calibration:=cal.yaml",), "--ros-args -p calibration:=cal.yaml"),
        (("-p", "calibration:=cal.yaml"), "--ros-args -p calibration:=cal.yaml"),
        (("--ros-args", "-p", "config:=x", "--", "loop"), "loop, which ROS would ignore"),
    ],
)
def test_arguments_that_ros_would_ignore_are_refused(
    arguments: tuple[str, ...], named: str
) -> None:
    with pytest.raises(InvalidValueError, match=re.escape(named)):
        CommandLine(arguments).refuse_foreign()


def _is_refused(*arguments: str) -> bool:
    try:
        CommandLine(arguments).refuse_foreign()
    except InvalidValueError:
        return True
    return False


def test_arguments_for_ros_pass() -> None:
    assert not _is_refused("--ros-args", "-p", "config:=x", "-r", "__ns:=/lab", "--")
    assert not _is_refused()
    # What follows the end of the arguments for ROS is not for it.
    assert _is_refused("--ros-args", "-p", "config:=x", "--", "__ns:=/lab")


def test_a_misspelt_parameter_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(InvalidValueError, match=r"calibraton.* expected calibration, perhaps"):
        unused(CommandLine(), "config", "calibraton")
    with pytest.raises(InvalidValueError, match=r"xyz.* expected one of its parameters"):
        unused(CommandLine(), "xyz")


def test_what_ros_itself_declares_is_known() -> None:
    assert unused(CommandLine(), "config", "use_sim_time", "start_type_description_service") == []


def line_with(path: Path, text: str) -> CommandLine:
    path.write_text(text, encoding="utf-8")
    return CommandLine(("--ros-args", "--params-file", str(path)))


def test_unknown_names_are_refused_in_a_section_of_this_node_and_listed_from_one_for_all(
    tmp_path: Path,
) -> None:
    content = ":\n  ros__parameters:\n    config: x\n    image_rect:\n      depth: 5\n"
    for own in ("/sem/rectifier", "sem:\n  rectifier"):
        indented = content if ":" not in own else content.replace("\n  ", "\n    ")
        line = line_with(tmp_path / "own.yaml", own + indented)
        with pytest.raises(InvalidValueError, match=r"image_rect\.depth"):
            unused(line, "config", "image_rect.depth")
    line = line_with(tmp_path / "all.yaml", "/**" + content)
    assert unused(line, "config", "image_rect.depth") == ["image_rect.depth"]


def test_a_section_that_names_the_node_without_its_namespace_is_refused(tmp_path: Path) -> None:
    line = line_with(tmp_path / "p.yaml", "rectifier:\n  ros__parameters:\n    config: x\n")
    with pytest.raises(InvalidValueError, match="expected the section /sem/rectifier"):
        unused(line)
    # Without a namespace it is the right one, and for others it may be.
    assert unused(line, node="/rectifier") == []
    assert unused(line, node="/sem/stream_corrector") == []


def test_help_needs_no_ros_and_says_what_the_documentation_says() -> None:
    """In one process for all of them, which cannot start ROS."""
    script = """
import importlib
import rclpy
rclpy.init = None
from semcal_ros.nodes.common.command_line import EXECUTABLES
for name in EXECUTABLES:
    assert importlib.import_module(f"semcal_ros.nodes.{name}").main(["--help"]) == 0
    print("=====")
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    texts = dict(zip(EXECUTABLES, done.stdout.split("=====\n"), strict=False))
    manual = (REPOSITORY / "doc" / "nodes.md").read_text(encoding="utf-8")
    for name, about in EXECUTABLES.items():
        row = f"| [`{name}`](#{name}) | {about.inputs} | {about.outputs} | "
        assert row + (f"{about.services} |" if about.services else "|") in manual
        text = texts[name]
        assert text.startswith(about.purpose)
        assert "\n *config = " in text
        assert f"example: ros2 run semcal_ros {name} --ros-args {about.example}" in text
        # A parameter of the suite may be that of one of its nodes, which it names.
        assert not about.nodes or f"\n  {', '.join(about.nodes)}\n" in text
        known = text + "".join(texts[node] for node in about.nodes)
        for parameter in re.findall(r"-p (\w+):=", about.example):
            assert re.search(rf"^ [ *]{parameter} = ", known, re.MULTILINE), parameter


def test_help_may_be_cut_short() -> None:
    """As by `--help | head -1`, which leaves."""
    script = "import sys; from semcal_ros.nodes.rectifier import main; sys.exit(main(['--help']))"
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(timeout=60) == 0
    assert process.stderr is not None
    assert process.stderr.read() == ""
    process.stderr.close()


def test_renamed_topics_are_those_for_this_node() -> None:
    rules = ("a:=/x", "__ns:=/lab", "rectifier:b:=/y", "other:c:=/z", "~/d:=/v")
    line = CommandLine(("--ros-args", *(word for rule in rules for word in ("-r", rule))))
    assert line.renamed_topics("rectifier") == ["a", "b", "~/d"]


def test_a_misspelt_topic_is_told_at_the_start() -> None:
    given = ("image_rct:=/out/x", "camera_info:=/out/y", "~/get_parameters:=/out/z")
    rules = tuple(word for rule in given for word in ("-r", rule))
    with running("rectifier", None, *rules) as node:
        deadline = time.monotonic() + 30.0
        while "subscribes to" not in node.output and time.monotonic() < deadline:
            time.sleep(0.02)
        log = node.output
    assert "not renamed: image_rct (image_rect, perhaps)" in log
    assert log.count("perhaps") == 1
