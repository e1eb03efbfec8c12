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

"""Tables of numbers as CSV files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_text

__all__ = ["DRIFT_COLUMNS", "write_csv"]

DRIFT_COLUMNS = (
    "stamp_ns",
    "dx_m",
    "dy_m",
    "sigma_x_m",
    "sigma_y_m",
    "dx_px",
    "dy_px",
    "status",
)
"""Columns of ``drift.csv``."""


def _cell(value: object) -> str:
    """Format a value so that it reads back the same; None is written as ``nan``."""
    if value is None:
        return "nan"
    return repr(float(value)) if isinstance(value, float) else str(value)


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table completely or not at all, with full precision.

    Raises
    ------
    InvalidValueError
        The number of values in a row differs from the number of columns.
    OSError
        The file cannot be written; an existing one is untouched.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        if len(row) != len(columns):
            raise InvalidValueError(f"a row of {len(row)} values", expected=f"{len(columns)}")
        writer.writerow([_cell(value) for value in row])
    atomic_write_text(path, text.getvalue())
