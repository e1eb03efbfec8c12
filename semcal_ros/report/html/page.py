"""From a template to a file on disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_text

__all__ = ["render", "write_page"]


def render(template: str, values: Mapping[str, Any]) -> str:
    """The page; every value is escaped, and a value that the template misses is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("semcal_ros.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(**values)


def write_page(path: str | os.PathLike[str], text: str) -> Path:
    """Write the page completely or not at all, and return its path.

    Raises
    ------
    InvalidValueError
        If the file cannot be written; an existing file is then untouched.
    """
    target = Path(path)
    try:
        atomic_write_text(target, text)
    except OSError as error:
        raise InvalidValueError(
            f"report {os.fspath(path)}: {error.strerror or error}",
            expected="a folder that can be written",
            do="choose another output",
        ) from error
    return target
