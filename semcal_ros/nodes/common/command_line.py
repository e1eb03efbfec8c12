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

"""What a node was started with: refuses what it would otherwise ignore, and tells what `--help` shows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass

from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.core.wording import nearest_name
from semcal_ros.files.parameter_file import ParameterSection, read_parameter_sections
from semcal_ros.nodes.common.parameters import ParameterDeclaration

_HELP = ("-h", "--help")
# rclpy declares these by itself.
_OF_ROS = ("use_sim_time", "start_type_description_service")
_OF_QOS = "qos_overrides."


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
