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

"""What a node was started with: refuses what it would otherwise ignore, reads parameter files, and prints `--help`.

The table of executables is the one at the top of ``doc/nodes.md``.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semcal_ros.core.errors import ConfigError, InvalidValueError, SemcalError
from semcal_ros.core.wording import nearest_name
from semcal_ros.files.plain_yaml import load_plain_yaml
from semcal_ros.nodes.common.parameters import DIRECTORY, ParameterDeclaration
from semcal_ros.text_files import read_text_file

_HELP = ("-h", "--help")
# rclpy declares these by itself.
_OF_ROS = ("use_sim_time", "start_type_description_service")
_OF_QOS = "qos_overrides."

_WIDTH = 100  # characters

_MAX_BYTES = 1024 * 1024  # they are written by hand; this only keeps other files out


class HelpWanted(Exception):
    """Raised where a node would start ROS, with what is known about it by then."""

    def __init__(self, name: str, declarations: Sequence[ParameterDeclaration]) -> None:
        super().__init__(name)
        self.name = name
        self.declarations = tuple(declarations)


@dataclass(frozen=True)
class CommandLine:
    """The arguments of one executable.

    Attributes
    ----------
    arguments
        Without the name of the executable.
    of_several
        Whether they are of several nodes in one process: what one does not know another may.
    """

    arguments: tuple[str, ...] = ()
    of_several: bool = False

    @property
    def wants_help(self) -> bool:
        """Whether help is asked for outside of the arguments for ROS."""
        return any(argument in _HELP for argument in self._foreign())

    def _foreign(self) -> list[str]:
        found, for_ros = [], False
        for argument in self.arguments:
            if argument in ("--ros-args", "--"):
                for_ros = argument == "--ros-args"
            elif not for_ros:
                found.append(argument)
        return found

    def refuse_foreign(self) -> None:
        """Refuse arguments that are not for ROS; raises :class:`InvalidValueError`."""
        foreign = self._foreign()
        if foreign:
            given = " ".join(foreign)
            parameter = next((a for a in foreign if ":=" in a), "NAME:=VALUE")
            raise InvalidValueError(
                f"{given}, which ROS would ignore",
                expected=f"parameters after --ros-args -p, as in `--ros-args -p {parameter}`",
                do="see --help",
            )

    def unused_names(self, given: Iterable[str], declared: Iterable[str], node: str) -> list[str]:
        """Return given parameters that the node does not have, from sections that are meant for several nodes.

        Parameters
        ----------
        given, declared
            Names of the parameters that the node was given, and of those that it has.
        node
            Its fully qualified name.

        Raises
        ------
        InvalidValueError
            Such a name was given to this node alone, or a section of a file has its name without its namespace,
            which ROS takes for another node.
        """
        sections = self._sections()
        namespace, _, name = node.rpartition("/")
        for section in sections:
            if namespace and section.nodes == f"/{name}":
                raise InvalidValueError(
                    f"section {name} of {section.file}, which is for the node /{name}",
                    expected=f"the section {node} of this node, or /**",
                    do="correct the name of the section, or start the node with -r __ns:=/",
                )
        known = list(declared)
        for_all = frozenset[str]().union(*(s.names for s in sections if "*" in s.nodes))
        unknown = [key for key in given if key not in known and key not in _OF_ROS]
        for key in unknown:
            if key not in for_all and not self.of_several:
                raise unknown_parameter(key, name, known)
        return unknown

    def renamed_topics(self, node: str) -> list[str]:
        """Return the names of topics and services that are given another name, as they were written.

        Parameters
        ----------
        node
            Name of the node, without its namespace: what is renamed for another node is left out.
        """
        pairs = zip(self.arguments, self.arguments[1:], strict=False)
        rules = [value.partition(":=")[0] for flag, value in pairs if flag in ("-r", "--remap")]
        split = [rule.rpartition(":") for rule in rules]
        return [name for of, _, name in split if of in ("", node) and not name.startswith("__")]

    def _sections(self) -> list[ParameterSection]:
        pairs = zip(self.arguments, self.arguments[1:], strict=False)
        files = [value for flag, value in pairs if flag == "--params-file"]
        return [section for file in files for section in _read_sections(file)]


def unknown_parameter(key: str, owner: str, known: Iterable[str]) -> InvalidValueError:
    """Return the error for a parameter that a node, or all nodes of a process, do not have."""
    near = nearest_name(key, list(known))
    return InvalidValueError(
        f"parameter {key}, which {owner} does not have",
        expected=f"{near}, perhaps" if near else "one of its parameters",
        do="see --help, or `ros2 param list` while it runs",
    )


def _read_sections(file: str) -> tuple[ParameterSection, ...]:
    with suppress(SemcalError):  # ROS itself says what is wrong with it
        return read_parameter_sections(file)
    return ()


def is_quality(name: str) -> bool:
    """Return whether a parameter overrides the quality of service of a topic."""
    return name.startswith(_OF_QOS)


_CURRENT: ContextVar[CommandLine] = ContextVar("command_line", default=CommandLine())  # noqa: B039 - frozen


def command_line() -> CommandLine:
    """Return the command line of the executable that is being started; an empty one elsewhere."""
    return _CURRENT.get()


@contextmanager
def starting_with(arguments: Sequence[str], *, of_several: bool = False) -> Iterator[CommandLine]:
    """Make these the arguments of the executable that is started inside."""
    line = CommandLine(tuple(arguments), of_several)
    token = _CURRENT.set(line)
    try:
        yield line
    finally:
        _CURRENT.reset(token)


@dataclass(frozen=True)
class ExecutableHelp:
    """What one executable is for.

    Attributes
    ----------
    purpose
        One sentence.
    inputs, outputs, services
        Topics and services, as the documentation lists them.
    example
        Arguments of a typical start.
    nodes
        Executables whose parameters it takes besides its own.
    """

    purpose: str
    inputs: str
    outputs: str
    services: str
    example: str
    nodes: tuple[str, ...] = ()


EXECUTABLES = {
    "stream_corrector": ExecutableHelp(
        "Removes drift and distortion from the live stream in one interpolation.",
        "image_raw, magnification, calibration, conditions",
        "image_rect, camera_info, projection_stamped, projection_covariance_stamped, drift, drift_velocity, ~/moving",
        "~/reset",
        "-p config:=jsm820 -p calibration:=cal.yaml",
    ),
    "drift_compensator": ExecutableHelp(
        "Removes drift from the live stream; needs no calibration.",
        "image_raw, magnification",
        "image_stabilized, drift, drift_velocity, ~/moving",
        "~/reset",
        "-p config:=jsm820",
    ),
    "rectifier": ExecutableHelp(
        "Removes distortion from the live stream.",
        "image_raw or image_stabilized, magnification, calibration, conditions",
        "image_rect, camera_info, projection_stamped, projection_covariance_stamped",
        "",
        "-p config:=jsm820 -p calibration:=cal.yaml",
    ),
    "parameter_server": ExecutableHelp(
        "Serves the calibration at any magnification, on topics and as parameters.",
        "magnification, calibration, conditions; image_raw with monitor_period",
        "calibration, camera_info, projection, projection_covariance, /tf_static where tf2 is installed; parameters"
        " such as `p@5250`",
        "~/reload",
        "-p config:=jsm820 -p calibration:=cal.yaml",
    ),
    "calibration_server": ExecutableHelp(
        "Collects views of the grid from the live stream, and calibrates from them.",
        "image_raw, magnification, stage, conditions",
        "calibration, ~/progress, ~/overlay",
        "~/add_view, ~/calibrate, ~/calibrate_start, ~/acquire, ~/extend, ~/cancel, ~/check, ~/update, ~/save, ~/clear",
        "-p config:=jsm820 -p output:=live.yaml",
    ),
    "virtual_sem": ExecutableHelp(
        "A simulated live microscope with a stage and a magnification knob.",
        "~/stage, ~/move_stage, ~/set_magnification",
        "image_raw, magnification, stage, conditions, ~/motion",
        "~/start, ~/stop",
        "-p specimen:=gold -p drift:=slow -p magnification:=5000.0",
    ),
    "microscope": ExecutableHelp(
        "Puts a microscope, a folder of its pictures or a frame grabber on the topics.",
        "~/set_magnification, ~/move_stage",
        "image_raw, magnification, stage, conditions, ~/motion",
        "~/start, ~/stop",
        "-p config:=jsm820 -p source:=folder -p folder:=/mnt/sem",
    ),
    "visual_servo": ExecutableHelp(
        "Brings a target to a pose in the sem frame by velocities of the stage.",
        "image_rect, camera_info, projection_stamped or projection, projection_covariance_stamped, drift,"
        " magnification",
        "velocity of the stage, ~/error",
        "~/start, ~/stop",
        "-p goal_x_m:=1e-6 -p start:=true",
    ),
    "suite": ExecutableHelp(
        "The suite in one process, with the parameters of all its nodes: source, stream_corrector, parameter_server,"
        " viewer, and consumers of others.",
        "what its nodes do; frames go from node to node in memory",
        "what its nodes do, images only where somebody subscribes",
        "those of its nodes",
        "-p config:=jsm820 -p source:=openfibsem -p consumers:=none",
        (
            "stream_corrector",
            "parameter_server",
            "microscope",
            "bag_player",
            "virtual_sem",
        ),
    ),
    "bag_player": ExecutableHelp(
        "Replays a recording on its own topics.",
        "a recording, ~/seek, ~/set_rate",
        "its topics, /clock",
        "~/pause, ~/resume, ~/toggle_paused, ~/play_next",
        "-p bag:=recording -p rate:=2.0",
    ),
}


def format_help(name: str, declarations: Sequence[ParameterDeclaration]) -> str:
    """Return the help text of an executable.

    Parameters
    ----------
    name
        Of the executable.
    declarations
        Its parameters; the last declaration of a name counts.
    """
    parameters = {declaration.name: declaration for declaration in declarations}
    if any(declaration.confined for declaration in parameters.values()):
        parameters.setdefault(DIRECTORY.name, DIRECTORY)
    about = EXECUTABLES[name]
    lines = [
        about.purpose,
        "",
        f"usage: ros2 run semcal_ros {name} [--ros-args [-p PARAMETER:=VALUE]... [-r OLD:=NEW]...]",
        "",
        f"  subscribes  {about.inputs}",
        f"  publishes   {about.outputs}, /diagnostics",
    ]
    if about.services:
        lines.append(f"  services    {about.services}")
    lines += ["", "Names are relative; the namespace is /sem unless -r __ns:=/NAME gives another."]
    lines += ["", "parameters (* only read at start):"]
    for declaration in parameters.values():
        mark = "*" if declaration.fixed else " "
        lines.append(f" {mark}{declaration.name} = {_format_default(declaration.default)}")
        text = f"{declaration.description} Accepted: {declaration.expected}."
        lines += textwrap.wrap(
            text, _WIDTH, initial_indent=8 * " ", subsequent_indent=8 * " ", break_on_hyphens=False
        )
    if about.nodes:
        lines += [
            "",
            "and the parameters of its nodes, each as for the executable of that name (--help):",
        ]
        lines.append(f"  {', '.join(about.nodes)}")
    lines += ["", f"example: ros2 run semcal_ros {name} --ros-args {about.example}"]
    return "\n".join(lines)


def _format_default(value: bool | float | str) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value) if value != "" else "''"


@dataclass(frozen=True)
class ParameterSection:
    """A section of a parameter file.

    Attributes
    ----------
    file
        Name of the file.
    nodes
        The nodes that it is for, such as ``/sem/rectifier`` or ``/**``.
    names
        The parameters in it, with dots between their parts.
    """

    file: str
    nodes: str
    names: frozenset[str]


def read_parameter_sections(path: str | os.PathLike[str]) -> tuple[ParameterSection, ...]:
    """Read the sections of a file; raises :class:`SemcalError` if it is not plain YAML."""
    name = os.fspath(path)
    text = read_text_file(Path(name), _MAX_BYTES, error=ConfigError, expected="a parameter file")
    return tuple(_list_sections(name, "", load_plain_yaml(text, name)))


def _list_sections(file: str, path: str, content: Any) -> Iterator[ParameterSection]:
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        if key == "ros__parameters":
            yield ParameterSection(file, path, frozenset(_list_names("", value)))
        else:
            yield from _list_sections(file, f"{path}/{str(key).strip('/')}", value)


def _list_names(prefix: str, content: Any) -> Iterator[str]:
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from _list_names(f"{prefix}.{key}" if prefix else str(key), value)
    else:
        yield prefix
