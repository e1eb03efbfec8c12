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

"""The file that a node writes when a service asks for it: known, and said, before the work is done."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.nodes.common.parameters import ParameterDeclaration, Parameters

_SUFFIXES = (".yaml", ".yml")

OUTPUT = ParameterDeclaration(
    "output",
    "calibration.yaml",
    "File that ~/save writes, from the folder `directory` on. The default never replaces a file that was there before:"
    " it becomes calibration_2.yaml and so on.",
    confined=True,
)


class OutputFile:
    """The file of the parameter :data:`OUTPUT`.

    Parameters
    ----------
    parameters
        Parameters among which is :data:`OUTPUT`.
    on_change
        Called with :attr:`plan` when another file is named.
    """

    def __init__(self, parameters: Parameters, on_change: Callable[[str], None]) -> None:
        self._parameters = parameters
        self._written: Path | None = None
        parameters.on_change(OUTPUT.name, lambda _value: on_change(self.plan), _check_suffix)

    def path(self) -> Path:
        """Return the file that would be written now; raises :class:`InvalidValueError` if none may be."""
        name = str(self._parameters[OUTPUT.name] or OUTPUT.default)
        wanted = self._parameters.allowed_path(name)
        if name != OUTPUT.default:
            return wanted
        number, free = 2, wanted
        while free.exists() and free != self._written:
            free = wanted.with_name(f"{wanted.stem}_{number}{wanted.suffix}")
            number += 1
        return free

    @property
    def plan(self) -> str:
        """What a call to save would do now, in words."""
        try:
            path = self.path()
        except InvalidValueError as error:
            return f"~/save cannot write: {error}"
        if not os.access(path.parent, os.W_OK | os.X_OK):
            return f"~/save cannot write {path}: the folder is missing or read-only; set the parameter output"
        return f"~/save will {self._verb(path)} {path}"

    def _verb(self, path: Path) -> str:
        return "replace" if path.exists() and path != self._written else "write"

    def write(self, save: Callable[[Path], object]) -> str:
        """Write the file by ``save(path)``; return what was done, in words, with the whole path."""
        path = self.path()
        replaced = self._verb(path) == "replace"
        save(path)
        self._written = path
        return f"saved to {path}" + ", in place of a file that this node had not written" * replaced


def _check_suffix(name: str) -> None:
    # Whoever may call services may name files: a calibration must not become a start-up script.
    if name and Path(name).suffix not in _SUFFIXES:
        raise InvalidValueError(
            f"parameter output = {name!r}", expected="a name that ends in .yaml"
        )
