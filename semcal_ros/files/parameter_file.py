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

"""Parameter files of ROS 2: which names they give to which nodes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semcal_ros.core.errors import ConfigError
from semcal_ros.files.plain_yaml import load_plain_yaml
from semcal_ros.text_files import read_text_file

_MAX_BYTES = 1024 * 1024  # they are written by hand; this only keeps other files out


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
