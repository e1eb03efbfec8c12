"""Names of ROS 2 (https://design.ros2.org/articles/topic_and_service_names.html)."""

from __future__ import annotations

from semcal_ros.core.errors import InvalidValueError

__all__ = ["absolute_namespace"]


def absolute_namespace(namespace: str) -> str:
    """Return a namespace such as ``sem/left/`` in the form ``/sem/left``.

    Raises
    ------
    InvalidValueError
        If ROS would not accept it.
    """
    parts = namespace.strip("/").split("/")
    if not all(part.isascii() and part.isidentifier() for part in parts):
        raise InvalidValueError(f"namespace {namespace!r}", expected="a ROS namespace such as /sem")
    return "/" + "/".join(parts)
