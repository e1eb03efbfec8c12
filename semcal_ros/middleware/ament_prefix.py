"""The ament index of a Python environment, which is searched only where a variable names its prefix."""

from __future__ import annotations

import os
import sys
from pathlib import Path

__all__ = ["add_environment_prefix"]

_VARIABLE = "AMENT_PREFIX_PATH"
_MARKER = Path("share", "ament_index", "resource_index", "packages", "semcal_ros")


def add_environment_prefix() -> None:
    """Put the prefix of this Python environment in front of ``AMENT_PREFIX_PATH``, if the suite is installed there.

    The setup script of a ROS installation or of a workspace sets the variable for what it holds. An environment that
    pip made has no such script, so the suite's executables and commands call this first. Child processes inherit it.
    """
    prefixes = [p for p in os.environ.get(_VARIABLE, "").split(os.pathsep) if p]
    if sys.prefix not in prefixes and (Path(sys.prefix) / _MARKER).is_file():
        os.environ[_VARIABLE] = os.pathsep.join([sys.prefix, *prefixes])
