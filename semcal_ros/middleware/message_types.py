"""Message classes by name."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from semcal_ros.core.errors import ConfigError

__all__ = ["message_class"]


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
