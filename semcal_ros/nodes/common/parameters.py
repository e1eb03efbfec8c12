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

"""Parameters of a node: declared once with description, unit and range, refused with a reason, applied live.

Files that are named while a node runs, such as by a service, lie in one folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from semcal_ros.core.errors import InvalidValueError, SemcalError

Check = Callable[[Any], object]
Apply = Callable[[Any], None]


@dataclass(frozen=True)
class ParameterDeclaration:
    """One parameter.

    Attributes
    ----------
    name, default
        Name and default; the type of the default is the type of the parameter. An integer is accepted for a float.
    description, unit
        What ``ros2 param describe`` shows.
    low, high
        Range of a number, both ends included.
    choices
        The accepted strings; empty accepts any.
    fixed
        Only read when the node starts.
    confined
        The parameter names a file, which must lie inside :data:`DIRECTORY` once the node runs.
    """

    name: str
    default: bool | int | float | str
    description: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False
    confined: bool = False

    @property
    def is_float(self) -> bool:
        """Whether the parameter is a float, for which an integer is accepted too."""
        return isinstance(self.default, float)

    @property
    def expected(self) -> str:
        """What is accepted, as a text for messages."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        kind = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}
        text = kind[type(self.default)]
        if self.low is not None and self.high is not None:
            text += f" from {self.low:g} to {self.high:g}"
        return f"{text} ({self.unit})" if self.unit else text

    def descriptor(self) -> ParameterDescriptor:
        """Return the descriptor for ``declare_parameter``."""
        text = f"{self.description} Accepted: {self.expected}."
        descriptor = ParameterDescriptor(description=text, read_only=self.fixed)
        # A statically typed double would refuse `rate:=5`.
        descriptor.dynamic_typing = self.is_float
        if self.low is not None and self.high is not None:
            if self.is_float:
                limits = FloatingPointRange(from_value=float(self.low), to_value=float(self.high))
                descriptor.floating_point_range = [limits]
            else:
                whole = IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)
                descriptor.integer_range = [whole]
        return descriptor

    def convert(self, value: Any) -> Any:
        """Convert a value to the parameter's type; raises :class:`InvalidValueError` if it is not accepted."""
        wanted = type(self.default)
        if self.is_float and type(value) is int:
            value = float(value)
        good = type(value) is wanted
        if good and self.choices:
            good = value in self.choices
        if good and isinstance(value, (int, float)) and not isinstance(value, bool):
            good = math.isfinite(value)
            good = good and (self.low is None or value >= self.low)
            good = good and (self.high is None or value <= self.high)
        if not good:
            raise InvalidValueError(f"parameter {self.name} = {value!r}", expected=self.expected)
        return value


CONFIG = ParameterDeclaration(
    "config",
    "generic",
    "Description of the microscope's topics: a msg_configs file or the name of one that is shipped.",
    fixed=True,
)

DIAGNOSTICS_PERIOD = ParameterDeclaration(
    "diagnostics_period",
    1.0,
    "Time between two reports on /diagnostics.",
    unit="s",
    low=0.05,
    high=60.0,
    fixed=True,
)

DIRECTORY = ParameterDeclaration(
    "directory",
    "",
    "Folder of the files that are named while the node runs; empty: that of the file given at start.",
    fixed=True,
)

CALIBRATION = ParameterDeclaration(
    "calibration",
    "",
    "Calibration file; empty to wait for one on the topic `calibration`.",
    confined=True,
)

REPLAYED_CALIBRATION = ParameterDeclaration(
    "replayed_calibration",
    "ignore",
    "What to do with a calibration that comes while a recording is played on the topic `calibration`, where another one"
    " is in force already.",
    choices=("ignore", "take"),
)

INTERPOLATION = ParameterDeclaration(
    "interpolation",
    "linear",
    "Interpolation between raw pixels.",
    choices=("linear", "cubic", "lanczos4"),
)


class Parameters:
    """The declared parameters of one node, by name.

    Parameters
    ----------
    node
        The node that declares them.
    declarations
        What to declare.

    Raises
    ------
    InvalidValueError
        A value given at start is refused.
    """

    def __init__(self, node: Node, declarations: Iterable[ParameterDeclaration]) -> None:
        # The last declaration of a name counts: a node may change a default.
        self._declared = {declaration.name: declaration for declaration in declarations}
        self._values: dict[str, Any] = {}
        self._checks: dict[str, Check] = {}
        self._applies: dict[str, Apply] = {}
        confined = [name for name, declaration in self._declared.items() if declaration.confined]
        if confined:
            self._declared.setdefault(DIRECTORY.name, DIRECTORY)
        for declaration in self._declared.values():
            given = node.declare_parameter(
                declaration.name, declaration.default, declaration.descriptor()
            )
            self._values[declaration.name] = declaration.convert(given.value)
        # Files named at start are trusted, since the user who starts the node has its rights. Callers of
        # services are not.
        trusted = [self._values[name] for name in confined if self._values[name]]
        self._allowed = AllowedPaths(self._values.get(DIRECTORY.name, ""), trusted)
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._after_set)

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def allowed_path(self, path: str) -> Path:
        """Resolve a file name and its links; raises :class:`InvalidValueError` if the file lies outside."""
        return self._allowed.resolve(path)

    def on_change(self, name: str, apply: Apply, check: Check | None = None) -> None:
        """Call ``check(value)``, which may raise, before each change is accepted, and ``apply(value)`` after.

        A parameter that is set to the value that it has does not change, unless it names a file.
        """
        self._applies[name] = apply
        if check is not None:
            self._checks[name] = check

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                declaration = self._declared.get(parameter.name)
                if declaration is None:
                    continue
                value = declaration.convert(parameter.value)
                if declaration.confined and value:
                    self.allowed_path(value)
                if parameter.name in self._checks:
                    self._checks[parameter.name](value)
        except SemcalError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _after_set(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            declaration = self._declared.get(parameter.name)
            if declaration is None:
                continue
            before = self._values[parameter.name]
            self._values[parameter.name] = declaration.convert(parameter.value)
            # What a file holds may have changed; nothing else has.
            if self._values[parameter.name] == before and not declaration.confined:
                continue
            if parameter.name in self._applies:
                self._applies[parameter.name](self._values[parameter.name])


def _resolve(path: str, directory: str = "") -> Path:
    try:
        return Path(os.path.realpath(os.path.join(directory, os.path.expanduser(path))))
    except ValueError as error:
        raise InvalidValueError(f"file name {path!r} ({error})", expected="a path") from error


class AllowedPaths:
    """The files that may be named.

    Parameters
    ----------
    directory
        Folder in which the files must lie, and from which relative names start. Empty: the folders of
        ``trusted``, and the working directory.
    trusted
        Files named at the start, which are allowed wherever they are.

    Raises
    ------
    InvalidValueError
        ``directory`` is not a folder.
    """

    def __init__(self, directory: str = "", trusted: Sequence[str] = ()) -> None:
        self._start = str(_resolve(directory)) if directory else ""
        self._trusted = tuple(_resolve(path, self._start) for path in trusted)
        self._folders = tuple(path.parent for path in self._trusted)
        if directory:
            folder = Path(self._start)
            if not folder.is_dir():
                raise InvalidValueError(
                    f"directory {directory}, which is not a folder", expected="an existing folder"
                )
            self._folders = (folder,)

    def resolve(self, path: str) -> Path:
        """Return the file itself: ``~``, ``..`` and all symbolic links are resolved as they are now.

        Raises
        ------
        InvalidValueError
            The file lies elsewhere.
        """
        real = _resolve(path, self._start)
        if real in self._trusted or any(real.is_relative_to(folder) for folder in self._folders):
            return real
        if not self._folders:
            raise InvalidValueError(
                f"file {path}, but no folder whose files may be named while the node runs",
                expected="the parameter directory to name one",
                do="start the node with -p directory:=FOLDER",
            )
        folders = " or ".join(str(folder) for folder in dict.fromkeys(self._folders))
        behind = "" if str(real) == path else f", which is {real}"
        raise InvalidValueError(
            f"file {path}{behind}",
            expected=f"a file inside {folders}",
            do="choose one there, or start the node with another directory",
        )
