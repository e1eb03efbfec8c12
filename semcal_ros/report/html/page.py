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

"""Write a page from a template to a file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_text


def render(
    template: str, values: Mapping[str, Any], *, folder: str | os.PathLike[str] | None = None
) -> str:
    """Fill in a template.

    Parameters
    ----------
    template
        File name of the template. It may extend or import the templates of this package.
    values
        Values that the template shows; all are escaped.
    folder
        Folder of the template if it is not one of this package.

    Raises
    ------
    jinja2.UndefinedError
        If the template asks for a value that is not given.
    """
    loaders: list[jinja2.BaseLoader] = [jinja2.PackageLoader("semcal_ros.report.html", "templates")]
    if folder is not None:
        loaders.insert(0, jinja2.FileSystemLoader(folder))
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(loaders),
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
