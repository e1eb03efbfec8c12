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

"""Message classes by name."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from semcal_ros.core.errors import ConfigError


def message_class(type_name: str) -> Any:
    """Class of a type such as ``"std_msgs/msg/Float64"``.

    Raises
    ------
    ConfigError
        The name is malformed or the package is not installed.
    """
    parts = type_name.split("/")
    if len(parts) == 3 and parts[1] == "msg" and all(part.isidentifier() for part in parts):
        try:
            return getattr(import_module(f"{parts[0]}.msg"), parts[2])
        except (ImportError, AttributeError):
            pass
    raise ConfigError(
        f"message type {type_name!r}",
        expected="an installed type such as std_msgs/msg/Float64",
        do="correct its spelling or install the package it comes from",
    )
