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

"""A page: its text with safe characters and quantities in readable units, and how it is filled in and written."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_text

# Most decimals of a number: longer ones do not fit a table.
_MOST_DECIMALS = 9


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


def remove_control_characters(text: object) -> str:
    """Replace what a page or UTF-8 cannot carry: control characters and lone surrogates."""
    kept = (
        c if c.isspace() or unicodedata.category(c) not in ("Cc", "Cs") else "�" for c in str(text)
    )
    return "".join(kept)


def format_with_sigma(value: float, sigma: float) -> str:
    """Format a value with two digits of its 1-sigma, such as ``230.54 ± 0.31``."""
    if not (np.isfinite(sigma) and sigma > 0.0):
        return f"{value:.4g}"
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, _MOST_DECIMALS))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def format_length(length_m: float, sigma_m: float | None = None) -> str:
    """Format a length in nm or µm, with two digits of its 1-sigma if it is given; those of photographs in mm."""
    unit, factor = ("µm", 1e6) if abs(length_m) >= 1e-6 else ("nm", 1e9)
    if abs(length_m) >= 1e-2:
        unit, factor = "mm", 1e3
    value = factor * length_m
    if sigma_m is None or not (np.isfinite(sigma_m) and sigma_m > 0.0):
        return f"{value:#.4g}".rstrip(".") + f" {unit}"
    return f"{format_with_sigma(value, factor * sigma_m)} {unit}"


def format_magnification(g: float, digits: int = 4) -> str:
    """Format a magnification to a number of digits, never with an exponent."""
    return f"{float(f'{g:.{digits}g}'):.10g}×"


def format_px(value: float | None) -> str:
    """Format an error in px; a dash stands for a missing one."""
    if value is None or np.isnan(value):
        return "–"
    if np.isinf(value):
        return "no answer"
    return f"{value:.3f} px"
