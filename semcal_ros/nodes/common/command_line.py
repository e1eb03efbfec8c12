"""What a node was started with: refuses what it would otherwise ignore, and tells what `--help` shows."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semcal_ros.core.errors import ConfigError, InvalidValueError, SemcalError
from semcal_ros.files.plain_yaml import load_plain_yaml
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.text_files import read_text_file

__all__ = [
    "CommandLine",
    "HelpWanted",
    "command_line",
    "is_quality",
    "nearest_name",
    "starting_with",
]

_HELP = ("-h", "--help")
# rclpy declares these by itself.
_OF_ROS = ("use_sim_time", "start_type_description_service")
_OF_QOS = "qos_overrides."
# A parameter file is written by hand; larger ones are something else.
_MAX_BYTES = 1024 * 1024


class HelpWanted(Exception):
    """Raised where a node would start ROS, with what is known about it by then."""

    def __init__(self, name: str, declarations: Sequence[ParameterDeclaration]) -> None:
        super().__init__(name)
        self.name = name
        self.declarations = tuple(declarations)


@dataclass(frozen=True)
class _Section:
    """A section of a parameter file: the nodes that it is for, and the names in it."""

    file: str
    nodes: str
    names: frozenset[str]


@dataclass(frozen=True)
class CommandLine:
    """The arguments of one executable.

    Attributes
    ----------
    arguments
        Without the name of the executable.
    """

    arguments: tuple[str, ...] = ()

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
        sections = list(self._sections())
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
            if key not in for_all:
                near = nearest_name(key, known)
                raise InvalidValueError(
                    f"parameter {key}, which {name} does not have",
                    expected=f"{near}, perhaps" if near else "one of its parameters",
                    do="see --help, or `ros2 param list` while it runs",
                )
        return unknown

    def _sections(self) -> Iterator[_Section]:
        pairs = zip(self.arguments, self.arguments[1:], strict=False)
        for file in [value for flag, value in pairs if flag == "--params-file"]:
            try:
                text = read_text_file(
                    Path(file), _MAX_BYTES, error=ConfigError, expected="a parameter file"
                )
                content = load_plain_yaml(text, file)
            except SemcalError:
                continue  # ROS itself says what is wrong with it
            yield from _list_sections(file, "", content)


def is_quality(name: str) -> bool:
    """Return whether a parameter overrides the quality of service of a topic."""
    return name.startswith(_OF_QOS)


def _list_sections(file: str, path: str, content: Any) -> Iterator[_Section]:
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        if key == "ros__parameters":
            yield _Section(file, path, frozenset(_list_names("", value)))
        else:
            yield from _list_sections(file, f"{path}/{str(key).strip('/')}", value)


def _list_names(prefix: str, content: Any) -> Iterator[str]:
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from _list_names(f"{prefix}.{key}" if prefix else str(key), value)
    else:
        yield prefix


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return the known name that looks most like a misspelt one; empty if none does."""
    return next(iter(difflib.get_close_matches(name, list(known), 1)), "")


_CURRENT: ContextVar[CommandLine] = ContextVar("command_line", default=CommandLine())  # noqa: B039 - frozen


def command_line() -> CommandLine:
    """Return the command line of the executable that is being started; an empty one elsewhere."""
    return _CURRENT.get()


@contextmanager
def starting_with(arguments: Sequence[str]) -> Iterator[CommandLine]:
    """Make these the arguments of the executable that is started inside."""
    line = CommandLine(tuple(arguments))
    token = _CURRENT.set(line)
    try:
        yield line
    finally:
        _CURRENT.reset(token)
