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

"""The ament index of a Python environment, which is searched only where a variable names its prefix."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_VARIABLE = "AMENT_PREFIX_PATH"
_MARKER = Path("share", "ament_index", "resource_index", "packages", "semcal_ros")


_added: list[str] = []


def add_environment_prefix() -> None:
    """Put the prefix of this Python environment in front of ``AMENT_PREFIX_PATH``, if the suite is installed there.

    The setup script of a ROS installation or of a workspace sets the variable for what it holds. An environment that
    pip made has no such script, so the suite's executables and commands call this first. Child processes inherit it.
    """
    prefixes = [p for p in os.environ.get(_VARIABLE, "").split(os.pathsep) if p]
    if sys.prefix not in prefixes and (Path(sys.prefix) / _MARKER).is_file():
        os.environ[_VARIABLE] = os.pathsep.join([sys.prefix, *prefixes])
        _added.append(sys.prefix)


def prefixes_of_user() -> list[str]:
    """Return the prefixes of ``AMENT_PREFIX_PATH`` that :func:`add_environment_prefix` did not put there."""
    return [p for p in os.environ.get(_VARIABLE, "").split(os.pathsep) if p and p not in _added]
